"""Different bodies in one batch: against the step for one body, and that padding changes nothing.

Tolerances: accelerations agree to 1e-9 relative in float64 (sums run in another order; velocities
and inertias span four decades), scores over 200 float32 steps to 1e-5.
"""

from dataclasses import replace
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.random_bodies import random_body
from laboratory import (
    QUICK,
    ROOT,
    WATER,
    accelerate,
    body,
    check_refused,
    random_states,
    read,
    world,
)
from mjx_revolve import MODULES, load_config, load_morphology, make_fitness, make_mixed_fitness
from mjx_revolve.body.edits import add_module
from mjx_revolve.control.controller import gene_indices
from mjx_revolve.engine.batch import PartGroup, fit_capacity, order_rows, pack_bodies
from mjx_revolve.engine.batched_trees import make_batched_trees
from mjx_revolve.engine.population import PopulationEngine, acceleration
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.engine.step_constants import read_constants
from mjx_revolve.episodes.config import make_config
from mjx_revolve.episodes.fitness import fit_body
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics.xla import fuse
from mjx_revolve.water.flow import water_of

BED = {"kind": "flat", "height": -5.0}
WORLDS = {
    "everything": WATER,  # with thrusters and fins, too
    "waves and bed": WATER
    | {"bed": BED, "waves": [{"amplitude": 0.02, "wavelength": 1.0, "direction": 0.5}]},
    "default": WATER,
    "near the surface": WATER | {"near_surface": True},
    "ellipsoid": {"gravity": 9.81, "buoyancy": "partial", "drag": "ellipsoid"},
    "inertia_box": {"drag": "inertia_box"},
}


@lru_cache(maxsize=8)
def zoo(name):
    """A random tree, a chain, a body without hinges; in "everything" thrusters and fins instead."""
    tank = world(**WORLDS[name])
    bodies = [random_body(4, 5, 9), body("snake"), body("core")]
    if name == "everything":  # three groups of laws take three times as long to compile
        bodies[1:] = [body("auv"), body("fish")]
    return tuple(build_robot(b, tank) for b in bodies)


pytestmark = pytest.mark.usefixtures("quick_compiles")


def states(robots, capacity, each, depth):
    """`[7 + hinges, lanes]`, `[6 + hinges, lanes]`, commands, and each robot's own."""
    lanes, hinges = len(robots) * each, capacity.hinges
    qpos, qvel = np.zeros((7 + hinges, lanes)), np.zeros((6 + hinges, lanes))
    ctrl, own = np.zeros((hinges + capacity.thrusters, lanes)), []
    for k, robot in enumerate(robots):
        q, v = random_states(robot, each, seed=k, depth=depth)
        c = np.random.default_rng(k).uniform(-0.7, 0.7, (robot.mj_model.nu, each))
        own.append((q, v, c))
        here = slice(k * each, (k + 1) * each)
        qpos[: len(q), here], qvel[: len(v), here] = q, v
        ctrl[: robot.num_hinges, here] = c[list(robot.servos)]
        ctrl[hinges : hinges + robot.num_thrusters, here] = c[list(robot.thrusters)]
    return (qpos, qvel, ctrl), own


def pack(robots, capacity, each):
    """The tables in float64, so many of each robot."""
    bodies = pack_bodies([r for r in robots for _ in range(each)], capacity, np.float64)
    return jax.tree.map(jnp.asarray, bodies)


def resize_capacity(capacity, **changes):
    """A capacity with other room; what is constant stays so."""
    found = replace(capacity, **changes)

    def sized(level, count, points):
        pairs = zip(level.parts, found.groups, strict=True)
        parts = tuple(replace(p, count=count(g)) for p, g in pairs)
        touching = level.points and replace(level.points, count=points)
        return replace(level, parts=parts, points=touching)

    row = sized(found.row, lambda group: group.parts, found.points)
    root = sized(found.root, lambda group: group.root_parts, found.root_points)
    return replace(found, row=row, root=root)


@lru_cache(maxsize=8)
def accelerator(tank, capacity):
    """`step.acceleration` of packed bodies."""

    def run(bodies, q, v, c):
        rows = make_batched_trees(tank, capacity, bodies, q.shape[-1])
        return acceleration(rows, q, v, bodies.plant.arrange(c), water_of(tank))

    return jax.jit(fuse(run, inline=True), compiler_options=QUICK)


def mixed_acceleration(robots, capacity, each, arrays):
    """`step.acceleration` of all robots side by side, in float64."""
    with jax.enable_x64(True):
        jitted = accelerator(robots[0].world, capacity)
        return np.asarray(jitted(pack(robots, capacity, each), *map(jnp.asarray, arrays)))


@pytest.mark.slow
@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", WORLDS)
def test_accelerations_are_those_of_each_body_alone(name):
    robots = zoo(name)
    capacity = fit_capacity(robots)
    # Half under water, and half of the lanes with some points in the bed, where there is one.
    depth = np.array([0.0, 0.0, 4.95, 4.95]) if name == "waves and bed" else 0.0
    arrays, own = states(robots, capacity, 4, depth)
    found = mixed_acceleration(robots, capacity, 4, arrays)
    for k, (robot, (q, v, c)) in enumerate(zip(robots, own, strict=True)):
        lanes = slice(4 * k, 4 * k + 4)
        # A number that all lanes share is no constant to divide by.
        same = [np.tile(x[:, lanes], len(robots)) for x in arrays]
        alike = mixed_acceleration([robot] * len(robots), capacity, 4, same)[:, lanes]
        expected = accelerate(robot, q, v, c)
        scale = np.abs(expected).max(0)
        for here in (found[:, lanes], alike):
            assert np.all(np.abs(here[: len(v)] - expected).max(0) < 1e-9 * scale), k
            assert np.all(here[len(v) :] == 0)


@pytest.mark.long
def test_more_padding_and_more_overflow_rows_change_nothing():
    """More rows, a deeper stack, a larger root, and bodies cut into more or fewer rows."""
    robots = zoo("waves and bed")
    capacity = fit_capacity(robots)
    depth = np.array([0.0, 0.0, 4.95, 4.95])
    arrays, _ = states(robots, capacity, 4, depth)
    found = mixed_acceleration(robots, capacity, 4, arrays)
    scale = np.abs(found).max(0)
    groups = tuple(g._replace(root_parts=g.root_parts + 2) for g in capacity.groups)
    padded = resize_capacity(
        capacity, rows=capacity.rows + 5, slots=capacity.slots + 1, groups=groups,
        pairs=capacity.pairs + 3,
    )  # fmt: skip
    again = mixed_acceleration(robots, padded, 4, arrays)
    assert np.all(np.abs(again - found).max(0) < 1e-11 * scale)
    # One part in each row, and one on the root, which then has overflow rows of its own.
    groups = tuple(g._replace(parts=1, root_parts=1) for g in capacity.groups)
    points = dict.fromkeys(("points", "root_points"), 8 if capacity.points else 0)
    single = resize_capacity(capacity, rows=40, slots=5, groups=groups, **points)
    order = order_rows(read_constants(robots[0].assembly), groups)
    assert order.length[0] == len(robots[0].fluid.volume) - 1
    assert np.sum(order.overflow & (order.body == 1)) > 0
    again = mixed_acceleration(robots, single, 4, arrays)
    assert np.all(np.abs(again - found).max(0) < 1e-9 * scale)


@pytest.mark.slow
def test_a_body_in_several_rows_steps_as_in_one():
    """How much of its drag a step takes implicitly follows from the whole body."""
    robot = zoo("default")[0]
    arrays, _ = states([robot], roomy := fit_capacity([robot]), 1, 0.0)

    def march(capacity):
        def run(bodies, q, v, c):
            trees = make_batched_trees(robot.world, capacity, bodies, 1)
            engine, ctrl = PopulationEngine(trees, bodies.plant), bodies.plant.arrange(c)
            step = lambda k, state: engine.step(state, ctrl, water_of(robot.world))[0]  # noqa: E731
            return engine.observe(jax.lax.fori_loop(0, 10, step, engine.init(q, v)))[0]

        with jax.enable_x64(True):
            run = jax.jit(run, compiler_options=QUICK)
            return np.asarray(run(pack([robot], capacity, 1), *map(jnp.asarray, arrays)))

    groups = tuple(g._replace(parts=1, root_parts=1) for g in roomy.groups)
    narrow = resize_capacity(roomy, rows=40, slots=5, groups=groups)
    found = march(narrow)
    np.testing.assert_allclose(found, march(roomy), atol=1e-12)
    assert np.abs(found - arrays[0]).max() > 1e-3


def test_a_short_stack_holds_any_tree():
    """Slots stay below log2 of the bodies, and every row finds its parent in its slot."""
    tank = world(**WATER)
    for seed in range(12):
        robot = build_robot(random_body(seed, 2 + seed, 3), tank)
        assembly = robot.assembly
        columns = read_constants(assembly)
        for parts, root in ((1, 99), (2, 99), (5, 99), (2, 1), (3, 4)):
            groups = [PartGroup(laws, parts, root) for laws in columns.laws]
            rows = order_rows(columns, groups)
            assert 2 ** (rows.slot.max() + 1) - 1 <= rows.length[0] + 1 == len(rows.slot) + 1
            stack = {0: 1}  # the root
            each = zip(rows.body, rows.overflow, rows.source, rows.slot, strict=True)
            for own, overflow, source, slot in each:
                assert stack[source] == (own if overflow else assembly.parent[own])
                stack[slot] = None if overflow else own


@pytest.mark.slow
def test_room_for_all_bodies_of_so_many_modules():
    """Whatever their shape; and no more than a few rows that none of them needs."""
    tank = world(**WATER, bed=BED)
    few = [build_robot(random_body(seed, 4, 4), tank) for seed in range(6)]
    capacity = fit_capacity(few, hinges=7, modules=15)
    # Chains of hinges, stars of bricks, and what lies between them.
    bodies = [random_body(seed, hinges, 14 - hinges) for hinges in range(8) for seed in range(12)]
    bodies += [random_body(0, hinges, bricks) for hinges in (1, 3) for bricks in (0, 2)]
    packed = pack_bodies([build_robot(body, tank) for body in bodies], capacity)
    assert packed.count.max() <= capacity.rows <= packed.count.max() + 4
    with pytest.raises(InputError, match="expected at most 7 hinges; found 8"):
        pack_bodies([build_robot(random_body(0, 8, 0), tank)], capacity)
    # On land what nothing but the bed acts on touches it.
    land = world(buoyancy="off", drag="off", added_mass=False, self_contact=False, bed=BED)
    room = fit_capacity([build_robot(random_body(0, 4, 1), land)], modules=15)
    assert min(room.points, room.root_points) >= 8
    # A drag law of whole bodies lets no part of them overflow into another row.
    tank = world(drag="inertia_box")
    capacity = fit_capacity([build_robot(random_body(0, 4, 1), tank)], hinges=7, modules=15)
    assert pack_bodies([build_robot(body, tank) for body in bodies], capacity).count.max() <= 15
    jet = MODULES["Thruster"]
    three = tuple(replace(jet.parts[0], name=name) for name in "abc")
    kinds = [replace(jet, parts=three), replace(jet, mount=None)]
    assert fit_capacity(few, kinds, modules=4).thrusters == 1 + 3 * 3


@pytest.fixture(scope="module")
def config():
    return load_config(
        ROOT / "experiments" / "sine_swim.yaml",
        overrides={"task.duration": 1.0, "task.settle": 0.2, "trim": "none"},
    )


@pytest.fixture(scope="module")
def fitness(config):
    """Episodes are short: its scores are compared to the bit."""
    short = {"task.duration": 0.4, "task.settle": 0.1, "world.self_contact": False}
    return make_mixed_fitness(config, [random_body(3, 6), body("snake")], **short)


def alone(config, robot, folder, **overrides):
    """The fitness of one body by itself."""
    path = folder / f"{robot.morphology.name}.yaml"
    robot.morphology.save(path)
    return make_fitness(config, morphology=str(path), **overrides)


@pytest.mark.slow
def test_scores_do_not_depend_on_who_swims_beside(fitness):
    robots = [fitness.build(random_body(3, 6)), fitness.build(body("snake"))]
    draw, key = np.random.default_rng(0), jax.random.key(1)
    pick = [0, 1, 1, 0, 1]
    own = [draw.normal(size=7 * robots[k].num_hinges + 1).astype(np.float32) for k in pick]
    genes = jnp.stack([fitness.pad_genes(g, robots[k]) for g, k in zip(own, pick, strict=True)])
    scores = fitness([robots[k] for k in pick], genes, key)
    for wide, given, k in zip(genes, own, pick, strict=True):
        assert np.array_equal(fitness.own_genes(wide, robots[k]), given)
    # The same program for other bodies, and bits that do not depend on who swims beside.
    compiled = fitness.program(genes, key).cache_size()
    others = [robots[1], robots[0], *(robots[k] for k in pick[2:])]
    swapped = jnp.stack([genes[1], genes[0], *genes[2:]])
    once_more = fitness(others, swapped, key)
    assert fitness.program(genes, key).cache_size() == compiled
    assert np.array_equal(np.asarray(once_more)[[1, 0, 2, 3, 4]], np.asarray(scores))
    # Nor on whether they all happen to have its body.
    snakes = fitness([robots[1]] * 5, swapped.at[1:].set(0.0), key)
    assert np.asarray(snakes)[0] == np.asarray(scores)[1]
    assert np.asarray(fitness([robots[1]], swapped[:1], key))[0] == np.asarray(scores)[1]
    # A length that all lanes share is no constant to divide by.
    drawn = jnp.asarray(draw.normal(size=(15, swapped.shape[1])), jnp.float32)
    beside = [fitness([robots[1]] * 5, drawn[k : k + 5], key) for k in (0, 5, 10)]
    lone = [fitness([robots[1]], drawn[k : k + 1], key) for k in range(15)]
    assert np.array_equal(np.concatenate(lone), np.concatenate(beside))


OWN = """
import jax.numpy as jnp
from mjx_revolve.control import GeneBlocks, make_controller

def make_wave(plant, settings):
    def decode(genes, plant):
        return plant.arrange(genes), plant.reach(genes), plant.middle(genes)

    def step(parameters, state, time, sense):
        late, reach, middle = parameters
        return state, middle + reach * jnp.sin(6.0 * time + late) * jnp.tanh(10 * time)

    genes = GeneBlocks(plant, ("late", "actuator")).genes
    return make_controller(plant, genes, decode, lambda p: (), step)
"""


CRAWL = {"task.type": "crawl"}
# With a memory of the last step, of older samples, and noise at each hinge.
NOISY = {
    "controller.sensors": [
        "accelerometer",
        {"type": "load", "noise": 0.01, "delay": 0.02},
        {"type": "angle", "noise": 0.1, "rate": 20},
        {"type": "battery", "range": [0, 1]},
        "bearing",
    ],
    "task.type": "reach_target",
    "task.target_distance": 1.0,
    "task.target_speed": 0.2,
}


@pytest.mark.slow
@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("kind", "other", "tank", "task", "checked"),
    [
        ("own", "fish", {"name": "lake", "bed": {"kind": "flat", "height": -3.0}}, CRAWL, 0),
        ("feedback", "auv", {"name": "lake", "gust": {"std": 0.05, "time": 2.0}},
         {"task.trials": 2, "task.robust": {"motor": 2.0}}, 1),
        ("cpg", "fish", {"name": "lake", "waves": [{"amplitude": 0.02, "wavelength": 1.0}]}, {}, 1),
        ("rnn", "auv", {"name": "lake"}, NOISY, 1),
        ("sensory_cpg", "snake", {"name": "lake"}, NOISY, 1),
    ],
)  # fmt: skip
def test_every_controller_drives_every_body(config, tmp_path, kind, other, tank, task, checked):
    """With thrusters of other thrust and fins, crawling, in gusts and waves: as if alone."""
    (tmp_path / "own.py").write_text(OWN)
    settings = {
        "controller.type": f"{tmp_path / 'own.py'}:make_wave" if kind == "own" else kind,
        "controller.harmonics": 1, "world": tank, "task.duration": 1.0, "task.settle": 0.2,
        "task.depth": 0.5, **task,
    }  # fmt: skip
    bodies = [random_body(4, 4, 3), body(other)]
    fitness = make_mixed_fitness(config, bodies, **settings)
    robots, key = [fitness.build(b) for b in bodies], jax.random.key(2)
    genes = 0.7 * jax.random.normal(jax.random.key(3), (len(robots), fitness.num_genes))
    scores, measures = fitness.evaluate(robots, genes, key)
    for k, robot in list(enumerate(robots))[checked : checked + 1]:
        single = alone(config, robot, tmp_path, **settings)
        own = fitness.own_genes(genes[k : k + 1], robot)
        expected, more = single.evaluate(own, key)
        # In float32; a loop that feels what it does amplifies the rounding.
        assert float(scores[k]) == pytest.approx(float(expected[0]), abs=1e-4)
        for name, value in more.items():
            found = float(measures[name][k])
            assert found == pytest.approx(float(value[0]), rel=2e-3, abs=1e-4), name


KINDS = [MODULES[name] for name in ("Core", "ActiveHinge", "Fin", "Thruster")]


@pytest.fixture(scope="module")
def stranger(config):
    """A body of types that no example has, a fitness with room for it, and its own."""
    overrides = {"task.duration": 0.5, "task.settle": 0.1, "controller.harmonics": 1}
    config = make_config(config.model_dump(), overrides=overrides)
    fitness = make_mixed_fitness(config, [random_body(4, 2, 1)], 2, kinds=KINDS, modules=5)
    tail = add_module(body("core"), "core", 1, "ActiveHinge", name="tail")
    fish = add_module(add_module(tail, "tail", 1, "Fin"), "core", 2, "Thruster")
    return fitness.build(fish), fitness, fit_body(config, fish)


def test_there_is_room_for_types_that_no_example_has(config, stranger):
    robot, fitness, _ = stranger
    packed = fitness.pack([robot])
    assert packed.count <= fitness.capacity.rows and len(fitness.capacity.groups) == 3
    # Where bodies have no hinge, types with one take no room.
    assert make_mixed_fitness(config, [body("core")], kinds=KINDS, modules=5).capacity.hinges == 0


@pytest.mark.long
def test_types_that_no_example_has_score_as_alone(stranger):
    """Fins and thrusters obey laws of their own."""
    robot, fitness, single = stranger
    genes = jax.random.normal(jax.random.key(3), (2, single.num_genes))
    expected = np.asarray(single(genes, jax.random.key(2)))
    found = fitness(robot, fitness.pad_genes(genes, robot), jax.random.key(2))
    assert np.asarray(found) == pytest.approx(expected, abs=1e-5)
    assert np.abs(np.diff(expected)) > 1e-3


@pytest.mark.slow
@pytest.mark.sampled(1)
@pytest.mark.parametrize("hinge", [False, True])
def test_bodies_of_one_module_score_in_a_batch_and_with_populations_of_their_own(config, hinge):
    """Two cores, or with a hinge each: XLA:CPU aborts over loops of no row and of one."""
    cores = [body("core"), read("body: {type: Core}")]
    if hinge:
        cores = [add_module(core, 0, 1, "ActiveHinge", name="tail") for core in cores]
    batch = make_mixed_fitness(config, cores)
    robots = [batch.build(core) for core in cores]
    genes = jax.random.normal(jax.random.key(0), (2, 3, batch.num_genes))
    own = np.asarray(batch(robots, genes, jax.random.key(1)))
    assert np.all(np.isfinite(own)) and np.all(np.ptp(own, axis=1) > 0) == hinge
    beside = np.asarray(batch(robots, genes[:, 1], jax.random.key(1)))
    assert own[:, 1] == pytest.approx(beside, abs=1e-6)


def test_bodies_without_anything_to_control_are_refused_by_name(config):
    """A cpg has no genes where there are no hinges."""
    changed = {"controller.type": "cpg", "controller.harmonics": 1}
    batch = make_mixed_fitness(config, [body("core")], **changed)
    with pytest.raises(InputError, match=r"expected bodies with a hinge or a thruster .* no genes"):
        batch(batch.build(body("core")), np.zeros((2, 0)), jax.random.key(1))


def test_genes_find_their_joints_again(fitness):
    robot = fitness.build(body("snake"))
    places = gene_indices(fitness.controller_of(robot), fitness.controller)
    assert len(set(places.tolist())) == len(places) == fitness.controller_of(robot).num_genes
    with pytest.raises(InputError, match=rf"genes: expected \[..., {len(places)}\]; found \[2, 3"):
        fitness.pad_genes(np.zeros((2, 3)), robot)
    wide, large = np.zeros((2, fitness.num_genes)), fitness.build(random_body(1, 9))
    for give in (fitness.pad_genes, fitness.own_genes):
        check_refused("'random_1': expected at most 8 hinges; found 9", give, wide, large)


def test_what_it_cannot_do_is_refused_by_name(config, fitness):
    tank = world(**WATER)
    snake, zeros = body("snake"), np.zeros((2, fitness.num_genes))
    auv, many, only = ([build_robot(x, tank)] for x in (body("auv"), random_body(1, 9), snake))
    snakes, built = fit_capacity(only), [fitness.build(snake)]
    check_refused("robots: expected at least one; found none", fit_capacity, [])
    laws = "'auv': expected parts under one of the laws [('partial', 'faces', False)]"
    check_refused(laws, pack_bodies, auv, snakes)
    check_refused("'random_1': expected at most 8 hinges; found 9", pack_bodies, many, snakes)
    engine = "engine: expected population, as bodies differ; found mjx"
    check_refused(engine, make_mixed_fitness, config, [snake], engine="mjx")
    check_refused("robots: expected 2, one each; found 1", fitness, built, zeros, None)
    kind = "robots: expected what `build` returns; found Morphology"
    check_refused(kind, fitness, [snake], zeros[:1], None)


def test_modules_of_one_type_may_have_params_of_their_own():
    two = read("""
body:
  type: Core
  children:
    0: {id: slow, type: ActiveHinge, params: {factors: {servo_speed: 0.9}}}
    1: {id: fast, type: ActiveHinge}
    2: {id: jet, type: Thruster, params: {thruster: {
      curve: interpolated, commands: [-1, 0, 1], thrusts: [-1, 0, 2]}}}
    3: {id: plain, type: Thruster}
""")
    robot = build_robot(two, world(**WATER))
    capacity = fit_capacity([robot])
    assert capacity.curve_points == 3
    pack_bodies([robot], capacity)


def test_a_number_that_is_the_same_in_all_bodies_of_the_types_must_stay_so():
    """Say, hinges of other friction."""
    tank = world(**WATER)
    capacity = fit_capacity([build_robot(body("snake"), tank)])
    assert capacity.row.hinges.damping > 0
    hinge = MODULES["ActiveHinge"]
    slow = replace(hinge, hinge=replace(hinge.hinge, speed=hinge.hinge.speed / 2))
    path = ROOT / "morphologies" / "snake.yaml"
    other = build_robot(load_morphology(path, MODULES | {"ActiveHinge": slow}), tank)
    with pytest.raises(InputError, match=r"'snake': hinges.damping: expected .* types of modules"):
        pack_bodies([other], capacity)


@pytest.mark.slow
def test_slanted_modules_are_no_constants():
    """A type that leaves the right angles frees what right angles would fix."""
    limb = "{type: ActiveHinge, children: {1: {type: FixedBrick}}}"
    robot = build_robot(read(f"body: {{type: Core, children: {{1: {limb}}}}}"), world(**WATER))
    kind = robot.morphology.modules[2].kind
    slot = replace(kind.slots[1], direction=(0.6, 0.8, 0.0))
    slanted = replace(kind, name="Slanted", slots={1: slot})
    square, free = fit_capacity([robot]), fit_capacity([robot], [slanted])
    assert square.row.parts[0].rotation[0][1] == 0.0
    assert free.row.parts[0].rotation[0][1] is None
