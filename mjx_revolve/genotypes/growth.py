"""A body while it grows, module after module: what would overlap or exceed a bound is left out."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from mjx_revolve.body.boxes import boxes_overlap
from mjx_revolve.body.module_types import ModuleType, Part
from mjx_revolve.body.placement import OVERLAP_TOLERANCE, Module, attach, frozen
from mjx_revolve.body.tree import Morphology
from mjx_revolve.genotypes.genotype import SLACK, Space

_ORIGIN = frozen(np.zeros(3)), frozen(np.eye(3))
# By how much boxes have to overlap [m], as in `boxes_overlap`.
_HAIR = 1e-9


def name_place(kind: ModuleType, path: tuple[int, ...]) -> str:
    """What a module is called that has no name of its own: its type, and the way to it.

    Args:
        kind: its type.
        path: slots from the core on.

    Returns:
        Such as `ActiveHinge-1-1`. There is no `_` in it, so that the `_2` of a copy tells what it
        is a copy of.
    """
    return "-".join((kind.name, *map(str, path)))


class Growth:
    """A body that grows from its core.

    It refuses what `find_overlaps` finds, but compares each new module with those that are there in
    plain numbers, which takes a twentieth of a millisecond.

    Attributes:
        modules: in the order in which they came.
        num_hinges: how many of them have one.
    """

    def __init__(self, space: Space, seed: Morphology | None = None) -> None:
        """Begins with a core.

        Args:
            space: whose upper bounds are kept; the lower ones are for who grows the body to see.
            seed: a body whose core it begins with, and whose modules' names are kept for them; by
                default it begins with a core of the space's type.
        """
        kind = space.catalogue[space.core]
        core = Module("core", kind.name, -1, -1, 0.0, None, *_ORIGIN, kind)
        first = seed.modules[0] if seed else core
        self._space = space
        self._names = {m.name for m in seed.modules} if seed else {core.name}
        self.modules: list[Module] = []
        self.num_hinges = 0
        self._mass = 0.0
        self._children: list[list[int]] = []
        self._paths: list[tuple[int, ...]] = []
        self._boxes: list[_Boxes] = []
        self._low = self._high = _ORIGIN[0]
        self._take(first, (), _place_boxes(first.kind, first.position, first.rotation))

    @property
    def is_full(self) -> bool:
        """Whether there is room for no further module."""
        return len(self.modules) >= self._space.max_modules

    def child(self, parent: int, slot: int) -> int | None:
        """Index of the module at a slot; None where it is free."""
        found = (i for i in self._children[parent] if self.modules[i].slot == slot)
        return next(found, None)

    def attach(
        self,
        parent: int,
        slot: int,
        kind: ModuleType,
        orientation: float = 0.0,
        like: Module | None = None,
    ) -> int | None:
        """Adds a module, if its slot is free and it neither overlaps nor exceeds a bound.

        Args:
            parent: index of the module that carries it.
            slot: one of the parent's slots.
            kind: its type.
            orientation: turn about the direction in which it is attached [deg].
            like: a module of the seed whose name, colour and params it gets; it then comes behind
                its siblings, where others come before those of higher slots.

        Returns:
            Its index; None where it was left out.
        """
        space, above = self._space, self.modules[parent]
        if self.is_full or self.child(parent, slot) is not None:
            return None
        if kind.hinge is not None and self.num_hinges >= space.max_hinges:
            return None
        if space.max_mass is not None and self._mass + kind.mass > space.max_mass * SLACK:
            return None
        position, rotation = attach(above, above.kind.slots[slot], kind, orientation)
        boxes = _place_boxes(kind, position, rotation)
        if space.max_length is not None:
            extent = np.maximum(self._high, boxes.high) - np.minimum(self._low, boxes.low)
            if extent.max() > space.max_length * SLACK:
                return None
        if any(k != parent and _overlap(boxes, other) for k, other in enumerate(self._boxes)):
            return None
        path = (*self._paths[parent], slot)
        own: Any = (self._free_name(kind, path), None, {})
        name, rgb, params = (like.name, like.rgb, like.params) if like else own
        index, siblings = len(self.modules), self._children[parent]
        after = [k for k, i in enumerate(siblings) if self.modules[i].slot > slot]
        siblings.insert(after[0] if after and not like else len(siblings), index)
        module = Module(
            name, kind.name, parent, slot, orientation, rgb, position, rotation, kind, params
        )
        self._take(module, path, boxes)
        return index

    def _free_name(self, kind: ModuleType, path: tuple[int, ...]) -> str:
        """The name of a place, told apart from a seed's module that has it."""
        stem = name = name_place(kind, path)
        count = 2
        while name in self._names:
            name, count = f"{stem}_{count}", count + 1
        return name

    def _take(self, module: Module, path: tuple[int, ...], boxes: _Boxes) -> None:
        self.modules.append(module)
        self._names.add(module.name)
        self._children.append([])
        self._paths.append(path)
        self._boxes.append(boxes)
        self.num_hinges += module.kind.hinge is not None
        self._mass += module.kind.mass
        self._low = np.minimum(self._low, boxes.low)
        self._high = np.maximum(self._high, boxes.high)

    def finish(self, name: str) -> Morphology:
        """The body as it is, modules depth first.

        Args:
            name: of the body.

        Returns:
            The body.
        """
        order: list[int] = []
        stack = [0]
        while stack:
            order.append(stack.pop())
            stack.extend(reversed(self._children[order[-1]]))
        place = {index: k for k, index in enumerate(order)} | {-1: -1}
        modules = (self.modules[index] for index in order)
        return Morphology(name, tuple(replace(m, parent=place[m.parent]) for m in modules))


# ------------------------------------------------------------------------- boxes


class _Boxes(NamedTuple):
    """A module's boxes in their place.

    Attributes:
        center: of each part's main box, core frame [m].
        reach: of each, how far it reaches along the core's axes [m].
        half: `[npart, 3]` their half edges, module frame [m].
        rotation: `[3, 3]` core frame from module frame.
        is_level: whether the boxes lie along the core's axes.
        low: `[3]` lowest corner of all boxes, core frame [m].
        high: `[3]` highest corner.
    """

    center: list[list[float]]
    reach: list[list[float]]
    half: np.ndarray
    rotation: np.ndarray
    is_level: bool
    low: np.ndarray
    high: np.ndarray


@lru_cache(maxsize=4096)
def _shape(parts: _Same) -> tuple[np.ndarray, ...]:
    """Main boxes, centre and shrunk half edges, then all boxes likewise, module frame [m]."""
    mains = [(part.position, part.boxes[0].size) for part in parts.value]
    center = np.array([position for position, _ in mains])
    half = np.array([size for _, size in mains]) / 2
    boxes = [(part.position, box) for part in parts.value for box in part.boxes]
    middle = np.array([np.add(position, box.position) for position, box in boxes])
    return (
        center,
        half - np.minimum(OVERLAP_TOLERANCE, half / 2),
        middle,
        np.array([box.size for _, box in boxes]) / 2,
    )


class _Same:
    """A value that is told apart from others by what it is, not by what is in it."""

    def __init__(self, value: tuple[Part, ...]) -> None:
        self.value = value

    def __hash__(self) -> int:
        return id(self.value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self.value is other.value


def _place_boxes(kind: ModuleType, position: np.ndarray, rotation: np.ndarray) -> _Boxes:
    """A module's boxes in their place."""
    center, half, middle, whole = _shape(_Same(kind.parts))
    turn = np.abs(rotation)
    middle, whole = position + middle @ rotation.T, whole @ turn.T
    return _Boxes(
        center=(position + center @ rotation.T).tolist(),
        reach=(half @ turn.T).tolist(),
        half=half,
        rotation=rotation,
        is_level=bool(turn.sum() < 3 + _HAIR),
        low=(middle - whole).min(axis=0),
        high=(middle + whole).max(axis=0),
    )


def _overlap(one: _Boxes, other: _Boxes) -> bool:
    """Whether main boxes of two modules overlap."""
    for i, ((x, y, z), (u, v, w)) in enumerate(zip(one.center, one.reach, strict=True)):
        for j, ((a, b, c), (d, e, f)) in enumerate(zip(other.center, other.reach, strict=True)):
            if abs(x - a) - u - d < -_HAIR and abs(y - b) - v - e < -_HAIR:
                if abs(z - c) - w - f >= -_HAIR:
                    continue
                # Boxes along the core's axes fill what they reach; others need a closer look.
                if one.is_level and other.is_level:
                    return True
                sides = [
                    (np.array([side.center[k]]), side.rotation[None], side.half[k : k + 1])
                    for side, k in ((one, i), (other, j))
                ]
                if boxes_overlap(*sides[0], *sides[1])[0]:
                    return True
    return False
