"""Triangle meshes: volume and centre of volume, and the refusal of meshes that have neither.

Buoyancy asks how much water a part displaces. For a closed mesh whose faces all look outwards that
is the sum of the signed volumes of the tetrahedra between each face and a reference point
(C. Zhang, T. Chen, "Efficient feature extraction for 2D/3D objects in mesh representation", ICIP
2001, equation 5)::

    V_i = 1/6 (-x3 y2 z1 + x2 y3 z1 + x3 y1 z2 - x1 y3 z2 - x2 y1 z3 + x1 y2 z3)

which is det[v1 v2 v3] / 6. The thesis prints the last term as ``x1 y2 z2``; that is a misprint:
with it the sum depends on where the mesh lies (`experiments/module_volumes.py` shows it by number).

The sum is the volume only when the surface is closed, wound one way, looks outwards and does not
cover a point twice: `check_mesh` refuses all others, because a wrong volume is a wrong buoyancy and
nothing later would notice.
"""

from __future__ import annotations

import io
import math
from pathlib import Path, PurePosixPath, PureWindowsPath

import numpy as np
import trimesh
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mjx_revolve.body.module_types import check_number
from mjx_revolve.inputs.errors import InputError

# A mesh is a `trimesh.Trimesh` or a pair (vertices [n, 3], faces [m, 3]).
Mesh = trimesh.Trimesh | tuple[ArrayLike, ArrayLike]

_FORMATS = (".stl", ".obj", ".ply")
# The largest printed module of Revolve is a few MB as STL; what is larger is not a module.
_MAX_BYTES = 64 * 2**20
# STL stores every corner three to six times in single precision (6e-8 of the value, ASCII files
# are coarser); corners nearer than this share of the largest extent are one corner.
_MERGE = 1e-6
# Volume over (area)^1.5 is 0.094 for a sphere and 7e-6 for a square sheet one thousandth as thick
# as it is wide; below this the mesh is a sheet without thickness.
_FLAT = 1e-9
# Faces of a body behind which we ask whether it lies inside another one.
_SAMPLES = 32


def _arrays(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Vertices `[n, 3]` float64 and faces `[m, 3]` int64 of a mesh."""
    vertices, faces = (mesh.vertices, mesh.faces) if isinstance(mesh, trimesh.Trimesh) else mesh
    vertices, faces = np.asarray(vertices, float), np.asarray(faces)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise InputError(f"mesh: vertices: expected shape [n, 3]; found {list(vertices.shape)}")
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise InputError(f"mesh: faces: expected triangles [m, 3]; found {list(faces.shape)}")
    if faces.size and not np.issubdtype(faces.dtype, np.integer):
        raise InputError(f"mesh: faces: expected whole numbers; found {faces.dtype}")
    return vertices, faces.astype(np.int64)


def _tetrahedra(mesh: Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Signed tetrahedra of a mesh about its mean vertex.

    The sum does not depend on the reference point; a near one avoids cancellation when the mesh
    lies far from the origin.

    Returns:
        volumes `[m]` [m³], corners `[m, 3, 3]` relative to the reference point [m], and the
        reference point `[3]` [m].
    """
    vertices, faces = _arrays(mesh)
    reference = vertices.mean(axis=0) if len(vertices) else np.zeros(3)
    corners = (vertices - reference)[faces]
    (x1, y1, z1), (x2, y2, z2), (x3, y3, z3) = corners.transpose(1, 2, 0)
    volumes = (
        -x3 * y2 * z1 + x2 * y3 * z1 + x3 * y1 * z2 - x1 * y3 * z2 - x2 * y1 * z3 + x1 * y2 * z3
    ) / 6.0
    return volumes, corners, reference


def mesh_volume(mesh: Mesh) -> float:
    """Volume enclosed by a closed mesh, as a sum of signed tetrahedra.

    Args:
        mesh: a `trimesh.Trimesh`, or (vertices `[n, 3]` [m], faces `[m, 3]`). Faces look outwards
            (counter-clockwise seen from outside); inner voids are surfaces that look into the void.

    Returns:
        The volume [m³]; negative when the mesh is inside out. Meaningless for an open mesh: see
        `check_mesh`.

    Raises:
        InputError: the arrays do not have the shapes of a triangle mesh.

    Source: Zhang & Chen 2001, equation 5.
    """
    return float(_tetrahedra(mesh)[0].sum())


def mesh_center_of_volume(mesh: Mesh) -> np.ndarray:
    """Centre of the volume enclosed by a closed mesh: where buoyancy acts.

    Args:
        mesh: as for `mesh_volume`.

    Returns:
        `[3]` the centre in the mesh's own frame [m].

    Raises:
        InputError: the arrays do not have the shapes of a triangle mesh, or the mesh encloses no
            volume.

    Source: Zhang & Chen 2001: each tetrahedron counts with its signed volume at the mean of its
    four corners.
    """
    volumes, corners, reference = _tetrahedra(mesh)
    volume = volumes.sum()
    if not np.isfinite(volume) or abs(volume) <= np.finfo(float).eps * np.abs(volumes).sum():
        raise InputError(f"mesh: expected a mesh that encloses a volume; found {volume:g} m3")
    return reference + volumes @ corners.sum(axis=1) / (4.0 * volume)


def _unbalanced_edges(faces: np.ndarray) -> tuple[int, int, int]:
    """Counts edges that keep a surface from being closed and wound one way.

    Returns:
        number of edges, of those that belong to an odd number of faces (open), and of those that
        the faces on both sides run through in the same direction (inconsistent).
    """
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forward = directed[:, 0] < directed[:, 1]
    _, index = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True)
    index = index.reshape(-1)
    total = np.bincount(index)
    ahead = np.bincount(index, weights=forward)
    is_open = total % 2 == 1
    return len(total), int(is_open.sum()), int((~is_open & (2 * ahead != total)).sum())


def _bodies(vertices: np.ndarray, faces: np.ndarray) -> list[np.ndarray]:
    """Splits the faces into bodies that share no vertex: a list of faces `[k, 3]`."""
    rows = np.concatenate([faces[:, 0], faces[:, 1]])
    columns = np.concatenate([faces[:, 1], faces[:, 2]])
    graph = coo_array((np.ones(len(rows), bool), (rows, columns)), shape=(len(vertices),) * 2)
    _, label = connected_components(graph, directed=False)
    label = label[faces[:, 0]]
    return [faces[label == one] for one in np.unique(label)]


def _just_inside(triangles: np.ndarray) -> np.ndarray:
    """Points `[k, 3]` a little behind some of the triangles `[m, 3, 3]`, where the solid is.

    Behind, and not on them, because bodies may touch.
    """
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    size = np.linalg.norm(normal, axis=1)  # twice the area
    some = np.flatnonzero(size > 1e-6 * size.max())
    some = some[:: max(1, len(some) // _SAMPLES)]
    return triangles[some].mean(axis=1) - 1e-4 * normal[some] / np.sqrt(size[some, None])


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


def _check_bodies(vertices: np.ndarray, faces: np.ndarray, name: str) -> None:
    """Refuses bodies that are inside out, or counted twice because they lie inside another."""
    bodies = _bodies(vertices, faces)
    if len(bodies) == 1:
        return
    boxes = [(vertices[body].min((0, 1)), vertices[body].max((0, 1))) for body in bodies]
    for k, body in enumerate(bodies):
        points = _just_inside(vertices[body])
        (low, high), around = boxes[k], np.zeros(len(points))
        for other, (other_low, other_high) in zip(bodies, boxes, strict=True):
            if other is not body and (low <= other_high).all() and (high >= other_low).all():
                around += _winding_number(points, vertices[other])
        volume = mesh_volume((vertices, body))
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
        vertices, faces = _arrays(mesh)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None
    if not len(vertices) or not len(faces):
        raise InputError(
            f"{name}: expected a mesh with vertices and faces; found {len(vertices)} vertices and "
            f"{len(faces)} faces"
        )
    broken = ~np.isfinite(vertices).all(axis=1)
    if broken.any():
        raise InputError(
            f"{name}: expected finite vertices; found {broken.sum()} of {len(vertices)} that are "
            f"not (first: vertex {broken.argmax()})"
        )
    broken = ((faces < 0) | (faces >= len(vertices))).any(axis=1)
    if broken.any():
        raise InputError(
            f"{name}: expected faces of vertices 0 to {len(vertices) - 1}; found {broken.sum()} of "
            f"{len(faces)} with others (first: face {broken.argmax()})"
        )
    broken = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    if broken.any():
        raise InputError(
            f"{name}: expected faces with three different corners; found {broken.sum()} of "
            f"{len(faces)} degenerate (first: face {broken.argmax()})"
        )
    edges, open_edges, inconsistent = _unbalanced_edges(faces)
    if open_edges:
        raise InputError(
            f"{name}: expected a closed surface; found {open_edges} open edges of {edges}"
        )
    if inconsistent:
        raise InputError(
            f"{name}: expected faces wound one way; found {inconsistent} edges of {edges} whose "
            "faces are wound against each other"
        )
    volume = mesh_volume((vertices, faces))
    corners = vertices[faces]
    area = (
        0.5
        * np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        ).sum()
    )
    if abs(volume) <= _FLAT * area**1.5:
        raise InputError(f"{name}: expected a solid; found a flat mesh (volume {volume:.6g} m3)")
    if volume < 0:
        raise InputError(
            f"{name}: expected faces that look outwards; found the mesh inside out (volume "
            f"{volume:.6g} m3): flip its faces"
        )
    _check_bodies(vertices, faces, name)


def _confined(path: str | Path, folder: str | Path) -> Path:
    """The file `path` inside `folder`, refusing every way out of it."""
    text = str(path)
    # A file written on Windows must not find another way out.
    for kind in (PurePosixPath(text), PureWindowsPath(text)):
        if kind.is_absolute() or kind.drive or kind.root or ".." in kind.parts:
            raise InputError(f"{text}: expected a path inside {folder}; found one that leads out")
    try:
        inside = Path(folder).resolve()
        full = (inside / text).resolve()
    except ValueError:
        raise InputError(f"{text!r}: expected a file name; found a null byte") from None
    except (OSError, RuntimeError):
        raise InputError(f"{text}: expected a readable file; found a loop of links") from None
    if not full.is_relative_to(inside):
        raise InputError(f"{text}: expected a path inside {folder}; found a link that leads out")
    return full


def _merge(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Makes corners that are one point one vertex; drops the faces that this collapses.

    A collapsed face has no area, and its two remaining edges cancel: the surface stays closed.
    """
    size = np.ptp(vertices, axis=0).max()
    if size == 0.0:
        return vertices, faces
    grid = np.round((vertices - vertices.min(axis=0)) / (_MERGE * size)).astype(np.int64)
    _, first, index = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    vertices, faces = vertices[first], index.reshape(-1)[faces]
    return vertices, faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]


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
    scale = check_number(scale, f"{path}: scale", "m per unit", above=True)
    file = Path(path) if folder is None else _confined(path, folder)
    suffix = file.suffix.lower()
    if suffix not in _FORMATS:
        found = f"'{suffix}'" if suffix else "no suffix"
        raise InputError(f"{path}: expected one of {', '.join(_FORMATS)}; found {found}")
    try:
        if file.stat().st_size > _MAX_BYTES:
            raise InputError(f"{path}: expected at most {_MAX_BYTES // 2**20} MiB; found more")
        data = file.read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: expected a file; found none") from None
    except OSError as error:
        raise InputError(f"{path}: expected a readable file; found {error.strerror}") from None
    vertices, faces = _parse(data, suffix[1:], str(path))
    if (
        np.isfinite(vertices).all()
        and faces.size
        and 0 <= faces.min() <= faces.max() < len(vertices)
    ):
        vertices, faces = _merge(vertices * scale, faces)
    check_mesh((vertices, faces), str(path))
    return trimesh.Trimesh(vertices, faces, process=False)


def _parse(data: bytes, kind: str, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a mesh file's bytes."""
    # From memory trimesh has no folder in which to look for materials and textures.
    try:
        scene = trimesh.load_scene(io.BytesIO(data), file_type=kind, process=False)
        parts = [
            part for part in scene.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)
        ]
    except ImportError:  # not a whole binary file: trimesh would guess the encoding of a text
        raise InputError(
            f"{name}: expected a valid {kind.upper()} mesh; found neither text nor a whole binary "
            "file"
        ) from None
    except Exception as error:  # damaged files raise nearly everything in trimesh
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"{name}: expected a valid {kind.upper()} mesh; found: {reason}") from None
    if not parts:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    starts = np.cumsum([0] + [len(part.vertices) for part in parts])
    vertices = np.concatenate([part.vertices for part in parts]).astype(float)
    faces = [part.faces + start for part, start in zip(parts, starts, strict=False)]
    return vertices, np.concatenate(faces).astype(np.int64)
