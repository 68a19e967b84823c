"""Work and precision: how far off an episode's end is, over how many robot seconds a core computes.

``python -m experiments.precision [--quick] [--only TEXT] [--rounds N] [--results]``

Error: the distance between an episode's end and its end with converged steps (the reference),
median over individuals, over the median way swum. Work: robot seconds per second of process CPU
time, all engines in one process and measured in turn, so that other programs on the machine do not
count; of each engine at its shortest step and at the longest that does not blow up, and of those
between by a line in 1 / step, beyond by 1 / step. Engines in one water are given the same commands,
those of our controller. Ours is held against a reference of its own, with a quarter of the shortest
step; MuJoCo C's integrators against its RK4 with the same: joint limits are springs there and
constraints here. `--only` measures some cases; with `--results` theirs replace those in
docs/results/precision.json, from where docs/precision.png and docs/performance.md have them.
"""

from __future__ import annotations

import functools
import itertools
import math
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from experiments.bench_cases import DEPTH, PHYSICS
from experiments.common import (
    RESULTS,
    ROOT,
    check_whole,
    make_folder,
    make_parser,
    read_rows,
    today,
    write_results,
)
from mjx_revolve.inputs.commands import run_command, whole
from mjx_revolve.inputs.errors import InputError

_PERCENT = 1.0  # the error at which engines are compared [% of the way]
_OURS, _FEW = 64, 16  # individuals whose ends are compared: ours alone, and beside C
_DRAWN = 512  # random gaits, of which the best are swum; as many are timed
# Individuals of MJX that are compared, and that are timed; steps of a call.
_MJX, _TIMED, _CALL = 4, 64, 100
_USUAL = 0.005  # the timestep with which gaits are chosen, and whose rate is shown [s]
_CLEAR = 20.0  # up to this error [%] hardly any individual blows up, which takes longer
_RATE = 20  # of commands [Hz]; all steps divide its period
_KEY = 1
_LOST = 10.0  # what ends so many ways off has blown up
# Strokes of one sine. Commands ramp: with held ones the servos' jerks, not the water, decide how
# far off a step is, and a gait that was found with 5 ms may swim twice as far as it should.
_GAIT = {
    "type": "sine", "harmonics": 1, "max_frequency": 1.0, "amplitude": 0.5, "between": "ramp",
}  # fmt: skip
# Sensors at a rate, read late: what robots have.
_RATED = {"rate": 20.0, "delay": 0.1}
_SENSES = {
    "type": "sensory_cpg", "gain": 0.3, "max_frequency": 1.0, "amplitude": 0.5, "between": "ramp",
    "sensors": [{"type": name} | _RATED for name in ("tilt", "gyro", "angle", "speed")],
}  # fmt: skip
_GUST = {"std": [0.02, 0.02, 0.02], "time": 5.0}


@dataclass(frozen=True)
class Case:
    """A robot in a water.

    Attributes:
        name: of the case.
        robot: its morphology; "" for different bodies.
        bodies: how many different ones.
        learners: individuals of each body that are timed, as where bodies learn in their lives.
        settings: of the configuration `config`, by dotted name.
        config: a shipped configuration.
        beside: whether MuJoCo C swims in the same water.
        mjx: whether plain MJX is shown, in the inertia box, the only law that it has.
        steps: timesteps [s], the longest first; explicit laws refuse long ones.
        spread: standard deviation of the genes.
    """

    name: str
    robot: str
    settings: dict[str, Any]
    config: str = "experiments/sine_swim"
    beside: bool = False
    mjx: bool = False
    steps: tuple[float, ...] = (0.025, 0.01, 0.005, 0.0025)
    spread: float = 0.5
    bodies: int = 256
    learners: int = 1


_WEIGHTLESS = {"world": PHYSICS["ellipsoid"], "trim": "none"}
_SHORT = (0.01, 0.005, 0.0025, 0.00125)
_LAKE = {"name": "lake", "gust": _GUST}
CASES = (
    Case("spider, ellipsoid law", "spider", _WEIGHTLESS, beside=True, mjx=True, steps=_SHORT),
    Case("snake, ellipsoid law", "snake", _WEIGHTLESS, beside=True, steps=_SHORT),
    Case("centipede, ellipsoid law", "centipede", _WEIGHTLESS, beside=True, steps=_SHORT),
    Case("256 bodies, ellipsoid law", "", _WEIGHTLESS, beside=True, steps=_SHORT[:3]),
    Case(
        "26 bodies with 64 learners each, ellipsoid law", "", _WEIGHTLESS, beside=True,
        steps=_SHORT[:3], bodies=26, learners=64,
    ),
    Case("spider, default water, gusts", "spider", {"world": _LAKE}),
    Case(
        "spider, default water, gusts, sensors at 20 Hz", "spider",
        {"world": _LAKE, "controller": _SENSES},
    ),
    Case("snake, default water, gusts", "snake", {"world": _LAKE}),
    Case(
        "AUV, default water, gusts, thrusters with lag", "auv",
        {"world.gust": {"std": [0.05] * 3, "time": 5.0}, "task.trials": 1,
         "controller": {"type": "feedback", "gain": 0.5, "between": "ramp"}},
        "configs/auv_hold_depth", spread=0.05,
    ),
    Case("256 bodies, default water, gusts", "", {"world": _LAKE, "trim": "none"}),
    Case(
        "spider crawling on the bed, default water", "spider",
        {"world": {"name": "lake"}, "task.type": "crawl", "trim": "none"},
    ),
)  # fmt: skip


@dataclass(frozen=True)
class Sizes:
    """How much is computed.

    Attributes:
        duration: of episodes [s].
        rounds: of timings.
        shown: how many of a case's steps, the longest left out.
    """

    duration: float = 10.0
    rounds: int = 3
    shown: int = 4


QUICK = Sizes(2.0, 1, 2)
_ALL = sorted({step for case in CASES for step in case.steps}, reverse=True)


Ends = tuple[np.ndarray, np.ndarray]
"""`[n, 3]` starts and ends of episodes [m]."""


class Engine(Protocol):
    """One engine in one case; `name` tells which."""

    name: str

    def ends(self, step: float) -> Ends:
        """Of episodes with a timestep [s]."""
        ...

    def reference(self) -> Ends:
        """With converged steps."""
        ...

    def timed(self, step: float) -> tuple[Callable[[], Any], float]:
        """What is timed, and the robot seconds that a call of it computes."""
        ...


# ------------------------------------------------------------------ ours


class Ours:
    """Our engine in a case, one compiled program for each timestep.

    Attributes:
        case: the case.
        duration: of episodes [s].
        finest: the reference's timestep [s].
    """

    name = "ours"

    def __init__(self, case: Case, sizes: Sizes) -> None:
        """Compiles nothing yet."""
        self.case, self.duration = case, sizes.duration
        self.finest = case.steps[-1] / 4

    @functools.cached_property
    def bodies(self) -> list[Any]:
        """The morphologies."""
        from experiments.random_bodies import random_body
        from mjx_revolve import load_morphology

        if self.case.robot:
            return [load_morphology(str(ROOT / "morphologies" / f"{self.case.robot}.yaml"))]
        return [random_body(k, 4 + k % 13, 6) for k in range(self.case.bodies)]

    def fitness(self, step: float) -> Any:
        """The fitness of a timestep, and its bodies' tables."""
        from mjx_revolve import load_config, make_fitness, make_mixed_fitness

        case = self.case
        settings = {"task.type": "speed", "controller": _GAIT} | case.settings
        for section in ("world", "controller"):
            values = dict(settings.pop(section, {}))
            settings |= {f"{section}.{key}": value for key, value in values.items()}
        overrides = {"controller.harmonics": 1} | settings | {
            "morphology": str(ROOT / "morphologies" / f"{case.robot or 'spider'}.yaml"),
            "controller.rate": float(_RATE), "task.duration": self.duration, "task.settle": 0.0,
            "task.start_tilt": 0.0, "world.timestep": step,
        }  # fmt: skip
        config = load_config(str(ROOT / f"{case.config}.yaml"), overrides=overrides)
        if case.robot:
            return make_fitness(config), ()
        mixed = make_mixed_fitness(config, self.bodies, hinges=16)
        return mixed, mixed.pack([mixed.build(body) for body in self.bodies])

    @functools.cached_property
    def genes(self) -> Any:
        """Gaits that get somewhere, the same for all timesteps.

        Of one body the best after some rounds of the cross-entropy method (Rubinstein 1999), of
        different bodies the best of each body's random ones.
        """
        import jax

        fitness, bodies = self.fitness(_USUAL)
        rounds, keys = (15, jax.random.split(jax.random.key(0), 15))
        key, count = jax.random.key(_KEY), fitness.num_genes
        if not self.case.robot:
            shape = (rounds, self.case.bodies, count)
            draws = self.case.spread * jax.random.normal(keys[0], shape)
            scores = np.stack([np.asarray(fitness(bodies, genes, key)) for genes in draws])
            return draws[np.argmax(scores, 0), np.arange(self.case.bodies)]
        mean, spread = np.zeros(count, np.float32), np.full(count, self.case.spread, np.float32)
        for drawn in keys:
            genes = mean + spread * jax.random.normal(drawn, (_DRAWN, count))
            best = genes[np.argsort(-np.asarray(fitness(genes, key)))[:_OURS]]
            mean, spread = np.asarray(best.mean(0)), np.asarray(best.std(0))
        return best

    @functools.cached_property
    def compared(self) -> np.ndarray:
        """Numbers of the individuals whose ends are compared; of different bodies, all sizes."""
        count = _FEW if self.case.beside else _OURS
        return np.arange(count) * (len(self.genes) // count)

    def _run(self, step: float) -> tuple[Ends, np.ndarray]:
        """Starts and ends, and for other engines the commands `[T, n, lanes]`."""
        import jax
        import jax.numpy as jnp

        from mjx_revolve.numerics.xla import jit

        fitness, bodies = self.fitness(step)
        alike, beside = bool(self.case.robot), self.case.beside
        beside = beside and step == self.finest
        rows = fitness.num_timesteps if beside else 1
        every = fitness.num_timesteps // rows
        lanes = jnp.asarray(np.resize(self.compared, _OURS), jnp.int32)

        def run(bodies: Any, population: Any, key: Any, gusts: Any) -> Any:
            starts = fitness.precise_starts(population, key)._replace(gusts=gusts)
            chunk = fitness.prepare(
                alike, False, bodies, population, starts, lanes, jnp.zeros_like(lanes)
            )
            rollout = chunk.rollout
            record = lambda now, ctrl, water: ctrl if beside else ()  # noqa: E731
            last, ctrl = rollout.advance(chunk.state, record, rows, every, chunk.inputs)
            root = rollout.engine.root
            # The whole state is asked for: XLA:CPU aborts over loops of which a part is not.
            return root(chunk.state.state).position, root(last.state).position, ctrl, last

        key = jax.random.key(_KEY)
        given = bodies, self.genes, key, self.gusts(fitness, step)
        first, last, ctrl, _ = jit(run, fast=True)(*given)
        count = len(self.compared)
        ends = np.stack(first, -1)[:count].astype(float), np.stack(last, -1)[:count].astype(float)
        return ends, np.asarray(ctrl, float)[..., :count] if beside else np.zeros(0)

    def ends(self, step: float) -> Ends:
        """See `Engine`."""
        return self._run(step)[0]

    @functools.cached_property
    def _converged(self) -> tuple[Ends, np.ndarray]:
        return self._run(self.finest)

    def reference(self) -> Ends:
        """See `Engine`: a quarter of the shortest step shown."""
        return self._converged[0]

    def commands(self, step: float, few: int = _FEW) -> np.ndarray:
        """`[T, n, few]` commands of a timestep's steps, in our order of actuators."""
        return self._converged[1][:: round(step / self.finest), :, :few]

    def gusts(self, fitness: Any, step: float) -> Any:
        """One path of gusts for all timesteps, drawn at the reference's; None without."""
        import jax

        from mjx_revolve.episodes.starts import draw_gusts

        if fitness.world.gust is None:
            return None
        world, stride = replace(fitness.world, timestep=self.finest), round(step / self.finest)
        steps = stride * fitness.num_timesteps
        return draw_gusts(world, jax.random.key(_KEY), steps, 1)[::stride]

    def timed(self, step: float) -> tuple[Callable[[], Any], float]:
        """Whole episodes as an optimiser calls for them: controller, track and score included."""
        import jax

        fitness, bodies = self.fitness(step)
        key, genes = jax.random.key(_KEY), self.genes
        if self.case.robot:
            genes = jax.numpy.tile(genes, (_DRAWN // _OURS, 1))
        elif self.case.learners > 1:
            genes = jax.numpy.repeat(genes[:, None], self.case.learners, 1)
        given = (genes, key) if self.case.robot else (bodies, genes, key)
        run = lambda: jax.block_until_ready(fitness.evaluate(*given))  # noqa: E731
        count = math.prod(genes.shape[:-1])
        return run, count * fitness.num_timesteps * step


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

    def __init__(self, ours: Ours, integrator: str, physics: str = "ellipsoid"):
        """Builds the models of the individuals that are compared."""
        import mujoco

        self.name = f"MuJoCo C, {integrator}"
        self.ours, self.integrator = ours, integrator
        bodies = [ours.bodies[k % len(ours.bodies)] for k in ours.compared]
        made = {id(body): c_model(physics, body) for body in bodies}
        self.models = [made[id(body)] for body in bodies]
        for model, _ in self.models:  # what blows up is not to begin anew
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET

    def _run(self, step: float, integrator: str) -> Ends:
        import mujoco
        from mujoco import rollout

        commands = self.ours.commands(step)
        starts, ends = [], []
        for k, (model, rows) in enumerate(self.models):
            model.opt.timestep = step
            model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
            data = mujoco.MjData(model)
            full = mujoco.mjtState.mjSTATE_FULLPHYSICS
            state = np.zeros(mujoco.mj_stateSize(model, full))
            mujoco.mj_getState(model, data, state, full)
            ctrl = np.ascontiguousarray(commands[:, rows, k])
            found, _ = rollout.rollout(model, data, state[None], ctrl[None])
            starts.append(model.qpos0[:3].copy())
            ends.append(found[0, -1, 1:4])
        return np.array(starts), np.array(ends)

    def ends(self, step: float) -> Ends:
        """See `Engine`."""
        return self._run(step, self.integrator)

    def reference(self) -> Ends:
        """See `Engine`: with our reference's step; of fourth order, but where that blows up."""
        found = self._run(self.ours.finest, "RK4")
        return found if np.isfinite(found[1]).all() else self._run(self.ours.finest, "Euler")

    def timed(self, step: float) -> tuple[Callable[[], Any], float]:
        """See `Engine`."""
        seconds = len(self.models) * self.ours.duration
        return lambda: self._run(step, self.integrator), seconds


class Mjx:
    """Plain `jit(vmap(mjx.step))` in a scan, in the inertia box: the only law that it has."""

    name = "plain MJX, inertia box"

    def __init__(self, ours: Ours):
        """Compiles nothing yet."""
        import jax
        from mujoco import mjx

        model, self.rows = c_model("inertia_box", ours.bodies[0])
        self.ours, self.start = ours, model.qpos0.copy()
        self.model = mjx.put_model(model)

        def begin(qpos: Any) -> Any:
            return jax.vmap(lambda q: mjx.make_data(self.model).replace(qpos=q))(qpos)

        def run(step: Any, data: Any, commands: Any) -> Any:
            known = self.model.tree_replace({"opt.timestep": step})

            def advance(data: Any, ctrl: Any) -> tuple[Any, None]:
                move = jax.vmap(mjx.step, in_axes=(None, 0))
                return move(known, data.replace(ctrl=ctrl)), None

            return jax.lax.scan(advance, data, commands)[0]

        self._begin, self._run = jax.jit(begin), jax.jit(run)

    def _ends(self, step: float, commands: np.ndarray) -> Ends:
        """Of commands `[T, n, lanes]`, in calls of one length, which are compiled once."""
        import jax.numpy as jnp

        rows = jnp.asarray(np.moveaxis(commands[:, self.rows], 2, 1), jnp.float32)
        start = np.tile(self.start, (rows.shape[1], 1))
        data = self._begin(jnp.asarray(start, jnp.float32))
        for k in range(0, len(rows), _CALL):
            data = self._run(np.float32(step), data, rows[k : k + _CALL])
        return start[:, :3], np.asarray(data.qpos[:, :3], float)

    def ends(self, step: float) -> Ends:
        """See `Engine`."""
        return self._ends(step, self.ours.commands(step, _MJX))

    def reference(self) -> Ends:
        """See `Engine`: half of the shortest step shown."""
        return self.ends(self.ours.case.steps[-1] / 2)

    def timed(self, step: float) -> tuple[Callable[[], Any], float]:
        """See `Engine`; wider, as MJX gains by it."""
        wide = np.tile(self.ours.commands(step)[:_CALL], (1, 1, _TIMED // _FEW))
        return lambda: self._ends(step, wide), _TIMED * _CALL * step


# ------------------------------------------------------------------ a case


def make_engines(case: Case, sizes: Sizes) -> list[Engine]:
    """The engines of a case, ours first: the others take its commands."""
    ours = Ours(case, sizes)
    engines: list[Engine] = [ours]
    if case.beside:
        engines += [C(ours, name) for name in ("Euler", "implicitfast", "RK4")]
    if case.mjx:
        engines.append(Mjx(ours))
    return engines


def error_percent(found: np.ndarray, start: np.ndarray, end: np.ndarray) -> float | None:
    """Distance from the converged end over the way, medians [%]; None where too many blew up."""
    way = float(np.median(np.linalg.norm(end - start, axis=1)))
    off = np.linalg.norm(found - end, axis=1)
    middle = float(np.median(np.where(np.isfinite(off), off, np.inf)))
    return 100 * middle / way if middle < _LOST * way else None


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


def timed_steps(known: Mapping[float, float | None]) -> list[float]:
    """The steps that are timed: the shortest, and the longest that does not blow up."""
    clear = [step for step, error in known.items() if error is not None and error <= _CLEAR]
    return sorted({min(known), max(clear, default=min(known))})


def cost_of(steps: Sequence[float], seconds: Sequence[float]) -> Callable[[float], float]:
    """CPU seconds per robot second over the step, from those of one or two steps.

    A step costs as long whatever its length; commands, records and episodes cost what they do per
    robot second: a line in 1 / step. Beyond the longest of two, all of it goes as 1 / step.
    """

    def cost(step: float) -> float:
        if step >= steps[-1]:
            return seconds[-1] * steps[-1] / step
        each = (seconds[0] - seconds[-1]) / (1 / steps[0] - 1 / steps[-1])
        return seconds[0] + each * (1 / step - 1 / steps[0])

    return cost


def run_case(case: Case, sizes: Sizes) -> list[dict[str, Any]]:
    """A row for each engine: its points, and its work at the error of comparison."""
    engines = make_engines(case, sizes)
    errors: list[dict[float, float | None]] = []
    converged: Ends | None = None
    for engine in engines:
        if not isinstance(engine, C) or converged is None:  # one for all of C's integrators
            converged = engine.reference()
        start, last = converged
        found: dict[float, float | None] = {}
        for step in case.steps[-sizes.shown :]:
            try:
                found[step] = error_percent(engine.ends(step)[1], start, last)
            except InputError:  # an explicit law refuses it
                found[step] = None
        errors.append(found)
        if isinstance(engine, Ours):
            converged = None
    timed = [(number, step) for number, known in enumerate(errors) for step in timed_steps(known)]
    calls = [engines[number].timed(step) for number, step in timed]
    for call, _ in calls:
        call()  # compiles
    spent: list[list[float]] = [[] for _ in calls]
    for number in range(sizes.rounds):  # every other round backwards
        order = list(zip(calls, spent, strict=True))
        for (call, _), times in order if number % 2 == 0 else reversed(order):
            began = time.process_time()
            call()
            times.append(time.process_time() - began)
    took = {
        of: statistics.median(times) / seconds
        for of, (_, seconds), times in zip(timed, calls, spent, strict=True)
    }
    rows = []
    for number, (engine, known) in enumerate(zip(engines, errors, strict=True)):
        steps = timed_steps(known)
        cost = cost_of(steps, [took[number, step] for step in steps])
        points = [
            {
                "step_ms": 1000 * step,
                "error_percent": error,
                "robot_seconds_per_core_second": 1 / cost(step),
            }
            for step, error in known.items()
        ]
        rows.append(
            {
                "name": f"{case.name}: {engine.name}",
                "case": case.name,
                "engine": engine.name,
                "steps_per_core_second": 1 / cost(_USUAL) / _USUAL,
                "points": points,
                "order": find_order(points),
                "work": work_at(points, _PERCENT),
                "error": {f"{1e6 * step:.0f}us": known.get(step) for step in _ALL},
            }
        )
    best = max((row["work"] or 0.0 for row in rows if "MuJoCo C" in row["engine"]), default=0.0)
    for row in rows:
        row["ratio"] = row["work"] / best if best and row["work"] else None
    return rows


def find_order(points: Sequence[dict[str, Any]]) -> float | None:
    """By what power of the step the error shrinks between the two shortest; None if it does not.

    Of a method of first order 1.2 beside a reference with a quarter of the shortest step (of errors
    h - h_ref), 1.6 beside one with half of it; near 0 it is a floor that no step lowers.
    """
    if len(points) < 2:
        return None
    far, near = points[-2:]
    if not far["error_percent"] or not near["error_percent"]:
        return None
    gain = math.log(far["error_percent"] / near["error_percent"])
    return gain / math.log(far["step_ms"] / near["step_ms"])


def draw(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """The diagram: a panel for each case, a line for each engine."""
    import matplotlib.pyplot as plt
    from matplotlib.ticker import NullFormatter

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
                [p["error_percent"] for p in known], "o-", markersize=4,
                label=row["engine"] if known else None,
            )  # fmt: skip
        axis.axhline(_PERCENT, color="0.7", linewidth=0.8)
        axis.set_title(name, fontsize=9)
        axis.xaxis.set_minor_formatter(NullFormatter())  # labels would overlap
        axis.set_xlabel("robot seconds per core second")
        axis.set_ylabel("error of the end [% of the way]")
        axis.legend(fontsize=7, framealpha=0.5)
    for axis in list(axes.flat)[len(names) :]:
        axis.set_axis_off()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(argv: list[str] | None = None) -> int:
    """Measures, prints, and with `--results` draws and writes."""
    parser = make_parser("precision", "Errors of episodes' ends over robot seconds per core second")
    parser.add_argument("--quick", action="store_true", help="two cases with short episodes")
    parser.add_argument("--only", metavar="TEXT", help="cases whose name contains this")
    parser.add_argument("--rounds", type=whole(1), metavar="N", help="of timings (default: 3)")
    options = parser.parse_args(argv)
    check_whole(parser, options, "quick")
    from mjx_revolve.numerics.runtime import prepare_process

    prepare_process()
    import mujoco

    mujoco.set_mju_user_warning(lambda _: None)  # long steps blow up: that is a result
    sizes = QUICK if options.quick else Sizes()
    if options.rounds:
        sizes = replace(sizes, rounds=options.rounds)
    every = [case for case in CASES if case.robot == "spider"] if options.quick else CASES
    cases = [case for case in every if not options.only or options.only in case.name]
    if not cases:
        names = "; ".join(case.name for case in every)
        raise InputError("--only", f"part of one of: {names}", repr(options.only))
    if options.quick:
        cases = [replace(case, mjx=False) for case in cases[:2]]
    # Short episodes replace no whole ones.
    own = "precision_quick" if options.quick else "precision"
    place = RESULTS if options.results else make_folder(options.out, own)
    read_rows("precision", "rows", place)  # refuses those of another machine before anything runs
    for case in cases:
        began = time.monotonic()
        found = run_case(case, sizes)
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
        save(found, place)  # after each case: nothing measured is lost
    return 0


def save(rows: list[dict[str, Any]], folder: Path) -> None:
    """Adds a case to the results in a folder, and draws all of them."""
    known: dict[str, list[dict[str, Any]]] = {}
    for row in read_rows("precision", "rows", folder):
        known.setdefault(row["case"], []).append(row)
    known[rows[0]["case"]] = [row | {"date": today()} for row in rows]
    rows = [row for case in CASES for row in known.get(case.name, [])]
    picture = ROOT / "docs" / "precision.png" if folder == RESULTS else folder / "precision.png"
    draw(rows, picture)
    write_results("precision", {"percent": _PERCENT, "rows": rows}, (0, _KEY), folder)


if __name__ == "__main__":
    sys.exit(run_command(main))
