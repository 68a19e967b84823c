"""The course of an episode in numbers, for those who draw it moving: films and pages."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import mujoco
import numpy as np

from mjx_revolve.engine.robot import Robot
from mjx_revolve.episodes.champion import Episode
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.view.motion import count_finite
from mjx_revolve.view.surroundings import water_velocity
from mjx_revolve.water.bed import Bed, bed_height
from mjx_revolve.water.flow import Water

SECTORS = 96  # points on each ring around the way on which the bed is drawn


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


def finite_part(episode: Episode) -> tuple[Episode, float | None]:
    """An episode up to the first row of its trajectory that is not finite.

    Args:
        episode: what happened.

    Returns:
        The same with NumPy arrays, and the time from which on it is not finite [s], or None.

    Raises:
        InputError: not even the first row is finite.
    """
    rows = jax.tree.map(np.asarray, episode.trajectory)
    count = count_finite(np.hstack([rows.qpos, rows.qvel]))
    if count == len(rows.qpos):
        return replace(episode, trajectory=rows), None
    if count == 0:
        raise InputError(
            f"{episode.title}: trajectory.qpos: expected finite numbers in its first row; found "
            "none"
        )
    # Gusts have rows too.
    trajectory, water = jax.tree.map(
        lambda x: x[:count] if np.ndim(x) else x, (rows, episode.water)
    )
    return replace(episode, trajectory=trajectory, water=water), float(rows.time[count])


def cut_episode(episode: Episode, seconds: float) -> Episode:
    """An episode's first seconds."""
    time = np.asarray(episode.trajectory.time)
    count = max(1, int(np.searchsorted(time, seconds * (1 + 1e-6), side="right")))
    rows, water = jax.tree.map(
        lambda x: x[:count] if np.ndim(x) else x, (episode.trajectory, episode.water)
    )
    return replace(episode, trajectory=rows, water=water)


def pose_robot(robot: Robot, qpos: np.ndarray) -> Poses:
    """Where a robot's bodies and parts are.

    Args:
        robot: from `build_robot`.
        qpos: `[S, nq]` one pose after the other.

    Returns:
        The poses.
    """
    data, table = mujoco.MjData(robot.mj_model), robot.fluid
    poses = []
    for row in qpos:
        data.qpos[:] = row
        mujoco.mj_kinematics(robot.mj_model, data)
        frame = data.xmat.reshape(-1, 3, 3)[table.body]
        parts = data.xpos[table.body] + np.einsum("pij,pj->pi", frame, table.position)
        poses.append((data.xpos.copy(), data.xquat.copy(), parts))
    position, quaternion, parts = (np.array(x) for x in zip(*poses, strict=True))
    return Poses(position, nearer_signs(quaternion), parts)


def nearer_signs(quaternion: np.ndarray) -> np.ndarray:
    """Quaternions of which neighbours in time are close, for q and -q are the same rotation.

    Args:
        quaternion: `[S, ..., 4]`.

    Returns:
        The same, some with the other sign.
    """
    flips = np.where((quaternion[1:] * quaternion[:-1]).sum(-1) < 0, -1.0, 1.0)
    signs = np.concatenate([np.ones_like(quaternion[:1, ..., 0]), np.cumprod(flips, axis=0)])
    return quaternion * signs[..., None]


def water_drift(robot: Robot, water: Water, place: np.ndarray, step: float) -> np.ndarray:
    """How far the water around a robot has gone, its waves apart.

    Args:
        robot: in whose world.
        water: of `[S]` each.
        place: `[S, 3]` of the robot, world frame [m].
        step: from row to row [s].

    Returns:
        `[S, 3]` world frame [m].
    """
    gone = np.cumsum(step * water_velocity(robot, water, place), axis=0)
    return np.concatenate([np.zeros((1, 3)), gone[:-1]])


def bed_at(bed: Bed, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Heights of a bed [m] at places x, y of any shape [m], world frame."""
    return np.asarray(bed_height(bed, np.asarray(x, np.float32), np.asarray(y, np.float32)), float)


def bed_rings(bed: Bed, middle: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Points of a bed on rings.

    Args:
        bed: of the world.
        middle: `[2]` of the rings, world frame [m].
        radius: `[rings]` [m].

    Returns:
        `[rings, SECTORS, 3]` world frame [m].
    """
    angle = 2 * np.pi * np.arange(SECTORS) / SECTORS
    x = middle[0] + radius[:, None] * np.cos(angle)
    y = middle[1] + radius[:, None] * np.sin(angle)
    return np.stack([x, y, bed_at(bed, x, y)], axis=-1)
