"""From declared sensors to one observation: noise, range, rate and delay.

Noise is a function of the episode's seed (`EpisodeContext.noise`), of the sensor's index in the
list, of the joint and of the sample: it is the same for all individuals in one trial, as gusts and
starts are, and the same whenever the trial is repeated.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree
from numpy.typing import DTypeLike

from mjx_revolve.body.module_types import ModuleType
from mjx_revolve.body.sensors import Sensor, check_names
from mjx_revolve.control.readings import SensorReadings
from mjx_revolve.engine.plant import Plant
from mjx_revolve.inputs.errors import InputError, reading, show
from mjx_revolve.inputs.schema import ConstraintError
from mjx_revolve.numerics.spatial import Scalar, sincos
from mjx_revolve.numerics.xla import materialize

DEFAULT_SENSORS = tuple(Sensor(type=name) for name in ("tilt", "gyro", "angle", "speed"))
"""The sensors where none are declared."""

# A sample counts as due from this share of a period before its time: more than the rounding error
# of a float32 clock.
_DUE = 0.01
# Share of a count that the last bits of a float32 clock, and of its product, may lack.
_ROUNDING = 1.5e-7
# The most samples that a delay may keep; a choice.
_MAX_KEPT = 256


def count_samples(time: Scalar, rate: float) -> jax.Array:
    """The number of samples after the first that are due, a whole number in the type of `time`.

    Args:
        time: since the first [s].
        rate: of samples [Hz].
    """
    count = time * rate
    return jnp.floor(count + _DUE + _ROUNDING * count)


class Observation(NamedTuple):
    """Outputs of the declared sensors, each between -1 and 1.

    Attributes:
        robot: of the robot as a whole, `[lanes]` each.
        joint: of the hinges, `[hinge rows, lanes]` each, in the plant's order; undefined in rows
            without a hinge. Empty if there are no hinges.
    """

    robot: tuple[jax.Array, ...]
    joint: tuple[jax.Array, ...]


@dataclass(frozen=True)
class Observer:
    """Makes observations from readings, with the declared sensors and a timestep [s]."""

    sensors: tuple[Sensor, ...]
    timestep: float

    def __post_init__(self) -> None:
        """Refuses a delay that is longer than the samples that are kept."""
        for k, sensor in enumerate(self.sensors):
            if self._kept(sensor) > 1 + _MAX_KEPT:
                rate = self._rate(sensor)
                most = f"at most {_MAX_KEPT / rate:g} s at {rate:g} Hz"
                raise InputError(f"sensors.{k}.delay", most, f"{sensor.delay:g}")

    @cached_property
    def robot_names(self) -> tuple[str, ...]:
        """Names of `Observation.robot`."""
        return tuple(name for s in self.sensors if s.where != "joint" for name in s.names)

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """Names of `Observation.joint`."""
        return tuple(name for s in self.sensors if s.where != "robot" for name in s.names)

    @property
    def signals(self) -> tuple[str, ...]:
        """The `signals` of a `Controller` that uses it."""
        return tuple(dict.fromkeys(name for sensor in self.sensors for name in sensor.signals))

    def init(self, like: jax.Array) -> PyTree:
        """The state: for each sensor with a rate or a delay, its last count and its samples.

        Args:
            like: `[hinge rows, lanes]` of the floating-point type.
        """
        found: list[Any] = []
        for sensor in self.sensors:
            if self._keeps(sensor):
                blank = jax.tree.map(jnp.zeros_like, self._shapes(sensor, like))
                kept = tuple(blank for _ in range(self._kept(sensor)))
                found.append((jnp.full(like.shape[1:], -1, like.dtype), kept))
        return tuple(found)

    def observe(
        self, state: PyTree, time: jax.Array, sense: SensorReadings, joint: Scalar
    ) -> tuple[PyTree, Observation]:
        """The state and the observation before a step.

        Args:
            state: from `init`, or of the step before.
            time: since the start [s].
            sense: readings.
            joint: `[hinge rows, lanes]` or `[hinge rows, 1]` number of the robot's hinge in each
                row: noise belongs to the hinge, not to its row.
        """
        before, after = iter(state), []
        robot: list[jax.Array] = []
        joints: list[jax.Array] = []
        for place, sensor in enumerate(self.sensors):
            count = count_samples(time, self._rate(sensor))
            values = self._measure(place, sensor, count, sense, joint)
            if self._keeps(sensor):
                kept, values = self._hold(sensor, next(before), time, count, values)
                after.append(kept)
            robot += map(materialize, values[0])
            joints += map(materialize, values[1])
        return tuple(after), Observation(tuple(robot), tuple(joints))

    def _rate(self, sensor: Sensor) -> float:
        """Rate of its samples [Hz]."""
        each = 1 / self.timestep
        return each if sensor.rate is None else min(sensor.rate, each)

    def _kept(self, sensor: Sensor) -> int:
        """Number of samples that it keeps."""
        return 1 + math.ceil(sensor.delay * self._rate(sensor) - 1e-6)

    def _keeps(self, sensor: Sensor) -> bool:
        """Whether there is a rate or a delay."""
        return self._rate(sensor) < 1 / self.timestep or self._kept(sensor) > 1

    def _shapes(self, sensor: Sensor, like: jax.Array) -> PyTree:
        """Zeros of the shapes of a sample: of the robot, of the hinges."""
        where, count = sensor.where, len(sensor.kind.parts)
        robot = [jnp.zeros(like.shape[1:], like.dtype)] * count
        joint = [like] * count if where != "robot" and like.shape[0] else []
        return (robot if where != "joint" else [], joint)

    def _measure(
        self, place: int, sensor: Sensor, count: jax.Array, sense: SensorReadings, joint: Scalar
    ) -> tuple[list[jax.Array], list[jax.Array]]:
        """A sample of a sensor: values of the robot, values of the hinges."""
        kind, (low, high) = sensor.kind, sensor.limits
        zero, scale = sensor.scaling
        robot: list[jax.Array] = []
        joints: list[jax.Array] = []
        source: Any = sense.modules[sensor.place] if sensor.place else sense
        # Where there is no module of the type, the value is 0.
        there = source.present if sensor.each is not None else None
        for part, value in enumerate(kind.signal(source)):
            pieces: list[tuple[list[jax.Array], Any, Any, Any]] = [(robot, value, None, there)]
            if sensor.where == "joint":
                pieces = [(joints, value, joint, None)]
            elif sensor.where == "body":
                own, hung = (None, None) if there is None else (there[0], there[1:])
                pieces = [(robot, value[0], None, own), (joints, value[1:], joint, hung)]
            if not joint.shape[0]:  # XLA's loops cannot carry arrays of size 0
                pieces = [piece for piece in pieces if piece[0] is robot]
            for found, true, number, share in pieces:
                if sensor.noise > 0:
                    # 0 is the robot's own, so hinges count from 1.
                    which = 16 * place + part, 0 if number is None else number + 1
                    true = true + sensor.noise * hash_normal(sense.noise, *which, count, true.dtype)
                scaled = scale * (jnp.clip(true, low, high) - zero)
                found.append(scaled if share is None else share * scaled)
        return robot, joints

    def _hold(
        self, sensor: Sensor, state: PyTree, time: jax.Array, count: jax.Array, values: PyTree
    ) -> tuple[PyTree, PyTree]:
        """The samples after this step, and the sample that is the sensor's output."""
        last, kept = state
        first, due = last < 0, count != last
        fresh: list[Any] = []
        for k, old in enumerate(kept):
            new = values if k == 0 else kept[k - 1]

            def pick(new: Any, old: Any, start: Any) -> Any:
                return jnp.where(first, start, jnp.where(due, new, old))

            fresh.append(jax.tree.map(pick, new, old, values))
        if len(fresh) == 1:
            return (jnp.broadcast_to(count, last.shape), tuple(fresh)), fresh[0]
        wanted = jnp.maximum(count_samples(time - sensor.delay, self._rate(sensor)), 0)
        oldest = count - wanted > len(fresh) - 1.5
        given = jax.tree.map(lambda a, b: jnp.where(oldest, a, b), fresh[-1], fresh[-2])
        return (jnp.broadcast_to(count, last.shape), tuple(fresh)), given


def make_observer(
    sensors: Sequence[Sensor] | None, timestep: float, plant: Plant | None = None
) -> Observer:
    """An observer of sensors.

    Args:
        sensors: the declared ones; None for the default ones.
        timestep: between observations [s].
        plant: of the robot, or of the largest one; None to leave modules unchecked.

    Raises:
        InputError: a delay needs too many samples, or the robot lacks a module.
    """
    found = Observer(DEFAULT_SENSORS if sensors is None else tuple(sensors), timestep)
    for k, sensor in enumerate(found.sensors):
        if plant is not None and sensor.at is not None:
            with reading(f"sensors.{k}.at"):
                sites = plant.site(sensor.place)
            if sensor.kind.where == "joint" and sites.hinge is None:
                hinged = f"a module with a hinge, as {sensor.type} is measured at one"
                raise InputError(f"sensors.{k}.at", hinged, show(sensor.at))
    return found


def resolve_sensors(
    declared: Sequence[Sensor] | None, modules: Mapping[str, ModuleType], source: str = "config"
) -> tuple[Sensor, ...] | None:
    """Declared sensors and those of types of modules; None if there are neither.

    Args:
        declared: None if none are.
        modules: all types by name and alias.
        source: the configuration, in messages.

    Raises:
        InputError: a type is unknown, or two sensors have one name.
    """
    found, kinds = [], {kind.name: kind for kind in modules.values()}
    for k, sensor in enumerate(DEFAULT_SENSORS if declared is None else declared):
        if sensor.each is not None:
            if sensor.each not in modules:
                known = f"a type of modules, one of {', '.join(kinds)}"
                raise InputError(f"{source}: sensors.{k}.each", known, show(sensor.each))
            sensor = replace(sensor, each=modules[sensor.each].name)
        found.append(sensor)
    more = [replace(s, each=name) for name, kind in kinds.items() for s in kind.sensors]
    if declared is None and not more:
        return None
    try:
        return check_names((*found, *more))
    except ConstraintError as error:
        raise InputError(f"{source}: sensors.{error}") from None


def _mix(x: Scalar) -> Scalar:
    """A hash of 32 bits: Wellons' lowbias32 (nullprogram.com, 2018)."""
    x = (x ^ (x >> np.uint32(16))) * np.uint32(0x7FEB352D)
    x = (x ^ (x >> np.uint32(15))) * np.uint32(0x846CA68B)
    return x ^ (x >> np.uint32(16))


def hash_normal(
    seed: Scalar, number: int, joint: Scalar, sample: Scalar, dtype: DTypeLike
) -> jax.Array:
    """A standard normal number that is a function of its arguments alone.

    By a hash of a counter and the method of Box and Muller (1958), as `jax.random` inside the
    step's loop would cost ten times as much.

    Args:
        seed: uint32 `[lanes]`; None for 0.
        number: of the sensor's part.
        joint: whole numbers that broadcast against the lanes.
        sample: a whole number.
        dtype: of the result.
    """
    whole = lambda x: jnp.asarray(x).astype(jnp.int32).astype(jnp.uint32)  # noqa: E731
    state = jnp.zeros((1,), jnp.uint32) if seed is None else seed
    for counter in (whole(number), whole(joint), whole(sample)):
        state = _mix(state ^ (counter * np.uint32(0x9E3779B9) + np.uint32(0x85EBCA6B)))
    first, second = _mix(state ^ np.uint32(0x68E31DA4)), _mix(state ^ np.uint32(0xB5297A4D))
    # 24 bits each, in (0, 1] and [0, 1).
    share = lambda x: (x >> np.uint32(8)).astype(dtype) * np.asarray(2.0**-24, dtype)  # noqa: E731
    radius = jnp.sqrt(-2 * jnp.log(share(first) + np.asarray(2.0**-24, dtype)))
    return radius * sincos(2 * np.pi * share(second))[1]
