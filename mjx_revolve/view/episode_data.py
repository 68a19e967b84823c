"""Data for the page of an episode: its robot's poses, forces, speed, current and target."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mjx_revolve.engine.robot import Robot
from mjx_revolve.episodes.champion import Episode
from mjx_revolve.view.forces import module_forces, sum_modules
from mjx_revolve.view.motion import smooth_path, speed_over, stroke_period
from mjx_revolve.view.page_data import Packed, pack_floats, pack_poses, pack_quantized, replay_data
from mjx_revolve.view.palette import FORCES
from mjx_revolve.view.poses import finite_rows, pose_robot
from mjx_revolve.view.recording import ReplayRobot
from mjx_revolve.view.surroundings import (
    is_moving,
    target_name,
    target_of,
    water_at,
    water_drift,
    water_velocity,
)
from mjx_revolve.water.flow import Water, water_of

# Poses per second, and how many at most: a long episode gets fewer per second.
_RATE, _MOST = 50.0, 3000
# Rounding of positions [m], quaternions [-] and hinges [rad]: invisible when a robot fills the
# picture.
_STEPS = (2e-5, 5e-5, 1e-3)
# Three quarters of a kind's arrows are shorter than the first of these shares of the body's length,
# and all are shorter than the second; of a small body, than these lengths [m].
_ARROW, _LONGEST = (0.3, 0.1), (0.65, 0.22)
_LEFT_OUT = "left out here; python -m mjx_revolve.viewer RUN --individual N has them"
# Forces below this are rounding [N].
_ROUNDING_FORCE = 1e-5


def episode_data(episode: Episode, forces: bool = True) -> Packed:
    """What the page's scripts read, as plain values for JSON.

    Args:
        episode: what to show.
        forces: whether the page has arrows of forces, which take seconds to compile.

    Returns:
        As `replay_data` of one robot, with its poses, and `episode`: arrays along time with a row
        each `step` seconds.

    Raises:
        InputError: the episode has no finite row.
    """
    episode, _ = finite_rows(episode)
    robot, trajectory = episode.robot, episode.trajectory
    world, length = robot.world, robot.morphology.length
    water: Water = water_of(world) if episode.water is None else episode.water
    every = row_stride(np.asarray(trajectory.time, float))
    rows = np.arange(0, len(trajectory.time), every)
    time, qpos = (np.asarray(x, float)[rows] for x in (trajectory.time, trajectory.qpos))
    step = float(time[-1] - time[0]) / max(len(time) - 1, 1) or world.timestep
    period = stroke_period(time, qpos[:, 7:])
    parts = pose_robot(robot, qpos).parts
    weight = robot.fluid.volume / robot.fluid.volume.sum()
    center = smooth_path(time, np.einsum("spi,p->si", parts, weight), period)
    low = float((parts[..., 2] - np.linalg.norm(robot.fluid.half_size, axis=1)).min())
    now = water_at(world, rows, time, len(trajectory.time), water)
    current = water_velocity(world, now, center)
    target = target_of(episode.task, trajectory)
    surface, begun = (_first(x) for x in (water.surface_height, water.time))
    net, lowest = qpos[-1, :2] - qpos[0, :2], float(qpos[:, 2].min())
    moved = float(np.linalg.norm(net)) > 0.05 * length
    fastest = float(np.linalg.norm(current, axis=1).max())
    moving = {"fastest": fastest, "velocity": pack_floats(current)}
    shown = ReplayRobot(episode.title, robot, time, qpos)
    data = replay_data([shown], low - 0.1 * length, begun=begun)
    data["world"]["surface"] = surface
    return data | pack_poses([time], [qpos], _STEPS) | {
        "many": False,
        "episode": {
            "step": step,
            "length": episode.length,
            # Direction of the way, from x towards y [deg]; a robot that stays is shown along y.
            "heading": math.degrees(math.atan2(net[1], net[0])) if moved else 90.0,
            "center": pack_floats(center),
            "speed": pack_floats(speed_over(time, qpos[:, :3], period)),
            "drift": pack_floats(water_drift(world, now, center, step)),
            "current": moving if is_moving(current) else None,
            "target": None if target is None else pack_floats(target[rows]),
            "target_name": target_name(episode.task),
            "anchors": _anchors(robot),
            "forces": _arrows(episode, every, water) if forces else _no_arrows(_LEFT_OUT),
            "deepest": max(1.3 * (surface - lowest), surface - low, 1.5 * length),
        },
    }  # fmt: skip


def row_stride(time: np.ndarray) -> int:
    """Rows of a trajectory `[T]` [s] from one pose that a page keeps to the next."""
    dt = float(time[-1] - time[0]) / (len(time) - 1) if len(time) > 1 else 1.0
    return max(1, round(1 / (_RATE * dt)), math.ceil(len(time) / _MOST))


def _anchors(robot: Robot) -> list[dict[str, Any]]:
    """Where each module's arrows begin: at the centre of its part that displaces most."""
    fluid, anchors = robot.fluid, []
    for module in range(robot.morphology.num_modules):
        k = int(np.where(fluid.module == module, fluid.volume, -1.0).argmax())
        place = fluid.position[k] + fluid.rotation[k] @ fluid.center_of_volume[k]
        anchors.append({"body": int(fluid.body[k]) - 1, "place": place.round(6).tolist()})
    return anchors


def _arrows(episode: Episode, every: int, water: Water) -> Packed:
    """Forces on modules `[S, nmodule, 3]` [N] of each kind, and how long arrows are [m/N]."""
    robot, length = episode.robot, episode.robot.morphology.length
    found = module_forces(robot, episode.trajectory, every, water)
    arrows = _no_arrows()
    for name, arrow in arrows.items():
        force = sum_modules(robot, getattr(found, name))
        size = np.linalg.norm(force, axis=-1)
        size = size[size > _ROUNDING_FORCE]
        arrow["force"] = pack_quantized(force)
        if size.size:
            usual, longest = (max(share * length, least) for share, least in (_ARROW, _LONGEST))
            most = usual / float(np.percentile(size, 75)), longest / float(size.max())
            arrow["scale"] = min(most)
    return arrows


def _no_arrows(why: str | None = None) -> Packed:
    """Every kind of force without arrows, and why there are none; None: there is no force."""
    none = {"scale": 0.0, "force": pack_quantized(np.zeros(0)), "why": why}
    return {name: {"color": color, **none} for name, color in FORCES.items()}


def _first(value: ArrayLike) -> float:
    """A number, or the first of its rows."""
    return float(np.ravel(np.asarray(value, float))[0])
