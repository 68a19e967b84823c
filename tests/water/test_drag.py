"""Drag: falls and coasts in closed form, MuJoCo's own laws, Gazebo's plate, no free energy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from laboratory import (
    accelerate,
    arm_robot,
    at_rest,
    box_robot,
    face_drag,
    march,
    random_states,
    world,
)
from mjx_revolve.water.face_drag import face_drag_coefficients
from mjx_revolve.water.mujoco_drag import (
    ELLIPSOID,
    EllipsoidNumbers,
    ellipsoid,
    ellipsoid_numbers,
    inertia_box,
)

RHO = 999.1026
MUJOCOS_GEOM = np.array([1, *ELLIPSOID.mj_fluidcoef, *6 * [0.0]])  # without virtual mass
BRICK = ((0.041, 0.041, 0.0355), 0.0102 + 0.005, 1.07e-5)  # with 5 g of ballast, or it floats


def test_coasting_and_spinning_down():
    """Along and about each axis: v = v₀ / (1 + c v₀ t / m), and the same for ω and inertia."""
    size, mass, _ = BRICK
    tank = world(drag="faces", added_mass=True, timestep=0.001)
    robot = box_robot(size, mass, tank)
    qpos, qvel = at_rest(robot, 6, -20.0)
    qvel[np.arange(6), np.arange(6)] = [1.0, 1.0, 1.0, 20.0, 20.0, 20.0]
    time, _, after, _ = march(robot, 1.0, qpos, qvel)
    fluid, edges = robot.fluid, np.square(size)
    drag = np.concatenate([face_drag(robot).linear[0], face_drag(robot).angular[0]])
    inertia = np.concatenate([[mass] * 3, mass / 12 * (edges.sum() - edges)])
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


def test_absurd_speeds_slow_down():
    """100 m/s and 100 rad/s at 5 ms: explicit drag would throw the box back 40 times as fast."""
    robot = box_robot(*BRICK[:2], world(drag="faces"))
    qpos, qvel = random_states(robot, 64, speed=100.0)
    _, _, after, _ = march(robot, 1.0, qpos, qvel)
    speed = np.linalg.norm(after[:, :3], axis=1)
    assert np.all(np.diff(speed, axis=0) < 1e-12)
    assert np.all(speed[-1] < 0.1)


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


def test_a_shell_with_all_its_mass_in_the_middle_comes_to_rest():
    robot = box_robot((0.1,) * 3, 0.002, world(drag="faces", timestep=0.01), ballast_mass=0.3)
    qpos, qvel = at_rest(robot, 1, -20.0)
    qvel[:, 0] = 0.3, 0.1, 0.0, 5.0, 1.5, 1.0
    speeds = march(robot, 0.5, qpos, qvel)[2]
    assert np.abs(speeds).max() < 5.1 and np.abs(speeds[-1, 3:]).max() < 0.1


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


def test_the_ellipsoids_drag_acts_in_the_middle_of_the_step():
    """A coasting cube: v = v₀ / (1 + c v₀ t / m); twice the step, four times the error."""
    side, mass, speed = 0.04, 0.064, 0.5
    numbers = ellipsoid_numbers(np.full(3, side / 2), MUJOCOS_GEOM, RHO, 0.0)
    drag, errors = numbers.blunt + numbers.slender, []
    for step in (0.02, 0.01):
        tank = world(drag="ellipsoid", added_mass=False, viscosity=0.0, timestep=step)
        robot = box_robot((side,) * 3, mass, tank)
        qpos, qvel = at_rest(robot, 1, -20.0)
        qvel[1] = speed
        time, _, after, _ = march(robot, 2.0, qpos, qvel)
        expected = speed / (1 + drag * speed / mass * time)
        errors.append(np.abs(after[:, 1, 0] / expected - 1).max())
    assert errors[1] < 3e-3
    assert 3 < errors[0] / errors[1] < 5


@pytest.mark.parametrize("half", [(0.02, 0.02, 0.03), (0.05, 0.03, 0.001), (0.1, 0.01, 0.01)])
def test_the_bound_of_the_ellipsoids_step_is_never_less_than_the_slope(half):
    """Of -∂F/∂v over |v|, from every side and nearly along the part."""
    numbers = ellipsoid_numbers(np.array(half), MUJOCOS_GEOM, RHO, 0.0)
    flat = {k: tuple(x) if np.ndim(x) else x for k, x in vars(numbers).items()}
    still = (0.0, 0.0, 0.0)

    def force(v):
        return jnp.stack(ellipsoid(tuple(v), still, EllipsoidNumbers(**flat), False)[0])

    draw = np.random.default_rng(0).normal(size=(3000, 3))
    draw[1000:] *= np.random.default_rng(1).choice([1.0, 0.1, 1e-3], (2000, 3))
    draw /= np.linalg.norm(draw, axis=1)[:, None]
    with jax.enable_x64(True):
        slope = -np.asarray(jax.vmap(jax.jacobian(force))(jnp.asarray(draw)))
    steepest = np.linalg.eigvalsh((slope + slope.transpose(0, 2, 1)) / 2)[:, -1].max()
    assert 0.2 < steepest / (RHO * ELLIPSOID.steepest(numbers)) <= 1


def test_the_ellipsoids_gradient_is_finite_at_rest():
    numbers = ellipsoid_numbers(
        np.array([0.1, 0.05, 0.03]), np.array([1, 0.5, 0.25, 1.5, 1, 1] + 6 * [0.1]), RHO, 1e-3
    )
    rows = {name: np.float32(x) for name, x in vars(numbers).items()}
    numbers = EllipsoidNumbers(**{k: tuple(x) if np.ndim(x) else x for k, x in rows.items()})
    still = (jnp.zeros(()),) * 3
    found = jax.jacobian(lambda v, w: ellipsoid(v, w, numbers, True), (0, 1))(still, still)
    assert np.isfinite(np.array(jax.tree.leaves(found))).all()
