"""The controller that a configuration names: one of the package's, or a user's own."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from mjx_revolve.body.morphology import Morphology
from mjx_revolve.control.controller import Controller
from mjx_revolve.control.neurons import make_neural_network
from mjx_revolve.control.rate import hold_commands
from mjx_revolve.control.readings import (
    OPTIONAL_SIGNALS,
    SensorReadings,
    is_module_signal,
    readings_at_rest,
)
from mjx_revolve.control.table import CONTROLLERS
from mjx_revolve.engine.plant import Plant
from mjx_revolve.inputs.errors import InputError, note, reading, show
from mjx_revolve.inputs.user_code import (
    call_user_function,
    function_place,
    load_user_function,
    short_name,
)


def find_controller(
    plant: Plant,
    settings: Any,
    source: str = "config",
    example: Plant | None = None,
    body: Morphology | None = None,
) -> Controller:
    """The controller that a configuration names, made for a plant.

    Args:
        plant: of the actuators.
        settings: a `ControllerConfig`. Its `type` is a name in `CONTROLLERS`, or FILE.py:FUNCTION
            for a user's function, which takes the plant and these settings and returns a
            `Controller`. With a `rate` its commands are held (`rate.hold_commands`), and the plant
            that it is made for has the time between them for `timestep`.
        source: the configuration, in messages.
        example: a plant with its tables, to try a user's controller on; by default `plant`.
        body: of the plant, for `type: brain`; None for many bodies.

    Raises:
        InputError: the file or the function is missing, or it makes no controller of this plant.
    """
    if settings.rate is not None:
        paced = plant.at_rate(settings.rate)
        if paced.rate and paced.rate < 0.999 * settings.rate:
            note(f"controller.rate: {paced.rate:g} Hz, one command at each of the world's steps")
        limit = (paced.rate or settings.rate) / 2
        if settings.fastest > limit:  # where the world's steps are longer than 1 / rate
            most = f"waves of at most {limit:g} Hz, half as many as the world's steps"
            raise InputError(f"{source}: controller.max_frequency", most, f"{settings.fastest:g}")
        shown = None if example is None else example.at_rate(settings.rate)
        found = _find(paced, settings, source, shown, body)
        return hold_commands(found, paced, settings.between == "ramp")
    return _find(plant, settings, source, example, body)


def _find(
    plant: Plant, settings: Any, source: str, example: Plant | None, body: Morphology | None
) -> Controller:
    """The controller, without holding its commands."""
    name = settings.type
    if name == "brain":
        return _make_brain(plant, settings, source, body)
    if name in CONTROLLERS:
        return _make(name, plant, settings)
    function = load_user_function(name, f"{source}: controller.type")
    expected = f"{short_name(name)} to make a controller"
    controller = call_user_function(name, expected, function, plant, settings)
    _check_users_controller(name, controller, plant if example is None else example)
    return controller


def _make(name: str, plant: Plant, settings: Any) -> Controller:
    """A controller of the package, with those settings that are arguments of its function."""
    kind = CONTROLLERS[name]
    takes = inspect.signature(kind.make).parameters
    given = {key: value for key, value in settings if key in takes}
    return kind.make(plant, **given, **kind.fixed)


def _make_brain(plant: Plant, settings: Any, source: str, body: Morphology | None) -> Controller:
    """The controller under `brain` in the robot's file."""
    if body is None:
        raise InputError(f"{source}: controller.type", "another one, as bodies differ", "'brain'")
    brain, file = body.brain, body.path or body.name
    if isinstance(brain, Mapping) and "neurons" in brain:
        for name in CONTROLLERS["brain"].settings:
            usual, found = type(settings).model_fields[name].default, getattr(settings, name)
            if found != usual:
                none = f"as the brain of {file} is a network of neurons, which has none"
                raise InputError(f"{source}: controller.{name}", f"{usual:g}, {none}", f"{found:g}")
        return make_neural_network(plant, body, file)
    kind = brain.get("type") if isinstance(brain, Mapping) else brain
    if kind == "rlpower-splines":
        # `settings.fastest` does not know what the file has.
        if plant.rate is not None and settings.max_frequency > plant.rate / 2:
            most = f"at most half of controller.rate ({plant.rate:g} Hz), to be sampled by it"
            found = f"{settings.max_frequency:g}"
            raise InputError(f"{source}: controller.max_frequency", most, found)
        return _make("splines", plant, settings)
    known = "neurons and connections, or type: rlpower-splines"
    if kind == "bo-cpg":
        known += " (its oscillators are those of controller.type cpg)"
    found = "none" if brain is None else show(brain if kind is None else kind)
    raise InputError(f"{file}: brain", known, found)


def _check_users_controller(name: str, controller: object, plant: Plant) -> None:
    """Raises `InputError` unless a user's function made a controller of the plant."""
    place = function_place(name)
    if not isinstance(controller, Controller):
        raise InputError(place, "a Controller", type(controller).__name__)
    count = controller.num_genes
    if not isinstance(count, int) or count < 0:
        raise InputError(f"{place}: num_genes", "a whole number >= 0", repr(count))
    named = len(controller.gene_names)
    if named != count:
        raise InputError(f"{place}: gene_names", f"{count} of them, as num_genes says", named)
    for signal in controller.signals:
        if signal not in OPTIONAL_SIGNALS and not is_module_signal(signal):
            known = f"any of {', '.join(OPTIONAL_SIGNALS)}"
            known += ", or modules such as 'at ID' and 'each TYPE'"
            raise InputError(f"{place}: signals", known, repr(signal))
    # A plant with tables has a column for each robot; that of one body goes with any number.
    wide, rows = plant.source.shape[-1], plant.num_rows
    lanes = wide if wide > 1 else 7
    with reading(f"{place}: signals"):
        readings = jax.eval_shape(lambda: readings_at_rest(plant, lanes, controller.signals))

    def run(genes: jax.Array, time: jax.Array, sense: SensorReadings) -> Any:
        parameters = controller.decode(genes, plant)
        state = controller.init(parameters)
        for x in jax.tree.leaves(state):
            if not hasattr(x, "ndim"):
                raise InputError("init", "a state of arrays [..., lanes]", repr(x))
            if x.ndim and x.shape[-1] != lanes and jnp.issubdtype(x.dtype, jnp.floating):
                known = f"a state of arrays [..., lanes], here {lanes}"
                raise InputError("init", known, _shapes(x))
        return state, *controller.step(parameters, state, time, sense)

    genes, time = jnp.zeros((count, lanes), jnp.float32), jnp.zeros((), jnp.float32)
    expected = f"{short_name(name)}'s decode, init and step to give targets"
    before, after, targets = call_user_function(
        name, expected, jax.eval_shape, run, genes, time, readings
    )
    if getattr(targets, "shape", None) != (rows, lanes):
        found = list(targets.shape) if hasattr(targets, "shape") else type(targets).__name__
        raise InputError(f"{place}: step", f"targets [n, lanes], here [{rows}, {lanes}]", found)
    if not jnp.issubdtype(targets.dtype, jnp.floating):
        raise InputError(f"{place}: step", "targets that are real numbers", str(targets.dtype))
    if _shapes(before) != _shapes(after):
        alike = f"a state of the shapes that init gives, {_shapes(before)}"
        raise InputError(f"{place}: step", alike, _shapes(after))


def _shapes(state: object) -> str:
    return str(jax.tree.map(lambda x: f"{x.dtype}{list(x.shape)}", state)).replace("'", "")
