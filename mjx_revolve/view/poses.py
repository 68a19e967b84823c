"""Poses of robots along an episode, for films, pages and still pictures."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple, cast

import jax
import numpy as np

from mjx_revolve.engine.kinematics import body_poses
from mjx_revolve.engine.robot import Robot
from mjx_revolve.episodes.champion import Episode
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics.spatial import continuous_quaternions, matrix_to_quat
from mjx_revolve.view.motion import count_finite


class Poses(NamedTuple):
    """A robot's poses, world frame.

    Attributes:
        position: `[S, nbody, 3]` of the bodies, the world's own first [m].
        quaternion: `[S, nbody, 4]` w first; neighbours in time have the nearer of both signs.
        parts: `[S, npart, 3]` centres of the parts' boxes [m].
    """

    position: np.ndarray
    quaternion: np.ndarray
    parts: np.ndarray


def pose_robot(robot: Robot, qpos: np.ndarray) -> Poses:
    """Where a robot's bodies and parts are in poses `[S, nq]`."""
    table, rows = robot.fluid, cast(Any, np.asarray(qpos, np.float64))
    position, rotation = map(np.asarray, body_poses(robot, rows))
    parts = np.einsum("spij,pj->spi", rotation[:, table.body], table.position)
    quaternion = continuous_quaternions(matrix_to_quat(rotation))
    return Poses(position, quaternion, position[:, table.body] + parts)


def finite_rows(episode: Episode) -> tuple[Episode, float | None]:
    """An episode up to the first row of its trajectory that is not finite.

    Returns:
        The same with NumPy arrays, and the time from which on it is not finite [s], or None.

    Raises:
        InputError: not even the first row is finite.
    """
    rows = jax.tree.map(np.asarray, episode.trajectory)
    count = count_finite(np.hstack([rows.qpos, rows.qvel]))
    if count == 0:
        place = f"{episode.title}: trajectory.qpos"
        raise InputError(place, "finite numbers in its first row", "none")
    lost = None if count == len(rows.qpos) else float(rows.time[count])
    return _first_rows(replace(episode, trajectory=rows), count), lost


def cut_episode(episode: Episode, seconds: float) -> Episode:
    """An episode's first seconds."""
    time = np.asarray(episode.trajectory.time)
    count = int(np.searchsorted(time, seconds * (1 + 1e-6), side="right"))
    return _first_rows(episode, max(1, count))


def _first_rows(episode: Episode, count: int) -> Episode:
    # Gusts have rows too.
    rows, water = jax.tree.map(
        lambda x: x[:count] if np.ndim(x) else x, (episode.trajectory, episode.water)
    )
    return replace(episode, trajectory=rows, water=water)
