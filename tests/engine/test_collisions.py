"""Robots that touch: force by hand, momentum, no passing through, worlds apart."""

from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from laboratory import QUICK, body, box_robot, world
from mjx_revolve.engine import interaction
from mjx_revolve.engine.batch import fit_capacity, pack_bodies
from mjx_revolve.engine.batched_trees import make_batched_trees
from mjx_revolve.engine.interaction import (
    NO_NEIGHBOUR,
    ContactParameters,
    frames_of,
    make_interaction,
    nearest_robot,
    penalty_force,
)
from mjx_revolve.engine.population import PopulationEngine
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.engine.spheres import pack_spheres, sphere_box
from mjx_revolve.episodes.rollout import Rollout, held
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.water.flow import water_of

NAMES = ("spider", "fish", "snake")
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("float64")]


@lru_cache(maxsize=1)
def crowd_tables():
    """Eight robots of three kinds in a world of nothing, the last two places empty."""
    space = world()
    kinds = [build_robot(body(name), space) for name in NAMES]
    robots = [kinds[k % 3] for k in range(8)]
    capacity = fit_capacity(robots)
    tables = pack_bodies(robots, capacity, np.float64)
    return space, robots, capacity, tables, pack_spheres(robots, capacity, dtype=np.float64)


def crowd(seed: int, spread: float = 0.05):
    """Random poses and speeds, so near each other that most overlap."""
    _, robots, capacity, *_ = crowd_tables()
    draw = np.random.default_rng(seed)
    lanes, hinges = len(robots), capacity.hinges
    quat = draw.normal(size=(4, lanes))
    qpos = np.concatenate(
        [
            draw.normal(0, spread, (3, lanes)),
            quat / np.linalg.norm(quat, axis=0),
            draw.uniform(-0.7, 0.7, (hinges, lanes)),
        ]
    )
    return jnp.asarray(qpos), jnp.asarray(draw.normal(0, 0.3, (6 + hinges, lanes)))


@lru_cache(maxsize=4)
def meeting_of(worlds: int = 1):
    """(qpos, qvel, present) → frames and meeting of the crowd."""
    space, robots, capacity, *packed = crowd_tables()

    @partial(jax.jit, compiler_options=QUICK)
    def find(packed, qpos, qvel, present):
        tables, spheres = packed
        rows = make_batched_trees(space, capacity, tables, len(robots))
        meet = make_interaction(rows, spheres, present, worlds, ContactParameters())
        state = PopulationEngine(rows, tables.plant).init(qpos, qvel)
        return frames_of(rows, state), meet.detect(state, meet.init(state))[0]

    return partial(find, packed)


def wrenches(meeting, frames) -> tuple[np.ndarray, np.ndarray]:
    """`[rows + 1, 3, lanes]` forces and torques about the world's origin, world frame."""
    (torque, force), (below_torque, below_force) = meeting.wrench
    join = lambda a, b: np.concatenate([np.asarray(a), np.asarray(b)[:, 0]])  # noqa: E731
    force = np.stack([join(a, b) for a, b in zip(force, below_force, strict=True)], 1)
    torque = np.stack([join(a, b) for a, b in zip(torque, below_torque, strict=True)], 1)
    axes = np.array(frames.axes).transpose(2, 0, 1, 3)  # world axis, then body component
    place = np.array(frames.position).transpose(1, 0, 2)
    force = np.einsum("rwbl,rbl->rwl", axes, force)
    torque = np.einsum("rwbl,rbl->rwl", axes, torque) + np.cross(place, force, axis=1)
    return force, torque


def push_of(depth, speed, mass, dt, parameters=None, slip=0.0):
    """Normal force and friction [N] of one contact along z, settled: of a point mass."""
    parameters, normal = parameters or ContactParameters(), (0.0, 0.0, 1.0)
    start, old = np.array([slip, 0.0, -speed]), (jnp.float64(0), (jnp.float64(0),) * 3)
    for _ in range(200):
        push = np.add([float(x) for x in old[1]], (0.0, 0.0, float(old[0])))
        velocity = start + dt * push / mass
        old = penalty_force(
            parameters, jnp.float64(depth), normal, tuple(start), tuple(velocity),
            lambda _: (1 / mass, 1 / mass), old, dt,
        )  # fmt: skip
    return float(old[0]), np.array([float(x) for x in old[1]])


def test_spheres_of_known_boxes():
    centers, radius = sphere_box((0.02, 0.02, 0.02))
    assert radius == pytest.approx(0.02) and np.allclose(centers, 0)
    # A rod has two, side by side; a plate four, and one in their middle.
    centers, radius = sphere_box((0.04, 0.01, 0.01))
    assert radius == pytest.approx(0.02)
    assert sorted(centers[:, 0]) == pytest.approx([-0.02, 0.02])
    assert len(sphere_box((0.03, 0.03, 0.001))[0]) == 5
    assert len(sphere_box((0.0, 0.0, 0.0))[0]) == 0


@pytest.mark.parametrize("slip", [0.01, 1.0])
def test_friction_stops_and_never_passes_coulombs_bound(slip):
    """Within a step of 10 ms, μ F takes .4 · 1.6 N · 10 ms / 100 g = 6 cm/s at most."""
    normal, friction = push_of(0.001, 0.0, 0.1, 0.01, slip=slip)
    assert np.linalg.norm(friction) <= 0.4 * normal * (1 + 1e-9)
    after = slip + 0.01 * friction[0] / 0.1
    assert after >= 0
    if slip < 0.05:
        assert after < 2e-3


def test_a_contact_stops_no_more_than_its_mass():
    """However stiff and long a step: what comes at 1 m/s with 10 g is at most brought to rest,
    and pushed out of the depth within one step."""
    for dt in (1e-3, 1e-2, 0.1):
        force, _ = push_of(0.01, 1.0, 0.01, dt, ContactParameters(stiffness=1e9))
        after = -1 + dt * force / 0.01
        assert -1e-6 <= after <= 0.01 / dt + 1e-6


@pytest.mark.parametrize("seed", [0, 1])
def test_forces_are_equal_and_opposite(seed):
    """Forces and torques of all robots add up to nothing, to rounding; empty places have none."""
    present = np.array([True] * 6 + [False] * 2)
    qpos, qvel = crowd(seed)
    frames, meeting = meeting_of()(qpos, qvel, jnp.asarray(present))
    force, torque = wrenches(meeting, frames)
    size = np.abs(force).max()
    assert size > 1  # they do touch
    assert np.abs(force.sum((0, 2))).max() < 1e-12 * size
    assert np.abs(torque.sum((0, 2))).max() < 1e-12 * size
    assert np.all(force[..., 6:] == 0) and np.all(np.abs(force[..., :6]).max((0, 1)) > 0)


def test_a_list_without_room_for_all_that_is_near_has_what_meets_in_the_step(monkeypatch):
    qpos, qvel = crowd(1, spread=0.2)
    qvel = qvel.at[:3].multiply(3)
    every = jnp.ones(8, bool)
    frames, usual = meeting_of()(qpos, qvel, every)
    expected, _ = wrenches(usual, frames)
    monkeypatch.setattr(interaction, "_ROOM", 12)
    frames, few = meeting_of.__wrapped__()(qpos, qvel, every)
    assert np.abs(expected).max() > 1
    np.testing.assert_allclose(wrenches(few, frames)[0], expected, rtol=1e-9, atol=1e-9)


def test_worlds_do_not_feel_each_other():
    """Two worlds of four in the same places: each as if the other were not there."""
    qpos, qvel = crowd(3)
    every = np.ones(8, bool)
    frames, both = meeting_of(worlds=2)(qpos, qvel, jnp.asarray(every))
    force, _ = wrenches(both, frames)
    for half in (slice(0, 4), slice(4, 8)):
        alone = np.zeros(8, bool)
        alone[half] = True
        frames, one = meeting_of()(qpos, qvel, jnp.asarray(alone))
        expected, _ = wrenches(one, frames)
        assert np.abs(expected[..., half]).max() > 1
        assert np.allclose(force[..., half], expected[..., half], rtol=1e-12, atol=1e-12)


def test_who_is_nearest():
    draw = np.random.default_rng(0)
    place = draw.normal(size=(3, 12))
    present = draw.random(12) < 0.7
    present[6:] = False
    present[7] = True  # the only one of its world
    tags = np.arange(12.0) + 1
    toward, tag = nearest_robot(tuple(map(jnp.asarray, place)), 2, present, jnp.asarray(tags))
    toward = np.array(toward)
    for k in range(6):
        others = [j for j in range(6) if present[j] and j != k]
        best = min(others, key=lambda j: np.sum((place[:, j] - place[:, k]) ** 2))
        if present[k]:
            assert np.allclose(toward[:, k], place[:, best] - place[:, k])
            assert tag[k] == tags[best]
    assert np.allclose(toward[:, 7], (0, 0, NO_NEIGHBOUR)) and tag[7] == 0
    # Robots that are no longer finite are not seen, as if they were gone.
    gone = int(np.flatnonzero(present)[0])
    place[0, gone], there = np.nan, present & (np.arange(12) != gone)
    blind = nearest_robot(tuple(map(jnp.asarray, place)), 2, present, jnp.asarray(tags))
    left = nearest_robot(tuple(map(jnp.asarray, place)), 2, jnp.asarray(there), jnp.asarray(tags))
    for a, b in zip((*blind[0], blind[1]), (*left[0], left[1]), strict=True):
        assert np.array_equal(a[there], b[there])


# Edges [m] and masses [kg]; two of each meet.
ROD, PLATE, CUBE = ((0.2, 0.02, 0.02), 0.02), ((0.1, 0.1, 0.002), 0.02), ((0.1, 0.1, 0.1), 0.3)
PAIRS = ((ROD, ROD), (ROD, CUBE), (PLATE, PLATE), (PLATE, CUBE), (CUBE, CUBE), (ROD, PLATE))
ASIDE = (np.sqrt(0.5), 0.0, -np.sqrt(0.5), 0.0)  # x to z
ACROSS = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))  # x to y


@pytest.mark.parametrize("speed", [0.5, 2.0])
@pytest.mark.parametrize("dt", [0.005, 0.02])
def test_light_rods_and_thin_plates_do_not_pass_through(dt, speed):
    """Broadside, rods crosswise: 20 g and 2 mm. Momentum to rounding, energy only lost."""
    run, kinds = rigid_pairs(dt)
    qpos, qvel = np.zeros((7, 12)), np.zeros((6, 12))
    qpos[0, ::2], qpos[0, 1::2], qpos[1, 1::2] = -0.08, 0.08, 0.013
    qvel[0, ::2], qvel[0, 1::2] = speed / 2, -speed / 2
    qpos[3:] = np.transpose([(1, 0, 0, 0) if kind is CUBE else ASIDE for kind in kinds])
    qpos[3:, 1] = ACROSS
    q, v = map(np.asarray, run(jnp.asarray(qpos), jnp.asarray(qvel)))
    mass = np.array([kind[1] for kind in kinds])
    square = np.array([kind[0] for kind in kinds]).T ** 2
    inertia = mass / 12 * (square.sum(0) - square)
    pairs = lambda x: x[..., ::2] + x[..., 1::2]  # noqa: E731
    energy = pairs(0.5 * mass * (v[:, :3] ** 2).sum(1) + 0.5 * (inertia * v[:, 3:] ** 2).sum(1))
    start = pairs(0.5 * mass * speed**2 / 4)
    assert np.allclose(pairs(mass * v[:, :3]), pairs(mass * qvel[:3]), atol=1e-14)
    assert np.all(energy <= start * (1 + 1e-9)) and np.all(energy[-1] < 0.9 * start)
    assert (q[:, 0, 1::2] - q[:, 0, ::2]).min() > 0


@lru_cache(maxsize=8)
def rigid_pairs(dt: float):
    """Boxes without hinges, two in each world: (positions and velocities) → half a second."""
    space, kinds = world(timestep=dt), [kind for pair in PAIRS for kind in pair]
    robots = [box_robot(edges, mass, space) for edges, mass in kinds]
    return make_run(space, robots, len(PAIRS), round(0.5 / dt), 1), kinds


def make_run(space, robots, worlds, rows, every):
    """(qpos, qvel) → both along the way, of robots that touch; servos hold at 0."""
    capacity = fit_capacity(robots)
    tables = pack_bodies(robots, capacity, np.float64)
    spheres = pack_spheres(robots, capacity, dtype=np.float64)
    lanes = len(robots)

    @partial(jax.jit, compiler_options=QUICK)
    def run(packed, qpos, qvel):
        tables, spheres = packed
        rows_of = make_batched_trees(space, capacity, tables, lanes)
        present = jnp.ones(lanes, bool)
        meet = make_interaction(rows_of, spheres, present, worlds, ContactParameters())
        engine = PopulationEngine(rows_of, tables.plant, interaction=meet)
        still = jnp.zeros((tables.plant.num_rows, lanes))
        rollout = Rollout(engine, held(still), space, water_of(space))
        record = lambda now, ctrl, water: engine.observe(now.state)  # noqa: E731
        return rollout.advance(rollout.init(engine.init(qpos, qvel)), record, rows, every)[1]

    return partial(run, (tables, spheres))


@lru_cache(maxsize=8)
def duel(dt: float):
    """Two boxes of .1 m, .3 and .6 kg, without hinges; for half a second, every other step."""
    space = world(timestep=dt)
    robots = [box_robot((0.1, 0.1, 0.1), mass, space) for mass in (0.3, 0.6)]
    return make_run(space, robots, 1, round(0.5 / dt), 2), np.array([0.3, 0.6])


@pytest.mark.parametrize("speed", [0.1, 0.5])
def test_boxes_meet_without_passing_and_keep_momentum(speed):
    """Off centre, so that friction and torque act: momentum kept to rounding, energy only lost."""
    run, mass = duel(0.01)
    qpos = np.zeros((7, 2))
    qpos[0], qpos[1], qpos[3] = (-0.06, 0.06), (0.0, 0.03), 1
    qvel = np.zeros((6, 2))
    qvel[0] = (speed, -speed)
    q, v = map(np.asarray, run(jnp.asarray(qpos), jnp.asarray(qvel)))
    momentum = (mass * v[:, :3]).sum(-1)
    assert np.allclose(momentum, (mass * qvel[:3]).sum(-1), atol=1e-14)
    inertia = mass * 0.1**2 / 6  # of cubes, so that attitude does not matter
    turning = inertia * v[:, 3:6]  # body frame; both turn about z only
    orbit = np.cross(q[:, :3], mass[None, None] * v[:, :3], axis=1)
    start = np.cross(qpos[:3], mass * qvel[:3], axis=0).sum(-1)
    spun = (turning + orbit).sum(-1)
    # Position steps after velocity: dt v × F dt, of first order in dt.
    assert np.abs(spun[:, :2]).max() < 1e-14 and np.allclose(spun[:, 2], start[2], atol=1e-12)
    energy = (0.5 * mass * (v[:, :3] ** 2).sum(1) + 0.5 * inertia * (v[:, 3:] ** 2).sum(1)).sum(-1)
    assert energy.max() < 0.5 * (mass * qvel[0] ** 2).sum() * (1 + 1e-9)
    gap = q[:, :3, 1] - q[:, :3, 0]
    # Never deeper than a third of the two radii together, and apart again at the end.
    assert np.linalg.norm(gap, axis=1).min() > 0.1 * 2 / 3
    assert np.dot(gap[-1], (v[-1, :3, 1] - v[-1, :3, 0])) > 0


def test_jointed_robots_meet_fast_and_lose_energy():
    """Spiders, fish and snakes at 2 m/s: none through another, no energy made. Forces are equal
    and opposite; what is left of momentum is the step's own, of hinges that whip."""
    dt, names = 0.0125, ("spider", "fish", "snake", "spider", "spider", "spider")
    space = world(timestep=dt, self_contact=False)
    robots = [build_robot(body(name), space) for name in names]
    run = make_run(space, robots, 3, round(0.6 / dt), 1)
    qpos = np.zeros((7 + fit_capacity(robots).hinges, 6))
    qvel = np.zeros((len(qpos) - 1, 6))
    qpos[0], qpos[1, 1::2], qpos[3] = (-0.3, 0.3) * 3, 0.02, 1
    qvel[0] = (1.0, -1.0) * 3
    q, v = map(np.asarray, run(jnp.asarray(qpos), jnp.asarray(qvel)))
    energy, momentum = [], []
    for k, robot in enumerate(robots):
        model, data, found = robot.mj_model, mujoco.MjData(robot.mj_model), []
        for a, b in zip(q[:, :, k], v[:, :, k], strict=True):
            data.qpos[:], data.qvel[:] = a[: model.nq], b[: model.nv]
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_fwdVelocity(model, data)
            mujoco.mj_energyVel(model, data)
            mujoco.mj_subtreeVel(model, data)
            servos = 0.5 * robot.assembly.stiffness[2:] @ data.qpos[7:] ** 2
            motion = model.body_subtreemass[1] * data.subtree_linvel[1]
            found.append((data.energy[1] + servos, *motion))
        energy.append([x[0] for x in found])
        momentum.append([x[1:] for x in found])
    energy, momentum = np.array(energy), np.array(momentum)
    energy = energy[::2] + energy[1::2]
    # A position behind the velocity by half a step: springs that swing are off by as little.
    assert np.all(energy.max(1) < energy[:, 0] * 1.001)
    assert np.all(energy[:, -1] < 0.3 * energy[:, 0])
    assert (q[:, 0, 1::2] - q[:, 0, ::2]).min() > 0.05
    size = np.abs(momentum[::2, 0, 0])
    change = momentum[::2] + momentum[1::2]
    change = np.linalg.norm(change - change[:, :1], axis=-1).max(1) / size
    assert change.max() < 0.02
    assert change[2] < 1e-3  # two spiders mirror each other, nearly


def test_too_many_spheres_are_refused_by_name():
    _, robots, capacity, *_ = crowd_tables()
    with pytest.raises(InputError, match=r"robot 'spider': expected at most 5 spheres .* found 33"):
        pack_spheres(robots, capacity, count=5)
