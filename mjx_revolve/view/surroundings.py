"""The surroundings of a robot in pictures: the water's own motion, the bed, the task's target."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import jax
import numpy as np

from mjx_revolve.water.bed import Bed, bed_height
from mjx_revolve.water.flow import Water, flow, water_of
from mjx_revolve.water.world import World

if TYPE_CHECKING:
    from mjx_revolve.episodes.config import TaskConfig
    from mjx_revolve.episodes.simulate import Trajectory

SECTORS = 96  # points on each ring around the way on which the bed is drawn
# Slower water is as good as still [m/s].
_STILL = 1e-3


def water_at(
    world: World, rows: np.ndarray, time: np.ndarray, steps: int, water: Water | None = None
) -> Water:
    """The water at rows of a trajectory.

    Args:
        world: of the trajectory.
        rows: `[S]` of the trajectory.
        time: `[S]` their times [s].
        steps: how many rows the trajectory has.
        water: as given to `simulate`; None: the world's, without its gusts.

    Returns:
        Water of `[S]` each.
    """
    # A row of the trajectory is the state after its step, which the next step's water meets.
    after = np.clip(rows + 1, 0, steps - 1)
    pick = lambda x: np.broadcast_to(np.asarray(x, np.float32), (steps,))[after]  # noqa: E731
    given = water_of(world) if water is None else water
    if np.shape(given.time) == (steps,):  # of each step, as `simulate` has it, not of the start
        start = np.asarray(given.time, float) - world.timestep * np.arange(steps)
        given = given._replace(time=start)
    now: Water = jax.tree.map(pick, given)
    return now._replace(time=(now.time + time).astype(np.float32))


def water_velocity(world: World, water: Water | None, place: np.ndarray) -> np.ndarray:
    """Velocity of the water around a robot, its waves apart.

    Args:
        world: of the robot.
        water: of numbers or of `[S]` each; None: the world's.
        place: `[S, 3]` of the robot, world frame [m].

    Returns:
        `[S, 3]` world frame [m/s].
    """
    water = water_of(world) if water is None else water
    velocity, _ = flow(replace(world, waves=()), water, *place.T.astype(np.float32))
    return np.stack([np.broadcast_to(np.asarray(v, float), len(place)) for v in velocity], axis=-1)


def water_drift(world: World, water: Water, place: np.ndarray, step: float) -> np.ndarray:
    """How far the water around a robot has gone, its waves apart.

    Args:
        world: of the robot.
        water: of `[S]` each.
        place: `[S, 3]` of the robot, world frame [m].
        step: from row to row [s].

    Returns:
        `[S, 3]` world frame [m].
    """
    gone = np.cumsum(step * water_velocity(world, water, place), axis=0)
    return np.concatenate([np.zeros((1, 3)), gone[:-1]])


def is_moving(current: np.ndarray) -> bool:
    """Whether water of velocities `[S, 3]` [m/s] takes anything along."""
    return bool(np.sqrt(np.mean(np.sum(current**2, axis=-1))) > _STILL)


def target_of(task: TaskConfig | None, trajectory: Trajectory) -> np.ndarray | None:
    """`[S, 3]` the target at each row of a trajectory, world frame [m]; None without one."""
    if trajectory.target is not None:
        return np.asarray(trajectory.target, float)
    if task is None or task.target is None:
        return None
    return np.tile(np.asarray(task.target, float), (len(trajectory.time), 1))


def target_name(task: TaskConfig | None) -> str:
    """What pictures call a task's target: one that pursues the robot is a pursuer."""
    return "target" if task is None or task.target_turn is None else "pursuer"


def target_at_last(task: TaskConfig | None, trajectory: Trajectory) -> np.ndarray | None:
    """`[3]` the target at the end, world frame [m]; None without one."""
    found = target_of(task, trajectory)
    return None if found is None else found[-1]


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
