"""A brain learnt by gradients through the water, beside one that evolves for as long.

``python -m experiments.gradient_learning [--seconds S] [--seed N] [--out DIR]``

A fish learns to swim to targets, which its oscillators only know of by a sensor of their direction
(`sensory_cpg`, the brain and the task of `configs/lake_target.yaml`). Four brains learn side by
side, each in 16 episodes: every 2 s of an episode (`make_windows`), Adam goes a step along the mean
gradient. Gradients are clipped episode by episode, to the median length of those of the same brain,
as where the motion is chaotic single ones are longer by orders of magnitude. The rate falls to 0
with the time. Then CMA-ES has as long. Time is that of processors, without compilation.
The best brain by gradient goes into a run folder, which replay, viewer and report can read.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from experiments.common import ROOT, make_folder, make_parser, write_results
from mjx_revolve.episodes.config import EvolutionConfig, load_config
from mjx_revolve.episodes.fitness import Fitness, make_fitness
from mjx_revolve.episodes.scoring import REPORT_STREAM
from mjx_revolve.episodes.windows import TruncatedBPTT, make_windows
from mjx_revolve.evolution.run_folder import create_run_folder
from mjx_revolve.evolution.strategies import make_strategy
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import short_path
from mjx_revolve.numerics.runtime import prepare_process

CONFIG = ROOT / "configs" / "lake_target.yaml"
# The fish is neutral as it is. All of an episode counts, so that its first window does as well.
CHANGES = {
    "morphology": str(ROOT / "morphologies" / "fish.yaml"),
    "trim": "none",
    "task.settle": 0.0,
}
# Of the gradient; choices. Brains times episodes fill one chunk.
BRAINS, EPISODES = 4, 16
HORIZON, RATE, SPREAD = 2.0, 0.02, 0.2
# Of the evolution; choices: half of the episodes of the configuration, twice the generations.
POPULATION, TRIALS = 64, 8
FRESH = 4  # keys of 16 starts each that nobody learnt from


def clip_gradients(gradient: jax.Array) -> jax.Array:
    """Makes no gradient longer than the median of those of the same individual.

    Args:
        gradient: `[P, trials, num_genes]`.

    Returns:
        Likewise.
    """
    size = jnp.linalg.norm(gradient, axis=-1, keepdims=True)
    # Squares of very long ones overflow: what has no length any more says nothing.
    gradient = jnp.where(jnp.isfinite(size), gradient, 0.0)
    size = jnp.where(jnp.isfinite(size), size, 0.0)
    most = jnp.median(size, axis=1, keepdims=True)
    return gradient * jnp.minimum(1.0, most / jnp.maximum(size, 1e-12))


def learn(
    windows: TruncatedBPTT, seconds: float, seed: int, say: Callable[[str], None]
) -> tuple[np.ndarray, float]:
    """Learns by gradients for a while.

    Args:
        windows: of the fitness.
        seconds: of processors, compilation left out [s].
        seed: of brains and episodes.
        say: is told how it goes.

    Returns:
        `[BRAINS, num_genes]`, and how long compilation took [s of wall time].
    """
    key = jax.random.key(seed)
    genes = SPREAD * jax.random.normal(key, (BRAINS, windows.fitness.num_genes))
    optimiser = optax.inject_hyperparams(optax.adam)(RATE)
    memory = optimiser.init(genes)

    @jax.jit
    def improve(genes: jax.Array, memory: Any, gradient: jax.Array) -> Any:
        change, memory = optimiser.update(-clip_gradients(gradient).mean(1), memory)
        return optax.apply_updates(genes, change), memory

    began = time.perf_counter()
    gradients, _ = windows.step(genes, windows.init(genes, key))
    jax.block_until_ready(improve(genes, memory, gradients.gradient))
    compiling, start, number, spent = time.perf_counter() - began, time.process_time(), 0, 0.0
    told = 0.0
    while spent < seconds:
        episodes, score = windows.init(genes, jax.random.fold_in(key, number)), 0.0
        for _ in range(windows.count):
            gradients, episodes = windows.step(genes, episodes)
            score += np.asarray(gradients.gain).mean(1)
            left = max(0.0, 1 - (time.process_time() - start) / seconds)
            memory.hyperparams["learning_rate"] = jnp.asarray(RATE * left, jnp.float32)
            genes, memory = improve(genes, memory, gradients.gradient)
        number, spent = number + 1, time.process_time() - start
        if spent >= told:
            told += seconds / 8
            say(f"{spent:5.0f} s  {number:5} rounds of episodes  scores {np.round(score, 2)}")
    return np.asarray(genes), compiling


def evolve(fitness: Fitness, seconds: float, seed: int, say: Callable[[str], None]) -> np.ndarray:
    """CMA-ES for as long; `[1, num_genes]` the centre of its distribution."""
    strategy = make_strategy(EvolutionConfig(population_size=POPULATION), fitness.num_genes)
    key = jax.random.key(seed)
    state = strategy.init(key)
    # Compiled before the time counts, as what learns by gradients is.
    population, thrown = strategy.ask(key, state)
    strategy.tell(key, population, np.asarray(fitness(population, key)), thrown)
    start, number, spent, told = time.process_time(), 0, 0.0, 0.0
    while spent < seconds:
        own = jax.random.fold_in(key, number)
        population, state = strategy.ask(own, state)
        scores = np.asarray(fitness(population, own))
        state = strategy.tell(own, population, scores, state)
        number, spent = number + 1, time.process_time() - start
        if spent >= told:
            told += seconds / 8
            say(f"{spent:5.0f} s  {number:5} generations  best {scores.max():.2f}")
    mean = strategy.mean(state)
    assert mean is not None
    return mean[None]


def judge(fitness: Fitness, genes: np.ndarray, seed: int) -> np.ndarray:
    """`[P]` mean scores on starts that nobody learnt from."""
    key = jax.random.fold_in(jax.random.key(seed), REPORT_STREAM)
    scores = [fitness(genes, jax.random.fold_in(key, k)) for k in range(FRESH)]
    return np.mean(scores, 0)


def main(argv: Sequence[str] | None = None) -> int:
    """Learns, evolves, judges both, and writes the best brain by gradient as a run folder."""
    parser = make_parser("gradient_learning", "A brain learnt by gradients through the water.")
    parser.add_argument(
        "--seconds", type=float, default=30.0, help="of processors, for each (default: 30)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of everything (default: 0)")
    args = parser.parse_args(argv)
    if not 0 < args.seconds < 86400:
        raise InputError("--seconds", "a number > 0, below a day", f"{args.seconds:g}")
    if not 0 <= args.seed < 2**31:
        raise InputError("--seed", f"0 to {2**31 - 1}", args.seed)
    config = load_config(CONFIG, CHANGES | {"task.trials": EPISODES})
    run, config = create_run_folder(
        make_folder(args.out, "gradient_learning"), config, seed=args.seed
    )
    prepare_process()
    say = partial(print, flush=True)
    fitness = make_fitness(config)
    windows = make_windows(fitness, HORIZON)
    say(f"{windows}: {fitness.num_genes} genes")
    genes, compiling = learn(windows, args.seconds, args.seed, say)
    # Which of them is best is chosen on other starts than it is judged on.
    best = int(np.argmax(judge(fitness, genes, args.seed + 1)))
    score = float(judge(fitness, genes[best : best + 1], args.seed)[0])
    run.save_champion(
        genes[best],
        final=True,
        score=score,
        origin="learnt by gradients",
        controller=config.controller.name,
        task=config.task.name,
    )
    run.close()
    say(f"Gradients, compiled in {compiling:.0f} s. Evolution:")
    few = make_fitness(config, **{"task.trials": TRIALS})
    other = float(judge(fitness, evolve(few, args.seconds, args.seed, say), args.seed)[0])
    unit = fitness.task.unit
    say(f"On {FRESH * EPISODES} fresh starts: gradients {score:.3f}, CMA-ES {other:.3f} {unit}")
    if args.results:
        numbers = {
            "gradients": score, "evolution": other, "seconds": args.seconds,
            "compile_s": compiling, "starts": FRESH * EPISODES,
        }  # fmt: skip
        write_results(f"gradient_learning_{args.seed}", numbers, [args.seed])
    say(f"written: {short_path(run.path)}")
    return 0


if __name__ == "__main__":
    raise SystemExit(run_command(main))
