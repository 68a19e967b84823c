"""What recordings determine, in words; and which motions would determine the rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from mjx_revolve.engine.plant import body_geometry
from mjx_revolve.engine.robot import Robot
from mjx_revolve.fitting.estimate import (
    Model,
    free_information,
    linearize,
    normal_equations,
    prior_matrix,
)
from mjx_revolve.fitting.parameters import Parameter
from mjx_revolve.fitting.poses import rest_height
from mjx_revolve.fitting.problem import NOISE, FitProblem, FitSettings, make_problem
from mjx_revolve.fitting.recording import RobotRecording, TimeSeries
from mjx_revolve.inputs.errors import InputError

# A number is found where the data leave less than this share of what was not known of it, and a
# direction is known where they say so much more than the prior. A choice.
SHARE = 1 / 3
_KNOWN = SHARE**-2 - 1
# Numbers that have this share of a direction are named. A choice.
_NAMED = 0.3
# Least rate of a planned motion's commands, whatever the frames' [1/s]. A choice.
_SENT = 30.0


class Unknown(NamedTuple):
    """A direction in which the data say next to nothing.

    Attributes:
        names: of the numbers that move along it.
        words: what is known of them, in a sentence.
        direction: `[P]` in units of the priors.
    """

    names: tuple[str, ...]
    words: str
    direction: np.ndarray


def find_unknown(parameters: Sequence[Parameter], information: np.ndarray) -> list[Unknown]:
    """The directions that data do not determine, the least known first.

    Args:
        parameters: P free numbers.
        information: `[P, P]` of the data alone.
    """
    spread = np.array([p.spread for p in parameters])
    strength, directions = np.linalg.eigh(spread[:, None] * information * spread)
    found = []
    for k in np.flatnonzero(strength < _KNOWN):
        v = directions[:, k]
        rows = np.flatnonzero(np.abs(v) > _NAMED * np.abs(v).max()).tolist()
        names = tuple(parameters[i].name for i in rows)
        positive = all(parameters[i].positive for i in rows)
        if len(rows) == 1:
            words = f"{names[0]} is not known from this"
        elif len(rows) == 2 and positive:
            # Along it both grow, and the motion stays: their ratio is what it shows.
            what = "ratio" if v[rows[0]] * v[rows[1]] > 0 else "product"
            words = f"only the {what} of {names[0]} and {names[1]} is known"
        elif positive and np.all(v[rows] * v[rows[0]] > 0):
            words = f"{_list(names)} are known only up to a common factor"
        else:
            words = f"{_list(names)} cannot be distinguished"
        found.append(Unknown(names, words, v))
    return found


def _list(names: Sequence[str]) -> str:
    return f"{', '.join(names[:-1])} and {names[-1]}"


def is_found(parameter: Parameter, width: float) -> bool:
    """Whether a number is found: its interval, of that width, is far narrower than before."""
    return width < SHARE * 2 * 1.96 * parameter.spread


# --- motions --------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class PlannedMotion:
    """Something to have a robot do.

    Attributes:
        words: what, for a person at a pool.
        recording: without measurements but where the core is at first, and commands.
        velocity: `[6]` of the core at first [m/s, rad/s].
        turn: `[3]` by which it is turned at first, a rotation vector [rad].
    """

    words: str
    recording: RobotRecording
    velocity: np.ndarray
    turn: np.ndarray


def list_motions(robot: Robot, settings: FitSettings) -> list[PlannedMotion]:
    """A catalogue: coast-downs, releases, steps of thrusters, sines of hinges.

    Args:
        robot: that is to do them.
        settings: their length and the frames' rate.
    """
    length = float(body_geometry(robot).length)
    rates = settings.rate, max(settings.rate, _SENT)
    time, sent = (np.arange(0.0, settings.duration + 1e-9, 1 / rate) for rate in rates)
    modules = robot.morphology.modules
    hinges = [modules[k].name for k in robot.morphology.hinges]
    parts = [modules[k].kind.parts[i].thruster for k, i in robot.morphology.thrusters]
    named = zip(robot.morphology.thruster_names, parts, strict=True)
    jets = {name: jet for name, jet in named if jet is not None}
    still = {n: TimeSeries(time, 0 * time) for n in ("x", "y", "yaw", "roll", "pitch")}
    still["z"] = TimeSeries(time, 0 * time + rest_height(robot))
    found: list[PlannedMotion] = []

    def add(words: str, commands: dict[str, np.ndarray], velocity: Sequence[float] = (0,) * 6,
            turn: Sequence[float] = (0, 0, 0)) -> None:  # fmt: skip
        signals = still | {f"command.{n}": TimeSeries(sent, x) for n, x in commands.items()}
        recording = RobotRecording(f"motion {len(found) + 1}", signals)
        first = np.array(velocity, float), np.array(turn, float)
        found.append(PlannedMotion(words, recording, *first))

    for axis, way in enumerate(("along x", "along y", "along z")):
        push = np.eye(6)[axis] * length
        add(f"coast-down: push it {way} to {length:.2g} m/s and let go", {}, push)
    add("coast-down: spin it about z to 90°/s and let go", {}, np.eye(6)[5] * np.pi / 2)
    add("release: tilt it by 40° about x and let go", {}, turn=(0.7, 0, 0))
    add("release: tilt it by 40° about y and let go", {}, turn=(0, 0.7, 0))
    on = (sent < settings.duration / 2).astype(float)
    if jets:
        for share in (0.5, 1.0):
            words = f"step: all thrusters at {100 * share:.0f} % of full ahead for half of the time"
            add(words, {n: share * jet.range[1] * on for n, jet in jets.items()})
        for n, jet in jets.items():
            add(f"step: {n} at 70 % for half of the time, alone", {n: 0.7 * jet.range[1] * on})
        beat = np.sign(np.sin(2 * np.pi * sent / 2.0))
        add("square wave: all thrusters, 1 s ahead and 1 s astern, at 70 %",
            {n: 0.7 * jet.range[1] * beat for n, jet in jets.items()})  # fmt: skip
    sine = lambda hertz, late=0.0: np.sin(2 * np.pi * (hertz * sent - late))  # noqa: E731
    for n in hinges:
        add(f"sine: {n}, 0.6 rad at 1 Hz, the others held", {n: 0.6 * sine(1.0)})
    if len(hinges) > 1:
        for hertz in (0.5, 1.0, 2.0):
            wave = {n: 0.5 * sine(hertz, k / len(hinges)) for k, n in enumerate(hinges)}
            add(f"wave: all hinges, 0.5 rad at {hertz:g} Hz, each a little later", wave)
    return found


def motion_problem(
    robot: Robot, motions: Sequence[PlannedMotion], free: Sequence[str], settings: FitSettings
) -> FitProblem:
    """Motions as recordings without measurements, for the information that they would give."""
    whole = replace(settings, held_out=0.0, window=settings.duration)
    problem = make_problem(robot, [m.recording for m in motions], free, whole)
    for r, motion in enumerate(motions):
        half = np.linalg.norm(motion.turn) / 2
        axis = motion.turn / max(2 * half, 1e-9)
        problem.roots[:, 3:7, r] = [np.cos(half), *(np.sin(half) * axis)]
        problem.roots[:, 7:, r] = motion.velocity
    return problem


def information_of(problem: FitProblem) -> np.ndarray:
    """`[R, P, P]` what each recording of a problem would contribute by itself, with usual noise."""
    model = linearize(problem, problem.origin())
    if not np.isfinite(model.track).all():
        raise InputError("plan", "motions that can be simulated", "some that diverge")
    found = []
    for r in range(len(problem.recordings)):
        kept = [c._replace(fitted=c.fitted & (c.recording == r)) for c in problem.channels]
        # What is simulated is what would be seen.
        zero = Model([0 * x for x in model.values], model.slopes, model.track)
        one = replace(problem, channels=tuple(kept))
        found.append(free_information(one, normal_equations(one, zero, problem.origin(), NOISE)))
    return np.array(found)


@dataclass(frozen=True)
class MotionPlan:
    """A programme of motions, the most informative first.

    Attributes:
        motions: in order.
        spreads: `[motions, P]` standard deviations expected after each of them.
        parameters: P free numbers.
        unknown: what stays unknown after all.
    """

    motions: tuple[PlannedMotion, ...]
    spreads: np.ndarray
    parameters: tuple[Parameter, ...]
    unknown: tuple[Unknown, ...]


def plan_motions(
    robot: Robot,
    free: Sequence[str],
    settings: FitSettings,
    known: np.ndarray | None = None,
    count: int | None = None,
) -> MotionPlan:
    """A short programme of motions that determines the free numbers: D-optimal, one by one.

    Args:
        robot: with the numbers that it has now.
        free: names of what is free.
        settings: length and number of motions.
        known: `[P, P]` information that there is already.
        count: how many motions; by default the settings'.

    Raises:
        InputError: a name is wrong.
    """
    motions = list_motions(robot, settings)
    problem = motion_problem(robot, motions, free, settings)
    each = information_of(problem)
    parameters = problem.parameters
    total = np.zeros((len(parameters),) * 2) if known is None else known.copy()
    prior = prior_matrix(problem)
    chosen: list[PlannedMotion] = []
    spreads = []
    wanted = settings.motions if count is None else count
    for _ in range(min(wanted, len(motions))):
        # Each once: unforeseen effects show in different motions rather than in one.
        left = [k for k in range(len(motions)) if motions[k] not in chosen]
        best = max(left, key=lambda k: float(np.linalg.slogdet(total + each[k] + prior)[1]))
        total = total + each[best]
        chosen.append(motions[best])
        spreads.append(np.sqrt(np.diag(np.linalg.inv(total + prior))))
    unknown = tuple(find_unknown(parameters, total))
    return MotionPlan(tuple(chosen), np.array(spreads), parameters, unknown)
