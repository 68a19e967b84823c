"""SDF: its poses, masses and water, by a reader of our own and by Gazebo's in Drake."""

from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from exports import NAMES, lake_robot
from laboratory import body
from mjx_revolve.body.morphology import load_morphology
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.formats.inertias import propeller
from mjx_revolve.formats.links import make_links, plain, rest_pose
from mjx_revolve.formats.sdf import make_sdf
from mjx_revolve.numerics.spatial import quat_to_matrix
from mjx_revolve.water.drag import DRAG_LAWS
from mjx_revolve.water.face_drag import FACES
from mjx_revolve.water.lift_drag import LIFT_DRAG
from mjx_revolve.water.world import load_world


@pytest.fixture(params=NAMES)
def robot(request):
    return lake_robot(request.param)


def pose_of(element):
    """`[3]` and `[3, 3]` of an element's pose; and what it is relative to."""
    pose = element.find("pose")
    if pose is None:
        return np.zeros(3), np.eye(3), None
    x = np.array(pose.text.split(), float)
    turn = np.eye(3)
    for axis in (2, 1, 0):
        half = x[3 + axis] / 2
        turn = turn @ quat_to_matrix([np.cos(half), *(np.sin(half) * np.eye(3)[axis])])
    return x[:3], turn, pose.get("relative_to")


def model_of(robot):
    root = ElementTree.fromstring(make_sdf(robot))
    return root, root.find("world/model[@canonical_link]")


def rest_of(model):
    """Poses of all links and frames of an SDF model at rest, model frame."""
    elements = {e.get("name"): e for e in model if e.tag in ("link", "frame")}

    def solve(name):
        position, turn, base = pose_of(elements[name])
        if base is None:
            return position, turn
        p, r = solve(base)
        return p + r @ position, r @ turn

    return {name: solve(name) for name in elements}


def test_sdf_stands_as_the_robot_does(robot):
    _, model = model_of(robot)
    rest, links = rest_of(model), make_links(robot)
    for index, link in enumerate(links):
        position, rotation = rest_pose(links, index)
        np.testing.assert_allclose(rest[link.name][0], position, atol=1e-9)
        np.testing.assert_allclose(rest[link.name][1], rotation, atol=1e-9)
        for part in link.parts:
            module = robot.morphology.modules[robot.fluid.module[part.row]]
            np.testing.assert_allclose(
                rest[part.name][0],
                module.position + module.rotation @ part.part.position,
                atol=1e-9,
            )


def test_sdf_weighs_what_the_robot_does(robot):
    """Mass, centre and inertia of all links together, about the core."""
    _, model = model_of(robot)
    rest = rest_of(model)
    mass, moment, inertia = 0.0, np.zeros(3), np.zeros((3, 3))
    for link in model.findall("link"):
        inertial = link.find("inertial")
        m = float(inertial.findtext("mass"))
        local, _, _ = pose_of(inertial)
        position, turn = rest[link.get("name")]
        at = position + turn @ local
        i = {k.tag: float(k.text) for k in inertial.find("inertia")}
        own = np.array([[i["i" + "".join(sorted(a + b))] for b in "xyz"] for a in "xyz"])
        assert np.linalg.eigvalsh(own).min() > 0
        mass, moment = mass + m, moment + m * at
        inertia += turn @ own @ turn.T + m * (at @ at * np.eye(3) - np.outer(at, at))
    whole, center, full = 0.0, np.zeros(3), np.zeros((3, 3))
    links = make_links(robot)
    for index, link in enumerate(links):
        position, turn = rest_pose(links, index)
        at = position + turn @ link.center_of_mass
        whole, center = whole + link.mass, center + link.mass * at
        full += turn @ link.inertia @ turn.T
        full += link.mass * (at @ at * np.eye(3) - np.outer(at, at))
    assert mass == pytest.approx(robot.morphology.mass)
    assert mass == pytest.approx(whole)
    np.testing.assert_allclose(moment, center, atol=1e-9)
    np.testing.assert_allclose(inertia, full, atol=1e-10)


def test_what_floats_not_has_boxes_of_its_own_size():
    sunk = build_robot(load_morphology("spider"), load_world("lake", buoyancy="off"))
    model = model_of(sunk)[1]
    solid = [p for x in make_links(sunk) for p in x.parts if p.part.contact]
    for part in solid:
        size = model.findtext(f"link[@name='{part.name}']/collision/geometry/box/size").split()
        np.testing.assert_allclose(np.array(size, float), 2 * sunk.fluid.half_size[part.row])
    assert len(model.findall("link/collision")) == len(solid) > 20


def test_sdf_has_the_water_of_each_part(robot):
    root, model = model_of(robot)
    table, density = robot.fluid, robot.world.density
    plugins = model.findall("plugin")
    drags = {p.findtext("link_name"): p for p in plugins if "Hydrodynamics" in p.get("name")}
    fins = {p.findtext("link_name"): p for p in plugins if "LiftDrag" in p.get("name")}
    faces = FACES.numbers(table, robot.world)
    plates = LIFT_DRAG.numbers(table, robot.world)
    for link in make_links(robot):
        for part in link.parts:
            k, element = part.row, model.find(f"link[@name='{part.name}']")
            size = np.array(element.findtext("collision/geometry/box/size").split(), float)
            assert size.prod() == pytest.approx(table.volume[k])
            place = pose_of(element.find("collision"))[0]
            np.testing.assert_allclose(place, table.center_of_volume[k], atol=1e-12)
            added = element.find("inertial/fluid_added_mass")
            values = [float(added.findtext(tag)) for tag in ("xx", "yy", "zz", "pp", "qq", "rr")]
            carried = [*table.carried_mass[k], *table.carried_inertia[k]]
            np.testing.assert_allclose(values, density * np.array(carried), rtol=1e-9)
            if DRAG_LAWS[table.drag[k]].sdf.stand_in == "lift_drag":
                assert float(fins[part.name].findtext("area")) == pytest.approx(plates.area[k])
                assert float(fins[part.name].findtext("air_density")) == density
                tags = "kPabsP", "mQabsQ", "nRabsR"
                turning = [float(drags[part.name].findtext(tag)) for tag in tags]
                np.testing.assert_allclose(turning, -plates.angular[k], rtol=1e-9)
                continue
            # After Fossen: what brakes is negative.
            found = [
                float(drags[part.name].findtext(tag))
                for tag in ("xUabsU", "yVabsV", "zWabsW", "kPabsP", "mQabsQ", "nRabsR")
            ]
            expected = [*faces.linear[k], *faces.angular[k]]
            np.testing.assert_allclose(found, -np.array(expected), rtol=1e-9)
    graded = root.find("world/plugin/graded_buoyancy")
    assert float(graded.findtext("default_density")) == density
    assert float(graded.findtext("density_change/above_depth")) == 0.0


def test_sdf_refers_to_what_is_there(robot):
    _, model = model_of(robot)
    names = [e.get("name") for e in model if e.tag in ("link", "frame", "joint")]
    assert len({*names}) == len(names)
    links = {e.get("name") for e in model.findall("link")}
    joints = {e.get("name"): e for e in model.findall("joint")}
    for joint in joints.values():
        assert {joint.findtext("parent"), joint.findtext("child")} <= links
    # A tree: one root, and every other link the child of one joint.
    children = [joint.findtext("child") for joint in joints.values()]
    assert sorted(children) == sorted(links - {model.get("canonical_link")})
    for plugin in model.findall("plugin"):
        assert plugin.findtext("link_name") in links | {None}
        assert plugin.findtext("joint_name") in {*joints, None}
    for link in make_links(robot)[1:]:
        joint = joints[link.joint.name]
        module = robot.mj_model.body(link.body).name  # its two parts overlap: joined, they may
        assert joint.findtext("parent").startswith(f"{plain(module)}_")
        limit = joint.find("axis/limit")
        assert pose_of(joint)[2] == link.name
        np.testing.assert_allclose(np.array(joint.findtext("axis/xyz").split(), float), [0, 1, 0])
        assert float(limit.findtext("lower")) == pytest.approx(link.joint.range[0])
        assert float(limit.findtext("upper")) == pytest.approx(link.joint.range[1])
        assert float(limit.findtext("effort")) == pytest.approx(link.joint.effort)
        assert float(limit.findtext("velocity")) == pytest.approx(link.joint.speed)
    thrusters = [p for p in model.findall("plugin") if "Thruster" in p.get("name")]
    assert len(thrusters) == robot.num_thrusters
    for plugin in thrusters:
        assert float(plugin.findtext("max_thrust_cmd")) == pytest.approx(0.5)
        assert float(plugin.findtext("min_thrust_cmd")) == pytest.approx(-0.5)


def test_a_thruster_along_a_diagonal_has_a_propeller():
    part = next(p for m in load_morphology("auv").modules for p in m.kind.parts if p.thruster)
    thruster = replace(part.thruster, axis=(3**-0.5,) * 3)
    diameter = propeller(replace(part, thruster=thruster))[1]
    assert diameter == pytest.approx(0.9 * min(part.boxes[0].size))


def test_sdf_of_a_world_without_water_has_none_and_its_bed_is_there():
    world = load_world(
        "empty_underwater", buoyancy="off", drag="off", added_mass=False,
        bed={"kind": "flat", "height": -1.5, "friction": 0.7},
    )  # fmt: skip
    root, _ = model_of(build_robot(body("core"), world))
    text = ElementTree.tostring(root, encoding="unicode")
    for word in ("Hydrodynamics", "Buoyancy", "fluid_added_mass"):
        assert word not in text
    bed = root.find("world/model[@name='bed']")
    assert pose_of(bed)[0][2] == -1.5
    assert float(bed.findtext(".//mu")) == 0.7
