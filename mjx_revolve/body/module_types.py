"""What a module type is: boxes, parts, a mount, slots and a hinge, all checked.

Every number is SI. A module type is made of parts (rigid boxes); a type with a hinge has a first
part that is fixed to the parent, and further parts that move. `catalogue.py` holds ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field
from functools import cached_property
from typing import Annotated

import numpy as np
from annotated_types import Ge, Unit
from pydantic import StringConstraints

from mjx_revolve.body.boxes import union_measure
from mjx_revolve.body.sensors import SensorRow
from mjx_revolve.body.servo import EFFORT, REACH, SPEED
from mjx_revolve.inputs.schema import (
    Boolean,
    ConstraintError,
    Direction,
    Integer,
    NonNegative,
    Number,
    Pair,
    Positive,
    Share,
    Text,
    Triple,
    TupleOf,
    Vector,
    checked,
    show,
    words,
)
from mjx_revolve.water.law_names import BuoyancyName, Coefficients, Factors, PartDrag, PerAxis
from mjx_revolve.water.plates import CUBE_DRAG
from mjx_revolve.water.plates import Fossen as Fossen
from mjx_revolve.water.plates import LiftDrag as LiftDrag
from mjx_revolve.water.propellers import Thruster as Thruster

Name = Annotated[
    Text,
    StringConstraints(pattern=r"^[A-Za-z][A-Za-z0-9_-]*$"),
    words("letters, digits, _ or -, beginning with a letter"),
]


@checked
class Box:
    """An axis-aligned box.

    Attributes:
        size: edges along x, y, z [m].
        position: its centre, part frame [m].

    Raises:
        InputError: an edge is not positive, or a number is not finite.
    """

    size: Annotated[Triple[Positive], Unit("m")]
    position: Annotated[Vector, Unit("m")] = (0.0, 0.0, 0.0)

    @property
    def volume(self) -> float:
        """Volume of the full box [m³]."""
        return self.size[0] * self.size[1] * self.size[2]


def box_corners(boxes: Sequence[Box]) -> tuple[np.ndarray, np.ndarray]:
    """`[n, 3]` lowest and `[n, 3]` highest corners of boxes [m]."""
    center = np.array([box.position for box in boxes])
    half = np.array([box.size for box in boxes]) / 2
    return center - half, center + half


@checked
class Part:
    """A rigid part of a module. Its frame is parallel to the module's while the hinge is at 0.

    Attributes:
        name: unique in its module.
        boxes: collision boxes; the first is the main box, the envelope for clipping at the surface
            and for added mass, centred on the part's frame.
        mass: [kg], uniform over the main box; without the ballast.
        volume: of the material, from the mesh [m³]; it displaces water.
        electronics_volume: sealed volume that the mesh lacks [m³]; displaces water too.
        center_of_volume: of mesh and electronics, part frame [m].
        position: of the part's frame, module frame [m].
        coefficients: of laws, by name; by default the world's.
        drag_coefficient: of a face that meets the flow, or three, across the part's axes [-].
        added_mass_coefficient: multiplies the main box's added mass; or three, along its axes [-].
        factors: fitted factors on coefficients of laws, by name, on LAW.FIELD of laws with
            parameters, or on all coefficients of `drag` or `added_mass` together.
        contact: whether it touches the bed, other parts and other robots.
        buoyancy: name of a buoyancy law; by default the world's. A law that the world switches off
            stays off; so for `drag` and `added_mass`.
        drag: name of a drag law of parts; by default "fossen" where that is stated, "lift_drag" for
            a fin, else the world's choice.
        added_mass: false for none; by default the world's choice.
        entrained_water: water that moves with the part, as a share of the main box's volume without
            mesh, electronics and ballast, 0 to 1 [-].
        ballast_mass: a point mass [kg].
        ballast_volume: a point volume that displaces water: a float, or the ballast's own [m³].
        ballast_position: of both, part frame [m].
        lift_drag: parameters of Gazebo's LiftDrag, which make the part a fin.
        fossen: added mass and damping from another source, in place of those of our laws and of
            the entrained water.
        thruster: makes the part a thruster.

    Raises:
        InputError: a number is out of range; the message names part and field.
    """

    name: Name
    boxes: TupleOf[Box]
    mass: Annotated[NonNegative, Unit("kg")]
    volume: Annotated[NonNegative, Unit("m3")]
    electronics_volume: Annotated[NonNegative, Unit("m3")] = 0.0
    center_of_volume: Annotated[Vector, Unit("m")] = (0.0, 0.0, 0.0)
    position: Annotated[Vector, Unit("m")] = (0.0, 0.0, 0.0)
    coefficients: Coefficients = ()
    drag_coefficient: Annotated[PerAxis, Unit("-")] = CUBE_DRAG
    added_mass_coefficient: Annotated[PerAxis, Unit("-")] = 1.0
    factors: Factors = ()
    contact: Boolean = True
    buoyancy: BuoyancyName | None = None
    drag: PartDrag | None = None
    added_mass: Boolean | None = None
    entrained_water: Share = 0.0
    ballast_mass: Annotated[NonNegative, Unit("kg")] = 0.0
    ballast_volume: Annotated[NonNegative, Unit("m3")] = 0.0
    ballast_position: Annotated[Vector, Unit("m")] = (0.0, 0.0, 0.0)
    lift_drag: LiftDrag | None = None
    fossen: Fossen | None = None
    thruster: Thruster | None = None

    def __post_init__(self) -> None:
        """Checks that there is a main box in the middle."""
        if not self.boxes:
            raise ConstraintError("boxes", "at least one box", "0")
        if any(self.boxes[0].position):
            raise ConstraintError(
                "boxes.0.position",
                "[0, 0, 0] (the part's frame lies at the centre of its main box: move the part)",
                show(list(self.boxes[0].position)),
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
        """Volume of the main box without mesh, electronics and ballast [m³]."""
        return max(self.boxes[0].volume - self.total_volume, 0.0)

    @property
    def lifted_volume(self) -> float:
        """Volume by which the water lifts it: `total_volume`, or 0 with buoyancy off [m³]."""
        return 0.0 if self.buoyancy == "off" else self.total_volume

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
        """Sum of its boxes' volumes [m³]; the overlap of two boxes counts twice."""
        return sum(box.volume for box in self.boxes)

    @cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """`[3]` lowest and `[3]` highest corner of the boxes, part frame [m]."""
        low, high = box_corners(self.boxes)
        return low.min(0), high.max(0)

    @cached_property
    def face_areas(self) -> np.ndarray:
        """`[3]` silhouette of all boxes together, seen along x, y, z of the part frame [m²]."""
        low, high = box_corners(self.boxes)
        sides = [[1, 2], [0, 2], [0, 1]]
        return np.array([union_measure(low[:, s], high[:, s]) for s in sides])


@checked
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

    axis: Direction
    anchor: Annotated[Vector, Unit("m")]
    range: Annotated[Pair[Number], Unit("rad")] = (-REACH, REACH)
    effort: Annotated[Positive, Unit("N m")] = EFFORT
    speed: Annotated[Positive, Unit("rad/s")] = SPEED

    def __post_init__(self) -> None:
        """Checks that the rest pose is in the range."""
        low, high = self.range
        if not low <= 0.0 <= high or low == high:
            around = "[lowest, highest] around the rest angle 0 [rad]"
            raise ConstraintError("range", around, show([low, high]))


@checked
class Slot:
    """Where a child can be attached.

    Attributes:
        position: of the child's mount, module frame [m].
        direction: unit vector of the child's front, module frame.
        up: unit vector along which the child's z points (before its `orientation` turns it), module
            frame; perpendicular to `direction`.

    Raises:
        InputError: a number is out of range, or `up` is not perpendicular to `direction`.
    """

    position: Annotated[Vector, Unit("m")]
    direction: Direction
    up: Direction = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        """Checks that the directions fit."""
        if abs(np.dot(self.direction, self.up)) > 1e-9:
            across = f"a vector perpendicular to direction {list(self.direction)}"
            raise ConstraintError("up", across, show(list(self.up)))


@checked
class Mount:
    """Where a module is attached to its parent.

    Attributes:
        position: the point that is fixed to the parent's slot, module frame [m].
        outward: unit vector away from the parent, module frame; perpendicular to z.

    Raises:
        InputError: a number is out of range, or `outward` is not level.
    """

    position: Annotated[Vector, Unit("m")]
    outward: Direction

    def __post_init__(self) -> None:
        """Checks that `outward` is level."""
        if abs(self.outward[2]) > 1e-9:
            level = "a vector perpendicular to the module's z"
            raise ConstraintError("outward", level, show(list(self.outward)))


@checked
class ModuleType:
    """A type of module.

    Attributes:
        name: the `type` in a morphology file.
        parts: with a hinge, the first is fixed to the parent's body, the others and all slots move.
        mount: where it is attached to its parent; None for a core, the root of a robot.
        slots: where children can be attached, by number; 0 is reserved for the mount, if any.
        hinge: the motorised hinge, if there is one.
        sensor: a sensor; left out of the descriptors that count a body's size.
        aliases: further names in morphology files.
        sensors: that sit on each module of the type; see `sensors.Sensor.each`.

    Raises:
        InputError: the pieces do not make a module; the message names module and field.
    """

    name: Name
    parts: TupleOf[Part]
    mount: Mount | None = None
    slots: dict[Annotated[Integer, Ge(0)], Slot] = field(default_factory=dict)
    hinge: Hinge | None = None
    sensor: Boolean = False
    aliases: TupleOf[Name] = ()
    sensors: SensorRow = ()

    def __post_init__(self) -> None:
        """Checks that the pieces make a module."""
        names = [part.name for part in self.parts]
        if not names or len(set(names)) < len(names):
            raise ConstraintError("parts", "parts, each name once", show(names))
        if self.mount is not None and 0 in self.slots:
            raise ConstraintError("slots", "numbers >= 1 (0 is where it is attached)", "0")
        whole = [part.fossen is not None and part.fossen.whole for part in self.parts]
        if any(whole[1:]) or (whole[0] and self.mount is not None):
            raise ConstraintError("parts", "fossen.whole in the first part of a core only", "more")
        if self.mount is None and self.sensor:
            raise ConstraintError("sensor", "false, as a core is part of a body's size", "true")
        if self.mount is None and self.mass <= 0.0:
            raise ConstraintError("mass", "a core heavier than 0 kg", f"{self.mass:g}")
        for k, sensor in enumerate(self.sensors):
            if sensor.place or sensor.kind.where != "robot" or not sensor.kind.sits:
                what = "a kind that may sit on modules of a type, without `at` and `each`"
                raise ConstraintError(f"sensors.{k}", what, show(sensor.to_mapping()))
        if self.hinge is None:
            return
        if self.mount is None:
            raise ConstraintError("mount", "one, since it has a hinge", "none")
        moving = sum(part.total_mass for part in self.parts[1:])
        if moving <= 0.0:
            raise ConstraintError(
                "parts",
                "a moving part (the second or later) heavier than 0 kg, since it has a hinge",
                f"{moving:g} kg in {len(self.parts) - 1} moving parts",
            )

    @cached_property
    def mass(self) -> float:
        """Mass of all parts, ballast included [kg]."""
        return sum(part.total_mass for part in self.parts)

    @cached_property
    def is_fin(self) -> bool:
        """Whether a part of it is a plate with Gazebo's LiftDrag."""
        return any(part.lift_drag is not None for part in self.parts)

    @cached_property
    def is_thruster(self) -> bool:
        """Whether a part of it is a thruster."""
        return any(part.thruster is not None for part in self.parts)

    @cached_property
    def volume(self) -> float:
        """Displaced volume of all parts, electronics and ballast included [m³]."""
        return sum(part.total_volume for part in self.parts)

    @cached_property
    def box_volume(self) -> float:
        """Sum of all boxes' volumes [m³]."""
        return sum(part.box_volume for part in self.parts)
