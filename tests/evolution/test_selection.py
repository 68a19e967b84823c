"""Parents and survivors, worked by hand on small populations."""

import numpy as np
import pytest

from mjx_revolve.episodes.bodies_config import SelectionConfig
from mjx_revolve.evolution.novelty import axis_scale, novelty
from mjx_revolve.evolution.selection import (
    SCHEMES,
    Candidates,
    best_first,
    crowding_distance,
    dominates,
    nondominated_sort,
)

NAN, INF = np.nan, np.inf


def candidates(scores, born=None, children=0, ids=None):
    """Individuals by age, the last few of them children of generation 1."""
    scores = np.array(scores, float)
    count = len(scores)
    is_child = np.arange(count) >= count - children
    return Candidates(
        objectives=scores.reshape(count, -1),
        born=np.where(is_child, 1, 0) if born is None else np.array(born),
        ids=np.arange(count) if ids is None else np.array(ids),
        is_child=is_child,
    )


def survivors(scheme, found, mu, generation=1, **settings):
    config = SelectionConfig(type=scheme, **settings)
    return SCHEMES[scheme].survivors(found, config, mu, generation).tolist()


def parents(scheme, found, count, seed=0, **settings):
    config = SelectionConfig(type=scheme, **settings)
    return SCHEMES[scheme].parents(np.random.default_rng(seed), found, config, count)


# Speed and thrift. A, B and C trade one for the other; D is worse than B in both, E equals B in
# thrift and is slower, F is worse than D, and G has failed.
A, B, C, D, E, F, G = (0, 9), (4, 5), (8, 0), (3, 4), (2, 5), (3, 3), (7, NAN)
FIELD = np.array([A, B, C, D, E, F, G], float)


def test_dominance():
    a, b = np.array([1.0, 2.0]), np.array([1.0, 1.0])
    assert dominates(a, b) and not dominates(b, a)
    assert not dominates(a, a)
    assert not dominates(FIELD[0], FIELD[1]) and not dominates(FIELD[1], FIELD[0])
    # Failed: below everything, even where one value is the best of all.
    assert dominates(FIELD[5], FIELD[6]) and not dominates(FIELD[6], FIELD[5])
    assert not dominates(FIELD[6], FIELD[6])


def test_each_front_is_what_none_of_the_rest_dominates():
    values = np.random.default_rng(0).integers(0, 6, (60, 3)).astype(float)
    fronts, left = nondominated_sort(values), set(range(60))
    for front in range(fronts.max() + 1):
        best = {i for i in left if not any(dominates(values[j], values[i]) for j in left)}
        assert best == set(np.flatnonzero(fronts == front).tolist())
        left -= best
    assert not left and fronts.max() > 2


def test_crowding():
    # Front 0 by speed: 0, 4, 8; by thrift: 0, 5, 9. B: 8/8 + 9/9. Ends are infinite.
    found = crowding_distance(FIELD, nondominated_sort(FIELD))
    assert found.tolist() == [INF, 2.0, INF, INF, INF, 0.0, 0.0]
    # Four on a line, two of them close: (3 - 0)/10 twice and (10 - 1)/10 twice.
    line = np.array([[0, 10], [1, 9], [3, 7], [10, 0]], float)
    assert crowding_distance(line, np.zeros(4, int)) == pytest.approx([INF, 0.6, 1.8, INF])
    # An objective in which all are equal says nothing.
    flat = np.stack([line[:, 0], np.ones(4)], axis=1)
    assert crowding_distance(flat, np.zeros(4, int)) == pytest.approx([INF, 0.3, 0.9, INF])


def test_order_of_several_objectives():
    # Front 0: the ends by age, then B; front 1: D and E, both ends; F; G, which failed.
    assert best_first(FIELD, np.arange(7)).tolist() == [0, 2, 1, 3, 4, 5, 6]
    assert best_first(FIELD, np.arange(7)[::-1]).tolist() == [2, 0, 1, 4, 3, 5, 6]


@pytest.mark.parametrize("objectives", [1, 2, 3])
def test_order_does_not_depend_on_where_individuals_stand(objectives):
    rng = np.random.default_rng(1)
    values = rng.integers(0, 4, (40, objectives)).astype(float)  # many ties
    values[rng.random(40) < 0.1] = NAN
    ids = rng.permutation(100)[:40]
    expected = ids[best_first(values, ids)]
    for _ in range(5):
        shuffled = rng.permutation(40)
        assert (ids[shuffled][best_first(values[shuffled], ids[shuffled])] == expected).all()


@pytest.mark.parametrize(("scheme", "scores", "children", "mu", "kept", "settings"), [
    ("plus", [5, 1, 3, 4, 0, 9], 3, 3, [5, 0, 3], {}),
    # A child that is as good as a parent stays behind it.
    ("plus", [5, 3, 3, 5], 2, 2, [0, 3], {}), ("plus", [5, 3, 4, 3], 2, 3, [0, 2, 1], {}),
    ("comma", [5, 9, 3, 4, 0, 1], 4, 2, [3, 2], {}),
    ("comma", [5, 9, 3, 4, 0, 1], 4, 6, [3, 2, 5, 4], {}),
    ("generational", [5, 9, 8, 4, 0, 1], 3, 3, [1, 3, 5], {"elites": 1}),
    ("generational", [5, 9, 8, 4, 0, 1], 3, 3, [1, 2, 3], {"elites": 2}),
    ("generational", [5, 9, 8, 4, 0, 1], 3, 3, [3, 5, 4], {"elites": 0}),
    # An elite stays even if all children are better, and stands where it belongs.
    ("generational", [1, 2, 7, 8], 2, 2, [3, 1], {"elites": 1}),
    # 2 takes the place of 1, 4 that of 2, and 3 is not better than 3.
    ("steady", [5, 1, 3, 2, 4, 3], 3, 3, [0, 4, 2], {}),
    ("nsga2", FIELD, 3, 3, [0, 2, 1], {}), ("nsga2", FIELD, 3, 4, [0, 2, 1, 3], {}),
    # A front of five for four places: (1, 9) has the nearest neighbours.
    ("nsga2", [[0, 10], [1, 9], [2, 8], [6, 4], [10, 0]], 0, 4, [0, 4, 3, 2], {}),
])  # fmt: skip
def test_survivors_by_hand(scheme, scores, children, mu, kept, settings):
    assert survivors(scheme, candidates(scores, children=children), mu, **settings) == kept


def test_steady_is_a_child_after_the_other_in_the_place_of_the_worst():
    rng = np.random.default_rng(2)
    for _ in range(50):
        scores, mu = rng.integers(0, 6, 12).astype(float), int(rng.integers(1, 6))
        scores[rng.random(12) < 0.2] = NAN
        values = np.where(np.isnan(scores), -INF, scores)
        found = candidates(scores, children=12 - mu)
        kept = list(range(mu))
        for child in range(mu, 12):
            worst = min(kept, key=lambda i: (values[i], -i))
            if values[child] > values[worst]:
                kept[kept.index(worst)] = child
        assert survivors("steady", found, mu) == sorted(kept, key=lambda i: (-values[i], i))


def test_random_keeps_the_best_and_map_elites_all():
    found = candidates([5, 1, NAN, 7], born=[0, 0, 1, 1], children=2)
    assert survivors("random", found, 2, generation=9, max_age=1) == [3, 0]
    assert survivors("map_elites", found, 2, generation=9, max_age=1) == [3, 0, 1, 2]


@pytest.mark.parametrize("scheme", SCHEMES)
def test_the_failed_are_last_and_stay_only_where_there_is_room(scheme):
    found = candidates([NAN, NAN, 1, NAN, 2, NAN], children=4)
    kept = survivors(scheme, found, 2)
    assert kept[0] == 4
    if scheme not in ("generational", "map_elites"):
        assert kept == [4, 2]
    assert survivors("plus", found, 4) == [4, 2, 0, 1]


def test_the_old_go_however_good_they_are():
    found = candidates([9, 8, 7, 1], born=[0, 2, 3, 4], children=1)
    assert survivors("plus", found, 3, generation=4) == [0, 1, 2]
    assert survivors("plus", found, 3, generation=4, max_age=4) == [1, 2, 3]
    assert survivors("plus", found, 3, generation=4, max_age=2) == [2, 3]
    assert survivors("steady", found, 1, generation=4, max_age=2) == [2]
    assert survivors("generational", found, 2, generation=4, max_age=2, elites=1) == [2, 3]
    # All are too old: the youngest stay.
    assert survivors("plus", found, 3, generation=50, max_age=2) == [3]
    youngest = candidates([9, 8, 7], born=[0, 2, 2])
    assert survivors("plus", youngest, 3, generation=50, max_age=2) == [1, 2]


@pytest.mark.parametrize("scheme", SCHEMES)
def test_parents_are_two_and_drawn_by_the_generator_alone(scheme):
    found = candidates([5, 1, NAN, 7, 2])
    pairs = parents(scheme, found, 500)
    assert pairs.shape == (500, 2) and (pairs[:, 0] != pairs[:, 1]).all()
    assert set(pairs.ravel()) <= set(range(5))
    assert (pairs == parents(scheme, found, 500)).all()
    assert (pairs != parents(scheme, found, 500, seed=1)).any()
    assert parents(scheme, candidates([3.0]), 2).tolist() == [[0, 0], [0, 0]]
    assert {*map(tuple, parents(scheme, candidates([3, 4]), 50).tolist())} <= {(0, 1), (1, 0)}


def test_tournaments_win_as_often_as_they_must():
    # Of four, tournaments of two: the best is drawn in 3 of 6 pairs, the next wins 2, the next 1.
    pairs = parents("plus", candidates([1, 9, NAN, 5]), 20_000, tournament=2)
    share = np.bincount(pairs[:, 0], minlength=4) / 20_000
    assert share == pytest.approx([1 / 6, 3 / 6, 0, 2 / 6], abs=0.015)
    # The second is of the other three: without the best, 2/3 and 1/3 for the two that are left.
    others = pairs[pairs[:, 0] == 1, 1]
    share = np.bincount(others, minlength=4) / len(others)
    assert share == pytest.approx([1 / 3, 0, 0, 2 / 3], abs=0.02)
    # As many as there are: always the best two.
    assert (parents("plus", candidates([1, 9, NAN, 5]), 50, tournament=9) == [1, 3]).all()
    # Crowded: B stands between A and C, so that it never wins over them.
    pairs = parents("nsga2", candidates([A, B, C]), 2000, tournament=2)
    assert np.bincount(pairs[:, 0], minlength=3)[1] == 0


def test_novelty_is_the_mean_distance_to_the_nearest():
    points = np.array([[0, 0], [3, 4], [0, 1]], float)
    others = np.array([[0, -2], [30, 40]], float)
    # From the first: 1, 2, 5, 50. From the second: √(9 + 9), 5, √(9 + 36), 45.
    found = novelty(points, others, 2, np.ones(2))
    assert found[:2] == pytest.approx([1.5, (18**0.5 + 5) / 2])
    assert novelty(points, others, 99, np.ones(2))[0] == pytest.approx((1 + 2 + 5 + 50) / 4)
    # Along y the unit is 2.
    assert novelty(points, others, 1, np.array([1, 2]))[0] == pytest.approx(0.5)
    assert novelty(points[:1], others[:0], 3, np.ones(2)).tolist() == [0.0]
    # An equal point is a neighbour; the point itself is none.
    assert novelty(points[[0, 0]], others[:0], 1, np.ones(2)).tolist() == [0.0, 0.0]


def test_axis_scale():
    points = np.array([[1, 0.1, 5], [3, 0.1, 5], [NAN, 0, 0]])
    assert axis_scale(points).tolist() == [1.0, 1.0, 1.0]
    assert axis_scale(np.array([[0.0], [6.0]])).tolist() == [3.0]
    assert axis_scale(points[2:]).tolist() == [1.0, 1.0, 1.0]
