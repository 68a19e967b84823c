"""What pages are given, as plain values for JSON: numbers packed, a robot's meshes, its water."""

from __future__ import annotations

import base64
import math
from typing import Any

import numpy as np

from mjx_revolve.engine.robot import Robot
from mjx_revolve.view.course import bed_rings
from mjx_revolve.view.pieces import make_pieces, mount_piece
from mjx_revolve.water.world import World

# A bed that is further below than this is lost in the water's haze [m].
_SIGHT = 25.0
# The bed is drawn on rings from the way's middle to the horizon, of these radii [m].
_RADIUS = np.concatenate([[0.0], np.geomspace(0.1, 1500.0, 109)])


def pack_floats(values: Any) -> dict[str, str]:
    """Packs numbers whole: base64 of little-endian float32."""
    return {"f32": base64.b64encode(np.asarray(values, "<f4").tobytes()).decode()}


def pack_whole(values: np.ndarray) -> dict[str, Any]:
    """Packs numbers to 1/32767 of the largest: base64 of int16, and their scale."""
    scale = float(np.abs(values).max(initial=0.0)) / 32767 or 1.0
    whole = np.round(values / scale).astype("<i2")
    return {"i16": base64.b64encode(whole.tobytes()).decode(), "scale": scale}


def pack_pieces(robot: Robot) -> dict[str, Any]:
    """Meshes of a robot's parts, and on which bodies they are.

    Args:
        robot: from `build_robot`.

    Returns:
        `shapes`: triangles; `pieces`: which of them on which body, from 0 for the core's, in which
        colour, and the 4 x 4 matrix by columns, body frame.
    """
    shapes: dict[int, int] = {}  # modules of a kind share their parts' triangles
    packed: list[Any] = []
    pieces: list[Any] = []
    for piece in make_pieces(robot.morphology):
        if piece.mark:  # rods and arrows are for pictures at rest
            continue
        if id(piece.corners) not in shapes:
            shapes[id(piece.corners)] = len(packed)
            packed.append(pack_whole(piece.corners))
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


def pack_waves(world: World, begun: float) -> list[dict[str, float]]:
    """The world's waves as a cos(k·p - ωt + φ).

    Args:
        world: whose waves.
        begun: the sea's time at which t is 0 [s].

    Returns:
        A mapping for each wave that moves.
    """
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


def pack_bed(world: World, center: np.ndarray, low: float) -> dict[str, Any] | None:
    """The bed on rings around a way.

    Args:
        world: whose bed.
        center: `[S, 3]` of the way, world frame [m].
        low: of the lowest of what swims there [m].

    Returns:
        Heights over the rings; None where there is no bed in sight.
    """
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
        "radius": pack_floats(_RADIUS),
        "height": pack_floats(height),
    }


def pack_water(world: World, places: np.ndarray, low: float) -> dict[str, Any]:
    """The water of a page with many robots.

    Args:
        world: in which they are.
        places: `[S, 3]` where they get, world frame [m].
        low: of the lowest of them [m].

    Returns:
        `world`: surface, waves and bed; `current` [m/s]; `floor`: height of the grid [m].
    """
    return {
        "world": {
            "surface": float(world.surface_height),
            "waves": pack_waves(world, 0.0),
            "bed": pack_bed(world, places, low),
        },
        "current": [*world.current],
        "floor": low,
    }
