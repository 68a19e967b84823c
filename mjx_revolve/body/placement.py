"""Modules at rest: where each one and its boxes lie, and which ones overlap."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from mjx_revolve.body.boxes import boxes_overlap, quarter_turn
from mjx_revolve.body.module_types import ModuleType, Mount, Part, Slot
from mjx_revolve.inputs.errors import InputError

# Boxes are shrunk by this much at each face [m] before they are tested for overlap, thin ones by
# half their half-edge at most. A choice: a brick's box stands 1.5 mm proud of its attachment faces,
# so that two bricks on adjacent faces of a third overlap by 3 mm by design. What is read from files
# may overlap by a little more than what edits and genotypes make, which passports hold to 3 mm.
OVERLAP_TOLERANCE, GROWN_TOLERANCE = 0.002, 0.0016


@dataclass(frozen=True, eq=False, repr=False)
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
        base: its type without `params`, where it has some; not compared.
        origin: of a module that edits have copied: of which parent (0: the edited body itself), and
            its name there. Neither compared nor saved.
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
    base: ModuleType | None = None
    origin: tuple[int, str] | None = None

    def __eq__(self, other: object) -> bool:
        """Same values, bit for bit."""
        if not isinstance(other, Module):
            return NotImplemented
        plain = attrgetter("name", "type", "parent", "slot", "orientation", "rgb", "kind")
        return (
            plain(self) == plain(other)
            and np.array_equal(self.position, other.position)
            and np.array_equal(self.rotation, other.rotation)
            and same(self.params, other.params)
        )

    def __repr__(self) -> str:
        """One line."""
        place = "" if self.parent < 0 else f", slot {self.slot} of module {self.parent}"
        return f"Module({self.name!r}: {self.type}{place}, {self.kind.mass:.4g} kg)"

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


def same(a: object, b: object) -> bool:
    """Equal plain data; unlike ==, nan is equal to itself and 1 is not 1.0 or true."""
    return repr(a) == repr(b)


def frozen(array: np.ndarray) -> np.ndarray:
    """The array, made read-only."""
    array.flags.writeable = False
    return array


@lru_cache(maxsize=4096)
def _joint(slot: Slot, mount: Mount, quarter: int) -> tuple[np.ndarray, np.ndarray]:
    """`[3]` position and `[3, 3]` rotation of a child in its parent's frame, by quarter turns."""
    toward, above = np.array(slot.direction), np.array(slot.up)
    away, z = np.array(mount.outward), np.array([0.0, 0.0, 1.0])
    target = np.column_stack([toward, np.cross(above, toward), above])
    source = np.column_stack([away, np.cross(z, away), z])
    turn = quarter_turn(toward, quarter) @ target @ source.T
    return np.array(slot.position) - turn @ mount.position, turn


def attach(
    parent: Module, slot: Slot, kind: ModuleType, orientation: float
) -> tuple[np.ndarray, np.ndarray]:
    """Pose of a child at rest.

    The child's outward axis is along the slot's direction and its z along the slot's `up`; then it
    is turned by its orientation about that direction (right-handed, as in Revolve).

    Args:
        parent: the module that carries it, with its pose.
        slot: one of the parent's slots.
        kind: the child's type, which has a mount.
        orientation: the child's [deg].

    Returns:
        `[3]` position and `[3, 3]` rotation, core frame.
    """
    mount = kind.mount
    assert mount is not None  # a core is never a child
    offset, turn = _joint(slot, mount, round(orientation / 90) % 4)
    position = parent.position + parent.rotation @ offset
    return frozen(position), frozen(parent.rotation @ turn)


# ------------------------------------------------------------------------- all parts together


class RestPose(NamedTuple):
    """All parts at rest and all of their boxes, part after part, of one body or several.

    Attributes:
        parts: the distinct parts.
        kind: `[npart]` index of each part in `parts`.
        body: `[npart]` index of each part's body.
        module: `[npart]` index of its module, counted through all bodies.
        position: `[npart, 3]` origin of the part's frame, core frame [m].
        rotation: `[npart, 3, 3]` core frame from part frame.
        low: `[npart, 3]` lowest corner of the part's boxes, part frame [m].
        high: `[npart, 3]` highest corner.
        main: `[npart]` index of the part's first box, the main one, centred on the part's frame.
        box_part: `[nbox]` index of each box's part.
        box_position: `[nbox, 3]` its centre, part frame [m].
        box_half: `[nbox, 3]` its half edges, part frame [m].
    """

    parts: tuple[Part, ...]
    kind: np.ndarray
    body: np.ndarray
    module: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    low: np.ndarray
    high: np.ndarray
    main: np.ndarray
    box_part: np.ndarray
    box_position: np.ndarray
    box_half: np.ndarray

    def box_centers(self) -> np.ndarray:
        """`[nbox, 3]` centres of the boxes, core frame [m]."""
        k = self.box_part
        return self.position[k] + turned(self.rotation[k], self.box_position)

    def box_reaches(self) -> np.ndarray:
        """`[nbox, 3]` half extents of each box along the core's axes [m]."""
        return turned(np.abs(self.rotation[self.box_part]), self.box_half)

    def corners(self) -> np.ndarray:
        """`[npart, 8, 3]` corners of the boxes around each part, part frame [m]."""
        return np.where(_CORNERS, self.high[:, None], self.low[:, None])

    def core_corners(self) -> np.ndarray:
        """`[npart, 8, 3]` the same, core frame [m]."""
        return self.position[:, None] + self.corners() @ self.rotation.swapaxes(1, 2)


_CORNERS = np.array(list(np.ndindex(2, 2, 2)), bool)


def turned(rotation: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """`[n, 3]` vectors, each turned by its `[n, 3, 3]` matrix; bits do not depend on n."""
    return (rotation @ vector[..., None])[..., 0]


def counted(count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For runs of `[n]` lengths, one after another: each item's run, and its index in the run."""
    owner = np.repeat(np.arange(len(count)), count)
    return owner, np.arange(len(owner)) - (np.cumsum(count) - count)[owner]


def pairs_within(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All pairs of items of the same body, one item from each of two sorted lists.

    Args:
        first: `[n]` body of each item of the first list, ascending.
        second: `[m]` body of each item of the second list, ascending.

    Returns:
        `[pair]` indices into `first` and `[pair]` into `second`, sorted.
    """
    start, stop = (np.searchsorted(second, first, side=side) for side in ("left", "right"))
    one, rank = counted(stop - start)
    return one, start[one] + rank


def rest_pose(*bodies: Sequence[Module]) -> RestPose:
    """Where all parts and boxes lie at rest.

    Args:
        *bodies: the modules of each body.

    Returns:
        The layout.
    """
    modules = [m for body in bodies for m in body]
    listed = [part for m in modules for part in m.kind.parts]
    # Most modules share a type and its parts: each distinct part is read once.
    given = {id(part): part for part in listed}
    number = {key: k for k, key in enumerate(given)}
    kind = np.array([number[id(part)] for part in listed])
    module = counted(np.array([len(m.kind.parts) for m in modules]))[0]
    rotation = np.array([m.rotation for m in modules])[module]
    origin = np.array([m.position for m in modules])[module]
    parts = tuple(given.values())
    local = np.array([part.position for part in parts])[kind]
    boxes = [box for part in parts for box in part.boxes]
    size = np.array([len(part.boxes) for part in parts])
    bounds = np.array([part.bounds for part in parts])
    box_part, rank = counted(size[kind])
    box = (np.cumsum(size) - size)[kind[box_part]] + rank
    return RestPose(
        parts=parts,
        kind=kind,
        body=counted(np.array([len(body) for body in bodies]))[0][module],
        module=module,
        position=origin + turned(rotation, local),
        rotation=rotation,
        low=bounds[kind, 0],
        high=bounds[kind, 1],
        main=np.cumsum(size[kind]) - size[kind],
        box_part=box_part,
        box_position=np.array([box.position for box in boxes])[box],
        box_half=np.array([box.size for box in boxes])[box] / 2,
    )


def find_overlaps(
    modules: Sequence[Module],
    moved: Iterable[int] | None = None,
    tolerance: float = OVERLAP_TOLERANCE,
) -> tuple[tuple[int, int], ...]:
    """Modules that overlap at rest.

    The main boxes of all parts are compared, shrunk by the tolerance; parts of one module and of
    parent and child touch by design and are left out.

    Args:
        modules: a robot's modules.
        moved: indices of those to compare with all; by default all.
        tolerance: by which boxes are shrunk at each face [m].

    Returns:
        pairs of indices, in order.
    """
    layout = rest_pose(modules)
    center, turn, half = layout.position, layout.rotation, layout.box_half[layout.main]
    half = half - np.minimum(tolerance, half / 2)
    reach = turned(np.abs(turn), half)
    compared = np.full(len(modules), moved is None)
    compared[list(moved or ())] = True
    rows = np.flatnonzero(compared[layout.module])
    # Most pairs are already apart along the core's axes.
    gap = np.abs(center[rows, None] - center) - reach[rows, None] - reach
    first, second = np.nonzero((gap < 0).all(-1))
    first = rows[first]
    a, b = layout.module[first], layout.module[second]
    parent = np.array([m.parent for m in modules])
    apart = (a != b) & (parent[a] != b) & (parent[b] != a)
    first, second = first[apart], second[apart]
    if not len(first):
        return ()
    hit = boxes_overlap(
        center[first], turn[first], half[first], center[second], turn[second], half[second]
    )
    pairs = np.sort(np.column_stack([a[apart], b[apart]])[hit], axis=1)
    return tuple(sorted({(int(i), int(j)) for i, j in pairs}))


def check_rigid(modules: Sequence[Module], place: str) -> None:
    """Raises `InputError` for hinges on a core that states the water of a whole rigid robot."""
    hinges = [module.name for module in modules if module.kind.hinge is not None]
    stated = modules[0].kind.parts[0].fossen
    if hinges and stated is not None and stated.whole:
        raise InputError(
            f"{place}: expected no hinges, as the core's fossen.whole states the water of all of a "
            f"rigid robot; found {hinges[0]}"
        )


def check_overlaps(
    modules: Sequence[Module], allow: bool, place: str, moved: Iterable[int] | None = None
) -> tuple[tuple[str, str], ...]:
    """Refuses modules that overlap at rest.

    Args:
        modules: of one robot.
        allow: refuse none.
        place: where, for the message.
        moved: indices of the modules to compare with all; by default all.

    Returns:
        Names of the pairs that overlap, in the modules' order.

    Raises:
        InputError: some overlap and `allow` is not set.
    """
    found = find_overlaps(modules, moved, OVERLAP_TOLERANCE if moved is None else GROWN_TOLERANCE)
    pairs = tuple((modules[i].name, modules[j].name) for i, j in found)
    if pairs and not allow:
        named = ", ".join(f"{a} and {b}" for a, b in pairs[:5])
        more = f" and {len(pairs) - 5} more" if len(pairs) > 5 else ""
        raise InputError(
            f"{place}: expected modules that do not overlap at rest; found overlapping: "
            f"{named}{more} (allow_overlap loads them all the same)"
        )
    return pairs
