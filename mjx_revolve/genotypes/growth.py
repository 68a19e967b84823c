"""Growth of a body, module by module; modules that overlap or exceed a bound are left out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np

from mjx_revolve.body.boxes import boxes_overlap
from mjx_revolve.body.module_types import ModuleType
from mjx_revolve.body.placement import GROWN_TOLERANCE, Module, attach, frozen
from mjx_revolve.body.tree import Morphology, free_name
from mjx_revolve.genotypes.genotype import SLACK, Space, cached

_ORIGIN = frozen(np.zeros(3)), frozen(np.eye(3))
# By how much boxes have to overlap [m], as in `boxes_overlap`.
_HAIR = 1e-9


def name_place(kind: ModuleType, path: tuple[int, ...]) -> str:
    """The name of a module: its type and the slots from the core to it, as `ActiveHinge-1-1`.

    It has no `_`, which is for suffixes of copies.
    """
    return "-".join((kind.name, *map(str, path)))


class Growth:
    """A body that grows from its core.

    It refuses the same overlaps as `find_overlaps`, but compares each new module with the earlier
    ones in plain Python numbers, in a twentieth of a millisecond.

    Attributes:
        modules: in the order of attachment.
        num_hinges: number of modules with a hinge.
    """

    def __init__(self, space: Space, seed: Morphology | None = None) -> None:
        """Begins with a core.

        Args:
            space: gives the upper bounds; lower ones are left to the caller.
            seed: gives the core, and reserves the names of its modules; by
                default it begins with a core of the space's type.
        """
        kind = space.catalogue[space.core]
        core = Module("core", kind.name, -1, -1, 0.0, None, *_ORIGIN, kind)
        given = seed.modules if seed else (core,)
        self._space = space
        self._names = {module.name for module in given}
        self.modules: list[Module] = []
        self.num_hinges = 0
        self._mass = 0.0
        self._children: list[list[int]] = []
        self._paths: list[tuple[int, ...]] = []
        # All main boxes, each with its module and its index there; and the shapes of all modules.
        self._mains: list[tuple[float, float, float, float, float, float, int, int]] = []
        self._shapes: list[_Shape] = []
        self._low = self._high = [0.0, 0.0, 0.0]
        self._take(given[0], (), _shapes(given[0].kind)(given[0].rotation.tobytes()))

    @property
    def is_full(self) -> bool:
        """Whether the body has the largest number of modules."""
        return len(self.modules) >= self._space.max_modules

    def has_room(self, kind: ModuleType) -> bool:
        """Whether the bounds on hinges and on the type allow another module of it."""
        if kind.hinge is not None and self.num_hinges >= self._space.max_hinges:
            return False
        most = self._space.max_of.get(kind.name)
        return most is None or sum(module.kind.name == kind.name for module in self.modules) < most

    def child(self, parent: int, slot: int) -> int | None:
        """Index of the module at a slot; None where it is free."""
        found = (i for i in self._children[parent] if self.modules[i].slot == slot)
        return next(found, None)

    def direction(self, index: int, slot: int) -> list[float]:
        """Direction of one of a module's slots: a unit vector, core frame."""
        return self._shapes[index].ways[slot]

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
            like: a module of the seed, of which the new one has name, colour and params; it is then
                appended to its siblings, while others are inserted in the order of slots.

        Returns:
            Its index; None if it was left out.
        """
        space, above = self._space, self.modules[parent]
        if self.is_full or self.child(parent, slot) is not None or not self.has_room(kind):
            return None
        if space.max_mass is not None and self._mass + kind.mass > space.max_mass * SLACK:
            return None
        position, rotation = attach(above, above.kind.slots[slot], kind, orientation)
        shape, place = _shapes(kind)(rotation.tobytes()), position.tolist()
        if space.max_length is not None:
            low, high = self._reach(shape, place)
            extent = max(b - a for a, b in zip(low, high, strict=True))
            if extent > space.max_length * SLACK:
                return None
        if self._hits(shape, place, parent):
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
        self._take(module, path, shape)
        return index

    def _free_name(self, kind: ModuleType, path: tuple[int, ...]) -> str:
        """The name from `name_place`, made different from those of the seed's modules."""
        name = name_place(kind, path)
        return free_name(name, self._names) if name in self._names else name

    def _take(self, module: Module, path: tuple[int, ...], shape: _Shape) -> None:
        """Adds a module that was checked."""
        index, place = len(self.modules), module.position.tolist()
        self._mains += [
            (*(a + b for a, b in zip(place, center, strict=True)), *reach, index, k)
            for k, (center, reach) in enumerate(shape.mains)
        ]
        self._low, self._high = self._reach(shape, place)
        self.modules.append(module)
        self._names.add(module.name)
        self._children.append([])
        self._paths.append(path)
        self._shapes.append(shape)
        self.num_hinges += module.kind.hinge is not None
        self._mass += module.kind.mass

    def _reach(self, shape: _Shape, place: list[float]) -> tuple[list[float], list[float]]:
        """Lowest and highest corner of the body with another module, core frame [m]."""
        low = [min(a, b + c) for a, b, c in zip(self._low, place, shape.low, strict=True)]
        high = [max(a, b + c) for a, b, c in zip(self._high, place, shape.high, strict=True)]
        return low, high

    def _hits(self, shape: _Shape, place: list[float], parent: int) -> bool:
        """Whether a module would overlap with any other than its parent."""
        for number, (center, (u, v, w)) in enumerate(shape.mains):
            x, y, z = (a + b for a, b in zip(place, center, strict=True))
            for a, b, c, d, e, f, index, k in self._mains:
                if (
                    abs(x - a) - u - d < -_HAIR
                    and abs(y - b) - v - e < -_HAIR
                    and abs(z - c) - w - f < -_HAIR
                    and index != parent
                ):
                    # For boxes along the core's axes that is exact; others need the exact test.
                    other = self._shapes[index]
                    if shape.is_level and other.is_level:
                        return True
                    one = np.array([[x, y, z]]), shape.rotation[None], shape.half[[number]]
                    two = np.array([[a, b, c]]), other.rotation[None], other.half[[k]]
                    if boxes_overlap(*one, *two)[0]:
                        return True
        return False

    def finish(self, name: str) -> Morphology:
        """The body with a name, modules depth first."""
        order: list[int] = []
        stack = [0]
        while stack:
            order.append(stack.pop())
            stack.extend(reversed(self._children[order[-1]]))
        place = {index: k for k, index in enumerate(order)} | {-1: -1}
        found = []
        for module in (self.modules[index] for index in order):
            parent = place[module.parent]
            found.append(module if parent == module.parent else replace(module, parent=parent))
        return Morphology(name, tuple(found))


# ------------------------------------------------------------------------- boxes


class _Shape(NamedTuple):
    """A module's boxes and slots, rotated to the core's axes, relative to the module's position.

    Attributes:
        mains: for each part's main box, shrunk: its centre and half extents along the core's axes
            [m].
        half: `[npart, 3]` their half edges, module frame [m].
        rotation: `[3, 3]` core frame from module frame.
        is_level: whether the boxes are parallel to the core's axes.
        low: lowest corner of all boxes, core's axes [m].
        high: highest corner.
        ways: directions of the slots, core's axes.
    """

    mains: list[tuple[list[float], list[float]]]
    half: np.ndarray
    rotation: np.ndarray
    is_level: bool
    low: list[float]
    high: list[float]
    ways: dict[int, list[float]]


@cached
def _shapes(kind: ModuleType) -> Callable[[bytes], _Shape]:
    """Rotation → a type's boxes and slots, rotated; cached, as there are few rotations."""
    return lru_cache(maxsize=4096)(partial(_shape, kind))


def _shape(kind: ModuleType, turn: bytes) -> _Shape:
    parts = kind.parts
    rotation = frozen(np.frombuffer(turn).reshape(3, 3))
    reach = np.abs(rotation).T
    center = np.array([part.position for part in parts])
    half = np.array([part.boxes[0].size for part in parts]) / 2
    half = half - np.minimum(GROWN_TOLERANCE, half / 2)
    boxes = [(part.position, box) for part in parts for box in part.boxes]
    middle = np.array([np.add(place, box.position) for place, box in boxes]) @ rotation.T
    whole = np.array([box.size for _, box in boxes]) / 2 @ reach
    mains = zip((center @ rotation.T).tolist(), (half @ reach).tolist(), strict=True)
    slots = kind.slots.items()
    return _Shape(
        mains=[*mains],
        half=half,
        rotation=rotation,
        is_level=bool(reach.sum() < 3 + _HAIR),
        low=(middle - whole).min(axis=0).tolist(),
        high=(middle + whole).max(axis=0).tolist(),
        ways={number: (rotation @ slot.direction).tolist() for number, slot in slots},
    )
