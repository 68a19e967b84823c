"""The bed: a penalty law at corners. Robots land, stay on top, gain no energy, and grip."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from laboratory import WATER, at_rest, body, box_robot, march, random_states, world
from mjx_revolve.engine.contact import bed_contact, bed_plane
from mjx_revolve.engine.engines import make_engine
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.episodes.simulate import simulate
from mjx_revolve.water.bed import Bed, bed_height, bed_slope
from mjx_revolve.water.flow import water_of
from mjx_revolve.water.world import load_world
from references import Lagrangian, clearance, each_lane

RHO, G = 999.1026, 9.81
LAKE = load_world("lake").bed
FLAT = Bed(kind="flat", height=-2.0)
# Places in the lake by the tangent of their slope; the bed's friction is 0.6.
LEVEL, GENTLE, STEEP = (0.0, 0.0), (200.0, 50.0), (150.0, -250.0)


def sink(bed, name="core"):
    """A robot with water, drag and a bed."""
    return build_robot(body(name), world(**WATER, bed=bed))


def above(robot, places, clear, seed=0, speed=0.1):
    """Random attitudes, hinges at rest, slowly moving, with the core `clear` above the bed."""
    qpos, qvel = random_states(robot, len(places), seed=seed, speed=speed)
    qpos[7:] = 0.0
    qpos[:2] = np.array(places).T
    qpos[2] = bed_height(robot.world.bed, qpos[0], qpos[1]) + clear
    return qpos, qvel


def test_force_on_a_point():
    """Only ever outwards; friction against the sliding, within Coulomb's cone; nothing outside."""
    draw = np.random.default_rng(0)
    depth = draw.uniform(-2e-3, 5e-3, 500)
    normal = draw.normal(size=(3, 500))
    normal /= np.linalg.norm(normal, axis=0)
    velocity = draw.normal(size=(3, 500))
    moved = tuple(map(jnp.asarray, velocity))
    force = np.stack(bed_contact(FLAT, jnp.asarray(depth), tuple(normal), moved, 0.01, 0.005)[0])
    outward = (force * normal).sum(0)
    sliding = force - outward * normal
    slip = velocity - (velocity * normal).sum(0) * normal
    # The spring is that of the end of the step: what arrives within it is met.
    ahead = depth - 0.005 * (velocity * normal).sum(0)
    assert not force[:, ahead <= 0].any()
    # float32 leaves a millionth of the largest force.
    assert outward.min() > -1e-6 * np.abs(force).max()
    assert np.all(np.linalg.norm(sliding, axis=0) < FLAT.friction * outward + 1e-5)
    assert np.all((sliding * slip).sum(0) <= 1e-5)
    assert outward.max() > 1.0


@pytest.mark.parametrize("dt", [0.02, 0.005, 0.00125])
def test_a_landing_point_is_gripped_by_what_stops_it_at_any_step(dt):
    """Friction's impulse is at most μ m v at any depth; a point that lies still has all μ F_n."""
    mass, speed = 0.01, 0.3
    land = bed_contact(FLAT, jnp.zeros(1) - 1e-4, (0.0, 0.0, 1.0), (1.0, 0.0, -speed), mass, dt)
    assert 0 < -float(land[0][0][0]) * dt <= FLAT.friction * mass * speed * (1 + 1e-5)
    lie = bed_contact(FLAT, jnp.full(1, 1e-3), (0.0, 0.0, 1.0), (0.1, 0.0, 0.0), mass, dt)
    assert -float(lie[0][0][0]) == pytest.approx(FLAT.friction * float(lie[0][2][0]), rel=1e-3)


@pytest.mark.parametrize("dt", [0.02, 0.005, 0.000625])
def test_what_lands_does_not_bounce_whatever_stands_behind_the_point(dt):
    """A share of 1 g, ten times as much behind: lands at .3 m/s, within 2 mm, out at a sixth."""
    mass, share = 0.01, 1e-3
    force = jax.jit(lambda d, v: bed_contact(FLAT, d, (0.0, 0.0, 1.0), (0.0, 0.0, v), share, dt))
    height, speed, deepest, fastest = 1e-3, -0.3, 0.0, -1.0
    for _ in range(round(0.1 / dt)):
        push, damping, _ = force(jnp.full(1, -height), jnp.full(1, speed))
        speed += dt * float(push[2][0]) / (mass + dt * float(damping[0]))
        height += dt * speed
        deepest, fastest = min(deepest, height), max(fastest, speed)
    assert fastest < 0.05
    assert -2e-3 < deepest < 1e-3


def test_gradient_is_finite_at_rest_and_at_touch_down():
    def pull(depth, speed):
        return sum(bed_contact(FLAT, depth, (0.0, 0.0, 1.0), (speed, 0.0, -speed), 0.01, 0.005)[0])

    for depth in (-1e-3, 0.0, 1e-3):
        for speed in (0.0, 0.1):
            assert np.all(np.isfinite(jax.grad(pull, (0, 1))(depth, speed)))


def test_a_bed_too_soft_for_a_robot_is_noted(caplog):
    for gravity, notes in ((G, 0), (1e3 * G, 1)):
        build_robot(body("spider"), world(gravity=gravity, bed=FLAT))
        assert caplog.text.count("sinks by more than a tenth") == notes


def test_plane_below_a_body():
    """Its height, and a unit normal across both slopes; flat beds have (0, 0, 1)."""
    x, y = np.random.default_rng(1).uniform(-450, 450, (2, 200)).astype(np.float32)
    height, normal = bed_plane(LAKE, (jnp.asarray(x), jnp.asarray(y)))
    assert np.asarray(height) == pytest.approx(np.asarray(bed_height(LAKE, x, y)), abs=1e-4)
    assert sum(np.square(n) for n in normal) == pytest.approx(1.0, abs=1e-5)
    slope = bed_slope(LAKE, x, y)
    for k in range(2):
        # float32 knows heights of 100 m to 8 µm, and the slope is a difference over 2 cm.
        assert -normal[k] / normal[2] == pytest.approx(np.asarray(slope[k]), abs=2e-3)
    height, normal = bed_plane(FLAT, (jnp.asarray(x), jnp.asarray(y)))
    assert np.all(np.asarray(height) == FLAT.height)
    assert np.all(np.asarray(normal[2]) == 1)


@pytest.mark.slow
def test_a_core_lands_on_a_flat_bed_and_stays():
    """From half a metre, in eight attitudes: 7 mm deep at most while landing, .5 mm at rest."""
    robot = sink(FLAT)
    qpos, qvel = above(robot, [(0.0, 0.0)] * 8, 0.5)
    _, q, v, _ = march(robot, 10.0, qpos, qvel, every=4)
    clear = np.array([clearance(robot, q[:, :, lane]) for lane in range(8)]).T
    assert clear.min() > -8e-3
    assert np.abs(v[-1]).max() < 1e-4
    assert np.all((clear[-1] > -1e-3) & (clear[-1] < 0))
    # It came to rest on a side, not on an edge: a corner's height says so.
    heights = np.abs(q[-1, 2] - FLAT.height)
    assert np.all(np.minimum(np.abs(heights - 0.0225), np.abs(heights - 0.0445)) < 1e-3)
    # No bounce, tumble or shove ever adds to what it came with.
    lagrangian, net = Lagrangian(robot, RHO), (0.09 - RHO * 5.054e-5) * G
    for lane in range(8):
        energy = each_lane(lagrangian.energy, q[:, :, lane].T, v[:, :, lane].T)
        energy += net * q[:, 2, lane]
        start = lagrangian.energy(qpos[:, lane], qvel[:, lane]) + net * qpos[2, lane]
        assert max(energy) < start
        # What rises is what the ground had stored.
        assert np.diff(energy).max() < 0.05 * (start - energy[-1])


@pytest.mark.parametrize("dt", [0.0025, 0.01])
def test_the_force_that_is_felt_is_the_one_that_stops_a_fall(dt):
    """Its impulse is the change of momentum, and the weight's."""
    robot = build_robot(body("core"), world(gravity=G, bed=Bed(height=-1.0), timestep=dt))
    engine, still, weight = make_engine(robot), water_of(robot.world), G * robot.morphology.mass

    def step(state, _):
        state, _ = engine.step(state, jnp.zeros((0, 1)), still)
        return state, (engine.contact_force(state, still)[0, 0], engine.root(state).velocity[2])

    start = engine.init(*map(jnp.asarray, at_rest(robot, 1, -0.95)))
    _, (force, rise) = jax.lax.scan(step, start, length=round(0.4 / dt))
    assert rise.min() < -0.6 and abs(rise[-1]) < 1e-4
    assert dt * force.sum() == pytest.approx(0.4 * weight, rel=0.1)


def test_creep_stays_below_the_stated_speed():
    """Where tan(slope) is half of μ, the docstring's 1 mm/s law creeps at .6 mm/s."""
    robot = sink(LAKE)
    q = march(robot, 12.0, *above(robot, [LEVEL, GENTLE, STEEP], 0.3), every=20)[1]
    assert np.linalg.norm(q[-1, :2, 1] - q[-51, :2, 1]) / 5.0 < 0.0012


@pytest.mark.slow
@pytest.mark.sampled(1)
@pytest.mark.parametrize("bed", [FLAT, LAKE], ids=["flat", "lake"])
def test_a_spider_lands_and_stays(bed):
    """Legs first, on its back, on a slope: on top of the bed in float32 after 15 s, and calm."""
    robot = sink(bed, "spider")
    places = [LEVEL, LEVEL, LEVEL, GENTLE] if bed is LAKE else [LEVEL] * 4
    qpos, qvel = above(robot, places, 0.5)
    qpos[3:7, 0] = 1, 0, 0, 0
    _, q, v, _ = march(robot, 15.0, qpos, qvel, every=20, x64=False)
    clear = np.array([clearance(robot, q[:, :, lane]) for lane in range(4)])
    assert np.all(np.isfinite(v))
    assert clear.min() > -0.015
    assert np.all((clear[:, -1] > -0.003) & (clear[:, -1] < 0.001))
    assert np.linalg.norm(v[-1, :3], axis=0).max() < (0.08 if bed is LAKE else 0.02)


@pytest.mark.slow
@pytest.mark.parametrize(("timestep", "surface"), [(0.005, 2.0), (0.02, 2.0), (0.005, -2.0)])
def test_light_bodies_come_to_rest_wholly(timestep, surface):
    """A brick and a plate, tumbling, also on land: as points lost the bed, most rocked for ever."""
    water = dict(buoyancy="partial", drag="cross_flow", added_mass=True, surface_height=surface)
    tank = world(gravity=9.81, bed={"kind": "flat", "height": 0.0}, timestep=timestep, **water)
    for size, mass, volume in (
        ((0.041, 0.041, 0.0355), 0.0152, 1.07e-5),
        ((0.06, 0.05, 0.002), 0.0122, 5.8e-6 if surface > 0 else 1.2e-5),
    ):  # fmt: skip
        robot = box_robot(size, mass, tank, volume)
        qpos, qvel = random_states(robot, 8, seed=1, speed=0.5, depth=0.0)
        qpos[2] = 0.15
        _, qpos, qvel, _ = march(robot, 8.0, qpos, qvel)
        assert np.abs(qvel[-1]).max() < 2e-4
        assert (np.abs(qpos[-1, 2]) < 0.025).all()


def test_what_lies_on_the_bed_does_not_feel_a_gust_as_a_push():
    """A heavy box that friction holds: while gusts of .1 m/s pass it moves at under 3 mm/s, and
    nowhere. With the water's acceleration in the bed's damping it was 12."""
    water = dict(buoyancy="partial", added_mass=True, gust={"std": [0.1, 0.1, 0.0], "time": 0.5})
    tank = world(gravity=9.81, bed={"kind": "flat", "height": -2.0}, **water)
    robot = box_robot((0.1, 0.1, 0.05), 1.5, tank, 5e-4)
    run = simulate(robot, None, 4.0, qpos=robot.start_qpos(1.975), key=jax.random.key(1), once=True)
    assert np.sqrt((np.asarray(run.qvel)[200:, :3] ** 2).mean(0)).max() < 3e-3
    assert np.abs(np.diff(np.asarray(run.qpos)[[200, -1], :2], axis=0)).max() < 2e-3
