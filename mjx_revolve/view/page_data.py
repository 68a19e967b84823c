"""What the page of `viewer` is given of an episode: plain values for its scripts."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mjx_revolve.engine.robot import Robot
from mjx_revolve.episodes.champion import Episode
from mjx_revolve.view.course import finite_part, pose_robot, water_drift
from mjx_revolve.view.forces import module_forces, sum_modules, water_at
from mjx_revolve.view.motion import smooth_path, speed_over, stroke_period
from mjx_revolve.view.packed import pack_bed, pack_floats, pack_pieces, pack_waves, pack_whole
from mjx_revolve.view.surroundings import moves, target_of, water_velocity
from mjx_revolve.water.flow import Water, water_of

# Poses per second, and how many at most: a long episode gets fewer per second.
_RATE, _MOST = 50.0, 3000
# Red, green, blue of the arrows of each kind of force.
_COLORS = {
    "buoyancy": (0.56, 0.93, 1.0),
    "drag": (1.0, 0.30, 0.42),
    "thrust": (1.0, 0.83, 0.25),
}
# Three quarters of a kind's arrows are shorter than the first of these shares of the body's length,
# and all are shorter than the second; of a small body, than these lengths [m].
_ARROW, _LONGEST = (0.3, 0.1), (0.65, 0.22)
_LEFT_OUT = "left out here; python -m mjx_revolve.viewer RUN --individual N has them"
# Forces below this are rounding [N].
_NOTHING = 1e-5


def page_data(episode: Episode, forces: bool = True) -> dict[str, Any]:
    """What the page's scripts read, as plain values for JSON.

    Args:
        episode: what to show.
        forces: whether the page has arrows of forces, which take seconds to compile.

    Returns:
        Arrays are packed: base64 of little-endian float32 as `f32`, or of int16 as `i16` with a
        `scale`. Along time there is a row each `step` seconds.

    Raises:
        InputError: the episode has no finite row.
    """
    episode, _ = finite_part(episode)
    robot, trajectory = episode.robot, episode.trajectory
    world, length = robot.world, robot.morphology.length
    water: Water = water_of(world) if episode.water is None else episode.water
    every = _stride(np.asarray(trajectory.time, float))
    rows = np.arange(0, len(trajectory.time), every)
    time, qpos = (np.asarray(x, float)[rows] for x in (trajectory.time, trajectory.qpos))
    poses = pose_robot(robot, qpos)
    step = float(time[-1] - time[0]) / max(len(time) - 1, 1) or world.timestep
    period = stroke_period(time, qpos[:, 7:])
    weight = robot.fluid.volume / robot.fluid.volume.sum()
    center = smooth_path(time, np.einsum("spi,p->si", poses.parts, weight), period)
    now = water_at(robot, rows, time, len(trajectory.time), water)
    low = float((poses.parts[..., 2] - np.linalg.norm(robot.fluid.half_size, axis=1)).min())
    surface = _first(water.surface_height)
    net = qpos[-1, :2] - qpos[0, :2]
    target = target_of(episode.fitness.config.task if episode.fitness else None, trajectory)
    moved = float(np.linalg.norm(net)) > 0.05 * length
    return {
        "length": length,
        "start": float(time[0]),
        "step": step,
        "count": len(time),
        # Of the way, from x towards y [deg]; who stays is shown along y.
        "heading": math.degrees(math.atan2(net[1], net[0])) if moved else 90.0,
        "core": pack_floats(qpos[:, :3]),
        "center": pack_floats(center),
        "speed": pack_floats(speed_over(time, qpos[:, :3], period)),
        "drift": pack_floats(water_drift(robot, now, center, step)),
        "current": _current(water_velocity(robot, now, center)),
        "target": None if target is None else pack_floats(target[rows]),
        "robot": {
            "bodies": poses.position.shape[1] - 1,
            **pack_pieces(robot),
            "position": pack_floats(poses.position[:, 1:]),
            "quaternion": pack_whole(poses.quaternion[:, 1:]),
        },
        "anchors": _anchors(robot),
        "forces": _forces(episode, every, water)
        if forces
        else {
            name: {"color": color, "scale": 0, "force": pack_whole(np.zeros(0)), "why": _LEFT_OUT}
            for name, color in _COLORS.items()
        },
        "world": {
            "surface": surface,
            "waves": pack_waves(world, _first(water.time)),
            "bed": pack_bed(world, center, low),
        },
        "floor": low - 0.1 * length,  # below the robot: where the grid is drawn
        "deepest": max(1.3 * (surface - float(qpos[:, 2].min())), surface - low, 1.5 * length),
    }


def _forces(episode: Episode, every: int, water: Water) -> dict[str, Any]:
    """The arrows of all kinds of forces."""
    robot, length = episode.robot, episode.robot.morphology.length
    found = module_forces(robot, episode.trajectory, every, water)
    return {
        name: _arrows(color, sum_modules(robot, getattr(found, name)), length)
        for name, color in _COLORS.items()
    }


def _current(velocity: np.ndarray) -> dict[str, Any] | None:
    """The water's velocity around the robot, waves apart `[S, 3]` [m/s]; None where it is still."""
    if not moves(velocity):
        return None
    return {
        "fastest": float(np.linalg.norm(velocity, axis=1).max()),
        "velocity": pack_floats(velocity),
    }


def _stride(time: np.ndarray) -> int:
    """Rows from one pose that is kept to the next."""
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


def _arrows(color: tuple[float, ...], force: np.ndarray, length: float) -> dict[str, Any]:
    """A kind of force `[S, nmodule, 3]` [N], and how long its arrows are [m/N]; 0 where none is."""
    size = np.linalg.norm(force, axis=-1)
    size, scale = size[size > _NOTHING], 0.0
    if size.size:
        usual, longest = (max(share * length, least) for share, least in (_ARROW, _LONGEST))
        scale = min(usual / float(np.percentile(size, 75)), longest / float(size.max()))
    return {"color": color, "scale": scale, "force": pack_whole(force)}


def _first(value: Any) -> float:
    """A number, or the first of its rows."""
    return float(np.ravel(np.asarray(value, float))[0])
