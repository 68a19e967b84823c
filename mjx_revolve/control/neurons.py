"""Revolve's neural networks, as a robot's YAML has them under `brain`: read, run and evolved.

Where Revolve's code differs from its documentation, or leaves something open:

- `phase_offset` counts periods, not radians: an Oscillator gives
  1/2 - a/2 + a (sin(2π/T (t - T φ)) + 1)/2, whatever its inputs are.
- Some files give an Oscillator a `gain` in place of an `amplitude`; it is read as one.
- All neurons are updated at once, from the values of the update before; those begin at 0.
- The network is updated 8 times a second, and its outputs are held in between.
- An output is clipped to 0 to 1, and that is the hinge's whole range; of several for one hinge, the
  first in the file counts. A hinge without an output stays in the middle.
- The inputs of a module are its input neurons in the file's order: of the core its accelerometer's
  x, y, z, then its gyro's [m/s², rad/s]; of a touch sensor its two cells, the contact force on
  its left and its right half as seen in the direction in which it is attached, as a share of 1 N.
- Two connections between the same neurons add up. One into an Oscillator does nothing.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import field
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from annotated_types import Unit
from jaxtyping import PyTree
from pydantic import BeforeValidator

from mjx_revolve.body.tree import Morphology
from mjx_revolve.control.controller import Controller, Gene, StepOutput
from mjx_revolve.control.readings import SensorReadings, is_module_signal
from mjx_revolve.control.sensors import count_samples
from mjx_revolve.engine.plant import Plant
from mjx_revolve.inputs.errors import InputError, show
from mjx_revolve.inputs.schema import (
    ConstraintError,
    Id,
    Number,
    Positive,
    Text,
    TupleOf,
    checked,
    read,
)
from mjx_revolve.numerics.spatial import sincos

RATE = 8.0
"""How often Revolve's controllers are updated [Hz]."""

# Parameters of each type of neuron, in the order of its genes, and other names for them in files.
PARAMS: dict[str, tuple[str, ...]] = {
    "Input": (),
    "Simple": ("bias", "gain"),
    "Sigmoid": ("bias", "gain"),
    "Oscillator": ("period", "phase_offset", "amplitude"),
}
_OTHERWISE = {"amplitude": "gain"}
# Largest change of a number of the file by its gene, for a period the factor; choices, about the
# ranges that Revolve draws them from.
_REACH = {"weight": 2.0, "bias": 1.0, "gain": 1.0, "phase_offset": 0.5, "amplitude": 1.0}
_PERIODS = 4.0
_CELLS, _INERTIAL = 2, 6  # inputs of a touch sensor, and of the core
# Largest activity. In 32 bits a loop of Simple neurons would reach infinity within seconds, and 0
# times that is NaN for all neurons; and a Sigmoid beyond this has the gradient 0 × infinity.
_MOST = {"Simple": 1e30, "Sigmoid": 80.0}


@checked
class Neuron:
    """A neuron of a file.

    Attributes:
        id: its name.
        layer: of the network.
        type: a name in `PARAMS`.
        part_id: the module that it belongs to; hidden ones need none.
    """

    id: Id
    layer: Literal["input", "hidden", "output"]
    type: Literal["Input", "Simple", "Sigmoid", "Oscillator"]
    part_id: Id | None = None

    def __post_init__(self) -> None:
        """Checks that the type fits the layer."""
        if (self.layer == "input") != (self.type == "Input"):
            what = "Input in the layer input, and nowhere else"
            raise ConstraintError("type", what, show(self.type))


@checked
class Synapse:
    """A connection of a file."""

    src: Id
    dst: Id
    weight: Number


def _as_list(neurons: object) -> Any:
    """Neurons by id as a list of them; an input's type may be left out."""
    if isinstance(neurons, Mapping):
        own = neurons.items()
        neurons = [{"id": k} | dict(x) if isinstance(x, Mapping) else x for k, x in own]
    if not isinstance(neurons, list):
        return neurons
    is_input = lambda x: isinstance(x, Mapping) and x.get("layer") == "input"  # noqa: E731
    return [{"type": "Input"} | dict(x) if is_input(x) else x for x in neurons]


_OrNone = BeforeValidator(lambda value: value or ())
_Params = Annotated[dict[Id, dict[Text, Any]], BeforeValidator(lambda value: value or {})]


@checked
class _File:
    """A network as a file has it."""

    neurons: Annotated[TupleOf[Neuron], BeforeValidator(_as_list)]
    connections: Annotated[TupleOf[Synapse], _OrNone] = ()
    params: _Params = field(default_factory=dict)
    type: Any = None

    def __post_init__(self) -> None:
        """Checks names, and the ends of connections."""
        types: dict[str, str] = {}
        for k, neuron in enumerate(self.neurons):
            if neuron.id in types:
                raise ConstraintError(f"neurons.{k}.id", "each id once", f"{neuron.id!r} twice")
            types[neuron.id] = neuron.type
        for k, connection in enumerate(self.connections):
            if connection.src not in types:
                what = "the id of a neuron"
                raise ConstraintError(f"connections.{k}.src", what, show(connection.src))
            if types.get(connection.dst, "Input") == "Input":
                what = "the id of a neuron that is no input"
                raise ConstraintError(f"connections.{k}.dst", what, show(connection.dst))


class NeuralNetwork(NamedTuple):
    """A network as in the file.

    Attributes:
        neurons: in the file's order.
        connections: in the file's order.
        params: of each neuron, in the order of `PARAMS`.
    """

    neurons: tuple[Neuron, ...]
    connections: tuple[Synapse, ...]
    params: tuple[tuple[float, ...], ...]


def read_neural_network(brain: object, source: str) -> NeuralNetwork:
    """Reads what a morphology file has under `brain`.

    Raises:
        InputError: something in it is wrong, or is not supported.
    """
    file: _File = read(_File, brain, f"{source}: brain")
    params = []
    for neuron in file.neurons:
        given, found = file.params.get(neuron.id, {}), []
        for name in PARAMS[neuron.type]:
            kind = Annotated[Positive, Unit("s")] if name == "period" else Number
            value = given.get(name, given.get(_OTHERWISE.get(name, "")))
            found.append(read(kind, value, f"{source}: brain.params.{neuron.id}.{name}"))
        params.append(tuple(found))
    return NeuralNetwork(file.neurons, file.connections, tuple(params))


def _genes_of(network: NeuralNetwork) -> list[tuple[str, Any]]:
    """The numbers of a network that evolve: (kind, index), connections first, then parameters."""
    types = {neuron.id: neuron.type for neuron in network.neurons}
    found: list[tuple[str, Any]] = [
        ("weight", k)
        for k, connection in enumerate(network.connections)
        if types[connection.dst] != "Oscillator"
    ]
    return found + [
        (name, (k, n))
        for k, neuron in enumerate(network.neurons)
        for n, name in enumerate(PARAMS[neuron.type])
    ]


def evolve_brain(brain: Any, genes: Any, source: str = "robot") -> Any:
    """A network in the form of a morphology file, with its numbers changed by genes.

    Args:
        brain: under `brain` in the file.
        genes: `[num_genes]` of `make_neural_network`.
        source: the file, in messages.

    Returns:
        A new network: with genes of 0 it acts as the given one does with `genes`.
    """
    network, made = read_neural_network(brain, source), copy.deepcopy(brain)
    # What a file's aliases share is changed for each by itself.
    for key, value in made.items():
        if key == "connections":
            made[key] = [dict(one) for one in value or ()]
        elif key == "params":
            made[key] = {neuron: dict(own or {}) for neuron, own in (value or {}).items()}
    params = {str(key): value for key, value in (made.get("params") or {}).items()}
    folded = np.sin(np.asarray(genes, float))
    for (kind, which), x in zip(_genes_of(network), folded, strict=True):
        if kind == "weight":
            item = made["connections"][which]
            item["weight"] = float(_moved(kind, network.connections[which].weight, x))
        else:
            k, n = which
            own = params[network.neurons[k].id]
            name = kind if kind in own else _OTHERWISE[kind]
            own[name] = float(_moved(kind, network.params[k][n], x))
    return made


def _moved(kind: str, written: float, folded: Any) -> Any:
    """A number of the file, changed by a gene."""
    if kind == "period":
        return written * _PERIODS**folded
    return written + _REACH[kind] * folded


def make_neural_network(plant: Plant, body: Morphology, source: str = "robot") -> Controller:
    """The network in a robot's file; genes change its numbers, genes of 0 leave them as they are.

    Args:
        plant: of the robot.
        body: the robot, with neurons and connections under `brain`.
        source: its file, in messages.

    Returns:
        The controller; genes: weights of all connections but those into Oscillators, +- 2, then
        biases, gains and amplitudes +- 1, periods up to 4 times longer or shorter, and phase
        offsets +- 1/2.

    Raises:
        InputError: a neuron is wrong, or belongs to a module that has no such input or output.
    """
    network = read_neural_network(body.brain, source)
    neurons, place = network.neurons, f"{source}: brain"
    moving = [k for k, neuron in enumerate(neurons) if neuron.type != "Input"]
    # Of one type side by side.
    moving.sort(key=lambda k: list(PARAMS).index(neurons[k].type))
    types = [neurons[k].type for k in moving]
    row_of = {neurons[k].id: row for row, k in enumerate(moving)}
    inputs = _find_inputs(network, body, place)
    outputs = _find_outputs(network, plant, row_of, place)
    changing = _genes_of(network)
    sources = [*(neurons[k].id for k, _ in inputs), *row_of]
    column_of = {name: column for column, name in enumerate(sources)}
    signals = ("force",) * any(x[0] == "force" for _, x in inputs)
    touched = dict.fromkeys(x[0] for _, x in inputs if is_module_signal(x[0]))
    signals += ("cells", *touched) if touched else ()

    def decode(genes: jax.Array, plant: Plant) -> PyTree:
        folded, lanes = jnp.sin(genes), genes.shape[1:]
        weights = jnp.zeros((len(moving), len(sources), *lanes), genes.dtype)
        values = [[jnp.full(lanes, x, genes.dtype) for x in own] for own in network.params]
        for (kind, which), x in zip(changing, folded, strict=True):
            if kind == "weight":
                one = network.connections[which]
                at = row_of[one.dst], column_of[one.src]
                weights = weights.at[at].add(_moved(kind, one.weight, x))
            else:
                k, n = which
                values[k][n] = _moved(kind, network.params[k][n], x)
        columns = [weights[:, j] for j in range(len(sources))]
        tables = {}
        for kind in ("Simple", "Sigmoid", "Oscillator"):
            own = [values[k] for k in moving if neurons[k].type == kind]
            tables[kind] = [jnp.stack(x) for x in zip(*own, strict=True)]
        return columns, tables, plant.middle(genes), plant.reach(genes)

    def init(parameters: PyTree) -> PyTree:
        middle = parameters[2]
        still = jnp.zeros((len(moving), *middle.shape[1:]), middle.dtype)
        return jnp.full((), -1, middle.dtype), still

    def step(
        parameters: PyTree, state: PyTree, time: jax.Array, sense: SensorReadings
    ) -> StepOutput:
        columns, tables, middle, reach = parameters
        last, values = state
        count = count_samples(time, RATE)
        given = [_read_input(sense, what) for _, what in inputs]
        given += [values[row] for row in range(len(moving))]
        total = jnp.zeros_like(values)
        for column, x in zip(columns, given, strict=True):  # no reductions inside the loop
            total = total + column * x
        start, found = 0, []
        for kind in ("Simple", "Sigmoid", "Oscillator"):
            n = types.count(kind)
            if not n:
                continue
            own, table = total[start : start + n], tables[kind]
            start += n
            if kind == "Oscillator":
                period, late, amplitude = table
                sine, _ = sincos(2 * np.pi * (time / period - late))
                found.append(0.5 - amplitude / 2 + amplitude * (sine + 1) / 2)
            else:
                bias, gain = table
                own = jnp.clip(gain * (own - bias), -_MOST[kind], _MOST[kind])
                found.append(own if kind == "Simple" else 1 / (1 + jnp.exp(-own)))
        if found:
            values = jnp.where(count != last, jnp.concatenate(found), values)
        rows = [
            jnp.zeros_like(middle[0]) if row is None else 2 * jnp.clip(values[row], 0, 1) - 1
            for row in outputs
        ]
        command = jnp.stack(rows) if rows else jnp.zeros_like(middle)
        return (count, values), middle + reach * command

    names = []
    for kind, which in changing:
        if kind == "weight":
            one = network.connections[which]
            names.append(f"weight {which + 1} {one.src}>{one.dst}")
        else:
            names.append(f"{kind} {neurons[which[0]].id}")
    genes = tuple(Gene(name, "robot") for name in names)
    return Controller(len(genes), tuple(names), decode, init, step, genes, signals)


def _read_input(sense: SensorReadings, what: tuple[str, int]) -> Any:
    """The value of an input: a component of a reading of the core, or the force on a cell."""
    field, k = what
    if is_module_signal(field):
        return jnp.clip(sense.modules[field].cells[k], 0, 1)
    return getattr(sense, field)[k]


def _find_inputs(
    network: NeuralNetwork, body: Morphology, place: str
) -> list[tuple[int, tuple[str, int]]]:
    """Input neurons, each with the field of the readings, or the module, and its component."""
    modules = {module.name: k for k, module in enumerate(body.modules)}
    seen = dict.fromkeys(modules, 0)
    found = []
    for k, neuron in enumerate(network.neurons):
        if neuron.type != "Input":
            continue
        name = neuron.part_id
        where = f"{place}.neurons.{neuron.id}.part_id"
        if name not in modules:
            raise InputError(where, "a module's id", show(neuron.part_id))
        module, number = body.modules[modules[name]], seen[name]
        seen[name] += 1
        most = _INERTIAL if module.parent < 0 else _CELLS if module.kind.sensor else 0
        if number >= most:
            has = f"a module with {number + 1} inputs (a core has 6, a touch sensor 2, others none)"
            raise InputError(where, has, f"{name!r} of type {module.type}")
        what = (f"at {name}", number)
        if module.parent < 0:
            what = ("force", number) if number < 3 else ("angular_velocity", number - 3)
        found.append((k, what))
    return found


def _find_outputs(
    network: NeuralNetwork, plant: Plant, row_of: Mapping[str, int], place: str
) -> list[int | None]:
    """The neuron of each row of the plant."""
    driven: dict[int, int] = {}
    for neuron in network.neurons:
        if neuron.layer != "output":
            continue
        name = neuron.part_id
        if name not in plant.names:
            where = f"{place}.neurons.{neuron.id}.part_id"
            raise InputError(where, "the id of a hinge or a thruster", show(name))
        driven.setdefault(plant.names.index(name), row_of[neuron.id])
    return [driven.get(int(k)) for k in np.asarray(plant.source)[:, 0]]
