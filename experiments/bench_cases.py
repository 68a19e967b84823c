"""What `experiments.bench` measures: one engine in one process.

``python -m experiments.bench_cases '{"case": ...}'`` builds and compiles one case, prints a line
of JSON when it is ready, and measures once for every line that it reads. `experiments.bench` starts
one such process for each case, so that no engine shares memory, threads or settings with another.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import json
import math
import os
import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

# Physics by the changes to the default world. In "ellipsoid" the robot is weightless and under
# water, as a body of the water's density is, so that MuJoCo C has the same water. Joint limits are
# MuJoCo's own constraints in C and MJX, springs in ours; so are contacts of modules of one robot in
# "touching", of the same pairs in both. Without a word these are off where MuJoCo is beside us.
PHYSICS: dict[str, dict[str, Any]] = {
    "default": {"name": "lake"},
    "mask": {"name": "lake", "buoyancy": "mask"},
    "no_drag": {"name": "lake", "drag": "off"},
    "no_added_mass": {"name": "lake", "added_mass": False},
    "ellipsoid": {
        "name": "empty_underwater", "gravity": 0.0, "buoyancy": "off", "drag": "ellipsoid",
        "added_mass": False, "self_contact": False,
    },
    "touching": {
        "name": "empty_underwater", "gravity": 0.0, "buoyancy": "off", "drag": "ellipsoid",
        "added_mass": False, "self_contact": True,
    },
    "inertia_box": {
        "name": "empty_underwater", "gravity": 0.0, "buoyancy": "off", "drag": "inertia_box",
        "added_mass": False, "self_contact": False,
    },
    "none": {
        "name": "empty_underwater", "gravity": 0.0, "buoyancy": "off", "drag": "off",
        "added_mass": False, "self_contact": False,
    },
    # MuJoCo's own contacts with the lake's bed; gravity is cut to what buoyancy leaves of it.
    "bed": {
        "name": "lake", "buoyancy": "off", "drag": "ellipsoid", "added_mass": False,
        "bed": {"kind": "lake", "contact": "mjx"}, "self_contact": False,
    },
}  # fmt: skip
# Brains, by the changes to the default controller. Eight units at each of the spider's eight hinges
# are 64. "tired" has sensors as they are bought.
_TIRED = {"noise": 0.05, "rate": 20.0, "delay": 0.1}
BRAINS: dict[str, dict[str, Any]] = {
    "": {},
    "sine": {"type": "sine", "harmonics": 1},
    "mlp": {"type": "mlp", "hidden": 8, "harmonics": 1},
    "tired": {
        "type": "mlp",
        "harmonics": 1,
        "hidden": 8,
        "sensors": [{"type": name} | _TIRED for name in ("tilt", "gyro", "angle", "speed")],
    },
}
# Steps in one call of an engine that is given plain controls.
STEPS = 200
DEPTH = 2.0  # of the start [m]

# A prepared case: a function that steps the population, and how many steps of one robot it makes.
Case = tuple[Callable[[], Any], int]


def _config(job: dict[str, Any]) -> Any:
    from mjx_revolve import load_config

    # Without gravity there is nothing to trim, a crawler had better sink, and a random body may
    # float already.
    lake = PHYSICS[job["physics"]]["name"] == "lake"
    trimmed = lake and job["task"] != "crawl" and job["case"] not in ("mixed", "learners")
    return load_config(
        job["config"],
        overrides={
            "morphology": job["robot"],
            **{f"controller.{key}": value for key, value in BRAINS[job["brain"]].items()},
            "world": PHYSICS[job["physics"]],
            "task.type": job["task"],
            "task.duration": job["duration"],
            "trim": "neutral" if trimmed else "none",
            "evolution.population_size": job["population"],
            "evolution.generations": 10**6,
        },
    )


def _fitness(job: dict[str, Any]) -> Any:
    from mjx_revolve import make_fitness

    return make_fitness(_config(job))


def _episode_steps(fitness: Any) -> int:
    task = fitness.config.task
    return task.trials * round(task.duration / fitness.robot.world.timestep)


def make_evaluation(job: dict[str, Any]) -> Case:
    """Whole episodes of a random population, as an optimiser calls for them."""
    import jax

    fitness = _fitness(job)
    genes = jax.random.normal(jax.random.key(0), (job["population"], fitness.num_genes))
    key = jax.random.key(1)
    run = lambda: jax.block_until_ready(fitness.evaluate(genes, key))  # noqa: E731
    return run, job["population"] * _episode_steps(fitness)


def make_generation(job: dict[str, Any]) -> Case:
    """A whole generation of the evolution loop on all cores: ask, evaluate, tell, what it keeps."""
    from mjx_revolve.evolution.executor import make_executor
    from mjx_revolve.evolution.gene_search import GeneEvolution
    from mjx_revolve.evolution.generations import run_generations

    executor = make_executor(_config(job))
    evolution = executor.fitness.config.evolution
    generations = run_generations(GeneEvolution(evolution, executor), evolution.generations)
    return lambda: next(generations), job["population"] * _episode_steps(executor.fitness)


def _bodies(job: dict[str, Any], each: int = 1) -> list[Any]:
    """Different bodies of 4 to 16 hinges and 6 bricks, with so many individuals `each`.

    Processes get blocks of bodies of a size, as evolution deals them: the largest first, and who is
    done first takes the next.
    """
    from experiments.random_bodies import random_body
    from mjx_revolve.numerics.xla import LANES

    first, step = job["share"]
    everybody = sorted(range(step * job["population"]), key=lambda k: (-(k % 13), k))
    turns = [*range(step), *reversed(range(step))]
    block = math.gcd(LANES // each, job["population"])
    own = [k for n, k in enumerate(everybody) if turns[n // block % (2 * step)] == first]
    assert len(own) == job["population"], "expected whole blocks"
    return [random_body(k, 4 + k % 13, 6) for k in own]


def make_mixed(job: dict[str, Any], learners: int = 0) -> Case:
    """Whole episodes of a population in which every individual has another body.

    With `learners`, every body has so many individuals of its own.
    """
    import jax

    from mjx_revolve import make_mixed_fitness

    bodies = _bodies(job, max(learners, 1))
    fitness = make_mixed_fitness(_config(job), bodies, hinges=16)
    packed = fitness.pack([fitness.build(body) for body in bodies])
    each = (len(bodies), learners) if learners else (len(bodies),)
    genes = jax.random.normal(jax.random.key(0), (*each, fitness.num_genes))
    key = jax.random.key(1)
    steps = round(fitness.config.task.duration / fitness.world.timestep)
    run = lambda: jax.block_until_ready(fitness.evaluate(packed, genes, key))  # noqa: E731
    return run, len(bodies) * max(learners, 1) * steps


def make_learners(job: dict[str, Any]) -> Case:
    """The same, 64 individuals to a body."""
    return make_mixed(job, learners=64)


def make_bare(job: dict[str, Any]) -> Case:
    """The population step alone: no controller, no record of the way, no score."""
    import jax
    import jax.numpy as jnp

    from mjx_revolve.episodes.rollout import Rollout, held
    from mjx_revolve.numerics.xla import jit, over_chunks
    from mjx_revolve.water.flow import water_of

    fitness = _fitness(job)
    robot, engine = fitness.robot, fitness.engine
    world, count = robot.world, job["population"]
    steps = _episode_steps(fitness) // fitness.config.task.trials

    def chunk(qpos: Any, ctrl: Any) -> Any:
        qvel = jnp.zeros((robot.mj_model.nv, qpos.shape[-1]), qpos.dtype)
        rollout = Rollout(engine, held(ctrl), world, water_of(world))
        start = rollout.init(engine.init(qpos, qvel))
        last, _ = rollout.advance(start, lambda *_: (), steps // 20, 20)
        return jnp.stack(last.state.position)

    run = jit(over_chunks(chunk))
    qpos = jnp.tile(jnp.asarray(robot.start_qpos(DEPTH), jnp.float32)[:, None], (1, count))
    low, high = engine.plant.low, engine.plant.high
    share = jax.random.uniform(jax.random.key(0), (robot.num_hinges, count))
    ctrl = jnp.asarray(low + (high - low) * share, jnp.float32)
    return lambda: jax.block_until_ready(run(qpos, ctrl)), count * steps


def _c_model(job: dict[str, Any], morphology: Any = None) -> Any:
    """The compiled model; the water of "ellipsoid" and "inertia_box" is MuJoCo's own."""
    import numpy as np

    from mjx_revolve import build_robot, load_morphology, load_world
    from mjx_revolve.engine.plant import body_geometry
    from mjx_revolve.episodes.tasks import reach_below
    from mjx_revolve.water.bed import bed_height

    fields = dict(PHYSICS[job["physics"]])
    world = load_world(fields.pop("name"), **fields)
    robot = build_robot(morphology or load_morphology(job["robot"]), world)
    model = robot.mj_model
    if world.drag in ("ellipsoid", "inertia_box"):
        model.opt.density, model.opt.viscosity = world.density, world.viscosity
    model.qpos0[2] = -DEPTH
    if world.bed is not None:
        body = robot.morphology
        model.opt.gravity[2] *= 1 - world.density * body.volume / body.mass
        start = float(bed_height(world.bed, np.zeros(1), np.zeros(1))[0])
        model.qpos0[2] = start + reach_below(_config(job).task, body_geometry(robot))
    return model


def _controls(model: Any, count: int) -> tuple[Any, Any]:
    """Sines of 1 Hz: `[count, STEPS, nu]` targets [rad], and their phases `[count, nu]` [rad]."""
    import numpy as np

    phase = 2 * np.pi * np.random.default_rng(0).random((count, model.nu))
    time = model.opt.timestep * np.arange(STEPS)
    reach = 0.5 * model.actuator_ctrlrange[:, 1]
    return reach * np.sin(2 * np.pi * time[None, :, None] + phase[:, None]), phase


def make_mjx(job: dict[str, Any]) -> Case:
    """`jax.jit(jax.vmap(mjx.step))` on the same model, in a scan, nothing of ours added.

    In a scan because that is faster than calling the jitted step from Python.
    """
    import jax
    import jax.numpy as jnp
    import mujoco
    from mujoco import mjx

    model = _c_model(job)
    if not job["limits"]:
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    count, dt = job["population"], model.opt.timestep
    phase = jnp.asarray(_controls(model, count)[1], jnp.float32)
    reach = jnp.asarray(0.5 * model.actuator_ctrlrange[:, 1], jnp.float32)
    mjx_model = mjx.put_model(model)
    data = jax.vmap(lambda _: mjx.make_data(mjx_model))(jnp.arange(count))
    data = data.replace(qpos=jnp.tile(jnp.asarray(model.qpos0, jnp.float32), (count, 1)))

    @jax.jit
    def run(data: Any) -> Any:
        def step(data: Any, k: Any) -> tuple[Any, None]:
            data = data.replace(ctrl=reach * jnp.sin(2 * jnp.pi * dt * k + phase))
            return jax.vmap(mjx.step, in_axes=(None, 0))(mjx_model, data), None

        return jax.lax.scan(step, data, jnp.arange(STEPS))[0].qpos

    return lambda: jax.block_until_ready(run(data)), count * STEPS


def make_rollout(job: dict[str, Any]) -> Case:
    """MuJoCo C's `mujoco.rollout`, with as many threads as asked for."""
    import mujoco
    import numpy as np
    from mujoco import rollout

    model = _c_model(job)
    count, threads = job["population"], job["threads"]
    data = [mujoco.MjData(model) for _ in range(threads)]
    full = mujoco.mjtState.mjSTATE_FULLPHYSICS
    state = np.zeros(mujoco.mj_stateSize(model, full))
    mujoco.mj_getState(model, data[0], state, full)
    states, controls = np.tile(state, (count, 1)), _controls(model, count)[0]
    pool = rollout.Rollout(nthread=threads)
    return lambda: pool.rollout(model, data, states, controls), count * STEPS


def make_batch(job: dict[str, Any]) -> Case:
    """MuJoCo C's `mujoco.batch.Batch`, with as many threads as asked for."""
    import mujoco
    from mujoco.batch import Batch

    model = _c_model(job)
    batch = Batch(model, job["population"], job["threads"])
    controls = _controls(model, job["population"])[0]

    def run() -> None:
        batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
        batch.rollout(STEPS, controls)

    return run, job["population"] * STEPS


def make_threads(job: dict[str, Any]) -> Case:
    """MuJoCo C on different bodies: `mj_step` in threads, as its batch engines take one body."""
    from concurrent.futures import ThreadPoolExecutor

    import mujoco

    models = [_c_model(job, body) for body in _bodies(job)]
    worlds = [(model, mujoco.MjData(model)) for model in models]
    pool = ThreadPoolExecutor(job["threads"])

    def advance(world: Any) -> None:
        model, data = world
        mujoco.mj_resetData(model, data)
        data.ctrl[:] = 0.3
        mujoco.mj_step(model, data, STEPS)  # without Python's lock

    return lambda: list(pool.map(advance, worlds)), len(models) * STEPS


MAKERS: dict[str, Callable[[dict[str, Any]], Case]] = {
    "evaluation": make_evaluation,
    "generation": make_generation,
    "bare": make_bare,
    "mjx": make_mjx,
    "rollout": make_rollout,
    "batch": make_batch,
    "mixed": make_mixed,
    "learners": make_learners,
    "threads": make_threads,
}


def measure(run: Callable[[], Any], steps: int, seconds: float) -> dict[str, float]:
    """Calls a case for a while.

    Args:
        run: the case.
        steps: how many steps of one robot a call makes.
        seconds: how long to go on, at least.

    Returns:
        Steps per second, and how many cores were busy in the mean.
    """
    began, busy, calls = time.perf_counter(), time.process_time(), 0
    while (spent := time.perf_counter() - began) < seconds or not calls:
        run()
        calls += 1
    spent = time.perf_counter() - began
    return {
        "steps_per_second": calls * steps / spent,
        "cores": (time.process_time() - busy) / spent,
    }


def forget_peak() -> None:
    """Gives back what compilation held, and starts `peak_memory` anew, where Linux can.

    The compiler's own peak would hide what a population takes.
    """
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def peak_memory() -> int:
    """The largest resident memory of this process since `forget_peak` [B]."""
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii")
        return int(status.split("VmHWM:")[1].split()[0]) * 1024
    except (OSError, IndexError):
        # Where a process was started by a larger one, that one's memory counts here.
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def main() -> int:
    """Serves one case until standard input ends."""
    job = json.loads(sys.argv[1])
    # Libraries print while they are imported; the answers go where nobody else writes.
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)

    def answer(values: dict[str, Any]) -> None:
        print(json.dumps(values | {"peak_bytes": peak_memory()}), file=answers, flush=True)

    if job.get("core") is not None:
        os.sched_setaffinity(0, {job["core"]})
    from mjx_revolve.inputs.errors import InputError
    from mjx_revolve.numerics.runtime import prepare_process

    began = time.perf_counter()
    prepare_process()
    try:
        run, steps = MAKERS[job["case"]](job)
    except InputError as error:
        answer({"error": str(error)})
        return 2
    built = time.perf_counter()
    run()
    first = time.perf_counter()
    run()
    second = time.perf_counter() - first
    forget_peak()
    answer({"built_s": built - began, "compile_s": max(0.0, first - built - second)})
    for line in sys.stdin:
        answer(measure(run, steps, float(line)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
