"""Sensors as users declare them, and the table of their kinds.

Revolve's are touch, an inertial unit of six numbers, light and battery; the names here are
MuJoCo's where it has such a sensor (gyro, accelerometer).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any, NamedTuple

from annotated_types import Le, MinLen, Unit
from pydantic import AfterValidator, BeforeValidator

from mjx_revolve.body.servo import EFFORT, REACH, SPEED
from mjx_revolve.inputs.schema import (
    MisfitError,
    NonNegative,
    Number,
    Positive,
    Row,
    Text,
    as_tuple,
    checked,
    show,
    words,
)


class SensorKind(NamedTuple):
    """What a sensor measures.

    Attributes:
        parts: names of its numbers; one without a name of its own is "".
        unit: of them.
        where: "robot": once, at the core, or at modules; "joint": at each hinge; "body": of the
            core's rigid body and of what each hinge carries; "module": only at a module.
        range: lowest and highest, as most such devices have them; choices.
        signal: (a `control.sense.Sense`, or a `control.places.Place`) → its numbers, in the order
            of `parts`: `[lanes]` each of a robot, `[hinge rows, lanes]` of joints,
            `[1 + hinge rows, lanes]` of bodies; of a place as that has them.
        what: it is, in words.
        feels: field of the sense that must be asked for, or "".
        sits: whether it may sit elsewhere than at the core.
    """

    parts: tuple[str, ...]
    unit: str
    where: str
    range: tuple[float, float]
    signal: Callable[[Any], tuple[Any, ...]]
    what: str
    feels: str = ""
    sits: bool = True


def _length(toward: Any) -> Any:
    x, y, z = toward
    # The tiny term keeps the gradient finite where the target is reached.
    return (x * x + y * y + z * z + 1e-12) ** 0.5


def _distance(sense: Any) -> Any:
    if getattr(sense, "seen", None) is None:
        return _length(sense.target)
    # What is not felt is as far away as the range goes; where it is felt, the factor is 1.
    return _length(sense.target) + (1.0 - sense.seen) * 1e9


def _bearing(toward: Any) -> tuple[Any, ...]:
    scale = 1 / _length(toward)
    return tuple(scale * component for component in toward)


_ONE, _THREE = ("",), ("x", "y", "z")

SENSORS: Mapping[str, SensorKind] = {
    "depth": SensorKind(
        _ONE, "m", "robot", (0, 10), lambda s: (-s.height,), "of the core below the still surface"
    ),
    "climb": SensorKind(_ONE, "m/s", "robot", (-1, 1), lambda s: (s.climb,), "vertical velocity"),
    "tilt": SensorKind(
        _THREE, "-", "robot", (-1, 1), lambda s: s.up, "the world's vertical, core frame"
    ),
    "compass": SensorKind(
        _THREE, "-", "robot", (-1, 1), lambda s: s.north, "the world's x axis, core frame"
    ),
    "gyro": SensorKind(
        _THREE, "rad/s", "robot", (-10, 10), lambda s: s.spin, "angular velocity, core frame"
    ),
    "accelerometer": SensorKind(
        _THREE,
        "m/s2",
        "robot",
        (-20, 20),
        lambda s: s.force,
        "specific force at the core over the last step, core frame",
        "force",
    ),
    "flow": SensorKind(
        _THREE,
        "m/s",
        "robot",
        (-1, 1),
        lambda s: s.flow,
        "velocity of the water relative to the core, core frame",
    ),
    "sonar": SensorKind(
        _ONE,
        "m",
        "robot",
        (0, 10),
        lambda s: (s.altitude,),
        "height of the core above the bed, straight down",
    ),
    "target": SensorKind(
        _THREE, "m", "robot", (-5, 5), lambda s: s.target, "from the core to the target, core frame"
    ),
    "bearing": SensorKind(
        _THREE,
        "-",
        "robot",
        (-1, 1),
        lambda s: _bearing(s.target),
        "direction of the target, core frame",
    ),
    "distance": SensorKind(
        _ONE, "m", "robot", (0, 10), lambda s: (_distance(s),), "of the target from the core"
    ),
    "nearest": SensorKind(
        _THREE,
        "m",
        "robot",
        (-5, 5),
        lambda s: s.nearest.toward,
        "from the core to the nearest other robot's, core frame",
        "nearest",
        sits=False,
    ),
    "nearest_bearing": SensorKind(
        _THREE,
        "-",
        "robot",
        (-1, 1),
        lambda s: _bearing(s.nearest.toward),
        "direction of the nearest other robot, core frame",
        "nearest",
        sits=False,
    ),
    "nearest_distance": SensorKind(
        _ONE,
        "m",
        "robot",
        (0, 10),
        lambda s: (_length(s.nearest.toward),),
        "of the nearest other robot",
        "nearest",
        sits=False,
    ),
    "nearest_tag": SensorKind(
        _ONE,
        "-",
        "robot",
        (-1, 1),
        lambda s: (s.nearest.tag,),
        "by which the nearest other robot can be told apart",
        "nearest",
        sits=False,
    ),
    "course": SensorKind(
        _THREE, "-", "robot", (-1, 1), lambda s: s.course, "the direction to keep to, core frame"
    ),
    "battery": SensorKind(
        _ONE,
        "J",
        "robot",
        (0, 100),
        lambda s: (s.work,),
        "work that servos and propellers have done so far",
        "work",
        sits=False,
    ),
    "angle": SensorKind(
        _ONE, "rad", "joint", (-REACH, REACH), lambda s: (s.angle,), "of each hinge"
    ),
    "speed": SensorKind(
        _ONE, "rad/s", "joint", (-SPEED, SPEED), lambda s: (s.speed,), "of each hinge"
    ),
    "load": SensorKind(
        _ONE,
        "N m",
        "joint",
        (-EFFORT, EFFORT),
        lambda s: (s.load,),
        "torque of each servo under its last command",
        "load",
    ),
    "contact": SensorKind(
        _ONE,
        "N",
        "body",
        (0, 1),
        lambda s: (s.touch,),
        "force of the bed on the core's rigid body and on what each hinge carries",
        "touch",
    ),
    "touch": SensorKind(
        ("left", "right"),
        "N",
        "module",
        (0, 1),
        lambda s: s.cells,
        "force of the bed on the two halves of a module, along its normal",
        "cells",
    ),
}
"""All kinds of sensors by name."""


def _read_range(value: Any) -> Any:
    """A number r as -r to r."""
    plain = isinstance(value, int | float) and not isinstance(value, bool)
    return (-value, value) if plain else as_tuple(value)


def _read_id(value: Any) -> Any:
    """Names in YAML may be numbers."""
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


_Id = Annotated[Text, BeforeValidator(_read_id), MinLen(1), words("a name")]
_Range = Annotated[
    tuple[Number, Number],
    BeforeValidator(_read_range),
    words("a number, or the lowest and the highest"),
]


@checked
class Sensor:
    """A sensor of a robot.

    What it gives is a number between -1 and 1: the true value, with noise, clipped to the range. A
    range that holds 0 is divided by its larger end, so that 0 stays 0; another one counts from its
    middle, so that its ends are -1 and 1.

    Attributes:
        type: its kind, a name in `SENSORS`.
        name: of its own; by default the type, behind the module where it sits on one.
        unit: of range and noise, if it is written: that of the kind.
        range: lowest and highest value, or one number for both signs; by default the kind's.
        noise: standard deviation, of every sample by itself [unit].
        rate: how often it measures; what it has measured stays until the next time. By default
            before every step [Hz].
        delay: how old what it gives is [s].
        at: id of the module that it sits on, of one robot; by default it sits at the core.
        each: type of modules that it sits on, wherever there are some.

    Raises:
        InputError: there is no such kind, or a number is out of range.
    """

    type: Text
    name: Text = ""
    unit: Text | None = None
    range: _Range | None = None
    noise: NonNegative = 0.0
    rate: Annotated[Positive, Le(1e4), Unit("Hz")] | None = None
    delay: Annotated[NonNegative, Le(5), Unit("s")] = 0.0
    at: _Id | None = None
    each: _Id | None = None

    def __post_init__(self) -> None:
        """Checks that there is such a kind, and the range."""
        if self.type not in SENSORS:
            raise MisfitError("type", f"one of {', '.join(SENSORS)}", show(self.type))
        kind = SENSORS[self.type]
        if self.unit is not None and self.unit != kind.unit:
            raise MisfitError("unit", f"{kind.unit!r}, as of {self.type}", show(self.unit))
        self._check_place()
        low, high = self.limits
        if low >= high:
            raise MisfitError("range", "the lowest below the highest", show(list(self.limits)))

    def _check_place(self) -> None:
        """Checks that such a sensor may sit where it does."""
        kind, key = self.kind, "at" if self.at is not None else "each"
        if self.at is not None and self.each is not None:
            raise MisfitError("each", "none, as there is `at`", show(self.each))
        if kind.where == "module" and self.at is None:
            raise MisfitError("at", f"the id of a module, as {self.type} is felt by one", "none")
        if self.place and not kind.sits:
            what = f"none, as {self.type} is of the robot as a whole"
            raise MisfitError(key, what, show(getattr(self, key)))
        if self.each is not None and kind.where != "robot":
            what = f"none, as {self.type} is at each hinge" if kind.where == "joint" else "none, as"
            what += "" if kind.where == "joint" else f" {self.type} is of each rigid body"
            raise MisfitError("each", what, show(self.each))

    @property
    def place(self) -> str:
        """Where it sits, as `Controller.feels` names places; "" for the core."""
        if self.at is not None:
            return f"at {self.at}"
        return "" if self.each is None else f"each {self.each}"

    @property
    def where(self) -> str:
        """How often there are its numbers: "robot", "joint" or "body", as of a kind."""
        return "body" if self.each is not None else "robot" if self.place else self.kind.where

    @property
    def feels(self) -> tuple[str, ...]:
        """What a `Controller` must name in its `feels`."""
        own = self.kind.feels
        if not self.place:
            return (own,) if own else ()
        # At modules, a specific force asks for a longer memory.
        own = "forces" if own == "force" else own
        return (self.place, own) if own else (self.place,)

    @property
    def kind(self) -> SensorKind:
        """What it measures."""
        return SENSORS[self.type]

    @property
    def label(self) -> str:
        """Its name, or its type behind the module that it sits on."""
        return self.name or f"{self.at or self.each or ''} {self.type}".strip()

    @property
    def limits(self) -> tuple[float, float]:
        """Lowest and highest value [unit]."""
        return self.kind.range if self.range is None else self.range

    @property
    def scaling(self) -> tuple[float, float]:
        """Which value is told as 0, and what one more is told as [unit, 1/unit]."""
        low, high = self.limits
        if low <= 0 <= high:
            return 0.0, 1 / max(-low, high)
        return (low + high) / 2, 2 / (high - low)

    @property
    def names(self) -> tuple[str, ...]:
        """Of its numbers."""
        return tuple(f"{self.label} {part}".strip() for part in self.kind.parts)

    def to_mapping(self) -> dict[str, Any]:
        """As a file has it, without what is usual."""
        usual: dict[str, Any] = {"name": "", "at": None, "each": None}
        usual |= {"unit": None, "range": None, "noise": 0.0, "rate": None, "delay": 0.0}
        found: dict[str, Any] = {"type": self.type}
        for key, value in usual.items():
            own = getattr(self, key)
            if own != value:
                found[key] = list(own) if isinstance(own, tuple) else own
        return found


def _read_sensor(value: Any) -> Any:
    """A kind's name alone as a sensor of it."""
    return {"type": value} if isinstance(value, str) else value


def check_names(sensors: tuple[Sensor, ...]) -> tuple[Sensor, ...]:
    """The sensors, if their names differ."""
    labels = [sensor.label for sensor in sensors]
    for k, label in enumerate(labels):
        if label in labels[:k]:
            unlike = "names that differ (give one of them a `name`)"
            raise MisfitError(f"{k}.name", unlike, f"{label!r} twice")
    return sensors


SensorRow = Annotated[
    Row[Annotated[Sensor, BeforeValidator(_read_sensor)]],
    AfterValidator(check_names),
    words("a list of sensors"),
]
"""Sensors in a user's file: kinds' names, or mappings with fields of `Sensor`."""
