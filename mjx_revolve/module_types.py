"""What a module type is: boxes, parts, a mount, slots and a hinge, all checked.

Every number is SI. A module type is made of parts (rigid boxes); a type with a hinge has a first
part that is fixed to the parent, and further parts that move. `modules.py` holds the catalogue.
"""

from __future__ import annotations

import math
import re
import reprlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from mjx_revolve.boxes import union_measure
from mjx_revolve.errors import InputError

Vector = tuple[float, float, float]

# Drag of a cube that faces the flow: Hoerner, Fluid-Dynamic Drag, 1965, chapter 3.
CUBE_DRAG = 1.05

_TYPE_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")


# ------------------------------------------------------------------------- checks


def show(value: Any) -> str:
    """A value as a message shows it: short, whatever it is."""
    try:
        return reprlib.repr(value)
    except ValueError:  # Python refuses to print integers of more than 4300 digits
        return "a huge integer"


def check_number(value: Any, place: str, unit: str, low: float = 0.0, above: bool = False) -> float:
    """A finite number that is at least `low`.

    Args:
        value: what the user gave.
        place: where, for the message.
        unit: for the message.
        low: the smallest value allowed.
        above: refuse `low` itself too.

    Returns:
        The number as a float.

    Raises:
        InputError: not a number, not finite, or too small.
    """
    try:
        number = isinstance(value, int | float | np.integer | np.floating)
        found = float(value) if number and not isinstance(value, bool) else math.nan
    except OverflowError:  # an integer of more than 308 digits
        found = math.inf
    if not math.isfinite(found) or found < low or (above and found <= low):
        bound = "" if low == -math.inf else f" {'>' if above else '>='} {low:g}"
        raise InputError(f"{place}: expected a number{bound} [{unit}]; found {show(value)}")
    return found


def _check_vector(value: Any, place: str, unit: str, low: float = -math.inf) -> Vector:
    """Three finite numbers, all above `low`."""
    if not isinstance(value, Sequence | np.ndarray) or isinstance(value, str) or len(value) != 3:
        raise InputError(f"{place}: expected three numbers [{unit}]; found {show(value)}")
    x, y, z = (check_number(v, f"{place}.{i}", unit, low, True) for i, v in enumerate(value))
    return (x, y, z)


def _check_direction(value: Any, place: str) -> Vector:
    """Three numbers, scaled to a unit vector."""
    vector = _check_vector(value, place, "-")
    length = math.sqrt(sum(x * x for x in vector))
    if not 1e-9 < length < math.inf:
        raise InputError(f"{place}: expected a direction, not zero; found {list(vector)}")
    x, y, z = (v / length for v in vector)
    return (x, y, z)


def _set(target: Any, **values: Any) -> None:
    """Stores checked values in a frozen dataclass under construction."""
    for name, value in values.items():
        object.__setattr__(target, name, value)


# ------------------------------------------------------------------------- types


@dataclass(frozen=True)
class Box:
    """An axis-aligned box.

    Attributes:
        size: edges along x, y, z [m].
        position: its centre, part frame [m].

    Raises:
        InputError: an edge is not positive, or a number is not finite.
    """

    size: Vector
    position: Vector = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        """Checks the numbers."""
        _set(
            self,
            size=_check_vector(self.size, "box: size", "m", 0.0),
            position=_check_vector(self.position, "box: position", "m"),
        )

    @property
    def volume(self) -> float:
        """Volume of the full box [m³]."""
        return self.size[0] * self.size[1] * self.size[2]


@dataclass(frozen=True)
class Part:
    """A rigid part of a module. Its frame is parallel to the module's while the hinge is at 0.

    Attributes:
        name: unique in its module.
        boxes: what it collides with; the first is its main box, which is the envelope for clipping
            at the surface and for added mass, and is centred on the part's frame.
        mass: [kg], spread evenly over the main box.
        volume: of the material, from the mesh [m³]; what displaces water.
        electronics_volume: sealed volume that the mesh lacks [m³]; displaces water too.
        center_of_volume: of the displaced water, part frame [m].
        position: of the part's frame, module frame [m].
        drag_coefficient: of a face that meets the flow [-].
        added_mass_coefficient: multiplies the main box's added mass [-].
        contact: whether it touches the bed.

    Raises:
        InputError: a number is out of range; the message names part and field.
    """

    name: str
    boxes: tuple[Box, ...]
    mass: float
    volume: float
    electronics_volume: float = 0.0
    center_of_volume: Vector = (0.0, 0.0, 0.0)
    position: Vector = (0.0, 0.0, 0.0)
    drag_coefficient: float = CUBE_DRAG
    added_mass_coefficient: float = 1.0
    contact: bool = True

    def __post_init__(self) -> None:
        """Checks the numbers."""
        place = f"part {show(self.name)}"
        if not isinstance(self.name, str) or not _TYPE_NAME.fullmatch(self.name):
            raise InputError(
                f"{place}: name: expected letters, digits, _ or -, beginning with a letter; "
                f"found {show(self.name)}"
            )
        boxes = tuple(self.boxes)
        if not boxes or not all(isinstance(box, Box) for box in boxes):
            raise InputError(f"{place}: boxes: expected at least one box; found {len(boxes)}")
        if any(boxes[0].position):
            raise InputError(
                f"{place}: boxes.0.position: expected [0, 0, 0] (the part's frame lies at the "
                f"centre of its main box: move the part); found {list(boxes[0].position)}"
            )
        if not isinstance(self.contact, bool):
            raise InputError(
                f"{place}: contact: expected true or false; found {show(self.contact)}"
            )
        _set(
            self,
            boxes=boxes,
            mass=check_number(self.mass, f"{place}: mass", "kg"),
            volume=check_number(self.volume, f"{place}: volume", "m3"),
            electronics_volume=check_number(
                self.electronics_volume, f"{place}: electronics_volume", "m3"
            ),
            center_of_volume=_check_vector(
                self.center_of_volume, f"{place}: center_of_volume", "m"
            ),
            position=_check_vector(self.position, f"{place}: position", "m"),
            drag_coefficient=check_number(self.drag_coefficient, f"{place}: drag_coefficient", "-"),
            added_mass_coefficient=check_number(
                self.added_mass_coefficient, f"{place}: added_mass_coefficient", "-"
            ),
        )

    @property
    def total_volume(self) -> float:
        """Displaced volume, mesh and electronics [m³]."""
        return self.volume + self.electronics_volume

    @property
    def box_volume(self) -> float:
        """Sum of its boxes' volumes [m³]; where boxes overlap, that share counts twice."""
        return sum(box.volume for box in self.boxes)

    @cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """`[3]` lowest and `[3]` highest corner of the boxes, part frame [m]."""
        center = np.array([box.position for box in self.boxes])
        half = np.array([box.size for box in self.boxes]) / 2
        return (center - half).min(0), (center + half).max(0)

    @cached_property
    def face_areas(self) -> np.ndarray:
        """`[3]` silhouette of all boxes together, seen along x, y, z of the part frame [m²]."""
        center = np.array([box.position for box in self.boxes])
        half = np.array([box.size for box in self.boxes]) / 2
        low, high = center - half, center + half
        sides = [[1, 2], [0, 2], [0, 1]]
        return np.array([union_measure(low[:, s], high[:, s]) for s in sides])


@dataclass(frozen=True)
class Hinge:
    """A motorised hinge between a module's first part and its other parts.

    Attributes:
        axis: unit vector, module frame.
        anchor: a point on the axis, module frame [m].
        range: lowest and highest angle [rad]; contains 0, the rest pose.
        effort: largest torque [N·m].
        speed: largest angular speed [rad/s].

    Raises:
        InputError: a number is out of range.
    """

    axis: Vector
    anchor: Vector
    range: tuple[float, float]
    effort: float
    speed: float

    def __post_init__(self) -> None:
        """Checks the numbers."""
        limits = self.range
        if not isinstance(limits, Sequence) or isinstance(limits, str) or len(limits) != 2:
            raise InputError(f"hinge: range: expected two angles [rad]; found {show(limits)}")
        low, high = (
            check_number(x, f"hinge: range.{i}", "rad", -math.inf) for i, x in enumerate(limits)
        )
        if not low <= 0.0 <= high or low == high:
            raise InputError(
                "hinge: range: expected [lowest, highest] around the rest angle 0 [rad]; "
                f"found {[low, high]}"
            )
        _set(
            self,
            axis=_check_direction(self.axis, "hinge: axis"),
            anchor=_check_vector(self.anchor, "hinge: anchor", "m"),
            range=(low, high),
            effort=check_number(self.effort, "hinge: effort", "N m", above=True),
            speed=check_number(self.speed, "hinge: speed", "rad/s", above=True),
        )


@dataclass(frozen=True)
class Slot:
    """Where a child can be attached.

    Attributes:
        position: where the child's mount comes to lie, module frame [m].
        direction: unit vector along which the child looks, module frame.
        up: unit vector along which the child's z points (before its `orientation` turns it), module
            frame; perpendicular to `direction`.

    Raises:
        InputError: a number is out of range, or `up` is not perpendicular to `direction`.
    """

    position: Vector
    direction: Vector
    up: Vector = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        """Checks the numbers."""
        _set(
            self,
            position=_check_vector(self.position, "slot: position", "m"),
            direction=_check_direction(self.direction, "slot: direction"),
            up=_check_direction(self.up, "slot: up"),
        )
        if abs(np.dot(self.direction, self.up)) > 1e-9:
            raise InputError(
                f"slot: up: expected a vector perpendicular to direction {list(self.direction)}; "
                f"found {list(self.up)}"
            )


@dataclass(frozen=True)
class Mount:
    """Where a module is attached to its parent.

    Attributes:
        position: the point that comes to lie at the parent's slot, module frame [m].
        outward: unit vector away from the parent, module frame; perpendicular to z.

    Raises:
        InputError: a number is out of range, or `outward` is not level.
    """

    position: Vector
    outward: Vector

    def __post_init__(self) -> None:
        """Checks the numbers."""
        _set(
            self,
            position=_check_vector(self.position, "mount: position", "m"),
            outward=_check_direction(self.outward, "mount: outward"),
        )
        if abs(self.outward[2]) > 1e-9:
            raise InputError(
                "mount: outward: expected a vector perpendicular to the module's z; "
                f"found {list(self.outward)}"
            )


@dataclass(frozen=True)
class ModuleType:
    """A type of module.

    Attributes:
        name: the `type` in a morphology file.
        parts: with a hinge, the first is fixed to the parent's body, the others and all slots move.
        mount: where it is attached to its parent; None for a core, the root of a robot.
        slots: where children can be attached, by number; 0 is kept for the mount where there is
            one.
        hinge: the motorised hinge, if there is one.
        sensor: a sensor; left out of the descriptors that count a body's size.
        aliases: further names in morphology files.

    Raises:
        InputError: the pieces do not make a module; the message names module and field.
    """

    name: str
    parts: tuple[Part, ...]
    mount: Mount | None = None
    slots: dict[int, Slot] = field(default_factory=dict)
    hinge: Hinge | None = None
    sensor: bool = False
    aliases: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Checks that the pieces make a module."""
        parts, aliases = tuple(self.parts), tuple(self.aliases)
        _set(self, parts=parts, aliases=aliases, slots=dict(self.slots))
        for name in (self.name, *aliases):
            if not isinstance(name, str) or not _TYPE_NAME.fullmatch(name):
                raise InputError(
                    f"module {show(self.name)}: name: expected letters, digits, _ or -, beginning "
                    f"with a letter; found {show(name)}"
                )
        place = f"module {show(self.name)}"
        names = [part.name for part in parts]
        if not parts or len(set(names)) < len(names):
            raise InputError(f"{place}: parts: expected parts, each name once; found {names}")
        for number in self.slots:
            if not isinstance(number, int) or isinstance(number, bool) or number < 0:
                raise InputError(f"{place}: slots: expected numbers >= 0; found {show(number)}")
        if self.mount is not None and 0 in self.slots:
            raise InputError(
                f"{place}: slots: expected numbers >= 1 (0 is where it is attached); found 0"
            )
        if not isinstance(self.sensor, bool):
            raise InputError(f"{place}: sensor: expected true or false; found {show(self.sensor)}")
        if self.mount is None and self.mass <= 0.0:
            raise InputError(f"{place}: mass: expected a core heavier than 0 kg; found {self.mass}")
        if self.hinge is None:
            return
        if self.mount is None:
            raise InputError(f"{place}: mount: expected one, since it has a hinge; found none")
        moving = sum(part.mass for part in parts[1:])
        if moving <= 0.0:
            raise InputError(
                f"{place}: parts: expected a moving part (the second or later) heavier than 0 kg, "
                f"since it has a hinge; found {moving} kg in {len(parts) - 1} moving parts"
            )

    @property
    def mass(self) -> float:
        """Mass of all parts [kg]."""
        return sum(part.mass for part in self.parts)

    @property
    def volume(self) -> float:
        """Displaced volume of all parts, electronics included [m³]."""
        return sum(part.total_volume for part in self.parts)

    @property
    def box_volume(self) -> float:
        """Sum of all boxes' volumes [m³]."""
        return sum(part.box_volume for part in self.parts)
