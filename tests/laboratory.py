"""Small robots and a tank to try them in: what several files of tests share.

Everything here runs the package's own step, in float64, so that tolerances can say what a law's
discretisation errs by and not what float32 rounds to.
"""

import copy
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.water_tank import (
    CHEAP,
    accelerate,
    at_rest,
    box_robot,
    march,
    quick_options,
    world,
)
from mjx_revolve.body.morphology import Morphology, load_morphology, make_morphology
from mjx_revolve.control.controller import Controller
from mjx_revolve.control.readings import EpisodeContext, SensorReadings, init_memory, read_sensors
from mjx_revolve.engine.batch import Capacity, pack_bodies
from mjx_revolve.engine.batched_trees import make_batched_trees
from mjx_revolve.engine.plant import Plant
from mjx_revolve.engine.population import PopulationEngine
from mjx_revolve.engine.robot import Robot, build_robot
from mjx_revolve.episodes.tasks import Track
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics.xla import OLD_EMITTERS, on_cpu
from mjx_revolve.water.face_drag import FACES, FaceNumbers
from mjx_revolve.water.flow import water_of
from mjx_revolve.water.world import World

__all__ = ["accelerate", "at_rest", "box_robot", "march", "world"]

ROOT = Path(__file__).resolve().parents[1]
OURS = sorted((ROOT / "morphologies").glob("*.yaml"))
WILD = sorted((ROOT.parent / "shared" / "revolve_robots").glob("*.yaml"))

# What real water does, for `world`.
WATER = {"gravity": 9.81, "buoyancy": "partial", "drag": "faces", "added_mass": True}


def need_mjx() -> None:
    """Skips what follows in a test where MJX is not installed."""
    pytest.importorskip("mujoco.mjx", reason="the extra [mjx] is not installed")


def body(name: str) -> Morphology:
    """One of the shipped robots."""
    return load_morphology(ROOT / "morphologies" / f"{name}.yaml")


def tree(body: Morphology) -> list[tuple[tuple[int, ...], str, float]]:
    """(slots from the core, type, turn) of all modules but the core, in order."""
    paths: list[tuple[int, ...]] = [()]
    for module in body.modules[1:]:
        paths.append((*paths[module.parent], module.slot))
    return [(path, m.type, m.orientation) for path, m in zip(paths, body.modules, strict=True)][1:]


def face_drag(robot: Robot) -> FaceNumbers:
    """Drag of the faces of all parts, `[npart, 3]` each."""
    numbers: FaceNumbers = FACES.numbers(robot.fluid, robot.world)
    return numbers


def limp(robot):
    """The robot without servos, friction and end stops."""
    model = copy.copy(robot.mj_model)
    model.actuator_gainprm[:, 0], model.actuator_biasprm[:] = 1e-12, 0.0
    model.dof_damping[:], model.jnt_limited[:], model.jnt_user[:] = 0.0, 0, np.inf
    return robot.with_model(model)


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


_USUAL = {
    "xla_backend_optimization_level": 3,
    **dict.fromkeys(OLD_EMITTERS, True),
    "xla_cpu_parallel_codegen_split_count": 32,
}


def _compile_quickly() -> None:
    """Makes `CHEAP` this process's default, but not that of processes which tests start.

    XLA reads its flags once, when its first client is made. Who sets XLA_FLAGS, be it to nothing,
    has the tests compiled as they say.
    """
    if "XLA_FLAGS" not in os.environ:
        os.environ |= XLA_FLAGS
        jax.jit(lambda x: x + 1)(0.0)
        del os.environ["XLA_FLAGS"]


XLA_FLAGS = {
    "XLA_FLAGS": os.environ.get(
        "XLA_FLAGS", " ".join(f"--{name}={str(value).lower()}" for name, value in CHEAP.items())
    )
}
_compile_quickly()
QUICK = quick_options()
USUAL = _USUAL if on_cpu() else None  # as users compile
# A derivative is all calls of small functions; inlined into one another, they take XLA 7 times as
# long. Its numbers are then compared with differences of a program that was compiled otherwise.
SLOPE = CHEAP | {"xla_disable_hlo_passes": "call-inliner"} if on_cpu() else None


@contextmanager
def compiled_quickly() -> Iterator[None]:
    """Leaves out the compiler's optimisations: they cost more than short runs save."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mjx_revolve.numerics.xla.compiler_options", lambda fast=False: QUICK)
        yield


def batch_engine(
    robots: Sequence[Robot], capacity: Capacity, lanes: int, kind: Any = np.float64
) -> PopulationEngine:
    """The step for different bodies side by side."""
    bodies = pack_bodies(robots, capacity, kind)
    trees = make_batched_trees(robots[0].world, capacity, bodies, lanes)
    return PopulationEngine(trees, jax.tree.map(jnp.asarray, bodies.plant))


def sensed(
    engine_of: Callable[[], Any], tank: World, after: Any, ctrl: Any, signals: Any,
    cues: EpisodeContext, before: Any = None, time: float = 0.0,
) -> tuple[SensorReadings, np.ndarray]:  # fmt: skip
    """What is felt after a step, in float64, as NumPy; and the plant's rows."""
    with jax.enable_x64(True):

        def run(before: Any, after: Any, ctrl: Any) -> Any:
            engine, now = engine_of(), jnp.asarray(time)
            memory = init_memory(signals, engine, engine.init(*before))
            memory = memory._replace(ctrl=engine.plant.arrange(ctrl))
            state, water = engine.init(*after), water_of(tank)
            found = read_sensors(tank, engine, state, water, now, cues, memory, signals)
            return found._replace(noise=None), engine.plant.source

        arrays = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), (before or after, after, ctrl))
        found, source = jax.jit(run, compiler_options=QUICK)(*arrays)
        return jax.tree.map(np.asarray, found), np.asarray(source)


def play(
    controller: Controller, plant: Plant, genes: Any, steps: int, sense: Any, start: int = 0
) -> tuple[np.ndarray, Any]:
    """`[steps, n, lanes]` targets of a controller, and its states, in float64, at 200 Hz."""
    with jax.enable_x64(True):

        def run(genes: Any, sense: Any) -> Any:
            parameters = controller.decode(genes, plant)

            def step(state: Any, k: Any) -> Any:
                state, target = controller.step(parameters, state, 0.005 * (start + k), sense)
                return state, (target, state)

            return jax.lax.scan(step, controller.init(parameters), jnp.arange(steps))[1]

        given = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), (genes, sense))
        found: tuple[np.ndarray, Any] = jax.tree.map(np.asarray, jax.jit(run)(*given))
        return found


@lru_cache
def dry_robot(name: str) -> Robot:
    """One of the shipped robots in a world of nothing."""
    return build_robot(body(name), world())


def refusal(function: Callable[..., Any], *given: Any, **more: Any) -> str:
    """What the `InputError` says in which a call ends."""
    with pytest.raises(InputError) as error:
        function(*given, **more)
    return str(error.value)


def check_refused(
    message: str, function: Callable[..., Any], *given: Any, start: str = "", **more: Any
) -> None:
    """A call ends in an `InputError` of one line, with a message in it and a start."""
    found = refusal(function, *given, **more)
    assert message in found and found.startswith(start) and "\n" not in found, found


def check_error(captured: Any, message: str) -> None:
    """A command has ended in one line, an error with a message in it."""
    assert captured.err.startswith("error: ") and captured.err.count("\n") == 1
    assert message in captured.err


def with_motors(robot: Robot, factor: float) -> Robot:
    """The robot with other top speeds of its motors."""
    model = copy.copy(robot.mj_model)
    model.jnt_user[:] *= factor
    return robot.with_model(model)


# Small bodies without symmetry. The arm has two crooked limbs of different length: five moving
# bodies, four hinges about two axes. The elbow is one limb of two hinges. The oar has one hinge:
# what has joints compiles no sooner than this.
OAR = "body: {type: Core, children: {1: {type: ActiveHinge, children: {1: {type: FixedBrick}}}}}"
ARM = """
id: arm
body:
  id: core
  type: Core
  children:
    1: {id: shoulder, type: ActiveHinge, orientation: 90, children: {1: {
          id: upper, type: FixedBrick, orientation: -90, children: {1: {
            id: wrist, type: ActiveHinge, children: {1: {id: hand, type: FixedBrick}}}}}}}
    2: {id: tail, type: ActiveHinge, children: {1: {id: tip, type: ActiveHinge, orientation: 90}}}
"""
ELBOW = """
id: elbow
body:
  id: core
  type: Core
  children:
    1: {id: shoulder, type: ActiveHinge, orientation: 90, children: {1: {
          id: upper, type: FixedBrick, children: {2: {
            id: wrist, type: ActiveHinge, orientation: 180, children: {1: {type: FixedBrick}}}}}}}
"""


def write(folder: Path, text: str, name: str = "robot.yaml") -> Path:
    """A new file with a text."""
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def read(text: str) -> Morphology:
    """A morphology from the text of its YAML."""
    with tempfile.TemporaryDirectory() as folder:
        return load_morphology(write(Path(folder), text))


def fork(length: int, base: int) -> Morphology:
    """Two parallel arms that look ahead, each with a hinge and so many bricks behind it."""

    def side(slot: int) -> dict[str, Any]:
        tip: dict[str, Any] = {"type": "FixedBrick", "orientation": -90}
        arm = {"type": "ActiveHinge", "orientation": 90, "children": {1: tip}}
        for _ in range(length - 1):
            tip["children"] = {1: {"type": "FixedBrick"}}
            tip = tip["children"][1]
        top = {"type": "FixedBrick", "children": {slot: arm}}
        for _ in range(base):
            top = {"type": "FixedBrick", "children": {1: top}}
        return top

    return make_morphology({"type": "Core", "children": {2: side(3), 3: side(2)}}, name="fork")


def swimmer(folder: Path, robot: str, task: dict[str, Any]) -> dict[str, Any]:
    """What `make_fitness` takes: a robot, written to a folder, that hovers in the lake; sines."""
    return {
        "morphology": str(write(folder, robot)),
        "world": {"name": "lake", "bed": False},  # out of reach, and a replay would compile it
        "trim": "neutral",
        "controller": {"type": "sine"},
        "task": task,
    }


def make_track(position: Any, interval: float = 1.0, **more: Any) -> Track:
    """A track of one individual, half a metre long: `position` `[S, 3]` and others get a lane."""
    ones = np.ones(len(position))
    lanes = {"position": position, "clearance": ones, "energy": ones} | more
    return Track(
        interval=interval, start_height=jnp.zeros(1), length=0.5, weight=2.0, surface_height=3.0,
        num_hinges=np.shape(more["angle"])[1] if "angle" in more else 0,
        **{name: jnp.asarray(np.asarray(x, np.float32)[..., None]) for name, x in lanes.items()},
    )  # fmt: skip


def _made_of(text: str) -> Callable[[World], Robot]:
    """What builds a robot from the text of its YAML."""
    return lambda tank: build_robot(read(text), tank)


arm_robot, elbow_robot, oar_robot = map(_made_of, (ARM, ELBOW, OAR))
