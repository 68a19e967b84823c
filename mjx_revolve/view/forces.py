"""Forces of the water on each part of a robot along a trajectory: for pictures and reports.

They are the terms that a step adds up (`engine.forces.part_forces`). Added mass and entrained water
are not among them: they count as inertia.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from mjx_revolve.engine.forces import part_forces
from mjx_revolve.engine.population import init
from mjx_revolve.engine.robot import Robot
from mjx_revolve.engine.single_tree import make_single_tree
from mjx_revolve.engine.thrusters import run_thrusters
from mjx_revolve.episodes.simulate import Trajectory
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.view.poses import pose_robot
from mjx_revolve.view.surroundings import water_at
from mjx_revolve.water.flow import Water


@dataclass(frozen=True, eq=False)
class Forces:
    """Forces on a robot's parts at some rows of a trajectory; rows of parts as in the fluid table.

    Attributes:
        rows: `[S]` rows of the trajectory.
        time: `[S]` [s].
        place: `[S, npart, 3]` centres of the parts' boxes, world frame [m].
        buoyancy: `[S, npart, 3]` force of the water's pressure, world frame [N]: Archimedes', what
            accelerating water adds to it, and the pull of the surface where the world has one.
        drag: `[S, npart, 3]` of the water that flows past, the lift of fins included, world frame
            [N].
        thrust: `[S, npart, 3]` of the thrusters, world frame [N].
    """

    rows: np.ndarray
    time: np.ndarray
    place: np.ndarray
    buoyancy: np.ndarray
    drag: np.ndarray
    thrust: np.ndarray


def module_forces(
    robot: Robot, trajectory: Trajectory, every: int = 1, water: Water | None = None
) -> Forces:
    """Buoyancy, drag and thrust on each part along a trajectory.

    Args:
        robot: of the trajectory.
        trajectory: of the robot, with the coefficients that it was made with.
        every: stride of rows.
        water: as given to `simulate`: surface and current, each a number or a row for each step;
            by default the world's, without its gusts.

    Returns:
        The forces; `sum_modules` adds up those of a module.

    Raises:
        InputError: the trajectory is another robot's, or `every` is not at least 1.
    """
    model = robot.mj_model
    if isinstance(every, bool) or not isinstance(every, int) or every < 1:
        raise InputError("every", "a whole number of at least 1", repr(every))
    count = np.shape(trajectory.time)[0]
    for name, width in (("qpos", model.nq), ("qvel", model.nv), ("ctrl", model.nu)):
        shape = np.shape(getattr(trajectory, name))
        if shape != (count, width):
            raise InputError(f"trajectory.{name}", f"{[count, width]}", list(shape))
    rows = np.arange(0, count, every)
    qpos, qvel = np.asarray(trajectory.qpos)[rows], np.asarray(trajectory.qvel)[rows]
    if trajectory.command is None:  # no lag is known: the commands themselves
        command = np.asarray(trajectory.ctrl)[rows][:, list(robot.thrusters)]
    else:
        command = np.asarray(trajectory.command)[rows]
    time = np.asarray(trajectory.time, float)[rows]
    now = water_at(robot.world, rows, time, count, water)
    levels = make_single_tree(robot).with_variation(trajectory.variation)

    def run(qpos: jax.Array, qvel: jax.Array, command: jax.Array, water: Water) -> Any:
        # The rows of the trajectory are the lanes, like a population.
        thrusts: Any = ()
        if robot.num_thrusters:
            still = replace(levels.thrusters, delayed=np.zeros((robot.num_thrusters, 1), bool))
            thrusts = run_thrusters(still, command, command, robot.world.density)[1]
        return part_forces(levels, init(levels, qpos, qvel), water, thrusts)

    found = jax.jit(run)(qpos.T, qvel.T, command.T, now)
    return Forces(rows, time, pose_robot(robot, qpos).parts, *map(np.asarray, found))


def sum_modules(robot: Robot, force: np.ndarray) -> np.ndarray:
    """Forces on modules from those on their parts.

    Args:
        robot: of the forces.
        force: `[S, npart, 3]` [N].

    Returns:
        `[S, nmodule, 3]` [N], in the order of the morphology.
    """
    own = robot.fluid.module == np.arange(robot.morphology.num_modules)[:, None]
    return np.einsum("spi,mp->smi", force, own.astype(force.dtype))
