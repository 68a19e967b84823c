"""Sensors as users declare them, and the table of their kinds.

Revolve's are touch, an inertial unit of six numbers, light and battery; the names here are
MuJoCo's where it has such a sensor (gyro, accelerometer).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from operator import attrgetter
from typing import Annotated, Any, NamedTuple

from annotated_types import Le, MinLen, Unit
from pydantic import AfterValidator, BeforeValidator

from mjx_revolve.body.servo import EFFORT, REACH, SPEED
from mjx_revolve.inputs.schema import (
    ConstraintError,
    Id,
    NonNegative,
    Number,
    Positive,
    Text,
    TupleOf,
    also,
    as_tuple,
    checked,
    show,
    words,
)


class SensorKind(NamedTuple):
    """A kind of sensor.

    Attributes:
        parts: names of its components; ("",) for a single one.
        unit: of the components.
        where: "robot": once, at the core, or at modules; "joint": at each hinge; "body": of the
            core's rigid body and of the body that each hinge moves; "module": only at a module.
        range: lowest and highest value, as of most such devices; choices.
        signal: `SensorReadings` → its components, in the order of `parts`: `[lanes]` each for a
            robot, `[hinge rows, lanes]` for joints, `[1 + hinge rows, lanes]` for bodies; for
            modules shaped as the module's readings.
        what: description.
        signals: the one of `OPTIONAL_SIGNALS` that it requires, or "".
        sits: whether it may be mounted on modules.
    """

    parts: tuple[str, ...]
    unit: str
    where: str
    range: tuple[float, float]
    signal: Callable[[Any], tuple[Any, ...]]
    what: str
    signals: str = ""
    sits: bool = True


def _length(toward: Any) -> Any:
    x, y, z = toward
    # The tiny term keeps the gradient finite where the target is reached.
    return (x * x + y * y + z * z + 1e-12) ** 0.5


def _distance(sense: Any) -> Any:
    if sense.seen is None:
        return _length(sense.target)
    # A target that is not visible reads as the upper end of the range; `seen` is 1 where it is.
    return _length(sense.target) + (1.0 - sense.seen) * 1e9


def _bearing(toward: Any) -> tuple[Any, ...]:
    scale = 1 / _length(toward)
    return tuple(scale * component for component in toward)


_Range = tuple[float, float]


def _number(field: str, unit: str, limits: _Range, what: str, **more: Any) -> SensorKind:
    """A kind with one component, which is a field of the readings."""
    read = attrgetter(field)
    return SensorKind(("",), unit, "robot", limits, lambda s: (read(s),), what)._replace(**more)


def _vector(field: str, unit: str, most: float, what: str, **more: Any) -> SensorKind:
    """A kind with three components, a vector field of the readings, each from -most to most."""
    kind = SensorKind(("x", "y", "z"), unit, "robot", (-most, most), attrgetter(field), what)
    return kind._replace(**more)


_NEAREST = {"signals": "nearest", "sits": False}
SENSORS: Mapping[str, SensorKind] = {
    "depth": _number("height", "m", (0, 10), "of the core below the still surface",
                     signal=lambda s: (-s.height,)),
    "climb": _number("climb", "m/s", (-1, 1), "vertical velocity"),
    "tilt": _vector("up", "-", 1, "the world's vertical, core frame"),
    "compass": _vector("north", "-", 1, "the world's x axis, core frame"),
    "gyro": _vector("angular_velocity", "rad/s", 10, "angular velocity, core frame"),
    "accelerometer": _vector(
        "force", "m/s2", 20, "specific force at the core over the last step, core frame",
        signals="force",
    ),
    "flow": _vector("flow", "m/s", 1, "velocity of the water relative to the core, core frame"),
    "sonar": _number("altitude", "m", (0, 10), "height of the core above the bed, straight down"),
    "target": _vector("target", "m", 5, "from the core to the target, core frame"),
    "bearing": _vector("target", "-", 1, "direction of the target, core frame",
                       signal=lambda s: _bearing(s.target)),
    "distance": _number("target", "m", (0, 10), "of the target from the core",
                        signal=lambda s: (_distance(s),)),
    "nearest": _vector("nearest.toward", "m", 5,
                       "from the core to the nearest other robot's, core frame", **_NEAREST),
    "nearest_bearing": _vector(
        "nearest.toward", "-", 1, "direction of the nearest other robot, core frame",
        signal=lambda s: _bearing(s.nearest.toward), **_NEAREST,
    ),
    "nearest_distance": _number(
        "nearest.toward", "m", (0, 10), "of the nearest other robot",
        signal=lambda s: (_length(s.nearest.toward),), **_NEAREST,
    ),
    "nearest_tag": _number("nearest.tag", "-", (-1, 1),
                           "number that identifies the nearest other robot", **_NEAREST),
    "course": _vector("course", "-", 1, "the direction to keep to, core frame", sits=False),
    "battery": _number(
        "work", "J", (0, 100), "work that servos and propellers have done so far",
        signals="work", sits=False,
    ),
    "angle": _number("angle", "rad", (-REACH, REACH), "of each hinge", where="joint"),
    "speed": _number("speed", "rad/s", (-SPEED, SPEED), "of each hinge", where="joint"),
    "load": _number("load", "N m", (-EFFORT, EFFORT),
                    "torque of each servo under its last command", where="joint", signals="load"),
    "contact": _number(
        "touch", "N", (0, 1),
        "force of contacts on the core's rigid body and on what each hinge carries",
        where="body", signals="touch",
    ),
    "touch": _vector(
        "cells", "N", 1, "force of contacts on the two halves of a module, along its normal",
        parts=("left", "right"), range=(0, 1), where="module", signals="cells",
    ),
}  # fmt: skip
"""All kinds of sensors by name."""


@also({"type": "number"})
def _read_range(value: object) -> object:
    """A number r as -r to r."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return -value, value
    return as_tuple(value)


_Id = Annotated[Id, MinLen(1)]
_Limits = Annotated[
    tuple[Number, Number],
    BeforeValidator(_read_range),
    words("a number, or the lowest and the highest"),
]


@checked
class Sensor:
    """A sensor of a robot.

    Its output is a number between -1 and 1: the true value, with noise, clipped to the range and
    scaled. If the range contains 0, values are divided by its larger end, so that 0 stays 0; else
    its ends are mapped to -1 and 1.

    Attributes:
        type: its kind, a name in `SENSORS`.
        name: of its own; by default the type, behind the module where it sits on one.
        unit: of range and noise; if given, it must be that of the kind.
        range: lowest and highest value, or one number for both signs; by default the kind's.
        noise: standard deviation, independent for each sample [unit].
        rate: of samples, which are held in between; by default one before every step [Hz].
        delay: age of its output [s].
        at: id of the module that carries it, of one robot; by default it is at the core.
        each: type of the modules that carry one each.

    Raises:
        InputError: there is no such kind, or a number is out of range.
    """

    type: Text
    name: Text = ""
    unit: Text | None = None
    range: _Limits | None = None
    noise: NonNegative = 0.0
    rate: Annotated[Positive, Le(1e4), Unit("Hz")] | None = None
    delay: Annotated[NonNegative, Le(5), Unit("s")] = 0.0
    at: _Id | None = None
    each: _Id | None = None

    def __post_init__(self) -> None:
        """Checks that there is such a kind, and the range."""
        if self.type not in SENSORS:
            raise ConstraintError("type", f"one of {', '.join(SENSORS)}", show(self.type))
        kind = SENSORS[self.type]
        if self.unit is not None and self.unit != kind.unit:
            raise ConstraintError("unit", f"{kind.unit!r}, as of {self.type}", show(self.unit))
        self._check_place()
        low, high = self.limits
        if low >= high:
            raise ConstraintError("range", "the lowest below the highest", show(list(self.limits)))

    def _check_place(self) -> None:
        """Checks that such a sensor may be mounted there."""
        kind, key = self.kind, "at" if self.at is not None else "each"
        if self.at is not None and self.each is not None:
            raise ConstraintError("each", "none, as there is `at`", show(self.each))
        if kind.where == "module" and self.at is None:
            raise ConstraintError("at", f"the id of a module, as {self.type} sits on one", "none")
        if self.place and not kind.sits:
            what = f"none, as {self.type} is of the robot as a whole"
            raise ConstraintError(key, what, show(getattr(self, key)))
        if self.each is not None and kind.where != "robot":
            where = "at each hinge" if kind.where == "joint" else "of each rigid body"
            raise ConstraintError("each", f"none, as {self.type} is {where}", show(self.each))

    @property
    def place(self) -> str:
        """The signal of the module that carries it; "" for the core."""
        if self.at is not None:
            return f"at {self.at}"
        return "" if self.each is None else f"each {self.each}"

    @property
    def where(self) -> str:
        """The kind's `where`: "robot", "joint", "body" or "module"."""
        return "body" if self.each is not None else "robot" if self.place else self.kind.where

    @property
    def signals(self) -> tuple[str, ...]:
        """The `signals` of a `Controller` that uses it."""
        own = self.kind.signals
        if not self.place:
            return (own,) if own else ()
        # At modules, a specific force needs a longer memory.
        own = "forces" if own == "force" else own
        return (self.place, own) if own else (self.place,)

    @property
    def kind(self) -> SensorKind:
        """Its row of `SENSORS`."""
        return SENSORS[self.type]

    @property
    def label(self) -> str:
        """Its name; by default its type, after the module that carries it."""
        return self.name or f"{self.at or self.each or ''} {self.type}".strip()

    @property
    def limits(self) -> tuple[float, float]:
        """Lowest and highest value [unit]."""
        return self.kind.range if self.range is None else self.range

    @property
    def scaling(self) -> tuple[float, float]:
        """The value with output 0, and the output per unit of value [unit, 1/unit]."""
        low, high = self.limits
        if low <= 0 <= high:
            return 0.0, 1 / max(-low, high)
        return (low + high) / 2, 2 / (high - low)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its outputs."""
        return tuple(f"{self.label} {part}".strip() for part in self.kind.parts)

    def to_mapping(self) -> dict[str, object]:
        """A mapping as in a morphology file, without default values."""
        found: dict[str, object] = {}
        for field in dataclasses.fields(self):
            own = getattr(self, field.name)
            if own != field.default:
                found[field.name] = list(own) if isinstance(own, tuple) else own
        return found


@also({"type": "string"})
def _read_sensor(value: object) -> object:
    """A kind's name alone as a mapping with that type."""
    return {"type": value} if isinstance(value, str) else value


def check_names(sensors: tuple[Sensor, ...]) -> tuple[Sensor, ...]:
    """The sensors, if their names differ."""
    labels = [sensor.label for sensor in sensors]
    for k, label in enumerate(labels):
        if label in labels[:k]:
            unlike = "names that differ (give one of them a `name`)"
            raise ConstraintError(f"{k}.name", unlike, f"{label!r} twice")
    return sensors


SensorRow = Annotated[
    TupleOf[Annotated[Sensor, BeforeValidator(_read_sensor)]],
    AfterValidator(check_names),
    words("a list of sensors"),
]
"""Sensors in a user's file: kinds' names, or mappings with fields of `Sensor`."""
