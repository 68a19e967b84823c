"""What the page of `viewer` is given of an episode: plain values for its scripts."""

from __future__ import annotations

import base64
import math
from typing import Any

import numpy as np

from mjx_revolve.engine.robot import Robot
from mjx_revolve.episodes.champion import Episode
from mjx_revolve.view.course import bed_rings, finite_part, pose_robot, water_drift
from mjx_revolve.view.forces import module_forces, sum_modules, water_at
from mjx_revolve.view.motion import smooth_path, speed_over, stroke_period
from mjx_revolve.view.pieces import make_pieces, mount_piece
from mjx_revolve.view.surroundings import moves, target_of, water_velocity
from mjx_revolve.water.flow import Water, water_of
from mjx_revolve.water.world import World

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
# A bed that is further below than this is lost in the water's haze [m].
_SIGHT = 25.0
# The bed is drawn on rings from the way's middle to the horizon, of these radii [m].
_RADIUS = np.concatenate([[0.0], np.geomspace(0.1, 1500.0, 109)])


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
        "core": _f32(qpos[:, :3]),
        "center": _f32(center),
        "speed": _f32(speed_over(time, qpos[:, :3], period)),
        "drift": _f32(water_drift(robot, now, center, step)),
        "current": _current(water_velocity(robot, now, center)),
        "target": None if target is None else _f32(target[rows]),
        "robot": {
            "bodies": poses.position.shape[1] - 1,
            **_pieces(robot),
            "position": _f32(poses.position[:, 1:]),
            "quaternion": _i16(poses.quaternion[:, 1:]),
        },
        "anchors": _anchors(robot),
        "forces": _forces(episode, every, water)
        if forces
        else {
            name: {"color": color, "scale": 0, "force": _i16(np.zeros(0)), "why": _LEFT_OUT}
            for name, color in _COLORS.items()
        },
        "world": {
            "surface": surface,
            "waves": _waves(world, _first(water.time)),
            "bed": _bed(world, center, low),
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
    return {"fastest": float(np.linalg.norm(velocity, axis=1).max()), "velocity": _f32(velocity)}


def _stride(time: np.ndarray) -> int:
    """Rows from one pose that is kept to the next."""
    dt = float(time[-1] - time[0]) / (len(time) - 1) if len(time) > 1 else 1.0
    return max(1, round(1 / (_RATE * dt)), math.ceil(len(time) / _MOST))


def _pieces(robot: Robot) -> dict[str, Any]:
    """Meshes of the parts, and on which bodies they are."""
    shapes: dict[int, int] = {}  # modules of a kind share their parts' triangles
    packed: list[Any] = []
    pieces: list[Any] = []
    for piece in make_pieces(robot.morphology):
        if piece.mark:  # rods and arrows are for pictures at rest
            continue
        if id(piece.corners) not in shapes:
            shapes[id(piece.corners)] = len(packed)
            packed.append(_i16(piece.corners))
        body, position, rotation = mount_piece(robot, piece)
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation, position
        pieces.append({
            "body": body - 1,
            "shape": shapes[id(piece.corners)],
            "color": piece.color.round(4).tolist(),
            "matrix": matrix.T.ravel().round(7).tolist(),  # by columns
        })  # fmt: skip
    return {"shapes": packed, "pieces": pieces}


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
    return {"color": color, "scale": scale, "force": _i16(force)}


def _waves(world: World, begun: float) -> list[dict[str, float]]:
    """The world's waves as a cos(k·p - ωt + φ), t of an episode that began at a time."""
    waves = []
    for wave in world.waves:
        if wave.amplitude == 0:
            continue
        k = wave.wavenumber(world.gravity, world.water_depth)
        x, y = math.cos(wave.direction), math.sin(wave.direction)
        along = k * (x * world.current[0] + y * world.current[1])
        omega = wave.frequency(world.gravity, world.water_depth) + along
        phase = math.remainder(wave.phase - omega * begun, 2 * math.pi)
        waves.append({
            "k": k, "x": x, "y": y, "amplitude": wave.amplitude, "omega": omega, "phase": phase,
        })  # fmt: skip
    return waves


def _bed(world: World, center: np.ndarray, low: float) -> dict[str, Any] | None:
    """The bed on rings around the way, or None where it is out of sight."""
    if world.bed is None:
        return None
    middle = (center[:, :2].min(0) + center[:, :2].max(0)) / 2
    height = bed_rings(world.bed, middle, _RADIUS)[..., 2]
    reach = float(np.ptp(center[:, :2], axis=0).max()) + _SIGHT
    if low - float(height[reach >= _RADIUS].max()) > _SIGHT:
        return None
    rings, sectors = height.shape
    return {
        "center": middle.tolist(),
        "rings": rings,
        "sectors": sectors,
        "radius": _f32(_RADIUS),
        "height": _f32(height),
    }


def _f32(values: Any) -> dict[str, str]:
    """Packs numbers whole."""
    return {"f32": base64.b64encode(np.asarray(values, "<f4").tobytes()).decode()}


def _i16(values: np.ndarray) -> dict[str, Any]:
    """Packs numbers to 1/32767 of the largest."""
    scale = float(np.abs(values).max(initial=0.0)) / 32767 or 1.0
    whole = np.round(values / scale).astype("<i2")
    return {"i16": base64.b64encode(whole.tobytes()).decode(), "scale": scale}


def _first(value: Any) -> float:
    """A number, or the first of its rows."""
    return float(np.ravel(np.asarray(value, float))[0])
