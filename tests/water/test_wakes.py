"""Laws that remember: plates that swing, fins whose lift lags behind their angle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special

from laboratory import at_rest, batch_engine, box_robot, march, read, world
from mjx_revolve.body.catalogue import MODULES
from mjx_revolve.body.module_files import read_modules
from mjx_revolve.body.morphology import make_morphology
from mjx_revolve.engine.batch import fit_capacity
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.inputs.yaml_reader import parse_yaml
from mjx_revolve.numerics.spatial import dot
from mjx_revolve.water.cross_flow import CROSS_FLOW
from mjx_revolve.water.fin_wake import FIN_WAKE
from mjx_revolve.water.flow import water_of
from mjx_revolve.water.laws import PartFlow, as_components
from mjx_revolve.water.lift_drag import LIFT_DRAG
from mjx_revolve.water.plate_wake import PLATE_WAKE, thinness

WATER = world(drag="cross_flow")
PLATE = (0.004, 0.2, 0.1)  # [m], across x
pytestmark = pytest.mark.usefixtures("float64")


def modules(text):
    """Module types from text, beside the catalogue's."""
    return MODULES | read_modules(parse_yaml(text.encode(), "modules.yaml"), MODULES)


def numbers_of(law, robot, part=0):
    return as_components(jax.tree.map(lambda x: x[part], law.numbers(robot.fluid, robot.world)))


@pytest.fixture(scope="module")
def plate():
    robot = box_robot(PLATE, 0.1, WATER)
    assert robot.fluid.drag == ("plate_wake",)
    return numbers_of(PLATE_WAKE, robot)


@pytest.fixture(scope="module")
def fin():
    robot = build_robot(read("body: {type: Core, children: {0: {type: Fin}}}"), WATER)
    assert robot.fluid.drag[1] == "fin_wake"
    return numbers_of(FIN_WAKE, robot, 1)


def past(law, numbers, velocities, dt, submerged=1.0):
    """What a law remembers after steps of velocities `[T, 3]` of a part that does not turn."""
    still = (jnp.zeros(()),) * 3

    def step(memory, v):
        flow = PartFlow((v[0], v[1], v[2]), still, submerged, memory)
        return law.remember(flow, numbers, WATER, dt), (memory, law.force(flow, numbers, WATER)[0])

    first = (jnp.zeros(()),) * law.memory
    return jax.lax.scan(step, first, jnp.asarray(velocities))


def test_the_least_motion_changes_neither_force_nor_gradient():
    """Share and reach of the wake are ratios, which what turns about its middle has not."""
    slat = numbers_of(PLATE_WAKE, box_robot((0.002, 0.03, 0.3), 0.5, WATER))
    law = lambda memory, *v: PLATE_WAKE.force(PartFlow(*v, 1.0, memory), slat, WATER)  # noqa: E731
    spin, side = (0.0, 3.0, 0.0), jnp.array((0, 0.2, 0))
    still, little = (0.0,) * 4, (1e-9, 0.0, 0.0)
    moved, _ = past(PLATE_WAKE, slat, [little] * 50, 0.005)
    expected = law(still, (0.0,) * 3, spin).torque[1]
    np.testing.assert_allclose(law(moved, little, spin).torque[1], expected, rtol=1e-6)
    gradient = jax.jacfwd(lambda v: law(still, tuple(v), (0.0,) * 3).force[0])(side)
    begun, _ = past(PLATE_WAKE, slat, [little], 1e-6)
    found = law(begun, (1e-9, 0.2, 0.0), (0.0,) * 3).force[0] / 1e-9
    np.testing.assert_allclose(gradient[0], found, rtol=1e-4)


def test_thin_parts_alone_are_plates():
    assert thinness([0.004, 0.2, 0.1]) == 1.0
    assert thinness([0.1, 0.015, 0.2]) == pytest.approx(0.5)
    assert thinness([0.1, 0.021, 0.2]) == thinness([0.1, 0.1, 0.1]) == 0.0
    box = box_robot((0.06, 0.2, 0.1), 0.1, WATER)
    own = box_robot(PLATE, 0.1, WATER, drag="faces")
    assert box.fluid.drag == ("cross_flow",) and own.fluid.drag == ("faces",)
    assert box_robot(PLATE, 0.1, world(drag="faces")).fluid.drag == ("faces",)
    # A box that names the law has that of chains.
    flow = PartFlow((0.3, -0.2, 0.1), (1.0, 2.0, 3.0), 1.0, (0.1, 0.02, 0.001, 0.01))
    found = PLATE_WAKE.force(flow, numbers_of(PLATE_WAKE, box), WATER)
    expected = CROSS_FLOW.force(flow, numbers_of(CROSS_FLOW, box), WATER)
    np.testing.assert_allclose(found.force, expected.force, rtol=1e-12)
    np.testing.assert_allclose(found.torque, expected.torque, rtol=1e-12)


def test_a_steady_plate_has_the_drag_of_its_aspect_ratio(plate):
    speed, area = 0.5, 0.02
    _, (_, force) = past(PLATE_WAKE, plate, np.tile([speed, 0, 0], (4000, 1)), 0.01)
    scale = 0.5 * WATER.density * area * speed**2
    assert -force[0][-1] / scale == pytest.approx(1.17 + 0.02, rel=1e-6)
    # Along it, and at the first moment of a motion, nothing is remembered.
    assert -force[0][0] / scale == pytest.approx(1.19, rel=1e-12)
    # Swung back and forth before, it is dragged more.
    assert -force[0][1] / scale > 2.0
    long = box_robot((0.002, 10.0, 0.1), 0.1, WATER)
    flow, numbers = PartFlow((1.0, 0.0, 0.0), (0.0,) * 3, 1.0), numbers_of(PLATE_WAKE, long)
    ends = PLATE_WAKE.force(flow, numbers, WATER).force
    assert -ends[0] / (0.5 * WATER.density) == pytest.approx(1.98, rel=1e-6)


@pytest.mark.parametrize("number", [4.0, 40.0])
def test_a_swinging_plate_has_the_drag_of_ikedas_fit_and_its_work(number, plate):
    """C_d and work per cycle over KC, at another speed and size than in `experiments.measured`."""
    period, dt = 0.8, 0.002
    speed = number * 0.1 / period
    time = dt * np.arange(round(16 * period / dt))
    v = speed * np.sin(2 * np.pi * time / period)
    _, (_, force) = past(PLATE_WAKE, plate, np.stack([v, 0 * v, 0 * v], 1), dt)
    last = time >= time[-1] + dt - 2 * period
    push, v = np.asarray(force[0])[last], v[last]
    scale = 0.5 * WATER.density * 0.02
    ours = -np.sum(push * np.abs(v) * v) / np.sum(scale * v**4)
    expected = 1.19 / 1.98 * min(22.5 / number + 2.4, 9.0)
    assert ours == pytest.approx(expected, rel=0.06)
    # 8/3 of ½ ρ C_d A U² times the amplitude U T / 2π, per cycle.
    work = -np.sum(push * v) * dt / 2
    assert work == pytest.approx(8 / 3 * scale * expected * speed**3 * period / 2 / np.pi, rel=0.06)


def test_what_a_plate_remembers_is_exact_even_and_of_its_motion_through_the_water(plate):
    v = np.repeat(np.random.default_rng(0).normal(size=(20, 3)), 8, 0)
    whole, (_, force) = past(PLATE_WAKE, plate, v[::8], 0.08)
    parts, _ = past(PLATE_WAKE, plate, v, 0.01)
    np.testing.assert_allclose(whole, parts, rtol=1e-10)
    mirrored, (_, other) = past(PLATE_WAKE, plate, -v[::8], 0.08)
    np.testing.assert_allclose(np.abs(whole), np.abs(mirrored), rtol=1e-12)
    np.testing.assert_allclose(np.array(force), -np.array(other), rtol=1e-12)


HALVES = """
modules:
  Half:
    mount: null
    parts: [{size: [0.004, 0.1, 0.1], mass: 0.05}]
    slots: {1: +y}
  OtherHalf:
    mount: {position: [0, -0.05, 0], outward: [0, 1, 0]}
    parts: [{size: [0.004, 0.1, 0.1], mass: 0.05}]
"""


def test_a_plate_in_pieces_is_one_plate():
    whole = numbers_of(PLATE_WAKE, box_robot(PLATE, 0.1, WATER))
    tree = {"id": "a", "type": "Half", "children": {1: {"id": "b", "type": "OtherHalf"}}}
    types = modules(HALVES)
    robot = build_robot(make_morphology({"id": "two", "body": tree}, modules=types), WATER)
    halves = [numbers_of(PLATE_WAKE, robot, k) for k in range(2)]
    for half in halves:
        assert float(half.width) == float(whole.width) == 0.1
        assert float(half.faces[0]) == pytest.approx(float(whole.faces[0]) / 2)


@pytest.mark.parametrize("frequency", [0.1, 1.5])
def test_a_fins_lift_lags_as_theodorsens_function_says(frequency, fin):
    """In small heave, lift over the quasi-steady one is C(k), k = ω c / 2 U, within 3 %."""
    speed, chord = 0.5, float(fin.chord)
    omega = 2 * frequency * speed / chord
    period = 2 * np.pi / omega
    dt = period / 400
    time = dt * np.arange(round((12 + 40 * frequency) * 400))
    w = 0.01 * speed * np.sin(omega * time)
    forward, upward = np.array([fin.forward, fin.upward], float)
    velocity = speed * forward - w[:, None] * upward
    _, (_, force) = past(FIN_WAKE, fin, velocity, dt)
    lift = np.array(force).T @ upward
    # Half of the scale is friction's, and drag's as far as it points up: too small to see.
    last = slice(-2 * 400, None)
    response = 2 * np.mean(lift[last] * np.exp(-1j * (omega * time[last] - np.pi / 2)))
    steady = 0.5 * WATER.density * float(fin.area) * speed * float(fin.cla) * 0.01 * speed
    h0, h1 = (scipy.special.hankel2(n, frequency) for n in (0, 1))
    expected = h1 / (h1 + 1j * h0)
    assert response / steady == pytest.approx(expected, abs=0.03)


def test_a_fin_in_steady_flow_lifts_as_before_and_its_drag_follows(fin):
    """A sharp edge: the force is normal to the plate; with friction. A round nose: C_L² / π A."""
    angle, speed = np.radians(10.0), 0.5
    forward, upward = np.array([fin.forward, fin.upward], float)
    velocity = speed * (np.cos(angle) * forward - np.sin(angle) * upward)
    _, (_, force) = past(FIN_WAKE, fin, np.tile(velocity, (3000, 1)), 0.02)
    force = np.array(force)[:, -1]
    ahead = velocity / speed
    across = np.sin(angle) * forward + np.cos(angle) * upward
    scale = 0.5 * WATER.density * float(fin.area) * speed**2
    lift, drag = force @ across / scale, -force @ ahead / scale
    assert lift == pytest.approx(float(fin.cla) * angle, rel=1e-4)
    friction = 2 * 0.455 / np.log10(WATER.density * speed * 0.06 / WATER.viscosity) ** 2.58
    assert drag == pytest.approx(lift * np.tan(angle) + friction, rel=1e-3)
    plain = LIFT_DRAG.force(PartFlow(tuple(velocity), (0.0,) * 3, 1.0), fin, WATER).force
    assert force @ across == pytest.approx(np.array(plain) @ across, rel=1e-4)
    # Half out, half of it; dry, the wake is forgotten.
    wet, half = np.tile(velocity, (3000, 1)), jnp.asarray(0.5)
    (kept, (_, there)) = past(FIN_WAKE, fin, wet, 0.02, half)
    np.testing.assert_allclose(np.array(there)[:, -1], force / 2, rtol=1e-3, atol=1e-6)
    dry = PartFlow(tuple(map(jnp.asarray, velocity)), (jnp.zeros(()),) * 3, jnp.zeros(()), kept)
    assert np.all(np.abs(FIN_WAKE.remember(dry, fin, WATER, 10.0)) < 0.1 * np.abs(kept))


# As Gazebo's models have them: their drag past the stall falls, and counts by its size.
ZEPHYR = """
modules:
  Wing:
    mount: {position: [-0.05, 0, 0], outward: [1, 0, 0]}
    parts:
    - size: [0.1, 0.12, 0.004]
      mass: 0.05
      lift_drag: {a0: 0.06, cla: 4.75, cda: 0.64, alpha_stall: 0.34, cla_stall: -3.85,
                  cda_stall: -0.92, forward: [1, 0, 0], upward: [0, 0, 1]}
"""


@pytest.fixture(scope="module")
def wing():
    tree = {"type": "Core", "children": {0: {"type": "Wing"}}}
    robot = build_robot(make_morphology({"body": tree}, modules=modules(ZEPHYR)), WATER)
    return numbers_of(FIN_WAKE, robot, 1)


@pytest.mark.parametrize("kind", ["plate", "fin", "wing"])
def test_whatever_is_remembered_the_water_never_works_and_gradients_are_finite(kind, request):
    numbers, law = request.getfixturevalue(kind), PLATE_WAKE if kind == "plate" else FIN_WAKE
    v, w, size = np.random.default_rng(2).normal(size=(3, 4, 300))
    memory = size if law is FIN_WAKE else np.concatenate([size[:2], size[2:] ** 2])
    flow = PartFlow(tuple(v[:3]), tuple(5 * w[:3]), 1.0, tuple(memory[: law.memory]))
    flow = jax.tree.map(jnp.asarray, flow)
    drag = law.force(flow, numbers, WATER)
    work = dot(drag.force, flow.velocity) + dot(drag.torque, flow.angular_velocity)
    assert np.max(work) <= 1e-9

    def total(x):
        flow = PartFlow(tuple(x[:3]), tuple(x[3:6]), 1.0, tuple(x[6 : 6 + law.memory]))
        drag = law.force(flow, numbers, WATER)
        later = law.remember(flow, numbers, WATER, 0.01)
        return sum(x for part in (drag.force, drag.torque, later) for x in part)

    for x in (jnp.zeros(10), jnp.arange(10.0) / 10):
        assert np.isfinite(jax.jit(jax.grad(total))(x)).all()


PADDLE = """
modules:
  Paddle:
    mount: {position: [-0.05, 0, 0], outward: [1, 0, 0]}
    parts: [{size: [0.1, 0.12, 0.004], mass: 0.05}]
"""


def swimmer(**fields):
    """A core with a hinged paddle on one side and a fin on the other."""
    tank = world(drag="cross_flow", **fields)
    tree = {"id": "core", "type": "Core", "children": {
        0: {"id": "hinge", "type": "ActiveHinge", "children": {1: {"id": "p", "type": "Paddle"}}},
        1: {"id": "brick", "type": "FixedBrick", "children": {1: {"id": "fin", "type": "Fin"}}},
    }}  # fmt: skip
    robot = build_robot(make_morphology({"id": "s", "body": tree}, modules=modules(PADDLE)), tank)
    assert {"plate_wake", "fin_wake"} <= {*robot.fluid.drag}
    return robot


def stroke(robot, steps, lanes=1):
    turns = np.sin(2 * np.pi * robot.world.timestep * np.arange(steps))
    return np.broadcast_to(0.8 * turns[:, None, None], (steps, 1, lanes))


@pytest.mark.long
def test_both_engines_and_bodies_side_by_side_remember_alike():
    robot = swimmer(added_mass=True)
    qpos, qvel = at_rest(robot, 1, -5.0)
    qvel[0] = 0.2
    ctrl = stroke(robot, 100)
    one, other = (march(robot, 0.5, qpos, qvel, ctrl, engine=e)[1:3] for e in ("population", "mjx"))
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-8)
    robots = [robot, box_robot(PLATE, 0.1, robot.world)]
    capacity = fit_capacity(robots)
    engine, wide = batch_engine(robots, capacity, 2), np.zeros((capacity.hinges, 2))
    start = engine.init(*(jnp.asarray(np.repeat(x, 2, 1)) for x in (qpos, qvel)))
    water = water_of(robot.world)

    def step(state, row):
        return engine.step(state, jnp.asarray(wide).at[0].set(row), water)[0], ()

    end = jax.jit(lambda s: jax.lax.scan(step, s, jnp.asarray(ctrl[:, 0, 0]))[0])(start)
    np.testing.assert_allclose(engine.observe(end)[1][:, 0], one[1][-1][:, 0], atol=1e-8)
