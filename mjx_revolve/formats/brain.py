"""A controller with its genes as a program, from which files for other computers are written.

The controller's own step is traced, for one robot and with its parameters as constants, so that
nothing is translated by hand, and users' own controllers are exported in the same way.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from mjx_revolve.body.sensors import Sensor
from mjx_revolve.control.controller import Controller
from mjx_revolve.control.readings import NearestRobot, SensorReadings, readings_at_rest
from mjx_revolve.engine.plant import Plant, plant_of
from mjx_revolve.engine.robot import Robot
from mjx_revolve.episodes.fitness import Fitness
from mjx_revolve.formats.brain_code import one_line
from mjx_revolve.formats.brain_program import Builder, Program, kind_of
from mjx_revolve.formats.links import make_links, plain, unique_names
from mjx_revolve.inputs.errors import InputError

READINGS: dict[str, tuple[str, str]] = {
    "height": ("m", "height above the still surface, negative under water"),
    "climb": ("m/s", "vertical velocity, upwards"),
    "up": ("-", "the world's vertical x, y, z: (0, 0, 1) while level"),
    "angular_velocity": ("rad/s", "angular velocity about x, y, z"),
    "north": ("-", "the world's x axis x, y, z: a compass"),
    "angle": ("rad", "angle of each hinge, 0 in the rest pose"),
    "speed": ("rad/s", "angular velocity of each hinge"),
    "flow": ("m/s", "velocity of the water past it x, y, z"),
    "altitude": ("m", "height above the bed, straight down"),
    "target": ("m", "to the target x, y, z; 0 while it is not seen"),
    "force": ("m/s2", "specific force x, y, z, as of an accelerometer: (0, 0, 9.81) at rest"),
    "load": ("N m", "torque of each hinge's servo"),
    "work": ("J", "work that servos and propellers have done since the start"),
    "touch": ("N", "force of contacts on the core's rigid body, then on what each hinge carries"),
    "nearest_toward": ("m", "to the nearest other robot x, y, z"),
    "nearest_tag": ("-", "the number that identifies the nearest other robot"),
    "course": ("-", "the direction to keep to x, y, z, of length 1"),
    "seen": ("-", "1 while the target is seen, else 0"),
    "cells": ("N", "force of contacts on the left and the right half"),
}
"""Unit and meaning of the fields of `SensorReadings`; vectors are in the frame of where they are
measured: the core, or a module's main box."""


# At one module.
_AT_MODULE = {
    "angle": "angle of its hinge, 0 in the rest pose",
    "speed": "angular velocity of its hinge",
    "load": "torque of its hinge's servo",
    "touch": "force of contacts on its rigid body",
}


@dataclass(frozen=True)
class Signal:
    """An input of a brain.

    Attributes:
        name: a field of `SensorReadings`, after the name of the module if it is measured at one.
        unit: of its numbers.
        words: its meaning, and where it is measured.
        size: number of values.
        value: number of the input in the program.
    """

    name: str
    unit: str
    words: str
    size: int
    value: int


@dataclass(frozen=True)
class Brain:
    """A controller with its genes.

    Attributes:
        robot: its name.
        program: of a step.
        time: number of the program's input that is the time since the start [s].
        signals: the other inputs.
        commands: names of the actuators: hinges [rad], then thrusters [-].
        num_hinges: number of hinges.
        low: least of each command.
        high: greatest.
        rate: at which the step is to be called [Hz].
        sensors: as they were simulated.
    """

    robot: str
    program: Program
    time: int
    signals: tuple[Signal, ...]
    commands: tuple[str, ...]
    num_hinges: int
    low: tuple[float, ...]
    high: tuple[float, ...]
    rate: float
    sensors: tuple[Sensor, ...]


def champion_brain(fitness: Fitness, genes: ArrayLike) -> Brain:
    """The brain of an individual, with the rate and the sensors of its configuration.

    Args:
        fitness: of the run.
        genes: `[num_genes]`.

    Returns:
        The brain.

    Raises:
        InputError: genes are too few or many, or its step has an operation that files cannot hold.
    """
    observer, rate = fitness.controller.observer, fitness.controller.rate
    sensors = () if observer is None else observer.sensors
    seen = fitness.settings.sight is not None
    return make_brain(fitness.robot, fitness.bare_controller(), genes, rate, sensors, seen)


def make_brain(
    robot: Robot,
    controller: Controller,
    genes: ArrayLike,
    rate: float | None,
    sensors: Sequence[Sensor] = (),
    seen: bool = False,
) -> Brain:
    """Traces a controller's step.

    Parameters are decoded as in the simulation, to the same bits; the step is traced in 64 bits, so
    that a file computes in the precision that it is set to.

    Args:
        robot: from `build_robot`.
        controller: with a command at each call and exact sensors (see `Fitness.bare_controller`):
            real sensors have noise, rate and delay of their own.
        genes: `[num_genes]`.
        rate: at which its step is to be called [Hz]; None: at each of the world's steps.
        sensors: as they were simulated, for the files' comments.
        seen: whether the target may be out of sight.

    Returns:
        The brain.

    Raises:
        InputError: genes are too few or many, or its step has an operation that files cannot hold.
    """
    if not robot.mj_model.nu:
        raise InputError("controller", "a robot with hinges or thrusters", "neither")
    plant = plant_of(robot) if rate is None else plant_of(robot).at_rate(rate)
    genes = jnp.asarray(genes, jnp.result_type(np.asarray(genes), 0.0))
    if genes.shape != (controller.num_genes,):
        raise InputError("genes", f"[{controller.num_genes}]", list(genes.shape))
    parameters = controller.decode(genes[:, None], plant)
    initial = jax.tree.map(_wide, controller.init(parameters))
    parameters = jax.tree.map(_wide, parameters)
    readings = _blank_readings(plant, controller.signals, seen)
    present = {name: _present(plant, name) for name in readings.modules or ()}

    def step(state: PyTree, time: jax.Array, sense: SensorReadings) -> PyTree:
        if present:
            own = {k: x._replace(present=present[k]) for k, x in sense.modules.items()}
            sense = sense._replace(modules=own)
        return controller.step(parameters, state, time, sense)

    with jax.enable_x64(True):
        closed = jax.make_jaxpr(step)(initial, np.zeros(()), readings)
        return _lower(robot, plant, closed, initial, readings, tuple(sensors))


def _lower(
    robot: Robot, plant: Plant, closed: core.ClosedJaxpr, initial: object, readings: SensorReadings,
    sensors: tuple[Sensor, ...],
) -> Brain:  # fmt: skip
    builder = Builder()
    start = tuple(np.asarray(x).reshape(-1) for x in jax.tree.leaves(initial))
    state = [builder.input(f"state{k}", kind_of(x.dtype), x.size) for k, x in enumerate(start)]
    time = builder.input("time", "real", 1)
    signals, leaves = [], {}
    for name, unit, words, parts in _list_readings(readings):
        sizes = [int(np.prod(part.shape)) for part in parts]
        number = builder.input(name, "real", sum(sizes))
        signals.append(Signal(name, unit, one_line(words), sum(sizes), number))
        ends = np.cumsum([0, *sizes])
        for part, low, high in zip(parts, ends[:-1], ends[1:], strict=True):
            leaf = builder.take([number], np.arange(low, high))
            if part.dtype == bool:
                leaf = builder.apply("ne", "bool", leaf, builder.constant(np.zeros(1)))
            leaves[id(part)] = leaf
    order = [leaves.get(id(leaf), -1) for leaf in jax.tree.leaves(readings)]
    found = builder.run(closed, [*state, time, *order])
    low, high = (np.asarray(x)[:, 0].astype(float) for x in (plant.low, plant.high))
    limits = builder.constant(low), found[-1], builder.constant(high)
    commands = builder.apply("clamp", "real", *limits)
    program = Program(tuple(builder.values), commands, tuple(state), tuple(found[:-1]), start)
    live = program.live
    return Brain(
        robot=robot.morphology.name,
        program=program,
        time=time,
        signals=tuple(signal for signal in signals if signal.value in live),
        commands=_command_names(robot),
        num_hinges=plant.num_hinges,
        low=tuple(low.tolist()),
        high=tuple(high.tolist()),
        rate=plant.rate or 1 / plant.timestep,
        sensors=sensors,
    )


def _command_names(robot: Robot) -> tuple[str, ...]:
    """Names of the actuators, of hinges those that URDF and bags have."""
    joints = [link.joint for link in make_links(robot) if link.joint is not None]
    hinges = {joint.ctrl: joint.name for joint in joints}
    jets = [plain(robot.mj_model.actuator(k).name) for k in robot.thrusters]
    return tuple(unique_names([*(hinges[k] for k in robot.servos), *jets], set()))


def _wide(x: object) -> Any:
    """Reals in 64 bits, as they are."""
    x = np.asarray(x)
    return x.astype(np.float64) if x.dtype.kind == "f" else x


def _blank_readings(plant: Plant, signals: Sequence[str], seen: bool) -> SensorReadings:
    """Readings of one robot, a zero for each number, to trace with."""

    def blank(sense: SensorReadings) -> SensorReadings:
        own = sense._replace(seen=np.ones(1, bool) if seen else None, present=None, modules=None)
        return jax.tree.map(lambda x: np.zeros_like(_wide(x)), own)

    readings = readings_at_rest(plant, 1, signals)
    modules = {name: blank(own) for name, own in (readings.modules or {}).items()}
    return blank(readings)._replace(modules=modules or None)


def _present(plant: Plant, name: str) -> np.ndarray:
    """`SensorReadings.present` of a module signal."""
    return np.atleast_1d(np.asarray(plant.site(name).there, float))


def _list_readings(readings: SensorReadings) -> list[tuple[str, str, str, list[np.ndarray]]]:
    """Name, unit, meaning and arrays of each reading; no two have one name."""
    rows = list(_readings_at(readings, ""))
    names = unique_names([row[0] for row in rows], set())
    return [(name, *row[1:]) for name, row in zip(names, rows, strict=True)]


def _readings_at(
    readings: SensorReadings, place: str
) -> Iterator[tuple[str, str, str, list[np.ndarray]]]:
    for field, value in readings._asdict().items():
        if value is None or field in ("noise", "present"):
            continue
        if field == "modules":
            for name, own in value.items():
                yield from _readings_at(own, name)
            continue
        fields = {field: value}
        if isinstance(value, NearestRobot):
            fields = {f"{field}_{key}": x for key, x in value._asdict().items()}
        for name, x in fields.items():
            unit, words = READINGS[name]
            words = _AT_MODULE.get(name, words) if place else words
            at = "the core" if not place else place.replace("at ", "module ")
            where = "" if name in ("angle", "speed", "load", "touch") and not place else f", {at}"
            if place.startswith("each "):
                where = f", {at} on the core's rigid body, then on what each hinge carries"
            label = plain(f"{place} {name}".strip())
            yield label, unit, words + where, [*x] if isinstance(x, tuple) else [x]
