"""Robots with their poses over time, for pages and films of an episode or of a colony."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from mjx_revolve.engine.robot import Robot
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics.spatial import continuous_quaternions


@dataclass(frozen=True, eq=False)
class ReplayRobot:
    """A robot of a replay.

    Attributes:
        name: shown beside it.
        robot: its body; robots that share one `Robot` share its meshes, too.
        time: `[T]` of its poses, rising, in the replay's time [s]; poses between are interpolated.
        qpos: `[T, 7 + num_hinges]` its poses, MuJoCo's order, world frame.
        start: when it appears [s]; None: with its first pose.
        end: when it vanishes [s]; None: never.
        info: facts that a page shows while it is followed: words or numbers by name, as
            `{"parents": "3 and 7", "energy": 12.5}`.
    """

    name: str
    robot: Robot
    time: np.ndarray
    qpos: np.ndarray
    start: float | None = None
    end: float | None = None
    info: Mapping[str, str | float] = field(default_factory=dict)

    @property
    def appears(self) -> float:
        """When it appears [s]."""
        return float(self.time[0]) if self.start is None else float(self.start)

    def check(self) -> None:
        """Refuses poses that do not fit the body.

        Raises:
            InputError: times or poses have a wrong shape, are not finite, or do not rise.
        """
        time, qpos = np.asarray(self.time), np.asarray(self.qpos)
        width = 7 + self.robot.num_hinges
        if time.ndim != 1 or len(time) == 0 or qpos.shape != (len(time), width):
            rows = f"[T, {width}], a row for each of at least one time"
            found = f"{[*qpos.shape]} for times {[*time.shape]}"
            raise InputError(f"robot {self.name!r}: qpos", rows, found)
        if not (np.isfinite(time).all() and np.isfinite(qpos).all()):
            raise InputError(f"robot {self.name!r}", "finite times and poses", "other numbers")
        if (np.diff(time) <= 0).any():
            raise InputError(f"robot {self.name!r}: time", "rising times", "others")
        if (np.linalg.norm(qpos[:, 3:7], axis=1) == 0).any():
            raise InputError(f"robot {self.name!r}: qpos", "quaternions", "one of length 0")
        end = self.appears if self.end is None else self.end
        if not -np.inf < self.appears <= end < np.inf:
            found = f"{self.appears:g} to {end:g} s"
            raise InputError(f"robot {self.name!r}", "a finite end after its start", found)


def interpolate_poses(
    rows: np.ndarray, qpos: ArrayLike, time: np.ndarray, leap: float | None = None
) -> np.ndarray:
    """Poses `[F, nq]` at times `[F]` between poses `qpos` `[T, nq]` at times `rows` `[T]`.

    Before the first and after the last of them, that one is held. A robot that is farther than
    `leap` [m] from its pose before was put there, and holds the pose until then; None: never.
    """
    qpos = np.array(qpos, float)
    qpos[:, 3:7] = continuous_quaternions(qpos[:, 3:7])
    found = np.stack([np.interp(time, rows, column) for column in qpos.T], axis=-1)
    if leap is not None:
        far = np.linalg.norm(np.diff(qpos[:, :3], axis=0), axis=1) > leap
        before = np.clip(np.searchsorted(rows, time, side="right") - 1, 0, len(rows) - 1)
        held = np.r_[far, False][before]
        found[held] = qpos[before[held]]
    found[:, 3:7] /= np.linalg.norm(found[:, 3:7], axis=1, keepdims=True)
    return found


@dataclass(frozen=True)
class Mark:
    """A place that replays show: a charger, say, or where robots are born.

    Attributes:
        name: shown beside it.
        place: its middle, world frame [m].
        radius: of the level ring around it [m].
    """

    name: str
    place: tuple[float, float, float]
    radius: float


@dataclass(frozen=True, eq=False)
class Recording:
    """Robots in one world, for a time.

    Attributes:
        title: shown above.
        robots: at least one; those that are born or die have a start or an end.
        start: from when on it is shown [s].
        end: until when [s].
        marks: places to show.
        leap: see `interpolate_poses`.
    """

    title: str
    robots: Sequence[ReplayRobot]
    start: float
    end: float
    marks: Sequence[Mark] = ()
    leap: float | None = None
