"""Forces on parts: closed forms, and the sum that the engines' step makes of them."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from laboratory import accelerate, arm_robot, box_robot, face_drag, random_states, world
from mjx_revolve.body.module_types import Thruster
from mjx_revolve.engine.robot import Robot
from mjx_revolve.engine.variation import Variation
from mjx_revolve.episodes.simulate import Trajectory
from mjx_revolve.view.forces import module_forces
from mjx_revolve.water.flow import Water, flow, water_of
from mjx_revolve.water.plates import LiftDrag
from references import rotation

RHO, G = 999.1026, 9.81
BRICK = (0.06, 0.04, 0.02)
TURNED = [np.cos(0.35), *(np.sin(0.35) * np.array([0.6, 0.0, 0.8]))]


def states(robot: Robot, qpos, qvel=None, ctrl=None, command=None, time=None) -> Trajectory:
    """A trajectory of given states, `[S, nq]`."""
    qpos = np.atleast_2d(np.asarray(qpos, float))
    count, model = len(qpos), robot.mj_model
    blank = lambda value, width: np.zeros((count, width)) if value is None else value  # noqa: E731
    return Trajectory(
        time=np.zeros(count) if time is None else time, qpos=qpos, qvel=blank(qvel, model.nv),
        xpos=np.zeros((count, model.nbody, 3)), ctrl=blank(ctrl, model.nu), power=np.zeros(count),
        command=command,
    )  # fmt: skip


def pose(x=0.0, y=0.0, z=-5.0, quat=(1.0, 0.0, 0.0, 0.0)) -> np.ndarray:
    return np.array([x, y, z, *quat])


def test_buoyancy_of_what_is_under_water():
    """ρ V g upwards, whatever the attitude; none above; half of it half way."""
    robot = box_robot(BRICK, 0.03, world(gravity=G, buoyancy="partial"))
    rows = [pose(), pose(quat=TURNED), pose(z=1.0), pose(z=0.0)]
    forces = module_forces(robot, states(robot, rows))
    full = RHO * np.prod(BRICK) * G
    assert forces.buoyancy[:, 0, 2] == pytest.approx([full, full, 0, full / 2], rel=1e-5)
    assert forces.buoyancy[:, 0, :2] == pytest.approx(0, abs=1e-6 * full)
    assert not forces.drag.any() and not forces.thrust.any()


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_drag_of_a_brick(axis):
    """½ ρ C_d A v² against its motion relative to the water."""
    current = (0.1, -0.2, 0.05)
    robot = box_robot(BRICK, 0.03, world(drag="faces", current=current), drag_coefficient=1.05)
    v = np.zeros((2, 6))
    v[:, axis] = [0.3, -0.4]
    v[:, :3] += current
    drag = module_forces(robot, states(robot, [pose()] * 2, v)).drag[:, 0]
    area = np.prod(BRICK) / BRICK[axis]
    expected = np.zeros((2, 3))
    expected[:, axis] = 0.5 * RHO * 1.05 * area * np.array([-(0.3**2), 0.4**2])
    assert drag == pytest.approx(expected, rel=1e-4, abs=1e-6)


def test_forces_are_those_of_the_coefficients_of_the_episode():
    robot = box_robot(BRICK, 0.03, world(gravity=G, buoyancy="partial", drag="faces"))
    usual = states(robot, [pose()], np.array([[0.3, -0.2, 0.1, 1.0, 0.5, -0.7]]))
    varied = replace(usual, variation=Variation(drag=1.2, density=1.1))
    own, other = (module_forces(robot, x) for x in (usual, varied))
    assert other.drag == pytest.approx(1.2 * 1.1 * own.drag, rel=1e-5)
    assert other.buoyancy == pytest.approx(1.1 * own.buoyancy, rel=1e-5)


def test_lift_of_a_plate():
    """At 30° of attack: lift ½ ρ A v² cla α across the flow, drag ½ ρ A v² cda α against it."""
    fin = LiftDrag(cla=2.0, cda=0.5, area=0.01, forward=(1.0, 0.0, 0.0), upward=(0.0, 0.0, 1.0))
    robot = box_robot((0.1, 0.1, 0.01), 0.03, world(drag="faces"), lift_drag=fin)
    attack, speed = np.radians(30.0), 0.5
    v = np.zeros((1, 6))
    v[0, :3] = speed * np.array([np.cos(attack), 0.0, -np.sin(attack)])
    drag = module_forces(robot, states(robot, pose(), v)).drag[0, 0]
    q = 0.5 * RHO * 0.01 * speed**2
    across = np.array([np.sin(attack), 0.0, np.cos(attack)])
    expected = q * 2.0 * attack * across - q * 0.5 * attack * v[0, :3] / speed
    assert drag == pytest.approx(expected, rel=1e-4)


def test_thrust_follows_the_curve():
    """T = k x|x| along the turned axis, of the command behind the lag; none out of the water."""
    thruster = Thruster(gain=0.8, axis=(0.0, 1.0, 0.0), time_constant=0.2)
    robot = box_robot((0.1, 0.1, 0.1), 1.0, world(buoyancy="partial"), thruster=thruster)
    rows, lagged = [pose(), pose(quat=TURNED), pose(z=1.0)], np.array([[0.5], [-0.7], [1.0]])
    forces = module_forces(robot, states(robot, rows, ctrl=np.ones((3, 1)), command=lagged))
    expected = [[0, 0.8 * 0.25, 0], -0.8 * 0.49 * rotation(TURNED)[:, 1], [0, 0, 0]]
    assert forces.thrust[:, 0] == pytest.approx(np.array(expected), abs=1e-6)
    # Without a record of the lag, what was asked for.
    asked = module_forces(robot, states(robot, rows, ctrl=np.full((3, 1), 0.5)))
    assert asked.thrust[0, 0] == pytest.approx([0, 0.8 * 0.25, 0])


def test_water_of_its_time():
    """Waves go on with time, a current's rows with the steps: drag sees the water of the moment."""
    sea = world(drag="faces", gravity=G, waves=[{"amplitude": 0.05, "wavelength": 2.0}])
    robot = box_robot(BRICK, 0.03, sea)
    time = np.array([0.2, 0.4, 0.6])
    rows = [pose(0.3, 0.0, -0.5)] * 3
    forces = module_forces(robot, states(robot, rows, time=time))
    still = water_of(sea)
    for k in range(3):
        u = [float(x) for x in flow(sea, still._replace(time=time[k]), 0.3, 0.0, -0.5)[0]]
        c = face_drag(robot).linear[0]
        assert forces.drag[k, 0] == pytest.approx(c * np.abs(u) * u, rel=2e-3, abs=1e-6)
    # A time for each step, which `simulate` takes as well, says the same as that of the start.
    moments = still._replace(time=sea.timestep * np.arange(3))
    each = module_forces(robot, states(robot, rows, time=time), water=moments)
    assert each.drag == pytest.approx(forces.drag, rel=1e-5)
    # A row of the current is the water of the step that follows; the last one stays.
    robot = box_robot(BRICK, 0.03, world(drag="faces"))
    gusty = Water(0.0, (np.array([0.1, 0.2, 0.3]), 0.0, 0.0))
    forces = module_forces(robot, states(robot, rows, time=time), water=gusty)
    c = face_drag(robot).linear[0, 0]
    assert forces.drag[:, 0, 0] == pytest.approx(c * np.array([0.04, 0.09, 0.09]), rel=1e-4)


def test_a_current_that_speeds_up_pushes():
    """Water that accelerates holds up ρ V (g + a)."""
    robot = box_robot(BRICK, 0.03, world(gravity=G, buoyancy="partial"))
    water = Water(0.0, (0.0, 0.0, 0.0), (0.5, 0.0, -1.0))
    force = module_forces(robot, states(robot, pose()), water=water).buoyancy[0, 0]
    assert force == pytest.approx(RHO * np.prod(BRICK) * np.array([0.5, 0, G - 1]), rel=1e-5)


_SEA = {
    "current": (0.2, -0.1, 0.0),
    "waves": [{"amplitude": 0.03, "wavelength": 1.5, "direction": 0.7}],
    "shear": {"velocity": (0.1, 0.0, 0.0), "depth": 3.0},
    "surface_tension": {"gamma": 0.0728},
}


def _momentum_rate(robot: Robot, qpos, qvel, qacc, step=1e-5) -> np.ndarray:
    """d/dt of the robot's linear momentum, by central differences along its motion."""
    model, data = robot.mj_model, mujoco.MjData(robot.mj_model)

    def momentum(time: float) -> np.ndarray:
        data.qpos[:] = qpos
        mujoco.mj_integratePos(model, data.qpos, qvel, time)
        data.qvel[:] = qvel + time * qacc
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        mujoco.mj_subtreeVel(model, data)
        return model.body_subtreemass[1] * data.subtree_linvel[1]

    return (momentum(step) - momentum(-step)) / (2 * step)


@pytest.mark.slow
@pytest.mark.parametrize("laws", [
    {"buoyancy": "partial", "drag": "faces", **_SEA},
    {"buoyancy": "mask", "drag": "lift_drag", "current": (0.2, 0.0, 0.1)},
    {"buoyancy": "partial", "drag": "inertia_box", "current": (0.2, 0.0, 0.1)},
    {"buoyancy": "off", "drag": "ellipsoid", "current": (0.2, 0.0, 0.1)},
], ids=lambda laws: laws["drag"])  # fmt: skip
def test_sum_is_what_the_step_does(laws):
    """Newton, without added mass: d/dt Σ m v = Σ forces + weight, half in and half out of water."""
    robot = arm_robot(world(gravity=G, **laws))
    qpos, qvel = random_states(robot, 3, depth=0.05, speed=0.5)
    qpos[2, 2] -= 1.0
    acceleration = accelerate(robot, qpos, qvel)
    forces = module_forces(robot, states(robot, qpos.T, qvel.T))
    total = (forces.buoyancy + forces.drag + forces.thrust).sum(1)
    total[:, 2] -= robot.mj_model.body_subtreemass[1] * G
    motions = zip(qpos.T, qvel.T, acceleration.T, strict=True)
    expected = [_momentum_rate(robot, *motion) for motion in motions]
    assert total == pytest.approx(np.array(expected), rel=1e-3, abs=2e-4)
