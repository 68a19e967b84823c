"""A robot as triangles: what pictures, films and pages draw of it."""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import trimesh

from mjx_revolve.body.module_types import ModuleType
from mjx_revolve.body.morphology import Morphology
from mjx_revolve.body.placement import Module
from mjx_revolve.body.solids import part_mesh
from mjx_revolve.view.palette import HINGE_AXIS, MODULES, THRUST_AXIS

if TYPE_CHECKING:
    from mjx_revolve.engine.robot import Robot

# Parts that move with a hinge are drawn darker than the frame, or the hinge could not be made out.
_MOVING = 0.72
# Hinge axes are drawn as thin rods: their radius and half length [m].
_ROD = (0.0011, 0.025)
# Arrows of thrusts: radius and length of the shaft and of the head [m].
_ARROW = (0.0011, 0.034, 0.0036, 0.010)
# Edges of a part are sharp where its faces turn by more than this.
_CREASE = math.radians(35.0)
_MOST_DRAWN = 500  # types of modules with cached meshes; some 100 kB each


@dataclass(frozen=True)
class Scene:
    """What is drawn: `m` triangles in the world frame.

    Attributes:
        corners: `[m, 3, 3]` [m].
        color: `[m, 3]` red, green, blue from 0 to 1.
        part: `[m]` number of the piece that the triangle belongs to.
    """

    corners: np.ndarray
    color: np.ndarray
    part: np.ndarray

    def bounds(self, view: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lower left and upper right corner `[2]` of the picture in a `raster.make_view` [m]."""
        points = self.corners.reshape(-1, 3) @ view[:2].T
        return points.min(axis=0), points.max(axis=0)


@dataclass(frozen=True)
class Piece:
    """One part of a module, the rod that shows a hinge's axis, or the arrow of a thrust.

    Attributes:
        module: number of the module in its morphology.
        part: the part of the module that carries it.
        corners: `[m, 3, 3]` triangles, module frame at hinge angle 0 [m]; one array for all that
            look alike.
        color: `[3]` red, green, blue from 0 to 1.
        mark: whether it is a rod or an arrow, and nothing to touch.
    """

    module: int
    part: int
    corners: np.ndarray
    color: np.ndarray
    mark: bool = False


def make_pieces(morphology: Morphology) -> list[Piece]:
    """All parts of a morphology, hinges' axes and thrusts.

    Args:
        morphology: the robot's modules; those without a colour have that of what they are for.

    Returns:
        The pieces, in the order of the modules and their parts.
    """
    pieces = []
    for number, module in enumerate(morphology.modules):
        kind = module.kind
        rgb = np.clip(np.asarray(module.rgb or MODULES[_role(module)], float), 0.0, 1.0)
        for k, triangles in enumerate(_triangles(kind)):
            shade = rgb * (_MOVING if kind.hinge is not None and k > 0 else 1.0)
            pieces.append(Piece(number, k, triangles, shade))
        if kind.hinge is not None:
            radius, half = _ROD
            profile = [(-half, 0.0), (-half, radius), (half, radius), (half, 0.0)]
            rod = _spindle(kind.hinge.axis, profile) + np.asarray(kind.hinge.anchor)
            pieces.append(Piece(number, 0, rod, np.array(HINGE_AXIS), mark=True))
        for k, part in enumerate(kind.parts):
            if part.thruster is not None:
                radius, shaft, wide, head = _ARROW
                profile = [(0.0, 0.0), (0.0, radius), (shaft, radius), (shaft, wide)]
                arrow = _spindle(part.thruster.axis, [*profile, (shaft + head, 0.0)])
                arrow = arrow + np.asarray(part.position) + np.asarray(part.thruster.position)
                pieces.append(Piece(number, k, arrow, np.array(THRUST_AXIS), mark=True))
    return pieces


def _role(module: Module) -> str:
    """What a module is for, as far as its colour goes."""
    kind = module.kind
    roles = {
        "core": module.parent < 0, "hinge": kind.hinge is not None, "sensor": kind.sensor,
        "thruster": kind.is_thruster, "fin": kind.is_fin,
    }  # fmt: skip
    return next((role for role, is_one in roles.items() if is_one), "brick")


_DRAWN: dict[Hashable, list[np.ndarray]] = {}  # solving for a part's volume takes a while


def _triangles(kind: ModuleType) -> list[np.ndarray]:
    """The parts' meshes, module frame; the same arrays for all types that look alike."""
    drawn = tuple((p.name, p.boxes, p.volume, p.position, p.thruster) for p in kind.parts)
    key = (kind.name, kind.hinge, drawn)
    if key not in _DRAWN:
        if len(_DRAWN) >= _MOST_DRAWN:
            _DRAWN.clear()
        _DRAWN[key] = [part_mesh(kind, p).triangles + np.asarray(p.position) for p in kind.parts]
    return _DRAWN[key]


def smooth_mesh(corners: np.ndarray) -> trimesh.Trimesh:
    """A mesh for shading: smooth but for its edges, along which it is cut open.

    Args:
        corners: `[m, 3, 3]` triangles [m].

    Returns:
        The mesh; `vertex_normals` are those to shade with.
    """
    mesh = trimesh.Trimesh(**trimesh.triangles.to_kwargs(corners))
    return trimesh.graph.smooth_shade(mesh, angle=_CREASE, facet_minarea=None)


def mount_piece(robot: Robot, piece: Piece) -> tuple[int, np.ndarray, np.ndarray]:
    """Where a piece sits on a robot.

    Args:
        robot: from `build_robot`.
        piece: of its morphology.

    Returns:
        The MuJoCo body that carries it, and position `[3]` [m] and rotation `[3, 3]` of the piece's
        module frame, body frame.
    """
    fluid = robot.fluid
    k = int(np.flatnonzero(fluid.module == piece.module)[piece.part])
    part = robot.morphology.modules[piece.module].kind.parts[piece.part]
    # The table has the centre of the part's main box, which is the part's own.
    place = fluid.position[k] - fluid.rotation[k] @ np.asarray(part.position)
    return int(fluid.body[k]), place, fluid.rotation[k]


def place_pieces(pieces: Sequence[Piece], frames: Iterable[tuple[np.ndarray, np.ndarray]]) -> Scene:
    """Puts pieces together.

    Args:
        pieces: from `make_pieces`.
        frames: of each piece position `[3]` [m] and rotation `[3, 3]` of its module's frame in the
            world.

    Returns:
        The scene.
    """
    corners, color, part = [], [], []
    for number, (piece, (position, rotation)) in enumerate(zip(pieces, frames, strict=True)):
        corners.append(piece.corners @ rotation.T + position)
        color.append(np.broadcast_to(piece.color, (len(piece.corners), 3)))
        part.append(np.full(len(piece.corners), number))
    return Scene(np.concatenate(corners), np.concatenate(color), np.concatenate(part))


def rest_scene(morphology: Morphology) -> Scene:
    """All parts of the morphology at rest.

    Args:
        morphology: the robot's modules.

    Returns:
        The scene, the core's frame at the world's origin.
    """
    frames = [(np.asarray(m.position), np.asarray(m.rotation)) for m in morphology.modules]
    pieces = make_pieces(morphology)
    return place_pieces(pieces, [frames[piece.module] for piece in pieces])


def _spindle(axis: Sequence[float], profile: Sequence[tuple[float, float]]) -> np.ndarray:
    """Six-sided solid of revolution `[m, 3, 3]` about a direction through the origin [m].

    Args:
        axis: the direction.
        profile: places along it and radii [m], from a point on the axis to another.
    """
    turn = trimesh.geometry.align_vectors([0.0, 0.0, 1.0], axis)
    line = [(radius, place) for place, radius in profile]
    return np.asarray(trimesh.creation.revolve(line, sections=6, transform=turn).triangles)
