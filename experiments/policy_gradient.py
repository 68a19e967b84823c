"""A swimmer learnt by policy gradient through Gymnasium's vector environment.

``python -m experiments.policy_gradient [--seconds S] [--seed N] [--envs N] [--out DIR]``

Proximal policy optimisation (Schulman et al. 2017, arXiv:1707.06347) as CleanRL has it for
continuous actions (Huang et al. 2022, "The 37 implementation details of PPO"): clipped ratios,
generalised advantage estimation (Schulman et al. 2015, arXiv:1506.02438), two small networks, Adam.
The fish of `configs/fish_swim.yaml` learns to swim ahead from what it feels; no gait is given. At
the end, its mean action is judged on fresh episodes beside doing nothing and acting at random.
Needs gymnasium: ``pip install 'gymnasium>=1.1'``.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from experiments.common import make_folder, make_parser, write_results
from mjx_revolve.episodes.rollout import Rollout, held
from mjx_revolve.episodes.vector_env import make_vector_env
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import write_atomic
from mjx_revolve.numerics.runtime import prepare_process
from mjx_revolve.numerics.xla import jit
from mjx_revolve.water.flow import water_of

CONFIG = "fish_swim"
SENSORS = ("tilt", "compass", "gyro", "flow", "climb", "angle", "speed")
# The fish swims along y, and nothing is lost on the time in which it need not. Rewards are the way
# itself, in one water.
CHANGES = {"task.settle": 0.5, "task.duration": 5.0, "task.horizon": None, "task.robust": None}


@dataclass(frozen=True)
class Settings:
    """Of the learner; CleanRL's for continuous actions where nothing is said.

    Attributes:
        steps: control steps between updates.
        epochs: how often each step is learnt from.
        batches: into which the steps of an update are divided.
        rate: of learning, at first; it falls to 0 with the time.
        discount: of a reward one step later.
        trace: λ of the advantages.
        clip: how far a ratio may leave 1 before it counts no more.
        spread: logarithm of the actions' standard deviation at first.
        hidden: units of each of two layers.
    """

    steps: int = 50
    epochs: int = 5
    batches: int = 8
    rate: float = 1e-3
    discount: float = 0.98
    trace: float = 0.95
    clip: float = 0.2
    spread: float = -0.7
    hidden: int = 64


def init_networks(key: jax.Array, seen: int, acts: int, settings: Settings) -> dict[str, Any]:
    """Weights of the policy and the value, orthogonal (Saxe et al. 2014), and the log spread."""

    def layers(key: jax.Array, out: int, scale: float) -> list[Any]:
        sizes = [(seen, settings.hidden), (settings.hidden, settings.hidden)]
        sizes.append((settings.hidden, out))
        keys = jax.random.split(key, 3)
        scales = (np.sqrt(2), np.sqrt(2), scale)
        return [
            (jax.nn.initializers.orthogonal(s)(k, size), jnp.zeros(size[1]))
            for k, size, s in zip(keys, sizes, scales, strict=True)
        ]

    policy, value = jax.random.split(key)
    return {
        "policy": layers(policy, acts, 0.01),
        "value": layers(value, 1, 1.0),
        "spread": jnp.full(acts, settings.spread),
    }


def apply(layers: list[Any], x: jax.Array) -> jax.Array:
    """A network of tanh units."""
    for weight, bias in layers[:-1]:
        x = jnp.tanh(x @ weight + bias)
    weight, bias = layers[-1]
    return x @ weight + bias


def log_chance(mean: jax.Array, spread: jax.Array, action: jax.Array) -> jax.Array:
    """Logarithm of a normal density, summed over the actions."""
    off = (action - mean) / jnp.exp(spread)
    return jnp.sum(-0.5 * off * off - spread - 0.5 * np.log(2 * np.pi), -1)


@jax.jit
def act(weights: Any, seen: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """An action, its log chance, and what is expected from here."""
    mean = apply(weights["policy"], seen)
    action = mean + jnp.exp(weights["spread"]) * jax.random.normal(key, mean.shape)
    return action, log_chance(mean, weights["spread"], action), apply(weights["value"], seen)[:, 0]


def advantages(
    rewards: jax.Array, values: jax.Array, over: jax.Array, settings: Settings
) -> jax.Array:
    """Generalised advantage estimation.

    Args:
        rewards: `[T, envs]`.
        values: `[T + 1, envs]`, the last of what comes after.
        over: `[T, envs]` whether the episode was over after the step: its value then counts for
            nothing, and what comes next is none of its doing.
        settings: of the learner.

    Returns:
        `[T, envs]`.
    """

    def back(later: jax.Array, row: Any) -> tuple[jax.Array, jax.Array]:
        reward, value, after, ended = row
        goes_on = 1.0 - ended
        error = reward + settings.discount * goes_on * after - value
        found = error + settings.discount * settings.trace * goes_on * later
        return found, found

    rows = (rewards, values[:-1], values[1:], over.astype(rewards.dtype))
    return jax.lax.scan(back, jnp.zeros_like(rewards[0]), rows, reverse=True)[1]


def loss(weights: Any, batch: dict[str, jax.Array], settings: Settings) -> jax.Array:
    """The clipped objective, and the value's error; steps that only began an episode left out."""
    mean = apply(weights["policy"], batch["seen"])
    ratio = jnp.exp(log_chance(mean, weights["spread"], batch["action"]) - batch["chance"])
    gain, counts = batch["gain"], batch["counts"]
    share = counts / jnp.maximum(jnp.sum(counts), 1)
    center = jnp.sum(share * gain)
    gain = (gain - center) / (jnp.sqrt(jnp.sum(share * (gain - center) ** 2)) + 1e-8)
    clipped = jnp.clip(ratio, 1 - settings.clip, 1 + settings.clip)
    better = jnp.minimum(ratio * gain, clipped * gain)
    error = apply(weights["value"], batch["seen"])[:, 0] - batch["return"]
    return jnp.sum(share * (0.5 * error * error - better))


@partial(jax.jit, static_argnames=("optimiser", "settings"))
def learn(
    weights: Any,
    memory: Any,
    track: dict[str, jax.Array],
    key: jax.Array,
    *,
    optimiser: Any,
    settings: Settings,
) -> tuple[Any, Any]:
    """An update from `[T, envs]` of steps; `track["values"]` has a row more."""
    gain = advantages(track["reward"], track["values"], track["over"], settings)
    rows = {k: track[k] for k in ("seen", "action", "chance", "counts")}
    rows |= {"gain": gain, "return": gain + track["values"][:-1]}
    rows = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rows)
    count = rows["gain"].shape[0] // settings.batches

    def batch(carry: Any, index: jax.Array) -> tuple[Any, None]:
        weights, memory = carry
        own = jax.tree.map(lambda x: x[index], rows)
        slope = jax.grad(loss)(weights, own, settings)
        change, memory = optimiser.update(slope, memory, weights)
        return (optax.apply_updates(weights, change), memory), None

    for epoch_key in jax.random.split(key, settings.epochs):
        order = jax.random.permutation(epoch_key, rows["gain"].shape[0])
        order = order[: count * settings.batches].reshape(settings.batches, count)
        (weights, memory), _ = jax.lax.scan(batch, (weights, memory), order)
    return weights, memory


def train(
    env: Any, seconds: float, seed: int, settings: Settings, say: Callable[[str], None]
) -> tuple[Any, list[dict[str, float]]]:
    """Learns for a while.

    Args:
        env: from `make_vector_env`, mode NextStep.
        seconds: of learning, compilation left out [s].
        seed: of weights, actions and episodes.
        settings: of the learner.
        say: is told how it goes.

    Returns:
        The weights, and a row for each update: seconds, env steps, mean score of episodes that
        were over since the row before.
    """
    key, weights_key = jax.random.split(jax.random.key(seed))
    seen, acts = env.single_observation_space.shape[0], env.single_action_space.shape[0]
    weights = init_networks(weights_key, seen, acts, settings)
    optimiser = optax.chain(
        optax.clip_by_global_norm(0.5), optax.inject_hyperparams(optax.adam)(settings.rate)
    )
    memory = optimiser.init(weights)
    now, _ = env.reset(seed=seed)
    ended = np.zeros(env.num_envs, bool)
    scores: list[float] = []
    log: list[dict[str, float]] = []
    spent, steps = 0.0, 0
    # Rewards add up to scores of about 1: as sums of a hundred they are large enough to learn from.
    scale = 1 / (1 - settings.discount)
    began = None
    while spent < seconds:
        found: dict[str, list[Any]] = {}
        for _ in range(settings.steps):
            key, own = jax.random.split(key)
            action, chance, value = act(weights, now, own)
            after, reward, terminated, truncated, infos = env.step(np.asarray(action))
            row = {
                "seen": now, "action": action, "chance": chance, "values": value,
                "reward": np.float32(scale) * reward.astype(np.float32),
                "over": terminated | truncated,
                "counts": (~ended).astype(np.float32),  # else the step only began an episode
            }  # fmt: skip
            for name, x in row.items():
                found.setdefault(name, []).append(x)
            # An episode that its time has ended would have gone on: what was to come is added.
            if truncated.any():
                more = np.asarray(act(weights, after, own)[2])
                row["reward"] += settings.discount * np.where(truncated, more, 0)
            if "score" in infos:
                scores += infos["score"][infos["_score"]].tolist()
            now, ended = after, terminated | truncated
        found["values"].append(act(weights, now, own)[2])
        track = {name: jnp.stack([jnp.asarray(x) for x in rows]) for name, rows in found.items()}
        key, own = jax.random.split(key)
        memory[1].hyperparams["learning_rate"] = jnp.asarray(
            settings.rate * max(0.0, 1 - spent / seconds), jnp.float32
        )
        weights, memory = learn(weights, memory, track, own, optimiser=optimiser, settings=settings)
        jax.block_until_ready(weights)
        if began is None:  # the first update compiles everything, and is not counted
            began = time.perf_counter()
            continue
        spent = time.perf_counter() - began
        steps += settings.steps * env.num_envs
        if scores:
            log.append({"seconds": spent, "steps": steps, "score": float(np.mean(scores))})
            if len(log) % 5 == 1:
                say(f"{spent:5.0f} s  {steps:9,} env steps  score {log[-1]['score']:7.3f}")
            scores = []
    return weights, log


def judge(env: Any, policy: Callable[[np.ndarray], Any], seed: int) -> np.ndarray:
    """`[num_envs]` scores of one episode each, from other starts than those of learning."""
    now, _ = env.reset(seed=seed)
    scores = np.full(env.num_envs, np.nan)
    while np.isnan(scores).any():
        now, _, _, _, infos = env.step(policy(now))
        if "score" in infos:  # of those that are over, the first
            scores = np.where(infos["_score"] & np.isnan(scores), infos["score"], scores)
    return scores


def time_both(env: Any, rounds: int = 8, steps: int = 100) -> tuple[float, float]:
    """Speed of the environments and of the engine alone, in turn, the best of a few rounds.

    Args:
        env: whose they are.
        rounds: of each.
        steps: control steps in a round.

    Returns:
        Env steps in a second, all environments counted; and timesteps of one robot in a second that
        the engine makes where nobody watches, as many robots side by side as in a chunk.
    """
    fitness = env.fitness
    engine, world, model = fitness.engine, fitness.robot.world, fitness.robot.mj_model
    lanes, every = min(env.num_envs, 64), env.environment.every

    def run(qpos: jax.Array, qvel: jax.Array, ctrl: jax.Array) -> Any:
        rollout = Rollout(engine, held(ctrl), world, water_of(world))
        start = rollout.init(engine.init(qpos, qvel))
        last, _ = rollout.advance(start, lambda now, ctrl, water: now.energy, steps, every)
        return engine.root(last.state).position

    qpos = jnp.repeat(jnp.asarray(fitness.robot.start_qpos(), jnp.float32)[:, None], lanes, 1)
    given = qpos, jnp.zeros((model.nv, lanes)), jnp.zeros((engine.plant.num_rows, lanes))
    jitted = jit(run)
    jax.block_until_ready(jitted(*given))
    env.reset(seed=0)
    action, best = env.action_space.sample(), [np.inf, np.inf]
    env.step(action)
    for _ in range(rounds):
        began = time.perf_counter()
        for _ in range(steps):
            env.step(action)
        middle = time.perf_counter()
        jax.block_until_ready(jitted(*given))
        end = time.perf_counter()
        best = [min(best[0], middle - began), min(best[1], end - middle)]
    return steps * env.num_envs / best[0], steps * every * lanes / best[1]


def main(argv: Sequence[str] | None = None) -> int:
    """Learns, judges and times; writes the numbers as JSON."""
    parser = make_parser("policy_gradient", "A fish learns to swim by policy gradient.")
    parser.add_argument("--seconds", type=float, default=90.0, help="of learning (default: 90)")
    parser.add_argument("--seed", type=int, default=0, help="of everything (default: 0)")
    parser.add_argument("--envs", type=int, default=64, help="environments (default: 64)")
    args = parser.parse_args(argv)
    if not 0 < args.seconds < 86400:
        raise InputError("--seconds", "a number > 0, below a day", f"{args.seconds:g}")
    if not 0 <= args.seed < 2**31:
        raise InputError("--seed", f"0 to {2**31 - 1}", args.seed)
    folder = make_folder(args.out, "policy_gradient")
    prepare_process()
    env = make_vector_env(CONFIG, args.envs, sensors=SENSORS, **CHANGES)
    say = partial(print, flush=True)
    say(f"{env}: {len(env.observation_names)} numbers seen, {len(env.action_names)} joints")
    weights, log = train(env, args.seconds, args.seed, Settings(), say)
    fresh = 2**31 + args.seed  # learning begins at seeds below
    draw = np.random.default_rng(args.seed)
    policies: dict[str, Callable[[np.ndarray], Any]] = {
        "learnt": lambda seen: np.asarray(apply(weights["policy"], seen)),
        "nothing": lambda seen: np.zeros(env.action_space.shape),
        "random": lambda seen: draw.uniform(-1, 1, env.action_space.shape),
    }
    unit, scores = env.fitness.task.unit, {k: judge(env, f, fresh) for k, f in policies.items()}
    say(f"Scores of {env.num_envs} fresh episodes [{unit}], mean and standard deviation:")
    for name, found in scores.items():
        say(f"  {name:8} {found.mean():7.3f} ± {found.std():.3f}")
    speed, bare = time_both(env)
    every = env.environment.every
    say(
        f"{speed:,.0f} env steps/s of {every} timesteps each = {speed * every:,.0f} timesteps/s; "
        f"the bare engine {bare:,.0f} ({speed * every / bare:.0%})"
    )
    data = {
        "scores": {k: {"mean": x.mean(), "std": x.std()} for k, x in scores.items()},
        "unit": unit, "seconds": args.seconds, "env_steps_per_second": speed,
        "timesteps_per_env_step": every, "share_of_engine": speed * every / bare,
        "engine_timesteps_per_second": bare,
    }  # fmt: skip
    path = folder / "policy_gradient.json"
    write_atomic(path, (json.dumps({"log": log}, indent=1) + "\n").encode())
    say(f"Wrote {path}")
    if args.results:
        write_results("policy_gradient", data, [args.seed])
    return 0


if __name__ == "__main__":
    raise SystemExit(run_command(main))
