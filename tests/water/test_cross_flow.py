"""Chains and rods: oblique flow, turning, friction, wakes; what is compact has its faces' drag."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from laboratory import accelerate, at_rest, box_robot, read, world
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.numerics.inertia import apply_inertia
from mjx_revolve.numerics.spatial import dot
from mjx_revolve.water.cross_flow import CROSS_FLOW, chain_shares
from mjx_revolve.water.laws import PartFlow, as_components
from mjx_revolve.water.world import load_world

WATER = world(drag="cross_flow")
SIZE = np.array([0.2, 0.1, 0.06])  # [m]


def chain_numbers(end=0.0, water=WATER):
    """Of a part in a slender row along x, with neighbours at both ends or at all but one."""
    parts = SimpleNamespace(
        half_size=SIZE[None] / 2, silhouette=(SIZE.prod() / SIZE)[None],
        exposed=np.array([[abs(end) / 2, 1.0, 1.0]]), joined=np.array([[1.0, 0.0, 0.0]]),
        ends=np.array([[end, 0.0, 0.0]]), rows=np.array([[2.0, 0.1, 0.06]]),
        coefficients={"drag_coefficient": np.full((1, 3), 1.05), "friction": np.array([0.455])},
    )  # fmt: skip
    return as_components(jax.tree.map(lambda x: x[0], CROSS_FLOW.numbers(parts, water)))


@pytest.fixture(scope="module")
def inside():
    return chain_numbers()


@pytest.fixture(scope="module")
def tail():
    """It ends towards -x."""
    return chain_numbers(-1.0)


def drag_at(numbers, velocity, turning=(0.0, 0.0, 0.0)):
    with jax.enable_x64(True):
        flow = PartFlow(*(tuple(map(jnp.asarray, x)) for x in (velocity, turning)), 1.0)
        return jax.tree.map(np.asarray, CROSS_FLOW.force(flow, numbers, WATER))


def shares_of(parts):
    """c of each part."""
    return chain_shares(parts)[1][:, 0].tolist()


def spin(numbers, axis, rate):
    """Torque about an axis of a part that only turns, with that of `angular`."""
    turning = rate * np.eye(3)[axis]
    own = drag_at(numbers, np.zeros(3), turning).torque[axis]
    return own - numbers.angular[axis] * abs(rate) * rate


@pytest.mark.parametrize("size", [(0.2, 0.1, 0.06), (0.1, 0.1, 0.1)])
def test_a_compact_part_has_the_drag_of_its_faces_by_default(size):
    waters = load_world("lake", drag="faces"), load_world("lake")
    robots = [box_robot(size, 1.2, water) for water in waters]
    qpos, qvel = at_rest(robots[0], 1, -5.0)
    qvel[:6, 0] = [0.3, -0.2, 0.1, 0.5, 0.2, -0.4]
    found = [accelerate(robot, qpos, qvel) for robot in robots]
    assert found[1] == pytest.approx(found[0], rel=1e-12)


def test_a_lone_rod_is_a_chain_that_sheds_nothing():
    """In oblique flow, along it, spinning about its middle; in between, some of it."""
    rod, shorter = (box_robot((x, 0.1, 0.1), 1000 * x * 0.01, WATER) for x in (1.0, 0.1 / 0.3))
    assert shares_of(rod.fluid) == [1.0]
    numbers = CROSS_FLOW.numbers(rod.fluid, WATER)
    assert np.abs(numbers.along).tolist() == [[1, 0, 0]]
    assert not numbers.shed.any()
    numbers = as_components(jax.tree.map(lambda x: x[0], numbers))
    across = drag_at(numbers, [0.0, 0.3, 0.4]).force
    assert across == pytest.approx(
        -0.5 * WATER.density * 1.75 * 0.1 * 0.5 * np.array([0, 0.3, 0.4])
    )
    assert spin(numbers, 2, 5.0) == pytest.approx(-WATER.density * 1.75 * 0.1 / 64 * 25, rel=1e-4)
    assert shares_of(shorter.fluid) == pytest.approx([0.5])


def test_a_chain_in_oblique_flow_meets_all_of_the_velocity_across_it(inside):
    scale = 0.5 * WATER.density * 1.75 * SIZE[0] * 0.5
    for angle in np.radians([0, 30, 45, 90]):
        velocity = 0.5 * np.array([0, np.cos(angle), np.sin(angle)])
        expected = -scale * SIZE[[0, 2, 1]] * velocity  # each face by its height
        assert drag_at(inside, velocity).force == pytest.approx(expected, rel=1e-9)


def test_along_it_there_is_friction_only(inside):
    speed = 0.5
    reynolds = WATER.density * speed * SIZE[0] / WATER.viscosity
    friction = 0.455 / np.log10(reynolds) ** 2.58
    wet = 2 * SIZE[0] * (SIZE[1] + SIZE[2])
    expected = -0.5 * WATER.density * friction * wet * speed**2
    assert drag_at(inside, [speed, 0, 0]).force == pytest.approx([expected, 0, 0], rel=4e-3)


@pytest.mark.parametrize("none", ["density", "viscosity"])
def test_without_water_or_its_viscosity_there_is_no_friction(none):
    assert chain_numbers(water=world(drag="cross_flow", **{none: 0.0})).friction == 0


def test_a_spinning_rod_is_dragged_by_its_strips(inside):
    expected = -WATER.density * 1.75 * SIZE[1] * SIZE[0] ** 4 / 64 * 25.0
    assert spin(inside, 1, 5.0) == pytest.approx(expected, rel=1e-9)
    drag = drag_at(inside, [0.0, 0, 0], [0, 5.0, 0])
    assert drag.torque[::2] == pytest.approx([0, 0], abs=1e-12)
    assert drag.force == pytest.approx([0, 0, 0], abs=1e-12)


@pytest.mark.parametrize(
    ("speed", "force_error", "torque_error"),
    [(0.2, 0.16, 0.1), (1.0, 1e-3, 0.1), (3.0, 1e-3, 0.04)],
)
def test_two_strips_stand_for_all(inside, speed, force_error, torque_error):
    """Beside the integral over a chain that moves across at `speed` times what its ends turn by."""
    rate, half = 5.0, SIZE[0] / 2
    s = (np.arange(10000) + 0.5) / 5000 - 1
    v = (speed - s) * rate * half  # of strips at s: ω × x points to -z for positive s
    each = 0.5 * WATER.density * 1.75 * SIZE[1] * np.abs(v) * v * half * 2 / len(s)
    drag = drag_at(inside, [0.0, 0, speed * rate * half], [0, rate, 0])
    assert drag.force[2] == pytest.approx(-each.sum(), rel=force_error)
    torque = drag.torque[1] - inside.angular[1] * rate**2
    assert torque == pytest.approx((each * s * half).sum(), rel=torque_error)


def shed_at(tail, velocity, turning=None):
    """Force and torque of the wake alone."""
    turning = np.zeros_like(velocity) if turning is None else turning
    none = replace(tail, shed=(0.0, 0.0, 0.0))
    one, other = drag_at(tail, velocity, turning), drag_at(none, velocity, turning)
    pairs = ((one.force, other.force), (one.torque, other.torque))
    wide = [[a - b + 0 * velocity[0] for a, b in zip(*pair, strict=True)] for pair in pairs]
    return np.array(wide[0]), np.array(wide[1])


def test_a_waving_plate_has_lighthills_mean_thrust(tail):
    """½ m (mean ẏ² - U² mean y_x²) for small waves; the fade takes a hundredth of it."""
    phase = 2 * np.pi * np.arange(64) / 64
    ahead, heave, slope = 0.5, 0.05 * np.cos(phase), 0.06 * np.sin(phase + 0.5)
    c, s = np.cos(slope), np.sin(slope)
    velocity = np.array([c * ahead + s * heave, c * heave - s * ahead, 0 * phase])
    force, torque = shed_at(tail, velocity)
    m = 0.5 * np.pi / 4 * WATER.density * SIZE[2] ** 2
    expected = m / 2 * (np.mean(heave**2) - ahead**2 * np.mean(slope**2))
    assert np.mean(c * force[0] - s * force[1]) == pytest.approx(expected, rel=0.015)
    assert torque == pytest.approx(np.cross([-SIZE[0] / 2, 0, 0], force.T).T, abs=1e-12)


def test_only_an_end_that_trails_sheds_momentum_and_does_no_work(tail, inside):
    v = np.random.default_rng(1).normal(size=(3, 100))
    w = 5 * np.random.default_rng(2).normal(size=(3, 100))
    force, torque = shed_at(tail, v, w)
    at = v + np.cross(w.T, [-SIZE[0] / 2, 0, 0]).T
    assert np.all((np.abs(force).max(0) > 0) == (at[0] > 0))
    assert np.all(np.sum(force * v, 0) + np.sum(torque * w, 0) <= 1e-9)
    force, _ = shed_at(inside, v, w)
    assert np.all(force == 0)
    slowly, _ = shed_at(tail, np.array([1e-9, 0.5, 0.0]))
    assert np.abs(slowly).max() < 1e-9  # no jump where it turns from leading to trailing


def test_rows_are_found_in_the_body():
    text = (
        "body: {type: Core, children: {1: {type: FixedBrick, children: {1: {type: FixedBrick}}}}}"
    )
    table = build_robot(read(text), WATER).fluid
    edges = 2 * table.half_size
    assert table.ends.tolist() == [[0, -1, 0], [0, 0, 0], [0, 1, 0]]
    rows = edges.copy()
    rows[:, 1] = edges[:, 1].sum()
    assert table.rows == pytest.approx(rows)
    # The row is twice as long as the core is high, and four times as long as the bricks are.
    numbers = CROSS_FLOW.numbers(table, WATER)
    share = 2 - edges[1, 0] / rows[1, 1] / 0.2
    assert shares_of(table) == pytest.approx([0, share, share])
    assert np.abs(numbers.along[1:]).tolist() == [[0, 1, 0]] * 2
    shed = share * 0.5 * np.pi / 4 * WATER.density * edges[2, 0] ** 2
    assert numbers.shed[:, 2] == pytest.approx([0, 0, shed])


def test_its_work_is_never_positive_and_its_damping_is_at_least_half_of_it(inside, tail):
    """Of a force -D ν, D from |ν|, a step is stable for any damping of D / 2 or more."""
    v, w = np.random.default_rng(0).normal(size=(2, 3, 100))
    for numbers in (inside, tail):
        drag = drag_at(numbers, v, 5 * w)
        work = dot(drag.force, v) + dot(drag.torque, 5 * w)
        assert np.all(work <= 0)
        torque, force = apply_inertia(drag.damping, tuple(5 * w), tuple(v))
        assert np.all(dot(force, v) + dot(torque, 5 * w) >= -0.5 * work)
        # What moves without turning is met in full.
        drag = drag_at(replace(numbers, shed=(0.0, 0.0, 0.0)), v)
        found = np.array(apply_inertia(drag.damping, (0.0,) * 3, tuple(v))[1])
        assert found == pytest.approx(-np.array(drag.force), rel=1e-12)


@pytest.mark.slow
def test_gradients_are_finite(tail):
    def total(v):
        flow = PartFlow(tuple(v[:3]), tuple(v[3:]), 1.0)
        return sum(x for part in CROSS_FLOW.force(flow, tail, WATER)[:2] for x in part)

    for v in (jnp.zeros(6), jnp.arange(6.0)):
        assert np.isfinite(jax.grad(total)(v)).all()
