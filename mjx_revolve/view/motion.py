"""What a robot did, analysed once as plain values: pictures, films, pages and reports only draw.

`Motion` is an episode with all that is told of it, each worked out when it is first asked for; the
functions below it take arrays and know no robot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from mjx_revolve.inputs.errors import InputError

if TYPE_CHECKING:
    from mjx_revolve.engine.robot import Robot
    from mjx_revolve.episodes.config import TaskConfig
    from mjx_revolve.episodes.rollout import Trajectory

# Who gets less far than this only drifted to and fro, and has no heading [body lengths].
_STAYED = 0.05
_MOST_POSES = 6
# Neighbouring poses are at least this far apart [body lengths]; two alone may be closer.
_APART, _PAIR = 0.55, 0.35
# A stroke must come back to where it began: correlation with the record one period earlier.
_REPEATS = 0.7
# Where strokes do not repeat, what they do to and fro is averaged over this long [s].
_SECOND = 1.0
# Closer to the start than this share of the way, energy over distance is noise.
_NEAR = 0.1


@dataclass(frozen=True, eq=False)
class Motion:
    """What a robot did in an episode, up to the first row that is not finite; T rows.

    Attributes:
        robot: who.
        trajectory: what it did, as long as it was.
        count: T, its rows that are finite.
        counted_from: when its task began to count, see `counted_time` [s].
        phases: `[T, nhinge]` of a CPG's oscillators, hinges in the order of the servos [rad]: 0
            when the joint's target passes the middle of its range upwards, π/2 at its largest;
            None for other controllers.
    """

    robot: Robot
    trajectory: Trajectory
    count: int
    counted_from: float = 0.0
    phases: np.ndarray | None = None

    def _column(self, name: str) -> np.ndarray:
        return np.asarray(getattr(self.trajectory, name), float)[: self.count]

    @cached_property
    def time(self) -> np.ndarray:
        """`[T]` [s]."""
        return self._column("time")

    @cached_property
    def qpos(self) -> np.ndarray:
        """`[T, nq]` as in a trajectory."""
        return self._column("qpos")

    @property
    def length(self) -> float:
        """Of the body [m]."""
        return self.robot.morphology.length

    @property
    def weight(self) -> float:
        """Of the robot in air [N]."""
        return self.robot.morphology.mass * max(self.robot.world.gravity, 1e-9)

    # --- the way ---

    @property
    def path(self) -> np.ndarray:
        """`[T, 3]` of the core, world frame [m]."""
        return self.qpos[:, :3]

    @cached_property
    def steady(self) -> np.ndarray:
        """`[T, 3]` the path without the to and fro of the strokes [m]."""
        return smooth_path(self.time, self.path, self.period)

    @cached_property
    def along(self) -> np.ndarray:
        """`[2]` unit vector of the way in the horizontal plane; x where the robot stayed."""
        net = self.path[-1, :2] - self.path[0, :2]
        size = float(np.linalg.norm(net))
        return net / size if size > _STAYED * self.length else np.array([1.0, 0.0])

    @property
    def depth(self) -> np.ndarray:
        """`[T]` of the core below the still surface [m]."""
        return float(self.robot.world.surface_height) - self.path[:, 2]

    @cached_property
    def first(self) -> int:
        """The row from which distance, speed and cost are counted."""
        row = int(np.searchsorted(self.time, self.counted_from - 1e-6))
        return max(min(row, self.count - 2), 0)

    @property
    def seconds(self) -> float:
        """How long it is counted [s]."""
        return float(self.time[-1] - self.time[self.first])

    @property
    def distance(self) -> float:
        """Net distance while it is counted [m]."""
        return float(np.linalg.norm(self.path[-1] - self.path[self.first]))

    @property
    def speed(self) -> float:
        """Net speed while it is counted [m/s]; 0 in a single row."""
        return self.distance / self.seconds if self.seconds > 0.0 else 0.0

    # --- strokes ---

    @cached_property
    def period(self) -> float | None:
        """Of the strokes [s]; None where the hinges do not repeat themselves."""
        return stroke_period(self.time, self.qpos[:, 7:])

    @cached_property
    def angles(self) -> np.ndarray:
        """`[T, nhinge]` of the joints in the order of the servos [rad]."""
        model = self.robot.mj_model
        joints = [int(model.actuator_trnid[i, 0]) for i in self.robot.servos]
        return self.qpos[:, [int(model.jnt_qposadr[joint]) for joint in joints]]

    @cached_property
    def targets(self) -> np.ndarray:
        """`[T, nhinge]` that the controller sets the joints [rad]."""
        return self._column("ctrl")[:, list(self.robot.servos)]

    @property
    def turns(self) -> np.ndarray:
        """`[nhinge]` mean frequency of each oscillator; negative where it turns backwards [Hz]."""
        turned = np.unwrap(np.asarray(self.phases), axis=0)
        span = max(float(self.time[-1] - self.time[0]), 1e-9)
        return (turned[-1] - turned[0]) / (2 * np.pi * span)

    @cached_property
    def commands(self) -> np.ndarray:
        """`[T, nthruster]` of the thrusters [-]."""
        return self._column("ctrl")[:, list(self.robot.thrusters)]

    @cached_property
    def lagged(self) -> np.ndarray:
        """`[T, nthruster]` what is left of the commands behind the thrusters' lag [-]."""
        return self._column("command")

    # --- energy ---

    @cached_property
    def power(self) -> np.ndarray:
        """`[T]` at the servos, summed without sign, and what ideal propellers need [W]."""
        return self._column("power")

    @cached_property
    def energy(self) -> np.ndarray:
        """`[T]` so far [J]."""
        step = float(np.median(np.diff(self.time))) if self.count > 1 else float(self.time[0])
        return np.cumsum(self.power) * step

    @cached_property
    def cost(self) -> np.ndarray:
        """`[T]` cost of transport so far: energy over weight times net distance, both counted [-].

        NaN before that, and while the robot is closer than a tenth of its way to where it began.
        """
        away = np.linalg.norm(self.path - self.path[self.first], axis=1)
        far = away > _NEAR * max(float(away[self.first :].max()), 1e-3)
        counted = np.arange(self.count) > self.first
        return np.where(far & counted, self._cost(self.energy, away), np.nan)

    @property
    def final_cost(self) -> float:
        """Cost of transport while it is counted [-]."""
        return float(self._cost(self.energy[-1], self.distance))

    def _cost(self, energy: Any, away: Any) -> Any:
        # A millimetre bounds it where the robot stays, as in `tasks.measure`.
        return (energy - self.energy[self.first]) / (self.weight * np.maximum(away, 1e-3))

    # --- what to draw ---

    @cached_property
    def poses(self) -> list[int]:
        """Rows along the way that can be told apart, see `choose_poses`."""
        return choose_poses(self.time, self.path, self.length)

    def stroke(self, count: int) -> list[int]:
        """Rows at `count` equal times in the last stroke, or in the last second."""
        span = min(self.period or _SECOND, float(self.time[-1] - self.time[0]))
        return nearest_rows(self.time, self.time[-1] - span + span * np.arange(count) / count)


def analyse_motion(
    robot: Robot,
    trajectory: Trajectory,
    counted_from: float = 0.0,
    phases: np.ndarray | None = None,
) -> Motion:
    """Makes a motion of a trajectory.

    Args:
        robot: who swam.
        trajectory: what it did: `time` `[T]` [s], `qpos` `[T, nq]`, and whatever else is asked of
            the motion. Rows after the first that is not finite are left out.
        counted_from: see `Motion`.
        phases: `[T, nhinge]`, see `Motion`.

    Returns:
        The motion.

    Raises:
        InputError: the trajectory is another robot's, or has no finite row.
    """
    qpos = np.asarray(trajectory.qpos)
    expected = [np.size(trajectory.time), robot.mj_model.nq]
    if list(qpos.shape) != expected:
        raise InputError(f"trajectory.qpos: expected {expected} [T, nq]; found {list(qpos.shape)}")
    count = count_finite(qpos)
    if count == 0:
        raise InputError("trajectory.qpos: expected finite numbers in its first row; found none")
    return Motion(
        robot, trajectory, count, counted_from, None if phases is None else phases[:count]
    )


def counted_time(task: TaskConfig, timestep: float) -> float:
    """When a task begins to count.

    Args:
        task: its settling time.
        timestep: of the world [s].

    Returns:
        The time of the first record of the track that it judges [s].
    """
    from mjx_revolve.episodes.scoring import first_counted, sample_rows

    return sample_rows(task, timestep)[0] * timestep * (1 + first_counted(task, timestep))


def count_finite(values: Any) -> int:
    """How many rows `[T, n]` there are before the first that is not finite."""
    finite = np.isfinite(values).all(axis=1)
    return len(finite) if finite.all() else int(finite.argmin())


def rms(values: np.ndarray) -> np.ndarray:
    """Root mean square `[n]` of values `[T, n]`."""
    return np.sqrt(np.mean(values**2, axis=0))


def nearest_rows(time: np.ndarray, moments: np.ndarray) -> list[int]:
    """Rows `[n]` of times `[T]` that are closest to moments `[n]` [s]."""
    return np.abs(time[:, None] - moments).argmin(axis=0).tolist()


def choose_poses(time: np.ndarray, path: np.ndarray, length: float) -> list[int]:
    """Rows of a trajectory at equal times that can be told apart.

    Args:
        time: `[T]` [s].
        path: `[T, 3]` of the core [m].
        length: of the body [m].

    Returns:
        At most six rows from the first to the last; only the last where the robot stayed.
    """
    for count in range(_MOST_POSES, 1, -1):
        rows = nearest_rows(time, np.linspace(time[0], time[-1], count))
        apart = np.linalg.norm(path[rows, None] - path[rows], axis=-1) / length
        apart[np.diag_indices(count)] = np.inf
        if apart.min() >= (_APART if count > 2 else _PAIR):
            return rows
    return [len(time) - 1]


def stroke_period(time: np.ndarray, angles: np.ndarray) -> float | None:
    """Period of the strokes, from the strongest frequency of all hinges together.

    Args:
        time: `[T]` [s], equal steps.
        angles: `[T, nhinge]` [rad].

    Returns:
        The period [s]; None where the hinges do not repeat themselves.
    """
    late = slice(len(time) // 3, None)  # the beginning is no steady stroke
    time, angles = time[late], angles[late]
    count = len(time)
    if count < 16 or angles.shape[1] == 0 or np.ptp(angles, axis=0).max() < 0.02:
        return None
    step = float(time[-1] - time[0]) / (count - 1)
    waves = (angles - angles.mean(axis=0)) * np.hanning(count)[:, None]
    power = (np.abs(np.fft.rfft(waves, 16 * count, axis=0)) ** 2).sum(axis=1)
    power[: 16 * 2] = 0.0  # fewer than two periods in the record are no period
    period = 16 * count * step / int(power.argmax())
    lag = round(period / step)
    if lag < 4:
        return None
    late, early = angles[lag:] - angles.mean(axis=0), angles[:-lag] - angles.mean(axis=0)
    alike = (late * early).sum() / max(math.sqrt((late**2).sum() * (early**2).sum()), 1e-12)
    return period if alike >= _REPEATS else None


def smooth_path(time: np.ndarray, path: np.ndarray, period: float | None) -> np.ndarray:
    """A path without the to and fro of the strokes.

    Args:
        time: `[T]` [s], equal steps.
        path: `[T, 3]` [m].
        period: of the strokes [s]; None: one second.

    Returns:
        `[T, 3]` mean over one stroke around each row, over less towards the path's two ends [m].
    """
    count = len(path)
    step = float(time[-1] - time[0]) / max(count - 1, 1)
    half = round(0.5 * (period or _SECOND) / max(step, 1e-9))
    rows = np.arange(count)
    reach = np.minimum(half, np.minimum(rows, count - 1 - rows))
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(path, axis=0)])
    return (total[rows + reach + 1] - total[rows - reach]) / (2 * reach + 1)[:, None]


def mean_rate(time: np.ndarray, values: np.ndarray, span: float | None = None) -> np.ndarray:
    """How fast something changes over a stroke or a second around each row.

    Args:
        time: `[T]` [s], equal steps.
        values: `[T, ...]`, e.g. a path [m] or the energy so far [J].
        span: over which [s], or all there is; None: one second.

    Returns:
        `[T, ...]` per second. At both ends, as in the last whole span: a part of a stroke would
        show its to and fro.
    """
    last = len(time) - 1
    step = float(time[-1] - time[0]) / max(last, 1)
    whole = min(max(1, round((span or _SECOND) / max(step, 1e-9))), last)
    if whole == 0:
        return np.zeros_like(values)
    begin = np.clip(np.arange(last + 1) - whole // 2, 0, last - whole)
    return (values[begin + whole] - values[begin]) / (whole * step)


def speed_over(time: np.ndarray, path: np.ndarray, span: float | None = None) -> np.ndarray:
    """Speed `[T]` along a path `[T, 3]`, see `mean_rate` [m/s]."""
    return np.linalg.norm(mean_rate(time, path, span), axis=1)


def last_strokes(time: np.ndarray, period: float | None, strokes: float) -> int:
    """The row of times `[T]` [s] from which on so many strokes are left.

    0 without a period [s], and where there are hardly more strokes than that in all.
    """
    if period is None or time[-1] <= 1.5 * strokes * period:
        return 0
    return int(np.searchsorted(time, time[-1] - strokes * period))


def last_swings(time: np.ndarray, commands: np.ndarray, swings: float) -> int:
    """The row of times `[T]` [s] from which on so many swings, up and down, are left.

    Of the liveliest of commands `[T, n]`; 0 where there are at most twice as many in all.
    """
    away = commands - commands.mean(axis=0)
    all_swings = (np.diff(np.sign(away), axis=0) != 0).sum(axis=0).max() / 2
    if all_swings <= 2 * swings:
        return 0
    return int(np.searchsorted(time, time[-1] - (time[-1] - time[0]) * swings / all_swings))
