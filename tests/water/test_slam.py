"""Bodies that enter and leave the water: who keeps the carried water's momentum and energy."""

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from laboratory import QUICK, at_rest, box_robot, march, random_states, world
from mjx_revolve.water.buoyancy import BUOYANCY_LAWS
from mjx_revolve.water.flow import Water
from references import rotation

RHO = 999.1026
G = 9.81
SIZE = np.array([0.2, 0.1, 0.06])


@lru_cache
def _cut(half, mode):
    law = BUOYANCY_LAWS[mode]
    return jax.jit(lambda up, depth: law.submersion(up, depth, half), compiler_options=QUICK)


def wetness(qpos, mode="partial"):
    """Submerged share of the box `SIZE` in `[..., nq]`, and its moment."""
    with jax.enable_x64(True):
        up = tuple(jnp.asarray(x) for x in np.moveaxis(rotation(qpos[..., 3:7])[..., 2, :], -1, 0))
        share, moment = _cut(tuple(SIZE / 2), mode)(up, jnp.asarray(-qpos[..., 2]))
        return np.asarray(share), np.stack(moment, -1)


def a_step_ago(qpos, qvel, dt):
    """`[..., 7]` from where a step has led here: places follow velocities."""
    found = np.array(qpos)
    found[..., :3] -= dt * qvel[..., :3]
    half = -0.5 * dt * qvel[..., 3:6]
    angle = np.linalg.norm(half, axis=-1, keepdims=True)
    b = half * np.sinc(angle / np.pi)
    w, a = qpos[..., 3:4], qpos[..., 4:7]
    c = np.cos(angle)
    found[..., 3:4] = w * c - np.sum(a * b, -1, keepdims=True)
    found[..., 4:7] = w * b + c * a + np.cross(a, b)
    return found


def ledger(robot, qpos, qvel, mode="partial"):
    """Of a box, `[...]` each: kinetic energy with the carried water's, and potential energy.

    Velocities come from a step which has carried the water of the place before it. The potential
    energy is that of weight and of the water raised, ρ g V times the mean over the box of max(0,
    depth).
    """
    mass, turn = robot.mj_model.body_mass[1], rotation(qpos[..., 3:7])
    own = mass / 12 * (np.sum(SIZE**2) - SIZE**2)
    share, moment = wetness(qpos, mode)
    raised = -share * qpos[..., 2] - np.sum(moment * turn[..., 2, :], -1)
    potential = G * (mass * qpos[..., 2] + RHO * SIZE.prod() * raised)
    share, _ = wetness(a_step_ago(qpos, qvel, robot.world.timestep), mode)
    along = mass + share[..., None] * RHO * robot.fluid.added_mass[0]
    about = own + share[..., None] * RHO * robot.fluid.added_inertia[0]
    v = np.einsum("...ji,...j->...i", turn, qvel[..., :3])
    w = qvel[..., 3:6]
    return 0.5 * np.sum(along * v * v + about * w * w, -1), potential


def lanes_last(x):
    """`[T, n, lanes]` as `[T, lanes, n]`."""
    return np.moveaxis(x, 1, -1)


def tilted(lanes, height):
    """The rest pose at heights, tilted by .9 rad about (1, .7, .2); the other lanes anyhow."""
    draw = np.random.default_rng(5)
    quat = draw.normal(size=(4, lanes))
    axis = np.array([1, 0.7, 0.2]) / np.linalg.norm([1, 0.7, 0.2])
    quat[:, 0] = [np.cos(0.45), *np.sin(0.45) * axis]
    return np.concatenate([np.zeros((2, lanes)), height, quat / np.linalg.norm(quat, axis=0)])


@pytest.mark.slow
@pytest.mark.parametrize("dt", [0.02, 0.005])
def test_a_box_that_bobs_and_tumbles_gains_no_energy(dt):
    """Relative density .6, no drag, for a minute: kinetic and potential energy never exceed the
    start's, at any of the usual steps; weight and buoyancy are vertical, and no lane is driven far.

    What is given is counted from the floating box at rest. Of it the step's own error may add:
    semi-implicit Euler's energy swings by a part of dt in weight and buoyancy.
    """
    tank = world(added_mass=True, gravity=G, buoyancy="partial", timestep=dt)
    mass = 0.6 * RHO * SIZE.prod()
    robot = box_robot(tuple(SIZE), mass, tank)
    lanes = 16
    height = np.linspace(-0.06, 0.1, lanes)[None]
    height[0, 0] = 0.03
    qpos, qvel = tilted(lanes, height), np.zeros((6, lanes))
    _, q, v, _ = march(robot, 60.0, qpos, qvel, every=round(0.02 / dt))
    kinetic, potential = ledger(robot, lanes_last(q), lanes_last(v))
    draft = 0.6 * SIZE[2]
    afloat = mass * G * (SIZE[2] / 2 - draft) + RHO * G * SIZE.prod() * draft**2 / (2 * SIZE[2])
    given = ledger(robot, qpos.T, qvel.T)[1] - afloat
    found = kinetic + potential - afloat
    assert np.all(found.max(0) < (1 + 3 * dt) * given)
    assert np.all(kinetic.max(0) < given)
    # Every entry takes its share: what still bobs after a minute is a small part of it.
    assert np.all(found[-1] < 0.2 * given)
    assert np.linalg.norm(q[:, :2, 0], axis=1).max() < 3.0


@pytest.mark.parametrize("mode", ["partial", "mask"])
def test_neither_entry_nor_exit_makes_kinetic_energy(mode):
    """Without weight: boxes that tumble through the surface, up and down, step by step.

    The energy that the step keeps account of has the water that it has carried, that of the step
    before; there the bound holds to rounding.
    """
    robot = box_robot(tuple(SIZE), 0.3, world(added_mass=True, buoyancy=mode))
    qpos, qvel = random_states(robot, 32, seed=3, speed=0.5)
    qpos[2] = np.linspace(-0.15, 0.15, 32)
    qvel[2] = -np.sign(qpos[2]) * 0.5
    _, q, v, _ = march(robot, 1.0, qpos, qvel)
    q, v = lanes_last(q), lanes_last(v)
    mass, added, inertia = 0.3, RHO * robot.fluid.added_mass[0], RHO * robot.fluid.added_inertia[0]
    own = mass / 12 * (np.sum(SIZE**2) - SIZE**2)
    share = wetness(q, mode)[0][:-1, :, None]  # of the states that the velocities below come from
    seen = np.einsum("...ji,...j->...i", rotation(q[..., 3:7]), v[..., :3])[1:]
    spin = v[1:, :, 3:6]
    energy = 0.5 * np.sum((mass + share * added) * seen**2 + (own + share * inertia) * spin**2, -1)
    change = np.diff(energy, axis=0) / energy[:-1]
    assert change.max() < 1e-12
    crossed = (share.max(0) == 1) & (share.min(0) == 0)
    assert crossed.sum() >= 8
    lost = 1 - energy[-1] / energy[0]
    assert lost[crossed[:, 0]].min() > 0.05


@pytest.mark.slow
def test_a_plate_slams_as_von_karman_has_it():
    """Without weight, v (m + m_a s) = m v₀ with the wet share s = depth / height of a level plate.

    In time, m z + m_a z² / 2h = m v₀ t. First order in the step, and exact in the momentum.
    """
    size, mass, fast = np.array([0.2, 0.1, 0.02]), 0.2, 0.1
    error = []
    for dt in (0.002, 0.001):
        robot = box_robot(
            tuple(size), mass, world(added_mass=True, buoyancy="partial", timestep=dt)
        )
        carried = RHO * robot.fluid.added_mass[0, 2]
        assert carried > 2 * mass
        qpos, qvel = at_rest(robot, 1, size[2] / 2)
        qvel[2] = -fast
        h = size[2]
        entry = h * (1 + carried / (2 * mass)) / fast
        time, _, v, _ = march(robot, 0.04 * np.ceil(entry / 0.04 + 0.5), qpos, qvel)
        root = np.sqrt(1 + 2 * carried * fast * time / (mass * h))
        depth = mass * h / carried * (root - 1)
        within = depth < h
        assert np.any(~within)
        speed = np.where(within, fast / root, fast * mass / (mass + carried))
        error.append(np.abs(-v[:, 2, 0] - speed).max() / fast)
        assert -v[-1, 2, 0] == pytest.approx(fast * mass / (mass + carried), rel=1e-12)
        assert np.all(np.diff(-v[:, 2, 0]) < 1e-15)  # it only slows down
    assert error[1] < 0.06
    assert error[0] / error[1] == pytest.approx(2.0, abs=0.4)


def test_what_leaves_the_water_keeps_its_velocity():
    """Up along each axis, to rounding; the water that is left keeps ½ m_a v²."""
    robot = box_robot(tuple(SIZE), 0.6, world(added_mass=True, buoyancy="partial"))
    qpos, qvel = at_rest(robot, 3, -0.15)
    half = 0.5**0.5
    qpos[3:7] = np.array([[1, 0, 0, 0], [half, half, 0, 0], [half, 0, half, 0]]).T
    qvel[2] = 0.4
    _, q, v, _ = march(robot, 1.0, qpos, qvel, every=200)
    assert v[-1] == pytest.approx(qvel, abs=1e-12)
    assert wetness(q[-1].T)[0].max() == 0


@pytest.mark.parametrize("mode", ["mask", "off"])
def test_all_or_nothing_takes_the_water_aboard_at_once(mode):
    """Where the share jumps, one step has the whole slam: v m / (m + m_a), to rounding."""
    robot = box_robot(tuple(SIZE), 0.6, world(added_mass=True, buoyancy=mode))
    qpos, qvel = at_rest(robot, 1, 0.011)
    qvel[2] = -0.4
    _, q, v, _ = march(robot, 0.1, qpos, qvel)
    carried = RHO * robot.fluid.added_mass[0, 2]
    above = q[:-1, 2, 0] > 0
    expected = np.where(above, -0.4, -0.4 * 0.6 / (0.6 + carried))
    assert v[1:, 2, 0] == pytest.approx(expected, rel=1e-12)


def test_entry_into_a_current_knows_only_the_relative_velocity():
    """The water that comes aboard flows already: a Galilean shift of the fall into still water."""
    robot = box_robot(tuple(SIZE), 0.6, world(added_mass=True, buoyancy="partial", gravity=G))
    qpos, qvel = random_states(robot, 6, seed=1, speed=0.3)
    qpos[2] = 0.1
    current = np.array([0.3, -0.2, 0.0])
    moving = qvel.copy()
    moving[:3] += current[:, None]
    calm = (np.float64(0),) * 3
    _, q, v, _ = march(robot, 1.0, qpos, qvel, water=Water(0.0, calm), every=50)
    time, p, u, _ = march(robot, 1.0, qpos, moving, water=Water(0.0, tuple(current)), every=50)
    assert u[:, :3] - current[:, None] == pytest.approx(v[:, :3], abs=1e-9)
    drift = time[:, None, None] * current[:, None]
    assert p[:, :3] - drift == pytest.approx(q[:, :3], abs=1e-9)
