"""Drag: falls and coasts in closed form, MuJoCo's own laws, Gazebo's plate, no free energy."""

from __future__ import annotations

from functools import lru_cache

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from laboratory import accelerate, arm_robot, at_rest, box_robot, march, random_states, world
from mjx_revolve.water.drag import (
    ELLIPSOID_COEFFICIENTS,
    ellipsoid,
    ellipsoid_constants,
    face_drag_coefficients,
    inertia_box,
    quadratic_drag,
)
from mjx_revolve.water.lift_drag import lift_drag
from mjx_revolve.water.world import LiftDrag

RHO = 999.1026
G = 9.81
CUBE_DRAG = 1.05  # Hoerner 1965
CORE = ((0.089, 0.089, 0.045), 0.09, 5.054e-5)  # size, mass, displaced volume
BRICK = ((0.041, 0.041, 0.0355), 0.0102 + 0.005, 1.07e-5)  # with 5 g of ballast, or it floats
SIDES = np.array([[1, 0, 0, 0], [0.5**0.5, 0.5**0.5, 0, 0], [0.5**0.5, 0, 0.5**0.5, 0]]).T


# ------------------------------------------------------------------------- falling and coasting


@pytest.mark.parametrize("added_mass", [False, True])
@pytest.mark.parametrize(("size", "mass", "volume"), [CORE, BRICK], ids=["core", "brick"])
def test_falling_box_approaches_its_terminal_velocity(size, mass, volume, added_mass):
    """v = v_t tanh(t / τ), v_t² = 2 (m - ρV) g / (ρ C_d A), τ = (m + m_a) v_t / ((m - ρV) g).

    On each of the three faces, as a lane each. First order in the time step: τ is 0.05 to 0.5 s, so
    that 1 ms costs up to dt / 2τ of the speed on the way and nothing at the end.
    """
    tank = world(gravity=G, buoyancy="partial", drag="faces", added_mass=added_mass, timestep=0.001)
    robot = box_robot(size, mass, tank, volume)
    qpos, qvel = at_rest(robot, 3, -20.0)
    qpos[3:7] = SIDES
    # Sharp end down is an unstable equilibrium with carried water (Munk's moment): after 2.5 s the
    # rounding of the start pose would have grown to a tumble.
    time, _, qvel, _ = march(robot, 2.0 if added_mass else 3.0, qpos, qvel)
    down = np.array([2, 1, 0])  # the edge that is upright
    area = np.prod(size) / np.array(size)[down]
    net = (mass - RHO * volume) * G
    terminal = np.sqrt(2 * net / (RHO * CUBE_DRAG * area))
    carried = RHO * robot.fluid.added_mass[0][down] if added_mass else 0.0
    expected = terminal * np.tanh(time[:, None] * net / ((mass + carried) * terminal))
    assert -qvel[:, 2] == pytest.approx(expected, abs=0.01 * terminal.max())
    assert -qvel[-1, 2] == pytest.approx(terminal, rel=3e-3 if added_mass else 1e-6)


@pytest.mark.parametrize("added_mass", [False, True])
def test_coasting_and_spinning_down(added_mass):
    """Along and about each axis: v = v₀ / (1 + c v₀ t / m), and the same for ω and inertia."""
    size, mass, _ = BRICK
    tank = world(drag="faces", added_mass=added_mass, timestep=0.001)
    robot = box_robot(size, mass, tank)
    qpos, qvel = at_rest(robot, 6, -20.0)
    qvel[np.arange(6), np.arange(6)] = [1.0, 1.0, 1.0, 20.0, 20.0, 20.0]
    time, _, after, _ = march(robot, 1.0, qpos, qvel)
    fluid, edges = robot.fluid, np.square(size)
    drag = RHO * np.concatenate([fluid.drag_linear[0], fluid.drag_angular[0]])
    inertia = np.concatenate([[mass] * 3, mass / 12 * (edges.sum() - edges)])
    if added_mass:
        inertia += RHO * np.concatenate([fluid.added_mass[0], fluid.added_inertia[0]])
    speed = np.diagonal(qvel)
    expected = speed / (1 + drag * speed / inertia * time[:, None])
    found = after[:, np.arange(6), np.arange(6)]
    assert found == pytest.approx(expected, abs=0.01 * 20)
    assert found / expected == pytest.approx(1.0, abs=0.05)
    # Nothing leaks into another direction.
    assert np.abs(after[:, ~np.eye(6, dtype=bool)]).max() < 1e-12


def test_face_coefficients_against_strips():
    """½ C_d A, and the angular one by summing ½ C_d |ωr|² r over strips of the faces."""
    size, drag = np.array([0.3, 0.2, 0.05]), 1.2
    linear, angular = face_drag_coefficients(size, np.prod(size) / size, drag)
    assert linear == pytest.approx(0.5 * drag * np.array([0.01, 0.015, 0.06]))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        total = 0.0
        for along in (j, k):
            r = (np.arange(20_000) + 0.5) / 20_000 * size[along] - size[along] / 2
            total += np.sum(0.5 * drag * np.abs(r) ** 3) * size[i] * size[along] / 20_000
        assert angular[i] == pytest.approx(total, rel=1e-6)


# ------------------------------------------------------------------------- no free energy


def random_flow(n, seed=0, speed=2.0):
    draw = np.random.default_rng(seed)
    return (tuple(speed * draw.normal(size=(3, n))), tuple(10 * draw.normal(size=(3, n))))


def power(force, torque, v, w):
    return sum(np.asarray(a) * b for a, b in zip((*force, *torque), (*v, *w), strict=True))


def test_no_law_adds_energy():
    v, w = random_flow(2000)
    half = np.array([0.05, 0.02, 0.01])
    drag = [quadratic_drag(x, 0.7, 1.0)[0] for x in (*v, *w)]
    assert np.all(power(drag[:3], drag[3:], v, w) <= 0)
    force, torque = inertia_box(v, w, tuple(2 * half), RHO, 1e-3)
    assert np.all(power(force, torque, v, w) < 0)
    coefficients = np.array([1.0, *ELLIPSOID_COEFFICIENTS, *[1e-5] * 6])
    constants = ellipsoid_constants(half, coefficients, RHO, 1e-3)
    for carried in (False, True):
        force, torque = ellipsoid(v, w, constants, carried)
        assert np.all(power(force, torque, v, w) < 0)
    zero = (np.zeros(2000),) * 3
    for plate in (LiftDrag(), LiftDrag(a0=0.2, cda_stall=0.3, alpha_stall=0.4, cla_stall=-1.0)):
        lift = lift_drag(v, (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), 0.01, RHO, plate)
        # Lift stands across the motion: what it adds to the power is rounding.
        scale = RHO * np.square(v).sum(0) ** 1.5 * 0.01
        assert np.all(power(lift, zero, v, w) < 1e-6 * scale)


@pytest.mark.slow
@pytest.mark.parametrize("drag", ["faces", "lift_drag"])
def test_drag_takes_energy_from_a_jointed_body(drag, arm):
    """The power of the drag alone, qvel · M (a_with - a_without), in random states."""
    wet = arm_robot(world(drag=drag))
    qpos, qvel = random_states(wet, 64, speed=2.0, depth=0.0)
    change = accelerate(wet, qpos, qvel) - accelerate(arm, qpos, qvel)
    model = arm.mj_model
    data, mass = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    worked = []
    for q, v, a in zip(qpos.T, qvel.T, change.T, strict=True):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, mass)
        worked.append(v @ mass @ a)
    worked = np.array(worked)
    assert np.all(worked <= 1e-9)
    assert worked.min() < -1e-3


# ------------------------------------------------------------------------- stability


def test_absurd_speeds_slow_down():
    """100 m/s and 100 rad/s at 5 ms: explicit drag would throw the box back 40 times as fast."""
    robot = box_robot(*BRICK[:2], world(drag="faces"))
    qpos, qvel = random_states(robot, 64, speed=100.0)
    _, _, after, _ = march(robot, 1.0, qpos, qvel)
    speed = np.linalg.norm(after[:, :3], axis=1)
    assert np.all(np.diff(speed, axis=0) < 1e-12)
    assert np.all(speed[-1] < 0.1)


@pytest.mark.parametrize("share", [1.0, 0.1])
def test_absurd_speeds_with_added_mass(share):
    """Along the axes, where no Munk moment turns the box; half-dry it carries less."""
    size = BRICK[0]
    robot = box_robot(*BRICK[:2], world(buoyancy="partial", drag="faces", added_mass=True))
    qpos, qvel = at_rest(robot, 2, size[2] * (0.5 - share) - 1e-9)
    qvel[[0, 1], [0, 1]] = 1000.0
    _, _, after, _ = march(robot, 1.0, qpos, qvel)
    speed = np.linalg.norm(after[:, :3], axis=1)
    assert np.all(np.diff(speed, axis=0) < 1e-12)
    # Without the cap's share of inertia, v would fall like m / (c t).
    assert np.all(speed[-1] < 0.1 / share)


@pytest.mark.slow
def test_a_jointed_body_slows_down_from_more_than_it_can_reach():
    """3 m/s and 10 rad/s, several times what servos and weight allow, with added mass at 5 ms."""
    robot = arm_robot(world(drag="faces", added_mass=True))
    qpos, qvel = random_states(robot, 32)
    qvel[:3] *= 3.0
    qvel[3:] *= 10.0
    _, _, after, _ = march(robot, 1.0, qpos, qvel)
    assert np.all(np.isfinite(after))
    assert np.linalg.norm(after[-1, :3], axis=0).max() < 0.3


def test_a_light_plate_that_carries_twenty_times_its_mass():
    robot = box_robot((0.2, 0.1, 0.01), 0.05, world(drag="faces", added_mass=True))
    qpos, qvel = random_states(robot, 32)
    _, _, after, _ = march(robot, 1.0, qpos, qvel)
    assert np.all(np.isfinite(after))


# ------------------------------------------------------------------------- Gazebo's plate


def gazebo(v, forward, upward, area, p):
    """LiftDrag as `shared` facts state it, with acos and one plate at a time."""
    n = np.cross(forward, upward)
    n /= np.linalg.norm(n)
    speed = np.linalg.norm(v)
    sweep = 1 - (n @ v / speed) ** 2
    plane = v - (v @ n) * n
    pressure = 0.5 * RHO * plane @ plane
    angle = np.arccos(np.clip(forward @ plane / np.linalg.norm(plane), -1, 1))
    alpha = p.a0 + (angle if upward @ plane < 0 else -angle)
    while abs(alpha) > np.pi / 2:
        alpha += -np.pi if alpha > 0 else np.pi
    if alpha > p.alpha_stall:
        lift = max(0.0, p.cla * p.alpha_stall + p.cla_stall * (alpha - p.alpha_stall))
        drag = p.cda * p.alpha_stall + p.cda_stall * (alpha - p.alpha_stall)
    elif alpha < -p.alpha_stall:
        lift = min(0.0, -p.cla * p.alpha_stall + p.cla_stall * (alpha + p.alpha_stall))
        drag = -p.cda * p.alpha_stall + p.cda_stall * (alpha + p.alpha_stall)
    else:
        lift, drag = p.cla * alpha, p.cda * alpha
    up = np.cross(n, plane) / np.linalg.norm(plane)
    along = -plane / np.linalg.norm(plane)
    return area * pressure * (lift * sweep * up + abs(drag * sweep) * along)


PLATES = {
    "default": LiftDrag(),
    "stalling": LiftDrag(a0=0.0, cla=4.7, cda=0.5, alpha_stall=0.34, cla_stall=-3.8, cda_stall=2.0),
    "cambered": LiftDrag(a0=0.15, cla=3.0, cda=0.3, alpha_stall=0.5, cla_stall=-6.0, cda_stall=1.0),
}


@pytest.mark.parametrize("plate", PLATES)
def test_lift_and_drag_before_at_and_past_the_stall(plate):
    p = PLATES[plate]
    draw = np.random.default_rng(4)
    forward, upward = np.array([0.6, 0.0, 0.8]), np.array([-0.8, 0.0, 0.6])
    v = draw.normal(size=(400, 3))
    # And a sweep of the angle through zero, both stalls and both ends, without sideslip.
    sweep = np.linspace(-np.pi + 0.01, np.pi - 0.01, 201)
    v[:201] = np.outer(np.cos(sweep), forward) - np.outer(np.sin(sweep), upward)
    with jax.enable_x64(True):
        found = np.stack(
            lift_drag(tuple(jnp.asarray(v.T)), tuple(forward), tuple(upward), 0.02, RHO, p), -1
        )
    expected = np.array([gazebo(x, forward, upward, 0.02, p) for x in v])
    assert found == pytest.approx(expected, abs=1e-9 * np.abs(expected).max())


def test_plate_where_the_formula_is_0_over_0():
    """At rest, spanwise, edge on, face on, and almost spanwise: finite, and so is the gradient."""
    flows = np.array([[0, 0, 0], [0, 2, 0], [2, 0, 0], [0, 0, 2], [1e-12, 1, 0]], np.float32)

    def force(v):
        return jnp.stack(
            lift_drag((v[0], v[1], v[2]), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), 0.01, RHO, LiftDrag())
        )

    found, slope = jax.jit(jax.vmap(lambda v: (force(v), jax.jacobian(force)(v))))(flows)
    assert np.all(np.isfinite(found))
    assert np.all(np.isfinite(slope))
    # Only the flows across the plate's span push it.
    assert np.abs(found[jnp.array([0, 1, 4])]).max() < 1e-6
    # Edge on there is no angle of attack, and Gazebo's drag is zero with it.
    assert np.all(np.asarray(found[2]) == 0)


# ------------------------------------------------------------------------- MuJoCo's own laws


@lru_cache
def mujoco_model(size, shape):
    xml = f"""
    <mujoco><option density="{RHO}" viscosity="0.3" wind="0.3 -0.2 0.1" gravity="0 0 0"/>
      <worldbody><body><freejoint/>
        <geom type="box" size="{size[0] / 2} {size[1] / 2} {size[2] / 2}" mass="0.3"
              {'fluidshape="ellipsoid"' if shape else ""}/>
      </body></worldbody></mujoco>"""
    return mujoco.MjModel.from_xml_string(xml)


@pytest.mark.parametrize("size", [(0.1, 0.06, 0.03), (0.05, 0.05, 0.05), (0.02, 0.3, 0.02)])
@pytest.mark.parametrize("law", ["inertia_box", "ellipsoid"])
def test_mujoco_qfrc_passive(law, size):
    """Force and torque of one box, in random motion in a wind, to rounding of float64."""
    model = mujoco_model(size, law == "ellipsoid")
    data = mujoco.MjData(model)
    draw = np.random.default_rng(6)
    expected, flow = [], []
    for _ in range(50):
        data.qpos[3:7] = draw.normal(size=4)
        data.qvel[:] = draw.normal(size=6)
        mujoco.mj_forward(model, data)
        turn = data.xmat[1].reshape(3, 3)
        expected.append([*(turn.T @ data.qfrc_passive[:3]), *data.qfrc_passive[3:]])
        flow.append([*(turn.T @ (data.qvel[:3] - model.opt.wind)), *data.qvel[3:]])
    flow, expected = np.array(flow).T, np.array(expected).T
    with jax.enable_x64(True):
        v, w = tuple(map(jnp.asarray, flow[:3])), tuple(map(jnp.asarray, flow[3:]))
        if law == "inertia_box":
            found = inertia_box(v, w, size, RHO, 0.3)
        else:
            constants = ellipsoid_constants(np.array(size) / 2, model.geom_fluid[0], RHO, 0.3)
            found = ellipsoid(v, w, constants, True)
        found = np.concatenate([np.stack(x) for x in found])
    assert found == pytest.approx(expected, abs=1e-10 * np.abs(expected).max())


def test_a_body_that_displaces_nothing_has_the_inertia_boxs_drag():
    """Deep, with the law's whole force and torque; half in, half of them, as its box is."""
    size, mass = np.array([0.1, 0.06, 0.04]), 0.2
    robot = box_robot(tuple(size), mass, world(drag="inertia_box", buoyancy="partial"), volume=0.0)
    qpos, qvel = at_rest(robot, 3)
    qpos[2], qvel[:3], qvel[3:] = [-1.0, 0.0, 1.0], 0.3, 0.5
    found = accelerate(robot, qpos, qvel)
    viscosity = robot.world.viscosity
    rates = (np.float64(0.3),) * 3, (np.float64(0.5),) * 3
    with jax.enable_x64(True):
        force, torque = inertia_box(*rates, tuple(size), RHO, viscosity)
    share = np.array([1.0, 0.5, 0.0])
    assert found[:3] == pytest.approx(np.outer(force, share) / mass, rel=1e-9)
    own = mass / 12 * (np.sum(size**2) - size**2)
    turning = np.array(torque)[:, None] * share - np.cross(0.5 * np.ones(3), 0.5 * own)[:, None]
    assert found[3:] == pytest.approx(turning / own[:, None], rel=1e-9)
