"""Gazebo's LiftDrag: against its source, by hand at chosen angles, its limits and its step."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from laboratory import accelerate, at_rest, box_robot, check_refused, face_drag, march, read, world
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.water.lift_drag import (
    LIFT_DRAG,
    LiftDrag,
    lift_drag,
    lift_drag_damping,
    lift_drag_wrench,
    plate_numbers,
)

RHO, AREA = 999.1026, 0.02
X, Y, Z = np.eye(3)
PLATES = {
    "default": LiftDrag(),
    "stalling": LiftDrag(cla=4.7, cda=0.5, alpha_stall=0.34, cla_stall=-3.8, cda_stall=2.0),
    "cambered": LiftDrag(a0=0.15, cla=3.0, cda=0.3, alpha_stall=0.5, cla_stall=-6.0),
    "turning": LiftDrag(cda=0.2, alpha_stall=0.5, cma=0.4, cma_stall=-0.3),
    "odd": LiftDrag(a0=-0.4, cla=2.0, cda=-0.3, alpha_stall=0.6, cla_stall=1.0, cda_stall=-0.8),
    "round": LiftDrag(cla=0.8, cda=0.3, alpha_stall=0.5, cma=0.3, radial_symmetry=True),
}


def wrench(v, p, forward=X, upward=Z, area=AREA, dtype=jnp.float64):
    """Force and moment `[3, n]` of one plate in flows `[3, n]`, or `[3]` each in one flow."""
    with jax.enable_x64(dtype == jnp.float64):
        v = tuple(jnp.asarray(x, dtype) for x in v)
        found = lift_drag_wrench(v, tuple(forward), tuple(upward), area, RHO, p)
        return tuple(np.stack([np.broadcast_to(x, v[0].shape) for x in w]) for w in found)


def flow(alpha, speed=1.0, sideways=0.0, forward=X, upward=Z):
    """Velocities `[3, n]` at angles of attack, a0 aside."""
    alpha = np.atleast_1d(alpha)
    side = np.cross(forward, upward)
    ahead, below = np.outer(forward, np.cos(alpha)), np.outer(upward, np.sin(alpha))
    return speed * (ahead - below) + np.outer(side, sideways * np.ones_like(alpha))


def unit(x):
    """`Vector3::Normalize`, which leaves a zero vector as it is."""
    length = np.linalg.norm(x)
    return x / length if length else x


def gazebo(v, p, forward, upward, area, quirk=""):
    """One plate, step by step as gz-sim's `LiftDragPrivate::Update` has it.

    Quirks are what the package departs from: "classic" the projection of Gazebo classic, "ahead" no
    force from behind, "moment" the one-sided limits of the moment.
    """
    if np.linalg.norm(v) <= 0.01:
        return np.zeros(3), np.zeros(3)
    if quirk == "ahead" and forward @ v <= 0:
        return np.zeros(3), np.zeros(3)
    vel_i = unit(v)
    if p.radial_symmetry:
        upward = unit(np.cross(forward, np.cross(forward, vel_i)))
    spanwise = unit(np.cross(forward, upward))
    sin_sweep = np.clip(spanwise @ vel_i, -1, 1)
    cos2_sweep = 1 - sin_sweep**2
    in_plane = v - (v @ spanwise) * (vel_i if quirk == "classic" else spanwise)
    drag_direction, lift_direction = -unit(in_plane), unit(np.cross(spanwise, in_plane))
    angle = math.acos(np.clip(lift_direction @ upward, -1, 1))
    alpha = p.a0 + angle if lift_direction @ forward >= 0 else p.a0 - angle
    while abs(alpha) > 0.5 * math.pi:
        alpha += -math.pi if alpha > 0 else math.pi
    q = 0.5 * RHO * (in_plane @ in_plane)

    def coefficient(slope, stalled, limited):
        if alpha > p.alpha_stall:
            c = (slope * p.alpha_stall + stalled * (alpha - p.alpha_stall)) * cos2_sweep
            return max(0.0, c) if limited else c
        if alpha < -p.alpha_stall:
            c = (-slope * p.alpha_stall + stalled * (alpha + p.alpha_stall)) * cos2_sweep
            return min(0.0, c) if limited else c
        return slope * alpha * cos2_sweep

    cl = coefficient(p.cla, p.cla_stall, True)
    cd = abs(coefficient(p.cda, p.cda_stall, False))
    cm = coefficient(p.cma, p.cma_stall, p.cma >= 0 or quirk == "moment")
    force = cl * q * area * lift_direction + cd * q * area * drag_direction
    return force, cm * q * area * spanwise


@pytest.mark.parametrize("plate", PLATES)
def test_against_gz_sim_over_random_flows(plate):
    """Any direction of flow, any attitude of the plate, speeds from 0.1 to 10 m/s."""
    p, draw = PLATES[plate], np.random.default_rng(1)
    v = draw.normal(size=(3, 300)) * 10 ** draw.uniform(-1, 1, 300)
    forward, upward = Rotation.random(random_state=5).as_matrix()[:, [0, 2]].T
    v[:, :100] = flow(np.linspace(-3.1, 3.1, 100), forward=forward, upward=upward)
    found = wrench(v, p, forward, upward)
    expected = np.array([gazebo(x, p, forward, upward, AREA) for x in v.T]).transpose(1, 2, 0)
    scale = RHO * AREA * np.square(v).sum(0)
    for a, b in zip(found, expected, strict=True):
        assert a / scale == pytest.approx(b / scale, abs=1e-12)
    assert np.any(found[1]) == (p.cma != 0)


def test_named_departures():
    """Each quirk named in the file's head shows, and shows nothing where it should not."""
    p = PLATES["stalling"]
    side = np.array([1.0, 0.7, -0.2])
    for v, quirk in ((side, "classic"), (-X - 0.3 * Z, "ahead")):
        ours = wrench(v, p)[0]
        assert ours == pytest.approx(gazebo(v, p, X, Z, AREA)[0], abs=1e-12)
        assert np.linalg.norm(ours - gazebo(v, p, X, Z, AREA, quirk)[0]) > 0.1
        ahead = np.array([1.0, 0.0, -0.2])
        assert wrench(ahead, p)[0] == pytest.approx(gazebo(ahead, p, X, Z, AREA, quirk)[0])
    # Classic's flow is |v| (1 - sin sweep): swimming left and right differ.
    left, right = (gazebo(side * [1, s, 1], p, X, Z, AREA, "classic")[0] for s in (1, -1))
    assert np.linalg.norm(left) / np.linalg.norm(right) > 3
    left, right = (np.linalg.norm(wrench(side * [1, s, 1], p)[0]) for s in (1, -1))
    assert left == pytest.approx(right)
    # A stable plate keeps its moment past the stall; in gz-sim it vanishes at once.
    stable = LiftDrag(cma=-0.4, alpha_stall=0.3)
    v = flow(0.31)[:, 0]
    assert gazebo(v, stable, X, Z, AREA, "moment")[1] == pytest.approx(0)
    assert wrench(v, stable)[1][1] == pytest.approx(0.5 * RHO * AREA * 0.4 * 0.3)
    # Along the axis of a body of revolution.
    along, broadside = PLATES["round"], gazebo(Z, PLATES["round"], X, Z, AREA)[0]
    assert wrench(X, along)[0] == pytest.approx(np.zeros(3))
    theirs = np.linalg.norm(gazebo(X, along, X, Z, AREA)[0])
    assert theirs == pytest.approx(abs(broadside[2]), rel=1e-6)


def jacobian(v, p):
    def force(v):
        return jnp.stack(lift_drag((v[0], v[1], v[2]), tuple(X), tuple(Z), AREA, RHO, p))

    with jax.enable_x64(True):
        return np.asarray(jax.jit(jax.vmap(jax.jacobian(force)))(jnp.asarray(v.T)))


def test_the_bound_of_the_step_is_that_of_the_plate_not_of_its_box():
    plate = LiftDrag(area=0.03, cla=9.0, cda=3.0)
    half, none = np.full((1, 3), 0.01), np.zeros((1, 3))
    numbers = plate_numbers([plate], half, 4 * half**2, none, RHO)
    damping = lift_drag_damping((jnp.ones(1), 0.0, 0.0), tuple(X), tuple(Z), 0.03, RHO, plate)
    assert RHO * LIFT_DRAG.steepest(numbers) == pytest.approx(np.asarray(damping))


@pytest.mark.parametrize("plate", ["default", "stalling", "cambered", "turning"])
def test_damping_is_never_less_than_the_slope(plate):
    """-∂F/∂v along any direction, where the force has a slope: away from the jump at ±90°."""
    p = PLATES[plate]
    v = np.random.default_rng(9).normal(size=(3, 3000))
    slope = -jacobian(v, p)
    steepest = np.linalg.eigvalsh((slope + slope.transpose(0, 2, 1)) / 2)[:, -1]
    with jax.enable_x64(True):
        flows = tuple(jnp.asarray(v))
        bound = np.asarray(lift_drag_damping(flows, tuple(X), tuple(Z), AREA, RHO, p))
    assert np.all(bound >= 0)
    assert np.max(steepest / bound) <= 1


@pytest.mark.parametrize("plate", PLATES)
def test_slopes_against_finite_differences(plate):
    """In random flows; kinks, at the stall, are too thin for them to hit."""
    p, v, h = PLATES[plate], np.random.default_rng(10).normal(size=(3, 100)), 1e-6
    found = jacobian(v, p)
    for i in range(3):
        ahead, behind = (wrench(v + s * h * np.eye(3)[:, i, None], p)[0] for s in (1, -1))
        expected = (ahead - behind) / (2 * h)
        assert np.abs(found[:, :, i].T - expected).max() < 1e-5 * np.abs(expected).max()


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("plate", PLATES)
def test_finite_everywhere(plate, dtype):
    """At rest, spanwise, along ±forward and ±upward, at both stalls, and a hair beside each."""
    p = PLATES[plate]
    stalls = flow([p.alpha_stall, -p.alpha_stall], sideways=0.5)
    exact = np.hstack([np.zeros((3, 1)), np.eye(3), -np.eye(3), stalls])
    hairs = [1e-30, 1e-20, 1e-12, 1e-6]
    near = [exact + h * np.array([[1], [-2], [3]]) for h in hairs]
    beside = np.hstack([exact, *near, *(h * exact for h in hairs)])

    def both(v):
        force, moment = lift_drag_wrench((v[0], v[1], v[2]), tuple(X), tuple(Z), AREA, RHO, p)
        damping = lift_drag_damping((v[0], v[1], v[2]), tuple(X), tuple(Z), AREA, RHO, p)
        return jnp.stack([jnp.asarray(x, v.dtype) for x in (*force, *moment, damping)])

    with jax.enable_x64(dtype == jnp.float64):
        flows = jnp.asarray(beside.T, dtype)
        backward = jax.grad(lambda v: jnp.sum(both(v)))
        run = jax.jit(jax.vmap(lambda v: (both(v), jax.jacfwd(both)(v), backward(v))))
        value, *slopes = run(flows)
    assert value.dtype == dtype
    for x in (value, *slopes):
        assert np.all(np.isfinite(x))
    bound = 20 * RHO * AREA * np.square(beside).sum(0) + 1e-30
    assert (np.abs(value[:, :3]).T / bound).max() <= 1
    assert np.abs(value[0]).max() == 0  # at rest
    if plate != "round":
        assert np.abs(value[2, :6]).max() == 0  # along the span


BAD = [
    ({"cma": math.nan}, "lift_drag: cma: expected a number [m/rad]; found nan"),
    ({"alpha_stall": 2.0}, "and <= 1.5708 [rad]; found 2"),
    ({"cp": "abc"}, "lift_drag: cp: expected three numbers [m], or nothing; found 'abc'"),
    ({"forward": (1, 0, 0)}, "lift_drag: expected both forward and upward, or neither; found one"),
    (
        {"forward": (1, 0, 0), "upward": (1, 0, 1)},
        "lift_drag: upward: expected a vector perpendicular",
    ),
]


@pytest.mark.parametrize(("fields", "message"), BAD, ids=[str(f)[:40] for f, _ in BAD])
def test_wrong_parameters(fields, message):
    check_refused(message, LiftDrag, **fields)


SIZE, MASS = (0.1, 0.06, 0.004), 0.1
INERTIA = MASS / 12 * (np.sum(np.square(SIZE)) - np.square(SIZE))


def fin(p, **fields):
    return box_robot(SIZE, MASS, world(drag="faces", **fields), lift_drag=p)


def test_centre_of_pressure():
    """Force at cp, with the velocity of cp: m a = F, I α = cp × F (- ω × I ω) + moment + drag.

    The plugin has no drag against turning; the faces' angular drag stands in for it.
    """
    cp = np.array([0.03, 0.01, 0.0])
    p = LiftDrag(cla=2.0, cda=0.4, cma=0.1, cp=tuple(cp), forward=(1, 0, 0), upward=(0, 0, 1))
    robot = fin(p)
    draw = np.random.default_rng(11)
    qpos, qvel = at_rest(robot, 20, -5.0)
    qvel[:] = draw.normal(size=qvel.shape)
    found = accelerate(robot, qpos, qvel)
    v, w = qvel[:3], qvel[3:]
    force, moment = wrench(v + np.cross(w, cp, 0, 0, 0), p, area=SIZE[0] * SIZE[1])
    spin = INERTIA[:, None] * w
    torque = moment + np.cross(cp, force, 0, 0, 0) - np.cross(w, spin, 0, 0, 0)
    torque -= face_drag(robot).angular[0][:, None] * np.abs(w) * w
    assert found[:3] == pytest.approx(force / MASS, rel=1e-9, abs=1e-9)
    assert found[3:] == pytest.approx(torque / INERTIA[:, None], rel=1e-9, abs=1e-8)


@pytest.mark.parametrize(
    "p",
    [LiftDrag(area=0.5, density=500.0), LiftDrag(cla=3.0, radial_symmetry=True)],
    ids=["density", "radial"],
)
def test_own_density_area_and_symmetry_reach_the_step(p):
    robot = fin(p)
    qpos, qvel = at_rest(robot, 20, -5.0)
    qvel[:3] = np.random.default_rng(12).normal(size=(3, 20))
    force = wrench(qvel[:3], p, area=p.area or SIZE[0] * SIZE[1])[0]
    assert accelerate(robot, qpos, qvel)[:3] == pytest.approx(force / MASS, rel=1e-9, abs=1e-9)


def test_a_radial_plate_stands_beside_fins_but_has_no_wake():
    radial = "{type: Fin, params: {lift_drag: {radial_symmetry: true}%s}}"
    text = f"body: {{type: Core, children: {{0: {radial}, 1: {{type: Fin}}}}}}"
    tank = world(drag="cross_flow")
    build_robot(read(text % ""), tank).fluid  # noqa: B018
    with pytest.raises(InputError, match="radial_symmetry: expected false with drag: fin_wake"):
        build_robot(read(text % ", drag: fin_wake"), tank).fluid  # noqa: B018


def test_plate_drifts_to_the_current():
    """Across the flow: m dv/dt = ½ ρ A C_d (u - v)² with C_d = cda π / 2, so a hyperbola."""
    current, cda = 0.5, 0.7
    p = LiftDrag(cla=0.0, cda=cda)
    robot = fin(p, current=(0.0, 0.0, current), timestep=0.001)
    qpos, qvel = at_rest(robot, 1, -50.0)
    time, _, qvel, _ = march(robot, 1.0, qpos, qvel)
    tau = 2 * MASS / (RHO * SIZE[0] * SIZE[1] * cda * math.pi / 2 * current)
    assert qvel[:, 2, 0] == pytest.approx(current * (1 - 1 / (1 + time / tau)), abs=0.01 * current)


# An ordinary flat plate: lift gone at 90°.
FLAT = LiftDrag(
    cla=4.7, cda=0.5, alpha_stall=0.34, cla_stall=-4.7 * 0.34 / (math.pi / 2 - 0.34), cda_stall=0.8
)


@pytest.mark.parametrize("mass", [0.001, 0.1])
def test_stiff_fin_does_not_blow_up(mass):
    """dt ρ A |v| cla / m is 700 for a fin of 1 g at 5 m/s; explicit steps bear 2."""
    robot = box_robot(SIZE, mass, world(drag="faces"), lift_drag=FLAT)
    qpos, qvel = at_rest(robot, 32, -50.0)
    qvel[:3] = np.random.default_rng(13).normal(size=(3, 32)) * 3.0
    after = march(robot, 1.0, qpos, qvel)[2]
    speed = np.linalg.norm(np.concatenate([qvel[None, :3], after[:, :3]]), axis=1)
    assert np.all(np.diff(speed, axis=0) < 1e-9)
