"""The project's own meshes of the modules: what a picture shows, with the tabulated volume.

They look like RoboGen's printed parts (hollow boxes with windows, a U bracket, a servo with its
plate, a slab with two pads; the propeller in its duct and the rounded fin are our own) but are
drawn from the catalogue alone: the outer dimensions are those of a part's boxes, and one free
dimension (a wall, a window, the height of the pads) is solved so that the mesh encloses the part's
tabulated volume. A user's module type is drawn the same way.

A surface is put together from flat faces and from bands between two closed loops of points. A loop
is four quadrants, counter-clockwise about the direction in which its face looks; the quadrants let
a rectangle (one point each) and a rounded opening (an arc each) be joined without any search. Every
mesh is closed, wound one way and needs no boolean engine.

The meshes are pictures: the centre of volume that the physics uses is the catalogue's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import cast

import numpy as np
import trimesh
from numpy.typing import ArrayLike
from scipy.optimize import brentq

from mjx_revolve.body.catalogue import Box, ModuleType, Part
from mjx_revolve.body.meshes import mesh_volume

# Segments of a quarter circle: enough to look round at the size of a module.
_ARC = 6
# Corners nearer than this [m] are one corner; the thinnest wall of the catalogue is 1 mm.
_MERGE = 1e-9
# A window takes this share of the room inside the walls.
_WINDOW = 0.62
# A solid of at least this share of a box is drawn as the box; one of less than the least share as a
# shell of that share, since no surface encloses nothing.
_SOLID, _LEAST = 0.999, 1e-3

_Loop = list[np.ndarray]  # four quadrants, [n, 2] in a face's plane or [n, 3] in space
_Triangles = list[np.ndarray]  # [3, 3] each
_Corners = tuple[np.ndarray, np.ndarray]  # lowest and highest corner of a box, [3] each
_Build = Callable[[float], _Triangles]


def _rounded(half_u: float, half_v: float, radius: float = 0.0) -> _Loop:
    """Rectangle with rounded corners about the origin of a plane, counter-clockwise."""
    radius = min(radius, half_u, half_v)
    loop = []
    for k, sign in enumerate(((1, 1), (-1, 1), (-1, -1), (1, -1))):
        center = np.multiply(sign, (half_u - radius, half_v - radius))
        angle = np.linspace(0.5 * np.pi * k, 0.5 * np.pi * (k + 1), _ARC + 1)
        arc = center + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        loop.append(arc if radius > 0.0 else center[None])
    return loop


def _place(loop: _Loop, axis: int, height: float, center: ArrayLike = (0.0, 0.0)) -> _Loop:
    """Puts a plane loop on a face that looks along +`axis`.

    Args:
        loop: four quadrants `[n, 2]` [m].
        axis: 0, 1 or 2 for x, y, z.
        height: the face's coordinate along `axis` [m].
        center: where the loop's origin lies along the two next axes, in cyclic order [m].
    """
    order = np.argsort([axis, (axis + 1) % 3, (axis + 2) % 3])
    return [
        np.column_stack([np.full(len(one), height), one + np.asarray(center)])[:, order]
        for one in loop
    ]


def _band(outer: _Loop, inner: _Loop) -> _Triangles:
    """Triangles between two loops; they look along the loops' direction if `inner` is within."""
    triangles = []
    for k in range(4):
        a, b = outer[k], inner[k]
        for i in range(len(a) - 1):
            triangles.append(np.stack([a[i], a[i + 1], b[min(i, len(b) - 1)]]))
        for j in range(len(b) - 1):
            triangles.append(np.stack([a[min(j + 1, len(a) - 1)], b[j + 1], b[j]]))
        a_next, b_next = outer[(k + 1) % 4][0], inner[(k + 1) % 4][0]
        triangles += [np.stack([a[-1], a_next, b[-1]]), np.stack([a_next, b_next, b[-1]])]
    return triangles


def _chain(*loops: _Loop) -> _Triangles:
    """Bands from each loop to the next."""
    return [one for a, b in pairwise(loops) for one in _band(a, b)]


def _face(points: Sequence[Sequence[float]] | _Loop, look: ArrayLike) -> _Triangles:
    """Convex flat face `[n, 3]` (or a loop) as a fan of triangles that look along `look`."""
    rim = np.concatenate([np.reshape(one, (-1, 3)) for one in points])
    fan = [np.stack([rim[0], rim[i], rim[i + 1]]) for i in range(1, len(rim) - 1)]
    # The area of the whole face tells the winding even where a triangle of the fan has none.
    area = np.sum([np.cross(one[1] - one[0], one[2] - one[0]) for one in fan], axis=0)
    return fan if np.dot(area, look) > 0 else [one[::-1] for one in fan]


def _mirror(triangles: _Triangles, axis: int) -> _Triangles:
    """The triangles reflected in the plane through the origin across `axis`."""
    flip = np.where(np.arange(3) == axis, -1.0, 1.0)
    return [one[::-1] * flip for one in triangles]


def _surface(triangles: _Triangles) -> trimesh.Trimesh:
    """One mesh of the triangles, with one vertex per corner point."""
    corners = np.concatenate(triangles)
    grid = np.round(corners / _MERGE).astype(np.int64)
    _, first, index = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    faces = index.reshape(-1, 3)
    # Where arcs of neighbouring quadrants meet, the band between them has no width.
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    return trimesh.Trimesh(corners[first], faces, process=False)


def _solve(build: _Build, low: float, high: float, volume: float) -> _Triangles | None:
    """`build(s)` with `low <= s <= high` that encloses `volume` [m³]; None if there is none."""

    def excess(s: float) -> float:
        triangles = np.concatenate(build(s))
        return mesh_volume((triangles, np.arange(len(triangles)).reshape(-1, 3))) / volume - 1.0

    if low >= high or excess(low) * excess(high) > 0.0:
        return None
    return build(float(brentq(excess, low, high, xtol=1e-15, rtol=1e-12)))


def _shell(
    size: ArrayLike, wall: float, windows: dict[tuple[int, int], tuple[float, float, float]]
) -> _Triangles:
    """Hollow box about the origin with rounded windows in some of its faces.

    Args:
        size: outer dimensions [m].
        wall: thickness of all walls [m], less than half of the smallest dimension.
        windows: for a face (axis, sign) the window's half widths along the two next axes in cyclic
            order, and the radius of its corners [m].
    """
    outer = 0.5 * np.asarray(size)
    inner = outer - wall
    triangles = []
    for axis in range(3):
        u, v, look = (axis + 1) % 3, (axis + 2) % 3, np.eye(3)[axis]
        rim = _place(_rounded(outer[u], outer[v]), axis, outer[axis])
        floor = _place(_rounded(inner[u], inner[v]), axis, inner[axis])
        for sign in (1, -1):
            if (axis, sign) in windows:
                hole = _rounded(*windows[axis, sign])
                side = _chain(
                    rim, _place(hole, axis, outer[axis]), _place(hole, axis, inner[axis]), floor
                )
            else:
                side = _face(rim, look) + _face(floor, -look)
            triangles += side if sign > 0 else _mirror(side, axis)
    return triangles


def _box(size: ArrayLike) -> _Triangles:
    """Solid box about the origin."""
    half = 0.5 * np.asarray(size)
    low, high = (_place(_rounded(half[0], half[1]), 2, sign * half[2]) for sign in (-1, 1))
    return _face(low, (0, 0, -1)) + _chain(low, high) + _face(high, (0, 0, 1))


def _core(kind: ModuleType, part: Part) -> _Triangles | None:
    """Box with a wide window in each side wall, a round one in the lid and a closed floor."""
    half = 0.5 * np.asarray(part.boxes[0].size)

    def build(wall: float) -> _Triangles:
        x, y, z = half - wall
        slit = 0.45 * z
        windows = {(2, 1): (0.55 * min(x, y),) * 3}
        for sign in (1, -1):
            windows[0, sign] = (0.6 * y, slit, slit)
            windows[1, sign] = (slit, 0.6 * x, slit)
        return _shell(2.0 * half, wall, windows)

    return _solve(build, 1e-3 * half.min(), 0.95 * half.min(), part.volume)


def _brick(kind: ModuleType, part: Part) -> _Triangles | None:
    """Box with a round window in each of its six faces."""
    half = 0.5 * np.asarray(part.boxes[0].size)

    def build(wall: float) -> _Triangles:
        room = _WINDOW * (half - wall)
        windows = {}
        for axis in range(3):
            radius = min(room[(axis + 1) % 3], room[(axis + 2) % 3])
            windows[axis, 1] = windows[axis, -1] = (radius, radius, radius)
        return _shell(2.0 * half, wall, windows)

    return _solve(build, 1e-3 * half.min(), 0.95 * half.min(), part.volume)


def _frame(kind: ModuleType, part: Part) -> _Triangles | None:
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

    def build(wall: float) -> _Triangles:
        base, inside = wall - half_x, half_y - wall

        def arm(start: float, y: float) -> _Loop:
            half = 0.5 * (half_x - start)
            loop = _rounded(half_z, half, half_z)[:2] + _rounded(half_z, half)[2:]
            return _place(loop, 1, y, (0.0, 0.5 * (half_x + start)))

        outer, inner = arm(-half_x, half_y), arm(base, inside)
        hole = _rounded(bore, bore, bore)
        side = _chain(outer, *(_place(hole, 1, y, (0.0, axis_x)) for y in (half_y, inside)), inner)
        ends = np.concatenate(outer[:2]), np.concatenate(inner[:2])
        for a, b in zip(pairwise(ends[0]), pairwise(ends[1]), strict=True):
            if not np.allclose(*a, rtol=0.0, atol=_MERGE):
                side += _face([*a, *b[::-1]], (a[0] + a[1]) / 2 - (bend, half_y, 0.0))
        for z in (half_z, -half_z):
            strip = [(-half_x, half_y, z), (base, inside, z), (bend, inside, z), (bend, half_y, z)]
            side += _face(strip, (0, 0, z))
        triangles = side + _mirror(side, 1)
        for x, y, look in ((-half_x, half_y, -1), (base, inside, 1)):
            plate = [(x, y, half_z), (x, -y, half_z), (x, -y, -half_z), (x, y, -half_z)]
            triangles += _face(plate, (look, 0, 0))
        for z in (half_z, -half_z):
            strip = [
                (-half_x, half_y, z), (base, inside, z), (base, -inside, z), (-half_x, -half_y, z)
            ]  # fmt: skip
            triangles += _face(strip, (0, 0, z))
        return triangles

    return _solve(build, 1e-3 * half_y, 0.999 * widest, part.volume)


def _servo(kind: ModuleType, part: Part) -> _Triangles | None:
    """Servo with a cable duct along z, and in front of it, at +x, the plate it is screwed to."""
    if len(part.boxes) != 2:
        return None
    half_x, half_y, half_z = 0.5 * np.asarray(part.boxes[0].size)
    plate = part.boxes[1]
    center, half = np.asarray(plate.position), 0.5 * np.asarray(plate.size)
    back, front = center[0] - half[0], center[0] + half[0]
    covers = half[1] - abs(center[1]) > half_y and half[2] - abs(center[2]) > half_z
    if not covers or not -half_x < back < half_x <= front + _MERGE:
        return None
    middle = 0.5 * (back - half_x)  # of the body behind the plate

    def build(share: float) -> _Triangles:
        body = [_place(_rounded(half_y, half_z), 0, x) for x in (-half_x, back)]
        outline = _rounded(half[1], half[2], 0.15 * min(half[1:]))
        sheet = [_place(outline, 0, x, center[1:]) for x in (back, front)]
        triangles = _face(body[0], (-1, 0, 0)) + _chain(body[1], *sheet)
        triangles += _face(sheet[1], (1, 0, 0))
        for y in (half_y, -half_y):
            side = [(-half_x, y, half_z), (-half_x, y, -half_z), (back, y, -half_z)]
            triangles += _face([*side, (back, y, half_z)], (0, y, 0))
        half_body = 0.5 * (back + half_x)
        duct = _rounded(share * half_body, share * half_y, share * min(half_body, half_y))
        rim = _rounded(half_body, half_y)
        return triangles + _chain(
            *(
                _place(loop, 2, z, (middle, 0.0))
                for loop, z in ((rim, half_z), (duct, half_z), (duct, -half_z), (rim, -half_z))
            )
        )

    return _solve(build, 1e-3, 0.9, part.volume)


def _sensor(kind: ModuleType, part: Part) -> _Triangles | None:
    """Slab with two rounded pads on its +x face.

    The tabulated volume of the touch sensor (2.735e-6 m³) exceeds its collision box (1.970e-6 m³):
    the pads hold the rest and stand out of the box.
    """
    half_x, half_y, half_z = 0.5 * np.asarray(part.boxes[0].size)
    corners = [(y, z) for y in (half_y, -half_y) for z in (half_z, -half_z)]
    base = np.array([0.36 * half_y, 0.78 * half_z])

    def build(height: float) -> _Triangles:
        back = [(-half_x, *corners[k]) for k in (0, 1, 3, 2)]
        triangles = _face(back, (-1, 0, 0))
        for y in (half_y, -half_y):
            side = [(x, y, z) for x, z in ((-half_x, half_z), (-half_x, -half_z))]
            triangles += _face([*side, (half_x, y, -half_z), (half_x, y, half_z)], (0, y, 0))
        for z in (half_z, -half_z):
            # The front is two halves with a pad each, so their common edge ends in this face.
            side = [(-half_x, half_y, z), (-half_x, -half_y, z), (half_x, -half_y, z)]
            triangles += _face([*side, (half_x, 0.0, z), (half_x, half_y, z)], (0, 0, z))
        middle = (0.5 * half_y, 0.0)
        pad = [_place(_rounded(0.5 * half_y, half_z), 0, half_x, middle)]
        for angle in np.linspace(0.0, 1.2, 6):
            y, z = base * np.cos(angle) ** 0.7
            loop = _rounded(y, z, base.min())
            pad.append(_place(loop, 0, half_x + height * np.sin(angle) / np.sin(1.2), middle))
        front = _chain(*pad) + _face(pad[-1], (1, 0, 0))
        return triangles + front + _mirror(front, 1)

    return _solve(build, 1e-6 * half_y, 2.0 * half_y, part.volume)


def _duct(kind: ModuleType, part: Part) -> _Triangles | None:
    """Tube along the thrust, and in it a motor with three blades at the end that pushes ahead."""
    if part.thruster is None:
        return None
    axis = int(np.abs(part.thruster.axis).argmax())
    ahead = 1.0 if part.thruster.axis[axis] > 0.0 else -1.0
    half = 0.5 * np.asarray(part.boxes[0].size)
    length, radius = half[axis], min(half[(axis + 1) % 3], half[(axis + 2) % 3])

    def circle(size: float, height: float) -> _Loop:
        return _place(_rounded(size, size, size), axis, height)

    hub, nose, most = 0.4 * radius, 0.12 * radius, 0.9 * length
    ends = [(nose, -most), (hub, -0.7 * most), (hub, 0.7 * most), (nose, most)]
    motor = [circle(size, height) for size, height in ends]
    look = np.eye(3)[axis]
    inside = _face(motor[0], -look) + _chain(*motor) + _face(motor[-1], look)

    # Blades are pitched by 35 degrees and end short of motor and tube: nothing counts twice.
    wide, c, s = 0.55 * radius, np.cos(np.radians(35.0)), np.sin(np.radians(35.0))
    pitch = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    root = 1.01 * hub

    def blade(tip: float, turn: float) -> _Triangles:
        """Thin plate from the motor to the tip."""
        cos, sin = np.cos(turn), np.sin(turn)
        about = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        at = np.array([0.5 * (tip + root), 0.0, 0.0])
        height = np.array([0.0, 0.0, ahead * 0.5 * most])
        # Built about z, then z becomes the axis: a turn that keeps the order of the axes.
        order = [(k - axis - 1) % 3 for k in range(3)]
        plate = _box((tip - root, wide, 0.05 * radius))
        return [((one @ pitch.T + at) @ about.T + height)[:, order] for one in plate]

    def build(wall: float) -> _Triangles:
        inner = radius - wall
        rims = [
            circle(size, height)
            for size, height in (
                (inner, -length), (radius, -length), (radius, length), (inner, length)
            )
        ]  # fmt: skip
        triangles = _chain(*rims, rims[0]) + inside
        for k in range(3):
            tip = np.sqrt((0.97 * inner) ** 2 - (0.5 * wide * c) ** 2)
            triangles += blade(tip, k * 2.0 * np.pi / 3.0)
        return triangles

    return _solve(build, 1e-3 * radius, 0.5 * radius, part.volume)


def _plate(kind: ModuleType, part: Part) -> _Triangles | None:
    """Flat plate with rounded corners."""
    half = 0.5 * np.asarray(part.boxes[0].size)
    axis = int(half.argmin())
    u, v, look = half[(axis + 1) % 3], half[(axis + 2) % 3], np.eye(3)[axis]

    def build(radius: float) -> _Triangles:
        low, high = (_place(_rounded(u, v, radius), axis, sign * half[axis]) for sign in (-1, 1))
        return _face(low, -look) + _chain(low, high) + _face(high, look)

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


def _generic(part: Part) -> list[_Triangles]:
    """The part's boxes, each hollowed to the same share, with a window in every face.

    The windows let the water in: a sealed shell would displace its whole box. They close as the
    wall grows, so that every volume up to that of the boxes has its shell; a volume beyond it is
    the solid boxes, enlarged about the origin.
    """
    pieces = _pieces(part.boxes)
    share = part.volume / sum(float(np.prod(high - low)) for low, high in pieces)
    share = max(share, _LEAST)
    shells = []
    for low, high in pieces:
        half = 0.5 * (high - low)

        def build(s: float, half: np.ndarray = half) -> _Triangles:
            wall = s * half.min()
            room = _WINDOW * (1.0 - s) * (half - wall)
            windows = {}
            for axis in range(3):
                u, v = room[(axis + 1) % 3], room[(axis + 2) % 3]
                windows[axis, 1] = windows[axis, -1] = (u, v, 0.5 * min(u, v))
            return _shell(2.0 * half, wall, windows)

        shell = None
        if share < _SOLID:
            shell = _solve(build, 1e-5, 1.0 - 1e-5, share * float(np.prod(2.0 * half)))
        if shell is None:
            scale = share ** (1.0 / 3.0)
            shells.append([scale * (one + 0.5 * (low + high)) for one in _box(2.0 * half)])
        else:
            shells.append([one + 0.5 * (low + high) for one in shell])
    return shells


def part_mesh(kind: ModuleType, part: Part) -> trimesh.Trimesh:
    """Mesh of one part of a module type, with the part's tabulated volume.

    The outer dimensions are those of the part's boxes, except that the pads of a touch sensor, and
    any part whose tabulated volume exceeds that of its boxes, stand out of them. Types and parts of
    the catalogue have a shape of their own; all others (and a part of the catalogue whose volume
    its own shape cannot reach) are hollow boxes with a window in each face. A part that displaces
    less than a thousandth of its boxes is drawn with that thousandth.

    Args:
        kind: the module type; a hinge frame is bored where its axis is.
        part: one of `kind.parts`.

    Returns:
        A closed mesh in the part's frame (origin at the centre of its main box) [m].
    """
    shape = _SHAPES.get((kind.name, part.name))
    triangles = shape(kind, part) if shape and part.volume > 0.0 else None
    if triangles is not None:
        return _surface(triangles)
    # Pieces that touch stay bodies of their own: no edge has more than two faces.
    pieces = [_surface(piece) for piece in _generic(part)]
    return (
        pieces[0] if len(pieces) == 1 else cast(trimesh.Trimesh, trimesh.util.concatenate(pieces))
    )
