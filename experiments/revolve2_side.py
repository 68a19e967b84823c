"""revolve2's half of `revolve2_comparison`, run by the Python of revolve2's own environment.

Reads robots and brains as JSON from stdin; builds them of revolve2's modules, simulates all of them
on a plane by revolve2's simulator, and prints what came of it.
"""

import json
import sys
import time
from importlib.metadata import version

import mujoco
import numpy as np
from revolve2.modular_robot import ModularRobot
from revolve2.modular_robot.body.v1 import ActiveHingeV1, BodyV1, BrickV1
from revolve2.modular_robot.brain import Brain
from revolve2.modular_robot.brain.cpg import BrainCpgInstance
from revolve2.modular_robot_simulation import ModularRobotScene, Terrain, simulate_scenes
from revolve2.simulation.scene import Pose
from revolve2.simulation.scene.geometry import GeometryPlane
from revolve2.simulation.scene.vector2 import Vector2
from revolve2.simulation.simulator import BatchParameters
from revolve2.simulators.mujoco_simulator import LocalSimulator
from revolve2.simulators.mujoco_simulator._scene_to_model import scene_to_model

# Our slots as revolve2 calls them.
CORE = {0: "back", 1: "front", 2: "right", 3: "left"}
BRICK = {1: "front", 2: "right", 3: "left"}


class Instance(BrainCpgInstance):
    """revolve2's CPG with tanh, as Revolve's paper and we have it, where revolve2 clips."""

    def control(self, dt, sensor_state, control_interface):
        """A step of x' = W x by the same Runge-Kutta scheme, then the targets."""
        a, x = self._weight_matrix, self._state
        k1 = a @ x
        k2 = a @ (x + dt / 2 * k1)
        k3 = a @ (x + dt / 2 * k2)
        k4 = a @ (x + dt * k3)
        self._state = x + dt / 6 * (k1 + 2 * (k2 + k3) + k4)
        for index, hinge in self._output_mapping:
            target = float(np.tanh(self._state[index])) * hinge.range
            control_interface.set_active_hinge_target(hinge, target)


class Cpg(Brain):
    """A CPG with the given matrix; all x begin at 0, all y at 1."""

    def __init__(self, matrix, hinges):
        """Keeps the matrix `[2 n, 2 n]` and the n hinges in its order."""
        self.matrix, self.hinges = np.array(matrix, float), hinges

    def make_instance(self):
        """A fresh oscillator."""
        start = np.repeat([0.0, 1.0], len(self.hinges))
        return Instance(start, self.matrix, list(enumerate(self.hinges)))


def build(modules):
    """A body of revolve2's own modules, and its hinges in our order."""
    body, made, hinges = BodyV1(), [], []
    for module in modules:
        turn = float(np.radians(module["orientation"]))
        if module["type"] == "Core":
            made.append(("Core", body.core_v1))
            continue
        own = (ActiveHingeV1 if module["type"] == "ActiveHinge" else BrickV1)(turn)
        kind, parent = made[module["parent"]]
        names = {"Core": CORE, "FixedBrick": BRICK, "ActiveHinge": {1: "attachment"}}[kind]
        setattr(parent, names[module["slot"]], own)
        made.append((module["type"], own))
        if module["type"] == "ActiveHinge":
            hinges.append(own)
    return body, hinges


def flat():
    """A scene with a level floor."""
    plane = GeometryPlane(pose=Pose(), mass=0.0, size=Vector2([20.0, 20.0]))
    return ModularRobotScene(terrain=Terrain([plane]))


def describe(body):
    """Mass [kg], and where the hinges are from the core's centre at rest, sorted [m]."""
    scene = flat()
    scene.add_robot(ModularRobot(body, Cpg(np.zeros((0, 0)), [])), translate_z_aabb=False)
    model, _ = scene_to_model(scene.to_simulation_scene()[0], 0.001, False, True)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    hinges = model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
    return {"mass": float(model.body_mass.sum()), "anchors": data.xanchor[hinges].tolist()}


def main():
    """Simulates, and prints."""
    asked = json.load(sys.stdin)
    found = {"versions": {name: version(name) for name in ("revolve2-simulation", "mujoco")}}
    found["robots"] = [describe(build(robot)[0]) for robot in asked["robots"]]
    began = time.perf_counter()
    robots = []
    for individual in asked["individuals"]:
        body, hinges = build(asked["robots"][individual["robot"]])
        robots.append(ModularRobot(body, Cpg(individual["matrix"], hinges)))
    scenes = []
    for robot in robots:
        scenes.append(flat())
        scenes[-1].add_robot(robot)
    parameters = BatchParameters(
        simulation_time=asked["seconds"], sampling_frequency=1,
        simulation_timestep=asked["timestep"], control_frequency=asked["rate"],
    )  # fmt: skip
    simulator = LocalSimulator(headless=True, num_simulators=asked["cores"])
    states = simulate_scenes(simulator, parameters, scenes)
    found["seconds"] = time.perf_counter() - began
    ways = []
    for robot, track in zip(robots, states, strict=True):
        first, last = (
            state.get_modular_robot_simulation_state(robot).get_pose().position
            for state in (track[0], track[-1])
        )
        ways.append(float(np.hypot(*(last - first)[:2])))
    found["ways"] = ways
    print(json.dumps(found))


if __name__ == "__main__":
    main()
