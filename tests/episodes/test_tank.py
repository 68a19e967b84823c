"""A world that goes on: robots come, go, and feel each other, and depend on nothing else."""

import jax
import numpy as np
import pytest

from laboratory import ELBOW, OAR, check_refused, read
from mjx_revolve.episodes.fitness import make_mixed_fitness
from mjx_revolve.episodes.tank import make_tank

PLACES = 4
SENSORS = [
    "nearest",
    "nearest_tag",
    "target",
    # What keeps samples has to begin anew with each robot.
    {"type": "angle", "rate": 10, "noise": 0.05, "delay": 0.05},
]
pytestmark = pytest.mark.usefixtures("quick_compiles")


@pytest.fixture(scope="module")
def mixed():
    settings = {
        "morphology": "spider",  # not used
        "trim": "neutral",
        "world": {"name": "lake", "bed": False, "timestep": 0.01},
        "controller": {"type": "mlp", "sensors": SENSORS, "hidden": 3, "messages": 1},
        "task": {"type": "speed", "duration": 2.0, "settle": 0.5, "trials": 1, "start_tilt": 0.0},
    }
    return make_mixed_fitness(settings, [read(OAR), read(ELBOW)])


@pytest.fixture(scope="module")
def robots(mixed):
    return [mixed.build(read(OAR)), mixed.build(read(ELBOW))]


@pytest.fixture(scope="module")
def programs():
    """Compiled programs that tanks of one shape share."""
    return {}


@pytest.fixture
def tank(mixed, programs):
    """Makes an empty tank."""

    def make(**settings):
        found = make_tank(mixed, PLACES, **{"spheres": 8, **settings})
        if not settings:
            found.__dict__["_programs"] = programs
        return found

    return make


def genes(mixed, robot, seed=0):
    count = mixed.controller_of(robot).num_genes
    return np.random.default_rng(seed).normal(size=count).astype(np.float32)


@pytest.mark.slow
def test_alone_it_swims_as_in_an_episode(tank, mixed, robots):
    """Against the fitness's own replay: another program, the same water; float32, two seconds."""
    robot = robots[1]
    own = genes(mixed, robot)
    [trajectory] = mixed.replay([robot], [own], jax.random.key(0))
    water = tank()
    assert np.allclose(np.asarray(trajectory.qpos[0])[:2], 0, atol=1e-3)
    water.add(robot, own, (0, 0, -2), noise=int(mixed.draw_starts(jax.random.key(0)).noise[0]))
    trail = water.advance(2.0, 0.02)
    count = 7 + robot.num_hinges
    assert np.allclose(trail.time, trajectory.time)
    assert np.allclose(trail.qpos[:, :count, 0], trajectory.qpos, atol=2e-4)
    assert np.abs(np.ptp(trail.qpos[:, 7:count, 0], axis=0)).max() > 0.1  # it does move


@pytest.mark.slow
def test_time_begins_with_each_robot_and_places_are_alike(tank, mixed, robots):
    """The same robot, put in later, elsewhere in the tank's list and beside others far away: the
    same bits, as nothing of it depends on them but what it feels."""
    own = genes(mixed, robots[0])
    first, later = tank(), tank()
    k = first.add(robots[0], own, (0, 0, -2), noise=7)
    alone = first.advance(2.0, 0.02)
    later.add(robots[1], genes(mixed, robots[1], 1), (400, 0, -2))
    later.advance(2.0, 0.02)
    gone = later.add(robots[1], None, (0, 300, -2))
    later.remove(gone)
    later.add(robots[1], None, (300, 0, -2))
    later.remove(0)
    later.remove(1)
    place = later.add(robots[1], None, (0, 500, -2))
    other = later.add(robots[0], own, (0, 0, -2), noise=7)
    later.remove(place)
    assert other != k
    beside = later.advance(2.0, 0.02)
    assert np.array_equal(alone.qpos[:, :8, k], beside.qpos[:, :8, other])
    assert np.array_equal(alone.energy[:, k], beside.energy[:, other])
    assert later.age(other) == pytest.approx(2.0) and later.time == pytest.approx(4.0)
    assert beside.time[-1] == pytest.approx(4.0)
    assert later.count == 1 and beside.alive.tolist() == [k == other for k in range(PLACES)]


def test_saved_and_loaded_it_goes_on_bit_for_bit(tank, mixed, robots):
    water = tank()
    for k in range(3):
        water.add(robots[k % 2], genes(mixed, robots[k % 2], k), (0.2 * k, 0.1 * k, -1))
    water.advance(2.0, 0.02)
    water.tag[:] = (0.1, 0.5, 0.2, 0.0)
    water.add(robots[0], None, (0, 0.5, -1))
    water.set_current((0.05, 0, 0))
    arrays = {name: value.copy() for name, value in water.to_arrays().items()}
    here = {k: robot for k, robot in enumerate(water.robots) if robot is not None}
    other = tank()
    other.from_arrays(arrays, here)
    before, after = water.advance(2.0, 0.02), other.advance(2.0, 0.02)
    assert np.array_equal(before.qpos, after.qpos) and np.array_equal(before.energy, after.energy)
    assert np.array_equal(before.time, after.time) and other.time == water.time
    message = "with these robots; found others"
    check_refused(message, tank().from_arrays, arrays, {0: robots[0]})


def test_robots_do_not_pass_through_each_other(tank, robots):
    """Two still robots adrift towards each other, cores in line; one that is taken out passes."""

    def least(present):
        water = tank()
        for x in (-0.11, 0.11):
            water.add(robots[0], None, (x, 0, -1), (0.7071, 0, 0, 0.7071))
        water.advance(2.0, 0.02)
        state = water.state
        speed = state.state.velocity[0].copy()
        speed[:2] = 0.3, -0.3
        velocity = (speed, *state.state.velocity[1:])
        water.state = state._replace(state=state.state._replace(velocity=velocity))
        if not present:
            water.remove(1)
        trail = water.advance(2.0, 0.02)
        return (trail.position[:, 0, 1] - trail.position[:, 0, 0]).min()

    # Spheres of 35 mm stand for the cores.
    assert least(True) > 0.05
    assert least(False) < 0


def test_a_current_carries_what_keeps_still(tank, robots):
    """Quadratic drag brings a neutral robot to the water's speed, ever more slowly: 5 % in 20 s."""
    water = tank()
    water.add(robots[0], None, (0, 0, -2))
    water.set_current((0.2, -0.1, 0))
    for _ in range(10):
        trail = water.advance(2.0, 0.02)
    speed = (trail.position[-1, :, 0] - trail.position[-26, :, 0]) / 0.5
    assert np.allclose(speed[:2], (0.2, -0.1), rtol=0.05)


def test_what_cannot_be_is_refused(tank, mixed, robots):
    water = tank()
    check_refused("robot in place 0; found none", water.remove, 0)
    check_refused("genes: expected [..., ", water.add, robots[0], np.zeros(3), (0, 0, -1))
    for place, quat in (
        ((0, 0, np.nan), (1, 0, 0, 0)), ((0, 0, -1), (0, 0, 0, 0)), ((0, 0), (1, 0, 0, 0)),
        ((0, 0, -1), (1, 0, 0)), (None, (1, 0, 0, 0)), ((0, 0, "x"), (1, 0, 0, 0)),
    ):  # fmt: skip
        check_refused("a quaternion of some length", water.add, robots[0], None, place, quat)
    check_refused("a world below 1; found -1", water.add, robots[0], None, (0, 0, -1), world=-1)
    for noise in (-1, 2**32, 0.5):
        check_refused("noise: expected", water.add, robots[0], None, (0, 0, -1), noise=noise)
    for current in ((0, 1), None, (0, 0, "x")):
        check_refused("current: expected three numbers", water.set_current, current)
    check_refused("target: expected [3, 4], a place", water.set_targets, np.zeros((3, 2)))
    for times in ((-1, 0.1), (np.nan, 0.1), (1, 0)):
        check_refused("expected times > 0 to advance by", water.advance, *times)
    assert water.count == 0
    empty = water.advance(1.0, 0.5)
    assert empty.time.tolist() == [0.5, 1.0] and not empty.alive.any()
