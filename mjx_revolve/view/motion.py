"""The motion of a robot, analysed once as plain values: pictures, films and pages only draw it.

`Motion` is an analysed episode; the functions below take arrays alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import jax
import numpy as np
from numpy.typing import ArrayLike

from mjx_revolve.engine.kinematics import mass_centers
from mjx_revolve.episodes.tasks import body_length
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.short_repr import short_repr
from mjx_revolve.view.surroundings import target_at_last, target_name, water_velocity
from mjx_revolve.water.flow import Water

if TYPE_CHECKING:
    from mjx_revolve.engine.robot import Robot
    from mjx_revolve.episodes.config import TaskConfig
    from mjx_revolve.episodes.fitness import Fitness
    from mjx_revolve.episodes.simulate import Trajectory

# A robot that gets less far than this only drifted to and fro, and has no heading [body lengths].
_STAYED = 0.05
_MOST_POSES = 6
# Neighbouring poses are at least this far apart [body lengths]; two alone may be closer.
_POSE_GAP, _PAIR_GAP = 0.55, 0.35
# A stroke must come back to where it began: correlation with the record one period earlier.
_REPEATS = 0.7
# Where strokes do not repeat, what they do to and fro is averaged over this long [s].
_SECOND = 1.0
# Closer to the start than this share of the way, energy over distance is noise.
_MIN_DISTANCE = 0.1


@dataclass(frozen=True, eq=False, repr=False)
class Motion:
    """The motion of a robot in an episode, up to the first row that is not finite; T rows.

    Attributes:
        robot: that moved.
        length: of its body, as the task has it [m].
        time: `[T]` [s].
        qpos: `[T, nq]` as in a trajectory.
        path: `[T, 3]` of the core, world frame [m].
        steady: `[T, 3]` the path without the to and fro of the strokes [m].
        along: `[2]` unit vector of the way in the horizontal plane; x where the robot stayed.
        surface: `[T]` z of the still surface, world frame [m].
        period: of the strokes [s]; None where the hinges do not repeat themselves.
        poses: rows along the way at which poses do not overlap, see `choose_poses`.
        angles: `[T, nhinge]` of the joints in the order of the servos [rad].
        targets: `[T, nhinge]` that the controller sets them [rad].
        commands: `[T, nthruster]` of the thrusters [-].
        lagged: `[T, nthruster]` what is left of the commands behind the thrusters' lag [-].
        power: `[T]` at the servos, summed without sign, and what ideal propellers need [W].
        energy: `[T]` so far [J].
        counted_from: when the task began to count, see `counted_time` [s].
        first: the row from which the following are counted.
        seconds: how long [s].
        distance: net [m].
        speed: net, over ground [m/s]; 0 in a single row.
        current: `[T, 3]` velocity of the water where the core is, waves apart, world frame [m/s].
        water_speed: net, through that water [m/s].
        target: `[3]` of the task, world frame [m], or None.
        target_name: what it is called.
        cost: of transport, energy over weight times net distance [-].
        costs: `[T]` the same so far; NaN before it counts, and while the robot is closer than a
            tenth of its way to where it began.
    """

    robot: Robot
    length: float
    time: np.ndarray
    qpos: np.ndarray
    path: np.ndarray
    steady: np.ndarray
    along: np.ndarray
    surface: np.ndarray
    period: float | None
    poses: list[int]
    angles: np.ndarray
    targets: np.ndarray
    commands: np.ndarray
    lagged: np.ndarray
    power: np.ndarray
    energy: np.ndarray
    counted_from: float
    first: int
    seconds: float
    distance: float
    speed: float
    current: np.ndarray
    water_speed: float
    target: np.ndarray | None
    target_name: str
    cost: float
    costs: np.ndarray

    __repr__ = short_repr


def analyse_motion(
    robot: Robot,
    trajectory: Trajectory,
    counted_from: float = 0.0,
    water: Water | None = None,
    target: np.ndarray | None = None,
    task: TaskConfig | None = None,
) -> Motion:
    """Makes a motion of a trajectory.

    Args:
        robot: of the trajectory.
        trajectory: rows after the first that is not finite are left out.
        counted_from: see `Motion`.
        water: surface and current, each a number or `[T]`; None: the world's.
        target: see `Motion`.
        task: gives the point of distances and speeds, and the body length; None: the core's centre,
            and the length at rest.

    Returns:
        The motion.

    Raises:
        InputError: the trajectory is another robot's, or has no finite row.
    """
    shape, expected = np.shape(trajectory.qpos), (np.size(trajectory.time), robot.mj_model.nq)
    if shape != expected:
        raise InputError("trajectory.qpos", f"{[*expected]} [T, nq]", [*shape])
    count = count_finite(trajectory.qpos)
    if count == 0:
        raise InputError("trajectory.qpos", "finite numbers in its first row", "none")
    columns = (trajectory.time, trajectory.qpos, trajectory.ctrl, trajectory.power)
    time, qpos, ctrl, power = (np.asarray(column, float)[:count] for column in columns)
    length = body_length(robot, task)
    weight = robot.morphology.mass * max(robot.world.gravity, 1e-9)
    own = trajectory.surface_height
    surface = np.full(count, robot.world.surface_height) if own is None else np.array(own)[:count]
    path, period = qpos[:, :3], stroke_period(time, qpos[:, 7:])
    net = path[-1, :2] - path[0, :2]
    moved = float(np.linalg.norm(net)) > _STAYED * length
    joints = robot.mj_model.actuator_trnid[list(robot.servos), 0]
    lagged = np.zeros((count, 0)) if trajectory.command is None else trajectory.command
    energy = np.cumsum(power) * (float(np.median(np.diff(time))) if count > 1 else 0.0)

    first = max(min(int(np.searchsorted(time, counted_from - 1e-6)), count - 2), 0)
    scored = path if task is None or task.point == "core" else mass_centers(robot, qpos)
    away = np.linalg.norm(scored - scored[first], axis=1)
    seconds, distance = float(time[-1] - time[first]), float(away[-1])
    if water is not None:
        water = jax.tree.map(lambda x: np.asarray(x)[:count] if np.ndim(x) else x, water)
    current = water_velocity(robot.world, water, path)
    drift = current[first:-1].sum(axis=0) * (seconds / max(count - 1 - first, 1))
    swum = float(np.linalg.norm(scored[-1] - scored[first] - drift))
    # A millimetre bounds the cost where the robot stays, as in `measures.measure`.
    costs = (energy - energy[first]) / (weight * np.maximum(away, 1e-3))
    far = away > _MIN_DISTANCE * max(float(away[first:].max()), 1e-3)
    return Motion(
        robot=robot,
        length=length,
        time=time,
        qpos=qpos,
        path=path,
        steady=smooth_path(time, path, period),
        along=net / np.linalg.norm(net) if moved else np.array([1.0, 0.0]),
        surface=surface,
        period=period,
        poses=choose_poses(time, path, length),
        angles=qpos[:, robot.mj_model.jnt_qposadr[joints]],
        targets=ctrl[:, list(robot.servos)],
        commands=ctrl[:, list(robot.thrusters)],
        lagged=np.asarray(lagged, float)[:count],
        power=power,
        energy=energy,
        counted_from=counted_from,
        first=first,
        seconds=seconds,
        distance=distance,
        speed=distance / seconds if seconds > 0.0 else 0.0,
        current=current,
        water_speed=swum / seconds if seconds > 0.0 else 0.0,
        target=target,
        target_name=target_name(task),
        cost=float(costs[-1]),
        costs=np.where(far & (np.arange(count) > first), costs, np.nan),
    )


def replay_motion(fitness: Fitness, trajectory: Trajectory, key: jax.Array) -> Motion:
    """The motion of an episode that a fitness has replayed, from the starts of a key."""
    robot, task = fitness.robot, fitness.config.task
    begin, target = counted_time(task, robot.world.timestep), target_at_last(task, trajectory)
    return analyse_motion(robot, trajectory, begin, fitness.water(key), target, task)


def counted_time(task: TaskConfig, timestep: float) -> float:
    """When a task begins to count.

    Args:
        task: its settling time.
        timestep: of the world [s].

    Returns:
        The time of the first record of the track that it judges [s].
    """
    from mjx_revolve.episodes.scoring import first_scored_row, sample_rows

    return sample_rows(task, timestep)[0] * timestep * (1 + first_scored_row(task, timestep))


def count_finite(values: ArrayLike) -> int:
    """How many rows `[T, n]` there are before the first that is not finite."""
    finite = np.isfinite(np.asarray(values)).all(axis=1)
    return len(finite) if finite.all() else int(finite.argmin())


def rms(values: np.ndarray) -> np.ndarray:
    """Root mean square `[n]` of values `[T, n]`."""
    return np.sqrt(np.mean(values**2, axis=0))


def nearest_rows(time: np.ndarray, moments: np.ndarray) -> list[int]:
    """Rows `[n]` of times `[T]` that are closest to moments `[n]` [s]."""
    return np.abs(time[:, None] - moments).argmin(axis=0).tolist()


def choose_poses(time: np.ndarray, path: np.ndarray, length: float) -> list[int]:
    """Rows of a trajectory at equal times at which poses do not overlap.

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
        if apart.min() >= (_POSE_GAP if count > 2 else _PAIR_GAP):
            return rows
    return [len(time) - 1]


def stroke_rows(time: np.ndarray, period: float | None, count: int) -> list[int]:
    """Rows of times `[T]` [s] at `count` equal times in the last stroke, or in the last second."""
    span = min(period or _SECOND, float(time[-1] - time[0]))
    return nearest_rows(time, time[-1] - span + span * np.arange(count) / count)


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
