"""Where a robot is and how long: its centre of mass by MuJoCo's, the stretched body by hand."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from experiments.random_bodies import random_body
from laboratory import WATER, body, need_mjx, random_states, read, world
from mjx_revolve.engine.engines import make_engine
from mjx_revolve.engine.kinematics import body_poses, mass_centers
from mjx_revolve.engine.plant import body_geometry
from mjx_revolve.engine.robot import build_robot


def mujocos(robot, qpos):
    """MuJoCo's `subtree_com` of the core."""
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(robot.mj_model, data)
    mujoco.mj_comPos(robot.mj_model, data)
    return data.subtree_com[1]


@pytest.mark.parametrize("engine", ["population", "mjx"])
def test_the_centre_of_mass_is_mujocos(engine):
    """In any pose, far from the origin, and without the water that is carried along."""
    if engine == "mjx":
        need_mjx()
    with jax.enable_x64(True):
        robot = build_robot(random_body(4, 5, 9), world(**WATER))
        qpos, qvel = random_states(robot, 4)
        qpos[:3] += 30.0
        simulator = make_engine(robot, engine, contact=False)
        state = simulator.init(jnp.asarray(qpos), jnp.asarray(qvel))
        found = np.stack(simulator.center_of_mass(state), 1)
        expected = [mujocos(robot, one) for one in qpos.T]
        np.testing.assert_allclose(found, expected, atol=1e-12)
        assert np.linalg.norm(found - qpos[:3].T, axis=1).min() > 0.01
        np.testing.assert_allclose(mass_centers(robot, qpos.T), expected, atol=1e-12)


# A core with an arm on its front and one on its right: folded by a right angle at rest.
CORNER = """
body:
  type: Core
  children:
    0: {id: b0, type: ActiveHinge, children: {1: {id: b1, type: FixedBrick}}}
    2: {id: c0, type: ActiveHinge, children: {1: {id: c1, type: FixedBrick}}}
"""


def test_a_stretched_body_is_as_long_as_the_way_through_it():
    """By hand, of an angle; and a chain and a cross are as long as at rest."""
    for name in ("snake", "spider", "core"):
        geometry = body_geometry(build_robot(body(name), world(**WATER)))
        assert geometry.stretched == pytest.approx(geometry.length, rel=1e-9), name
    robot = build_robot(read(CORNER), world(**WATER))
    geometry, assembly = body_geometry(robot), robot.assembly
    hinges = assembly.position[assembly.moved]
    # Each arm is straight, along an axis through the core's centre.
    arms = [far - np.abs(hinge).max() for far, hinge in zip(reaches(robot), hinges, strict=True)]
    expected = np.linalg.norm(hinges[0] - hinges[1]) + sum(arms)
    assert geometry.stretched == pytest.approx(expected, rel=1e-9)
    assert geometry.stretched > 1.2 * geometry.length


def test_what_the_water_does_not_lift_rights_nothing():
    """A light brick that floods hangs below the core, however much it displaces."""
    brick = "{type: FixedBrick, params: {volume: 4.0e-5%s}}"
    core = "body: {type: Core, params: {electronics_volume: 1.0e-4}, children: {1: %s}}"
    for law, side in (("", 1.0), (", buoyancy: 'off'", -1.0)):
        robot = build_robot(read(core % (brick % law)), world(**WATER))
        assert body_geometry(robot).up == pytest.approx([0.0, side, 0.0]), law


def reaches(robot):
    """How far each arm reaches from the core's centre."""
    layout, moved = robot.assembly.layout, robot.assembly.moved
    far = (np.abs(layout.box_centers()) + layout.box_reaches()).max(1)
    owner = robot.assembly.fluid.body[layout.box_part]
    return [far[owner == body].max() for body in moved]


def test_no_pose_is_longer_than_the_stretched_body():
    """Nor does a fold at rest make it shorter: over random bodies and poses."""
    for seed in range(8):
        robot = build_robot(random_body(seed, 6, 12), world(**WATER))
        geometry = body_geometry(robot)
        qpos, _ = random_states(robot, 20, seed)
        assert pose_extents(robot, qpos.T).max() <= geometry.stretched
        assert geometry.stretched >= geometry.length


def pose_extents(robot, qpos):
    """`[n]` largest distance of two boxes' centres in each pose [m]."""
    place, turn = body_poses(robot, qpos)
    body, position = robot.fluid.body, robot.fluid.position
    centers = place[:, body] + np.einsum("npij,pj->npi", turn[:, body], position)
    return np.linalg.norm(centers[:, :, None] - centers[:, None], axis=-1).max((1, 2))
