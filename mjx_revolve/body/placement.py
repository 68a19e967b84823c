"""Modules at rest: where each one lies, and which ones overlap."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mjx_revolve.body.boxes import boxes_overlap, quarter_turn
from mjx_revolve.body.module_types import ModuleType, Slot

# Boxes are shrunk by this much at each face [m] before they are tested for overlap, thin ones by
# half their half-edge at most. A choice: a brick's box stands 1.5 mm proud of its attachment faces,
# so that two bricks on neighbouring faces of a third share 3 mm by design.
OVERLAP_TOLERANCE = 0.002


@dataclass(frozen=True, eq=False)
class Module:
    """One module of a robot, at rest.

    Attributes:
        name: unique in the robot.
        type: name of its type in the catalogue.
        parent: index of its parent in the morphology's modules; -1 for the core.
        slot: the parent's slot that it is attached to; -1 for the core.
        orientation: turn about the direction in which it is attached [deg].
        rgb: red, green, blue from 0 to 1, or None where the file gives no colour.
        position: `[3]` origin of its frame, core frame [m].
        rotation: `[3, 3]` core frame from module frame.
        kind: its type, with the file's `params` (mass, volume, ...) applied.
        params: the file's `params` without the colour.
    """

    name: str
    type: str
    parent: int
    slot: int
    orientation: float
    rgb: tuple[float, float, float] | None
    position: np.ndarray
    rotation: np.ndarray
    kind: ModuleType
    params: Mapping[str, Any] = field(default_factory=dict)

    def __eq__(self, other: object) -> bool:
        """Same values, bit for bit."""
        if not isinstance(other, Module):
            return NotImplemented
        plain = ("name", "type", "parent", "slot", "orientation", "rgb", "kind")
        return (
            all(getattr(self, key) == getattr(other, key) for key in plain)
            and np.array_equal(self.position, other.position)
            and np.array_equal(self.rotation, other.rotation)
            and same(self.params, other.params)
        )

    def boxes(self, main: bool = False) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Its boxes at rest.

        Args:
            main: only the main box of each part.

        Yields:
            `[3]` centre, core frame [m], and `[3]` half edges, module frame [m].
        """
        for part in self.kind.parts:
            for box in part.boxes[: 1 if main else None]:
                local = np.asarray(part.position) + np.asarray(box.position)
                yield self.position + self.rotation @ local, np.asarray(box.size) / 2


def same(a: Any, b: Any) -> bool:
    """Equal plain data; unlike ==, nan is equal to itself and 1 is not 1.0 or true."""
    return repr(a) == repr(b)


def frozen(array: np.ndarray) -> np.ndarray:
    """The array, made read-only."""
    array.flags.writeable = False
    return array


def attach(parent: Module, slot: Slot, child: Module) -> tuple[np.ndarray, np.ndarray]:
    """Pose of a child at rest.

    The child's outward axis comes to lie along the slot's direction and its z along the slot's up;
    then it is turned by its orientation about that direction (right-handed, as in Revolve).

    Args:
        parent: the module that carries it, placed.
        slot: one of the parent's slots.
        child: a module with a mount; its own pose is not read.

    Returns:
        `[3]` position and `[3, 3]` rotation, core frame.
    """
    mount = child.kind.mount
    assert mount is not None  # a core is never a child
    up, direction = np.array(slot.up), np.array(slot.direction)
    outward, z = np.array(mount.outward), np.array([0.0, 0.0, 1.0])
    target = np.column_stack([direction, np.cross(up, direction), up])
    source = np.column_stack([outward, np.cross(z, outward), z])
    quarter = round(child.orientation / 90) % 4
    turned = quarter_turn(direction, quarter) @ target @ source.T
    rotation = parent.rotation @ turned
    position = (
        parent.position
        + parent.rotation @ np.array(slot.position)
        - rotation @ np.array(mount.position)
    )
    return frozen(position), frozen(rotation)


def find_bounds(modules: Sequence[Module]) -> tuple[np.ndarray, np.ndarray]:
    """Bounding box of all boxes at rest.

    Args:
        modules: a robot's modules.

    Returns:
        `[3]` lowest and `[3]` highest corner, core frame [m].
    """
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for module in modules:
        for center, half in module.boxes():
            reach = np.abs(module.rotation) @ half
            low, high = np.minimum(low, center - reach), np.maximum(high, center + reach)
    return low, high


def find_overlaps(modules: Sequence[Module]) -> tuple[tuple[str, str], ...]:
    """Modules that overlap at rest.

    The main boxes of all parts are compared, shrunk by `OVERLAP_TOLERANCE`; parts of one module and
    of parent and child touch by design and are left out.

    Args:
        modules: a robot's modules.

    Returns:
        names of the pairs, in the modules' order.
    """
    owner, centers, halves = [], [], []
    for index, module in enumerate(modules):
        for center, half in module.boxes(main=True):
            owner.append(index)
            centers.append(center)
            halves.append(half - np.minimum(OVERLAP_TOLERANCE, half / 2))
    which = np.array(owner)
    parent = np.array([m.parent for m in modules])[which]
    center, half = np.array(centers), np.array(halves)
    turn = np.array([modules[i].rotation for i in owner])
    radius = np.linalg.norm(half, axis=1)
    pairs: set[tuple[int, int]] = set()
    for a in range(len(which)):
        b = np.arange(a + 1, len(which))
        apart = (which[b] != which[a]) & (parent[b] != which[a]) & (which[b] != parent[a])
        near = np.linalg.norm(center[b] - center[a], axis=1) < radius[b] + radius[a]
        b = b[apart & near]
        hit = boxes_overlap(center[a], turn[a], half[a], center[b], turn[b], half[b])
        pairs |= {(int(which[a]), int(which[j])) for j in b[hit]}
    return tuple((modules[i].name, modules[j].name) for i, j in sorted(pairs))
