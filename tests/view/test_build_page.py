"""The page on how to build a robot: its numbers by MuJoCo and by building what it says."""

import base64
import html
import io
import re

import mujoco
import numpy as np
import pytest
import trimesh

from exports import lake_robot
from laboratory import read
from mjx_revolve.body.morphology import trim_neutral
from mjx_revolve.engine.plant import body_geometry
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.formats.links import make_links
from mjx_revolve.view.build_page import (
    ballast_words,
    joint_rows,
    list_parts,
    make_build_page,
    weigh,
)
from mjx_revolve.water.world import load_world

# A core with a crooked arm, a fin and a thruster; `{params}` are the core's.
ROBOT = """
id: bench
body:
  id: core
  type: Core
  params: {params}
  children:
    1:
      id: shoulder
      type: ActiveHinge
      orientation: 90
      children:
        1: {{id: upper, type: FixedBrick, children: {{2: {{id: wrist, type: ActiveHinge}}}}}}
    2: {{id: jet, type: Thruster}}
    3: {{id: fin, type: Fin}}
"""


def bench(params="{}", **water):
    return build_robot(read(ROBOT.format(params=params)), load_world("lake", **water))


@pytest.fixture(scope="module")
def page():
    return make_build_page(bench(), "a title <b>")


@pytest.mark.parametrize("name", ["spider", "auv", "fish", "centipede", "odd"])
def test_masses_and_centres_are_mujocos(name):
    robot, found = lake_robot(name), weigh(lake_robot(name))
    data = mujoco.MjData(robot.mj_model)
    mujoco.mj_forward(robot.mj_model, data)
    assert found.mass == pytest.approx(1e3 * robot.mj_model.body_mass.sum())
    np.testing.assert_allclose(found.mass_center, 1e3 * data.subtree_com[1], atol=1e-6)
    modules = [module for some in list_parts(robot.morphology) for module in some]
    assert {module.name for module in modules} == {m.name for m in robot.morphology.modules}
    assert 1e6 * sum(m.kind.volume for m in modules) == pytest.approx(found.displaced)
    apart = found.lift_center - found.mass_center
    if np.linalg.norm(apart) > 0.01:
        up = body_geometry(robot).up
        np.testing.assert_allclose(apart / np.linalg.norm(apart), up, atol=1e-6)


@pytest.mark.slow
def test_what_modules_hold_is_told_apart_and_stands_where_it_must():
    """Bricks of equal mass and volume, and sealed volume that moves the centre of all of it."""
    brick = "{k}: {{type: FixedBrick, params: {{ballast: .01, ballast_position: [0, 0, {z}]}}}}"
    bricks = (brick.format(k=k, z=z) for k, z in enumerate((-0.015, 0.01, -0.015)))
    body = read(f"body: {{type: Core, children: {{{', '.join(bricks)}}}}}")
    assert [len(some) for some in list_parts(body)] == [1, 2, 1]
    robot = bench("{electronics_volume: 50.54e-6, center_of_volume: [0, .01, 0]}")
    assert "50.54 cm³ of sealed volume at (0, 20, 0) mm" in make_build_page(robot, "x")


def said(pattern, robot):
    [found] = re.findall(pattern, " ".join(ballast_words(weigh(robot))))
    return float(found)


def test_what_is_said_to_be_missing_makes_it_neutral():
    volume = said(r"it needs (\S+) cm³ of float", bench())
    made = bench(f"{{electronics_volume: {volume * 1e-6}}}")
    words = " ".join(ballast_words(weigh(made)))
    assert "it is neutral" in words and f"Provide {volume:.4g} cm³" in words
    trimmed = trim_neutral(bench().morphology, made.world.density)
    assert weigh(made).displaced == pytest.approx(1e6 * trimmed.volume, rel=1e-3)


def test_joints_move_as_the_table_says():
    robot = bench()
    model, data = robot.mj_model, mujoco.MjData(robot.mj_model)
    axes = {f"{sign}{axis}": s * np.eye(3)[k] for k, axis in enumerate("xyz")
            for sign, s in (("+", 1), ("−", -1))}  # fmt: skip
    rows = joint_rows(robot)
    for row, servo in zip(rows, robot.servos, strict=True):
        joint = int(model.actuator_trnid[servo, 0])
        assert row["joint"].range == tuple(model.jnt_range[joint])
        assert row["joint"].stiffness == model.actuator_gainprm[servo, 0]
        [link] = [x for x in make_links(robot) if x.joint and x.joint.ctrl == servo]
        free = link.parts[-1].position + link.parts[-1].rotation @ [0.01, 0, 0]
        places = []
        for angle in (0.0, 0.01):
            data.qpos[:] = robot.qpos0
            data.qpos[model.jnt_qposadr[joint]] = angle
            mujoco.mj_kinematics(model, data)
            body = model.jnt_bodyid[joint]
            places.append(data.xpos[body] + data.xmat[body].reshape(3, 3) @ free)
        np.testing.assert_allclose(data.xaxis[joint], axes[row["axis"]], atol=1e-9)
        moved = places[1] - places[0]
        assert moved @ axes[row["toward"]] > 0.9 * np.linalg.norm(moved)


@pytest.mark.slow
def test_page_needs_nothing_else(page):
    assert "a title &lt;b&gt;" in page and not re.search(r"https?:|<script|@import|url\(", page)
    assert all(x.startswith("data:") for x in re.findall(r'(?:src|href)="([^"]+)"', page))
    words = html.unescape(re.sub(r"<style>.*?</style>|data:[^\"]+|<[^>]+>", " ", page, flags=re.S))
    for what in ("Screws, glue, wiring", "thruster, to buy", "shoulder", "pushes along"):
        assert what in words
    assert "Attach it to core, slot 1" in words and "turned by 90°" in words


def test_shapes_are_closed_and_in_millimetres(page):
    files = re.findall(r'download="([^"]+)" href="data:model/stl;base64,([^"]+)"', page)
    parts = {(m.kind.name, p.name): p for m in bench().morphology.modules for p in m.kind.parts}
    assert len(files) == len(parts)
    for (name, source), ((kind, part), own) in zip(files, parts.items(), strict=True):
        assert name == f"{kind}_{part}.stl".lower()
        mesh = trimesh.load(io.BytesIO(base64.b64decode(source)), file_type="stl")
        # Bodies that touch share edges: closed is what has each edge as often both ways.
        edges = np.round(1e3 * mesh.vertices)[mesh.edges].astype(int)
        there, back = (sorted(x.reshape(-1, 6).tolist()) for x in (edges, edges[:, ::-1]))
        assert there == back
        assert mesh.volume == pytest.approx(1e9 * own.volume, rel=1e-4)
        low, high = own.bounds
        np.testing.assert_allclose(mesh.bounds, 1e3 * np.array([low, high]), atol=2.0)
