"""Meshes, poses and water as pages receive them: plain values for JSON, with numbers packed."""

from __future__ import annotations

import base64
import hashlib
import json
import math
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from mjx_revolve.engine.robot import Robot
from mjx_revolve.numerics.spatial import continuous_quaternions, matrix_to_quat
from mjx_revolve.view.pieces import make_pieces, mount_piece, smooth_mesh
from mjx_revolve.view.surroundings import bed_rings
from mjx_revolve.water.world import World

if TYPE_CHECKING:
    from mjx_revolve.view.recording import Mark, ReplayRobot

Packed = dict[str, Any]

# A bed that is further below than this is lost in the water's haze [m].
_SIGHT = 25.0
# The bed is drawn on rings from the way's middle to the horizon, of these radii [m].
_RADIUS = np.concatenate([[0.0], np.geomspace(0.1, 1500.0, 109)])


def pack_floats(values: ArrayLike) -> Packed:
    """Packs numbers whole: base64 of little-endian float32."""
    return {"f32": base64.b64encode(np.asarray(values, "<f4").tobytes()).decode()}


def pack_quantized(values: np.ndarray) -> Packed:
    """Packs numbers to 1/32767 of the largest: base64 of int16, and their scale."""
    scale = float(np.abs(values).max(initial=0.0)) / 32767 or 1.0
    whole = np.round(values / scale).astype("<i2")
    return {"i16": base64.b64encode(whole.tobytes()).decode(), "scale": scale}


# --- meshes ---------------------------------------------------------------------------------------


@dataclass
class RobotMeshes:
    """Meshes of a page's robots; robots that look alike share a body, pieces that do a shape.

    Attributes:
        shapes: distinct meshes: vertices [m], normals, and faces of three vertices each, packed.
        bodies: distinct robots: `length` [m]; `tree`, for each moving body its parent (-1 for the
            core), position and quaternion (w first) in the parent's frame, and its hinge's axis;
            `pieces`, each a body, a shape, a colour (0 to 255), position and quaternion in the
            body's frame.
    """

    shapes: list[Packed] = field(default_factory=list)
    bodies: list[Packed] = field(default_factory=list)
    _robots: dict[Robot, int] = field(default_factory=dict)
    _bodies: dict[str, int] = field(default_factory=dict)
    _shapes: dict[bytes, int] = field(default_factory=dict)

    def add(self, robot: Robot) -> int:
        """Index of a robot's body, which is added where it is new."""
        if robot not in self._robots:
            data = self._body(robot)
            self._robots[robot] = self._bodies.setdefault(json.dumps(data), len(self.bodies))
            if self._robots[robot] == len(self.bodies):
                self.bodies.append(data)
        return self._robots[robot]

    def _body(self, robot: Robot) -> Packed:
        assembly = robot.assembly
        position, rotation = assembly.from_parents()
        tree = [
            [int(assembly.parent[k]) - 1,
             *_numbers(position[k], matrix_to_quat(rotation[k]), assembly.axis[k])]
            for k in range(1, len(assembly.parent))
        ]  # fmt: skip
        pieces = []
        for piece in make_pieces(robot.morphology):
            if piece.mark:  # rods and arrows are for pictures at rest
                continue
            body, where, turn = mount_piece(robot, piece)
            color = [round(255 * float(x)) for x in piece.color]
            place = _numbers(where, matrix_to_quat(turn))
            pieces.append([body - 1, self._shape(piece.corners), color, *place])
        return {"length": round(robot.morphology.length, 4), "tree": tree, "pieces": pieces}

    def _shape(self, corners: np.ndarray) -> int:
        key = hashlib.blake2b(np.ascontiguousarray(corners).tobytes(), digest_size=16).digest()
        number = self._shapes.setdefault(key, len(self.shapes))
        if number == len(self.shapes):
            mesh = smooth_mesh(corners)
            parts = {"vertices": mesh.vertices, "normals": mesh.vertex_normals}
            shape: Packed = {name: pack_quantized(np.asarray(x)) for name, x in parts.items()}
            self.shapes.append(shape | {"faces": pack_floats(mesh.faces)})
        return number


def _numbers(*vectors: Iterable[float]) -> list[float]:
    """Numbers as short as a picture needs them."""
    return [round(float(x), 6) for vector in vectors for x in vector]


# --- poses ----------------------------------------------------------------------------------------


def pack_poses(
    times: Sequence[np.ndarray], qpos: Sequence[np.ndarray], steps: Sequence[float]
) -> Packed:
    """Poses of all robots as one text.

    Every number is rounded to a whole number of steps. Only its difference from the pose before is
    kept, in two bytes: first the low ones, then the high ones, packed by zlib. Rounding does not
    add up. Times are kept as they are, in single precision.

    Args:
        times: of each robot `[T]` [s].
        qpos: of each robot `[T, nq]`.
        steps: what positions [m], quaternions [-] and hinges [rad] are rounded to.

    Returns:
        `poses`: the text; `steps`; `origins`: of each robot's positions [m]; `rows`: T of each.
    """
    origins = [rows[0, :3].round(3) for rows in qpos]
    # Differences must fit two bytes, at any speed.
    farthest = max(np.abs(np.diff(rows[:, :3], axis=0)).max(initial=0.0) for rows in qpos)
    steps = (max(steps[0], float(farthest) / 32000), *steps[1:])
    numbers = []
    for rows, origin in zip(qpos, origins, strict=True):
        position = (rows[:, :3] - origin) / steps[0]
        turn = continuous_quaternions(rows[:, 3:7]) / steps[1]
        # Angles are those of hinges, at most a turn or two.
        hinges = np.clip(rows[:, 7:], -30, 30) / steps[2]
        whole = np.round(np.c_[position, turn, hinges]).astype(np.int64)
        numbers.append(np.diff(whole, axis=0, prepend=0).T.ravel())  # number after number
    low_high = np.concatenate(numbers).astype("<i2").view(np.uint8).reshape(-1, 2)
    raw = np.concatenate(times).astype("<f4").tobytes() + low_high.T.tobytes()
    return {
        "poses": base64.b64encode(zlib.compress(raw, 6)).decode(),
        "steps": steps,
        "origins": [origin.tolist() for origin in origins],
        "rows": [len(rows) for rows in qpos],
    }


# --- water ----------------------------------------------------------------------------------------


def pack_water(world: World, path: np.ndarray, low: float, begun: float = 0.0) -> Packed:
    """The water of a page.

    Args:
        world: surface, waves, bed.
        path: `[S, 3]` where robots get, world frame [m].
        low: z of their lowest point [m].
        begun: the sea's time when the page's is 0 [s].

    Returns:
        `world`: surface, waves and bed; `current` [m/s].
    """
    sea = {
        "surface": float(world.surface_height),
        "waves": pack_waves(world, begun),
        "bed": _pack_bed(world, path, low),
    }
    return {"world": sea, "current": [*world.current]}


def pack_waves(world: World, begun: float = 0.0) -> list[dict[str, float]]:
    """The world's waves that move, each as a cos(k·p - ωt + φ).

    Args:
        world: the waves, and the current that carries them.
        begun: the sea's time at which t is 0 [s].

    Returns:
        A mapping for each wave: k, its direction x and y, amplitude, omega, phase.
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


def _pack_bed(world: World, path: np.ndarray, low: float) -> Packed | None:
    """Heights of the bed on rings around a path; None where there is no bed in sight."""
    if world.bed is None:
        return None
    middle = (path[:, :2].min(0) + path[:, :2].max(0)) / 2
    height = bed_rings(world.bed, middle, _RADIUS)[..., 2]
    reach = float(np.ptp(path[:, :2], axis=0).max()) + _SIGHT
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


def replay_data(
    robots: Sequence[ReplayRobot],
    floor: float,
    marks: Sequence[Mark] = (),
    leap: float | None = None,
    begun: float = 0.0,
) -> Packed:
    """What a replay's page receives but for the poses, as plain values for JSON.

    Args:
        robots: in one world.
        floor: z below all of them, where the grid is drawn [m].
        marks: places to show.
        leap: see `viewer.write_colony_page`.
        begun: the sea's time when the page's is 0 [s].
    """
    meshes = RobotMeshes()
    listed = [
        {
            "name": one.name,
            "body": meshes.add(one.robot),
            "start": round(one.appears, 4),
            "end": None if one.end is None else round(float(one.end), 4),
            "info": {
                k: x if isinstance(x, str) else f"{float(x):.4g}" for k, x in one.info.items()
            },
        }
        for one in robots
    ]
    places = np.concatenate([np.asarray(one.qpos, float)[:, :3] for one in robots])
    begin = min(round(one.appears, 4) for one in robots)
    ends = [float(one.end) for one in robots if one.end is not None]
    return {
        "size": float(np.median([one.robot.morphology.length for one in robots])),
        "begin": begin,
        "last": max([begin, *ends, *(float(one.time[-1]) for one in robots)]),
        "low": places.min(0).tolist(),
        "high": places.max(0).tolist(),
        "floor": floor,
        "robots": listed,
        "shapes": meshes.shapes,
        "bodies": meshes.bodies,
        "marks": [{"name": m.name, "place": [*m.place], "radius": m.radius} for m in marks],
        "leap": leap,
        **pack_water(robots[0].robot.world, places, floor, begun),
    }
