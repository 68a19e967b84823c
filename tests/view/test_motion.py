"""What a robot did, as plain values: known swims against what the analysis says of them."""

import math

import numpy as np
import pytest

from mjx_revolve.episodes.config import TaskConfig
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.view.motion import (
    analyse_motion,
    choose_poses,
    count_finite,
    counted_time,
    mean_rate,
    rms,
    smooth_path,
    speed_over,
    stroke_period,
    stroke_rows,
)
from standin import PERIOD, SECONDS, TIME, swim, trajectory

SPEED, HEADING = 0.05, 0.6


@pytest.fixture(scope="module")
def sine(elbow):
    """At one speed and 2 W, 1.5 m deep, targets off by so much, from the third second on."""
    plain, power = swim(elbow, HEADING, 1.5), np.full(len(TIME), 2.0)
    found = swim(elbow, HEADING, 1.5, ctrl=plain.qpos[:, 7:] + np.array([0.1, -0.2]), power=power)
    return analyse_motion(elbow, found, counted_from=2.0)


def test_how_fast_how_far_and_where_to(elbow, sine):
    assert sine.speed == pytest.approx(SPEED)
    assert (sine.seconds, sine.distance) == pytest.approx((4.0, 4.0 * SPEED))
    assert sine.along == pytest.approx([math.cos(HEADING), math.sin(HEADING)])
    assert sine.surface - sine.path[:, 2] == pytest.approx(1.5)
    assert sine.length == elbow.morphology.length
    assert speed_over(sine.time, sine.path) == pytest.approx(SPEED)


def test_strokes_and_joints(sine):
    assert sine.period == pytest.approx(PERIOD, rel=0.02)
    assert rms(sine.angles - sine.targets) == pytest.approx([0.1, 0.2])
    rows = stroke_rows(sine.time, sine.period, 4)
    assert np.diff(TIME[rows]) == pytest.approx(PERIOD / 4, abs=0.02)
    assert TIME[rows[0]] == pytest.approx(SECONDS - PERIOD, abs=0.02)
    assert sine.angles[rows, 0] == pytest.approx(sine.qpos[rows, 7])


def test_energy_and_its_cost(elbow, sine):
    assert sine.energy[-1] == pytest.approx(2.0 * SECONDS)
    assert mean_rate(sine.time, sine.energy) == pytest.approx(2.0)
    # Power over weight times speed, from where it counts; unknown before, and at its start.
    weight = 9.81 * elbow.morphology.mass
    assert sine.cost == sine.costs[-1] == pytest.approx(2.0 / (weight * SPEED))
    assert np.isnan(sine.costs[: sine.first + 1]).all()
    assert np.isfinite(sine.costs[TIME > 2.5]).all()


def test_rows_after_the_first_that_is_not_finite_are_left_out(elbow, sine):
    qpos = sine.qpos.copy()
    qpos[150] = np.nan
    assert count_finite(qpos) == 150
    short = analyse_motion(elbow, trajectory(elbow, TIME, qpos))
    assert {len(short.time), len(short.path), len(short.power), len(short.targets)} == {150}
    with pytest.raises(InputError, match="expected finite numbers in its first row; found none"):
        analyse_motion(elbow, trajectory(elbow, TIME, np.nan * qpos))


def test_a_task_counts_from_its_first_record():
    # Records every 0.1 s, the first of them one interval late: 2.0 s are the rows 0 to 19.
    task = TaskConfig(type="speed", duration=10.0, settle=2.0)
    assert counted_time(task, 0.005) == pytest.approx(2.1)


def test_poses_are_spread_over_the_way():
    path = np.zeros((len(TIME), 3))
    path[:, 0] = SPEED * TIME
    # 0.3 m are ten lengths of 3 cm: six poses at equal times, the two ends among them.
    rows = choose_poses(TIME, path, 0.03)
    assert rows[0] == 0
    assert rows[-1] == len(TIME) - 1
    assert len(rows) == 6
    assert np.ptp(np.diff(rows)) <= 1
    # Of 0.3 m, at least 0.55 lengths of 0.2 m between neighbours: three, 0.15 m apart.
    assert len(choose_poses(TIME, path, 0.2)) == 3
    # Two alone may be closer, and who stays is shown once, at the end.
    assert len(choose_poses(TIME, path, 0.7)) == 2
    assert choose_poses(TIME, path, 2.0) == [len(TIME) - 1]


@pytest.mark.parametrize("period", [0.4, 1.1])
def test_period_of_a_stroke(period):
    phase = 2 * np.pi * TIME[:, None] / period
    angles = np.column_stack([np.sin(phase), 0.3 * np.sin(2 * phase + 1), 0 * phase])
    assert stroke_period(TIME, 0.5 * angles) == pytest.approx(period, rel=0.02)


def test_smooth_path_takes_out_the_strokes_alone():
    path = np.zeros((len(TIME), 3))
    path[:, 0] = SPEED * TIME
    swaying = path.copy()
    swaying[:, 1] = 0.01 * np.sin(2 * np.pi * TIME / PERIOD)
    assert smooth_path(TIME, path, PERIOD) == pytest.approx(path, abs=1e-12)
    inner = slice(20, -20)  # half a stroke from the ends
    assert np.abs(smooth_path(TIME, swaying, PERIOD)[inner, 1]).max() < 5e-4
    # The ends stay where they are.
    assert smooth_path(TIME, swaying, PERIOD)[[0, -1]] == pytest.approx(swaying[[0, -1]])


def test_rates_over_a_stroke_know_no_strokes():
    """A to and fro of one period vanishes over that period, at the ends, too."""
    path = np.zeros((len(TIME), 3))
    path[:, 0] = SPEED * TIME
    path[:, 1] = 0.02 * np.sin(2 * np.pi * TIME / PERIOD)
    assert speed_over(TIME, path, PERIOD) == pytest.approx(SPEED, rel=1e-6)
    assert speed_over(TIME, path, 0.04).max() > 2 * SPEED
    assert speed_over(TIME, path, 100.0) == pytest.approx(SPEED, rel=0.01)  # all there is
    assert mean_rate(TIME[:1], path[:1]).tolist() == [[0.0, 0.0, 0.0]]
