"""The common part of all searches: a generation (ask, evaluate, tell), its row, the champion.

A search over genes, a search over bodies, and a colony implement `Evolution`. The clock, the order
of the steps and the columns of `metrics.csv` are here.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import Field, dataclass, field, replace
from typing import Any, ClassVar, Generic, NamedTuple, Protocol, TypeVar

import jax
import numpy as np

from mjx_revolve.body.tree import Morphology
from mjx_revolve.episodes.passport import Passport
from mjx_revolve.episodes.scoring import REPORT_EPISODES, REPORT_STREAM, replay_key
from mjx_revolve.evolution.blocks import Scored
from mjx_revolve.evolution.strategies import FAILED_SCORE
from mjx_revolve.inputs.errors import InputError

# Fresh episodes per candidate to choose the champion. The reported score comes from others
# (`REPORT_EPISODES`), because the best of several means is biased upwards, too.
CHOOSE_EPISODES = 8
# Number of best candidates for which a passport is made if required. A choice: half a minute each.
_TRIED = 8
# A stream of random numbers that no generation uses.
CHOOSE_STREAM = 2**32 - 1
# Columns of a generation's row that describe its finite scores.
_STATISTICS: dict[str, Callable[[np.ndarray], float]] = {
    "best": np.max,
    "mean": np.mean,
    "std": np.std,
    "median": np.median,
    "lower_quartile": lambda scores: np.quantile(scores, 0.25),
    "upper_quartile": lambda scores: np.quantile(scores, 0.75),
}


@dataclass(frozen=True)
class Champion:
    """The best individual of a run.

    Attributes:
        genes: `[G]`; those of the body's own controller.
        score: mean over `REPORT_EPISODES` fresh keys; `FAILED_SCORE` stands for a failed rollout.
            Before the final evaluation: the score in its own generation.
        origin: of its genes, in words.
        std: standard deviation over those keys; NaN before.
        measures: mean of each measure over those keys from which no rollout failed.
        key: the first of those keys, to replay; None before.
        body: its body, where bodies have evolved.
        individual: its number, where bodies have evolved.
        passport: results of its tests; None: it was not tested.
        failed: number of those keys from which a rollout failed.
    """

    genes: np.ndarray
    score: float
    origin: str
    std: float = float("nan")
    measures: Mapping[str, float] = field(default_factory=dict)
    key: jax.Array | None = None
    body: Morphology | None = None
    individual: int | None = None
    passport: Passport | None = None
    failed: int = 0


class SearchState(Protocol):
    """State of any search: a frozen dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    @property
    def generation(self) -> int:
        """Number of finished generations."""

    @property
    def seconds(self) -> float:
        """Time spent in generations [s]."""


S = TypeVar("S", bound=SearchState)


class Generation(NamedTuple, Generic[S]):
    """A generation's result.

    Attributes:
        search: the search after it.
        scores: `[P]` scores, for statistics in its row; not finite: failed.
        champion: the best score so far.
        columns: further columns of its row, in their order.
        evaluated: individuals that it has scored.
        evaluations: individuals that the search has scored so far.
        simulated: simulated time [s], for the column `times_real_time`; 0: no such column.
    """

    search: S
    scores: np.ndarray
    champion: float
    columns: Mapping[str, float]
    evaluated: int
    evaluations: int
    simulated: float = 0.0


P = TypeVar("P")  # what is evaluated
R = TypeVar("R")  # its results


class Evolution(Protocol[S, P, R]):
    """A kind of search. Its state is a frozen dataclass with `generation` and `seconds`.

    A search depends on that value alone, so one that is read back from disk continues with the same
    bits.
    """

    def start(self) -> S:
        """The search before its first generation."""

    def ask(self, search: S) -> P:
        """The individuals of the next generation, to be evaluated."""

    def evaluate(self, proposal: P) -> R:
        """The results of what `ask` returned."""

    def tell(self, proposal: P, results: R) -> Generation[S]:
        """The search after the generation, given its results."""

    def to_arrays(self, search: S) -> dict[str, np.ndarray]:
        """The search as named arrays, for a checkpoint."""

    def from_arrays(self, arrays: Mapping[str, np.ndarray]) -> S:
        """The inverse of `to_arrays`; raises `InputError` for arrays of another search."""

    def logs(self, search: S) -> Mapping[str, Sequence[str]]:
        """Lines that the last generation adds to the run folder's logs, by the file's name."""
        return {}

    def files(self, search: S) -> Mapping[str, bytes]:
        """Files of the run folder that are written anew with each checkpoint, by name."""
        return {}

    def best(self, search: S) -> Champion | None:
        """The champion so far, not yet evaluated on fresh starts; None: every rollout failed."""

    def choose_champion(self, search: S) -> Champion:
        """The champion of a finished search, evaluated on fresh starts."""


def run_generations(
    evolution: Evolution[S, P, R], generations: int, search: S | None = None
) -> Iterator[tuple[S, dict[str, float]]]:
    """Runs a search, one generation at a time.

    Args:
        evolution: the kind of search.
        generations: how many there are in all.
        search: where to continue; None starts a new search.

    Yields:
        The search after each generation, and the generation's row: generation, evaluations, the
        statistics of `score_statistics`, champion (the best score so far), the search's own
        columns, seconds (so far) and evaluations_per_second.
    """
    search = evolution.start() if search is None else search
    while search.generation < generations:
        began = time.perf_counter()
        proposal = evolution.ask(search)
        found = evolution.tell(proposal, evolution.evaluate(proposal))
        seconds = time.perf_counter() - began
        search = replace(found.search, seconds=search.seconds + seconds)
        row = {
            "generation": search.generation,
            "evaluations": found.evaluations,
            **score_statistics(found.scores),
            "champion": found.champion,
            **found.columns,
            "seconds": search.seconds,
        }
        if found.simulated:
            row["times_real_time"] = found.simulated / seconds
        yield search, row | {"evaluations_per_second": found.evaluated / seconds}


def score_statistics(scores: np.ndarray) -> dict[str, float]:
    """Best, mean, std, median and quartiles of the finite scores among `[P]`; NaN without any."""
    finite = scores[np.isfinite(scores)].astype(np.float64)
    return {n: float(of(finite)) if finite.size else np.nan for n, of in _STATISTICS.items()}


def choose_candidate(
    score: Callable[[Sequence[int], jax.Array], Scored],
    eligible: np.ndarray,
    seed: int,
    judge: Callable[[int], Passport] | None = None,
    screen: Callable[[Sequence[int]], Sequence[int]] | None = None,
) -> tuple[int, dict[str, Any]]:
    """Chooses among candidates on fresh starts, and evaluates the winner on others.

    The candidate with the best mean over `CHOOSE_EPISODES` fresh keys wins, of equal ones the
    first; its score is then measured on `REPORT_EPISODES` others.

    Args:
        score: (indices of candidates, key) → their scores, not finite where a rollout failed, and
            measures.
        eligible: `[N]` whether a candidate may win.
        seed: of the run.
        judge: makes a candidate's passport, where that is required: then the best of the best few
            that passes wins, or the best of all where none does, or where none can be made.
        screen: how likely candidates pass, of many at once: once the best of all has failed, those
            with 0 are not judged, and those with more come first.

    Returns:
        The winner's index, and `score`, `std`, `failed`, `measures`, `key` and `passport` of its
        `Champion`.

    Raises:
        InputError: no candidate has a finite score from any start.
    """
    root = jax.random.key(seed)

    def fresh(indices: Sequence[int], stream: int, episodes: int) -> Scored:
        """`[episodes, indices]` scores, `FAILED_SCORE` for a failed rollout, and measures."""
        keys = (jax.random.fold_in(jax.random.fold_in(root, stream), i) for i in range(episodes))
        results = [score(indices, key) for key in keys]
        scores = np.stack([np.where(np.isfinite(s), s, FAILED_SCORE) for s, _ in results])
        measures = {name: np.stack([m[name] for _, m in results]) for name in results[0][1]}
        return scores.astype(np.float64), measures

    means = fresh(range(len(eligible)), CHOOSE_STREAM, CHOOSE_EPISODES)[0].mean(axis=0)
    order = np.argsort(-np.where(eligible, means, -np.inf), kind="stable")
    if not np.any(means[eligible] > FAILED_SCORE):
        why = "none: all failed (not finite, or too fast: are units and timestep right?)"
        raise InputError("champion", "a score of any candidate", why)
    winner, passport = int(order[0]), None
    if judge is not None:
        # A user's own task may not suit a passport's times: the run goes on without, and says why.
        with contextlib.suppress(InputError):
            passport = judge(winner)
        if passport is not None and passport.failed:
            left = [int(k) for k in order[1:] if eligible[k] and means[k] > FAILED_SCORE]
            if left and screen is not None:
                chances = dict(zip(left, screen(left), strict=True))
                left = sorted((k for k in left if chances[k]), key=lambda k: -chances[k])
            for k in left[: _TRIED - 1]:
                found = judge(k)
                if not found.failed:
                    winner, passport = k, found
                    break
    scores, measures = fresh([winner], REPORT_STREAM, REPORT_EPISODES)
    sound = scores > FAILED_SCORE
    if sound.any() and not sound.all():  # what has blown up has no measures
        measures = {name: values[sound] for name, values in measures.items()}
    return winner, {
        "score": float(scores.mean()),
        "std": float(scores.std()),
        "failed": int((scores <= FAILED_SCORE).sum()),
        "measures": {name: float(values.mean()) for name, values in measures.items()},
        "key": replay_key(seed),
        "passport": passport,
    }
