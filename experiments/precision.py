"""Work and precision: how far off an episode's end is, over how many robot seconds a core computes.

``python -m experiments.precision [--quick] [--only TEXT] [--rounds N]``

Error: the distance between an episode's end and the same engine's end with converged steps (the
reference), median over individuals, over the median way swum. Work: robot seconds per second of
process CPU time, all engines in one process and measured in turn, so that other programs on the
machine do not count. Engines in one water are given the same commands, those that our controller
gave; each is held against a reference of its own, as joint limits differ. Everything goes to
docs/results/bench.json and docs/precision.png, from where docs/performance.md takes it.
"""

from __future__ import annotations

import functools
import itertools
import math
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.bench_cases import DEPTH, PHYSICS
from experiments.common import ROOT, make_parser, write_results
from mjx_revolve.inputs.commands import run_command, whole
from mjx_revolve.inputs.errors import InputError

_PERCENT = 1.0  # the error at which engines are compared [% of the way]
# Individuals whose ends are compared: of ours a chunk, of C what takes no longer.
_OURS, _FEW = 64, 8
_DRAWN = 512  # random gaits, of which the best are swum; as many are timed
_TIMED = 256  # individuals of MJX that are timed
_USUAL = 0.005  # the timestep that is timed [s]; a step takes as long whatever its length
_KEY = 1
# Sensors at a rate, read late: what robots have.
_RATED = {"rate": 20.0, "delay": 0.1}
_SENSES = {
    "type": "mlp", "harmonics": 1, "hidden": 8,
    "sensors": [{"type": name} | _RATED for name in ("tilt", "gyro", "angle", "speed")],
}  # fmt: skip
_GUST = {"std": [0.02, 0.02, 0.02], "time": 5.0}


@dataclass(frozen=True)
class Case:
    """A robot in a water.

    Attributes:
        name: of the case.
        robot: its morphology; "" for different bodies.
        settings: of the configuration `config`, by dotted name.
        config: a shipped configuration.
        beside: whether MuJoCo C swims in the same water.
        mjx: whether plain MJX is shown, in the inertia box, the only law that it has.
        spread: standard deviation of the genes.
        steps: timesteps [s], where not those of `Sizes`: MuJoCo's law is explicit and refuses long
            ones, and different bodies take long to compile.
    """

    name: str
    robot: str
    settings: dict[str, Any]
    config: str = "lake_swim"
    beside: bool = False
    mjx: bool = False
    spread: float = 0.5
    steps: tuple[float, ...] = ()


_WEIGHTLESS = {"world": PHYSICS["ellipsoid"], "trim": "none"}
_SHORT = (0.01, 0.005, 0.0025, 0.000625)
_LAKE = {"name": "lake", "gust": _GUST}
CASES = (
    Case("spider, ellipsoid law", "spider", _WEIGHTLESS, beside=True, mjx=True, steps=_SHORT),
    Case("snake, ellipsoid law", "snake", _WEIGHTLESS, beside=True, steps=_SHORT),
    Case("16 different bodies, ellipsoid law", "", _WEIGHTLESS, beside=True, steps=_SHORT),
    Case(
        "spider, default water, gusts, sensors at 20 Hz", "spider",
        {"world": _LAKE, "controller": _SENSES},
    ),
    Case("snake, default water, gusts", "snake", {"world": _LAKE}),
    Case(
        "AUV, default water, gusts, thrusters with lag", "auv",
        {"world.gust": {"std": [0.05] * 3, "time": 5.0}, "task.trials": 1}, "auv_hold_depth",
        spread=0.1,
    ),
    Case("16 different bodies, default water, gusts", "", {"world": _LAKE, "trim": "none"},
        steps=_SHORT,
    ),
    Case(
        "spider crawling on the bed, default water", "spider",
        {"world": {"name": "lake"}, "task.type": "crawl", "trim": "none"},
    ),
)  # fmt: skip


@dataclass(frozen=True)
class Sizes:
    """How much is computed.

    Attributes:
        steps: timesteps [s], the longest first; the last is the reference's.
        duration: of episodes [s].
        rounds: of timings.
    """

    steps: tuple[float, ...] = (0.02, 0.01, 0.005, 0.0025, 0.000625)
    duration: float = 10.0
    rounds: int = 3


QUICK = Sizes((0.01, 0.005, 0.00125), 4.0, 2)


@dataclass
class Engine:
    """One engine in one case.

    Attributes:
        name: of the engine.
        ends: timestep → `[n, 3]` starts and ends of episodes [m].
        timed: makes what is timed, and the robot seconds that a call of it computes.
        seconds: CPU seconds of its calls.
    """

    name: str
    ends: Callable[[float], tuple[np.ndarray, np.ndarray]]
    timed: Callable[[], tuple[Callable[[], Any], float]]
    seconds: list[float] = field(default_factory=list)


# ------------------------------------------------------------------ ours


class Ours:
    """Our engine in a case, one compiled program for each timestep."""

    def __init__(self, case: Case, sizes: Sizes) -> None:
        """Compiles nothing yet."""
        self.case, self.sizes = case, sizes
        self._commands = np.zeros(0)
        self.bodies: list[Any] = []

    def fitness(self, step: float) -> Any:
        """The fitness of a timestep, and its bodies' tables."""
        from experiments.random_bodies import random_body
        from mjx_revolve import load_config, make_fitness, make_mixed_fitness

        case = self.case
        settings = {"task.type": "speed"} | case.settings
        if "controller" not in settings:
            settings["controller.harmonics"] = 1
        world = dict(settings.pop("world", {}))
        settings |= {f"world.{key}": value for key, value in world.items()}
        overrides = settings | {
            "morphology": str(ROOT / "morphologies" / f"{case.robot or 'spider'}.yaml"),
            "task.duration": self.sizes.duration, "task.settle": 0.0, "task.start_tilt": 0.0,
            "world.timestep": step,
        }  # fmt: skip
        config = load_config(str(ROOT / "configs" / f"{case.config}.yaml"), overrides=overrides)
        if case.robot:
            return make_fitness(config), ()
        self.bodies = [random_body(k, 4 + k % 13, 6) for k in range(16)]
        mixed = make_mixed_fitness(config, self.bodies, hinges=16)
        lanes = [self.bodies[k % 16] for k in range(_OURS)]
        robots = {id(body): mixed.build(body) for body in self.bodies}
        return mixed, mixed.pack([robots[id(body)] for body in lanes])

    @functools.cached_property
    def genes(self) -> Any:
        """Gaits that get somewhere: the best of random ones, the same for all timesteps."""
        import jax

        fitness, _ = self.fitness(_USUAL)
        count = _DRAWN if self.case.robot else _OURS
        draw = jax.random.normal(jax.random.key(0), (count, fitness.num_genes))
        genes, key = self.case.spread * draw, jax.random.key(_KEY)
        if not self.case.robot:
            return genes
        return genes[jax.numpy.argsort(-fitness(genes, key))[:_OURS]]

    def ends(self, step: float) -> tuple[np.ndarray, np.ndarray]:
        """Starts and ends of a chunk of episodes; the reference's commands are kept."""
        import jax
        import jax.numpy as jnp

        from mjx_revolve.numerics.xla import jit

        fitness, bodies = self.fitness(step)
        stride = round(step / self.sizes.steps[-1])
        beside = self.case.beside and stride == 1
        alike = bool(self.case.robot)

        def run(population: Any, key: Any, gusts: Any) -> Any:
            starts = fitness.precise_starts(population, key)._replace(gusts=gusts)
            lanes = jnp.arange(_OURS, dtype=jnp.int32)
            chunk = fitness.prepare(
                alike, False, bodies, population, starts, lanes, jnp.zeros_like(lanes)
            )
            record = lambda now, ctrl, water: ctrl if beside else ()  # noqa: E731
            rollout, rows = chunk.rollout, fitness.num_timesteps if beside else 1
            every = fitness.num_timesteps // rows
            last, ctrl = rollout.advance(chunk.state, record, rows, every, chunk.inputs)
            root = rollout.engine.root
            return root(chunk.state.state).position, root(last.state).position, ctrl

        first, last, ctrl = jit(run, fast=True)(
            self.genes, jax.random.key(_KEY), self.gusts(fitness, stride)
        )
        if beside:
            self._commands = np.asarray(ctrl, float)
        return np.stack(first, -1).astype(float), np.stack(last, -1).astype(float)

    def commands(self, step: float) -> np.ndarray:
        """`[T, n, lanes]` commands of a timestep's steps, in our order of actuators."""
        return self._commands[:: round(step / self.sizes.steps[-1])]

    def gusts(self, fitness: Any, stride: int) -> Any:
        """One path of gusts for all timesteps, drawn at the reference's; None without."""
        import jax

        from mjx_revolve.episodes.starts import draw_gusts

        if fitness.world.gust is None:
            return None
        world = replace(fitness.world, timestep=self.sizes.steps[-1])
        steps = stride * fitness.num_timesteps
        return draw_gusts(world, jax.random.key(_KEY), steps, 1)[::stride]

    def timed(self) -> tuple[Callable[[], Any], float]:
        """Whole episodes as an optimiser calls for them: controller, track and score included."""
        import jax

        fitness, bodies = self.fitness(_USUAL)
        key, genes, count = jax.random.key(_KEY), self.genes, _OURS
        if self.case.robot:
            genes, count = jax.numpy.tile(genes, (_DRAWN // _OURS, 1)), _DRAWN
        given = (genes, key) if self.case.robot else (bodies, genes, key)
        run = lambda: jax.block_until_ready(fitness.evaluate(*given))  # noqa: E731
        return run, count * fitness.num_timesteps * _USUAL


# ------------------------------------------------------------------ MuJoCo


def c_model(physics: str, body: Any) -> tuple[Any, Any]:
    """MuJoCo's model of a robot in its own water, and our command row of each actuator."""
    from mjx_revolve import build_robot, load_world
    from mjx_revolve.engine.plant import actuators_of, plant_of

    fields = dict(PHYSICS[physics])
    world = load_world(fields.pop("name"), **fields)
    robot = build_robot(body, world)
    model = robot.mj_model
    model.opt.density, model.opt.viscosity = world.density, world.viscosity
    model.qpos0[2] = -DEPTH
    own = actuators_of(robot)
    return model, np.argsort(own[np.asarray(plant_of(robot).source)[:, 0]])


class C:
    """MuJoCo C with one integrator, one thread of `mujoco.rollout`."""

    def __init__(self, ours: Ours, integrator: str, sizes: Sizes, physics: str = "ellipsoid"):
        """Builds the models."""
        import mujoco

        from mjx_revolve import load_morphology

        path = ROOT / "morphologies" / f"{ours.case.robot}.yaml"
        bodies = [load_morphology(str(path))] if ours.case.robot else ours.bodies
        self.ours, self.sizes = ours, sizes
        self.models = [c_model(physics, body) for body in bodies]
        for model, _ in self.models:
            model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator}")

    def _run(self, step: float, lanes: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        import mujoco
        from mujoco import rollout

        starts, ends = [], []
        for k in lanes:
            model, rows = self.models[k % len(self.models)]
            model.opt.timestep = step
            data = mujoco.MjData(model)
            full = mujoco.mjtState.mjSTATE_FULLPHYSICS
            state = np.zeros(mujoco.mj_stateSize(model, full))
            mujoco.mj_getState(model, data, state, full)
            ctrl = self.ours.commands(step)[:, :, k][:, rows]
            found, _ = rollout.rollout(model, data, state[None], ctrl[None])
            starts.append(model.qpos0[:3].copy())
            ends.append(found[0, -1, 1:4])
        return np.array(starts), np.array(ends)

    def ends(self, step: float) -> tuple[np.ndarray, np.ndarray]:
        """See `Engine`."""
        return self._run(step, range(_FEW if self.ours.case.robot else 2 * _FEW))

    def timed(self) -> tuple[Callable[[], Any], float]:
        """See `Engine`; of different bodies a quarter, small and large ones."""
        lanes = range(0, 16, 4) if not self.ours.case.robot else range(4)
        return lambda: self._run(_USUAL, lanes), len(lanes) * self.sizes.duration


class Mjx:
    """Plain `jit(vmap(mjx.step))` in a scan, in the inertia box: the only law that it has."""

    def __init__(self, ours: Ours, sizes: Sizes):
        """Compiles nothing yet."""
        import jax
        import jax.numpy as jnp
        from mujoco import mjx

        from mjx_revolve import load_morphology

        path = ROOT / "morphologies" / f"{ours.case.robot}.yaml"
        model, self.rows = c_model("inertia_box", load_morphology(str(path)))
        self.ours, self.sizes, self.start = ours, sizes, model.qpos0.copy()
        self.model = mjx.put_model(model)

        def run(step: Any, commands: Any) -> Any:
            known = self.model.tree_replace({"opt.timestep": step})
            data = jax.vmap(lambda _: mjx.make_data(known))(jnp.arange(commands.shape[1]))

            def advance(data: Any, ctrl: Any) -> tuple[Any, None]:
                move = jax.vmap(mjx.step, in_axes=(None, 0))
                return move(known, data.replace(ctrl=ctrl)), None

            qpos = jnp.tile(jnp.asarray(self.start, jnp.float32), (commands.shape[1], 1))
            return jax.lax.scan(advance, data.replace(qpos=qpos), commands)[0].qpos

        self.run = jax.jit(run)

    def _commands(self, step: float) -> Any:
        import jax.numpy as jnp

        rows = self.ours.commands(step)[:, self.rows][..., :_FEW]
        return jnp.asarray(np.moveaxis(rows, 2, 1), jnp.float32)

    def ends(self, step: float) -> tuple[np.ndarray, np.ndarray]:
        """See `Engine`."""
        found = np.asarray(self.run(np.float32(step), self._commands(step)), float)
        return np.tile(self.start[:3], (_FEW, 1)), found[:, :3]

    def timed(self) -> tuple[Callable[[], Any], float]:
        """See `Engine`; wider, as MJX gains by it."""
        import jax
        import jax.numpy as jnp

        wide = jnp.tile(self._commands(_USUAL)[:200], (1, _TIMED // _FEW, 1))
        run = lambda: jax.block_until_ready(self.run(np.float32(_USUAL), wide))  # noqa: E731
        return run, _TIMED * len(wide) * _USUAL


# ------------------------------------------------------------------ a case


def make_engines(case: Case, sizes: Sizes) -> list[Engine]:
    """The engines of a case, ours first: the others take its commands."""
    ours = Ours(case, sizes)
    engines = [Engine("ours", ours.ends, ours.timed)]

    def later(make: Callable[[], Any], name: str) -> Engine:
        made: list[Any] = []

        def get() -> Any:
            if not made:
                made.append(make())
            return made[0]

        return Engine(name, lambda step: get().ends(step), lambda: get().timed())

    if case.beside:
        for name in ("EULER", "IMPLICITFAST", "RK4"):
            words = name if name == "RK4" else name.lower() if name != "EULER" else "Euler"
            engines.append(later(lambda n=name: C(ours, n, sizes), f"MuJoCo C, {words}"))
    if case.mjx:
        engines.append(later(lambda: Mjx(ours, sizes), "plain MJX, inertia box"))
    return engines


def error_percent(found: np.ndarray, start: np.ndarray, end: np.ndarray) -> float | None:
    """Distance from the converged end over the way, medians [%]; None where too many blew up."""
    way = float(np.median(np.linalg.norm(end - start, axis=1)))
    off = np.linalg.norm(found - end, axis=1)
    middle = float(np.median(np.where(np.isfinite(off), off, np.inf)))
    return 100 * middle / way if math.isfinite(middle) else None


def work_at(points: Sequence[dict[str, Any]], percent: float) -> float | None:
    """Robot seconds per core second at an error, between the points; None if none is as good.

    Where even the longest step is better, that step's.
    """
    known = sorted((p for p in points if p["error_percent"]), key=lambda p: -p["step_ms"])
    if not known or known[-1]["error_percent"] > percent:
        return None
    if known[0]["error_percent"] <= percent:
        return known[0]["robot_seconds_per_core_second"]
    for far, near in itertools.pairwise(known):
        if near["error_percent"] <= percent < far["error_percent"]:
            a, b = math.log(far["error_percent"]), math.log(near["error_percent"])
            share = (a - math.log(percent)) / (a - b)
            works = (far["robot_seconds_per_core_second"], near["robot_seconds_per_core_second"])
            return math.exp((1 - share) * math.log(works[0]) + share * math.log(works[1]))
    return None


def run_case(case: Case, sizes: Sizes) -> list[dict[str, Any]]:
    """A row for each engine: its points, and its work at the error of comparison."""
    engines = make_engines(case, sizes)
    errors: dict[str, dict[float, float | None]] = {}
    for engine in engines:
        start, last = engine.ends(sizes.steps[-1])
        errors[engine.name] = {}
        for step in sizes.steps[:-1]:
            try:
                found = engine.ends(step)[1]
            except InputError:  # an explicit law refuses it
                found = np.full_like(last, np.nan)
            errors[engine.name][step] = error_percent(found, start, last)
    calls = [engine.timed() for engine in engines]
    for call, _ in calls:
        call()  # compiles
    for number in range(sizes.rounds):  # every other round backwards
        order = list(zip(engines, calls, strict=True))
        for engine, (call, _) in order if number % 2 == 0 else reversed(order):
            began = time.process_time()
            call()
            engine.seconds.append(time.process_time() - began)
    rows = []
    for engine, (_, seconds) in zip(engines, calls, strict=True):
        rate = seconds / statistics.median(engine.seconds) / _USUAL  # steps per core second
        known = errors[engine.name]
        points = [
            {
                "step_ms": 1000 * step,
                "error_percent": error,
                "robot_seconds_per_core_second": rate * step,
            }
            for step, error in known.items()
        ]
        rows.append(
            {
                "name": f"{case.name}: {engine.name}",
                "case": case.name,
                "engine": engine.name,
                "steps_per_core_second": rate,
                "points": points,
                "work": work_at(points, _PERCENT),
                "error": {f"{1e6 * step:.0f}us": known.get(step) for step in Sizes().steps[:-1]},
            }
        )
    best = max((row["work"] or 0.0 for row in rows if "MuJoCo C" in row["engine"]), default=0.0)
    for row in rows:
        row["ratio"] = row["work"] / best if best and row["work"] else None
    return rows


def draw(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """The diagram: a panel for each case, a line for each engine."""
    import matplotlib.pyplot as plt

    names = list(dict.fromkeys(row["case"] for row in rows))
    columns = min(3, len(names))
    lines = -(-len(names) // columns)
    figure, axes = plt.subplots(
        lines, columns, figsize=(4.2 * columns, 3.4 * lines), squeeze=False, layout="constrained"
    )
    for name, axis in zip(names, axes.flat, strict=False):
        for row in (row for row in rows if row["case"] == name):
            known = [p for p in row["points"] if p["error_percent"]]
            axis.loglog(
                [p["robot_seconds_per_core_second"] for p in known],
                [p["error_percent"] for p in known], "o-", label=row["engine"], markersize=4,
            )  # fmt: skip
        axis.axhline(_PERCENT, color="0.7", linewidth=0.8)
        axis.set_title(name, fontsize=9)
        axis.set_xlabel("robot seconds per core second")
        axis.set_ylabel("error of the end [% of the way]")
        axis.legend(fontsize=7)
    for axis in list(axes.flat)[len(names) :]:
        axis.set_axis_off()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(argv: list[str] | None = None) -> int:
    """Measures, draws, and writes the results."""
    parser = make_parser("precision", "Errors of episodes' ends over robot seconds per core second")
    parser.add_argument(
        "--quick", action="store_true", help="one case with short episodes; nothing in docs/"
    )
    parser.add_argument("--only", metavar="TEXT", help="cases whose name contains this")
    parser.add_argument("--rounds", type=whole(1), metavar="N", help="of timings (default: 3)")
    options = parser.parse_args(argv)
    from mjx_revolve.numerics.runtime import prepare_process

    prepare_process()
    import mujoco

    mujoco.set_mju_user_warning(lambda _: None)  # long steps blow up: that is a result
    sizes = QUICK if options.quick else Sizes()
    if options.rounds:
        sizes = replace(sizes, rounds=options.rounds)
    cases = [case for case in CASES if not options.only or options.only in case.name]
    if not cases:
        names = "; ".join(case.name for case in CASES)
        raise InputError(f"--only: expected part of one of: {names}; found {options.only!r}")
    if options.quick:
        cases = [replace(case, mjx=False, steps=()) for case in cases[:1]]
    rows: list[dict[str, Any]] = []
    for case in cases:
        began = time.monotonic()
        found = run_case(case, replace(sizes, steps=case.steps or sizes.steps))
        rows += found
        print(f"\n{case.name} ({time.monotonic() - began:.0f} s)")
        for row in found:
            errors = ", ".join(
                f"{p['step_ms']:g} ms: " + ("-" if p["error_percent"] is None
                                            else f"{p['error_percent']:.2g} %")
                for p in row["points"]
            )  # fmt: skip
            work = "-" if row["work"] is None else f"{row['work']:.0f}"
            ratio = "" if row["ratio"] is None else f", {row['ratio']:.3g} times the best of C"
            print(f"  {row['engine']}: {row['steps_per_core_second'] / 1e6:.3f} Msteps/s; {errors}")
            print(f"    at {_PERCENT:g} %: {work} robot seconds per core second{ratio}", flush=True)
        if not options.quick and not options.only:  # after each case: nothing measured is lost
            save(rows)
    return 0


def save(rows: list[dict[str, Any]]) -> None:
    """Writes the results and the diagram."""
    draw(rows, ROOT / "docs" / "precision.png")
    write_results("bench", {"percent": _PERCENT, "rows": rows}, (0, _KEY))


if __name__ == "__main__":
    sys.exit(run_command(main))
