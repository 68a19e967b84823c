"""Robots to export: the shipped ones, and an odd one; their poses by MuJoCo."""

from functools import lru_cache

import mujoco
import numpy as np

from laboratory import body, read
from mjx_revolve.engine.robot import Robot, build_robot
from mjx_revolve.episodes.champion import Episode
from mjx_revolve.episodes.simulate import Trajectory
from mjx_revolve.water.world import load_world

# Names that neither ROS nor Gazebo takes, two that are one when they are made plain, every kind of
# part, ballast and colours.
ODD = """
id: "odd <one>"
body:
  id: core
  type: Core
  params: {red: 0.9, green: 0.1, blue: 0.2, ballast: 0.02, ballast_position: [0.01, 0, -0.018]}
  children:
    1:
      id: "arm 1"
      type: ActiveHinge
      orientation: 90
      children:
        1:
          id: hand
          type: FixedBrick
          params: {red: 0.1, green: 0.4, blue: 0.8}
          children:
            2: {id: jet, type: Thruster, params: {thruster: {torque_ratio: -0.002}}}
    2: {id: fin, type: Fin}
    3:
      id: "arm-1"
      type: ActiveHinge
      children:
        1: {id: feeler, type: TouchSensor}
"""

NAMES = ("spider", "auv", "fish", "centipede", "odd")


@lru_cache
def odd_episode() -> Episode:
    """The odd one for 0.6 s, its arms waving; stepped by MuJoCo, which has nothing to compile."""
    robot = build_robot(read(ODD), load_world("lake"))
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = robot.start_qpos()
    data.qvel[:6] = [0.3, -0.2, 0.5, 1.0, 2.0, -0.5]
    rows = []
    for k in range(120):
        data.ctrl[:] = 0.7 * np.sin(0.05 * k + np.arange(robot.mj_model.nu))
        mujoco.mj_step(robot.mj_model, data)
        qpos = data.qpos.copy()
        mujoco.mj_kinematics(robot.mj_model, data)
        rows.append((data.time, qpos, data.qvel.copy(), data.xpos.copy(), data.ctrl.copy(), 0.0))
    columns = [np.array(column, np.float32) for column in zip(*rows, strict=True)]
    command = columns[4][:, list(robot.thrusters)]
    return Episode("odd", robot, Trajectory(*columns, command))


@lru_cache
def lake_robot(name: str) -> Robot:
    """One of `NAMES` in the lake."""
    if name == "odd":
        return odd_episode().robot
    return build_robot(body(name), load_world("lake"))


def angles_of(robot, seed=0):
    """Random angles of the hinges within their ranges."""
    model, rng = robot.mj_model, np.random.default_rng(seed)
    low, high = model.jnt_range[1:].T
    return rng.uniform(low, high) if len(low) else np.zeros(0)


def forward(robot, angles):
    """Our bodies' poses, the core at the origin: positions and rotations by link."""
    data = mujoco.MjData(robot.mj_model)
    data.qpos[7:] = angles
    mujoco.mj_kinematics(robot.mj_model, data)
    return data.xpos[1:].copy(), data.xmat[1:].reshape(-1, 3, 3).copy()
