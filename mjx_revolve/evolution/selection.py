"""Who has children and who stays: tournaments, (μ+λ) and its kin, NSGA-II.

Everything follows from one order, `order`: by score, or by dominance and crowding where there are
several objectives. Ties go to the older, and it does not matter in which order individuals are
given. Nothing here knows what an individual is.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mjx_revolve.episodes.bodies_config import SelectionConfig
from mjx_revolve.inputs.errors import InputError


class Candidates(NamedTuple):
    """Individuals to choose from.

    Attributes:
        objectives: `[N, M]` higher is better; a row with a value that is not finite has failed and
            is worse than all others.
        born: `[N]` generation of birth.
        ids: `[N]` unique, increasing with age: of two, the one with the lower id is the older.
        is_child: `[N]` whether it is one of this generation's children.
    """

    objectives: np.ndarray
    born: np.ndarray
    ids: np.ndarray
    is_child: np.ndarray


class Scheme(NamedTuple):
    """A way to choose.

    Attributes:
        parents: (rng, the living, settings, count) → `[count, 2]` indices of parents: two different
            individuals where there are two. There must be at least one.
        survivors: (parents and children together, settings, μ, generation) → indices of those who
            stay, best first.
    """

    parents: Callable[[np.random.Generator, Candidates, SelectionConfig, int], np.ndarray]
    survivors: Callable[[Candidates, SelectionConfig, int, int], np.ndarray]


# --- who is better --------------------------------------------------------------------------------


def order(objectives: np.ndarray, ids: np.ndarray) -> np.ndarray:
    """Sorts individuals.

    Args:
        objectives: `[N, M]`, see `Candidates`.
        ids: `[N]`.

    Returns:
        `[N]` indices, best first: by score where there is one objective; by front, and within a
        front by crowding (Deb et al. 2002, "crowded comparison"), where there are several. Ties
        go to the older.
    """
    # In order of age before anything else, so that ties within an objective are ties of age, too.
    by_age = np.argsort(ids)
    values = _valued(objectives)[by_age]
    if values.shape[1] == 1:
        return by_age[np.argsort(-values[:, 0], kind="stable")]
    fronts = sort_fronts(values)
    return by_age[np.lexsort((-crowding(values, fronts), fronts))]


def dominates(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Whether a is nowhere worse than b and somewhere better (Pareto).

    Args:
        a: `[..., M]` objectives, higher is better.
        b: `[..., M]`.

    Returns:
        `[...]` truth values. What has failed dominates nothing, all others dominate it.
    """
    a, b = _valued(a), _valued(b)
    return np.logical_and((a >= b).all(-1), (a > b).any(-1))


def sort_fronts(objectives: np.ndarray) -> np.ndarray:
    """Non-dominated sorting.

    After Deb, Pratap, Agarwal and Meyarivan, "A fast and elitist multiobjective genetic algorithm:
    NSGA-II", IEEE Trans. Evolutionary Computation 6(2), 2002.

    Args:
        objectives: `[N, M]` higher is better.

    Returns:
        `[N]` number of the front: 0 for those that nobody dominates, 1 for those that only these
        dominate, and so on. Those that failed are the last front.
    """
    better = dominates(objectives[:, None], objectives[None])
    above = better.sum(0)  # by how many, not yet in a front, each is dominated
    fronts = np.full(len(objectives), -1)
    front = 0
    while (fronts < 0).any():
        found = (fronts < 0) & (above == 0)
        fronts[found] = front
        above -= better[found].sum(0)
        front += 1
    return fronts


def crowding(objectives: np.ndarray, fronts: np.ndarray) -> np.ndarray:
    """How far the neighbours of each individual are within its front (Deb et al. 2002).

    Args:
        objectives: `[N, M]` higher is better.
        fronts: `[N]` number of its front.

    Returns:
        `[N]` sum over the objectives of the distance between the next lower and the next higher
        value, over the range within the front; infinite at the ends. Of equal values, those that
        are named first count as lower. An objective in which a front does not differ adds nothing.
    """
    values, found = _valued(objectives), np.zeros(len(objectives))
    for front in np.unique(fronts):
        rows = np.flatnonzero(fronts == front)
        for column in values[rows].T:
            up = np.argsort(column, kind="stable")
            span = column[up[-1]] - column[up[0]] if np.isfinite(column).all() else 0.0
            if span > 0.0:
                found[rows[up[[0, -1]]]] = np.inf
                found[rows[up[1:-1]]] += (column[up[2:]] - column[up[:-2]]) / span
    return found


def _valued(objectives: np.ndarray) -> np.ndarray:
    """Those that failed as worse than everything."""
    objectives = np.asarray(objectives, float)
    return np.where(np.isfinite(objectives).all(-1, keepdims=True), objectives, -np.inf)


# --- parents --------------------------------------------------------------------------------------


def _by_tournament(
    rng: np.random.Generator, living: Candidates, settings: SelectionConfig, count: int
) -> np.ndarray:
    """Twice the best of `tournament` different ones."""
    best_first = order(living.objectives, living.ids)
    rank = np.argsort(best_first)
    return best_first[_draw(rng, rank, settings.tournament, count)]


def _by_chance(
    rng: np.random.Generator, living: Candidates, settings: SelectionConfig, count: int
) -> np.ndarray:
    """All are alike."""
    return _draw(rng, np.arange(len(living.ids)), 1, count)


def _draw(rng: np.random.Generator, rank: np.ndarray, size: int, count: int) -> np.ndarray:
    """Ranks `[count, 2]` of the winners of tournaments; the first winner is not in the second."""
    lots = rng.random((2, count, len(rank)))
    first = _win(lots[0], rank, size)
    if len(rank) == 1:
        return np.stack([first, first], axis=1)
    lots[1][rank == first[:, None]] = 2.0  # behind all others
    return np.stack([first, _win(lots[1], rank, min(size, len(rank) - 1))], axis=1)


def _win(lots: np.ndarray, rank: np.ndarray, size: int) -> np.ndarray:
    """The lowest rank among the `size` lowest lots, in each row."""
    return rank[np.argsort(lots, axis=1)[:, :size]].min(1)


# --- survivors ------------------------------------------------------------------------------------


def _plus(
    candidates: Candidates, settings: SelectionConfig, mu: int, generation: int
) -> np.ndarray:
    """The best of parents and children."""
    return _best(candidates, _young(candidates, settings, generation), mu)


def _comma(
    candidates: Candidates, settings: SelectionConfig, mu: int, generation: int
) -> np.ndarray:
    """The best of the children."""
    rows = _young(candidates, settings, generation)
    return _best(candidates, rows[candidates.is_child[rows]], mu)


def _generational(
    candidates: Candidates, settings: SelectionConfig, mu: int, generation: int
) -> np.ndarray:
    """The best few of the parents, and of the children as many as there is room for."""
    rows = _young(candidates, settings, generation)
    child = candidates.is_child[rows]
    elites = _best(candidates, rows[~child], min(settings.elites, mu))
    children = _best(candidates, rows[child], mu - len(elites))
    return _best(candidates, np.concatenate([elites, children]), mu)


def _best_ever(
    candidates: Candidates, settings: SelectionConfig, mu: int, generation: int
) -> np.ndarray:
    """The best, of whatever age: where nobody inherits anything there is nothing to keep young."""
    return _best(candidates, np.arange(len(candidates.ids)), mu)


def _everybody(
    candidates: Candidates, settings: SelectionConfig, mu: int, generation: int
) -> np.ndarray:
    """All: who lives is the archive's business."""
    return _best(candidates, np.arange(len(candidates.ids)), len(candidates.ids))


def _young(candidates: Candidates, settings: SelectionConfig, generation: int) -> np.ndarray:
    """Indices of those who may stay; the youngest where all are too old."""
    born = np.asarray(candidates.born)
    if settings.max_age is None or not born.size:
        return np.arange(len(born))
    oldest = min(generation - settings.max_age + 1, int(born.max()))
    return np.flatnonzero(born >= oldest)


def _best(candidates: Candidates, rows: np.ndarray, count: int) -> np.ndarray:
    """The best `count` of some rows, best first."""
    return rows[order(candidates.objectives[rows], candidates.ids[rows])][:count]


# A child that takes the worst one's place if it is better, one child after the other, leaves the
# best of all: `steady` differs from `plus` in how many children are born at a time. And NSGA-II is
# `plus` in the order of several objectives.
SCHEMES: dict[str, Scheme] = {
    "plus": Scheme(_by_tournament, _plus),
    "comma": Scheme(_by_tournament, _comma),
    "generational": Scheme(_by_tournament, _generational),
    "steady": Scheme(_by_tournament, _plus),
    "nsga2": Scheme(_by_tournament, _plus),
    "map_elites": Scheme(_by_chance, _everybody),
    "random": Scheme(_by_chance, _best_ever),
}


def check_selection(settings: SelectionConfig, mu: int) -> None:
    """Whether a population of `mu` can be kept up.

    Args:
        settings: who stays.
        mu: size of the population, `evolution.population_size`.

    Raises:
        InputError: there are too few children, or no room for any.
    """
    size, children = f"evolution.population_size ({mu})", settings.offspring or mu
    elites = settings.elites if settings.type == "generational" else 0
    if elites >= mu:
        raise InputError(f"bodies.selection.elites: expected less than {size}; found {elites}")
    if settings.type in ("comma", "generational") and children < mu - elites:
        least = f"at least {size}" + f" - elites ({elites})" * (elites > 0)
        raise InputError(
            f"bodies.selection.offspring: expected {least}, as {settings.type} keeps no other "
            f"parents; found {children}"
        )
