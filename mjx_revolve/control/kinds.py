"""The controllers by name, and users' own."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from mjx_revolve.body.morphology import Morphology
from mjx_revolve.control.controller import Controller
from mjx_revolve.control.cpg import make_cpg
from mjx_revolve.control.feedback import make_feedback
from mjx_revolve.control.joint_network import make_joint_network
from mjx_revolve.control.neurons import make_network
from mjx_revolve.control.places import Place
from mjx_revolve.control.sense import FEELS, Other, Sense, is_place
from mjx_revolve.control.sensory_cpg import make_sensory_cpg
from mjx_revolve.control.sine import make_sine
from mjx_revolve.control.splines import make_splines
from mjx_revolve.engine.plant import Plant
from mjx_revolve.inputs.errors import InputError, show
from mjx_revolve.inputs.own_code import call_own, load_own, parse_own, short_name

# By the name that a configuration gives; each takes (plant, settings).
CONTROLLERS: dict[str, Callable[[Plant, Any], Controller]] = {
    "cpg": lambda plant, settings: make_cpg(plant, settings.max_frequency, settings.amplitude),
    "sine": lambda plant, settings: make_sine(
        plant, settings.max_frequency, settings.amplitude, settings.harmonics
    ),
    "feedback": lambda plant, settings: make_feedback(plant, settings.depth, settings.gain),
    "mlp": lambda plant, settings: _make_network(plant, settings, False),
    "rnn": lambda plant, settings: _make_network(plant, settings, True),
    "sensory_cpg": lambda plant, settings: make_sensory_cpg(
        plant, settings.sensors, settings.max_frequency, settings.amplitude, settings.gain
    ),
    "splines": lambda plant, settings: make_splines(
        plant, settings.points, settings.max_frequency, settings.amplitude
    ),
}


def _make_brain(plant: Plant, settings: Any, source: str, body: Morphology | None) -> Controller:
    """What a robot's file has under `brain`."""
    place = f"{source}: controller.type"
    if body is None:
        raise InputError(f"{place}: expected another one, as bodies differ; found 'brain'")
    brain, file = body.brain, body.path or body.name
    if isinstance(brain, Mapping) and "neurons" in brain:
        return make_network(plant, body, file)
    kind = brain.get("type") if isinstance(brain, Mapping) else brain
    if kind == "rlpower-splines":
        return CONTROLLERS["splines"](plant, settings)
    known = "neurons and connections, or type: rlpower-splines"
    if kind == "bo-cpg":
        known += " (its oscillators are those of controller.type cpg)"
    found = "none" if brain is None else show(brain if kind is None else kind)
    raise InputError(f"{file}: brain: expected {known}; found {found}")


def _make_network(plant: Plant, settings: Any, recurrent: bool) -> Controller:
    return make_joint_network(
        plant,
        settings.sensors,
        settings.hidden,
        settings.messages,
        settings.max_frequency,
        settings.amplitude,
        recurrent,
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
        plant: whose hinges and thrusters are driven.
        settings: a `config.ControllerConfig`. Its `type` is a name in `CONTROLLERS`, or
            FILE.py:FUNCTION for a function of the user's own, which takes the plant and these
            settings and returns a `Controller`.
        source: what messages call the configuration.
        example: a plant with its tables, to try a user's own on; by default `plant`.
        body: whose plant it is, for `type: brain`; None for many.

    Returns:
        The controller.

    Raises:
        InputError: the file or the function is missing, or what it makes is no controller of this
            plant; one line says where.
    """
    if settings.type == "brain":
        return _make_brain(plant, settings, source, body)
    if settings.type in CONTROLLERS:
        return CONTROLLERS[settings.type](plant, settings)
    name = settings.type
    function = load_own(name, f"{source}: controller.type")
    controller = call_own(
        name, f"{short_name(name)} to make a controller", function, plant, settings
    )
    _check_own(name, controller, plant if example is None else example)
    return controller


def _check_own(name: str, controller: Any, plant: Plant) -> None:
    """Refuses what is no controller of a plant, before anything is compiled."""
    own = parse_own(name)
    place = f"{own.path}: {own.function}" if own else name
    if not isinstance(controller, Controller):
        raise InputError(f"{place}: expected a Controller; found {type(controller).__name__}")
    count = controller.num_genes
    if not isinstance(count, int) or count < 0:
        raise InputError(f"{place}: num_genes: expected a whole number >= 0; found {count!r}")
    if len(controller.gene_names) != count:
        raise InputError(
            f"{place}: gene_names: expected {count} of them, as num_genes says; found "
            f"{len(controller.gene_names)}"
        )
    for name_felt in controller.feels:
        if name_felt not in FEELS and not is_place(name_felt):
            raise InputError(
                f"{place}: feels: expected any of {', '.join(FEELS)}, or places such as 'at ID' "
                f"and 'each TYPE'; found {name_felt!r}"
            )
    lanes, rows = 3, plant.num_rows

    def run(genes: jax.Array, time: jax.Array, sense: Sense) -> Any:
        parameters = controller.decode(genes, plant)
        state = controller.init(parameters)
        return state, *controller.step(parameters, state, time, sense)

    before, after, targets = call_own(
        name,
        f"{short_name(name)}'s decode, init and step to give targets",
        jax.eval_shape,
        run,
        jax.ShapeDtypeStruct((count, lanes), jnp.float32),
        jax.ShapeDtypeStruct((), jnp.float32),
        _example_sense(plant, lanes, controller.feels, place),
    )
    if getattr(targets, "shape", None) != (rows, lanes):
        raise InputError(
            f"{place}: step: expected targets [n, lanes], here [{rows}, {lanes}]; found "
            f"{list(targets.shape) if hasattr(targets, 'shape') else type(targets).__name__}"
        )
    if _shapes(before) != _shapes(after):
        raise InputError(
            f"{place}: step: expected a state of the shapes that init gives, {_shapes(before)}; "
            f"found {_shapes(after)}"
        )


def _example_sense(plant: Plant, lanes: int, feels: Sequence[str], place: str) -> Sense:
    """The shapes of what is felt."""
    hinges = plant.num_hinge_rows

    def given(*shape: int) -> Any:
        return jax.ShapeDtypeStruct((*shape, lanes), jnp.float32)

    one, joint, touch = given(), given(hinges), given(1 + hinges)
    three = (one, one, one)
    asked: dict[str, Any] = {"force": three, "load": joint, "work": one, "touch": touch}
    asked["nearest"] = Other(three, one)

    def at(name: str) -> Place:
        """The shapes of what is felt at a place."""
        try:
            sites = plant.site(name)
        except InputError as error:
            raise InputError(f"{place}: feels: {error}") from None
        x = touch if sites.row is None else one
        found = Place(x, x, x, (x,) * 3, (x,) * 3, (x,) * 3, (x,) * 3, x, (x,) * 3)
        if "forces" in feels:
            found = found._replace(force=(x,) * 3)
        if sites.hinge is not None:
            found = found._replace(angle=x, speed=x, load=x if "load" in feels else None)
        if sites.module is not None:
            cells = (x, x) if "cells" in feels else None
            found = found._replace(touch=x if "touch" in feels else None, cells=cells)
        return found

    places = {name: at(name) for name in feels if is_place(name)}
    return Sense(
        height=one,
        climb=one,
        up=three,
        spin=three,
        north=three,
        angle=joint,
        speed=joint,
        flow=three,
        altitude=one,
        target=three,
        course=three,
        noise=jax.ShapeDtypeStruct((lanes,), jnp.uint32),
        places=places or None,
        **{name: asked[name] for name in feels if name in asked},
    )


def _shapes(state: Any) -> str:
    return str(jax.tree.map(lambda x: f"{x.dtype}{list(x.shape)}", state)).replace("'", "")
