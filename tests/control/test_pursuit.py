"""Pursuers against closed forms: straight lines, circles and Bouguer's curve of pursuit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from laboratory import box_robot, world
from mjx_revolve.control.pursuit import Pursuer, PursuitLimits, init_pursuer, step_pursuer
from mjx_revolve.control.readings import (
    EpisodeContext,
    SensorMemory,
    init_memory,
    read_sensors,
    update_memory,
)
from mjx_revolve.engine.engines import make_engine
from mjx_revolve.engine.state import RootState
from mjx_revolve.water.flow import water_of

DT = 0.005


def vec(*numbers):
    """A vector of one lane."""
    return tuple(jnp.array([x], jnp.float32) for x in numbers)


def chase(prey, start, speed, turn, seconds, heading=None):
    """`[T + 1, 3]` the pursuer's way; prey: time → place."""
    can = PursuitLimits(jnp.array([speed], jnp.float32), jnp.array([turn], jnp.float32))
    begin = init_pursuer(vec(*start), tuple(jnp.reshape(x, 1) for x in prey(jnp.float32(0))))
    if heading is not None:
        begin = begin._replace(heading=vec(*heading))

    def step(pursuer, count):
        place = tuple(jnp.reshape(jnp.float32(x), 1) for x in prey(DT * count))
        after = step_pursuer(pursuer, can, place, DT)
        return after, jnp.concatenate(after.position)

    _, way = jax.lax.scan(step, begin, jnp.arange(round(seconds / DT)).astype(jnp.float32))
    return np.concatenate([[start], np.asarray(way)])


def test_it_swims_straight_at_what_stays_and_stops_there():
    way = chase(lambda t: (3.0 + 0 * t, 4.0, 0.0), (0, 0, 0), 2.0, 1.0, 3.0)
    # 5 m away in the direction (0.6, 0.8), at 2 m/s; float32 over 400 steps.
    assert way[200] == pytest.approx([1.2, 1.6, 0.0], abs=1e-4)
    assert way[-1] == pytest.approx([3.0, 4.0, 0.0], abs=1e-4)


def test_it_turns_no_faster_than_it_can():
    """What is right behind is turned to on a circle of radius speed / turn, to the left."""
    way = chase(lambda t: (-50.0 + 0 * t, 0.0, 0.0), (0, 0, 0), 0.5, 0.25, 8.0, heading=(1, 0, 0))
    angle = 0.25 * DT * np.arange(len(way))
    circle = 2 * np.stack([np.sin(angle), 1 - np.cos(angle), 0 * angle], 1)
    assert way == pytest.approx(circle, abs=0.003)  # steps of 2.5 mm
    assert np.linalg.norm(np.diff(way, axis=0), axis=1) == pytest.approx(0.5 * DT, rel=1e-3)


def test_the_curve_of_pursuit():
    """Bouguer (1732): prey that crosses at speed u is caught after D v / (v² - u²)."""
    far, fast, slow = 2.0, 0.5, 0.3
    way = chase(lambda t: (0.0 * t, slow * t, 0.0), (-far, 0, 0), fast, 100.0, 7.0)
    prey = np.stack([0 * way[:, 0], slow * DT * np.arange(len(way)), 0 * way[:, 0]], 1)
    away = np.linalg.norm(way - prey, axis=1)
    caught = DT * np.argmax(away < 0.01)
    # At the end it closes at v - u: 1 cm takes 0.05 s. Beside that, a few steps of 5 ms.
    expected = far * fast / (fast**2 - slow**2) - 0.01 / (fast - slow)
    assert caught == pytest.approx(expected, abs=0.03)


def test_a_pursuer_travels_with_what_is_remembered():
    """From the cues to the core's frame; nothing of it where nobody pursues."""
    tank = world()
    engine = make_engine(box_robot((0.1, 0.1, 0.1), 1.0, tank))
    # A quarter turn to the left about z: what is ahead along x is at the robot's right, -y.
    half = np.sqrt(0.5)
    qpos = jnp.array([1.0, 0, -2, half, 0, 0, half], jnp.float32)[:, None]
    state = engine.init(qpos, jnp.zeros((6, 1)))
    can = PursuitLimits(jnp.array([2.0]), jnp.array([1.0]))
    cues = EpisodeContext(target=vec(4.0, 0.0, -2.0), pursuit=can)
    memory = init_memory((), engine, state, cues)
    assert isinstance(memory.pursuer, Pursuer)
    zero = vec(0.0, 0.0, 0.0)
    root = RootState(vec(1.0, 0.0, -2.0), engine.root(state).quat, zero, zero)
    memory = update_memory(memory, root, root, jnp.zeros((0, 1)), jnp.zeros(1), 0.5, context=cues)
    felt = read_sensors(tank, engine, state, water_of(tank), jnp.zeros(()), cues, memory)
    assert np.concatenate(felt.target) == pytest.approx([0, -2, 0], abs=1e-6)  # 3 m less 1 m
    assert init_memory((), engine, state, EpisodeContext(target=cues.target)) == SensorMemory()


@pytest.mark.parametrize(("sight", "seen"), [(2.9, False), (3.1, True)])
def test_what_is_out_of_sight_is_not_felt(sight, seen):
    from mjx_revolve.body.sensors import SENSORS

    tank = world()
    engine = make_engine(box_robot((0.1, 0.1, 0.1), 1.0, tank))
    state = engine.init(jnp.zeros((7, 1)).at[3].set(1.0), jnp.zeros((6, 1)))
    cues = EpisodeContext(target=vec(0.0, 3.0, 0.0), sight=jnp.array([sight]))
    felt = read_sensors(tank, engine, state, water_of(tank), jnp.zeros(()), cues, SensorMemory())
    found = {name: np.array(SENSORS[name].signal(felt)) for name in ("target", "bearing")}
    assert felt.seen.tolist() == [seen]
    assert found["target"].ravel() == pytest.approx([0, 3.0 * seen, 0])
    assert found["bearing"].ravel() == pytest.approx([0, 1.0 * seen, 0], abs=1e-6)
    (away,) = SENSORS["distance"].signal(felt)
    assert away[0] == pytest.approx(3.0) if seen else away[0] > 1e6


@pytest.mark.parametrize("place", [(3.0, 0, 0), (-3.0, 0, 0), (0.0, 0, 0), (1.0, 2, 0)])
def test_its_way_has_a_slope_everywhere(place):
    """Ahead, right behind, where it is itself: derivatives are numbers."""
    can = PursuitLimits(jnp.array([0.5]), jnp.array([1.0]))

    def after(prey):
        pursuer = Pursuer(vec(0, 0, 0), vec(1, 0, 0))
        found = step_pursuer(pursuer, can, tuple(prey[:, None]), 0.1)
        return jnp.sum(jnp.stack([*found.position, *found.heading]))

    assert np.isfinite(jax.grad(after)(jnp.array(place, jnp.float32))).all()
