"""Meshes of the modules, for pictures, with the tabulated volumes.

They look like RoboGen's printed parts (hollow boxes with windows, a U bracket, a servo with its
plate, a slab with two pads; the propeller in its duct and the rounded fin are our own) but are
drawn from the catalogue alone: the outer dimensions are those of a part's boxes, and one free
dimension (a wall, a window, the height of the pads) is solved so that the mesh encloses the part's
tabulated volume. A user's module type is drawn the same way.

A shape is a list of bodies that share no volume, so that no boolean engine is needed. A body is
swept through outlines of equally many points, the corners of a rectangle counting several times; a
hollow box is made of six such walls, with or without a window, open where they meet.

The meshes are pictures: the centre of volume that the physics uses is the catalogue's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import cast

import numpy as np
import trimesh
from numpy.typing import ArrayLike
from scipy.optimize import brentq

from mjx_revolve.body.catalogue import Box, ModuleType, Part

# Segments of a quarter circle: enough to look round at the size of a module.
_ARC = 6
# Corners that agree to this many digits [m] are one corner; the thinnest wall of the catalogue is
# 1 mm.
_DIGITS = 9
# A window takes this share of the room inside the walls.
_WINDOW = 0.62
# A solid of at least this share of a box is drawn as the box; one of less than the least share as a
# shell of that share, since no surface encloses nothing.
_SOLID, _LEAST = 0.999, 1e-3

_Body = np.ndarray  # [m, 3, 3] triangles of a closed surface, normals outwards
_Corners = tuple[np.ndarray, np.ndarray]  # lowest and highest corner of a box, [3] each
_Build = Callable[[float], list[_Body]]


def _outline(
    half_u: float, half_v: float, radius: float = 0.0, center: Sequence[float] = (0.0, 0.0)
) -> np.ndarray:
    """`[n, 2]` rectangle with rounded corners, counter-clockwise; n is the same for all."""
    radius = min(radius, half_u, half_v)
    angle = 0.5 * np.pi * (np.arange(4)[:, None] + np.linspace(0.0, 1.0, _ARC + 1))
    arc = radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    signs = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)])[:, None]
    return (arc + signs * (half_u - radius, half_v - radius) + center).reshape(-1, 2)


def _volume(bodies: Sequence[_Body]) -> float:
    """Volume of all bodies [m³]."""
    mass = trimesh.triangles.mass_properties(np.concatenate(bodies), skip_inertia=True)
    return float(mass.volume)


def _loops(axis: int, outlines: Sequence[tuple[np.ndarray, float]]) -> np.ndarray:
    """`[k, n, 3]` outlines in space.

    Args:
        axis: normal to the outlines: 0, 1 or 2 for x, y, z; their own axes are the two next, in
            cyclic order.
        outlines: `[n, 2]` each [m], with its coordinate along the axis [m].
    """
    order = np.argsort([axis, (axis + 1) % 3, (axis + 2) % 3])
    return np.array([np.insert(line, 0, height, axis=1)[:, order] for line, height in outlines])


def _sides(loops: np.ndarray) -> np.ndarray:
    """`[m, 3, 3]` triangles between each outline of `[k, n, 3]` and the next."""
    start, stop = loops[:-1], loops[1:]
    after = np.roll(start, -1, axis=1), np.roll(stop, -1, axis=1)
    sides = [
        np.stack([start, after[0], stop], axis=2),
        np.stack([after[0], after[1], stop], axis=2),
    ]
    return np.concatenate([side.reshape(-1, 3, 3) for side in sides])


def _fan(loop: np.ndarray) -> np.ndarray:
    """`[n - 2, 3, 3]` triangles inside an outline `[n, 3]`."""
    return np.stack([np.broadcast_to(loop[0], loop[2:].shape), loop[1:-1], loop[2:]], axis=1)


def _sweep(axis: int, *outlines: tuple[np.ndarray, float], closed: bool = False) -> _Body:
    """Body through outlines as of `_loops`.

    Closed, the last joins the first, as around a hole; else both are filled.
    """
    loops = _loops(axis, (*outlines, outlines[0]) if closed else outlines)
    ends = [] if closed else [_fan(loops[0])[:, ::-1], _fan(loops[-1])]
    body = np.concatenate([_sides(loops), *ends])
    return body if _volume([body]) > 0.0 else body[:, ::-1]


def _prism(
    axis: int, low: float, high: float, outline: np.ndarray, hole: np.ndarray | None = None
) -> _Body:
    """Body of one outline along an axis from one coordinate to another, bored by a hole."""
    if hole is None:
        return _sweep(axis, (outline, low), (outline, high))
    rims = (outline, low), (outline, high), (hole, high), (hole, low)
    return _sweep(axis, *rims, closed=True)


def _box(size: ArrayLike) -> _Body:
    """Solid box about the origin."""
    x, y, z = 0.5 * np.asarray(size)
    return _prism(2, -z, z, _outline(x, y))


def _surface(body: _Body) -> trimesh.Trimesh:
    """One mesh of a body, with one vertex per corner point."""
    corners = body.reshape(-1, 3)
    first, index = trimesh.grouping.unique_rows(corners, digits=_DIGITS)
    faces = index.reshape(-1, 3)
    # Where corners count several times, the sweep between them has no width.
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    return trimesh.Trimesh(corners[first], faces, process=False)


def _solve(build: _Build, low: float, high: float, volume: float) -> list[_Body] | None:
    """`build(s)` with `low <= s <= high` that encloses `volume` [m³]; None if there is none."""

    def excess(s: float) -> float:
        return _volume(build(s)) / volume - 1.0

    if low >= high or excess(low) * excess(high) > 0.0:
        return None
    return build(float(brentq(excess, low, high, xtol=1e-15, rtol=1e-12)))


def _shell(
    size: ArrayLike, wall: float, windows: dict[tuple[int, int], tuple[float, float, float]]
) -> list[_Body]:
    """Hollow box about the origin with rounded windows in some of its faces.

    Args:
        size: outer dimensions [m].
        wall: thickness of all walls [m], less than half of the smallest dimension.
        windows: for a face (axis, sign) the window's half widths along the two next axes in cyclic
            order, and the radius of its corners [m].
    """
    halves = 0.5 * np.asarray(size) - wall, 0.5 * np.asarray(size)
    faces = []
    for axis in range(3):
        for sign in (1, -1):
            inner, outer = (
                (_outline(half[(axis + 1) % 3], half[(axis + 2) % 3]), sign * half[axis])
                for half in halves
            )
            if (axis, sign) in windows:
                hole = _outline(*windows[axis, sign])
                rims = (outer, (hole, outer[1]), (hole, inner[1]), inner)
                face = _sides(_loops(axis, rims))
            else:
                loops = _loops(axis, (outer, inner))
                face = np.concatenate([_fan(loops[0]), _fan(loops[1])[:, ::-1]])
            faces.append(face if sign > 0 else face[:, ::-1])
    return [np.concatenate(faces)]


def _crate(half: np.ndarray, wall: float, room: np.ndarray, round_: bool) -> list[_Body]:
    """Hollow box about the origin with a window in each face, a circle or all of the room."""
    windows = {}
    for axis in range(3):
        u, v = room[(axis + 1) % 3], room[(axis + 2) % 3]
        least = min(u, v)
        windows[axis, 1] = windows[axis, -1] = (least,) * 3 if round_ else (u, v, 0.5 * least)
    return _shell(2.0 * half, wall, windows)


def _core(kind: ModuleType, part: Part) -> list[_Body] | None:
    """Box with a wide window in each side wall, a round one in the lid and a closed floor."""
    half = 0.5 * np.asarray(part.boxes[0].size)

    def build(wall: float) -> list[_Body]:
        x, y, z = half - wall
        slit = 0.45 * z
        windows = {(2, 1): (0.55 * min(x, y),) * 3}
        for sign in (1, -1):
            windows[0, sign] = (0.6 * y, slit, slit)
            windows[1, sign] = (slit, 0.6 * x, slit)
        return _shell(2.0 * half, wall, windows)

    return _solve(build, 1e-3 * half.min(), 0.95 * half.min(), part.volume)


def _brick(kind: ModuleType, part: Part) -> list[_Body] | None:
    """Box with a round window in each of its six faces."""
    half = 0.5 * np.asarray(part.boxes[0].size)

    def build(wall: float) -> list[_Body]:
        return _crate(half, wall, _WINDOW * (half - wall), round_=True)

    return _solve(build, 1e-3 * half.min(), 0.95 * half.min(), part.volume)


def _frame(kind: ModuleType, part: Part) -> list[_Body] | None:
    """U bracket: a base plate at -x and two arms along x, bored for the hinge's axis (y)."""
    half_x, half_y, half_z = 0.5 * np.asarray(part.boxes[0].size)
    if kind.hinge is None:
        return None
    axis_x = kind.hinge.anchor[0] - part.position[0]
    bend = half_x - half_z  # where the arms' round ends begin
    bore = 0.4 * half_z
    room = half_z - max(0.0, axis_x - bend)  # from the hinge's axis to the arm's nearest edge
    widest = min(0.9 * half_y, bend - half_z + half_x, axis_x - bore + half_x)
    if room < 1.2 * bore or widest <= 0.0:
        return None

    def build(wall: float) -> list[_Body]:
        base, inside = wall - half_x, half_y - wall
        half, middle = 0.5 * (half_x - base), (0.0, 0.5 * (half_x + base))
        round_, square = (_outline(half_z, half, radius, middle) for radius in (half_z, 0.0))
        arm = np.concatenate([round_[: len(round_) // 2], square[len(square) // 2 :]])
        hole = _outline(bore, bore, bore, (0.0, axis_x))
        arms = [_prism(1, *ends, arm, hole) for ends in ((inside, half_y), (-half_y, -inside))]
        plate = _outline(half_z, 0.5 * (base + half_x), 0.0, (0.0, 0.5 * (base - half_x)))
        body = _sweep(1, *((plate, y) for y in (-half_y, -inside, inside, half_y)))
        body = np.concatenate([body, *arms])
        # Where an arm stands on the plate neither has a surface.
        off, y = abs(body[..., 0] - base).max(axis=1), body[..., 1].mean(axis=1)
        return [body[(off > 10.0**-_DIGITS) | (abs(y) <= inside)]]

    return _solve(build, 1e-3 * half_y, 0.999 * widest, part.volume)


def _servo(kind: ModuleType, part: Part) -> list[_Body] | None:
    """Servo with a cable duct along z, and in front of it, at +x, the plate it is screwed to."""
    if len(part.boxes) != 2:
        return None
    half_x, half_y, half_z = 0.5 * np.asarray(part.boxes[0].size)
    plate = part.boxes[1]
    center, half = np.asarray(plate.position), 0.5 * np.asarray(plate.size)
    back, front = center[0] - half[0], center[0] + half[0]
    covers = half[1] - abs(center[1]) > half_y and half[2] - abs(center[2]) > half_z
    if not covers or not -half_x < back < half_x <= front + 10.0**-_DIGITS:
        return None
    middle = 0.5 * (back - half_x), 0.0  # of the body behind the plate
    half_body = 0.5 * (back + half_x)
    sheet = _prism(
        0, back, front, _outline(half[1], half[2], 0.15 * min(half[1:]), tuple(center[1:]))
    )

    def build(share: float) -> list[_Body]:
        duct = share * half_body, share * half_y, share * min(half_body, half_y)
        outline, hole = _outline(half_body, half_y, 0.0, middle), _outline(*duct, middle)
        return [_prism(2, -half_z, half_z, outline, hole), sheet]

    return _solve(build, 1e-3, 0.9, part.volume)


def _sensor(kind: ModuleType, part: Part) -> list[_Body] | None:
    """Slab with two rounded pads on its +x face.

    The tabulated volume of the touch sensor (2.735e-6 m³) exceeds its collision box (1.970e-6 m³):
    the pads hold the rest and stand out of the box.
    """
    half_x, half_y, half_z = 0.5 * np.asarray(part.boxes[0].size)
    base = np.array([0.36 * half_y, 0.78 * half_z])

    def pad(height: float, middle: float) -> _Body:
        outlines = []
        for angle in np.linspace(0.0, 1.2, 6):
            y, z = base * np.cos(angle) ** 0.7
            outline = _outline(y, z, base.min(), (middle, 0.0))
            outlines.append((outline, half_x + height * np.sin(angle) / np.sin(1.2)))
        return _sweep(0, *outlines)

    def build(height: float) -> list[_Body]:
        pads = [pad(height, sign * 0.5 * half_y) for sign in (1, -1)]
        return [_box(part.boxes[0].size), *pads]

    return _solve(build, 1e-6 * half_y, 2.0 * half_y, part.volume)


def _duct(kind: ModuleType, part: Part) -> list[_Body] | None:
    """Tube along the thrust, and in it a motor with three blades at the end that pushes ahead."""
    if part.thruster is None:
        return None
    axis = int(np.abs(part.thruster.axis).argmax())
    ahead = 1.0 if part.thruster.axis[axis] > 0.0 else -1.0
    half = 0.5 * np.asarray(part.boxes[0].size)
    length, radius = half[axis], min(half[(axis + 1) % 3], half[(axis + 2) % 3])

    def circle(size: float) -> np.ndarray:
        return _outline(size, size, size)

    hub, nose, most = 0.4 * radius, 0.12 * radius, 0.9 * length
    ends = [(nose, -most), (hub, -0.7 * most), (hub, 0.7 * most), (nose, most)]
    motor = _sweep(axis, *((circle(size), height) for size, height in ends))

    # Blades are pitched by 35 degrees and end short of motor and tube: nothing counts twice.
    wide, c, s = 0.55 * radius, np.cos(np.radians(35.0)), np.sin(np.radians(35.0))
    pitch = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    root = 1.01 * hub

    def blade(tip: float, turn: float) -> _Body:
        """Thin plate from the motor to the tip."""
        cos, sin = np.cos(turn), np.sin(turn)
        about = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        plate = _box((tip - root, wide, 0.05 * radius)) @ pitch.T + (0.5 * (tip + root), 0.0, 0.0)
        # Built about z, then z becomes the axis: a turn that keeps the order of the axes.
        order = [(k - axis - 1) % 3 for k in range(3)]
        return (plate @ about.T + (0.0, 0.0, ahead * 0.5 * most))[..., order]

    def build(wall: float) -> list[_Body]:
        inner = radius - wall
        tip = np.sqrt((0.97 * inner) ** 2 - (0.5 * wide * c) ** 2)
        blades = [blade(tip, k * 2.0 * np.pi / 3.0) for k in range(3)]
        return [_prism(axis, -length, length, circle(radius), circle(inner)), motor, *blades]

    return _solve(build, 1e-3 * radius, 0.5 * radius, part.volume)


def _plate(kind: ModuleType, part: Part) -> list[_Body] | None:
    """Flat plate with rounded corners."""
    half = 0.5 * np.asarray(part.boxes[0].size)
    axis = int(half.argmin())
    u, v = half[(axis + 1) % 3], half[(axis + 2) % 3]

    def build(radius: float) -> list[_Body]:
        return [_prism(axis, -half[axis], half[axis], _outline(u, v, radius))]

    return _solve(build, 1e-6 * min(u, v), min(u, v), part.volume)


_SHAPES = {
    ("Core", "core"): _core,
    ("FixedBrick", "brick"): _brick,
    ("ActiveHinge", "frame"): _frame,
    ("ActiveHinge", "servo"): _servo,
    ("TouchSensor", "sensor"): _sensor,
    ("Thruster", "duct"): _duct,
    ("LiftThruster", "duct"): _duct,
    ("Fin", "plate"): _plate,
}


def _outside(box: _Corners, other: _Corners) -> list[_Corners]:
    """The boxes (low, high) that make up `box` without `other`."""
    (low, high), pieces = (np.array(box[0]), np.array(box[1])), []
    if (np.maximum(low, other[0]) >= np.minimum(high, other[1])).any():
        return [(low, high)]
    for axis in range(3):
        if low[axis] < other[0][axis]:
            top = np.where(np.arange(3) == axis, other[0], high)
            pieces.append((low.copy(), top))
            low[axis] = other[0][axis]
        if high[axis] > other[1][axis]:
            bottom = np.where(np.arange(3) == axis, other[1], low)
            pieces.append((bottom, high.copy()))
            high[axis] = other[1][axis]
    return pieces


def _pieces(boxes: Sequence[Box]) -> list[_Corners]:
    """Boxes (low, high) that touch without overlapping and together fill `boxes`."""
    done: list[_Corners] = []
    for box in boxes:
        half, center = 0.5 * np.asarray(box.size), np.asarray(box.position)
        rest = [(center - half, center + half)]
        for other in tuple(done):
            rest = [piece for one in rest for piece in _outside(one, other)]
        done += rest
    return done


def _generic(part: Part) -> list[_Body]:
    """The part's boxes, each hollowed to the same share, with a window in every face.

    The windows let the water in: a sealed shell would displace its whole box. They close as the
    wall grows, so that every volume up to that of the boxes has its shell; a volume beyond it is
    the solid boxes, enlarged about the origin.
    """
    pieces = _pieces(part.boxes)
    share = part.volume / sum(float(np.prod(high - low)) for low, high in pieces)
    share = max(share, _LEAST)
    bodies: list[_Body] = []
    for low, high in pieces:
        half, middle = 0.5 * (high - low), 0.5 * (low + high)

        def build(s: float, half: np.ndarray = half) -> list[_Body]:
            wall = s * half.min()
            return _crate(half, wall, _WINDOW * (1.0 - s) * (half - wall), round_=False)

        shell = None
        if share < _SOLID:
            shell = _solve(build, 1e-5, 1.0 - 1e-5, share * float(np.prod(2.0 * half)))
        if shell is None:
            bodies.append(share ** (1.0 / 3.0) * (_box(2.0 * half) + middle))
        else:
            bodies += [wall + middle for wall in shell]
    return bodies


def part_mesh(kind: ModuleType, part: Part) -> trimesh.Trimesh:
    """Mesh of one part of a module type, with the part's tabulated volume.

    The outer dimensions are those of the part's boxes, except that the pads of a touch sensor, and
    any part with a larger tabulated volume than its boxes, stand out of them. Types and parts of
    the catalogue have a shape of their own; all others (and a part of the catalogue with a volume
    that its own shape cannot have) are hollow boxes with a window in each face. A part that
    displaces less than a thousandth of its boxes is drawn with that thousandth.

    Args:
        kind: the module type; a hinge frame is bored where its axis is.
        part: one of `kind.parts`.

    Returns:
        A closed mesh in the part's frame (origin at the centre of its main box) [m].
    """
    shape = _SHAPES.get((kind.name, part.name))
    bodies = shape(kind, part) if shape and part.volume > 0.0 else None
    # Bodies share no vertex: no edge has more than two faces.
    meshes = [_surface(body) for body in (_generic(part) if bodies is None else bodies)]
    return cast(trimesh.Trimesh, trimesh.util.concatenate(meshes))
