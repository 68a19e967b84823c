"""What a robot swims in and towards: the water's own motion around it, and its target."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from mjx_revolve.water.flow import Water, flow, water_of

if TYPE_CHECKING:
    from mjx_revolve.engine.robot import Robot
    from mjx_revolve.episodes.config import TaskConfig
    from mjx_revolve.episodes.simulate import Trajectory

# Slower water is as good as still [m/s].
_STILL = 1e-3


def water_velocity(robot: Robot, water: Water | None, place: np.ndarray) -> np.ndarray:
    """How fast the water around a robot goes, its waves apart.

    Args:
        robot: in whose world.
        water: of numbers or of `[S]` each; None: the world's.
        place: `[S, 3]` of the robot, world frame [m].

    Returns:
        `[S, 3]` world frame [m/s].
    """
    calm = replace(robot.world, waves=())
    water = water_of(robot.world) if water is None else water
    velocity, _ = flow(calm, water, *place.T.astype(np.float32))
    return np.stack([np.broadcast_to(np.asarray(v, float), len(place)) for v in velocity], axis=-1)


def moves(current: np.ndarray) -> bool:
    """Whether water of velocities `[S, 3]` [m/s] takes anything along."""
    return bool(np.sqrt(np.mean(np.sum(current**2, axis=-1))) > _STILL)


def target_of(task: TaskConfig | None, trajectory: Trajectory) -> np.ndarray | None:
    """Where a robot was to go, or whom it was to flee.

    Args:
        task: of the episode, or None.
        trajectory: of the robot.

    Returns:
        `[S, 3]` at each of its rows, world frame [m]; None where there is no such place.
    """
    found = getattr(trajectory, "target", None)
    if found is None and task is not None and task.target is not None:
        found = np.tile(np.asarray(task.target, float), (len(trajectory.time), 1))
    return None if found is None else np.asarray(found, float)


def target_at_last(task: TaskConfig | None, trajectory: Trajectory) -> np.ndarray | None:
    """`[3]` where `target_of` has it at the end, world frame [m]; None without one."""
    found = target_of(task, trajectory)
    return None if found is None else found[-1]
