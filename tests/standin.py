"""Stand-ins for the simulator: robots swim straight ahead and wave their hinges, by formula."""

import math
from types import SimpleNamespace

import numpy as np

from mjx_revolve.episodes.simulate import Trajectory
from mjx_revolve.inputs.errors import InputError

SPEED = 0.1  # of every robot through the water, along its own x [m/s]
# Of a swim of one robot alone: 50 rows a second.
PERIOD, SECONDS = 0.8, 6.0
TIME = np.arange(0.02, SECONDS + 1e-9, 0.02)


def trajectory(robot, time, qpos, **columns):
    """Of a robot that is not told anything and needs no power."""
    still = {"ctrl": np.zeros((len(time), robot.mj_model.nu)), "power": 0 * time}
    return Trajectory(time, qpos, qvel=None, xpos=None, **still | columns)


def swim(robot, heading=0.0, depth=1.0, speed=SPEED / 2, **columns):
    """Straight ahead at one speed, hinges beating."""
    qpos = np.tile(robot.mj_model.qpos0, (len(TIME), 1))
    way = np.array([math.cos(heading), math.sin(heading)])
    qpos[:, :2], qpos[:, 2] = np.outer(speed * TIME, way), -depth
    qpos[:, 7:] = 0.5 * np.sin(2 * np.pi * TIME / PERIOD)[:, None]
    return trajectory(robot, TIME, qpos, **columns)


class StandIn:
    """Has the interface of `mjx_revolve.episodes.tank.Tank`, and no physics."""

    def __init__(self, world, lanes=4):
        self.world, self.robots, self.time = world, [None] * lanes, 0.0
        self.current = np.array(world.current, float)
        self.lost = set()  # lanes that are to blow up
        self.poses = {}

    def add(self, robot, genes, position, quat=(1, 0, 0, 0)):
        if None not in self.robots:
            raise InputError(f"tank: expected a free place; found all {len(self.robots)} taken")
        lane = self.robots.index(None)
        self.robots[lane] = robot
        self.poses[lane] = (np.array(position, float), np.array(quat, float), genes is not None)
        return lane

    def remove(self, lane):
        self.robots[lane] = None
        self.poses.pop(lane)
        self.lost.discard(lane)

    def set_current(self, current):
        self.current = np.array(current, float)

    def advance(self, duration, every):
        count = round(duration / every)
        times = self.time + every * np.arange(1, count + 1)
        most = max([robot.num_hinges for robot in self.robots if robot is not None], default=0)
        qpos = np.zeros((count, 7 + most, len(self.robots)))
        alive = np.zeros(len(self.robots), bool)
        for lane, (place, quat, swims) in self.poses.items():
            robot, (w, _, _, z) = self.robots[lane], quat
            ahead = np.array([w * w - z * z, 2 * w * z, 0.0]) * SPEED * swims
            rows = place + np.outer(times - self.time, ahead + self.current)
            qpos[:, :3, lane], qpos[:, 3:7, lane] = rows, quat
            phase = 2 * math.pi * times[:, None] + np.arange(robot.num_hinges)
            qpos[:, 7 : 7 + robot.num_hinges, lane] = 0.5 * swims * np.sin(phase)
            self.poses[lane] = (rows[-1], quat, swims)
            alive[lane] = True
            if lane in self.lost:
                qpos[-1, :, lane] = np.nan
        self.time = float(times[-1])
        return SimpleNamespace(time=times, qpos=qpos, alive=alive)
