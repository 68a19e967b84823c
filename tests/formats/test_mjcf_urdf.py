"""Links and their names; MJCF and URDF as MuJoCo and yourdfpy read them."""

import copy
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest

from exports import NAMES, angles_of, forward, lake_robot, odd_episode
from laboratory import body
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.formats.export import export_robot
from mjx_revolve.formats.links import make_links, rest_pose
from mjx_revolve.formats.mjcf import make_mjcf
from mjx_revolve.formats.sdf import make_sdf
from mjx_revolve.formats.urdf import make_urdf
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.water.world import load_world


@pytest.fixture(params=NAMES)
def robot(request):
    return lake_robot(request.param)


def test_links_stand_where_their_hinges_do(robot):
    links = make_links(robot)
    modules = {module.name: module for module in robot.morphology.modules}
    assert links[0].name == "base_link"
    for index, link in enumerate(links):
        module = modules[robot.mj_model.body(link.body).name]
        position, rotation = rest_pose(links, index)
        anchor = module.kind.hinge.anchor if index else np.zeros(3)
        np.testing.assert_allclose(position, module.position + module.rotation @ anchor, atol=1e-12)
        np.testing.assert_allclose(rotation, module.rotation, atol=1e-12)
        for part in link.parts:
            assert part.rgb == (
                robot.morphology.modules[robot.fluid.module[part.row]].rgb or (0.5, 0.5, 0.5)
            )
    assert sum(link.mass for link in links) == pytest.approx(robot.morphology.mass)


def load_mjcf(robot):
    return mujoco.MjModel.from_xml_string(make_mjcf(robot))


def test_mjcf_is_the_same_robot(robot):
    ours, model = robot.mj_model, load_mjcf(robot)
    assert (model.nq, model.nv, model.nu) == (ours.nq, ours.nv, ours.nu)
    np.testing.assert_allclose(model.qpos0, ours.qpos0)
    for index in range(1, ours.nbody):
        mine = model.body(ours.body(index).name).id
        np.testing.assert_allclose(model.body_mass[mine], ours.body_mass[index], rtol=1e-6)
        np.testing.assert_allclose(model.body_ipos[mine], ours.body_ipos[index], atol=1e-7)
        np.testing.assert_allclose(model.body_inertia[mine], ours.body_inertia[index], rtol=1e-5)
    # What lifts weighs nothing.
    assert model.body_mass.sum() == pytest.approx(ours.body_mass.sum(), rel=1e-5)
    for name in ("jnt_range", "jnt_axis", "jnt_type", "actuator_gainprm", "actuator_biasprm"):
        np.testing.assert_allclose(getattr(model, name), getattr(ours, name), rtol=1e-5, atol=1e-6)
    for name in ("actuator_forcerange", "actuator_ctrlrange", "actuator_gear"):
        np.testing.assert_allclose(getattr(model, name), getattr(ours, name), rtol=1e-5, atol=1e-6)


def test_mjcf_moves_alike(robot):
    angles = angles_of(robot)
    model = load_mjcf(robot)
    data = mujoco.MjData(model)
    data.qpos[7:] = angles
    mujoco.mj_kinematics(model, data)
    position, rotation = forward(robot, angles)
    for index in range(1, robot.mj_model.nbody):
        mine = data.body(robot.mj_model.body(index).name)
        np.testing.assert_allclose(mine.xpos, position[index - 1], atol=1e-6)
        np.testing.assert_allclose(mine.xmat.reshape(3, 3), rotation[index - 1], atol=2e-6)


def test_mjcf_floats_as_the_robot_does(robot):
    """Weight less displaced water, and the moment of the centres, both known."""
    world, table = robot.world, robot.fluid
    model = load_mjcf(robot)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    lift = world.density * world.gravity * table.volume
    assert data.qfrc_passive[2] == pytest.approx(lift.sum(), rel=1e-5)
    part = [robot.mj_model.body(b).name for b in table.body]
    at = np.array([data.body(name).xpos for name in part])
    turn = np.array([data.body(name).xmat.reshape(3, 3) for name in part])
    local = table.position + np.einsum("pij,pj->pi", table.rotation, table.center_of_volume)
    center = at + np.einsum("pij,pj->pi", turn, local)
    moment = np.cross(center, lift[:, None] * [0, 0, 1]).sum(0)
    np.testing.assert_allclose(data.qfrc_passive[3:6], moment, atol=1e-5 * lift.sum())


def test_mjcf_keeps_hinges_below_their_top_speed():
    model, link = load_mjcf(lake_robot("spider")), make_links(lake_robot("spider"))[1]
    data = mujoco.MjData(model)
    for sign in (-1, 1):
        data.qvel[6:] = sign * link.joint.speed
        mujoco.mj_forward(model, data)
        expected = np.full(8, -sign * link.joint.effort)
        np.testing.assert_allclose(data.qfrc_damper[6:], expected, rtol=1e-5)


def test_mjcf_and_sdf_start_where_the_rollout_does(tmp_path):
    episode = odd_episode()
    files = {"mjcf": tmp_path / "a.xml", "sdf": tmp_path / "a.sdf"}
    export_robot(episode.robot, files, episode.trajectory)
    start = np.asarray(episode.trajectory.qpos)[0]
    key = mujoco.MjModel.from_xml_path(str(files["mjcf"])).key("start")
    np.testing.assert_allclose(key.qpos, start, atol=1e-6)
    pose = ElementTree.parse(files["sdf"]).findtext("world/model/pose").split()
    np.testing.assert_allclose(np.array(pose[:3], float), start[:3])
    with pytest.raises(InputError, match="mcap: expected a trajectory; found none"):
        export_robot(episode.robot, {"mcap": tmp_path / "a.mcap"})


def test_mjcf_has_the_current_and_a_near_bed():
    world = load_world("empty_underwater", current=(0.1, 0, 0.2), bed={"height": -1.02})
    robot = build_robot(body("spider"), world)
    model = load_mjcf(robot)
    np.testing.assert_allclose(model.opt.wind, [0.1, 0, 0.2])
    assert model.opt.density == pytest.approx(world.density, rel=1e-5)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    assert data.ncon > 0  # half a core is 22.5 mm


def test_what_an_edited_model_does_not_limit_is_not_limited():
    robot = lake_robot("spider")
    edit = copy.copy(robot.mj_model)
    edit.actuator_forcelimited[0] = edit.jnt_limited[1] = 0
    edit.actuator_forcerange[0], edit.jnt_user[1, 0] = 0, np.inf
    free = robot.with_model(edit)
    limit = ElementTree.fromstring(make_urdf(free)).find("joint/limit")
    found = {name: float(x) for name, x in limit.items()}
    assert found == {"lower": -1e16, "upper": 1e16, "effort": 1e16, "velocity": 1e16}
    text = make_sdf(free)
    assert "<cmd_max>1e+16</cmd_max>" in text and "of the edited model" in text


@pytest.mark.parametrize("drag", ["off", "ellipsoid", "inertia_box"])
def test_mjcf_has_mujocos_own_drag_where_the_world_has(drag):
    robot = build_robot(body("core"), load_world("lake", drag=drag, buoyancy="off"))
    text = make_mjcf(robot)
    model = mujoco.MjModel.from_xml_string(text)
    assert (model.opt.density > 0) == (drag != "off")
    assert (model.geom_fluid[:, 0].sum() > 0) == (drag == "ellipsoid")
    assert model.body_gravcomp.sum() == 0
    data = mujoco.MjData(model)
    data.qvel[0] = 0.3
    mujoco.mj_forward(model, data)
    assert (data.qfrc_passive[0] < 0) == (drag != "off")


def test_urdf_is_the_same_robot_to_yourdfpy(robot, tmp_path):
    yourdfpy = pytest.importorskip("yourdfpy", reason="the package yourdfpy reads URDF")
    path = tmp_path / "robot.urdf"
    export_robot(robot, {"urdf": path})
    urdf = yourdfpy.URDF.load(str(path))
    assert urdf.validate()
    angles, links = angles_of(robot, 2), make_links(robot)
    urdf.update_cfg(dict(zip((link.joint.name for link in links[1:]), angles, strict=True)))
    position, rotation = forward(robot, angles)
    for index, link in enumerate(links):
        pose = urdf.get_transform(link.name, "base_link")
        np.testing.assert_allclose(pose[:3, 3], position[index], atol=1e-9)
        np.testing.assert_allclose(pose[:3, :3], rotation[index], atol=1e-9)
        assert len(urdf.link_map[link.name].visuals) == len(link.parts)
    for link in links[1:]:
        joint = urdf.joint_map[link.joint.name]
        hinge = next(m for m in robot.morphology.modules if m.kind.hinge).kind.hinge
        assert (joint.limit.lower, joint.limit.upper) == pytest.approx(hinge.range)
        assert joint.limit.effort == pytest.approx(hinge.effort)
        assert joint.limit.velocity == pytest.approx(hinge.speed)
    # Its meshes were found: the scene has the size of the robot's, bent as it is.
    assert len(urdf.scene.geometry) > 0
    colors = {material.name: material.color.rgba for material in urdf.robot.materials}
    for module in robot.morphology.modules:
        if module.rgb is not None:
            assert any(np.allclose(rgba[:3], module.rgb) for rgba in colors.values())
