"""Selection of parents and survivors: tournaments, (μ+λ), (μ,λ) and others, NSGA-II.

All schemes use one order, `best_first`: by score, or by dominance and crowding if there are several
objectives. Ties go to the older individual, for any order of the individuals. Functions take
objectives and ids only, so that any kind of individual can be selected.
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
        ids: `[N]` unique; of two individuals, the one with the lower id is the older.
        is_child: `[N]` whether it is one of this generation's children.
    """

    objectives: np.ndarray
    born: np.ndarray
    ids: np.ndarray
    is_child: np.ndarray


class SelectionScheme(NamedTuple):
    """A selection scheme.

    Attributes:
        parents: (rng, population, settings, count) → `[count, 2]` indices of parents: two different
            individuals where there are two. There must be at least one.
        survivors: (parents and children together, settings, μ, generation) → indices of those that
            stay, best first.
    """

    parents: Callable[[np.random.Generator, Candidates, SelectionConfig, int], np.ndarray]
    survivors: Callable[[Candidates, SelectionConfig, int, int], np.ndarray]


# --- order


def best_first(objectives: np.ndarray, ids: np.ndarray) -> np.ndarray:
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
    fronts = nondominated_sort(values)
    return by_age[np.lexsort((-crowding_distance(values, fronts), fronts))]


def dominates(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Whether a is nowhere worse than b and somewhere better (Pareto).

    Args:
        a: `[..., M]` objectives, higher is better.
        b: `[..., M]`.

    Returns:
        `[...]` truth values. A failed individual dominates none and is dominated by all others.
    """
    a, b = _valued(a), _valued(b)
    return np.logical_and((a >= b).all(-1), (a > b).any(-1))


def nondominated_sort(objectives: np.ndarray) -> np.ndarray:
    """Non-dominated sorting.

    After Deb, Pratap, Agarwal and Meyarivan, "A fast and elitist multiobjective genetic algorithm:
    NSGA-II", IEEE Trans. Evolutionary Computation 6(2), 2002.

    Args:
        objectives: `[N, M]` higher is better.

    Returns:
        `[N]` number of the front: 0 for those that none dominates, 1 for those that only these
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


def crowding_distance(objectives: np.ndarray, fronts: np.ndarray) -> np.ndarray:
    """Distances between the neighbours of each individual within its front (Deb et al. 2002).

    Args:
        objectives: `[N, M]` higher is better.
        fronts: `[N]` number of its front.

    Returns:
        `[N]` sum over the objectives of the distance between the next lower and the next higher
        value, over the range within the front; infinite at the ends. Of equal values, the first
        ones count as lower. An objective that is constant within a front adds nothing.
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
    """Objectives; -inf in all columns for individuals that failed."""
    objectives = np.asarray(objectives, float)
    return np.where(np.isfinite(objectives).all(-1, keepdims=True), objectives, -np.inf)


# --- parents


def _by_tournament(
    rng: np.random.Generator, population: Candidates, settings: SelectionConfig, count: int
) -> np.ndarray:
    """Each parent is the best of `tournament` different individuals."""
    ranking = best_first(population.objectives, population.ids)
    return ranking[_draw(rng, np.argsort(ranking), settings.tournament, count)]


def _uniformly(
    rng: np.random.Generator, population: Candidates, settings: SelectionConfig, count: int
) -> np.ndarray:
    """Any two, with equal probability."""
    return _draw(rng, np.arange(len(population.ids)), 1, count)


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


# --- survivors


def _plus(found: Candidates, settings: SelectionConfig, mu: int, generation: int) -> np.ndarray:
    """The best of parents and children."""
    return _best(found, _young(found, settings, generation), mu)


def _comma(found: Candidates, settings: SelectionConfig, mu: int, generation: int) -> np.ndarray:
    """The best of the children."""
    rows = _young(found, settings, generation)
    return _best(found, rows[found.is_child[rows]], mu)


def _generational(
    found: Candidates, settings: SelectionConfig, mu: int, generation: int
) -> np.ndarray:
    """The best `elites` of the parents, and the best children in the remaining places."""
    rows = _young(found, settings, generation)
    child = found.is_child[rows]
    elites = _best(found, rows[~child], min(settings.elites, mu))
    children = _best(found, rows[child], mu - len(elites))
    return _best(found, np.concatenate([elites, children]), mu)


def _best_ever(
    found: Candidates, settings: SelectionConfig, mu: int, generation: int
) -> np.ndarray:
    """The best of any age: in random search, which has no inheritance, age does not matter."""
    return _best(found, np.arange(len(found.ids)), mu)


def _all(found: Candidates, settings: SelectionConfig, mu: int, generation: int) -> np.ndarray:
    """All: the archive is the population."""
    return _best(found, np.arange(len(found.ids)), len(found.ids))


def _young(found: Candidates, settings: SelectionConfig, generation: int) -> np.ndarray:
    """Indices of those that may stay; the youngest where all are too old."""
    born = np.asarray(found.born)
    if settings.max_age is None or not born.size:
        return np.arange(len(born))
    return np.flatnonzero(born >= min(generation - settings.max_age + 1, int(born.max())))


def _best(found: Candidates, rows: np.ndarray, count: int) -> np.ndarray:
    """The best `count` of some rows, best first."""
    return rows[best_first(found.objectives[rows], found.ids[rows])][:count]


# A child that takes the worst one's place if it is better, one child after the other, leaves the
# best of all: `steady` differs from `plus` in how many children are born at a time. And NSGA-II is
# `plus` in the order of several objectives.
SCHEMES: dict[str, SelectionScheme] = {
    "plus": SelectionScheme(_by_tournament, _plus),
    "comma": SelectionScheme(_by_tournament, _comma),
    "generational": SelectionScheme(_by_tournament, _generational),
    "steady": SelectionScheme(_by_tournament, _plus),
    "nsga2": SelectionScheme(_by_tournament, _plus),
    "map_elites": SelectionScheme(_uniformly, _all),
    "random": SelectionScheme(_uniformly, _best_ever),
}
"""The schemes of selection by their names in configurations."""


def check_selection(settings: SelectionConfig, mu: int) -> None:
    """Checks that a population of `mu` individuals can be kept up.

    Raises:
        InputError: there are too few children, or no room for any.
    """
    size, children = f"evolution.population_size ({mu})", settings.offspring or mu
    elites = settings.elites if settings.type == "generational" else 0
    if elites >= mu:
        raise InputError("bodies.selection.elites", f"less than {size}", elites)
    if settings.type in ("comma", "generational") and children < mu - elites:
        least = f"at least {size}" + f" - elites ({elites})" * (elites > 0)
        enough = f"{least}, as {settings.type} keeps no other parents"
        raise InputError("bodies.selection.offspring", enough, children)
