"""What a fit has found: values with intervals, what is unknown, and predictions."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjx_revolve.engine.robot import Robot
from mjx_revolve.fitting.estimate import FitState, Model, advance, begin, linearize
from mjx_revolve.fitting.identify import Unknown, find_unknown, is_found, plan_motions
from mjx_revolve.fitting.intervals import LEVEL, Estimate, estimate
from mjx_revolve.fitting.parameters import entries_of, with_values
from mjx_revolve.fitting.problem import LOCAL_UNITS, FitProblem, FitSettings, make_problem
from mjx_revolve.fitting.recording import RobotRecording, check_recording
from mjx_revolve.inputs.errors import InputError, plain
from mjx_revolve.inputs.yaml_reader import dump_yaml


@dataclass(frozen=True)
class FittedValue:
    """A free number as found.

    Attributes:
        name: of it.
        unit: of it; "" for a factor on what it was.
        value: most probable one.
        low: lower end of the interval.
        high: upper end.
        found: whether the recordings tell it; else it is no more than the prior.
    """

    name: str
    unit: str
    value: float
    low: float
    high: float
    found: bool


@dataclass(frozen=True)
class Prediction:
    """A recording beside what was simulated of it.

    Attributes:
        name: of the recording.
        time: `[n]` [s].
        held: `[n]` whether nothing was fitted to a frame; from the first of them on, what is
            simulated runs on by itself.
        recorded: `[n, 3]` position of the core, or the middle of the marks, NaN where unknown [m];
            of a recording of a mean speed, that [m/s].
        fitted: `[n, 3]` the same, with the coefficients found.
        before: `[n, 3]` with those that the robot had.
        is_speed: whether it is of a mean speed.
    """

    name: str
    time: np.ndarray
    held: np.ndarray
    recorded: np.ndarray
    fitted: np.ndarray
    before: np.ndarray
    is_speed: bool = False

    def error(self, which: np.ndarray, held: bool) -> float:
        """Root mean square distance of `fitted` or `before` from what was recorded [m]."""
        rows = self.held if held else ~self.held
        off = which - self.recorded
        off = off[rows & np.isfinite(off).any(1)]
        return float(np.sqrt(np.nansum(off**2, 1).mean())) if len(off) else float("nan")

    @property
    def way(self) -> float:
        """Length of the recorded way, in steps of a tenth of it [m]."""
        at, axes = np.linspace(self.time[0], self.time[-1], 11), []
        for x in self.recorded.T:
            if (known := np.isfinite(x)).any():
                axes.append(np.interp(at, self.time[known], x[known]))
        return float(np.sqrt(np.square(np.diff(axes, axis=-1)).sum(0)).sum()) if axes else 0.0


@dataclass(frozen=True, eq=False)
class Fit:
    """The end of a fit.

    Attributes:
        problem: that was solved.
        state: where the search ended.
        estimate: of the numbers.
        values: the numbers.
        unknown: what the recordings do not determine.
        local: (recording, name, value, standard deviation) of what each recording has of its own.
        predictions: of all recordings, those held out first.
        advice: the most informative further motion, and the largest of the remaining uncertainties
            before and after it; "" if none was computed.
    """

    problem: FitProblem
    state: FitState
    estimate: Estimate
    values: tuple[FittedValue, ...]
    unknown: tuple[Unknown, ...]
    local: tuple[tuple[str, str, float, float], ...]
    predictions: tuple[Prediction, ...]
    advice: str = ""

    @property
    def robot(self) -> Robot:
        """The robot with the numbers found."""
        return with_values(self.problem.robot, self.problem.parameters, self.state.point.free)

    @property
    def local_words(self) -> list[tuple[str, str, str]]:
        """`local` with its value in words: with half of its 95 % interval, and the unit."""
        return [
            (r, n, f"{x:.3g} ± {1.96 * s:.2g} {LOCAL_UNITS[n.partition('_')[0]]}")
            for r, n, x, s in self.local
        ]

    @property
    def coefficients(self) -> dict[str, dict[str, Any]]:
        """Params by type of module, module or `all`, as `body.coefficients` reads them."""
        problem, free = self.problem, self.state.point.free
        return _plain(entries_of(problem.robot, problem.parameters, free))

    def to_yaml(self) -> str:
        """The file of coefficients that morphologies and configurations name."""
        names = ", ".join(r.name for r in self.problem.recordings)
        lines = [f"# Coefficients of {self.problem.robot.morphology.name}, fitted to {names}."]
        for v in self.values:
            words = f"{v.low:.4g} to {v.high:.4g} ({LEVEL:.0%})" if v.found else "NOT FOUND"
            lines.append(f"# {v.name} {v.value:.4g} {v.unit}: {words}")
        lines += [f"# {u.words}." for u in self.unknown]
        if any(m.params.get("factors") for m in self.problem.robot.morphology.modules):
            lines.append("# On top of the factors that the robot had; robot.yaml has all of them.")
        return "\n".join(map(plain, lines)) + "\n" + dump_yaml({"modules": self.coefficients})

    def to_json(self) -> str:
        """All numbers, for other programs."""
        data = {
            "values": [vars(v) for v in self.values],
            "unknown": [{"names": u.names, "words": u.words} for u in self.unknown],
            "recordings": [
                {"recording": r, "name": n, "value": v, "std": s} for r, n, v, s in self.local
            ],
            "noise": self.estimate.noise,
            "variance_inflation": self.estimate.inflation,
            "covariance_of_offsets": self.estimate.covariance.tolist(),
            "predictions": [
                {
                    "recording": p.name,
                    "held_out": bool(p.held.any()),
                    "error_fitted": p.error(p.fitted, bool(p.held.any())),
                    "error_before": p.error(p.before, bool(p.held.any())),
                    "way": p.way,
                }
                for p in self.predictions
            ],
            "iterations": self.state.iteration,
            "advice": self.advice,
        }
        return json.dumps(data, indent=2) + "\n"


def _plain(value: object) -> Any:
    if isinstance(value, dict):
        return {key: _plain(x) for key, x in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(x) for x in value]
    return float(f"{value:.10g}") if isinstance(value, float) else value


def fit_robot(
    robot: Robot,
    recordings: Sequence[RobotRecording],
    free: Sequence[str],
    settings: FitSettings | None = None,
    seed: int = 0,
    advise: bool = False,
) -> Fit:
    """Fits numbers of a robot to recordings of it.

    Args:
        robot: from `build_robot`.
        recordings: from `load_recording`, or made in code.
        free: names of what is free, as `drag`, `thrust@port`, `current`.
        settings: of the fit.
        seed: of the draws with which the search begins.
        advise: whether the most informative motion is looked for.

    Returns:
        What was found.

    Raises:
        InputError: a recording or a name does not suit the robot.
    """
    if not recordings:
        raise InputError("recordings", "at least one", "none")
    for recording in recordings:
        check_recording(recording, robot)
    problem = make_problem(robot, recordings, free, settings or FitSettings())
    state = begin(problem, seed)
    model = linearize(problem, state.point)
    while not is_done(problem, state):
        state, model = advance(problem, state, model)
    return conclude(problem, state, model, free, advise)


def is_done(problem: FitProblem, state: FitState) -> bool:
    """Whether the search has arrived, or has had all its iterations."""
    return state.finished or state.iteration >= problem.settings.iterations


def conclude(
    problem: FitProblem, state: FitState, model: Model, free: Sequence[str], advise: bool
) -> Fit:
    """What a search that has ended has found."""
    found = estimate(problem, state, model)
    values = []
    for k, parameter in enumerate(problem.parameters):
        value, low, high = map(parameter.value, (found.offsets[k], *found.ends[k]))
        known = is_found(parameter, float(np.ptp(found.ends[k])))
        values.append(FittedValue(parameter.name, parameter.unit, value, low, high, known))
    unknown = tuple(find_unknown(problem.parameters, found.information))
    # What is sought of a current is its difference from the world's.
    current = problem.robot.world.current
    there = {f"current_{axis}": value for axis, value in zip("xyz", current, strict=True)}
    whole = found.local + np.array([there.get(name, 0.0) for name in problem.local])
    local = tuple(
        (recording.name, name, float(whole[r, k]), float(found.local_spread[r, k]))
        for r, recording in enumerate(problem.recordings)
        for k, name in enumerate(problem.local)
        if np.isfinite(problem.fitted_until[r])
    )
    advice = ""
    plan = None
    if advise:
        # A further motion has a current, too; a clock is of commands, which coasts lack.
        sought = [name for name in free if name != "clock"]
        with contextlib.suppress(InputError):  # a motion that diverges: no advice, but the fit
            plan = plan_motions(problem.robot, sought, problem.settings, found.information, 1)
    if plan is not None:
        spread = np.array([p.spread for p in problem.parameters])
        now = np.sqrt(np.diag(found.covariance)) / spread
        worst = int(np.argmax(now))
        after = plan.spreads[0][worst] / spread[worst]
        advice = (
            f"{plan.motions[0].words}: it would leave {after:.2g} of what is not known of "
            f"{problem.parameters[worst].name}, now {now[worst]:.2g}"
        )
    predictions = _predict(problem, state)
    return Fit(problem, state, found, tuple(values), unknown, local, predictions, advice)


def _predict(problem: FitProblem, state: FitState) -> tuple[Prediction, ...]:
    now = [state.point]
    tracks = np.concatenate([problem.simulate(now), problem.simulate(now, unchanged=True)])
    found = []
    for channel, off in zip(problem.channels, problem.residuals(tracks), strict=True):
        if channel.kind not in ("position", "marks", "speed"):
            continue
        recording = problem.recordings[channel.recording]
        if channel.kind == "speed":
            mean = float(np.mean(recording.signals["mean_speed"].value))
            none = np.full_like(off, np.nan)
            both = list(np.concatenate([mean * np.exp(off), none, none], -1))
            seen = np.tile([mean, np.nan, np.nan], (len(channel.time), 1))
        else:
            # The middle of the marks that are seen.
            wide = np.stack([channel.seen + x for x in (0 * off[0], *off)])
            wide = wide.reshape(*wide.shape[:2], -1, 3)
            count = np.isfinite(wide).sum(2)
            seen, *both = np.where(count > 0, np.nansum(wide, 2) / np.maximum(count, 1), np.nan)
        is_speed = channel.kind == "speed"
        there = np.isfinite(seen).any(1) | is_speed  # rows of other sensors may lie between
        time, held = channel.time[there], ~channel.fitted[there]
        row = recording.name, time, held, seen[there], both[0][there], both[1][there], is_speed
        found.append(Prediction(*row))
    return tuple(sorted(found, key=lambda p: not p.held.all()))
