"""A fit as least squares: recordings cut into windows, what is simulated of them, what is left.

Multiple shooting (Bock 1983): each window begins where smoothing found the core, plus corrections
that are free, so that neither drift nor chaos outlives a window.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Annotated, Any, NamedTuple

import numpy as np
from annotated_types import Ge, Gt, Le, Lt
from scipy.spatial.transform import Rotation

from mjx_revolve.engine.plant import body_geometry
from mjx_revolve.engine.robot import Robot
from mjx_revolve.engine.variants import Variants, course_targets, make_variants
from mjx_revolve.fitting.parameters import (
    LOCAL_SPREAD,
    RECORDING,
    Parameter,
    read_free,
    split_free,
    with_values,
)
from mjx_revolve.fitting.poses import (
    MarkPoints,
    check_marks,
    fit_rigid,
    gap,
    joined_marks,
    rest_height,
    smooth,
)
from mjx_revolve.fitting.recording import RobotRecording, TimeSeries
from mjx_revolve.fitting.simulation import ROOT, Drive, simulate_windows
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.schema import Integer, Number, checked
from mjx_revolve.numerics.spatial import continuous_quaternions

# Records lie no further apart [s]: interpolation is then good to a millimetre and a tenth of a
# degree.
_RECORD = 0.01
# Steps of the differences by which derivatives are found, and of the free numbers the widest and
# the finest ones. A servo reaches its limit at one step of time or at the next one, so that motions
# jump a little as numbers grow: over a ten-thousandth such a jump may pass for a gradient. Free
# numbers are changed both ways: far from the solution by some hundredths, or a fifth of what is not
# known of them, and near it by what they are uncertain by, as over more than that the motion of a
# robot that tumbles is not linear, and its mean gradient is another one. Choices.
_STEP, _FREE_STEP, _FREE_SHARE, _FINEST = 1e-3, 0.02, 0.2, 1e-4
# Of a clock, two of the usual steps: over less, held commands would make jumps of it [s].
_CLOCK_STEP = 0.01
# The search begins with windows that are so many times shorter: a robot that tumbles for seconds
# leads a search that begins far from its numbers astray. A choice.
_PARTS = 4
# An attitude that is farther from what marks say is one of another frame [rad]. A choice.
_OTHER_HEADING = 0.5
# In place of states of a simulation that diverged.
_DIVERGED = 1e6
START = 12
"""Corrections of a start: position, rotation (body), velocity, angular velocity (body)."""
# Standard deviations of where a window begins: more than smoothing can be wrong by, [m, rad, m/s,
# rad/s]; and of what is not recorded at all, which is left at rest: seen from above, heave, roll
# and pitch would else explain what they do not cause. Choices.
_SEEN = np.repeat([0.03, 0.15, 0.15, 0.6], 3)
_UNSEEN = np.repeat([1e-3, 5e-3, 2e-3, 1e-2], 3)
# Standard deviations of sensors until residuals say better: [m], [rad], [m], [rad], [rad/s],
# [m/s²], [m], and of the logarithm of speeds.
NOISE = {"position": 0.005, "attitude": 0.02, "marks": 0.005, "angles": 0.02, "gyro": 0.02,
         "accelerometer": 0.2, "depth": 0.01, "speed": 0.1}  # fmt: skip


@checked
class FitSettings:
    """How a fit goes about it.

    Attributes:
        window: length of a window [s]; those in which the motion is far from linear across what
            is not known are cut.
        held_out: share of the recordings, or of each one's end where there are fewer than four,
            that nothing is fitted to; each one's end, too, where a recording has no attitude, as
            nothing says which way it heads.
        iterations: at most.
        duration: of a planned motion [s].
        motions: how many are planned.
        rate: of frames in a planned recording [Hz].
    """

    window: Annotated[Number, Gt(0)] = 4.0
    held_out: Annotated[Number, Ge(0), Lt(1)] = 0.25
    iterations: Annotated[Integer, Ge(1), Le(200)] = 30
    duration: Annotated[Number, Gt(0)] = 8.0
    motions: Annotated[Integer, Ge(1), Le(20)] = 4
    rate: Annotated[Number, Gt(0)] = 30.0


LOCAL_UNITS = {"current": "m/s", "clock": "s"}
"""Of what each recording has of its own."""


_NOWHERE = np.zeros((0, 3))


class Channel(NamedTuple):
    """Measurements of one kind in one recording.

    Attributes:
        kind: of `NOISE`.
        recording: its number.
        time: `[n]` [s].
        fitted: `[n]` whether they count.
        seen: `[n, d]` what was measured, where there is a place of it in the world.
        residual: `[V, n, 13 + hinges]` states at the times (of "accelerometer" with rates beside)
            → `[V, n, d]` simulated minus measured, NaN where nothing was.
    """

    kind: str
    recording: int
    time: np.ndarray
    fitted: np.ndarray
    seen: np.ndarray
    residual: Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Point:
    """A point of the search: offsets from the priors' medians.

    Attributes:
        free: `[P]`.
        local: `[R, L]` what each recording has of its own.
        starts: `[K, 12, R]` corrections of the windows' beginnings.
    """

    free: np.ndarray
    local: np.ndarray
    starts: np.ndarray


@dataclass(frozen=True, eq=False)
class FitProblem:
    """A robot, what is free of it, and recordings.

    Attributes:
        robot: with the numbers that it has now.
        parameters: P free numbers.
        local: L names of what each recording has of its own.
        recordings: R of them.
        settings: of the fit.
        begin: `[R]` times at which they begin [s].
        end: `[R]` and end.
        fitted_until: `[R]` up to where they are fitted; nothing of those held out.
        piece: length of a piece of a window [s]; K pieces.
        drive: what is given of them.
        roots: `[K, 13, R]` where windows begin, by smoothing.
        start_spread: `[K, 12, R]` of the corrections' priors.
        channels: the measurements.
        variants: of the robot, one for each free number.
        free_heading: `[R]` whether nothing says which way the robot heads at first.
        commands: by recording and by how late its clock is.
        short: `[K, R]` which pieces begin anew where windows are short.
    """

    robot: Robot
    parameters: tuple[Parameter, ...]
    local: tuple[str, ...]
    recordings: tuple[RobotRecording, ...]
    settings: FitSettings
    begin: np.ndarray
    end: np.ndarray
    fitted_until: np.ndarray
    piece: float
    every: int
    drive: Drive
    roots: np.ndarray
    start_spread: np.ndarray
    channels: tuple[Channel, ...]
    variants: Variants
    free_heading: np.ndarray
    commands: tuple[Callable[[float], np.ndarray], ...]
    short: np.ndarray

    def in_pieces(self) -> FitProblem:
        """The same with short windows."""
        return replace(self, drive=replace(self.drive, resets=self.short))

    @property
    def window(self) -> float:
        """Length of a window [s]."""
        return _PARTS * self.piece

    @property
    def lanes(self) -> int:
        """Variants of each recording: as it is, and those of its derivatives."""
        return 1 + 2 * len(self.parameters) + len(self.local) + START

    def origin(self) -> Point:
        """The priors' medians."""
        windows, _, count = self.roots.shape
        shapes = (len(self.parameters),), (count, len(self.local)), (windows, START, count)
        return Point(*map(np.zeros, shapes))

    @property
    def local_spread(self) -> np.ndarray:
        """`[L]` standard deviations of the priors of what each recording has of its own."""
        return np.array([LOCAL_SPREAD[name.partition("_")[0]] for name in self.local])

    def _simulate(self, robots: Sequence[Robot], shifts: Sequence[Point]) -> np.ndarray:
        """`[V, R, K, records, 13 + hinges]` of points, one for each robot."""
        roots = np.stack([_moved(self.roots, p.starts) for p in shifts], 2)
        current = np.zeros((3, len(shifts), len(self.recordings)))
        current += np.array(self.robot.world.current)[:, None, None]
        for k, name in enumerate(self.local):
            if name.startswith("current"):
                axis = "xyz".index(name[-1])
                current[axis] += np.stack([p.local[:, k] for p in shifts])
        drive = self.drive
        if "clock" in self.local:
            k = self.local.index("clock")
            base = shifts[0].local[:, k]
            pair = [[f(t + s) for f, t in zip(self.commands, base, strict=True)]
                    for s in (0.0, _CLOCK_STEP)]  # fmt: skip
            # [2, R, K, N, nu] to [K, N, nu, 2, R]
            ctrl = np.moveaxis(np.array(pair), (0, 1), (3, 4))
            drive = replace(drive, ctrl=ctrl)
        return simulate_windows(self.variants, robots, drive, roots, current, self.every)

    def simulate(self, points: Sequence[Point], unchanged: bool = False) -> np.ndarray:
        """`[points, R, K, records, 13 + hinges]`; commands at the first one's clock.

        `unchanged`: of the robot as it was, whatever the points' numbers of it.
        """
        robots = [
            self.robot if unchanged else with_values(self.robot, self.parameters, p.free)
            for p in points
        ]
        padded = [*points] + [points[0]] * (self.lanes - len(points))
        robots += [robots[0]] * (self.lanes - len(points))
        still = replace(self, drive=replace(self.drive, later=np.zeros(self.lanes, bool)))
        return still._simulate(robots, padded)[: len(points)]

    def linearize(
        self, point: Point, steps: np.ndarray | None = None
    ) -> tuple[list[np.ndarray], list[np.ndarray], np.ndarray]:
        """Residuals and their derivatives.

        Args:
            point: where.
            steps: `[P]` of the differences, within bounds; None: the widest ones.

        Returns:
            For each channel `[n, d]` residuals, `[n, d, P + L + 12]` derivatives, and the track
            `[R, K, records, 13 + hinges]`.
        """
        count, own = len(self.parameters), len(self.local)
        widest = np.minimum(_FREE_STEP, [_FREE_SHARE * p.spread for p in self.parameters])
        steps = widest if steps is None else np.clip(steps, _FINEST, widest)
        frees = [point.free, *(point.free + np.diag(steps)), *(point.free - np.diag(steps))]
        points = [replace(point, free=free) for free in frees]
        robots = [with_values(self.robot, self.parameters, free) for free in frees]
        for k in range(own):
            clock = self.local[k] == "clock"  # its commands are the drive's later ones
            step = 0.0 if clock else _STEP
            points.append(replace(point, local=point.local + step * np.eye(own)[k]))
        for k in range(START):
            shift = _STEP * np.eye(START)[k][None, :, None] * self.drive.resets[:, None]
            points.append(replace(point, starts=point.starts + shift))
        robots += [robots[0]] * (own + START)
        singly = np.array([*(_CLOCK_STEP if n == "clock" else _STEP for n in self.local),
                           *[_STEP] * START])  # fmt: skip
        tracks = self._simulate(robots, points)
        values, slopes = [], []
        for left in self.residuals(tracks):
            values.append(left[0])
            known = np.where(np.abs(left) < _DIVERGED / 10, left, np.nan)
            up, down, rest = np.split(known[1:], [count, 2 * count])
            both = np.moveaxis(up - down, 0, -1) / (2 * steps)
            one = np.moveaxis(rest - known[0], 0, -1) / singly
            slopes.append(np.concatenate([both, one], -1))
        return values, slopes, tracks[0]

    def residuals(self, tracks: np.ndarray) -> list[np.ndarray]:
        """`[V, n, d]` of each channel, from `simulate`'s tracks; huge where those diverged."""
        found = []
        for channel in self.channels:
            r = channel.recording
            states = self.states(tracks[:, r], r, channel.time)
            broken = ~np.isfinite(states).all(-1, keepdims=True)
            found.append(channel.residual(np.where(broken, _DIVERGED, states)))
        return found

    def states(self, track: np.ndarray, recording: int, time: np.ndarray) -> np.ndarray:
        """`[V, n, 13 + hinges]` states at times, from `[V, K, records, ...]`."""
        windows, count = track.shape[1:3]
        passed = (time - self.begin[recording]) / self.piece
        # A frame where a window ends and the next begins is of the one that has run.
        k = np.clip(np.ceil(passed - 1e-9).astype(int) - 1, 0, windows - 1)
        place = np.clip((passed - k) * (count - 1), 0, count - 1)
        i = np.minimum(place.astype(int), count - 2)
        f = (place - i)[:, None]
        a, b = track[:, k, i], track[:, k, i + 1]
        found = a + f * (b - a)
        h, way = self.piece / (count - 1), (b - a)[..., :3]
        early, late = (h * x[..., 7:10] - way for x in (a, b))
        found[..., :3] += f * (1 - f) * ((1 - f) * early - f * late)
        found[..., 3:7] /= np.linalg.norm(found[..., 3:7], axis=-1, keepdims=True)
        # Acceleration, for accelerometers, behind the state.
        push = (b - a)[..., 7:10] / h
        return np.concatenate([found, push], -1)

    def window_of(self, recording: int, time: np.ndarray) -> np.ndarray:
        """`[n]` the windows in which the simulations that times belong to began."""
        passed = (time - self.begin[recording]) / self.piece
        k = np.clip(np.ceil(passed - 1e-9).astype(int) - 1, 0, len(self.roots) - 1)
        begun = np.where(self.drive.resets[:, recording], np.arange(len(self.roots)), 0)
        return np.maximum.accumulate(begun)[k]


def _moved(roots: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """`[K, 13, R]` states of the core with `[K, 12, R]` corrections."""
    found = roots.copy()
    found[:, :3] += shift[:, :3]
    found[:, 7:10] += shift[:, 6:9]
    found[:, 10:] += shift[:, 9:]
    quats = np.moveaxis(roots[:, 3:7], 1, -1).reshape(-1, 4)
    turns = np.moveaxis(shift[:, 3:6], 1, -1).reshape(-1, 3)
    turned = Rotation.from_quat(quats, scalar_first=True) * Rotation.from_rotvec(turns)
    wide = turned.as_quat(scalar_first=True).reshape(len(roots), -1, 4)
    found[:, 3:7] = np.moveaxis(wide, -1, 1)
    return found


# --- making one -----------------------------------------------------------------------------------


def make_problem(
    robot: Robot, recordings: Sequence[RobotRecording], free: Sequence[str], settings: FitSettings
) -> FitProblem:
    """Recordings of a robot as a least-squares problem.

    Args:
        robot: that swam.
        recordings: of it.
        free: names of what is free.
        settings: of the fit.

    Raises:
        InputError: a recording or a name does not suit the robot; the message says which.
    """
    own, common = split_free(free)
    parameters = read_free(own, robot)
    local = tuple(f"{n}_{x}" if x else n for n in common for x in RECORDING[n])
    if not parameters:
        raise InputError("--free", "at least one number of the robot", "none")
    hinges = [robot.morphology.modules[k].name for k in robot.morphology.hinges]
    jets = robot.morphology.thruster_names
    servos_free = any(p.name.startswith("servo") for p in parameters)
    prescribed = _prescribed(recordings, hinges, servos_free)
    views = [_View(robot, r, hinges) for r in recordings]
    for view in views:
        view.check_frames(settings.window)
    begin = np.array([v.begin for v in views])
    end = np.array([v.end for v in views])
    held = _held_out(len(recordings), settings.held_out)
    if any(v.quat is None and np.isfinite(v.position).any() for v in views):
        held[:] = False  # nothing says which way one that is held out heads
    share = 0.0 if held.any() else settings.held_out
    # A mean speed is one number, at the end.
    tracks = np.array(["mean_speed" not in r.signals for r in recordings])
    until = np.where(held, -np.inf, end - share * tracks * (end - begin))
    usual = np.where(held, end, until) - begin
    dt = robot.world.timestep
    window = float(min(settings.window, usual.max()))
    every = max(1, int(_RECORD / dt + 1e-9))
    steps = max(1, math.ceil(window / _PARTS / dt / every - 1e-9)) * every
    piece = steps * dt
    windows = max(1, math.ceil((end - begin).max() / piece - 1e-6))
    resets = np.zeros((windows, len(recordings)), bool)
    short, blind = resets.copy(), resets.copy()
    for r, view in enumerate(views):
        # Without attitude, nothing says how to begin again.
        whole = held[r] or view.quat is None or not np.isfinite(view.position).any()
        many = 1 if whole else max(1, int(usual[r] / piece / _PARTS + 0.25))
        resets[: many * _PARTS : _PARTS, r] = True
        short[: 1 if whole else max(1, int(usual[r] / piece + 0.25)), r] = True
        at = begin[r] + piece * np.arange(windows)
        unknown = np.full(windows, not np.isfinite(view.position).any())
        if view.quat is not None:  # nor in a gap of it
            known = [np.isfinite(x) for x in (view.quat[:, 0], *view.position.T[:2])]
            lost = np.any([gap(view.time[one], at) for one in known if one.any()], 0)
            lost[0] = False
            resets[lost, r] = short[lost, r] = False
            unknown |= lost
        # Nothing is known of what swims on after a gap in measured hinges, until it begins anew.
        fine = begin[r] + dt * np.arange(windows * steps)
        for name in (f"angle.{hinge}" for hinge in prescribed):
            missing = gap(view.recording.signals[name].time, fine) & (fine <= end[r])
            blind[:, r] |= missing.reshape(windows, steps).any(1)
        unknown |= (view.quat is None) | (at >= until[r])
        for k in range(1, windows):
            if blind[k - 1, r] and not blind[k, r]:
                blind[k, r] = unknown[k]
                resets[k, r] = short[k, r] = not unknown[k]
    at = begin + piece * np.arange(windows)[:, None]
    starts = [view.starts(t) for view, t in zip(views, at.T, strict=True)]
    roots, spread = (np.stack([s[k] for s in starts], -1) for k in range(2))
    count = windows * steps
    commands = tuple(
        _commands(r, b, dt, count, hinges, jets, prescribed, windows)
        for r, b in zip(recordings, begin, strict=True)
    )
    if "clock" in local and all(np.array_equal(f(0.0), f(0.05)) for f in commands):
        raise InputError("--free clock", "commands that may come late", "none that change")
    ctrl = np.stack([f(0.0) for f in commands], -1)
    ctrl = np.stack([ctrl, ctrl], -2)
    later = np.zeros(1 + 2 * len(parameters) + len(local) + START, bool)
    if "clock" in local:
        later[1 + 2 * len(parameters) + local.index("clock")] = True
    angles, speeds = (
        np.stack([v.hinges_at(v.begin, prescribed, dt)[k] for v in views], -1) for k in range(2)
    )
    drive = Drive(resets, angles, speeds, ctrl, later, begin)
    channels = [
        _without(c, recordings[r].name, blind[:, r], begin[r], piece)
        for r, v in enumerate(views)
        for c in v.channels(r, until[r], servos_free)
    ]
    variants = _variants(robot, tuple(own), tuple(h in prescribed for h in hinges))
    return FitProblem(
        robot, tuple(parameters), local, tuple(recordings), settings, begin, end, until, piece,
        every, drive, roots, spread, tuple(channels), variants,
        np.array([v.quat is None for v in views]), commands, short,
    )  # fmt: skip


def _without(channel: Channel, name: str, blind: np.ndarray, begin: float, piece: float) -> Channel:
    """A channel of a recording without what was measured in windows `[K]` that are blind."""
    window = np.ceil((channel.time - begin) / piece - 1e-9).astype(int) - 1
    none = blind[np.clip(window, 0, len(blind) - 1)]
    if not none.any():
        return channel
    if none[1:].all() and channel.kind in ("position", "marks", "speed"):
        expected = "measured angles where the robot is seen, or its attitude where they begin"
        raise InputError(name, expected, "a gap in them, and nothing to fit")
    seen = np.where(none[:, None], np.nan, channel.seen) if len(channel.seen) else channel.seen
    residual = lambda s: np.where(none[:, None], np.nan, channel.residual(s))  # noqa: E731
    return channel._replace(seen=seen, residual=residual)


@lru_cache(maxsize=8)
def _variants(robot: Robot, names: tuple[str, ...], prescribed: tuple[bool, ...]) -> Variants:
    """Variants of a robot with free parameters; cached, so that nothing compiles twice."""
    parameters = read_free(names, robot)
    build = partial(with_values, robot, parameters)
    usual, near = build(np.zeros(len(names))), [build(0.1 * x) for x in np.eye(len(names))]
    far = []
    for sign in (-1, 1):
        # Some numbers of the step, such as bounds, change only from a threshold on.
        ends = np.array([p.bound(sign * (np.inf if p.positive else 10 * p.spread))
                         for p in parameters])  # fmt: skip
        for offsets in (ends, *np.diag(ends)):
            with contextlib.suppress(InputError):  # no such robot
                far.append(build(offsets))
    variants = make_variants([usual, robot, *near, *far], prescribed)
    numbers = variants.stack([usual, *near])
    for k, name in enumerate(names, 1):
        if all(np.array_equal(x[..., k], x[..., 0]) for x in numbers):
            raise InputError(
                f"--free {name}: expected a number that this robot in its water depends on; found "
                "one that changes nothing"
            )
    return variants


def _held_out(count: int, share: float) -> np.ndarray:
    """`[R]` whole recordings that are held out, evenly spread; none where there are few."""
    if count < 4:
        return np.zeros(count, bool)
    done = np.floor(share * np.arange(count + 1) + 1e-9)
    return np.diff(done) > 0


def _prescribed(
    recordings: Sequence[RobotRecording], hinges: Sequence[str], servos_free: bool
) -> set[str]:
    """Hinges that move as measured."""
    if servos_free:
        for r in recordings:
            given = r.signals.keys()
            lacking = [h for h in hinges if f"angle.{h}" in given and f"command.{h}" not in given]
            if lacking:
                raise InputError(
                    r.name, "the servos' commands (command.MODULE), as they are free",
                    f"none of {', '.join(lacking)}",
                )  # fmt: skip
        return set()
    found = [{h for h in hinges if f"angle.{h}" in r.signals} for r in recordings]
    for r, some in zip(recordings, found, strict=True):
        if some != found[0]:
            raise InputError(
                f"{r.name}: expected angles of the same hinges as {recordings[0].name} "
                f"({', '.join(sorted(found[0])) or 'none'}); found "
                f"{', '.join(sorted(some)) or 'none'}"
            )
    return found[0]


def _commands(
    recording: RobotRecording, begin: float, dt: float, count: int, hinges: Sequence[str],
    jets: Sequence[str], prescribed: set[str], windows: int,
) -> Callable[[float], np.ndarray]:  # fmt: skip
    """Commands by how late the recording's clock is [s]: `[K, N, nu]`, the mean over each step."""
    edges = begin + dt * np.arange(count + 1)
    columns: list[Callable[[float], np.ndarray]] = []
    for name in hinges:
        if name in prescribed:
            signal = recording.signals[f"angle.{name}"]
            course = _course(signal, begin + dt * np.arange(-1, count + 1))
            columns.append(_constant(course_targets(course, dt)))
        else:
            columns.append(_held(recording, f"command.{name}", edges, dt))
    columns += [_held(recording, f"command.{name}", edges, dt, True) for name in jets]

    def commands(late: float) -> np.ndarray:
        if not columns:
            return np.zeros((windows, count // windows, 0))
        return np.stack([f(late) for f in columns], -1).reshape(windows, -1, len(columns))

    return commands


def _constant(values: np.ndarray) -> Callable[[float], np.ndarray]:
    return lambda late: values


def _course(signal: Any, at: np.ndarray) -> np.ndarray:
    """A measured angle, smoothed, at other times [rad]."""
    if len(signal.time) < 3 or np.ptp(signal.value) < 1e-9:
        return np.interp(at, signal.time, signal.value)
    return smooth(signal.time, signal.value[:, None], at)[0][:, 0]


def _held(
    recording: RobotRecording, name: str, edges: np.ndarray, dt: float, jet: bool = False
) -> Callable[[float], np.ndarray]:
    """A command that holds until the next one; before the first, 0 or a hinge's first."""
    signal = recording.signals.get(name)
    if signal is None:
        return lambda late: np.zeros(len(edges) - 1)
    time, value = signal
    before = 0.0 if jet else value[0]
    area = np.concatenate([[0.0], np.cumsum(np.diff(time) * value[:-1])])

    def mean(late: float) -> np.ndarray:
        t = edges + late
        inside = np.interp(t, time, area) + value[-1] * np.maximum(t - time[-1], 0)
        inside += before * np.minimum(t - time[0], 0)
        return np.diff(inside) / dt

    return mean


_SENT = ("command.", "angle.")
_TURNS = ("yaw", "pitch", "roll")


def _between(signals: Mapping[str, TimeSeries]) -> tuple[str, ...]:
    """What is taken at the frames' times, from rows before the first one, too."""
    return _TURNS[1:] if "x" in signals else (*_TURNS, "qw", "qx", "qy", "qz")


def _from_first_frame(recording: RobotRecording) -> RobotRecording:
    """Without what sensors say before the first frame, when nothing says where the robot is."""
    signals = recording.signals
    frames = [signals["x"].time[0]] if "x" in signals else [
        s.time[0] for n, s in signals.items() if n.startswith("mark.")
    ]  # fmt: skip
    if not frames or "mean_speed" in signals:
        return recording
    found, earlier = {}, (*_SENT, *_between(signals))
    for name, (time, value) in signals.items():
        kept = time >= (time[0] if name.startswith(earlier) else min(frames))
        if kept.any():
            found[name] = TimeSeries(time[kept], value[kept])
    return replace(recording, signals=found)


def _height_as_depth(recording: RobotRecording, surface: float) -> RobotRecording:
    """The core's height beside marks is its depth: no pose of the core is fitted there."""
    signals = dict(recording.signals)
    if "x" in signals or "z" not in signals or not recording.marks:
        return recording
    time, height = signals.pop("z")
    return replace(recording, signals={"depth": TimeSeries(time, surface - height)} | signals)


def _interpolate_pose(time: np.ndarray, pose: np.ndarray, at: np.ndarray) -> np.ndarray:
    """`[T, 7]` poses of `[n, 7]`, of which the quaternion alone is known, NaN in its gaps."""
    found = np.full((len(at), 7), np.nan)
    known = np.isfinite(pose[:, 3:]).all(1)
    if known.sum() > 1:
        turn = continuous_quaternions(pose[known, 3:])
        found[:, 3:] = np.stack([np.interp(at, time[known], x) for x in turn.T], -1)
        found[gap(time[known], at), 3:] = np.nan
    return found


class _View:
    """A recording as poses of a robot's core."""

    def __init__(self, robot: Robot, recording: RobotRecording, hinges: Sequence[str]) -> None:
        """Finds the core's poses."""
        recording = _height_as_depth(recording, robot.world.surface_height)
        recording = _from_first_frame(recording)
        self.robot, self.recording, self.hinges = robot, recording, hinges
        signals = recording.signals
        self.names = list(recording.marks)
        self.points = MarkPoints(robot, list(recording.marks.values()))
        wanted = [f"mark.{n}.{x}" for n in self.names for x in "xyz"]
        self.mark_time, seen = recording.table(wanted)
        self.seen = seen.reshape(len(self.mark_time), len(self.names), 3)
        own = ["yaw"] if "x" in signals and "qw" not in signals else []  # for its times
        self.time, pose = recording.table(["x", "y", "z", "qw", "qx", "qy", "qz", *own])
        pose = pose[:, :7]
        if self.names and "x" not in signals:  # an attitude beside marks is taken at their times
            self.time, pose = self.mark_time, _interpolate_pose(self.time, pose, self.mark_time)
        self.position, quat = pose[:, :3], pose[:, 3:]
        self.planar = "z" not in signals
        self.quat: np.ndarray | None = quat if "qw" in signals else None
        self.level = False
        if self.quat is None and "yaw" in signals:
            turns = [
                np.interp(self.time, signals[n].time, np.unwrap(signals[n].value))
                if n in signals
                else 0 * self.time
                for n in ("yaw", "pitch", "roll")
            ]
            self.quat = Rotation.from_euler("ZYX", np.stack(turns, -1)).as_quat(scalar_first=True)
            read = signals["yaw"].time
            none = ~np.isin(self.time, read) if "x" in signals else gap(read, self.time)
            for name in ("pitch", "roll"):
                if name in signals:  # between its rows, but not in a gap nor beyond its ends
                    none |= gap(signals[name].time, self.time)
            self.quat[none] = np.nan
            self.level = "roll" not in signals
        if self.quat is not None and not np.isfinite(self.quat).all(1).any():
            self.quat, self.level = None, False
        self.attitude = None if self.quat is None else (self.quat, self.level)
        if self.names:
            self._fit_marks()
        if self.quat is not None and not np.isfinite(self.quat).all(1).any():
            self.quat = None
        other = () if "mean_speed" in signals else (*_SENT, *_between(signals))
        kept = [s.time for n, s in signals.items() if not n.startswith(other)]
        self.begin = min(float(t[0]) for t in kept)
        self.end = max(float(t[-1]) for t in kept)

    def check_frames(self, window: float) -> None:
        """Refuses a recording of which a window has no two frames."""
        time = self.time[np.isfinite(self.position).any(1)]
        usual = float(np.median(np.diff(time))) if len(time) > 2 else 0.0
        if 2 * usual > window:
            raise InputError(
                f"{self.recording.name}: expected frames less than {window / 2:.3g} s apart, half "
                f"a window; found {usual:.3g} s: milliseconds? (--map time=COLUMN*0.001; or longer "
                f"windows, --set window={4 * usual:.3g})"
            )

    def _fit_marks(self) -> None:
        """Poses from marks, where the core's own are not recorded."""
        self.planar = self.planar and not np.isfinite(self.seen[..., 2]).any()
        dims = 2 if self.planar else 3
        if "x" in self.recording.signals:
            return
        angles = np.stack([self._angle(h, self.mark_time) for h in self.hinges], -1) if (
            self.hinges) else np.zeros((len(self.mark_time), 0))  # fmt: skip
        model = self.points.on_core(angles)
        length = float(body_geometry(self.robot).length)
        seen = joined_marks(self.mark_time, self.seen, dims)
        check_marks(model, seen, self.planar, self.names, self.mark_time, length)
        if len(self.names) >= dims:
            self.position, turned, _ = fit_rigid(model, seen, self.planar)
            turned[np.isnan(self.position[:, 0])] = np.nan
            if self.quat is not None:
                self._check_heading(turned, self.quat)
            if self.quat is None or self.level or not self.planar:
                self.quat, self.level = turned, self.planar
            else:  # from above, the attitude alone says roll and pitch
                self.quat = np.where(np.isfinite(self.quat), self.quat, turned)
        else:
            self.position = self.seen[:, 0].copy()
            if self.quat is not None:  # else nothing says on which side of the core it is
                known = np.isfinite(self.quat).all(1)
                turn = Rotation.from_quat(self.quat[known], scalar_first=True)
                self.position[known] -= turn.apply(model[known, 0])
                self.position[~known] = np.nan
        if self.planar:
            self.position[:, 2] = np.nan

    def _check_heading(self, turned: np.ndarray, quat: np.ndarray) -> None:
        """Refuses `[n, 4]` attitudes that head elsewhere than the marks."""
        both = np.isfinite(turned).all(1) & np.isfinite(quat).all(1)
        off = np.abs(_turn_error(turned[None, both], quat[both], True))
        if both.any() and (half := float(np.median(off))) > _OTHER_HEADING:
            raise InputError(
                f"{self.recording.name}: attitude", "as the marks turn, anticlockwise from above",
                f"{half:.2g} rad off (--map yaw=COLUMN*-1?)",
            )  # fmt: skip

    def _angle(self, hinge: str, at: np.ndarray) -> np.ndarray:
        if (signal := self.recording.signals.get(f"angle.{hinge}")) is not None:
            return np.interp(at, *signal)
        if (signal := self.recording.signals.get(f"command.{hinge}")) is not None:
            held = np.searchsorted(signal.time, at, "right") - 1
            return signal.value[np.maximum(held, 0)]
        return np.zeros(len(at))

    def hinges_at(
        self, at: float, prescribed: set[str], dt: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """`[hinges]` angles and speeds [rad, rad/s]; what is commanded begins at rest."""
        angles, speeds = np.zeros(len(self.hinges)), np.zeros(len(self.hinges))
        for k, hinge in enumerate(self.hinges):
            if hinge in prescribed:
                signal = self.recording.signals[f"angle.{hinge}"]
                before, now = _course(signal, at + dt * np.array([-1.0, 0.0]))
                angles[k], speeds[k] = now, (now - before) / dt
            else:
                angles[k] = self._angle(hinge, np.array([at]))[0]
        return angles, speeds

    def starts(self, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """`[K, 13]` states of the core at times, and `[K, 12]` how uncertain they are."""
        found = np.zeros((len(at), ROOT))
        found[:, 2], found[:, 3] = rest_height(self.robot), 1.0
        spread = np.tile(_UNSEEN, (len(at), 1))
        axes = [k for k in range(3) if len(self.time) and np.isfinite(self.position[:, k]).any()]
        for k in axes:
            value, rate = smooth(self.time, self.position[:, k : k + 1], at)
            found[:, k], found[:, 7 + k] = value[:, 0], rate[:, 0]
            spread[:, [k, 6 + k]] = _SEEN[[k, 6 + k]]
        if (depth := self.recording.signals.get("depth")) is not None and 2 not in axes:
            value, rate = smooth(depth.time, depth.value[:, None], at)
            found[:, 2], found[:, 9] = self.robot.world.surface_height - value[:, 0], -rate[:, 0]
            spread[:, [2, 8]] = _SEEN[[2, 8]]
        if self.quat is not None:
            known = np.isfinite(self.quat).all(1)
            q = self.quat[known] / np.linalg.norm(self.quat[known], axis=1, keepdims=True)
            value, rate = smooth(self.time[known], continuous_quaternions(q), at)
            value /= np.linalg.norm(value, axis=1, keepdims=True)
            found[:, 3:7] = value
            w, v, dw, dv = value[:, :1], value[:, 1:], rate[:, :1], rate[:, 1:]
            found[:, 10:] = 2 * (w * dv - dw * v - np.cross(v, dv))
            turns = [5, 11] if self.level else [3, 4, 5, 9, 10, 11]
            spread[:, turns] = _SEEN[turns]
        elif axes:
            spread[:, 5] = 1.0
        return found, spread

    def channels(self, r: int, until: float, servos_free: bool) -> list[Channel]:
        """The measurements of the recording."""
        signals, found = self.recording.signals, []

        def add(
            kind: str, time: np.ndarray, residual: Callable[[np.ndarray], np.ndarray],
            seen: np.ndarray = _NOWHERE,
        ) -> None:  # fmt: skip
            found.append(Channel(kind, r, time, time <= until + 1e-9, seen, residual))

        if "x" in signals:
            position = self.position
            add("position", self.time, lambda s: s[..., :3] - position, position)
        elif self.names:
            hinges = len(self.hinges)
            seen, points = self.seen, self.points

            def off(s: np.ndarray) -> np.ndarray:
                qpos = np.concatenate([s[..., :7], s[..., ROOT : ROOT + hinges]], -1)
                place = points.at(qpos.reshape(-1, qpos.shape[-1]))
                left = place.reshape(*s.shape[:2], -1, 3) - seen
                return left.reshape(*s.shape[:2], -1)

            add("marks", self.mark_time, off, seen.reshape(len(seen), -1))
        if self.attitude is not None:
            quat, level = self.attitude
            add("attitude", self.time, lambda s: _turn_error(s[..., 3:7], quat, level))
        if servos_free:
            time, values = self.recording.table([f"angle.{h}" for h in self.hinges])
            time, values = time[time >= self.begin], values[time >= self.begin]
            if len(time):
                add("angles", time, lambda s: s[..., ROOT : ROOT + len(self.hinges)] - values)
        if (depth := signals.get("depth")) is not None:
            top = self.robot.world.surface_height
            add("depth", depth.time, lambda s: top - s[..., 2:3] - depth.value[:, None])
        gravity = np.array([0.0, 0.0, self.robot.world.gravity])
        for kind, name in (("gyro", "gyro"), ("accelerometer", "accel")):
            time, sensed = self.recording.table([f"{name}.{x}" for x in "xyz"])
            if not len(time):
                continue

            def read(s: np.ndarray, kind: str = kind, sensed: np.ndarray = sensed) -> np.ndarray:
                if kind == "gyro":
                    return s[..., 10:13] - sensed
                turn = Rotation.from_quat(s[..., 3:7].reshape(-1, 4), scalar_first=True)
                push = (s[..., -3:] + gravity).reshape(-1, 3)
                return turn.inv().apply(push).reshape(*s.shape[:2], 3) - sensed

            add(kind, time, read)
        if (speed := signals.get("mean_speed")) is not None:
            time = speed.time[[0, -1]]
            mean = max(float(np.mean(speed.value)), 1e-6)

            def slow(s: np.ndarray) -> np.ndarray:
                way = np.linalg.norm(s[:, 1, :2] - s[:, 0, :2], axis=-1) / (time[1] - time[0])
                left = np.full((len(s), 2, 1), np.nan)
                left[:, 1, 0] = np.log(np.maximum(way, 1e-9) / mean)
                return left

            add("speed", time, slow)
        return found


def _turn_error(quat: np.ndarray, seen: np.ndarray, level: bool) -> np.ndarray:
    """`[V, n, 3]` rotation θ from seen to simulated, 2 sin(θ/2), or `[V, n, 1]` about z [rad]."""
    w, v, turned = seen[:, :1], -seen[:, 1:], quat[..., 1:]
    real = w[:, 0] * quat[..., 0] - np.sum(v * turned, -1)
    imaginary = w * turned + quat[..., :1] * v + np.cross(v, turned)
    if level:
        yaw = 2 * np.arctan2(imaginary[..., 2], real)
        return ((yaw + np.pi) % (2 * np.pi) - np.pi)[..., None]
    return 2 * imaginary * np.where(real < 0, -1, 1)[..., None]
