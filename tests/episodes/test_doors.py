"""Gymnasium's ids, Stable-Baselines3's interface and the pure environment: one environment."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from laboratory import OAR, swimmer
from mjx_revolve import load_config, make_vector_env
from mjx_revolve.episodes import make_functional_env, make_sb3_env, register_envs
from mjx_revolve.episodes.gym_ids import CONFIGS, env_id
from mjx_revolve.inputs.shipped import list_shipped

gymnasium = pytest.importorskip("gymnasium", reason="pip install 'gymnasium>=1.1'")
pytestmark = pytest.mark.usefixtures("quick_compiles")

TASK = {
    "type": "directed_swim", "point": "core", "duration": 1.0, "settle": 0.2, "trials": 1,
    "start_yaw": 1.0,
}  # fmt: skip
NUM, STEPS = 3, 20


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    return swimmer(tmp_path_factory.mktemp("doors"), f"id: oar\n{OAR}", TASK)


@pytest.fixture(scope="module")
def actions():
    return np.random.default_rng(0).uniform(-1, 1, (2 * STEPS + 3, NUM, 1)).astype(np.float32)


@pytest.fixture(scope="module")
def keys():
    return jax.random.split(jax.random.key(3), NUM)


@pytest.fixture(scope="module")
def vector(config, keys, actions):
    """Observations, rewards and ends of a vector environment; row 0 is the reset."""
    env = make_vector_env(config, NUM, autoreset_mode="SameStep")
    seeds = np.asarray(jax.vmap(jax.random.bits)(keys)).tolist()
    found = [(env.reset(seed=seeds)[0], np.zeros(NUM), np.zeros(NUM, bool))]
    for action in actions:
        seen, rewards, terminated, truncated, _ = env.step(action)
        found.append((seen, rewards, terminated | truncated))
    return [np.array(column) for column in zip(*found, strict=True)]


def test_every_shipped_task_of_one_robot_has_an_id():
    whole = {name: load_config(name) for name in list_shipped("configs") if name != "smoke"}
    single = [n for n, c in whole.items() if c.bodies is None and c.colony is None]
    assert sorted(single) == sorted(CONFIGS)
    register_envs()
    register_envs()  # once more does nothing
    assert {env_id(name) for name in CONFIGS} <= set(gymnasium.registry)
    assert env_id("lake_swim") == "mjx_revolve/LakeSwim-v0"


def test_ids_are_registered_without_heavy_imports():
    script = (
        "import sys, gymnasium, mjx_revolve.episodes.gym_ids; "
        "found = gymnasium.spec('mjx_revolve/LakeSwim-v0'); "
        "assert found.kwargs == {'config': 'lake_swim'}; "
        "assert not {'jax', 'mujoco', 'scipy'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_gymnasium_finds_nothing_wrong_with_one(config):
    from gymnasium.utils.env_checker import check_env

    env = gymnasium.make("mjx_revolve.episodes.gym_ids:mjx_revolve/FishSwim-v0", config=config)
    check_env(env.unwrapped, skip_render_check=True)
    env.reset(seed=4)
    total, over = 0.0, False
    while not over:
        _, reward, terminated, truncated, info = env.step(env.action_space.sample())
        total, over = total + reward, terminated or truncated
    assert total == pytest.approx(info["score"], abs=1e-6)
    many = gymnasium.make_vec("mjx_revolve/FishSwim-v0", 2, config=config)
    assert many.reset(seed=0)[0].shape == (2, env.observation_space.shape[0])


@pytest.mark.slow
def test_a_vmapped_environment_is_the_vector_environment_bit_for_bit(config, keys, actions, vector):
    env = make_functional_env(config, auto_reset=True)
    state = jax.jit(jax.vmap(env.reset))(keys)
    step = jax.jit(jax.vmap(env.step))
    found = [(state.obs, state.reward, state.done)]
    for action in actions:
        state = step(state, jnp.asarray(action))
        found.append((state.obs, state.reward, state.done))
    assert state.obs.shape == (NUM, env.observation_size)
    for ours, theirs in zip(zip(*found, strict=True), vector, strict=True):
        # Chunks are padded there, so that the compiler may round otherwise.
        np.testing.assert_allclose(np.array(ours), theirs, atol=2e-5)
    assert np.flatnonzero(np.array(found[-1][2])).size == 0
    assert [k for k, row in enumerate(found) if row[2].any()] == [STEPS, 2 * STEPS]


@pytest.mark.slow
def test_one_environment_is_a_row_of_the_batch_and_episodes_can_be_scanned(
    config, keys, actions, vector
):
    env = make_functional_env(config)

    @jax.jit
    def episode(key, actions):
        def step(state, action):
            state = env.step(state, action)
            return state, (state.obs, state.reward, state.done, state.info["truncation"])

        return jax.lax.scan(step, env.reset(key), actions)

    last, (seen, rewards, done, truncated) = episode(keys[1], jnp.asarray(actions[:STEPS, 1]))
    np.testing.assert_allclose(seen[:-1], vector[0][1:STEPS, 1], atol=2e-5)
    np.testing.assert_allclose(rewards, vector[1][1 : STEPS + 1, 1], atol=2e-5)
    assert done.tolist() == truncated.tolist() == [0.0] * (STEPS - 1) + [1.0]
    assert float(rewards.sum()) == pytest.approx(float(last.metrics["score"]), abs=1e-5)


@pytest.mark.slow
def test_stable_baselines_interface(config, actions, keys, vector):
    pytest.importorskip("stable_baselines3", reason="pip install stable-baselines3")
    from stable_baselines3.common.vec_env import VecMonitor

    env = VecMonitor(make_sb3_env(config, NUM))
    env.seed(7)
    first = env.reset()
    assert first.shape == (NUM, env.observation_space.shape[0])
    for k in range(STEPS):
        seen, _, over, infos = env.step(actions[k])
        assert over.all() == (k == STEPS - 1)
    for i, info in enumerate(infos):
        assert info["TimeLimit.truncated"] and info["episode"]["l"] == STEPS
        assert info["episode"]["r"] == pytest.approx(info["score"], abs=1e-5)
        assert not np.array_equal(info["terminal_observation"], seen[i])
    env.seed(7)
    np.testing.assert_array_equal(env.reset(), first)
    assert env.get_attr("control_rate") == [20.0] * NUM
