"""Import of a robot of rigid links: module types and a morphology.

Each link that a hinge moves becomes a module with that hinge, in a frame along its largest box.
Boxes that are turned against it become modules of their own, fixed to it. The mass of a link that
is not uniform over its boxes becomes four points with the link's mass, centre and inertia.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjx_revolve.body.catalogue import MODULES
from mjx_revolve.body.module_files import read_modules
from mjx_revolve.body.module_types import ModuleType
from mjx_revolve.body.morphology import Morphology, make_morphology
from mjx_revolve.body.tree import COLORS, free_name
from mjx_revolve.formats.inertias import spread
from mjx_revolve.formats.links import plain, unique_names
from mjx_revolve.formats.rigid_links import RigidLink, RigidRobot, Shape, read_rigid_robot
from mjx_revolve.inputs.errors import InputError, reading
from mjx_revolve.inputs.files import write_atomic
from mjx_revolve.inputs.yaml_reader import check_size, dump_yaml

# Edge of the box of a part without water or contact [m]: a choice, small against a link.
_SPECK = 1e-4
_DRY = {"volume": 0.0, "contact": False, "drag": "off", "added_mass": False}
# Four corners of a cube, no two on one edge: as many points as the inertia of a body needs.
_CORNERS = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], float)
# Ranges of a continuous joint and of one that cannot turn [rad], as our hinges have a range.
_WHOLE, _STILL = np.pi, 1e-3
# A range as wide as this is none [rad]. A choice: without limits SDF has ±1e16.
_ENDLESS = 1e3


@dataclass(frozen=True)
class ImportedRobot:
    """An imported robot.

    Attributes:
        morphology: the robot.
        modules: its types of modules, by name.
        files: the mappings that `save` writes: of the morphology and of the types.
        missing: properties that were not imported, in words.
    """

    morphology: Morphology
    modules: dict[str, ModuleType]
    files: tuple[dict[str, Any], dict[str, Any]]
    missing: tuple[str, ...]

    def paths(self, folder: str | Path = ".") -> tuple[Path, Path]:
        """Of the two files that `save` writes."""
        name = self.morphology.name
        return Path(folder) / f"{name}.yaml", Path(folder) / f"{name}_modules.yaml"

    def save(self, folder: str | Path = ".") -> tuple[Path, Path]:
        """Writes two YAML files named after the robot: morphology and types of modules.

        Args:
            folder: to write into.

        Returns:
            The two paths.
        """
        paths = self.paths(folder)
        for path, data in zip(paths, self.files, strict=True):
            text = dump_yaml(data, default_flow_style=None, width=100)
            write_atomic(path, text.encode())
        return paths


def import_robot(path: str | Path) -> ImportedRobot:
    """Makes a robot of a URDF or an MJCF file.

    Masses, centres, inertias and hinges are the file's. A link displaces the volume of its visible
    shapes, a mesh with holes that of the box around it; without any, that of those that collide,
    which are its boxes: cylinders, spheres and meshes as the boxes around them. Servos are
    position servos as all here.

    Args:
        path: of the file.

    Returns:
        The robot; `missing` names properties that were not imported.

    Raises:
        InputError: the file cannot be read, or holds no such robot; the message says where.
    """
    robot = read_rigid_robot(path)
    with reading(path):
        return _make(robot)


def _make(robot: RigidRobot) -> ImportedRobot:
    kinds: dict[str, Any] = {}
    frames: list[np.ndarray] = []
    items: list[dict[str, Any]] = []
    missing = robot.missing
    given = [link.name for link in robot.links]
    names = _names(given)
    taken = {*names, *MODULES}
    for link, name in zip(robot.links, names, strict=True):
        shapes = link.solid or link.seen
        turn = _frame(link, shapes)
        frames.append(turn)
        kinds[name], welded = _module(link, shapes, turn, missing)
        rgb = next((s.rgb for s in (*link.seen, *link.solid) if s.rgb), None)
        # A type's name is plain, as messages of ROS need it; an id keeps the file's.
        known = link.name.isprintable() and [*given, *names].count(link.name) == 1
        item: dict[str, Any] = {"id": link.name if known else name, "type": name} | _color(rgb)
        items.append(item)
        for number, (part, slot) in enumerate(welded, 1):
            own = free_name(name, taken, number)
            taken.add(own)
            kinds[own] = {"mount": {"position": [0.0, 0.0, 0.0], "outward": [1.0, 0.0, 0.0]},
                          "parts": [part]}  # fmt: skip
            _attach(kinds[name], item, slot, {"id": own, "type": own} | _color(rgb))
        if link.parent >= 0:
            above = frames[link.parent]
            slot = _slot(above.T @ link.position, above.T @ link.rotation @ turn)
            _attach(kinds[names[link.parent]], items[link.parent], slot, item)
    files = {"id": plain(robot.name), "body": items[0]}, {"modules": kinds}
    check_size(files[0])  # what is saved is to be read again
    modules = {**MODULES, **read_modules(files[1], {})}
    morphology = make_morphology(files[0], modules, allow_overlap=True)
    if morphology.overlaps:
        a, b = morphology.overlaps[0]
        missing.append(f"{len(morphology.overlaps)} pairs of modules overlap at rest, as {a} "
                       f"and {b}, which evolution refuses until boxes are smaller")  # fmt: skip
    return ImportedRobot(morphology, modules, files, _grouped(missing))


def _grouped(missing: list[str]) -> tuple[str, ...]:
    """The words, each once, with the names of all that they are about before them."""
    about: dict[str, list[str]] = {}
    for line in missing:
        name, colon, words = line.partition(": ")
        about.setdefault(words if colon else name, []).extend([name] if colon else [])
    return tuple(
        f"{', '.join(names[:4])}{f' and {len(names) - 4} more' if names[4:] else ''}: {words}"
        if names
        else words
        for words, names in about.items()
    )


def _color(rgb: tuple[float, ...] | None) -> dict[str, Any]:
    """A module's params with its colour, if there is one; what is brighter than 1 is 1, as seen."""
    return {"params": dict(zip(COLORS, np.clip(rgb, 0, 1).tolist(), strict=True))} if rgb else {}


def _names(given: list[str]) -> list[str]:
    """Names of types: letters, digits and _, each once."""
    bases = [name if name[0].isalpha() else f"m{name}" for name in map(plain, given)]
    return unique_names(bases, taken={*MODULES})


def _frame(link: RigidLink, shapes: list[Shape]) -> np.ndarray:
    """`[3, 3]` link from module: along the largest box; the root keeps its own axes."""
    if link.parent < 0 or not shapes:
        return np.eye(3)
    return max(shapes, key=lambda shape: np.prod(shape.size)).rotation


def _slot(position: np.ndarray, rotation: np.ndarray) -> dict[str, Any]:
    """Where a module with its mount at its origin comes to lie so."""
    return {
        "position": position.tolist(),
        "direction": rotation[:, 0].tolist(),
        "up": rotation[:, 2].tolist(),
    }


def _attach(
    kind: dict[str, Any], item: dict[str, Any], slot: dict[str, Any], child: dict[str, Any]
) -> None:
    slots = kind.setdefault("slots", {})
    number = len(slots) + 1
    slots[number] = slot
    item.setdefault("children", {})[number] = child


def _module(
    link: RigidLink, shapes: list[Shape], turn: np.ndarray, missing: list[str]
) -> tuple[dict[str, Any], list[tuple[dict[str, Any], dict[str, Any]]]]:
    """A link's type of module, and parts and slots of those that are fixed to it."""
    mass = link.inertia[3, 3]
    parts: list[dict[str, Any]] = []
    kind: dict[str, Any] = {"mount": None}
    if link.parent >= 0:
        kind["mount"] = {"position": [0.0, 0.0, 0.0], "outward": [1.0, 0.0, 0.0]}
        kind["hinge"] = _hinge(link, turn, missing)
        # The part that does not move: what the hinge is fixed to belongs to the parent.
        parts.append({"name": "bearing", "size": 3 * [_SPECK], "mass": 0.0, **_DRY})
    if not shapes:
        missing.append(f"{link.name}: no shape: it has a mass, and no water")
    own, welded = [], []
    shift, volumes = _volumes(link, shapes)
    for number, (shape, volume) in enumerate(zip(shapes, volumes, strict=True)):
        rotation = turn.T @ shape.rotation
        quarter = np.rint(rotation)
        straight = bool(np.allclose(rotation, quarter, atol=1e-6))
        axes = turn if straight else shape.rotation
        size = np.abs(quarter) @ shape.size if straight else shape.size
        center = axes.T @ (shape.center + shift - shape.position)
        part = {"name": f"box{number}", "size": size.tolist(), "mass": 0.0, "volume": float(volume),
                "center_of_volume": center.tolist()}  # fmt: skip
        if straight:
            part["position"] = (turn.T @ shape.position).tolist()
            own.append(part)
        else:
            welded.append((part, _slot(turn.T @ shape.position, rotation)))
    body = np.eye(4)
    body[:3, :3] = turn.T
    inertia = body @ link.inertia @ body.T
    if mass > 0:
        square = _spread_of(inertia)[1]
        if np.linalg.eigvalsh(square)[0] < -1e-6 * abs(np.trace(square)):
            missing.append(f"{link.name}: an inertia that no body has; the nearest one is taken")
        parts += _with_mass(own, inertia, whole=not welded)
    elif link.parent >= 0:
        raise InputError(link.name, "a mass, as a hinge moves it", "none")
    kind["parts"] = parts
    return kind, welded


def _hinge(link: RigidLink, turn: np.ndarray, missing: list[str]) -> dict[str, Any]:
    low, high = link.limits.get("range", (-_WHOLE, _WHOLE))
    if "range" not in link.limits or high - low > _ENDLESS:
        low, high = -_WHOLE, _WHOLE
        missing.append(f"{link.name}: turns all the way; here from -π to π")
    if low > high:
        raise InputError(link.name, "a range [lowest, highest]", f"[{low:g}, {high:g}]")
    if low == high == 0:
        high = _STILL
        missing.append(f"{link.name}: cannot turn; here from 0 to {high:g} rad")
    if not low <= 0 <= high:
        missing.append(f"{link.name}: its range [{low:g}, {high:g}] lacks the rest pose, 0")
        low, high = min(low, 0.0), max(high, 0.0)
    given = [name for name in ("effort", "speed") if name in link.limits]
    lacking = [name for name in ("effort", "speed") if name not in given]
    if lacking:
        missing.append(f"{link.name}: no {' nor '.join(lacking)} given; so Revolve's servo's")
    return {
        "axis": (turn.T @ link.axis).tolist(),
        "anchor": (turn.T @ link.anchor).tolist(),
        "range": [float(low), float(high)],
        **{name: float(link.limits[name]) for name in given},
    }


def _volumes(link: RigidLink, shapes: list[Shape]) -> tuple[np.ndarray, np.ndarray]:
    """How far the centre of volume lies from that of the boxes' shapes [m], and their volumes."""
    own = np.array([shape.volume for shape in shapes])
    seen = link.seen or shapes
    if not shapes or own.sum() <= 0:
        return np.zeros(3), own
    whole = sum(shape.volume for shape in seen)
    middle = sum((v * s.center for v, s in zip(own, shapes, strict=True)), np.zeros(3)) / own.sum()
    center = sum((s.volume * s.center for s in seen), np.zeros(3)) / whole
    return center - middle, own * whole / own.sum()


def _spread_of(inertia: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`[3]` centre [m] and `[3, 3]` mean square about it [m²] of a pseudo-inertia's mass."""
    center = inertia[:3, 3] / inertia[3, 3]
    return center, inertia[:3, :3] / inertia[3, 3] - np.outer(center, center)


def _with_mass(own: list[dict[str, Any]], inertia: np.ndarray, whole: bool) -> list[dict[str, Any]]:
    """The boxes with the mass, module frame; where they do not have the inertia, four points."""
    mass = inertia[3, 3]
    room = sum(part["volume"] for part in own)
    if own and whole and room > 0:
        masses = [mass * part["volume"] / room for part in own]
        even = sum(
            spread(one, part["position"], np.diag(np.square(part["size"])) / 12)
            for one, part in zip(masses, own, strict=True)
        )
        # Second moments are compared with the boxes', so that lengths count, not where zero is.
        if np.allclose(even, inertia, rtol=1e-6, atol=1e-9 * np.abs(inertia[:3, :3]).max()):
            return [part | {"mass": float(m)} for part, m in zip(own, masses, strict=True)]
    center, square = _spread_of(inertia)
    width, axes = np.linalg.eigh(square - _SPECK**2 / 12 * np.eye(3))
    points = center + _CORNERS * np.sqrt(np.maximum(width, 0)) @ axes.T
    return [
        *({"name": f"mass{k}", "size": 3 * [_SPECK], "mass": float(mass / 4),
           "position": point.tolist(), **_DRY} for k, point in enumerate(points)),
        *own,
    ]  # fmt: skip
