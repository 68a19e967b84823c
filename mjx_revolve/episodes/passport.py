"""A champion's passport: whether what it does would last, and could be built and confirmed.

Evolution is a search for what a score forgot. So a champion is swum again as it was not selected:
for longer, in smaller steps, from other starts, in other water, without its brain. All lanes of
one program swim side by side; only another timestep is another program.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree
from pydantic import Strict

from mjx_revolve.control.controller import Controller, StepOutput
from mjx_revolve.control.readings import SensorReadings
from mjx_revolve.engine.energy import energy_balance
from mjx_revolve.engine.forces import motor_torques
from mjx_revolve.engine.plant import Plant
from mjx_revolve.engine.robot import Robot
from mjx_revolve.engine.self_overlap import self_overlap
from mjx_revolve.engine.variation import Variation
from mjx_revolve.episodes.evaluation import Chunk, as_precise
from mjx_revolve.episodes.fitness import Fitness, fit_body
from mjx_revolve.episodes.scoring import PASSPORT_STREAM, replay_key
from mjx_revolve.episodes.simulate import Trajectory
from mjx_revolve.episodes.starts import Starts, draw_gusts
from mjx_revolve.inputs.errors import reading
from mjx_revolve.inputs.schema import Text, checked, read
from mjx_revolve.inputs.user_code import call_user_function, short_name
from mjx_revolve.inputs.yaml_reader import dump_yaml, load_yaml
from mjx_revolve.numerics.xla import over_chunks
from mjx_revolve.water.bed import bed_height
from mjx_revolve.water.drag import find_drag_law
from mjx_revolve.water.flow import Water, water_of
from mjx_revolve.water.world import World

PASSPORT = "champion/passport.yaml"
"""Its place in a run folder."""

LONG = 120.0
"""How long it swims [s]."""
# After which other time its score is looked at [s].
_MIDDLE = 30.0
# Fresh starts; and how many of them the variants are tried from.
_STARTS, _FEW = 64, 8
# By which coefficients of water and motors differ: what is not known of them, doubled. Drag of
# cubes and plates spreads by 30 % (see `RobustConfig`).
_FACTOR = 1.3
# A joint that turns back by less than this does not: a hobby servo's dead band and its gears' play,
# 1.1°. A joint that is hit at its stop swings by a degree or less; one that is driven to and fro at
# full speed in each step of 5 ms by 1.5° [rad].
_PLAY = 0.02

# The speed of a joint is looked at that it has for all but the fastest hundredth of the time.
_OFTEN = 0.99

# XLA's CPU back end can lock up when two programs run at once in one process.
_RUNNING = threading.Lock()

# What is required. All are choices, with these reasons.
KEPT = 0.8
"""Least share of the score over 30 and 120 s: a robot that turns or rises loses all of it."""
STEP = 0.1
"""Largest change of the score at half and a quarter of the step, as a share of it or of what the
brain adds to it, whichever is more: half of what two measurements of one real robot differ by."""
WORST_TENTH = 0.5
"""Least share of the score, or of what the brain adds to it where it is no rate, of the worst tenth
of fresh starts: no lucky starts."""
VARIED = 0.5
"""Least such share with a coefficient 30 % off: what goes with its square is left half."""
BRAINLESS = 0.1
"""Largest share of the score that a robot with joints at rest has: what only floats or sinks."""
OVERLAP = 3.0
"""Deepest overlap of two modules [mm]: what play and bending of printed parts may take up."""
REVERSALS = 10.0
"""Most reversals of a joint in a second: a hobby servo follows up to some 5 Hz."""
ENERGY = 0.1
"""Largest residual of the energy balance, as a share of the motors' work: as much as a score may
change with the step. It is of first order in the step (a spider: 2.4 % at 5 ms, 1.2 % at 1.25 ms);
what swims by a simulator's mistakes has more."""
TORQUE = 0.7
"""Largest root mean square of a servo's torque, as a share of its effort: that of a sine which just
reaches it; a servo that uses more is at its limit for most of the time."""


_Value = Annotated[float, Strict()]  # any: a share of nothing is NaN


@checked
class Check:
    """A line of a passport.

    Attributes:
        words: what was tried.
        value: what was found.
        unit: of the value; "" for a share.
        least: the least value that passes; None for any.
        most: the largest; None for any.
    """

    words: Text
    value: _Value
    unit: Text = ""
    least: _Value | None = None
    most: _Value | None = None

    @property
    def judged(self) -> bool:
        """Whether there is a limit."""
        return self.least is not None or self.most is not None

    @property
    def passed(self) -> bool:
        """Whether the value is within the limits; without any, all values are."""
        low = self.least is None or self.value >= self.least
        return bool(low and (self.most is None or self.value <= self.most))

    @property
    def limit(self) -> str:
        """The limits in words."""
        found = [] if self.least is None else [f"at least {self.least:g}"]
        found += [] if self.most is None else [f"at most {self.most:g}"]
        return " and ".join(found)


_FIELDS = [field.name for field in fields(Check)]


@dataclass(frozen=True)
class Passport:
    """What a champion was tried for, by name."""

    checks: Mapping[str, Check]

    @property
    def failed(self) -> tuple[str, ...]:
        """Names of what fails."""
        return tuple(name for name, check in self.checks.items() if not check.passed)

    @property
    def mark(self) -> str:
        """What stands beside the champion's number: "" where all is passed."""
        return f"fails its passport: {', '.join(self.failed)}" if self.failed else ""

    @property
    def rows(self) -> list[tuple[str, str, str, str]]:
        """What was tried, the value, the limit and the verdict of each line, in words."""
        return [
            (c.words, f"{c.value:.3g} {c.unit}".rstrip(), c.limit,
             ("passes" if c.passed else "FAILS") if c.judged else "")
            for c in self.checks.values()
        ]  # fmt: skip

    def to_text(self) -> str:
        """The text of `champion/passport.yaml`."""
        checks = {
            name: {k: v for k, v in vars(check).items() if v not in (None, "")}
            | ({"passed": check.passed} if check.judged else {})
            for name, check in self.checks.items()
        }
        return dump_yaml({"passed": not self.failed, "checks": checks})


def load_passport(path: Path) -> Passport:
    """Reads a passport's file.

    Raises:
        InputError: it is missing, or holds something else.
    """
    data = load_yaml(path)
    checks = data.get("checks") if isinstance(data, dict) else None
    with reading(path):
        rows = read(dict[Text, dict[str, Any]], checks, "checks")
        known = {name: {k: row[k] for k in _FIELDS if k in row} for name, row in rows.items()}
        return Passport(read(dict[str, Check], known, "checks"))


# ------------------------------------------------------------------ making one


def make_passport(fitness: Fitness, genes: Any, seed: int) -> Passport:
    """Tries a champion as it was not selected.

    Args:
        fitness: of its body.
        genes: `[num_genes]`.
        seed: of its run.

    Returns:
        The passport; the same bits for the same arguments.

    Raises:
        InputError: a user's own task does not suit other times.
    """
    genes = jnp.asarray(genes, jnp.float32)
    key = jax.random.fold_in(jax.random.key(seed), PASSPORT_STREAM)
    trajectory = fitness.replay(genes, replay_key(seed))
    checks = (
        *_swim(fitness, genes, key),
        *joint_checks(fitness.robot, trajectory, fitness.settings.settle),
        *_energy(fitness, trajectory, fitness.water(replay_key(seed))),
    )
    return Passport(dict(checks))


class _Lanes(NamedTuple):
    """Episodes of one program, `[lanes]` each.

    Attributes:
        start: which of the fresh starts.
        brain: 1 with its brain, 0 with joints at rest.
        variation: factors on coefficients; None where they cannot be varied.
    """

    start: np.ndarray
    brain: np.ndarray
    variation: Variation | None


def _swim(fitness: Fitness, genes: jax.Array, key: jax.Array) -> Iterator[tuple[str, Check]]:
    """Scores under other conditions than those of the selection."""
    usual, unit = fitness.config.task.duration, fitness.task.unit
    varied = fitness.config.engine == "population" and find_drag_law(fitness.world.drag).varied
    tried = _variants() if varied else {}
    few = _Lanes(np.arange(_FEW), np.ones(_FEW, int), None)
    # XLA compiles without Python's lock: the three programs side by side.
    with ThreadPoolExecutor(3) as threads:
        coarse = threads.submit(_scores, fitness, genes, key, _all_lanes(tried), True)
        given = fitness, genes, key, few, False
        fine = {part: threads.submit(_scores, *given, part) for part in (2, 4)}
        scores = coarse.result()
        finer = {part: found.result()[usual].mean() for part, found in fine.items()}
    own = scores[usual][:_STARTS]
    first = own[:_FEW]
    # A slow turn or rise that is foretold from a short swim may be one that ends: variants are
    # compared by what they really swim.
    lasting = scores[usual if fitness.settings.horizon is None else max(scores)]
    trials = lasting[_STARTS:].reshape(-1, _FEW)
    rest = float(trials[-1].mean())
    # A score that is no rate has no zero of its own: what counts is what the brain adds to rest.
    rates = unit.endswith("/s")
    zero, whole = (0.0, "share") if rates else (rest, "share of what the brain adds")

    def share(found: np.ndarray, of: np.ndarray) -> float:
        added = float(of.mean()) - zero
        return (float(found.mean()) - zero) / added if added > 0 else math.nan

    yield "score", Check(f"score from {_STARTS} fresh starts", float(own.mean()), unit)
    yield "score_sd", Check("its standard deviation", float(own.std()), unit)
    worst = np.sort(own)[: _STARTS // 10]
    words = f"{whole} in the worst tenth"
    yield "worst_tenth", Check(words, share(worst, own), least=WORST_TENTH)
    for seconds, found in scores.items():
        if seconds == usual:
            continue
        name, kept = f"kept_{seconds:g}_s", found[:_STARTS]
        if rates:
            yield name, Check(f"share kept over {seconds:g} s", share(kept, own), least=KEPT)
        else:  # it may grow or shrink with time: it is shown and has no limit
            yield name, Check(f"score over {seconds:g} s", float(kept.mean()), unit)
    # A score that is best at zero, as a distance to keep, is compared with what the brain adds.
    scale = max(abs(first.mean()), abs(first.mean() - rest), 1e-9)
    for part, mean in finer.items():
        change = float(abs(mean - first.mean()) / scale)
        yield f"step_over_{part}", Check(f"change at 1/{part} of the step", change, most=STEP)
    for (name, (words, _)), found in zip(tried.items(), trials, strict=False):
        yield name, Check(f"{whole} with {words}", share(found, lasting[:_FEW]), least=VARIED)
    if rates:  # should have no score at all; less is no gain
        still = max(share(trials[-1], lasting[:_FEW]), 0.0)
        yield "brainless", Check("share with joints at rest", still, most=BRAINLESS)
    else:
        yield "brainless", Check("score with joints at rest", rest, unit)


def _variants() -> dict[str, tuple[str, Variation]]:
    """Coefficients off by `_FACTOR`, one at a time, with their names in words."""
    return {
        f"{name}_{word}": (f"{name.replace('_', ' ')} x {factor:.2g}", Variation(**{name: factor}))
        for name in ("drag", "added_mass", "motor")
        for word, factor in (("less", 2 - _FACTOR), ("more", _FACTOR))
    }


def _all_lanes(tried: Mapping[str, tuple[str, Variation]]) -> _Lanes:
    """The fresh starts, then some of them with each variant, then without a brain."""
    start = np.concatenate([np.arange(_STARTS), *[np.arange(_FEW)] * (len(tried) + 1)])
    brain = np.where(np.arange(len(start)) < len(start) - _FEW, 1, 0)
    if not tried:
        return _Lanes(start, brain, None)
    rows = [Variation()] * _STARTS
    rows += [variation for _, variation in tried.values() for _ in range(_FEW)]
    rows += [Variation()] * _FEW
    factors = (np.array(x, np.float32) for x in zip(*rows, strict=True))
    return _Lanes(start, brain, Variation(*factors))


def _with_step(fitness: Fitness, part: int) -> Fitness:
    """The same body in a world of so many steps for one."""
    config = fitness.config
    world = {"name": config.world_name, **config.world_overrides}
    world["timestep"] = fitness.world.timestep / part
    # The robot's own body is trimmed already.
    config = config.model_copy(update={"world": world, "trim": "none"})
    return fit_body(config, fitness.robot.morphology)


def _scores(
    fitness: Fitness, genes: jax.Array, key: jax.Array, lanes: _Lanes, long: bool, part: int = 1
) -> dict[float, np.ndarray]:
    """Scores of lanes after some times.

    Args:
        fitness: of the body.
        genes: `[num_genes]`.
        key: draws the starts.
        lanes: what is tried.
        long: whether it swims longer than the task lasts.
        part: how many steps there are for one of the world's.

    Returns:
        `[lanes]` by time [s]: the task's duration first, then the longer ones.
    """
    coarse, usual = fitness, fitness.config.task.duration
    fitness = fitness if part == 1 else _with_step(fitness, part)
    times = [usual, *(t for t in (_MIDDLE, LONG) if long and t > usual)]

    def spec(seconds: float) -> Fitness:
        changes = {"duration": seconds, "trials": _STARTS, "robust": None}
        if fitness.task.unit.endswith("/s"):
            changes["energy_weight"] = fitness.settings.energy_weight_over(seconds)
        if seconds > usual:  # it is swum, not foretold
            changes["horizon"] = None
        task = fitness.settings.model_copy(update=changes)
        return replace(fitness, config=fitness.config.model_copy(update={"task": task}))

    specs = {seconds: spec(seconds) for seconds in times}
    whole = replace(specs[times[-1]], controller=_silenceable(fitness.controller))

    def run(genes: jax.Array, key: jax.Array) -> PyTree:
        starts = as_precise(fresh_starts(whole, specs[usual], coarse.world, key), genes)
        starts = jax.tree.map(lambda x: x[..., lanes.start], starts)
        starts = starts._replace(variation=jax.tree.map(jnp.asarray, lanes.variation))
        population = jnp.stack([jnp.append(genes, active) for active in (0.0, 1.0)])

        def swim(brain: jax.Array, lane: jax.Array) -> dict[float, jax.Array]:
            chunk = whole.prepare(True, False, (), population, starts, brain, lane)
            track = whole.record_track(chunk)
            return {
                seconds: _score(one, chunk, jax.tree.map(lambda x, n=one.num_records: x[:n], track))
                for seconds, one in specs.items()
            }

        order = jnp.arange(len(lanes.start), dtype=jnp.int32)
        return over_chunks(swim)(jnp.asarray(lanes.brain, jnp.int32), order)

    # Kept, the programs are there for the next champion of this body.
    made_of = jax.tree.map(np.ndarray.tolist, lanes)
    # That of half a step is sooner swum than compiled well.
    program = fitness.keep(run, "passport", made_of, times, fast=part == 2).load(genes, key)
    with _RUNNING:
        return {seconds: np.asarray(x, float) for seconds, x in program(genes, key).items()}


def fresh_starts(whole: Fitness, usual: Fitness, world: World, key: jax.Array) -> Starts:
    """The starts from which a champion is tried: the same for all times and steps.

    Args:
        whole: of the longest time, in steps that may be finer than the world's.
        usual: of the task's duration, within which courses turn.
        world: with the task's own step, for which gusts are drawn.
        key: draws them.
    """
    starts = whole.draw_starts(key)._replace(course=usual.draw_starts(key).course)
    if world.gust is None:
        return starts
    part = round(world.timestep / whole.world.timestep)
    steps = whole.num_timesteps
    path = draw_gusts(world, key, -(-steps // part), whole.settings.trials)
    rest = jnp.arange(part).reshape(-1, 1, 1) / part
    between = path[:-1, None] * (1 - rest) + path[1:, None] * rest
    gusts = jnp.concatenate([between.reshape(-1, *path.shape[1:]), path[-1:]])
    return starts._replace(gusts=gusts[: steps + 1])


def _score(spec: Fitness, chunk: Chunk, track: dict[str, jax.Array]) -> jax.Array:
    """`[lanes]` scores; NaN below the bed, where an engine without contact has led a robot.

    Raises:
        InputError: a user's own task does not suit an episode of this length.
    """
    task, given = spec.settings, (track, chunk.position, chunk.geometry, chunk.rollout.context)
    if task.is_user_code:
        expected = f"{short_name(task.type)} to score {task.duration:g} s, as passports do"
        score = call_user_function(task.type, expected, spec.score, *given).score
    else:
        score = spec.score(*given).score
    if spec.world.bed is None:
        return score
    x, y, z = (track["position"][:, k] for k in range(3))
    return jnp.where(jnp.any(z < bed_height(spec.world.bed, x, y), 0), jnp.nan, score)


def _silenceable(controller: Controller) -> Controller:
    """A controller with one more gene: 0 keeps joints and thrusters at rest, 1 changes nothing."""

    def decode(genes: jax.Array, plant: Plant) -> PyTree:
        return controller.decode(genes[:-1], plant), genes[-1]

    def step(
        parameters: PyTree, state: PyTree, time: jax.Array, readings: SensorReadings
    ) -> StepOutput:
        own, active = parameters
        state, ctrl = controller.step(own, state, time, readings)
        return state, ctrl * active

    return controller._replace(
        num_genes=controller.num_genes + 1,
        decode=decode,
        init=lambda parameters: controller.init(parameters[0]),
        step=step,
    )


def joint_checks(
    robot: Robot, trajectory: Trajectory, settle: float
) -> Iterator[tuple[str, Check]]:
    """The loads of one episode on all joints and on the busiest, and the room between modules.

    Args:
        robot: it.
        trajectory: of the episode, with rows at equal times.
        settle: time at its start that does not count [s].

    Yields:
        Names, and checks.
    """
    if not robot.num_hinges:
        return
    time, step = np.asarray(trajectory.time), robot.world.timestep
    # The last two rows always count, as in `scoring.first_scored_row`.
    rows, step = time >= min(settle, time[-2]), step * round(float(time[1] - time[0]) / step)
    motion = trajectory.qpos, trajectory.qvel, trajectory.ctrl
    qpos, qvel, ctrl = (np.asarray(x)[rows] for x in motion)
    moved, varied = robot.assembly.moved, trajectory.variation
    # To a micrometre: some bodies overlap by 3 mm at rest, by design.
    depth = np.abs(np.round(1000 * self_overlap(robot, qpos).depth, 3))  # rather than -0
    yield "overlap", Check("deepest overlap of modules", float(depth.max()), "mm", most=OVERLAP)
    deeper = float(np.mean(depth > OVERLAP))
    yield "overlap_time", Check(f"share of time with more than {OVERLAP:g} mm", deeper)
    rate = count_reversals(qpos[:, 7:]).max() / (len(qvel) * step)
    yield "reversals", Check("reversals of a joint", float(rate), "1/s", most=REVERSALS)
    torque = motor_torques(robot, qpos, qvel, ctrl, varied) / robot.assembly.effort[moved]
    used = float(np.sqrt(np.mean(torque**2, 0)).max())
    yield "torque", Check("share of a servo's torque used, root mean square", used, most=TORQUE)
    top = robot.assembly.speed[moved] * (1.0 if varied is None else float(varied.motor))
    fastest = np.quantile(np.abs(qvel[:, 6:]) / top, _OFTEN, axis=0).max()
    yield "speed", Check(f"share of a servo's speed used, {_OFTEN:.0%} of the time", float(fastest))


def _energy(
    fitness: Fitness, trajectory: Trajectory, water: Water | None
) -> Iterator[tuple[str, Check]]:
    """Whether what the motors give in one episode, in such water, is found again."""
    if fitness.config.engine != "population":  # the balance is made of its forces
        return
    rows = trajectory.qpos, trajectory.qvel, trajectory.ctrl, trajectory.command
    water = water or water_of(fitness.world)
    balance = energy_balance(fitness.robot, *rows, water, trajectory.variation)
    if balance is None:
        return
    words = "energy unaccounted for, share of the motors' work"
    yield "energy", Check(words, balance.residual, most=ENERGY)


def count_reversals(angle: np.ndarray) -> np.ndarray:
    """How often each joint turns back `[n]`, of angles `[T, n]` [rad], by more than the play."""
    return np.array([_turns(column) for column in angle.T.tolist()], int)


def _turns(angle: list[float]) -> int:
    """Extremes between which an angle swings by more than the play, but for the first."""
    count, way, low, high = 0, 0, angle[0], angle[0]
    for x in angle:
        low, high = min(low, x), max(high, x)
        if way >= 0 and high - x > _PLAY:
            count, way, low = count + (way > 0), -1, x
        elif way <= 0 and x - low > _PLAY:
            count, way, high = count + (way < 0), 1, x
    return count
