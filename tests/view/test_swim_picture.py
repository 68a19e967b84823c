"""The picture of a swim: which poses it shows, where the robot stands in it, what it refuses."""

from __future__ import annotations

import io
from dataclasses import replace

import matplotlib.image
import mujoco
import numpy as np
import pytest

from laboratory import WATER, body, world
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.episodes.config import TaskConfig
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.view.plots import figure_png
from mjx_revolve.view.swim_picture import plot_swim, pose_scenes
from mjx_revolve.water.flow import Water
from standin import TIME, swim, trajectory

SPEED = 0.05


def words(figure):
    """Every text of a figure."""
    texts = [*figure.texts, *(text for axes in figure.axes for text in axes.texts)]
    return [text.get_text() for text in texts if text.get_visible()]


def words_of(robot, trajectory, **more):
    """Every text of the page, whose robot is not painted: that takes seconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mjx_revolve.view.swim_picture.show_scene", lambda *_: None)
        return words(plot_swim(robot, trajectory, **more))


@pytest.fixture(scope="module")
def small():
    """The core alone: no hinges, so no strip of snapshots."""
    return build_robot(body("core"), world(**WATER))


def test_parts_stand_where_mujoco_has_them(elbow):
    """Boxes of the scene against MuJoCo's geoms, at a pose with every joint bent."""
    qpos = elbow.start_qpos()
    qpos[3:7] = np.array([0.8, 0.4, -0.2, 0.4]) / np.linalg.norm([0.8, 0.4, -0.2, 0.4])
    qpos[7:] = 0.6, -0.5
    model, data = elbow.mj_model, mujoco.MjData(elbow.mj_model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    corners = pose_scenes(elbow, qpos[None])[0].corners.reshape(-1, 3)
    for k in range(model.ngeom):
        if model.geom_bodyid[k] == 0 or model.geom(k).name.rsplit("/", 1)[-1].isdigit():
            continue  # the world's, and second boxes: the servo's plate is drawn round
        local = (corners - data.geom_xpos[k]) @ data.geom_xmat[k].reshape(3, 3)
        # Of each box, MuJoCo's and the picture's, the eight corners coincide.
        away = np.abs(np.abs(local) - model.geom_size[k]).max(1)
        assert np.count_nonzero(away < 1e-6) >= 8, model.geom(k).name


def test_the_page_says_how_fast_and_how_far(elbow):
    said = " | ".join(words_of(elbow, swim(elbow)))
    net = SPEED * (TIME[-1] - TIME[0])
    assert f"elbow: {SPEED / elbow.morphology.length:.2g} body lengths/s (0.05 m/s)" in said
    assert f"{net:.2g} m ({net / elbow.morphology.length:.2g} body lengths) in 5.98 s" in said
    assert "One stroke of 0.80 s, seen by a camera that follows the core" in said
    assert "from above" in said and "from the side" in said
    assert "water surface" not in said


@pytest.mark.slow
def test_getting_under_way_does_not_count(small):
    """Twice as fast after two seconds: the page says how fast from then on, as the scores do."""
    late = swim(small)
    late.qpos[:, 0] += SPEED * np.maximum(TIME - 2.0, 0)
    said = " | ".join(words_of(small, late, counted_from=2.0))
    assert f"core: {2 * SPEED / small.morphology.length:.2g} body lengths/s (0.1 m/s)" in said
    assert "0.4 m" in said and "in 4 s, from 2 s on" in said


@pytest.mark.slow
def test_the_surface_is_named_where_it_is_in_sight(small):
    assert "water surface" in words_of(small, swim(small, depth=0.02))


@pytest.mark.slow
def test_the_picture_is_whole_and_always_the_same(small):
    first, second = (figure_png(plot_swim(small, swim(small))) for _ in range(2))
    assert matplotlib.image.imread(io.BytesIO(first)).shape[:2] == (900, 1600)
    assert first == second


@pytest.mark.long
def test_the_robot_is_inside_the_frame_whichever_way_it_swims(small):
    """Bright red: nothing else on the page is, so its pixels are the robot's."""
    modules = tuple(replace(m, rgb=(1.0, 0.0, 0.0)) for m in small.morphology.modules)
    red = build_robot(replace(small.morphology, modules=modules), small.world)
    page = figure_png(plot_swim(red, swim(red, heading=2.0)))
    image = matplotlib.image.imread(io.BytesIO(page))[..., :3]  # from 0 to 1
    hot = (image[..., 0] > 0.45) & (image[..., 1:].max(-1) < 0.3)
    rows, columns = np.nonzero(hot)
    assert len(rows) > 300
    # Inside the panels, which begin 75 pixels from the left and 74 from the top.
    assert columns.min() > 75 and columns.max() < 1600 - 30
    assert rows.min() > 74 and rows.max() < 900 - 70
    # It swims to the right, the last pose in full colour and the first faded.
    assert columns.max() - columns.min() > 300


def test_a_robot_that_stays_is_drawn_once(small):
    still = swim(small, speed=0.0)
    said = words_of(small, still)
    # The last pose alone.
    assert [w for w in said if w.endswith(" s") and w[0].isdigit()] == ["6 s"]
    assert "core: 0 body lengths/s (0 m/s)" in said


def adrift(small, **changes):
    return build_robot(small.morphology, replace(small.world, **changes))


@pytest.mark.slow
def test_currents_are_drawn_and_speeds_told_apart(small):
    """Over ground at 0.05 m/s, in water that comes towards it or goes along."""
    length = small.morphology.length
    for current, through in ((-0.05, 0.1), (0.05, 0.0)):
        said = words_of(adrift(small, current=(current, 0.0, 0.0)), swim(small))
        assert "current 0.05 m/s" in said
        (headline,) = (w for w in said if "over ground" in w)
        assert headline.startswith("core: ") and "(0.05 m/s) over ground, " in headline
        found = float(headline.split("over ground, ")[1].split()[0])
        assert found == pytest.approx(through / length, rel=0.05, abs=1e-3)
    # An episode's own water, with a row for each step, goes before the world's.
    gust = Water(0.0, (0.0, np.linspace(0.0, 0.08, len(TIME)), 0.0))
    assert "current 0.04 m/s" in words_of(small, swim(small), water=gust)
    still = words_of(small, swim(small))
    assert not any("current" in w or "over ground" in w for w in still)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("target", "words"), [((0.4, 0.05, -1.0), ""), ((5.3, 0.0, -1.0), ", 5 m on"), (None, None)]
)
@pytest.mark.parametrize("name", ["target", "pursuer"])
def test_targets_are_drawn_or_pointed_at(small, name, target, words):
    place = None if target is None else np.array(target)
    chase = {"target_distance": 1.5, "target_speed": 0.3, "target_turn": 0.5}
    task = TaskConfig(type="escape", duration=10.0, **chase) if name == "pursuer" else None
    said = [w for w in words_of(small, swim(small), target=place, task=task) if name in w]
    assert set(said) == (set() if words is None else {name + words})  # marked in both views


def test_a_single_row_is_a_portrait(elbow):
    said = words_of(elbow, trajectory(elbow, TIME[:1], swim(elbow).qpos[:1]))
    assert "elbow" in said  # a name without a speed


def test_another_robots_trajectory_is_refused(elbow):
    message = r"trajectory.qpos: expected \[300, 9\] \[T, nq\]; found \[300, 7\]"
    with pytest.raises(InputError, match=message):
        plot_swim(elbow, replace(swim(elbow), qpos=np.zeros((300, 7))))
