"""Torque of a robot's motors along a trajectory, for messages and reports."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from mjx_revolve.engine.level import Level
from mjx_revolve.engine.levels import make_levels
from mjx_revolve.engine.robot import Robot
from mjx_revolve.engine.servos import motor_torque


def motor_torques(robot: Robot, qpos: Any, qvel: Any, ctrl: Any) -> np.ndarray:
    """Torque of the motors, by the servos' own law, without the joints' friction.

    Args:
        robot: from `build_robot`.
        qpos: `[S, nq]` configurations.
        qvel: `[S, nv]` velocities.
        ctrl: `[S, nu]` what was asked for.

    Returns:
        `[S, nhinge]` in the order of the hinges [N·m].
    """
    levels = make_levels(robot, contact=False)

    def push(level: Level, angle: Any, speed: Any, target: Any) -> Any:
        assert level.hinges is not None
        return motor_torque(level.hinges, angle, speed, target)

    hinges = (np.asarray(qpos)[:, 7:], np.asarray(qvel)[:, 6:], np.asarray(ctrl)[:, robot.servos])
    rows = [levels.spread(jnp.asarray(x.T)) for x in hinges]
    return np.asarray(levels.gather(levels.map(push, *rows), jnp.zeros(len(hinges[0])))).T
