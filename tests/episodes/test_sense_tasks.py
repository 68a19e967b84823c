"""Tasks that need senses: scores of known tracks, and the same pursuer wherever it swims."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from laboratory import make_track as track
from mjx_revolve import make_fitness
from mjx_revolve.episodes.config import TaskConfig
from mjx_revolve.episodes.tasks import TASKS


def along_x(*x, z=0.0):
    return [[value, 0.0, z] for value in x]


def judge(name, given, **settings):
    needed = {
        "search": {"target_distance": 1.0, "sight": 1.0, "touch": 0.5},
        "escape": {"target_distance": 1.0, "target_speed": 1.0, "target_turn": 1.0, "touch": 0.5},
        "follow_course": {"course_spread": 1.0},
    }
    task = TaskConfig(type=name, **(needed[name] | settings))
    return float(TASKS[name].score(given, task)[0])


@pytest.mark.parametrize(("x", "score"), [
    # The target is at 4.5 m, and touches within 0.5 m: 4 m of way.
    ((0, 0, 0, 0), 0.0),
    ((0, 2, 2, 2), 3 / 8),  # none, then half of it three times
    ((0, 2, 0, 0), 3 / 8),  # once it was half way
    ((0, -2, -4, -2), 0.0),
    ((0, 4, 0, 0), 3 / 4),  # touched, and away again
    ((0, 4.3, 4.6, 9), 3 / 4),
])  # fmt: skip
def test_search_counts_the_nearest_and_how_soon(x, score):
    given = track(along_x(*x), target=along_x(*[4.5] * 4))
    assert judge("search", given) == pytest.approx(score, abs=1e-6)


def test_who_starts_where_it_touches_has_found():
    assert judge("search", track(along_x(0, 5), target=along_x(0.3, 0.3))) == 1.0


@pytest.mark.parametrize(("robot", "pursuer", "score"), [
    ((0, 0, 0, 0), (-4.5, -4.5, -4.5, -4.5), 1.0),
    ((0, 1, 2, 3), (-4.5, -3.5, -2.5, -1.5), 1.0),  # as fast
    ((0, 0, 0, 0), (-4.5, -2.5, -2.5, -2.5), (1 + 3 * 0.5) / 4),  # 4 m, then 2 m
    ((0, 0, 0, 9), (-4.5, -2.5, -0.4, -0.4), (1 + 0.5) / 4),  # caught, and no way back
])  # fmt: skip
def test_escape_counts_the_nearest_and_how_late(robot, pursuer, score):
    given = track(along_x(*robot), target=along_x(*pursuer))
    assert judge("escape", given) == pytest.approx(score, abs=1e-6)


def test_a_course_is_followed_from_row_to_row():
    """1 m along x, 2 m along y; the course is x in the first two rows, then y."""
    way, course = [[0, 0, 0], [1, 0, 0], [1, 2, 0], [1, 4, 0]], [[1, 0, 0]] * 2 + [[0, 1, 0]] * 2
    # 1 m, then 2 m of which half counts, as the course turned meanwhile, then 2 m: in 3 s.
    found = judge("follow_course", track(way, course=course))
    assert found == pytest.approx((1 + 1 + 2) / 3 / 0.5)
    assert judge("follow_course", track(way, course=-np.array(course))) == pytest.approx(-found)
    deep = np.array(way) - [0, 0, 1]
    assert judge("follow_course", track(deep, course=course)) == 0.0  # not at its depth


@pytest.mark.parametrize("name", ["search", "escape"])
def test_scores_have_a_gradient_where_nothing_is_left(name):
    """Touched from the first row on, or never nearer: derivatives are numbers."""
    for x in ((4.5, 4.5, 0.0), (0.0, 0.0, 0.0)):
        given = track(along_x(*x), target=along_x(*[4.5] * 3))
        task = TaskConfig(type="search", target_distance=1.0, sight=1.0, touch=0.5)

        def score(position, given=given, task=task):
            return TASKS[name].score(replace(given, position=position), task)[0]

        assert np.isfinite(jax.grad(score)(given.position)).all()


CHASED = {
    "task.duration": 2.0, "task.settle": 0.2, "task.trials": 2, "task.target_distance": 0.4,
    "task.target_turn": 1.0, "world.bed": False,
}  # fmt: skip
pytestmark = pytest.mark.usefixtures("quick_compiles")


@pytest.fixture(scope="module")
def chased():
    """The fitness of those that flee, genes of three, and their scores."""
    fitness = make_fitness("auv_escape", **CHASED)
    genes = np.random.default_rng(0).normal(0, 0.3, (3, fitness.num_genes)).astype(np.float32)
    return fitness, genes, np.asarray(fitness(genes, jax.random.key(2)))


@pytest.mark.slow
def test_a_pursuer_is_the_robots_own(chased):
    """Whatever its neighbours; the scores of its episodes are those of their trajectories."""
    fitness, genes, scores = chased
    key = jax.random.key(2)
    assert len(set(scores.tolist())) == 3 and (scores < 0.95).all()
    assert np.array_equal(np.asarray(fitness(genes[::-1], key)), scores[::-1])
    one = make_fitness("auv_escape", **CHASED | {"task.trials": 1})
    score = float(one(genes[:1], key)[0])
    trajectory = one.replay(genes[0], key)
    # Two programs round differently, and chaos is slow in two seconds.
    assert one.judge(trajectory, key)[0] == pytest.approx(score, abs=1e-4)
    # By hand: 0.3 m/s, from 0.4 m away, and never faster.
    place = np.asarray(trajectory.target)
    moved = np.linalg.norm(np.diff(place, axis=0), axis=1)
    assert moved == pytest.approx(0.3 * one.robot.world.timestep, rel=2e-2)
    start = np.asarray(one.starts(key)[0])[:3, 0]
    first = np.linalg.norm(place[0] - start)
    assert first == pytest.approx(0.4 - 0.3 * one.robot.world.timestep, abs=1e-4)
