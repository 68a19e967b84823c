"""Added mass: Lamb's coefficients, Kirchhoff's equations, and what they conserve."""

import mujoco
import numpy as np
import pytest

from laboratory import accelerate, arm_robot, at_rest, box_robot, march, random_states, world
from mjx_revolve.water.added_mass import box_added_mass, lamb_coefficients
from references import Lagrangian, each_lane

RHO = 999.1026
SIZE = (0.12, 0.08, 0.03)  # its carried water weighs from 0.2 to 1.6 times what it displaces


def test_sphere():
    """Half of the displaced water along each axis, and none turns with it (Lamb 1932, § 92)."""
    mass, inertia = lamb_coefficients(np.full(3, 0.3))
    assert mass == pytest.approx(0.5 * 4 / 3 * np.pi * 0.3**3, rel=1e-9)
    assert inertia == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("semi", [(0.1, 0.06, 0.03), (0.02, 0.5, 0.1), (0.3, 0.3, 0.1)])
def test_ellipsoid_as_mujoco_has_it(semi):
    """MuJoCo's virtual mass and inertia of `fluidshape="ellipsoid"`, from its own quadrature."""
    model = mujoco.MjModel.from_xml_string(f"""
        <mujoco><worldbody><body><freejoint/><geom type="ellipsoid" mass="1"
        size="{semi[0]} {semi[1]} {semi[2]}" fluidshape="ellipsoid"/></body></worldbody></mujoco>
    """)
    mass, inertia = lamb_coefficients(np.array(semi))
    assert mass == pytest.approx(model.geom_fluid[0, 6:9], rel=1e-3)
    assert inertia == pytest.approx(model.geom_fluid[0, 9:12], rel=5e-3, abs=1e-3 * inertia.max())


def test_a_box_is_the_ellipsoid_of_its_volume_and_proportions():
    half = np.array(SIZE) / 2
    semi = half * (6 / np.pi) ** (1 / 3)
    assert box_added_mass(half)[0] == pytest.approx(lamb_coefficients(semi)[0])
    cube, _ = box_added_mass(np.full(3, 0.5))
    assert cube == pytest.approx(0.5)


def test_net_force_accelerates_body_and_water():
    """(m + m_a) a = net weight, on each face; m_a / m is 0.4 to 2.3 here."""
    tank = world(added_mass=True, gravity=9.81, buoyancy="partial")
    robot = box_robot(SIZE, 0.4, tank)
    qpos, qvel = at_rest(robot, 3, -3.0)
    qpos[3:7] = np.array([[1, 0, 0, 0], [0.5**0.5, 0.5**0.5, 0, 0], [0.5**0.5, 0, 0.5**0.5, 0]]).T
    carried = RHO * robot.fluid.added_mass[0][[2, 1, 0]]
    net = (0.4 - RHO * np.prod(SIZE)) * 9.81
    assert -accelerate(robot, qpos, qvel)[2] == pytest.approx(net / (0.4 + carried), rel=1e-12)


@pytest.mark.slow
def test_conservation_over_a_rollout():
    """A second of tumbling: energy to rounding at any step; impulse drifts less as it halves."""
    drift = []
    for dt in (0.005, 0.001, 0.0005):
        robot = box_robot(SIZE, 0.2, world(added_mass=True, timestep=dt))
        qpos, qvel = random_states(robot, 8, speed=0.2)
        _, q, v, _ = march(robot, 1.0, qpos, qvel, every=round(0.1 / dt))
        lagrangian = Lagrangian(robot, RHO)
        ends = (qpos, qvel), (q[-1], v[-1])
        start, end = (each_lane(lagrangian.energy, *state) for state in ends)
        assert end / start == pytest.approx(1.0, abs=1e-9)
        first, last = (each_lane(lagrangian.impulse, *state) for state in ends)
        drift.append(np.max(np.abs(last - first).max(1) / np.abs(first).max(1)))
    assert drift[1] < 0.05
    # The angular impulse takes the place half a step late, so it is first order.
    assert drift[1] / drift[2] == pytest.approx(2.0, abs=0.4)


@pytest.mark.slow
def test_a_jointed_body_obeys_lagrange():
    """The step's accelerations against Lagrange's equations with carried water, all 6 + n."""
    robot = arm_robot(world(added_mass=True))
    qpos, qvel = random_states(robot, 12, speed=1.5)
    servo = qpos[7:] + 0.02  # each servo pulls with a known part of its effort
    qacc = accelerate(robot, qpos, qvel, servo)
    lagrangian, model = Lagrangian(robot, RHO), robot.mj_model
    gain = model.actuator_gainprm[:, :1]
    torque = gain * 0.02 - model.dof_damping[6:, None] * qvel[6:]
    for q, v, a, t in zip(qpos.T, qvel.T, qacc.T, torque.T, strict=True):
        needed = lagrangian.force(q, v, a)
        expected = np.concatenate([np.zeros(6), t])
        # Differences over 10 µs leave about 1e-9 of the forces at work.
        scale = np.abs(lagrangian.inertia(q)).max() * np.abs(a).max()
        assert needed == pytest.approx(expected, abs=1e-7 * scale)
