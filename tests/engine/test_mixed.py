"""Different bodies in one batch: against the step for one body, and that padding changes nothing.

Tolerances: accelerations agree to 1e-9 relative in float64 (sums run in another order; velocities
and inertias span four decades), scores over 1,000 float32 steps to 1e-5.
"""

from __future__ import annotations

import dataclasses
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mjx_revolve.engine.menagerie import fit_shape, pack_bodies

from experiments.random_bodies import random_body
from laboratory import QUICK, ROOT, WATER, accelerate, body, march, random_states, world
from mjx_revolve import load_config, make_fitness
from mjx_revolve.engine import menagerie, mixed_step
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.episodes.fitness import make_mixed_fitness
from mjx_revolve.episodes.rollout import roll_out
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.water.flow import water_of

BED = {"kind": "flat", "height": -5.0}
WORLDS = {
    "default": WATER,
    "ellipsoid": {"gravity": 9.81, "buoyancy": "partial", "drag": "ellipsoid"},
    "inertia_box": {"drag": "inertia_box"},
    "contact": WATER | {"bed": BED},
    "waves": WATER | {"waves": [{"amplitude": 0.02, "wavelength": 1.0, "direction": 0.5}]},
}


@lru_cache(maxsize=8)
def zoo(name):
    """Two random trees, a chain, and a body without hinges."""
    tank = world(**WORLDS[name])
    bodies = [random_body(3, 6), random_body(4, 5, 9), body("snake"), body("core")]
    return tuple(build_robot(b, tank) for b in bodies)


def states(robots, shape, each, depth):
    """`[7 + hinges, lanes]`, `[6 + hinges, lanes]`, targets, and each robot's own."""
    lanes = len(robots) * each
    qpos, qvel = np.zeros((7 + shape.hinges, lanes)), np.zeros((6 + shape.hinges, lanes))
    ctrl, own = np.zeros((shape.hinges, lanes)), []
    for k, robot in enumerate(robots):
        q, v = random_states(robot, each, seed=k, depth=depth)
        c = np.random.default_rng(k).uniform(-0.7, 0.7, (robot.num_hinges, each))
        own.append((q, v, c))
        here = slice(k * each, (k + 1) * each)
        qpos[: len(q), here], qvel[: len(v), here], ctrl[: len(c), here] = q, v, c
    return (qpos, qvel, ctrl), own


def mixed_acceleration(robots, shape, each, arrays):
    """`mixed_step.acceleration` in float64."""
    tank = robots[0].world
    with jax.enable_x64(True):
        bodies = pack_bodies([r for r in robots for _ in range(each)], shape, np.float64)
        bodies = jax.tree.map(jnp.asarray, bodies)
        run = jax.jit(
            lambda b, q, v, c: mixed_step.acceleration(tank, shape, b, q, v, c, water_of(tank)),
            compiler_options=QUICK,
        )
        return np.asarray(run(bodies, *(jnp.asarray(x) for x in arrays)))


@pytest.mark.parametrize(
    "name", ["default", *(pytest.param(n, marks=pytest.mark.slow) for n in list(WORLDS)[1:])]
)
def test_accelerations_are_those_of_each_body_alone(name):
    robots = zoo(name)
    shape = fit_shape(robots)
    # Half under water, or with some points in the bed.
    depth = 4.95 if name == "contact" else 0.0
    arrays, own = states(robots, shape, 4, depth)
    found = mixed_acceleration(robots, shape, 4, arrays)
    for k, (robot, (q, v, c)) in enumerate(zip(robots, own, strict=True)):
        here = found[:, 4 * k : 4 * k + 4]
        expected = accelerate(robot, q, v, c)
        scale = np.abs(expected).max(0)
        assert np.all(np.abs(here[: len(v)] - expected).max(0) < 1e-9 * scale), k
        assert np.all(here[len(v) :] == 0)


@pytest.mark.slow
def test_more_padding_and_more_riders_change_nothing():
    """More rows, a deeper stack, a larger root, and bodies cut into more or fewer rows."""
    robots = zoo("default")
    shape = fit_shape(robots)
    arrays, _ = states(robots, shape, 2, 0.0)
    found = mixed_acceleration(robots, shape, 2, arrays)
    scale = np.abs(found).max(0)
    padded = dataclasses.replace(
        shape, rows=shape.rows + 5, slots=shape.slots + 1, root_parts=shape.root_parts + 2
    )
    again = mixed_acceleration(robots, padded, 2, arrays)
    assert np.all(np.abs(again - found).max(0) < 1e-11 * scale)
    single = dataclasses.replace(shape, parts=1, rows=40, slots=5, constants=())
    assert max(len(menagerie._rows(r, 1)) for r in robots) > shape.rows
    again = mixed_acceleration(robots, single, 2, arrays)
    assert np.all(np.abs(again - found).max(0) < 1e-9 * scale)


def test_a_short_stack_holds_any_tree():
    """Slots stay below log2 of the bodies, and every row finds its parent in its slot."""
    tank = world(**WATER)
    for seed in range(12):
        robot = build_robot(random_body(seed, 2 + seed, 3), tank)
        for parts in (1, 2, 5):
            rows = menagerie._rows(robot, parts)
            assert 2 ** (max(r.slot for r in rows) + 1) - 1 <= len(rows) + 1
            parents = robot.mj_model.body_parentid
            stack = {0: 1}  # the root
            for row in rows:
                host = row.body if row.rider else parents[row.body]
                assert stack[row.source] == host
                stack[row.slot] = None if row.rider else row.body


@pytest.mark.slow
def test_a_trajectory_is_that_of_the_body_alone():
    robots = zoo("default")
    shape, each = fit_shape(robots), 2
    (qpos, qvel, ctrl), own = states(robots, shape, each, 0.2)
    tank = robots[0].world
    with jax.enable_x64(True):
        bodies = pack_bodies([r for r in robots for _ in range(each)], shape, np.float64)
        bodies = jax.tree.map(jnp.asarray, bodies)

        def run(bodies, qpos, qvel, ctrl):
            engine = mixed_step.make_mixed_engine(tank, shape, bodies)
            targets = mixed_step.to_rows(bodies, ctrl)
            return roll_out(
                engine,
                lambda state, time, row, sense: (state, targets),
                lambda time, row: water_of(tank),
                lambda state, ctrl, energy: (*engine.observe(state), energy),
                engine.init(qpos, qvel),
                (),
                None,
                records=10,
                every=10,
                timestep=tank.timestep,
            )[1]

        jitted = jax.jit(run, compiler_options=QUICK)
        q, v, work = (np.asarray(x) for x in jitted(bodies, qpos, qvel, ctrl))
    for k, (robot, (q0, v0, c0)) in enumerate(zip(robots, own, strict=True)):
        _, q1, v1, work1 = march(robot, 0.5, q0, v0, c0, every=10)
        here = slice(each * k, each * (k + 1))
        assert q[:, : len(q0), here] == pytest.approx(q1, abs=1e-7)
        assert v[:, : len(v0), here] == pytest.approx(v1, abs=1e-5)
        assert work[:, here] == pytest.approx(work1, abs=1e-8)


@pytest.fixture(scope="module")
def config():
    return load_config(
        ROOT / "configs" / "lake_swim.yaml",
        overrides={"task.duration": 2.5, "task.settle": 0.5, "trim": "none"},
    )


@pytest.fixture(scope="module")
def fitness(config):
    return make_mixed_fitness(config, [random_body(3, 6), body("snake")])


@pytest.mark.slow
def test_scores_are_those_of_each_body_alone(config, fitness):
    robots = [fitness.build(random_body(3, 6)), fitness.build(body("snake"))]
    draw, key = np.random.default_rng(0), jax.random.key(1)
    pick = [0, 1, 1, 0, 1]
    own = [draw.normal(size=7 * robots[k].num_hinges + 1).astype(np.float32) for k in pick]
    genes = jnp.stack([fitness.pad_genes(g, robots[k]) for g, k in zip(own, pick, strict=True)])
    scores, measures = fitness.evaluate([robots[k] for k in pick], genes, key)
    for k, robot in enumerate(robots):
        here = [i for i in range(5) if pick[i] == k]
        again = [fitness.own_genes(genes[i], robot) for i in here]
        assert np.array_equal(again, [own[i] for i in here])
        expected, more = fitness._alone(robot).evaluate(np.stack([own[i] for i in here]), key)
        assert np.asarray(scores)[here] == pytest.approx(np.asarray(expected), abs=1e-5)
        speed = np.asarray(measures["speed_m_s"])[here]
        assert speed == pytest.approx(np.asarray(more["speed_m_s"]), abs=1e-5)
    # The same program for other bodies, and bits that do not depend on who swims beside.
    compiled = fitness._jitted._cache_size()
    others = [robots[1], robots[0], *(robots[k] for k in pick[2:])]
    swapped = jnp.stack([genes[1], genes[0], *genes[2:]])
    once_more = fitness(others, swapped, key)
    assert fitness._jitted._cache_size() == compiled
    assert np.array_equal(np.asarray(once_more)[[1, 0, 2, 3, 4]], np.asarray(scores))


@pytest.mark.slow
def test_one_body_for_all_takes_its_own_program(config, fitness):
    robot = fitness.build(body("snake"))
    genes = jnp.zeros((3, fitness.num_genes)).at[:, 0].set(1.0)
    scores = fitness([robot] * 3, genes, jax.random.key(0))
    plain = make_fitness(config, morphology=str(ROOT / "morphologies" / "snake.yaml"))
    expected = plain(np.stack([fitness.own_genes(g, robot) for g in genes]), jax.random.key(0))
    assert np.array_equal(scores, expected)


@pytest.mark.slow
def test_what_it_cannot_do_is_refused_by_name(config, fitness):
    tank = world(**WATER)
    cases = [
        (lambda: fit_shape([]), "robots: expected at least one; found none"),
        (
            lambda: fit_shape([build_robot(body("auv"), tank)]),
            "expected robots without thrusters; found",
        ),
        (
            lambda: fit_shape([build_robot(body("fish"), tank)]),
            "expected parts under one of the laws",
        ),
        (
            lambda: pack_bodies([build_robot(random_body(1, 9), tank)], fit_shape(zoo("default"))),
            "'random_1': expected at most 8 hinges; found 9",
        ),
        (
            lambda: make_mixed_fitness(
                config, [body("snake")], **{"controller.type": "cpg", "controller.harmonics": 1}
            ),
            "controller.type: expected sine, as bodies differ; found cpg",
        ),
        (
            lambda: make_mixed_fitness(config, [body("snake")], engine="mjx"),
            "engine: expected population, as bodies differ; found mjx",
        ),
        (lambda: make_mixed_fitness(config, []), "examples: expected at least one morphology"),
        (
            lambda: fitness([fitness.build(body("snake"))], np.zeros((2, fitness.num_genes)), None),
            "robots: expected 2, one each; found 1",
        ),
        (
            lambda: fitness([body("snake")], np.zeros((1, fitness.num_genes)), None),
            "robots: expected what `build` returns; found Morphology",
        ),
        (
            lambda: fitness([], np.zeros((2, 3)), None),
            f"population: expected [P, {fitness.num_genes}]; found [2, 3]",
        ),
    ]
    for make, message in cases:
        with pytest.raises(InputError) as error:
            make()
        assert message in str(error.value)


def test_a_number_that_was_the_same_in_all_examples_must_stay_so():
    """Say, hinges of other friction."""
    tank = world(**WATER)
    shape = fit_shape([build_robot(body("snake"), tank)])
    assert "joint.damping" in dict(shape.constants)
    other = build_robot(body("snake"), tank)
    other.mj_model.dof_damping[6:] *= 2
    with pytest.raises(InputError, match=r"'snake': joint.damping: expected .* fit the shape"):
        pack_bodies([other], shape)
