"""Robots to export: the shipped ones, and an odd one; their poses by MuJoCo."""

from functools import lru_cache

import mujoco
import numpy as np
import yaml

from laboratory import body, read
from mjx_revolve.body.catalogue import MODULES
from mjx_revolve.body.module_files import read_modules
from mjx_revolve.body.morphology import make_morphology
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

# Own types, whose names clash once something is put behind them: two thrusters, one of them far
# outside of its part, in a module; a hinge with a thruster; parts that differ in numbered names.
OWN = """
modules:
  Jets:
    mount: -x
    parts:
      - {name: motor, size: [0.03, 0.03, 0.03], mass: 0.02,
         thruster: {gain: 0.5, position: [0.06, 0, 0]}}
      - {name: motor_propeller, size: [0.01, 0.02, 0.02], mass: 0.01, position: [0.04, 0, 0],
         thruster: {gain: 0.5}}
  Pod:
    mount: -x
    hinge: {axis: [0, 1, 0], anchor: [0.012, 0, 0]}
    parts:
      - {name: box, size: [0.02, 0.02, 0.02], mass: 0.01}
      - {name: box_2, size: [0.03, 0.02, 0.02], mass: 0.01, position: [0.04, 0, 0],
         thruster: {gain: 0.5}}
body:
  {type: Core, id: core, children: {0: {type: Jets, id: jet/left}, 1: {type: Jets, id: jet/right},
   2: {type: Pod, id: core/lift}, 3: {type: Pod, id: pod, params: {mass: 0.03, volume: 5.0e-6}}}}
"""
NAMES = ("spider", "auv", "fish", "centipede", "odd", "own")


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
    return Episode("odd", robot, Trajectory(*columns, columns[4][:, list(robot.thrusters)]))


@lru_cache
def lake_robot(name: str) -> Robot:
    """One of `NAMES` in the lake."""
    if name == "odd":
        return odd_episode().robot
    if name == "own":
        data = yaml.safe_load(OWN)
        types = MODULES | read_modules({"modules": data.pop("modules")}, MODULES)
        return build_robot(make_morphology(data, types), load_world("lake"))
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
