"""What a robot swims in and towards: the water's own motion around it, and its target."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from mjx_revolve.water.flow import Water, flow, water_of

if TYPE_CHECKING:
    from mjx_revolve.engine.robot import Robot
    from mjx_revolve.episodes.config import TaskConfig

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


def target_of(task: TaskConfig | None) -> np.ndarray | None:
    """`[3]` where a task sends robots, world frame [m]; None where it names no place."""
    if task is None or task.target is None:
        return None
    return np.asarray(task.target, float)
