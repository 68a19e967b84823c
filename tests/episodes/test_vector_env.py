"""Gymnasium's vector environment: rewards add up to scores, episodes follow from seeds."""

import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from laboratory import OAR, check_refused, swimmer
from mjx_revolve import InputError, make_fitness, make_vector_env, simulate
from mjx_revolve.engine.plant import actuators_of
from mjx_revolve.episodes.functional_env import make_functional_env
from mjx_revolve.episodes.gym_ids import make_env
from mjx_revolve.episodes.scoring import WORST

gymnasium = pytest.importorskip(
    "gymnasium", reason="vector environments need gymnasium (pip install 'gymnasium>=1.1')"
)

NUM, STEPS = 5, 20
TASK = {
    "type": "directed_swim",
    "point": "core",  # an oar shakes it by more than its centre of mass gets in a second
    "duration": 1.0,
    "settle": 0.2,
    "trials": 1,
    "start_yaw": 1.0,
    "start_position": 0.1,
}
SENSORS = ["tilt", {"type": "depth", "noise": 0.1}, "accelerometer", "angle", "speed"]
pytestmark = pytest.mark.usefixtures("quick_compiles")


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    return swimmer(tmp_path_factory.mktemp("vector"), f"id: oar\n{OAR}", TASK)


@pytest.fixture(scope="module")
def env(config):
    return make_vector_env(config, NUM, sensors=SENSORS)


@pytest.fixture(scope="module")
def fitness(config):
    return make_fitness(config)


def run(env, actions, seed=0):
    """Observations, rewards, ends and infos of actions `[T, ...]`; row 0 is the reset."""
    found = [(env.reset(seed=seed)[0], np.zeros(env.num_envs), False, False, {})]
    for action in actions:
        found.append(env.step(np.broadcast_to(action, env.action_space.shape)))
    seen, rewards, terminated, truncated, infos = zip(*found, strict=True)
    over = np.array([np.broadcast_to(t, env.num_envs) for t in truncated])
    died = np.array([np.broadcast_to(t, env.num_envs) for t in terminated])
    return np.array(seen), np.array(rewards), died, over, infos


def strokes(steps=STEPS, num=NUM, size=0.8):
    """`[steps, num, 1]` another sine for each."""
    time = np.arange(steps)[:, None, None] / 20
    return size * np.sin(2 * np.pi * time * (1 + 0.2 * np.arange(num)[:, None])).astype(np.float32)


@pytest.fixture(scope="module")
def episode(env):
    """A whole episode and what comes next."""
    return run(env, strokes(STEPS + 3), seed=3)


def replay(fitness, actions, every, seed, episode=0):
    """The trajectory of held actions `[T, n]`, and the key of its start."""
    key = jax.random.fold_in(jax.random.key(seed), episode)
    low, high = fitness.robot.mj_model.actuator_ctrlrange.T
    own = np.zeros((len(actions), len(low)))
    own[:, actuators_of(fitness.robot)] = actions
    ctrl = np.repeat((low + high) / 2 + (high - low) / 2 * own, every, 0)
    return simulate(
        fitness.robot, ctrl, qpos=fitness.starts(key)[0][:, 0], water=fitness.water(key),
        context=fitness.context(key),
    ), key  # fmt: skip


@pytest.mark.slow
def test_spaces_and_what_comes_out_are_as_gymnasium_has_them(env, episode):
    assert isinstance(env, gymnasium.vector.VectorEnv)
    modes = gymnasium.vector.AutoresetMode
    assert env.metadata["autoreset_mode"] == modes.NEXT_STEP
    other = make_vector_env(env.fitness.config, 2, autoreset_mode=modes.SAME_STEP)
    assert other.metadata["autoreset_mode"] == modes.SAME_STEP
    assert env.control_rate == pytest.approx(20)
    assert env.observation_names[:5] == ("tilt x", "tilt y", "tilt z", "depth", "accelerometer x")
    assert [name.split()[0] for name in env.observation_names[-2:]] == ["angle", "speed"]
    assert env.single_observation_space.shape == (9,)
    assert env.single_action_space.shape == (1,)
    seen, info = env.reset(seed=1)
    assert info == {} and env.observation_space.contains(seen)
    seen, rewards, terminated, truncated, info = env.step(env.action_space.sample())
    assert env.observation_space.contains(seen) and info == {}
    assert (rewards.dtype, terminated.dtype, truncated.dtype) == (np.float64, np.bool_, np.bool_)
    assert {x.shape for x in (rewards, terminated, truncated)} == {(NUM,)}
    assert all(env.observation_space.contains(x) for x in episode[0])
    # What was given out stays as it is.
    kept = seen.copy()
    env.step(env.action_space.sample())
    assert np.array_equal(seen, kept)
    assert repr(env) == "WaterVectorEnv(directed_swim in lake, 5 of them at 20 Hz)"
    env.reset(seed=0)
    check_refused("actions: expected [5, 1]; found [5]", env.step, np.zeros(5))


@pytest.mark.slow
def test_a_target_that_drifts_stands_in_the_score_so_far(config):
    """A robot at rest loses what the target gains on it, step by step, and nothing beforehand."""
    more = {"task.type": "reach_target", "task.target_distance": 1.0, "task.target_speed": 0.1}
    fitness, key = make_fitness(config, **more), jax.random.key(2)
    context = jax.tree.map(lambda x: jnp.asarray(x)[None], fitness.context(key))
    start, rows = jnp.asarray(fitness.starts(key)[0][:3, :1]), fitness.num_records
    track = {"position": jnp.tile(start, (rows, 1, 1)), "energy": jnp.zeros((rows, 1))}
    clocks = fitness.record_every * jnp.arange(rows + 1)
    scores = [fitness.score_so_far(track, start, fitness.geometry, context, k)[0] for k in clocks]
    way = 0.1 * fitness.record_every * fitness.world.timestep / fitness.geometry.stretched
    assert np.abs(np.diff(scores, axis=0)).max() <= 1.01 * way and abs(scores[-1]) > way
    # A task's score that is none before it counts ends no episode.
    nothing = replace(fitness, task=replace(fitness.task, score=lambda *_: jnp.full(1, jnp.nan)))
    for k, expected in ((clocks[0], (0, True)), (clocks[-1], (WORST, False))):
        found = nothing.score_so_far(track, start, fitness.geometry, context, k)
        assert (float(found[0][0]), bool(found[1][0])) == expected


@pytest.mark.slow
def test_rewards_add_up_to_the_tasks_score(env, fitness, episode):
    _, rewards, died, over, infos = episode
    assert not died.any()
    assert over.sum(0).tolist() == [1] * NUM and over[STEPS].all()
    assert infos[STEPS]["_score"].all() and not any(infos[STEPS + 1 :])
    total = rewards[1 : STEPS + 1].sum(0)
    assert total == pytest.approx(infos[STEPS]["score"], abs=1e-6)
    assert np.all(rewards[:4] == 0)  # nothing counts before the settling time is over
    for i in (0, NUM - 1):
        trajectory, key = replay(fitness, strokes()[:, i], env.environment.every, 3 + i)
        score = fitness.judge(trajectory, key)[0]
        assert abs(score) > 1e-3
        assert total[i] == pytest.approx(score, rel=1e-3, abs=1e-5)


@pytest.mark.slow
def test_observations_are_what_the_sensors_tell(env, fitness, episode):
    seen = episode[0]
    trajectory, key = replay(fitness, strokes()[:, 0], env.environment.every, 3)
    qpos = np.asarray(trajectory.qpos)[env.environment.every - 1 :: env.environment.every]
    names = list(env.observation_names)
    angle = next(k for k, name in enumerate(names) if name.startswith("angle"))
    assert seen[1 : STEPS + 1, 0, angle] == pytest.approx(qpos[:, 7] / (np.pi / 4), abs=1e-3)
    w, x, y, z = np.asarray(fitness.starts(key)[0])[3:7, 0]
    up = [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    assert seen[0, 0, :3] == pytest.approx(up, abs=1e-5)
    # Noise of 0.1 m, of a range of 10 m.
    away = 10 * seen[1 : STEPS + 1, 0, names.index("depth")] + qpos[:, 2]
    assert 0.05 < away.std() < 0.2


TASKS = {
    "speed": {
        "task.current_std": 0.1, "task.energy_weight": 0.01,
        "world": {"name": "lake", "current": [0.1, 0.0, 0.0], "gust": {"std": 0.1, "time": 1.0},
                  "waves": [{"amplitude": 0.05, "period": 2.0}]},
    },
    "reach_target": {
        "task.target_distance": 1.0, "task.target_speed": 0.1,
        "sensors": ["bearing", {"type": "gyro", "rate": 10.0, "delay": 0.1}, "load"],
    },
}  # fmt: skip


@pytest.mark.long
@pytest.mark.sampled(1)
@pytest.mark.parametrize("task", TASKS)
def test_rewards_add_up_whatever_the_task_and_the_water(config, task):
    changes = TASKS[task] | {"task.type": task}
    env = make_vector_env(config, 2, **changes)
    fitness = make_fitness(config, **{k: x for k, x in changes.items() if k != "sensors"})
    actions = strokes(2 * STEPS + 1, 2)
    _, rewards, _, over, infos = run(env, actions, seed=5)
    assert over[STEPS].all() and over[2 * STEPS + 1].all()
    for number, first in enumerate((0, STEPS + 1)):  # the second episode begins a step later
        total = rewards[first + 1 : first + STEPS + 1].sum(0)
        assert total == pytest.approx(infos[first + STEPS]["score"], abs=1e-6)
        for i in range(2):
            own = actions[first : first + STEPS, i]
            trajectory, key = replay(fitness, own, env.environment.every, 5 + i, number)
            assert total[i] == pytest.approx(fitness.judge(trajectory, key)[0], rel=2e-3, abs=1e-4)


@pytest.mark.slow
def test_a_seed_says_everything(env, episode):
    again = run(env, strokes(STEPS + 3), seed=3)
    for a, b in zip(episode[:4], again[:4], strict=True):
        assert np.array_equal(a, b)
    other = run(env, strokes(2), seed=4)[0]
    assert not np.array_equal(other[0], episode[0][0])
    # Seeds count up; a list gives each its own.
    assert np.array_equal(other[0, :-1], episode[0][0, 1:])
    given = env.reset(seed=[7, 3, 3, 6, 5])[0]
    assert np.array_equal(given[[1, 2, 3, 4]], episode[0][0][[0, 0, 3, 2]])
    next_ones = env.reset()[0]
    env.reset(seed=[7, 3, 3, 6, 5])
    some = env.reset(seed=[None, 3, None, None, None])[0]
    assert np.array_equal(some[1], given[1])
    assert np.array_equal(some[[0, 2, 3, 4]], next_ones[[0, 2, 3, 4]])


@pytest.mark.slow
def test_some_of_them_can_be_reset(env, episode):
    run(env, strokes(4), seed=3)
    mask = np.array([False, True, False, True, False])
    seen, _ = env.reset(seed=3, options={"reset_mask": mask})
    assert np.array_equal(seen[mask], episode[0][0][mask])
    assert np.array_equal(seen[~mask], episode[0][4][~mask])
    after = env.step(strokes()[4])
    assert np.array_equal(after[0][~mask], episode[0][5][~mask])
    # Each has a clock of its own.
    for _ in range(STEPS - 5):
        after = env.step(strokes()[0])
    assert after[3].tolist() == (~mask).tolist()


@pytest.mark.slow
def test_who_blows_up_is_terminated_alone(env, episode):
    actions = strokes(STEPS)
    actions[6, 2] = np.nan
    seen, rewards, died, _, infos = run(env, actions, seed=3)
    when = int(np.argmax(died[:, 2]))
    assert when in (7, 8) and died[when].tolist() == [False, False, True, False, False]
    assert rewards[: when + 1, 2].sum() == pytest.approx(WORST)
    assert infos[when]["score"][2] == WORST and infos[when]["_score"].tolist() == [*died[when]]
    assert np.all(np.isfinite(seen))
    assert rewards[when + 1, 2] == 0 and not died[when + 1 :].any()
    others = [0, 1, 3, 4]
    assert np.array_equal(seen[:, others], episode[0][: STEPS + 1][:, others])


@pytest.mark.slow
def test_episodes_can_begin_anew_within_the_step(config, episode):
    same = make_vector_env(config, NUM, sensors=SENSORS, autoreset_mode="SameStep")
    seen, rewards, _, over, infos = run(same, strokes(STEPS + 1), seed=3)
    assert np.array_equal(seen[:STEPS], episode[0][:STEPS])
    assert np.array_equal(rewards[: STEPS + 1], episode[1][: STEPS + 1])
    last = infos[STEPS]
    assert np.array_equal(last["final_obs"], episode[0][STEPS]) and last["_final_obs"].all()
    assert np.array_equal(last["final_info"]["score"], episode[4][STEPS]["score"])
    assert np.array_equal(seen[STEPS], episode[0][STEPS + 1]) and over[STEPS].all()
    assert not over[STEPS + 1].any()


def test_what_is_wrong_gets_one_message(config, monkeypatch):
    def refuses(words, *given, **changes):
        check_refused(words, make_vector_env, *given, **changes)

    refuses("num_envs: expected a whole number >= 1; found 0", config, 0)
    refuses("control_rate: expected one of 10, 20, 40, 50, 100, 200 Hz; found 30", config, 1,
            control_rate=30)  # fmt: skip
    refuses("autoreset_mode: expected one of NextStep, SameStep; found", config, autoreset_mode=1)
    refuses("controller.sensors", config, 1, sensors=["smell"])
    refuses("engine: expected population", config, 1, engine="mjx")
    bodies = {"bodies": {"seeds": ["spider"]}, "morphology": None, "trim": "none"}
    refuses("expected one, as this is the fitness of one body", config, 1, **bodies)
    refuses("expected a hinge or a thruster", config, 1, morphology="core")
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    refuses("pip install 'gymnasium>=1.1'", config, 1)


def test_wrong_calls_get_one_message(config):
    env = make_vector_env(config, 2)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros((2, 1)))
    with pytest.raises(InputError, match="autoreset_mode: expected none, as this is a single Env"):
        make_env(config, autoreset_mode="SameStep")
    wrong = (-1, 2**32, 0.5, [1, 2, 3], [None], ["a", None], "a", b"ab", jax.random.key(0),
             np.array(0.5), [2**64, 1], [[1], [2, 3]])  # fmt: skip
    for seed in wrong:
        check_refused("seed: expected a whole number", env.reset, seed=seed)
    for given in (np.array(5), jnp.int32(5), np.array([5, 6]), jnp.arange(5, 7)):
        assert env._read_seeds(given).tolist() == [5, 6]
    with pytest.raises(InputError, match="render_mode: expected none, as nothing is drawn"):
        make_env(config, render_mode="rgb_array")
    check_refused("sensors: expected a list; found 5", make_vector_env, config, 2, sensors=5)
    pure = make_functional_env(config)
    with pytest.raises(InputError, match=r"action: expected 1 numbers; found 3"):
        jax.eval_shape(lambda key: pure.step(pure.reset(key), np.zeros(3)), jax.random.key(0))
    with pytest.raises(InputError, match=r"reset_mask: expected \[2\] of bool"):
        env.reset(seed=0, options={"reset_mask": [True]})
