"""Small robots and a tank to try them in: what several files of tests share.

Everything here runs the package's own step, in float64, so that tolerances can say what a law's
discretisation errs by and not what float32 rounds to.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_revolve.body.module_types import Box, ModuleType, Part
from mjx_revolve.body.morphology import Module, Morphology, load_morphology
from mjx_revolve.control.controller import Controller
from mjx_revolve.control.sense import Sense
from mjx_revolve.engine.engines import make_engine
from mjx_revolve.engine.plant import Plant, actuators_of
from mjx_revolve.engine.robot import Robot, build_robot
from mjx_revolve.engine.step import robot_acceleration
from mjx_revolve.episodes.rollout import flow_at, roll_out
from mjx_revolve.numerics.xla import on_cpu, share_once
from mjx_revolve.water.flow import water_of
from mjx_revolve.water.world import World, load_world

ROOT = Path(__file__).resolve().parents[1]
OURS = sorted((ROOT / "morphologies").glob("*.yaml"))
WILD = sorted((ROOT.parent / "shared" / "revolve_robots").glob("*.yaml"))

# What real water does, for `world`.
WATER = {"gravity": 9.81, "buoyancy": "partial", "drag": "faces", "added_mass": True}
# Nothing but inertia: what a test does not name is off.
EMPTY = {"gravity": 0.0, "buoyancy": "off", "drag": "off", "added_mass": False, "bed": None}


def world(**fields) -> World:
    """A world in which only what is named acts."""
    return load_world("empty_underwater", **EMPTY | fields)


def body(name: str) -> Morphology:
    """One of the shipped robots."""
    return load_morphology(ROOT / "morphologies" / f"{name}.yaml")


def tree(body: Morphology) -> list[tuple[tuple[int, ...], str, float]]:
    """(slots from the core, type, turn) of all modules but the core, in order."""
    paths: list[tuple[int, ...]] = [()]
    for module in body.modules[1:]:
        paths.append((*paths[module.parent], module.slot))
    return [
        (path, m.type, m.orientation) for path, m in zip(paths[1:], body.modules[1:], strict=True)
    ]


def box_robot(size, mass: float, tank: World, volume: float | None = None, **part) -> Robot:
    """A single box; without `volume`, it displaces what its box holds."""
    volume = float(np.prod(size)) if volume is None else volume
    only = Part("box", (Box(tuple(size)),), mass=mass, volume=volume, **part)
    module = Module(
        name="box",
        type="Core",
        parent=-1,
        slot=-1,
        orientation=0.0,
        rgb=None,
        position=np.zeros(3),
        rotation=np.eye(3),
        kind=ModuleType("Core", (only,)),
    )
    return build_robot(Morphology("box", (module,)), tank)


def limp(robot):
    """The robot without servos, friction and end stops; before anything compiles it."""
    model = robot.mj_model
    model.actuator_gainprm[:, 0], model.actuator_biasprm[:] = 1e-12, 0.0
    model.dof_damping[:], model.jnt_limited[:], model.jnt_user[:] = 0.0, 0, np.inf
    return robot


def at_rest(robot: Robot, lanes: int = 1, height: float = 0.0):
    """`[nq, lanes]` rest pose at a height of the core, and `[nv, lanes]` zeros."""
    model = robot.mj_model
    qpos = np.repeat(model.qpos0[:, None], lanes, 1)
    qpos[2] = height
    return qpos, np.zeros((model.nv, lanes))


def random_states(robot: Robot, lanes: int, seed: int = 0, speed: float = 1.0, depth: float = 5.0):
    """`[nq, lanes]` and `[nv, lanes]`: any attitude, joints within 80 % of their limits."""
    draw = np.random.default_rng(seed)
    model = robot.mj_model
    qpos, qvel = at_rest(robot, lanes)
    qpos[:3] = draw.normal(size=(3, lanes))
    qpos[2] -= depth
    qpos[3:7] = draw.normal(size=(4, lanes))
    qpos[3:7] /= np.linalg.norm(qpos[3:7], axis=0)
    low, high = model.jnt_range[1:].T
    qpos[7:] = draw.uniform(0.8 * low[:, None], 0.8 * high[:, None], (len(low), lanes))
    qvel[:] = speed * draw.normal(size=qvel.shape)
    return qpos, qvel


# A test runs a program once: what the compiler's optimisations cost is more than they save. These
# two leave them out; together with `xla_disable_hlo_passes=fusion` they would give wrong numbers.
# Nor does one program have both cores: in one piece, it takes the compiler a fifth less.
_CHEAP = {
    "xla_backend_optimization_level": 0,
    "xla_cpu_use_fusion_emitters": False,
    "xla_cpu_parallel_codegen_split_count": 1,
}
_USUAL = {
    "xla_backend_optimization_level": 3,
    "xla_cpu_use_fusion_emitters": True,
    "xla_cpu_parallel_codegen_split_count": 32,
}


def _compile_quickly() -> None:
    """Makes `_CHEAP` this process's default, but not that of processes which tests start.

    XLA reads its flags once, when its first client is made. Who sets XLA_FLAGS, be it to nothing,
    has the tests compiled as they say.
    """
    if "XLA_FLAGS" not in os.environ:
        os.environ |= XLA_FLAGS
        jax.jit(lambda x: x + 1)(0.0)
        del os.environ["XLA_FLAGS"]


XLA_FLAGS = {
    "XLA_FLAGS": os.environ.get(
        "XLA_FLAGS", " ".join(f"--{name}={str(value).lower()}" for name, value in _CHEAP.items())
    )
}
_compile_quickly()
QUICK = _CHEAP if on_cpu() else None
USUAL = _USUAL if on_cpu() else None  # as users compile
# A derivative is all calls of small functions; inlined into one another, they take XLA 7 times as
# long. Its numbers are then compared with differences of a program that was compiled otherwise.
SLOPE = _CHEAP | {"xla_disable_hlo_passes": "call-inliner"} if on_cpu() else None


@contextmanager
def compiled_quickly(*places: str) -> Iterator[None]:
    """Leaves out the compiler's optimisations: they cost more than short runs save.

    Args:
        places: where the options are asked for, `FILE.FUNCTION` of `mjx_revolve/episodes/`.
    """
    with pytest.MonkeyPatch.context() as patch:
        for place in places:
            patch.setattr(f"mjx_revolve.episodes.{place}", lambda: QUICK)
        yield


@lru_cache(maxsize=64)
def _accelerator(robot: Robot, still: bool):
    def run(qpos, qvel, ctrl, water):
        water = water_of(robot.world) if still else water
        return robot_acceleration(robot, qpos, qvel, ctrl, water)

    return jax.jit(share_once(run), compiler_options=QUICK)


def accelerate(robot: Robot, qpos, qvel, ctrl=None, water=None, x64: bool = True) -> np.ndarray:
    """`step.acceleration` of lanes of states, as NumPy: `[nv, lanes]`."""
    with jax.enable_x64(x64):
        kind = jnp.float64 if x64 else jnp.float32
        ctrl = np.zeros((robot.mj_model.nu, np.shape(qpos)[-1])) if ctrl is None else ctrl
        arrays = [jnp.asarray(x, kind) for x in (qpos, qvel, ctrl)]
        return np.asarray(_accelerator(robot, water is None)(*arrays, water))


@lru_cache(maxsize=64)
def _marcher(robot: Robot, records: int, every: int, engine: str, still: bool):
    simulator = make_engine(robot, engine)

    def run(qpos, qvel, targets, water):
        _, kept = roll_out(
            simulator,
            lambda state, time, row, sense: (state, targets),
            flow_at(robot.world, water_of(robot.world) if still else water),
            lambda state, ctrl, energy, water: (*simulator.observe(state), energy),
            simulator.init(qpos, qvel),
            (),
            None,
            records=records,
            every=every,
            timestep=robot.world.timestep,
        )
        return kept

    return jax.jit(run, compiler_options=QUICK)


def march(
    robot: Robot,
    duration: float,
    qpos,
    qvel,
    ctrl=None,
    *,
    water=None,
    every: int = 1,
    engine: str = "population",
    x64: bool = True,
):
    """Steps lanes of one robot with held joint targets.

    Args:
        robot: from `build_robot`.
        duration: [s].
        qpos: `[nq, lanes]`.
        qvel: `[nv, lanes]`.
        ctrl: `[nu, lanes]`, by default 0.
        water: surface and current, by default the world's.
        every: steps between the rows of the result.
        engine: "population" or "mjx".
        x64: in float64.

    Returns:
        `[T]` time, `[T, nq, lanes]`, `[T, nv, lanes]` and `[T, lanes]` servo work since the row
        before, the start not among them.
    """
    dt = robot.world.timestep
    records = round(duration / dt / every)
    with jax.enable_x64(x64):
        kind = jnp.float64 if x64 else jnp.float32
        lanes = np.shape(qpos)[-1]
        ctrl = np.zeros((robot.mj_model.nu, lanes)) if ctrl is None else ctrl
        own = np.asarray(ctrl)[actuators_of(robot)]
        asked = make_engine(robot, engine).plant.arrange(jnp.asarray(own, kind))
        arrays = [*(jnp.asarray(x, kind) for x in (qpos, qvel)), asked]
        run = _marcher(robot, records, every, engine, water is None)
        kept = [np.asarray(x, np.float64) for x in run(*arrays, water)]
    return (dt * every * np.arange(1, records + 1), *kept)


# Small bodies without symmetry. The arm has two crooked limbs of different length: five moving
# bodies, four hinges about two axes. The elbow is one limb of two hinges. The oar has one hinge:
# what has joints compiles no sooner than this.
OAR = "body: {type: Core, children: {1: {type: ActiveHinge, children: {1: {type: FixedBrick}}}}}"
_ARM = """
id: arm
body:
  id: core
  type: Core
  children:
    1:
      id: shoulder
      type: ActiveHinge
      orientation: 90
      children:
        1:
          id: upper
          type: FixedBrick
          orientation: -90
          children:
            1: {id: wrist, type: ActiveHinge, children: {1: {id: hand, type: FixedBrick}}}
    2:
      id: tail
      type: ActiveHinge
      children:
        1: {id: tip, type: ActiveHinge, orientation: 90}
"""
_ELBOW = """
id: elbow
body:
  id: core
  type: Core
  children:
    1:
      id: shoulder
      type: ActiveHinge
      orientation: 90
      children:
        1:
          id: upper
          type: FixedBrick
          children:
            2: {id: wrist, type: ActiveHinge, orientation: 180, children: {1: {type: FixedBrick}}}
"""


def read(text: str) -> Morphology:
    """A morphology from the text of its YAML."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.yaml"
        path.write_text(text)
        return load_morphology(path)


def swimmer(folder: Path, robot: str, task: dict[str, Any]) -> dict[str, Any]:
    """A configuration: a robot that hovers in the lake, and sines that drive it.

    Args:
        folder: where the robot's file is written.
        robot: the text of its YAML.
        task: its settings.

    Returns:
        What `make_fitness` takes.
    """
    path = folder / "robot.yaml"
    path.write_text(robot)
    return {
        "morphology": str(path),
        "world": "lake",
        "trim": "neutral",
        "controller": {"type": "sine"},
        "task": task,
    }


def check_slope_at_rest(controller: Controller, plant: Plant, sense: Sense) -> None:
    """The gradient through some steps of a controller is finite where all genes are 0."""

    def last(genes: jax.Array) -> jax.Array:
        parameters = controller.decode(genes, plant)
        state = controller.init(parameters)
        for k in range(3):
            state, target = controller.step(parameters, state, jnp.asarray(0.3 * k), sense)
        return jnp.sum(target)

    slope = jax.jit(jax.grad(last))(jnp.zeros((controller.num_genes, 1)))
    assert jnp.all(jnp.isfinite(slope))


def arm_robot(tank: World) -> Robot:
    """The arm in a world."""
    return build_robot(read(_ARM), tank)


def elbow_robot(tank: World) -> Robot:
    """The elbow in a world."""
    return build_robot(read(_ELBOW), tank)


def oar_robot(tank: World) -> Robot:
    """The oar in a world."""
    return build_robot(read(OAR), tank)
