"""The tree of modules at rest: `Morphology`, its derived quantities, and how it is saved.

The robot's frame is the core's. All positions are in that frame, at rest (hinges at 0), in metres.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from mjx_revolve.body.catalogue import MODULES
from mjx_revolve.body.descriptors import describe
from mjx_revolve.body.module_types import Part, Vector
from mjx_revolve.body.placement import Module, RestPose, frozen, rest_pose, same
from mjx_revolve.body.sensors import Sensor
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.yaml_reader import dump_yaml

COLORS = ("red", "green", "blue")


@dataclass(frozen=True, eq=False, repr=False)
class Morphology:
    """A robot's body as a tree of modules, depth first in the file's order.

    Two morphologies are equal when name, modules, brain and sensors are.

    Attributes:
        name: the file's `id`, or its stem.
        modules: the core first; a parent comes before its children.
        brain: the file's `brain`, uninterpreted; None if it has none.
        path: the file that it was read from.
        overlaps: names of the pairs of modules that overlap at rest (empty unless allowed).
        sensors: the file's `sensors`; None where it has no such key.
    """

    name: str
    modules: tuple[Module, ...]
    brain: Any = None
    path: str | None = None
    overlaps: tuple[tuple[str, str], ...] = ()
    sensors: tuple[Sensor, ...] | None = None

    def with_sensors(self, sensors: tuple[Sensor, ...] | None) -> Morphology:
        """The same with sensors, but for those at modules that it lacks."""
        names = {module.name for module in self.modules}
        kept = (one for one in sensors or () if one.at is None or one.at in names)
        return replace(self, sensors=None if sensors is None else tuple(kept))

    def __eq__(self, other: object) -> bool:
        """Same name, modules, brain and sensors; the path does not count."""
        if not isinstance(other, Morphology):
            return NotImplemented
        return (
            self.name == other.name
            and self.modules == other.modules
            and same(self.brain, other.brain)
            and self.sensors == other.sensors
        )

    def __repr__(self) -> str:
        """One line."""
        return (
            f"Morphology({self.name!r}: {self.num_modules} modules, {self.num_hinges} hinges, "
            f"{self.mass:.4g} kg)"
        )

    def __reduce__(self) -> Any:
        """Pickles small and quickly for other processes: the catalogue's types by name."""
        kinds = {id(kind): kind for m in self.modules for kind in (m.kind, m.base or m.kind)}
        number = {key: k for k, key in enumerate(kinds)}
        rows = [
            (m.name, m.type, m.parent, m.slot, m.orientation, m.rgb, number[id(m.kind)], m.params,
             number[id(m.base or m.kind)])
            for m in self.modules
        ]  # fmt: skip
        named = [k.name if MODULES.get(k.name) is k else k for k in kinds.values()]
        place = np.concatenate([x for m in self.modules for x in (m.position, *m.rotation)])
        head = (self.name, self.brain, self.path, self.overlaps, self.sensors)
        return _unpack, (head, rows, named, place.tobytes())

    @property
    def num_modules(self) -> int:
        """Number of modules; a hinge is one."""
        return len(self.modules)

    @property
    def mass(self) -> float:
        """Mass [kg]."""
        return sum(module.kind.mass for module in self.modules)

    @property
    def volume(self) -> float:
        """Displaced volume, electronics and ballast included [m³]."""
        return sum(module.kind.volume for module in self.modules)

    @property
    def center_of_mass(self) -> np.ndarray:
        """`[3]` centre of mass at rest, core frame [m]."""
        return self._center(lambda part: (part.total_mass, part.center_of_mass))

    @property
    def center_of_volume(self) -> np.ndarray:
        """`[3]` centre of the displaced volume at rest, core frame [m].

        Where it lies above the centre of mass, the robot rights itself under water.
        """
        return self._center(lambda part: (part.total_volume, part.displaced_center))

    def _center(self, look: Callable[[Part], tuple[float, Vector]]) -> np.ndarray:
        """Weighted mean of a point of each part; `look` gives weight and point, part frame."""
        looks = [look(part) for module in self.modules for part in module.kind.parts]
        weight, point = (np.array(column) for column in zip(*looks, strict=True))
        here = self.layout
        center = weight @ (here.position + np.einsum("pij,pj->pi", here.rotation, point))
        return center / weight.sum() if weight.any() else center

    @property
    def box_volume(self) -> float:
        """Sum of all collision boxes' volumes [m³]; shared space counts for each box."""
        return sum(module.kind.box_volume for module in self.modules)

    @property
    def hinges(self) -> tuple[int, ...]:
        """Indices of the modules with a hinge, in order: the order of `ctrl`."""
        return tuple(i for i, m in enumerate(self.modules) if m.kind.hinge is not None)

    @property
    def num_hinges(self) -> int:
        """Number of hinges."""
        return len(self.hinges)

    @property
    def thrusters(self) -> tuple[tuple[int, int], ...]:
        """Module and part of each thruster, in order: the order of `ctrl` after the hinges'."""
        return tuple(
            (i, k)
            for i, module in enumerate(self.modules)
            for k, part in enumerate(module.kind.parts)
            if part.thruster is not None
        )

    @property
    def thruster_names(self) -> tuple[str, ...]:
        """Names of the thrusters' commands: their modules', where there is no other command."""
        rows = [(self.modules[i], k) for i, k in self.thrusters]
        return tuple(
            m.name
            if m.kind.hinge is None and sum(other is m for other, _ in rows) == 1
            else f"{m.name}/{m.kind.parts[k].name}"
            for m, k in rows
        )

    @property
    def num_thrusters(self) -> int:
        """Number of thrusters."""
        return len(self.thrusters)

    @property
    def num_fins(self) -> int:
        """Number of modules with a fin."""
        return sum(module.kind.is_fin for module in self.modules)

    def hinge_neighbours(self) -> tuple[tuple[int, int], ...]:
        """Pairs of hinges that share a rigid body.

        Modules that are welded together are one body; a hinge joins the body that it is attached to
        and the body that it moves.

        Returns:
            pairs (i, j), i < j, of positions in `hinges`, in order.
        """
        count = 0
        carries: list[int] = []  # the hinge that moves a module's children; -1: the core's body
        joined: dict[int, list[int]] = {}
        for module in self.modules:
            body = carries[module.parent] if module.parent >= 0 else -1
            if module.kind.hinge is not None:
                joined.setdefault(body, []).append(count)
                body, count = count, count + 1
                joined[body] = [body]
            carries.append(body)
        # A body's own hinge has the lowest number of those that it joins.
        pairs = (pair for group in joined.values() for pair in itertools.combinations(group, 2))
        return tuple(sorted(pairs))

    @cached_property
    def layout(self) -> RestPose:
        """All parts and boxes at rest as arrays."""
        return rest_pose(self.modules)

    @property
    def title(self) -> str:
        """The name in titles of pictures; evolved bodies, all called `robot`, share one title."""
        return "evolved body" if self.name == "robot" else self.name

    @property
    def counts(self) -> str:
        """Numbers of modules, hinges and thrusters, in words; zeros are left out."""
        counts = {
            "module": self.num_modules, "hinge": self.num_hinges, "thruster": self.num_thrusters,
        }  # fmt: skip
        return ", ".join(f"{n} {name}{'s' * (n > 1)}" for name, n in counts.items() if n)

    @cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """`[3]` lowest and `[3]` highest corner of all boxes at rest, core frame [m]."""
        center, reach = self.layout.box_centers(), self.layout.box_reaches()
        return frozen((center - reach).min(axis=0)), frozen((center + reach).max(axis=0))

    @property
    def extent(self) -> np.ndarray:
        """`[3]` edges of the bounding box at rest along the core's x, y, z [m]."""
        low, high = self.bounds
        return high - low

    @property
    def length(self) -> float:
        """Body length: the largest extent at rest [m]."""
        return float(self.extent.max())

    @cached_property
    def descriptors(self) -> dict[str, float]:
        """Measures of the body; see `descriptors.describe`."""
        return describe(self.modules, self.extent)

    def to_mapping(self) -> dict[str, object]:
        """The body as a mapping like a morphology file; `make_morphology` reads it back.

        Types are given by name: reading a robot with a user's own types takes those types again.

        Returns:
            A new mapping with `id`, `body` and, where there are any, `sensors` and `brain`.
        """
        items: list[dict[str, Any]] = []
        for module in self.modules:
            item: dict[str, Any] = {"id": module.name, "type": module.type}
            turn = module.orientation
            item["orientation"] = int(turn) if turn.is_integer() else turn
            colors = zip(COLORS, module.rgb, strict=True) if module.rgb is not None else ()
            params = {**dict(colors), **copy.deepcopy(dict(module.params))}
            if params:
                item["params"] = params
            items.append(item)
            if module.parent >= 0:
                items[module.parent].setdefault("children", {})[module.slot] = item
        data: dict[str, object] = {"id": self.name, "body": items[0]}
        if self.sensors is not None:
            data["sensors"] = [sensor.to_mapping() for sensor in self.sensors]
        if self.brain is not None:
            data["brain"] = copy.deepcopy(self.brain)
        return data

    def save(self, path: str | Path) -> None:
        """Writes the morphology; see `save_morphology`."""
        save_morphology(self, path)


def _unpack(head: tuple[Any, ...], rows: list[Any], named: list[Any], place: bytes) -> Morphology:
    """The inverse of `Morphology.__reduce__`."""
    kinds = [MODULES[kind] if isinstance(kind, str) else kind for kind in named]
    places = np.frombuffer(place).reshape(-1, 4, 3)
    modules = [
        Module(own, type, parent, slot, turn, rgb, at[0], at[1:], kinds[kind], params, kinds[base])
        for (own, type, parent, slot, turn, rgb, kind, params, base), at in zip(
            rows, places, strict=True
        )
    ]
    name, *rest = head
    return Morphology(name, tuple(modules), *rest)


def free_name(stem: str, taken: Collection[str], first: int = 2) -> str:
    """The stem with the first free of the suffixes _2, _3 and so on."""
    numbered = (f"{stem}_{k}" for k in itertools.count(first))
    return next(name for name in numbered if name not in taken)


def save_morphology(morphology: Morphology, path: str | Path) -> None:
    """Writes a robot's body as YAML that `load_morphology` reads back to an equal morphology.

    Types are written by name: reading a robot with a user's own types takes those types again.

    Args:
        morphology: the robot.
        path: the file.

    Raises:
        InputError: the file cannot be written, or `params` or `brain` hold what YAML cannot.
    """
    try:
        data = morphology.to_mapping()
        text = dump_yaml(data)
        Path(path).write_text(text, encoding="utf-8")
    except (ValueError, RecursionError, yaml.YAMLError) as error:
        found = str(error).splitlines()[0]
        raise InputError(f"{path}: expected values that YAML can hold; found: {found}") from None
    except OSError as error:
        raise InputError(f"{path}: expected a file to write; found: {error.strerror}") from None
