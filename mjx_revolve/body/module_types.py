"""What a module type is: boxes, parts, thrusters, a mount, slots and a hinge, all checked.

Every number is SI. A module type is made of parts (rigid boxes); a type with a hinge has a first
part that is fixed to the parent, and further parts that move. `modules.py` holds the catalogue.
"""

from __future__ import annotations

import math
import re
import reprlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from mjx_revolve.body.boxes import union_measure
from mjx_revolve.body.plates import LiftDrag
from mjx_revolve.inputs.errors import InputError

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


def check_vector(value: Any, place: str, unit: str, low: float = -math.inf) -> Vector:
    """Three finite numbers, all above `low`.

    Args:
        value: what the user gave.
        place: where, for the message.
        unit: for the message.
        low: none may be this small.

    Returns:
        The numbers as floats.

    Raises:
        InputError: not three numbers, or one is not finite or too small.
    """
    if not isinstance(value, Sequence | np.ndarray) or isinstance(value, str) or len(value) != 3:
        raise InputError(f"{place}: expected three numbers [{unit}]; found {show(value)}")
    x, y, z = (check_number(v, f"{place}.{i}", unit, low, True) for i, v in enumerate(value))
    return (x, y, z)


def _check_direction(value: Any, place: str) -> Vector:
    """Three numbers, scaled to a unit vector."""
    vector = check_vector(value, place, "-")
    length = math.sqrt(sum(x * x for x in vector))
    if not 1e-9 < length < math.inf:
        raise InputError(f"{place}: expected a direction, not zero; found {list(vector)}")
    x, y, z = (v / length for v in vector)
    return (x, y, z)


def _check_list(value: Any, place: str, unit: str, count: int | None = None) -> tuple[float, ...]:
    """Some finite numbers."""
    listed = isinstance(value, Sequence | np.ndarray) and not isinstance(value, str)
    if not listed or (count is not None and len(value) != count):
        wanted = "a list of numbers" if count is None else f"{count} numbers"
        raise InputError(f"{place}: expected {wanted} [{unit}]; found {show(value)}")
    return tuple(check_number(x, f"{place}.{i}", unit, -math.inf) for i, x in enumerate(value))


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
            size=check_vector(self.size, "box: size", "m", 0.0),
            position=check_vector(self.position, "box: position", "m"),
        )

    @property
    def volume(self) -> float:
        """Volume of the full box [m³]."""
        return self.size[0] * self.size[1] * self.size[2]


CURVES = ("basic", "dead_band", "interpolated")


@dataclass(frozen=True)
class Thruster:
    """A propeller that pushes along an axis; `thrusters.py` holds the laws.

    Commands have no unit: 1 is full ahead, -1 full astern (UUV Simulator's command is the rotor's
    speed; divide by the top speed). Thrust is in newtons at such a command. Out of the water there
    is none.

    Attributes:
        axis: unit vector of positive thrust, part frame.
        position: where it pushes, part frame [m].
        curve: "basic" (k x|x|), "dead_band" (k (x|x| - δ) beyond a dead band) or "interpolated" (a
            broken line).
        gain: k, thrust per command squared [N]; of "dead_band" the one ahead; not for
            "interpolated".
        gain_backward: k astern [N]; "dead_band" only, by default `gain`.
        dead_band: [δ_l, δ_r] around 0, in units of x|x|, between which there is no thrust;
            "dead_band" only [-].
        commands: points of the broken line, rising; "interpolated" only [-].
        thrusts: thrust at each of them; "interpolated" only [N].
        range: lowest and highest command, around 0 [-]; what lies beyond is clamped.
        time_constant: τ of the first-order lag of the command [s]; 0 is no lag.
        torque_ratio: reaction torque about the axis per thrust [m]: positive for a right-handed
            propeller, which turns its robot left-handed as it pushes ahead; negative for a
            left-handed one. K_Q / K_T times the propeller's diameter.

    Raises:
        InputError: a number is out of range, or one is given that the curve does not have.
    """

    axis: Vector = (1.0, 0.0, 0.0)
    position: Vector = (0.0, 0.0, 0.0)
    curve: str = "basic"
    gain: float = 1.0
    gain_backward: float | None = None
    dead_band: tuple[float, float] = (0.0, 0.0)
    commands: tuple[float, ...] = ()
    thrusts: tuple[float, ...] = ()
    range: tuple[float, float] = (-1.0, 1.0)
    time_constant: float = 0.0
    torque_ratio: float = 0.0

    def __post_init__(self) -> None:
        """Checks the numbers."""
        if self.curve not in CURVES:
            raise InputError(
                f"thruster: curve: expected one of {', '.join(CURVES)}; found {show(self.curve)}"
            )
        backward = self.gain_backward
        if backward is not None:
            backward = check_number(backward, "thruster: gain_backward", "N")
        _set(
            self,
            axis=_check_direction(self.axis, "thruster: axis"),
            position=check_vector(self.position, "thruster: position", "m"),
            gain=check_number(self.gain, "thruster: gain", "N"),
            gain_backward=backward,
            dead_band=_check_list(self.dead_band, "thruster: dead_band", "-", 2),
            commands=_check_list(self.commands, "thruster: commands", "-"),
            thrusts=_check_list(self.thrusts, "thruster: thrusts", "N"),
            range=_check_list(self.range, "thruster: range", "-", 2),
            time_constant=check_number(self.time_constant, "thruster: time_constant", "s"),
            torque_ratio=check_number(self.torque_ratio, "thruster: torque_ratio", "m", -math.inf),
        )
        if not self.range[0] <= 0.0 <= self.range[1] or self.range[0] == self.range[1]:
            raise InputError(
                "thruster: range: expected [lowest, highest] around the command 0 [-]; found "
                f"{list(self.range)}"
            )
        if not self.dead_band[0] <= 0.0 <= self.dead_band[1]:
            raise InputError(
                "thruster: dead_band: expected [at most 0, at least 0] [-]; found "
                f"{list(self.dead_band)}"
            )
        self._check_curve()

    def _check_curve(self) -> None:
        """Refuses numbers of another curve, which would do nothing."""
        line = self.curve == "interpolated"
        strange = {
            "gain": line and self.gain != 1.0,
            "gain_backward": self.curve != "dead_band" and self.gain_backward is not None,
            "dead_band": self.curve != "dead_band" and self.dead_band != (0.0, 0.0),
            "commands": not line and self.commands != (),
            "thrusts": not line and self.thrusts != (),
        }
        for name, given in strange.items():
            if given:
                raise InputError(
                    f"thruster: {name}: expected none with curve {self.curve}; found "
                    f"{show(getattr(self, name))}"
                )
        rising = all(a < b for a, b in pairwise(self.commands))
        if line and (len(self.commands) < 2 or len(self.thrusts) != len(self.commands)):
            raise InputError(
                "thruster: commands and thrusts: expected two or more, as many of both; found "
                f"{len(self.commands)} and {len(self.thrusts)}"
            )
        if not rising:
            raise InputError(
                "thruster: commands: expected numbers that rise from each to the next [-]; found "
                f"{list(self.commands)}"
            )

    def thrust_at(self, command: float) -> float:
        """Thrust at a steady command, for tables and pictures; `thrusters.thrust` is for water.

        Args:
            command: clamped to the range [-].

        Returns:
            Thrust along the axis [N].
        """
        x = min(max(command, self.range[0]), self.range[1])
        if self.curve == "interpolated":
            return float(np.interp(x, self.commands, self.thrusts))
        square, (low, high) = x * abs(x), self.dead_band
        backward = self.gain if self.gain_backward is None else self.gain_backward
        return backward * min(square - low, 0.0) + self.gain * max(square - high, 0.0)

    def scaled(self, factor: float) -> Thruster:
        """The same with thrust multiplied by a factor at every command.

        Args:
            factor: at least 0 [-].

        Returns:
            The scaled thruster.
        """
        if self.curve == "interpolated":
            return replace(self, thrusts=tuple(factor * x for x in self.thrusts))
        backward = self.gain_backward
        return replace(
            self,
            gain=factor * self.gain,
            gain_backward=backward if backward is None else factor * backward,
        )


# What a part may choose. MuJoCo's inertia box is missing: it stands for a whole body, not a part.
PART_BUOYANCY = ("partial", "mask", "off")
PART_DRAG = ("faces", "lift_drag", "ellipsoid", "off")


@dataclass(frozen=True)
class Part:
    """A rigid part of a module. Its frame is parallel to the module's while the hinge is at 0.

    Attributes:
        name: unique in its module.
        boxes: what it collides with; the first is its main box, which is the envelope for clipping
            at the surface and for added mass, and is centred on the part's frame.
        mass: [kg], spread evenly over the main box; without the ballast.
        volume: of the material, from the mesh [m³]; what displaces water.
        electronics_volume: sealed volume that the mesh lacks [m³]; displaces water too.
        center_of_volume: of mesh and electronics, part frame [m].
        position: of the part's frame, module frame [m].
        drag_coefficient: of a face that meets the flow [-].
        added_mass_coefficient: multiplies the main box's added mass [-].
        contact: whether it touches the bed.
        buoyancy: "partial", "mask" or "off"; by default the world's choice. What a world switches
            off stays off, here and below.
        drag: "faces", "lift_drag", "ellipsoid" or "off"; by default "lift_drag" for a fin, else the
            world's choice.
        added_mass: false for none; by default the world's choice.
        entrained_water: share of the room in the main box that mesh, electronics and ballast leave
            free, whose water is carried along, 0 to 1 [-].
        ballast_mass: a point mass [kg].
        ballast_volume: a point volume that displaces water: a float, or the ballast's own [m³].
        ballast_position: of both, part frame [m].
        lift_drag: parameters of Gazebo's LiftDrag, which make the part a fin.
        thruster: makes the part a thruster.

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
    buoyancy: str | None = None
    drag: str | None = None
    added_mass: bool | None = None
    entrained_water: float = 0.0
    ballast_mass: float = 0.0
    ballast_volume: float = 0.0
    ballast_position: Vector = (0.0, 0.0, 0.0)
    lift_drag: LiftDrag | None = None
    thruster: Thruster | None = None

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
        for key, known in (("buoyancy", PART_BUOYANCY), ("drag", PART_DRAG)):
            value = getattr(self, key)
            if value is not None and (not isinstance(value, str) or value not in known):
                hint = " (a law of whole bodies: the world's)" if value == "inertia_box" else ""
                raise InputError(
                    f"{place}: {key}: expected one of {', '.join(known)}{hint}; found {show(value)}"
                )
        if self.added_mass is not None and not isinstance(self.added_mass, bool):
            raise InputError(
                f"{place}: added_mass: expected true or false; found {show(self.added_mass)}"
            )
        for key, made in (("lift_drag", LiftDrag), ("thruster", Thruster)):
            value = getattr(self, key)
            if value is not None and not isinstance(value, made):
                raise InputError(f"{place}: {key}: expected a {made.__name__}; found {show(value)}")
        flooded = check_number(self.entrained_water, f"{place}: entrained_water", "-")
        if flooded > 1.0:
            raise InputError(
                f"{place}: entrained_water: expected a share from 0 to 1 [-]; found {flooded:g}"
            )
        _set(
            self,
            boxes=boxes,
            entrained_water=flooded,
            ballast_mass=check_number(self.ballast_mass, f"{place}: ballast_mass", "kg"),
            ballast_volume=check_number(self.ballast_volume, f"{place}: ballast_volume", "m3"),
            ballast_position=check_vector(self.ballast_position, f"{place}: ballast_position", "m"),
            mass=check_number(self.mass, f"{place}: mass", "kg"),
            volume=check_number(self.volume, f"{place}: volume", "m3"),
            electronics_volume=check_number(
                self.electronics_volume, f"{place}: electronics_volume", "m3"
            ),
            center_of_volume=check_vector(self.center_of_volume, f"{place}: center_of_volume", "m"),
            position=check_vector(self.position, f"{place}: position", "m"),
            drag_coefficient=check_number(self.drag_coefficient, f"{place}: drag_coefficient", "-"),
            added_mass_coefficient=check_number(
                self.added_mass_coefficient, f"{place}: added_mass_coefficient", "-"
            ),
        )

    @property
    def total_mass(self) -> float:
        """Mass with its ballast [kg]."""
        return self.mass + self.ballast_mass

    @property
    def total_volume(self) -> float:
        """Displaced volume: mesh, electronics and ballast [m³]."""
        return self.volume + self.electronics_volume + self.ballast_volume

    @property
    def free_volume(self) -> float:
        """Room in the main box that mesh, electronics and ballast leave to the water [m³]."""
        return max(self.boxes[0].volume - self.total_volume, 0.0)

    @property
    def displaced_center(self) -> Vector:
        """Centre of the displaced volume: mesh, electronics and ballast, part frame [m]."""
        whole = self.total_volume
        share = self.ballast_volume / whole if whole > 0.0 else 0.0
        (x, y, z), (u, v, w) = self.center_of_volume, self.ballast_position
        return x + share * (u - x), y + share * (v - y), z + share * (w - z)

    @property
    def center_of_mass(self) -> Vector:
        """Centre of mass, part frame [m]: the main box's centre, but for the ballast."""
        whole = self.total_mass
        share = self.ballast_mass / whole if whole > 0.0 else 0.0
        x, y, z = self.ballast_position
        return share * x, share * y, share * z

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
            anchor=check_vector(self.anchor, "hinge: anchor", "m"),
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
            position=check_vector(self.position, "slot: position", "m"),
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
            position=check_vector(self.position, "mount: position", "m"),
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
        moving = sum(part.total_mass for part in parts[1:])
        if moving <= 0.0:
            raise InputError(
                f"{place}: parts: expected a moving part (the second or later) heavier than 0 kg, "
                f"since it has a hinge; found {moving} kg in {len(parts) - 1} moving parts"
            )

    @property
    def mass(self) -> float:
        """Mass of all parts, ballast included [kg]."""
        return sum(part.total_mass for part in self.parts)

    @property
    def is_fin(self) -> bool:
        """Whether a part of it is a plate with Gazebo's LiftDrag."""
        return any(part.lift_drag is not None for part in self.parts)

    @property
    def is_thruster(self) -> bool:
        """Whether a part of it is a thruster."""
        return any(part.thruster is not None for part in self.parts)

    @property
    def volume(self) -> float:
        """Displaced volume of all parts, electronics and ballast included [m³]."""
        return sum(part.total_volume for part in self.parts)

    @property
    def box_volume(self) -> float:
        """Sum of all boxes' volumes [m³]."""
        return sum(part.box_volume for part in self.parts)
