"""A tank for robots: worlds in which only what is named acts, and steps in float64.

`experiments.validation` and the tests run their closed forms through it.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.body.module_types import Box, ModuleType, Part
from mjx_revolve.body.morphology import Module, Morphology
from mjx_revolve.engine.engines import make_engine
from mjx_revolve.engine.plant import actuators_of
from mjx_revolve.engine.population import robot_acceleration
from mjx_revolve.engine.robot import Robot, build_robot
from mjx_revolve.episodes.rollout import NO_INPUTS, Rollout, StepInputs, held, open_loop
from mjx_revolve.numerics.xla import OLD_EMITTERS, fuse, on_cpu
from mjx_revolve.water.flow import water_of
from mjx_revolve.water.world import World, load_world

# Nothing but inertia: what is not named is off.
EMPTY = {"gravity": 0.0, "buoyancy": "off", "drag": "off", "added_mass": False, "bed": None}
# A program runs once here: what the compiler's optimisations cost is more than they save. The last
# two leave them out; together with `xla_disable_hlo_passes=fusion` they would give wrong numbers.
# Nor does one program have both cores: in one piece, it takes the compiler a fifth less.
CHEAP = {
    "xla_backend_optimization_level": 0,
    **OLD_EMITTERS,
    "xla_cpu_parallel_codegen_split_count": 1,
}


def quick_options() -> dict[str, Any] | None:
    """The compiler's options for a program that runs once."""
    return CHEAP if on_cpu() else None


def world(**fields: Any) -> World:
    """A world in which only what is named acts."""
    return load_world("empty_underwater", **EMPTY | fields)


def box_robot(
    size: Any, mass: float, tank: World, volume: float | None = None, **part: Any
) -> Robot:
    """A single box; without `volume`, it displaces what its box holds."""
    volume = float(np.prod(size)) if volume is None else volume
    only = Part("box", (Box(tuple(size)),), mass=mass, volume=volume, **part)
    kind = ModuleType("Core", (only,))
    module = Module("box", "Core", -1, -1, 0.0, None, np.zeros(3), np.eye(3), kind=kind)
    return build_robot(Morphology("box", (module,)), tank)


def at_rest(robot: Robot, lanes: int = 1, height: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """`[nq, lanes]` rest pose at a height of the core, and `[nv, lanes]` zeros."""
    model = robot.mj_model
    qpos = np.repeat(model.qpos0[:, None], lanes, 1)
    qpos[2] = height
    return qpos, np.zeros((model.nv, lanes))


@lru_cache(maxsize=64)
def _accelerator(robot: Robot, still: bool) -> Any:
    def run(qpos: Any, qvel: Any, ctrl: Any, water: Any) -> jax.Array:
        water = water_of(robot.world) if still else water
        return robot_acceleration(robot, qpos, qvel, ctrl, water)

    return jax.jit(fuse(run, inline=True), compiler_options=quick_options())


def accelerate(
    robot: Robot, qpos: Any, qvel: Any, ctrl: Any = None, water: Any = None, x64: bool = True
) -> np.ndarray:
    """Acceleration of lanes of states, as MuJoCo's `mj_forward` defines it: `[nv, lanes]`."""
    with jax.enable_x64(x64):
        kind = jnp.float64 if x64 else jnp.float32
        ctrl = np.zeros((robot.mj_model.nu, np.shape(qpos)[-1])) if ctrl is None else ctrl
        arrays = [jnp.asarray(x, kind) for x in (qpos, qvel, ctrl)]
        return np.asarray(_accelerator(robot, water is None)(*arrays, water))


@lru_cache(maxsize=64)
def _marcher(robot: Robot, records: int, every: int, engine: str, still: bool) -> Any:
    simulator = make_engine(robot, engine)

    def run(qpos: Any, qvel: Any, targets: Any, water: Any) -> Any:
        current = water_of(robot.world) if still else water
        rows = targets.ndim == 3
        policy = open_loop if rows else held(targets)
        inputs = StepInputs(ctrl=targets) if rows else NO_INPUTS
        rollout = Rollout(simulator, policy, robot.world, current)
        record = lambda now, ctrl, water: (*simulator.observe(now.state), now.energy)  # noqa: E731
        start = rollout.init(simulator.init(qpos, qvel))
        return rollout.advance(start, record, records, every, inputs)[1]

    return jax.jit(run, compiler_options=quick_options())


def march(
    robot: Robot,
    duration: float,
    qpos: Any,
    qvel: Any,
    ctrl: Any = None,
    *,
    water: Any = None,
    every: int = 1,
    engine: str = "population",
    x64: bool = True,
) -> tuple[np.ndarray, ...]:
    """Steps lanes of one robot with joint targets that are held or prescribed.

    Args:
        robot: from `build_robot`.
        duration: [s].
        qpos: `[nq, lanes]`.
        qvel: `[nv, lanes]`.
        ctrl: `[nu, lanes]`, by default 0, or `[steps, nu, lanes]`, a row for each step.
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
        own = jnp.asarray(np.asarray(ctrl)[..., actuators_of(robot), :], kind)
        arrange = make_engine(robot, engine).plant.arrange
        asked = jax.vmap(arrange)(own) if own.ndim == 3 else arrange(own)
        arrays = [*(jnp.asarray(x, kind) for x in (qpos, qvel)), asked]
        run = _marcher(robot, records, every, engine, water is None)
        kept = [np.asarray(x, np.float64) for x in run(*arrays, water)]
    return (dt * every * np.arange(1, records + 1), *kept)
