"""Courses: a direction that turns at moments, and all the time."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_revolve.control.courses import Course, course_path
from mjx_revolve.episodes.config import TaskConfig
from mjx_revolve.episodes.starts import draw_starts, episode_context
from mjx_revolve.water.world import load_world


def test_a_course_turns_at_once_and_all_the_time():
    course = Course(jnp.array([0.2]), jnp.array([0.1]), (jnp.array([1.0]), jnp.array([2.5])),
                    (jnp.array([0.5]), jnp.array([-1.0])))  # fmt: skip
    time = jnp.array([0.0, 0.99, 1.0, 2.0, 3.0])
    # 0.2 + t / 10, half a radian more from 1 s on, and one less from 2.5 s on.
    angles = np.array([0.2, 0.299, 0.8, 0.9, 0.0])
    found = np.asarray(course_path(course, time))
    assert found.shape == (5, 3, 1)
    expected = np.stack([np.cos(angles), np.sin(angles), 0 * angles], 1)
    assert found[..., 0] == pytest.approx(expected, abs=1e-6)


def drawn(**settings):
    task = TaskConfig(type="follow_course", trials=200, duration=10.0, settle=2.0, **settings)
    return task, draw_starts(task, load_world("lake"), jax.random.key(1), 10)


def test_courses_are_drawn_around_the_direction():
    settings = {"direction": (0.0, -3.0, 0.5), "course_spread": 0.4, "course_changes": 3}
    task, starts = drawn(course_turn=0.7, course_rate=0.2, **settings)
    course = starts.course
    # Within 0.4 rad of minus y, on both sides; of 200, some near each end.
    off = np.asarray(course.heading) + np.pi / 2
    assert np.abs(off).max() <= 0.4 + 1e-6 and off.min() < -0.35 and off.max() > 0.35
    assert np.abs(course.rate).max() <= 0.2 and np.min(course.rate) < -0.15
    assert len(course.moments) == len(course.turns) == 3
    for moment, turn in zip(course.moments, course.turns, strict=True):
        assert 2.0 <= np.min(moment) < 2.3 and 9.7 < np.max(moment) <= 10.0
        assert np.abs(turn).max() <= 0.7 and np.max(turn) > 0.6
    assert len({float(x[0]) for x in (*course.moments, *course.turns)}) == 6
    cues = episode_context(task, starts, jnp.zeros((3, 200)))
    assert cues.course is course and cues.target is None and cues.pursuit is None


def test_what_else_is_drawn_does_not_depend_on_courses():
    """A course is of its own stream: starts are the same bits with and without one."""
    _, with_course = drawn(course_spread=1.0, course_changes=2)
    plain = TaskConfig(type="speed", trials=200, duration=10.0, settle=2.0)
    without = draw_starts(plain, load_world("lake"), jax.random.key(1), 10)
    assert without.course is None
    for name in ("place", "quat", "noise"):
        assert np.array_equal(getattr(with_course, name), getattr(without, name))
