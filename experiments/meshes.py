"""Triangle meshes read from files, and the refusal of those whose volume would be none.

Buoyancy asks how much water a part displaces. trimesh reads a mesh and integrates its volume, which
is that of a solid only where the surface is closed, wound one way, looks outwards and does not
cover a point twice. `check_mesh` refuses all others, because a wrong volume is a wrong buoyancy and
nothing later would notice. (`experiments/module_volumes.py` holds the formula of the thesis.)
"""

from __future__ import annotations

import io
import math
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Annotated

import numpy as np
import trimesh
from annotated_types import Unit
from numpy.typing import ArrayLike

from mjx_revolve.inputs.errors import InputError, reading
from mjx_revolve.inputs.files import resolve_inside
from mjx_revolve.inputs.schema import Positive, read
from mjx_revolve.inputs.trust import audit

# A mesh is a `trimesh.Trimesh` or a pair (vertices [n, 3], faces [m, 3]).
Mesh = trimesh.Trimesh | tuple[ArrayLike, ArrayLike]

_FORMATS = (".stl", ".obj", ".ply")
# The largest printed module of Revolve is a few MB as STL; what is larger is not a module.
_MAX_BYTES = 64 * 2**20
# STL stores every corner three to six times in single precision (6e-8 of the value, ASCII files
# are coarser); corners that agree to this many digits of the largest extent are one corner.
_DIGITS = 6
# Volume over (area)^1.5 is 0.094 for a sphere and 7e-6 for a square sheet one thousandth as thick
# as it is wide; below this the mesh is a sheet without thickness.
_FLAT = 1e-9
# Faces of a body behind which we ask whether it lies inside another one.
_SAMPLES = 32


def _surface(mesh: Mesh) -> trimesh.Trimesh:
    """The mesh as it is, whatever it is, as trimesh's own."""
    vertices, faces = (mesh.vertices, mesh.faces) if isinstance(mesh, trimesh.Trimesh) else mesh
    vertices, faces = np.asarray(vertices, float), np.asarray(faces)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise InputError("mesh: vertices", "shape [n, 3]", list(vertices.shape))
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise InputError("mesh: faces", "triangles [m, 3]", list(faces.shape))
    if faces.size and not np.issubdtype(faces.dtype, np.integer):
        raise InputError("mesh: faces", "whole numbers", faces.dtype)
    return trimesh.Trimesh(vertices, faces.astype(np.int64), process=False)


def _volume_and_center(mesh: Mesh) -> tuple[float, np.ndarray | None]:
    """Volume [m³], and its centre `[3]` [m] where it is that of a solid and not of a sheet."""
    surface = _surface(mesh)
    # About a near point, lest what lies far from the origin loses its digits.
    near = surface.vertices.mean(axis=0) if len(surface.vertices) else np.zeros(3)
    triangles = (surface.vertices - near)[surface.faces]
    with np.errstate(all="ignore"):
        mass = trimesh.triangles.mass_properties(triangles, skip_inertia=True)
        area = np.abs(trimesh.triangles.area(triangles)).sum()
    solid = abs(mass.volume) > _FLAT * area**1.5
    return float(mass.volume), near + mass.center_mass if solid else None


def mesh_volume(mesh: Mesh) -> float:
    """Volume enclosed by a closed mesh.

    Args:
        mesh: a `trimesh.Trimesh`, or (vertices `[n, 3]` [m], faces `[m, 3]`). Faces look outwards
            (counter-clockwise seen from outside); inner voids are surfaces that look into the void.

    Returns:
        The volume [m³]; negative when the mesh is inside out. Meaningless for an open mesh: see
        `check_mesh`.

    Raises:
        InputError: the arrays do not have the shapes of a triangle mesh.
    """
    return _volume_and_center(mesh)[0]


def mesh_center_of_volume(mesh: Mesh) -> np.ndarray:
    """Centre of the volume enclosed by a closed mesh: where buoyancy acts.

    Args:
        mesh: as for `mesh_volume`.

    Returns:
        `[3]` the centre in the mesh's own frame [m].

    Raises:
        InputError: the arrays do not have the shapes of a triangle mesh, or the mesh encloses no
            volume.
    """
    volume, center = _volume_and_center(mesh)
    if center is None:
        raise InputError("mesh", "a mesh that encloses a volume", f"{volume:g} m3")
    return center


def _bodies(mesh: trimesh.Trimesh) -> list[trimesh.Trimesh]:
    """Splits a mesh into bodies that share no vertex."""
    label = trimesh.graph.connected_component_labels(mesh.edges, node_count=len(mesh.vertices))
    label = label[mesh.faces[:, 0]]
    return [
        trimesh.Trimesh(mesh.vertices, mesh.faces[label == one], process=False)
        for one in np.unique(label)
    ]


def _just_inside(body: trimesh.Trimesh) -> np.ndarray:
    """Points `[k, 3]` a little behind some of the faces, where the solid is.

    Behind, and not on them, because bodies may touch.
    """
    area = body.area_faces
    some = np.flatnonzero(area > 1e-6 * area.max())
    some = some[:: max(1, len(some) // _SAMPLES)]
    depth = 1e-4 * np.sqrt(2.0 * area[some, None])
    return body.triangles_center[some] - depth * body.face_normals[some]


def _winding_number(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """How often closed triangles `[m, 3, 3]` wind around points `[k, 3]`: 1 inside, 0 outside.

    Source: A. van Oosterom, J. Strackee, "The solid angle of a plane triangle", IEEE TBME 1983.
    """
    winding = np.empty(len(points))
    for k, point in enumerate(points):
        a, b, c = (triangles - point).transpose(1, 0, 2)
        la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
        above = np.einsum("ij,ij->i", a, np.cross(b, c))
        below = la * lb * lc + lc * (a * b).sum(1) + la * (b * c).sum(1) + lb * (c * a).sum(1)
        winding[k] = np.arctan2(above, below).sum() / (2.0 * math.pi)
    return winding


def _check_bodies(mesh: trimesh.Trimesh, name: str) -> None:
    """Refuses bodies that are inside out, or counted twice because they lie inside another."""
    bodies = _bodies(mesh)
    if len(bodies) == 1:
        return
    for k, body in enumerate(bodies):
        points, (low, high) = _just_inside(body), body.bounds
        around = np.zeros(len(points))
        for other in bodies:
            apart = (low > other.bounds[1]).any() or (high < other.bounds[0]).any()
            if other is not body and not apart:
                around += _winding_number(points, other.triangles)
        volume = mesh_volume(body)
        if volume < 0 and (around < 0.5).any():
            raise InputError(
                f"{name}: body {k} of {len(bodies)}: expected faces that look outwards; found it "
                f"inside out (volume {volume:.6g} m3)"
            )
        if volume > 0 and (around > 0.5).any():
            raise InputError(
                f"{name}: body {k} of {len(bodies)}: expected bodies apart from each other; found "
                "it reaching into another one, so that their common volume would count twice"
            )


def check_mesh(mesh: Mesh, name: str = "mesh") -> None:
    """Refuses a mesh whose volume by signed tetrahedra would not be the volume of a solid.

    Bodies that are apart or touch, and inner voids whose faces look into the void, are accepted.
    Overlap is found where faces of one body lie inside another (some 32 faces of each body are
    asked); a single body that cuts through itself is not found.

    Args:
        mesh: as for `mesh_volume`; corners that are one point must be one vertex.
        name: what to call it in the message, usually the file.

    Raises:
        InputError: the mesh is empty, has non-finite vertices, faces that name missing vertices or
            the same vertex twice, open edges, faces wound against each other, no thickness, or is
            inside out or overlapping as a whole or in one of its bodies.
    """
    try:
        surface = _surface(mesh)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None
    vertices, faces = surface.vertices, surface.faces
    if not len(vertices) or not len(faces):
        raise InputError(
            f"{name}: expected a mesh with vertices and faces; found {len(vertices)} vertices and "
            f"{len(faces)} faces"
        )
    last = len(vertices) - 1
    for broken, expected, found in (
        (~np.isfinite(vertices), "finite vertices", "that are not (first: vertex"),
        (
            (faces < 0) | (faces > last),
            f"faces of vertices 0 to {last}",
            "with others (first: face",
        ),
        (_repeated(faces), "faces with three different corners", "degenerate (first: face"),
    ):
        some = np.any(broken, axis=1)
        if some.any():
            raise InputError(
                name, f"{expected}", f"{some.sum()} of {len(some)} {found} {some.argmax()})"
            )
    # Bodies may touch along an edge, which then has four faces, or more.
    edge, ahead = surface.edges_unique_inverse, surface.edges[:, 0] < surface.edges[:, 1]
    total, along = np.bincount(edge), np.bincount(edge, weights=ahead)
    is_open = total % 2 == 1
    if is_open.any():
        raise InputError(name, "a closed surface", f"{is_open.sum()} open edges of {len(total)}")
    against = 2 * along != total
    if against.any():
        raise InputError(
            f"{name}: expected faces wound one way; found {against.sum()} edges of {len(total)} "
            "whose faces are wound against each other"
        )
    volume, center = _volume_and_center(surface)
    if center is None:
        raise InputError(name, "a solid", f"a flat mesh (volume {volume:.6g} m3)")
    if volume < 0:
        raise InputError(
            f"{name}: expected faces that look outwards; found the mesh inside out (volume "
            f"{volume:.6g} m3): flip its faces"
        )
    _check_bodies(surface, name)


def _repeated(faces: np.ndarray) -> np.ndarray:
    """`[m, 3]` corners that are the same as the one before them."""
    return np.equal(faces, np.roll(faces, 1, axis=1))


def _confined(path: str | Path, folder: str | Path) -> Path:
    """The file `path` inside `folder`, refusing every way out of it."""
    text = str(path)
    # A file written on Windows must not find another way out.
    for kind in (PurePosixPath(text), PureWindowsPath(text)):
        if kind.is_absolute() or kind.drive or kind.root or ".." in kind.parts:
            raise InputError(text, f"a path inside {folder}", "one that leads out")
    return resolve_inside(text, folder)


def load_mesh(
    path: str | Path, folder: str | Path | None = None, scale: float = 1.0
) -> trimesh.Trimesh:
    """Reads a closed mesh from an STL, OBJ or PLY file and checks it.

    Only the file itself is read: materials and textures that it names are not followed.

    Args:
        path: the file.
        folder: when given, `path` is relative to this folder and must stay inside it: no absolute
            path, no `..`, no link that leads out.
        scale: metres per unit of the file, for example 0.001 for files in millimetres.

    Returns:
        The mesh, in metres, with one vertex per corner point.

    Raises:
        InputError: the path leads out of the folder, the file is missing, too large, of another
            format or damaged, `scale` is not a positive finite number, or `check_mesh` refuses the
            mesh.
    """
    scale = read(Annotated[Positive, Unit("m per unit")], scale, f"{path}: scale")
    file = Path(path) if folder is None else _confined(path, folder)
    suffix = file.suffix.lower()
    if suffix not in _FORMATS:
        found = f"'{suffix}'" if suffix else "no suffix"
        raise InputError(path, f"one of {', '.join(_FORMATS)}", found)
    with reading(path):
        if file.stat().st_size > _MAX_BYTES:
            raise InputError(f"expected at most {_MAX_BYTES // 2**20} MiB; found more")
        data = file.read_bytes()
    audit(file, "data", data)
    mesh = _parse(data, suffix[1:], str(path))
    vertices, faces = np.asarray(mesh.vertices) * scale, np.asarray(mesh.faces)
    if np.isfinite(vertices).all() and ((faces >= 0) & (faces < len(vertices))).all():
        vertices, faces = _merge(vertices, faces)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    check_mesh(mesh, str(path))
    return mesh


def _merge(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Makes corners that are one point one vertex; drops the faces that this collapses.

    A collapsed face has no area, and its two remaining edges cancel: the surface stays closed.
    """
    size = np.ptp(vertices, axis=0).max() if len(vertices) else 0.0
    if size == 0.0:
        return vertices, faces
    unit = (vertices - vertices.min(axis=0)) / size
    first, index = trimesh.grouping.unique_rows(unit, digits=_DIGITS)
    faces = index[faces]
    return vertices[first], faces[~_repeated(faces).any(axis=1)]


def _parse(data: bytes, kind: str, name: str) -> trimesh.Trimesh:
    """The mesh of a file's bytes; from memory trimesh has no folder to look for textures in."""
    try:
        scene = trimesh.load_scene(io.BytesIO(data), file_type=kind, process=False)
        found = scene.to_mesh()
        return found if len(found.faces) else trimesh.Trimesh()
    except ImportError:  # not a whole binary file: trimesh would guess the encoding of a text
        reason = " neither text nor a whole binary file"
    except Exception as error:  # damaged files raise nearly everything in trimesh
        reason = f": {(str(error).splitlines() or [type(error).__name__])[0]}"
    raise InputError(f"{name}: expected a valid {kind.upper()} mesh; found{reason}")
