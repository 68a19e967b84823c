"""One fitness function, three optimisers: evosax, SciPy and cma; and a step along its gradient.

``python -m experiments.optimisers [--evaluations N] [--no-gradient] [--out DIR]``

`make_fitness` gives a plain function of (population, key). Here the spider learns to swim in the
lake with three libraries that know nothing of robots. Budgets are equal and small: this shows how
to call the function, not which optimiser is best.
"""

from __future__ import annotations

import csv
import importlib.util
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common import ROOT, make_folder, make_parser, write_results
from mjx_revolve.body.table import align
from mjx_revolve.inputs.commands import run_command, whole
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import short_path

SEED = 0
# Genes are angles that the controllers fold by a sine; beyond this, values repeat.
BOUND = np.pi / 2
STD_INIT = 0.5
# Of SciPy's differential evolution: individuals per gene. All three use the population that
# follows, because another number of rows is another compiled program.
PER_GENE = 4
FRESH = 8  # starts that no optimiser saw, to compare the three on

CONFIG: dict[str, Any] = {
    "morphology": str(ROOT / "morphologies" / "spider.yaml"),
    "trim": "neutral",
    "world": "lake",
    "task": {"type": "directed_swim", "duration": 5.0, "settle": 1.0, "trials": 1},
}

# Takes `[P, G]` genes, gives `[P]` scores, higher is better.
Score = Callable[[np.ndarray], np.ndarray]


@dataclass
class Counter:
    """A fitness for one fixed key that keeps the best and counts.

    Attributes:
        score: `[P, G]` to `[P]`, higher is better.
        best: `[G]` the best genes so far.
        best_score: theirs.
        evaluations: individuals scored.
    """

    score: Score
    best: np.ndarray
    best_score: float = -np.inf
    evaluations: int = 0

    def __call__(self, population: np.ndarray) -> np.ndarray:
        """Scores a population."""
        scores = self.score(population)
        k = int(np.argmax(scores))
        if scores[k] > self.best_score:
            self.best, self.best_score = population[k].copy(), float(scores[k])
        self.evaluations += len(population)
        return scores


def use_evosax(score: Score, num_genes: int, size: int, generations: int) -> None:
    """CMA-ES of evosax, which minimises."""
    import jax
    import jax.numpy as jnp
    from evosax.algorithms import CMA_ES

    strategy = CMA_ES(population_size=size, solution=jnp.zeros(num_genes))
    params = strategy.default_params.replace(std_init=STD_INIT)
    key, first = jax.random.split(jax.random.key(SEED))
    state = strategy.init(first, jnp.zeros(num_genes), params)
    for _ in range(generations):
        key, ask, tell = jax.random.split(key, 3)
        population, state = strategy.ask(ask, state, params)
        losses = -score(np.asarray(population))
        state, _ = strategy.tell(tell, population, jnp.asarray(losses), state, params)


def use_scipy(score: Score, num_genes: int, size: int, generations: int) -> None:
    """Differential evolution of SciPy, which minimises, and calls with `[G, P]`."""
    from scipy.optimize import differential_evolution

    differential_evolution(
        lambda genes: -score(genes.T),
        [(-BOUND, BOUND)] * num_genes,
        popsize=size // num_genes,
        maxiter=generations - 1,  # its first population counts as none
        vectorized=True,
        updating="deferred",
        polish=False,
        tol=0.0,
        rng=SEED,
    )


def use_cma(score: Score, num_genes: int, size: int, generations: int) -> None:
    """CMA-ES of cma, which minimises."""
    with warnings.catch_warnings():  # on import it misses an optional package, loudly
        warnings.simplefilter("ignore")
        import cma
    options = {"popsize": size, "seed": SEED + 1, "verbose": -9}  # to cma, seed 0 is the clock
    strategy = cma.CMAEvolutionStrategy(np.zeros(num_genes), STD_INIT, options)
    for _ in range(generations):
        population = strategy.ask()
        strategy.tell(population, list(-score(np.array(population))))


OPTIMISERS: dict[str, Callable[[Score, int, int, int], None]] = {
    "evosax, CMA_ES": use_evosax,
    "scipy, differential_evolution": use_scipy,
    "cma, CMAEvolutionStrategy": use_cma,
}


@dataclass(frozen=True)
class Outcome:
    """What an optimiser reached.

    Attributes:
        name: of the optimiser.
        genes: `[G]` its best.
        score: their score on the start that was optimised for.
        fresh: their mean score over starts that no optimiser saw.
        evaluations: individuals scored.
        seconds: time in the optimiser and the fitness [s].
    """

    name: str
    genes: np.ndarray
    score: float
    fresh: float
    evaluations: int
    seconds: float


def optimise(
    evaluations: int, tell: Callable[[str], None] = lambda _: None
) -> tuple[list[Outcome], float]:
    """Runs the three optimisers on one fitness function.

    Args:
        evaluations: budget of each, at least; rounded up to whole generations.
        tell: told what goes on, a line at a time.

    Returns:
        What each reached, and the score of a robot that keeps still.
    """
    import jax
    import jax.numpy as jnp

    from mjx_revolve import make_fitness

    fitness = make_fitness(CONFIG)
    size = PER_GENE * fitness.num_genes
    key = jax.random.key(SEED)

    def score(population: np.ndarray, key: jax.Array = key) -> np.ndarray:
        return np.asarray(fitness(jnp.asarray(population, jnp.float32), key), np.float64)

    tell("compiling the fitness, some ten seconds where it is not in the cache yet")
    still = score(np.zeros((size, fitness.num_genes)))
    outcomes = []
    for name, use in OPTIMISERS.items():
        counter = Counter(score, np.zeros(fitness.num_genes))
        tell(f"{name}: {size} individuals x {-(-evaluations // size)} generations")
        began = time.perf_counter()
        use(counter, fitness.num_genes, size, -(-evaluations // size))
        seconds = time.perf_counter() - began
        outcomes.append(
            Outcome(name, counter.best, counter.best_score, 0.0, counter.evaluations, seconds)
        )
    rows = np.zeros((size, fitness.num_genes))
    rows[: len(outcomes)] = [outcome.genes for outcome in outcomes]
    keys = [jax.random.fold_in(key, k + 1) for k in range(FRESH)]
    fresh = np.mean([score(rows, k) for k in keys], axis=0)
    return [
        Outcome(o.name, o.genes, o.score, float(f), o.evaluations, o.seconds)
        for o, f in zip(outcomes, fresh, strict=False)
    ], float(still[0])


@dataclass(frozen=True)
class Climb:
    """One step of gradient ascent.

    Attributes:
        before: the score at its start.
        after: at its end; the same where no step was better.
        slope: length of the gradient, score per unit of the genes.
        step: its length in genes; 0 where no step was better.
        seconds: time to compile [s].
    """

    before: float
    after: float
    slope: float
    step: float
    seconds: float


# The longest step, in genes, and how often it is halved: below 1e-4 the score's rounding shows.
LONGEST, HALVINGS = 0.1, 10


def climb(genes: np.ndarray, duration: float = 1.0) -> Climb:
    """One step of gradient ascent through a short rollout, as long as it pays.

    The gradient tells where the score rises, not how far: along it, the longest of some steps that
    raises the score is taken (a backtracking line search).

    Args:
        genes: `[G]` where to start.
        duration: of the episode [s].

    Returns:
        What it came to.
    """
    import jax
    import jax.numpy as jnp

    from mjx_revolve import make_fitness

    task = CONFIG["task"] | {"duration": duration, "settle": 0.2 * duration}
    fitness = make_fitness(CONFIG | {"task": task})
    key = jax.random.key(SEED)

    def value_and_slope(genes: Any) -> Any:
        return jax.value_and_grad(lambda x: fitness(x[None], key)[0])(genes)

    # A derivative is all calls of small functions: inlined into one another, they take XLA seven
    # times as long, and what is run a dozen times need not be fast.
    slope = jax.jit(value_and_slope, compiler_options={"xla_disable_hlo_passes": "call-inliner"})
    began = time.perf_counter()
    start = jnp.asarray(genes, jnp.float32)
    value, gradient = jax.block_until_ready(slope(start))
    seconds = time.perf_counter() - began
    before, length = float(value), float(jnp.linalg.norm(gradient))
    step, after = line_search(
        lambda step: float(slope(start + step * gradient / max(length, 1e-12))[0]), before
    )
    return Climb(before, after, length, step, seconds)


def line_search(score: Callable[[float], float], before: float) -> tuple[float, float]:
    """The longest step that raises the score, and the score there; 0 and `before` where none does.

    Args:
        score: step in genes → score.
        before: the score without a step.
    """
    for step in LONGEST * 0.5 ** np.arange(HALVINGS + 1):
        after = score(float(step))
        if after > before:
            return float(step), after
    return 0.0, before


def write_csv(path: Path, outcomes: list[Outcome]) -> None:
    """Writes what each optimiser reached, genes last."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        names = [f"gene_{k}" for k in range(len(outcomes[0].genes))]
        writer.writerow(["optimiser", "score", "fresh_score", "evaluations", "seconds", *names])
        for o in outcomes:
            genes = [f"{x:.8g}" for x in o.genes]
            writer.writerow([o.name, o.score, o.fresh, o.evaluations, f"{o.seconds:.3f}", *genes])


def main(argv: list[str] | None = None) -> int:
    """Runs the experiment, prints the table and writes `optimisers.csv`."""
    parser = make_parser("optimisers", "One fitness function, three optimisers.")
    parser.add_argument(
        "--evaluations", type=whole(1), default=2000, metavar="N",
        help="budget of each optimiser (default: 2000)",
    )  # fmt: skip
    parser.add_argument(
        "--no-gradient", action="store_true",
        help="leave out the step of gradient ascent, which takes most of a minute to compile",
    )  # fmt: skip
    options = parser.parse_args(argv)
    if importlib.util.find_spec("cma") is None:
        raise InputError("expected the package cma; found none (pip install 'mjx-revolve[cma]')")
    folder = make_folder(options.out, "optimisers")

    from mjx_revolve.numerics.runtime import prepare_process

    prepare_process()

    def tell(line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    outcomes, still = optimise(options.evaluations, tell)
    rows = [
        ("optimiser", "best", "on fresh starts", "evaluations", "speed"),
        ("", "body lengths/s", "body lengths/s", "", "evaluations/s"),
    ]
    for o in outcomes:
        rate = o.evaluations / o.seconds
        rows.append((o.name, f"{o.score:.3f}", f"{o.fresh:.3f}", f"{o.evaluations}", f"{rate:.0f}"))
    task = CONFIG["task"]
    print(f"Spider, neutral, lake: {task['type']}, {task['duration']:g} s\n")
    print("\n".join(align(rows)))
    print(
        f"\nKeeping still scores {abs(still):.3f}. Fresh starts: the mean over {FRESH}. Speeds "
        "include compiling the optimiser's own functions, not the fitness."
    )
    numbers: dict[str, Any] = {
        "still": still,
        "optimisers": [
            {"name": o.name, "score": o.score, "fresh": o.fresh, "evaluations": o.evaluations}
            for o in outcomes
        ],
    }
    if not options.no_gradient:
        best = max(outcomes, key=lambda o: o.score)
        tell("compiling the gradient, most of a minute where it is not in the cache yet")
        up = climb(best.genes)
        numbers["climb"] = asdict(up)
        found = f"no step along it raises the score of {up.before:.4f}"
        if up.step:
            scores = f"from {up.before:.4f} to {up.after:.4f}"
            found = f"a step of {up.step:.2g} along it takes the score {scores}"
        print(
            f"Gradient through 1 s from the best genes: {up.slope:.3f} body lengths/s per unit "
            f"gene; {found} (compiled in {up.seconds:.0f} s)."
        )
    write_csv(folder / "optimisers.csv", outcomes)
    if options.results:
        write_results("optimisers", numbers, [SEED])
    print(f"written: {short_path(folder / 'optimisers.csv')}")
    return 0


if __name__ == "__main__":
    raise SystemExit(run_command(main))
