"""Self-contact: depth, momentum, energy, mirrors, batches, MuJoCo's contacts, random bodies."""

import itertools
import re
from functools import lru_cache

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from experiments.random_bodies import random_body
from experiments.self_contact import make_march, random_gaits
from experiments.water_tank import EMPTY, march
from laboratory import QUICK, at_rest, batch_engine, body, fork, limp, need_mjx
from mjx_revolve import load_world
from mjx_revolve.body.morphology import make_morphology
from mjx_revolve.engine.batch import fit_capacity, pack_bodies
from mjx_revolve.engine.engines import make_engine
from mjx_revolve.engine.kinematics import body_poses
from mjx_revolve.engine.population import make_population_engine
from mjx_revolve.engine.robot import build_robot, check_timestep
from mjx_revolve.engine.self_overlap import self_overlap
from mjx_revolve.engine.self_pairs import candidate_pairs, part_gaps
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics.boxes import box_gap, pair_of
from mjx_revolve.water.flow import water_of

INWARDS = np.array([[0.785], [-0.785]])
SWUNG = 498, 1717
pytestmark = pytest.mark.slow


def water(**fields):
    return load_world("lake", **{"bed": None, "self_contact": True, **fields})


def open_jaw(robot, lanes=1):
    """Not the same on both sides: tips that meet head on slip to either side, by chance."""
    qpos, qvel = at_rest(robot, lanes, -2.0)
    qpos[7] = 0.3
    return qpos, qvel


@lru_cache(maxsize=16)
def jaw(**fields):
    """The tips of its arms meet when both swing inwards."""
    return build_robot(fork(3, 1), water(**fields))


def depths(robot, qpos):
    """`[T, lanes]` of `[T, nq, lanes]` [m]."""
    lanes = range(qpos.shape[-1])
    return np.stack([self_overlap(robot, qpos[..., k]).depth for k in lanes], -1)


def momentum(robot, qpos, qvel):
    """Linear and angular momentum about the core, and kinetic energy, by MuJoCo."""
    model, data = robot.mj_model, mujoco.MjData(robot.mj_model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    mujoco.mj_energyVel(model, data)
    linear = model.body_subtreemass[1] * data.subtree_linvel[1]
    return np.concatenate([linear, data.subtree_angmom[1]]), data.energy[1]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("timestep", [0.005, 0.01, 0.02])
def test_servos_at_full_torque_press_less_than_2_mm(timestep):
    robot = jaw(timestep=timestep)
    qpos, qvel = open_jaw(robot)
    qpos = march(robot, 2.0, qpos, qvel, INWARDS)[1]
    assert depths(robot, qpos).max() < 2e-3
    assert np.abs(qpos[-1, 7:] - INWARDS).max() > 0.05  # they do press
    # At 20 ms the end stop that one arm is pressed against lets go in every other step.
    assert np.ptp(qpos[-20:, 7:], 0).max() < 1e-3


@pytest.mark.parametrize("timestep", [0.005, 0.02])
def test_a_plate_that_is_pressed_flat_on_a_face_lies_still(timestep):
    """The end of an arm that is folded onto the core: two hinges turn it, a face carries it."""
    tip = {"type": "FixedBrick", "children": {3: {"type": "ActiveHinge", "orientation": 270}}}
    arm = {"type": "FixedBrick", "children": {3: tip}}
    arm = {"type": "ActiveHinge", "orientation": 180, "children": {1: arm}}
    folded = make_morphology({"type": "Core", "children": {3: arm}}, name="folded")
    robot = build_robot(folded, water(timestep=timestep))
    qpos, qvel = at_rest(robot, 2, -2.0)
    qpos = march(robot, 2.0, qpos, qvel, np.array([[0.43, 0.43], [-0.1, 0.4]]))[1]
    assert depths(robot, qpos).max() < 1e-3
    later = qpos[round(1 / timestep) :, 7:]
    assert np.abs(later).max() < 0.05  # it is pressed
    # Rattling, it had 26 rad/s at 5 ms and 3.5 at 20 ms.
    assert np.abs(np.diff(later, axis=0)).max() / timestep < 2.0


def test_a_hinge_ends_where_its_neighbours_meet():
    """An arm on the inner side of a brick: its servo holder meets the core's other brick."""
    robot, free = (build_robot(fork(1, 0), water(self_contact=x)) for x in (True, False))
    assert len(robot.assembly.meeting_pairs) == 0
    np.testing.assert_array_equal(free.assembly.stops, free.assembly.range)
    low, high = robot.assembly.stops[robot.assembly.moved].T
    reach = robot.assembly.range[-1, 1]
    np.testing.assert_allclose([low[0], high[1]], [-reach, reach])
    assert 0.3 < high[0] < 0.7
    assert low[1] == pytest.approx(-high[0], abs=1e-9)
    np.testing.assert_allclose(robot.mj_model.jnt_range[1:], np.stack([low, high], 1))
    # By MuJoCo: just inside of the stop nothing of the neighbours touches, just outside it does.
    model = free.mj_model
    model.geom_contype[:] = model.geom_conaffinity[:] = 1
    model.body_contype[:] = model.body_conaffinity[:] = 1
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_FILTERPARENT
    hinge = free.assembly.moved[0]
    counts = []
    for angle in (0.0, high[0] - 0.002, high[0] + 0.005):
        data = mujoco.MjData(model)
        data.qpos[7] = angle
        mujoco.mj_forward(model, data)
        pairs = {frozenset(c.geom.tolist()) for c in data.contact[: data.ncon]}
        own = [model.geom_bodyid[list(pair)].tolist() for pair in pairs]
        counts.append(sum(hinge in pair for pair in own))
    assert counts[0] == counts[1] < counts[2]


@pytest.mark.parametrize("timestep", [0.0125, 0.02])
def test_a_hinge_that_is_pressed_against_its_end_lies_still(timestep):
    """At long steps it lost its stop for what the servo adds within the step, and trembled."""
    robot = build_robot(fork(1, 0), load_world("lake", bed=None, timestep=timestep))
    targets = np.array([[0.78, -0.78, 0.78, 0.6], [-0.78, 0.78, 0.78, -0.6]])
    _, qpos, qvel, _ = march(robot, 4.0, *at_rest(robot, 4, -2.0), targets)
    assert np.abs(qvel[-40:, 6:]).max() < 1e-3
    low, high = robot.assembly.stops[robot.assembly.moved].T
    assert qpos[-1, 7:] == pytest.approx(np.clip(targets.T, low, high).T, abs=0.02)


def test_contact_keeps_momentum_and_takes_energy():
    """Of the same state, a step with and one without contact."""
    robot, free = jaw(**EMPTY), jaw(**EMPTY, self_contact=False)
    draw = np.random.default_rng(0)
    lanes = 64
    qpos, qvel = at_rest(robot, lanes)
    qpos[7:] = np.sign(INWARDS) * draw.uniform(0.6, 0.66, (2, lanes))
    qvel[:] = draw.normal(size=qvel.shape)
    qvel[6:] = 5 * np.sign(INWARDS) * draw.uniform(0, 1, (2, lanes))
    robot, free = limp(robot), limp(free)
    after, alone = (march(x, x.world.timestep, qpos, qvel)[2][0] for x in (robot, free))
    hit = np.abs(after - alone).max(0) > 1e-6
    assert 5 < hit.sum() < lanes
    np.testing.assert_array_equal(after[:, ~hit], alone[:, ~hit])
    for k in np.flatnonzero(hit):
        change, energy = momentum(robot, qpos[:, k], after[:, k] - alone[:, k])
        size = np.sqrt(2 * energy * robot.mj_model.body_mass.sum())
        assert np.abs(change).max() < 1e-11 * max(size, 1e-3)
        taken = momentum(robot, qpos[:, k], after[:, k])[1]
        assert taken < momentum(robot, qpos[:, k], alone[:, k])[1]


def feel(make, qpos, ctrl, wrench, steps):
    """After so many steps from rest: qpos, servo torques, and what contacts do to bodies, and to
    halves of modules, and to bodies under a wrench."""
    with jax.enable_x64(True):

        def run(qpos, wrench):
            engine, calm = make(), water_of(load_world("lake", **EMPTY))
            arranged = engine.plant.arrange(jnp.asarray(ctrl))
            state = engine.with_touch(engine.init(qpos, jnp.zeros_like(qpos[1:])))
            step = lambda _, now: engine.step(now, arranged, calm)[0]  # noqa: E731
            state = jax.lax.fori_loop(0, steps, step, state)
            forces = [engine.contact_force(state, calm, x) for x in ((), wrench)]
            torque = engine.servo_torque(state, arranged)
            halves = engine.contact_by_half(state, calm)
            return engine.observe(state)[0], torque, forces[0], halves, forces[1]

        found = jax.jit(run, compiler_options=QUICK)(jnp.asarray(qpos, float), wrench)
        return jax.tree.map(np.asarray, found)


def two_jaws(robot):
    """An open jaw and its mirror image."""
    qpos, _ = open_jaw(robot, 2)
    qpos[7:, 1] = -qpos[:6:-1, 0]
    return qpos


def test_touch_sensors_feel_the_robots_own_modules():
    robot = jaw(**EMPTY)
    ctrl = np.tile(INWARDS, 2)
    rest, torque, touch, halves, _ = feel(
        lambda: make_engine(robot), two_jaws(robot), ctrl, (), 400
    )
    assert not touch[0].any()
    np.testing.assert_array_equal(touch[1], touch[2])
    # The arm that is not at its end stop rests between its servo and the other arm.
    model, data = robot.mj_model, mujoco.MjData(robot.mj_model)
    data.qpos[:] = rest[:, 0]
    mujoco.mj_forward(model, data)
    arms = [np.flatnonzero(model.geom_bodyid == body) for body in (2, 3)]
    ends, gaps = np.zeros((2, 3)), {}
    for pair in itertools.product(*arms):
        gaps[pair] = mujoco.mj_geomDistance(model, data, *pair, 0.01, None)
    mujoco.mj_geomDistance(model, data, *min(gaps, key=gaps.get), 0.01, ends.ravel())
    normal = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    free = int(np.abs(rest[7:, 0]).argmin())
    arm = ends.mean(0) - data.xanchor[1 + free]
    lever = abs(normal @ np.cross(data.xaxis[1 + free], arm))
    assert touch[1, 0] * lever == pytest.approx(np.abs(torque[free, 0]), rel=0.01)
    # The tip of the right arm, which looks ahead, is pressed on its left half.
    pressed = np.array(halves)
    left, right = 6, 12
    if data.xpos[2, 0] > data.xpos[3, 0]:
        left, right = right, left
    for lane in range(2):
        expected = np.zeros((13, 2))
        expected[right, 0] = expected[left, 1] = touch[1, lane]
        np.testing.assert_array_equal(pressed[..., lane], expected)


def test_different_bodies_feel_themselves_and_others_as_one_alone_does():
    robot = jaw(**EMPTY)
    robots = [robot, build_robot(body("spider"), robot.world), robot]
    capacity = fit_capacity(robots)
    qpos, ctrl = np.zeros((7 + capacity.hinges, 3)), np.zeros((capacity.hinges, 3))
    qpos[:, 1] = at_rest(robots[1], 1, -2.0)[0][: len(qpos), 0]
    qpos[:9, [0, 2]], ctrl[:2, [0, 2]] = two_jaws(robot), INWARDS
    alone = feel(lambda: make_engine(robot), qpos[:9, [0, 2]], ctrl[:2, [0, 2]], (), 100)
    hinge = np.asarray(pack_bodies(robots, capacity).plant.source[: capacity.rows])
    push = (np.zeros((1, 3)), np.zeros((1, 3)), np.full((1, 3), -4.0))
    aside = (0.0 * hinge[:, None], 3.0 * (hinge == 1)[:, None], 0.0 * hinge[:, None])
    wrench = ((push, push), (aside, aside))
    many = lambda: batch_engine(robots, capacity, 3)  # noqa: E731
    _, _, touch, _, pushed = feel(many, qpos, ctrl, wrench, 100)
    assert not touch[:, 1].any()
    for lane, own in ((0, 0), (2, 1)):
        for row, force in enumerate(alone[2][1:, own]):
            found = touch[1:][hinge[:, lane] == row, lane]
            assert force > 1 and found == pytest.approx(force, rel=1e-9)
        assert (pushed - touch)[0, lane] == pytest.approx(4)
        assert (pushed - touch)[1:, lane] == pytest.approx(3.0 * (hinge[:, lane] == 1), abs=1e-9)


def gaits(robots, capacity, steps):
    """Four random ones of each robot, side by side."""
    ctrl = np.zeros((steps, capacity.hinges, 4 * len(robots)))
    for k, robot in enumerate(robots):
        ctrl[:, : robot.num_hinges, 4 * k : 4 * k + 4] = random_gaits(robot, 4, steps, k)
    return ctrl


def march_batch(robots, capacity, ctrl):
    """`[steps, nq, robots * 4]` of different bodies side by side, in float64."""
    run = jax.jit(make_march(robots[0].world, capacity, len(ctrl)))
    with jax.enable_x64(True):
        bodies = pack_bodies([r for r in robots for _ in range(4)], capacity, np.float64)
        run = run.lower(bodies, jnp.asarray(ctrl)).compile(QUICK)
        return np.asarray(run(bodies, jnp.asarray(ctrl)))


@pytest.fixture
def other_back_end(monkeypatch):
    """Makes contact what it is where there is no CPU, on this one: its kernels are not fused."""

    def change():
        monkeypatch.setenv("MJX_REVOLVE_FUSE", "0")
        monkeypatch.setattr("mjx_revolve.engine.self_contact.on_cpu", lambda: False)

    return change


def test_robots_that_are_looked_at_all_at_once_feel_the_same(other_back_end):
    robot = build_robot(fork(3, 1), water(timestep=0.01))
    qpos, qvel = open_jaw(robot, 3)
    qpos[7, 1] = 0.5
    usual = march(robot, 0.6, qpos, qvel, INWARDS)[1]
    assert 0 < depths(robot, usual).max() < 1e-3
    other_back_end()
    np.testing.assert_allclose(march(robot, 0.6, qpos, qvel, INWARDS)[1], usual, atol=1e-9)


@pytest.mark.long
def test_different_bodies_that_are_looked_at_all_at_once_feel_the_same(other_back_end):
    """But for what forces are solved to: contacts stand in another order."""
    world, steps = water(timestep=0.02), 40
    robots = [build_robot(random_body(k, 4 + k % 9, 6), world) for k in range(100, 112)]
    capacity = fit_capacity(robots)
    ctrl = gaits(robots, capacity, steps)
    usual = march_batch(robots, capacity, ctrl)
    other_back_end()
    found = march_batch(robots, capacity, ctrl)
    np.testing.assert_allclose(found[0], usual[0], atol=5e-4)  # 20 µm at the end of 4 cm
    for k, robot in enumerate(robots):
        assert depths(robot, found[:, : 7 + robot.num_hinges, 4 * k : 4 * k + 4]).max() < 3e-3


@pytest.mark.parametrize("seed", [23, 63, 77, 101, 166, 197])
def test_boxes_that_overlap_by_millimetres_at_rest_are_in_contact_and_end_hinges(seed):
    """All pairs of modules that are not attached, in poses within the hinges' limits."""
    robot = build_robot(random_body(seed, 3 + seed % 6, 3 + seed % 6), water())
    assembly, table = robot.assembly, robot.fluid
    body, above = table.body, [m.parent for m in robot.morphology.modules]
    pairs = np.array(
        [
            (i, j)
            for i, j in itertools.combinations(range(len(body)), 2)
            if body[i] != body[j]
            and (one := table.module[i]) != (other := table.module[j])
            and above[one] != other
            and above[other] != one
        ]
    )
    rest = part_gaps(assembly, pairs)
    assert (rest < -1e-4).any() and not robot.morphology.overlaps
    beside = (assembly.parent[body[pairs]] == body[pairs][:, ::-1]).any(1)
    listed = {tuple(pair) for pair in candidate_pairs(assembly).tolist()}
    assert {tuple(pair) for pair in pairs[~beside].tolist()} <= listed
    stops = assembly.stops[assembly.moved]
    assert np.all(stops[:, 1] - stops[:, 0] > 0.01)
    qpos = np.zeros((200, 7 + len(stops)))
    qpos[:, 3] = 1
    qpos[:, 7:] = np.random.default_rng(seed).uniform(*stops.T, (200, len(stops)))
    position, turn = body_poses(robot, qpos)
    for (i, j), gap in zip(pairs[beside], rest[beside], strict=True):
        boxes = []
        for k in (i, j):
            own = turn[:, body[k]]
            half = np.broadcast_to(table.half_size[k], (200, 3))
            boxes += [position[:, body[k]] + own @ table.position[k], own @ table.rotation[k], half]
        assert box_gap(pair_of(*boxes)).min() > min(gap, 0) - 6e-4


def test_contacts_are_mujocos():
    """Which pairs, when, and how deep: MuJoCo's contacts of the same model."""
    draw, seen = np.random.default_rng(0), 0
    for seed in (12, 25, 37, 51):
        robot = build_robot(random_body(seed, 4 + seed % 13, 6), water())
        model, data = robot.mj_model, mujoco.MjData(robot.mj_model)
        qpos = np.zeros((60, model.nq))
        qpos[:, 3] = 1
        stops = robot.assembly.stops[robot.assembly.moved]
        qpos[:, 7:] = draw.uniform(*stops.T, (60, len(stops)))
        found = self_overlap(robot, qpos)
        modules = [m.name for m in robot.morphology.modules]
        for q, depth, first, second in zip(qpos, *found, strict=True):
            data.qpos[:] = q
            mujoco.mj_forward(model, data)
            deepest = min(data.contact[: data.ncon], key=lambda c: c.dist, default=None)
            theirs = 0.0 if deepest is None else max(-deepest.dist, 0.0)
            if 0 < depth < 0.005:
                assert depth == pytest.approx(theirs, abs=1e-4)
                names = {model.geom(int(g)).name.split("/")[0] for g in deepest.geom}
                assert names == {modules[first], modules[second]}
                seen += 1
            assert (depth > 1e-4) == (theirs > 1e-4)
    assert seen > 5


def test_a_level_of_hinges_that_bring_nothing_together_is_no_exception():
    """Beside arms that meet: a tail of hinges alone, whose levels' reaches are 0 throughout."""
    two = fork(3, 1).to_mapping()["body"]
    tail = {"type": "ActiveHinge"}
    for _ in range(3):
        tail = {"type": "ActiveHinge", "orientation": 90, "children": {1: tail}}
    two["children"][0] = tail
    robot = build_robot(make_morphology(two, name="tail"), water())
    engine = make_population_engine(robot)
    assert [np.any(level.hinges.lever) for level in engine.tree.below] == [True, *[False] * 3]
    start = engine.init(*map(jnp.asarray, at_rest(robot, 2, -2.0)))
    ctrl = jnp.zeros((robot.num_hinges, 2))
    step = lambda s, c: engine.step(s, c, water_of(robot.world))[0]  # noqa: E731
    assert jax.eval_shape(step, start, ctrl).clearance.shape == (2,)


def test_pairs_that_can_never_meet_cost_nothing():
    """A spider's and a fish's step is, operation by operation, the one without self-contact."""
    assert len(candidate_pairs(build_robot(body("spider"), water()).assembly)) > 100
    for name in ("spider", "fish"):
        programs = []
        for on in (True, False):
            robot = build_robot(body(name), water(self_contact=on))
            engine = make_population_engine(robot)
            start = engine.init(*map(jnp.asarray, at_rest(robot, 4)))
            ctrl = jnp.zeros((robot.num_hinges, 4))
            step = lambda s, c, e=engine, r=robot: e.step(s, c, water_of(r.world))  # noqa: E731
            programs.append(str(jax.make_jaxpr(step)(start, ctrl)))
        assert programs[0] == programs[1]
    snake = build_robot(body("snake"), water()).assembly
    ends = {snake.names[k] for k in snake.fluid.body[snake.meeting_pairs].ravel()}
    assert 0 < len(snake.meeting_pairs) < 12  # its ends meet when it curls up
    assert len(ends) <= 6


@pytest.mark.sampled(1)
@pytest.mark.parametrize("timestep", [0.005, 0.02])
def test_random_bodies_under_fast_random_gaits_hardly_overlap(timestep):
    """Also two of ten thousand whose servos swung parts into each other that, at the speeds at
    which the step began, would have stayed apart."""
    world = water(timestep=timestep)
    robots = [build_robot(random_body(k, 4 + k % 9, 6), world) for k in (*range(100, 164), *SWUNG)]
    robots = [r for r in robots if len(r.assembly.meeting_pairs)]
    assert len(robots) > 20
    capacity, steps = fit_capacity(robots), round(2.0 / timestep)
    ctrl = gaits(robots, capacity, steps)
    for k, number in enumerate(SWUNG, len(robots) - len(SWUNG)):
        gait = random_gaits(robots[k], 1, steps, number)
        ctrl[:, : robots[k].num_hinges, 4 * k : 4 * k + 4] = gait
    found = march_batch(robots, capacity, ctrl)
    assert np.isfinite(found).all()
    deep = np.concatenate(
        [
            depths(robot, found[:, : 7 + robot.num_hinges, 4 * k : 4 * k + 4]).max(0)
            for k, robot in enumerate(robots)
        ]
    )
    assert deep.max() < 3e-3
    assert np.median(deep) < 1e-3


def test_mjx_refuses_modules_that_can_meet():
    """And says which; a body whose modules cannot meet swims in both engines."""
    need_mjx()
    words = "self_contact: expected false with engine: mjx.* modules '(.*)' and '(.*)' can meet"
    with pytest.raises(InputError, match=words) as found:
        make_engine(jaw(), "mjx")
    match = re.search(words, str(found.value))
    assert match and {m.name for m in jaw().morphology.modules} > set(match.groups())
    check_timestep(build_robot(body("spider"), water()), "mjx")
