"""The picture of a swim: which poses it shows, where the robot stands in it, what it refuses."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import matplotlib.image
import mujoco
import numpy as np
import pytest

from laboratory import WATER, body, world
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.view.swim_picture import (
    choose_poses,
    draw_swim,
    plot_swim,
    pose_scene,
    smooth_path,
    stroke_period,
)

PERIOD, SPEED, SECONDS = 0.8, 0.05, 6.0
TIME = np.arange(0.02, SECONDS + 1e-9, 0.02)


def swim(robot, heading=0.0, depth=1.0, speed=SPEED):
    """A robot that goes straight ahead at one speed while its hinges beat, without any physics."""
    qpos = np.tile(robot.mj_model.qpos0, (len(TIME), 1))
    qpos[:, 0] = speed * math.cos(heading) * TIME
    qpos[:, 1] = speed * math.sin(heading) * TIME
    qpos[:, 2] = -depth
    beat = np.sin(2 * np.pi * TIME / PERIOD)
    qpos[:, 7:] = 0.5 * beat[:, None]
    return SimpleNamespace(time=TIME, qpos=qpos)


def draw(robot, trajectory, path):
    """`[900, 1600, 3]` what `draw_swim` wrote, from 0 to 1."""
    draw_swim(robot, trajectory, path)
    return matplotlib.image.imread(path)[..., :3]


def words(figure):
    """Every text of a figure."""
    texts = [*figure.texts, *(text for axes in figure.axes for text in axes.texts)]
    return [text.get_text() for text in texts if text.get_visible()]


@pytest.fixture(scope="module")
def figure(elbow):
    return plot_swim(elbow, swim(elbow))


@pytest.fixture(scope="module")
def small():
    """The core alone: no hinges, so no strip of snapshots."""
    return build_robot(body("core"), world(**WATER))


# ------------------------------------------------------------------ what is shown


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


def test_poses_that_come_back_are_told_apart():
    """Out and back: at no two times shown is the robot in one place."""
    path = np.zeros((len(TIME), 3))
    path[:, 0] = np.interp(TIME, [0, SECONDS / 2, SECONDS], [0, 0.5, 0.2])
    rows = choose_poses(TIME, path, 0.2)
    x = path[rows, 0]
    assert np.diff(np.sort(x)).min() >= 0.35 * 0.2


@pytest.mark.parametrize("period", [0.4, 0.8, 1.1])
def test_period_of_a_stroke(period):
    phase = 2 * np.pi * TIME[:, None] / period
    angles = np.column_stack([np.sin(phase), 0.3 * np.sin(2 * phase + 1), 0 * phase])
    assert stroke_period(TIME, 0.5 * angles) == pytest.approx(period, rel=0.02)


def test_no_period_where_nothing_repeats():
    draw = np.random.default_rng(0)
    assert stroke_period(TIME, np.zeros((len(TIME), 2))) is None
    assert stroke_period(TIME, np.zeros((len(TIME), 0))) is None
    assert stroke_period(TIME, 0.3 * draw.normal(size=(len(TIME), 2))) is None
    assert stroke_period(TIME, 0.1 * TIME[:, None]) is None  # a drift
    assert stroke_period(TIME[:10], np.sin(20 * TIME[:10, None])) is None  # too short to say


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


def test_parts_stand_where_mujoco_has_them(elbow):
    """Boxes of the scene against MuJoCo's geoms, at a pose with every joint bent."""
    qpos = elbow.start_qpos()
    qpos[3:7] = np.array([0.8, 0.4, -0.2, 0.4]) / np.linalg.norm([0.8, 0.4, -0.2, 0.4])
    qpos[7:] = 0.6, -0.5
    model, data = elbow.mj_model, mujoco.MjData(elbow.mj_model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    corners = pose_scene(elbow, qpos).corners.reshape(-1, 3)
    for k in range(model.ngeom):
        if model.geom_bodyid[k] == 0 or model.geom(k).name.rsplit("/", 1)[-1].isdigit():
            continue  # the world's, and second boxes: the servo's plate is drawn round
        local = (corners - data.geom_xpos[k]) @ data.geom_xmat[k].reshape(3, 3)
        # Of each box, MuJoCo's and the picture's, the eight corners coincide.
        away = np.abs(np.abs(local) - model.geom_size[k]).max(1)
        assert np.count_nonzero(away < 1e-6) >= 8, model.geom(k).name


# ------------------------------------------------------------------ the page


def test_the_page_says_how_fast_and_how_far(elbow, figure):
    said = " | ".join(words(figure))
    net = SPEED * (TIME[-1] - TIME[0])
    assert f"elbow: {SPEED / elbow.morphology.length:.2g} body lengths/s (0.05 m/s)" in said
    assert f"{net:.2g} m ({net / elbow.morphology.length:.2g} body lengths) in 5.98 s" in said
    assert "One stroke of 0.80 s, seen by a camera that follows the core" in said
    assert "depth" in said  # 1 m down: a scale, and no surface
    assert "water surface" not in said


@pytest.mark.slow
def test_the_surface_is_named_where_it_is_in_sight(small):
    said = words(plot_swim(small, swim(small, depth=0.02)))
    assert "water surface" in said
    assert "depth" not in said


@pytest.mark.slow
def test_the_picture_is_whole_and_always_the_same(small, tmp_path):
    image = draw(small, swim(small), tmp_path / "a.png")
    assert image.shape == (900, 1600, 3)
    draw_swim(small, swim(small), tmp_path / "b.png")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.png", "b.png"]


@pytest.mark.parametrize("heading", [0.0, pytest.param(2.0, marks=pytest.mark.slow)])
def test_the_robot_is_inside_the_frame_whichever_way_it_swims(small, tmp_path, heading):
    """Bright red: nothing else on the page is, so its pixels are the robot's."""
    modules = tuple(replace(m, rgb=(1.0, 0.0, 0.0)) for m in small.morphology.modules)
    red = build_robot(replace(small.morphology, modules=modules), small.world)
    image = draw(red, swim(red, heading), tmp_path / "swim.png")
    hot = (image[..., 0] > 0.45) & (image[..., 1:].max(-1) < 0.3)
    rows, columns = np.nonzero(hot)
    assert len(rows) > 300
    # Inside the panel, which begins 36 pixels from the left and 74 from the top.
    assert columns.min() > 36
    assert columns.max() < 1600 - 36
    assert rows.min() > 74
    assert rows.max() < 900 - 36
    # It swims to the right, the last pose in full colour and the first faded.
    assert columns.max() - columns.min() > 300


@pytest.mark.slow
def test_a_robot_that_stays_is_drawn_once(small, tmp_path):
    still = swim(small, speed=0.0)
    said = words(plot_swim(small, still))
    assert [w for w in said if w.endswith(" s") and w[0].isdigit() and " " not in w[:-2]] == ["6 s"]
    assert "core: 0 body lengths/s (0 m/s)" in said


@pytest.mark.slow
def test_rows_after_the_first_that_is_not_finite_are_left_out(small):
    broken = swim(small)
    broken.qpos[150:] = np.nan
    short = SimpleNamespace(time=TIME[:150], qpos=broken.qpos[:150])
    assert words(plot_swim(small, broken)) == words(plot_swim(small, short))


def test_a_single_row_is_a_portrait(elbow):
    said = words(plot_swim(elbow, SimpleNamespace(time=TIME[:1], qpos=swim(elbow).qpos[:1])))
    assert "elbow" in said  # a name without a speed


# ------------------------------------------------------------------ wrong inputs


def wrong(elbow, **fields):
    return SimpleNamespace(**{**vars(swim(elbow)), **fields})


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            {"qpos": np.zeros((300, 7))},
            "trajectory.qpos: expected [300, 9] [T, nq]; found [300, 7]",
        ),
        (
            {"time": TIME[:-1]},
            "trajectory.qpos: expected [299, 9] [T, nq]; found [300, 9]",
        ),
        (
            {"qpos": np.full((300, 9), np.nan)},
            "trajectory.qpos: expected finite numbers in its first row; found none",
        ),
    ],
)
def test_wrong_trajectories(elbow, fields, message):
    with pytest.raises(InputError) as caught:
        plot_swim(elbow, wrong(elbow, **fields))
    assert str(caught.value) == message


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("swim.jpg", "{}/swim.jpg: expected a name that ends in .png; found '.jpg'"),
        ("no/swim.png", "{0}/no/swim.png: expected the folder {0}/no to exist; found none"),
        ("folder.png", "{}/folder.png: expected a file; found a folder"),
    ],
)
def test_wrong_paths(elbow, tmp_path, name, message):
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(InputError) as caught:
        draw_swim(elbow, swim(elbow), tmp_path / name)
    assert str(caught.value) == message.format(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["folder.png"]
