"""Revolve's neural networks, as a robot's YAML has them under `brain`: read, run and evolved.

What Revolve leaves open, or does unlike what its words say, and how it is here:

- `phase_offset` counts periods, not radians: an Oscillator gives
  1/2 - a/2 + a (sin(2π/T (t - T φ)) + 1)/2, whatever its inputs are.
- Files in the wild give an Oscillator a `gain` in place of an `amplitude`; it is read as one.
- All neurons are updated at once, from each other's values of the update before; those begin at 0.
- The network is updated 8 times a second, and its outputs are held in between.
- An output is clipped to 0 to 1, and that is the hinge's whole range; of several for one hinge, the
  first in the file counts. A hinge without any stays in the middle.
- The inputs of a module are its input neurons in the file's order: of the core its accelerometer's
  x, y, z, then its gyro's [m/s², rad/s]; of a touch sensor its two cells, left and right of the way
  in which it is attached: how hard the bed pushes each half, as a share of 1 N.
- Two connections between the same neurons add up. One into an Oscillator does nothing.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.body.tree import Morphology
from mjx_revolve.control.controller import Controller, Gene
from mjx_revolve.control.sense import Sense, is_place
from mjx_revolve.control.sensors import count_samples
from mjx_revolve.engine.plant import Plant
from mjx_revolve.inputs.errors import InputError, show
from mjx_revolve.inputs.schema import MisfitError, Number, Text, checked, read, words
from mjx_revolve.numerics.spatial import sincos

RATE = 8.0
"""How often Revolve's controllers are updated [Hz]."""

# What each type of neuron is told, in the order of its genes, and under which other names files
# have it.
PARAMS: dict[str, tuple[str, ...]] = {
    "Input": (),
    "Simple": ("bias", "gain"),
    "Sigmoid": ("bias", "gain"),
    "Oscillator": ("period", "phase_offset", "amplitude"),
}
_OTHERWISE = {"amplitude": "gain"}
# How far a gene may move what is written: weights and parameters by as much, a period by this
# factor; choices, about the ranges that Revolve draws them from.
_FAR = {"weight": 2.0, "bias": 1.0, "gain": 1.0, "phase_offset": 0.5, "amplitude": 1.0}
_PERIODS = 4.0
_CELLS, _INERTIAL = 2, 6  # inputs of a touch sensor, and of the core


@checked
class Neuron:
    """A neuron of a file.

    Attributes:
        id: its name.
        layer: "input", "hidden" or "output".
        type: a name in `PARAMS`.
        part_id: the module that it belongs to; hidden ones need none.
    """

    id: Annotated[str | int, words("a name")]
    layer: Text
    type: Text
    part_id: Annotated[str | int | None, words("a module's id")] = None

    def __post_init__(self) -> None:
        """Checks layer and type."""
        if self.layer not in ("input", "hidden", "output"):
            raise MisfitError("layer", "input, hidden or output", show(self.layer))
        if self.type not in PARAMS:
            raise MisfitError("type", f"one of {', '.join(PARAMS)}", show(self.type))
        if (self.layer == "input") != (self.type == "Input"):
            raise MisfitError("type", "Input in the layer input, and nowhere else", show(self.type))


@checked
class Connection:
    """A connection of a file."""

    src: Annotated[str | int, words("a neuron's id")]
    dst: Annotated[str | int, words("a neuron's id")]
    weight: Number


class Network(NamedTuple):
    """A network as it is written.

    Attributes:
        neurons: in the file's order.
        connections: likewise.
        params: of each neuron, as `PARAMS` has them.
    """

    neurons: tuple[Neuron, ...]
    connections: tuple[Connection, ...]
    params: tuple[tuple[float, ...], ...]


def read_network(brain: Any, source: str) -> Network:
    """Reads a network.

    Args:
        brain: what a morphology file has under `brain`.
        source: what messages call the file.

    Returns:
        The network.

    Raises:
        InputError: something in it is wrong, or is nothing that we run.
    """
    place = f"{source}: brain"
    for key in brain:
        if key not in ("type", "neurons", "connections", "params"):
            known = "type, neurons, connections, params"
            raise InputError(f"{place}: expected only {known}; found {show(key)}")
    found = brain["neurons"]
    if isinstance(found, Mapping):
        found = [
            item if not isinstance(item, Mapping) else {"id": key} | dict(item)
            for key, item in found.items()
        ]
    if not isinstance(found, list):
        raise InputError(f"{place}.neurons: expected neurons by id; found {show(found)}")
    items = [_with_layer(item) for item in found]
    neurons = tuple(read(Neuron, x, f"{place}.neurons.{k}") for k, x in enumerate(items))
    names = [str(neuron.id) for neuron in neurons]
    for k, name in enumerate(names):
        if name in names[:k]:
            raise InputError(f"{place}.neurons: expected each id once; found {name!r} twice")
    given = brain.get("connections") or []
    if not isinstance(given, list):
        raise InputError(f"{place}.connections: expected a list; found {show(given)}")
    connections = tuple(
        read(Connection, x, f"{place}.connections.{k}") for k, x in enumerate(given)
    )
    for k, connection in enumerate(connections):
        for end in ("src", "dst"):
            at = str(getattr(connection, end))
            if at not in names or (end == "dst" and neurons[names.index(at)].type == "Input"):
                what = "the id of a neuron" + (" that is no input" if end == "dst" else "")
                raise InputError(f"{place}.connections.{k}.{end}: expected {what}; found {at!r}")
    params = brain.get("params") or {}
    if not isinstance(params, Mapping):
        raise InputError(f"{place}.params: expected a mapping; found {show(params)}")
    told = {str(key): value for key, value in params.items()}
    return Network(
        neurons,
        connections,
        tuple(_read_params(told.get(n), neuron, f"{place}.params.{n}")
              for n, neuron in zip(names, neurons, strict=True)),
    )  # fmt: skip


def _with_layer(item: Any) -> Any:
    """An input's type is often left out."""
    if isinstance(item, Mapping) and item.get("layer") == "input":
        return {"type": "Input"} | dict(item)
    return item


def _read_params(given: Any, neuron: Neuron, place: str) -> tuple[float, ...]:
    names = PARAMS[neuron.type]
    if not names:
        return ()
    if not isinstance(given, Mapping):
        raise InputError(f"{place}: expected {', '.join(names)}; found {show(given)}")
    found = []
    for name in names:
        value = given.get(name, given.get(_OTHERWISE.get(name)))
        if value is None:
            raise InputError(f"{place}.{name}: expected a number; found none")
        number: float = read(Number, value, f"{place}.{name}")
        if name == "period" and number <= 0:
            raise InputError(f"{place}.period: expected a number > 0 [s]; found {number:g}")
        found.append(number)
    return tuple(found)


def _genes_of(network: Network) -> list[tuple[str, Any]]:
    """What may change of a network: (kind, which), connections first, then parameters."""
    types = {str(neuron.id): neuron.type for neuron in network.neurons}
    found: list[tuple[str, Any]] = [
        ("weight", k)
        for k, connection in enumerate(network.connections)
        if types[str(connection.dst)] != "Oscillator"
    ]
    return found + [
        (name, (k, n))
        for k, neuron in enumerate(network.neurons)
        for n, name in enumerate(PARAMS[neuron.type])
    ]


def evolve_brain(brain: Any, genes: Any, source: str = "robot") -> Any:
    """A robot's brain with the numbers that genes make of it.

    Args:
        brain: what a morphology file has under `brain`, a network.
        genes: `[num_genes]` of `make_network`.
        source: what messages call the file.

    Returns:
        A new one, to be saved with a robot: run with genes of 0 it does what this one does.
    """
    network, made = read_network(brain, source), copy.deepcopy(brain)
    params = {str(key): value for key, value in (made.get("params") or {}).items()}
    folded = np.sin(np.asarray(genes, float))
    for (kind, which), x in zip(_genes_of(network), folded, strict=True):
        if kind == "weight":
            item = made["connections"][which]
            item["weight"] = float(_moved(kind, network.connections[which].weight, x))
        else:
            k, n = which
            own = params[str(network.neurons[k].id)]
            name = kind if kind in own else _OTHERWISE[kind]
            own[name] = float(_moved(kind, network.params[k][n], x))
    return made


def _moved(kind: str, written: float, folded: Any) -> Any:
    """What a gene makes of a written number."""
    if kind == "period":
        return written * _PERIODS**folded
    return written + _FAR[kind] * folded


def make_network(plant: Plant, body: Morphology, source: str = "robot") -> Controller:
    """A robot's own network. Genes of 0 run it as it is written; they move its numbers.

    Args:
        plant: of the robot.
        body: whose `brain` has neurons and connections.
        source: what messages call the file.

    Returns:
        The controller; genes: weights of all connections but those into Oscillators, +- 2, then
        biases, gains and amplitudes +- 1, periods up to 4 times longer or shorter, and phase
        offsets +- 1/2.

    Raises:
        InputError: a neuron is wrong, or belongs to a module that has no such input or output.
    """
    network = read_network(body.brain, source)
    neurons, place = network.neurons, f"{source}: brain"
    moving = [k for k, neuron in enumerate(neurons) if neuron.type != "Input"]
    # Of one type side by side.
    moving.sort(key=lambda k: list(PARAMS).index(neurons[k].type))
    types = [neurons[k].type for k in moving]
    row_of = {str(neurons[k].id): row for row, k in enumerate(moving)}
    inputs = _find_inputs(network, body, place)
    outputs = _find_outputs(network, body, plant, row_of, place)
    changing = _genes_of(network)
    sources = [*(str(neurons[k].id) for k, _ in inputs), *row_of]
    column_of = {name: column for column, name in enumerate(sources)}
    feels = ("force",) * any(x[0] == "force" for _, x in inputs)
    touched = dict.fromkeys(x[0] for _, x in inputs if is_place(x[0]))
    feels += ("cells", *touched) if touched else ()

    def decode(genes: jax.Array, plant: Plant) -> Any:
        folded, lanes = jnp.sin(genes), genes.shape[1:]
        weights = jnp.zeros((len(moving), len(sources), *lanes), genes.dtype)
        values = [[jnp.full(lanes, x, genes.dtype) for x in own] for own in network.params]
        for (kind, which), x in zip(changing, folded, strict=True):
            if kind == "weight":
                one = network.connections[which]
                at = row_of[str(one.dst)], column_of[str(one.src)]
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

    def init(parameters: Any) -> Any:
        middle = parameters[2]
        still = jnp.zeros((len(moving), *middle.shape[1:]), middle.dtype)
        return jnp.full((), -1, middle.dtype), still

    def step(parameters: Any, state: Any, time: jax.Array, sense: Sense) -> tuple[Any, jax.Array]:
        columns, tables, middle, reach = parameters
        last, values = state
        count = count_samples(time, RATE)
        given = [_feel(sense, what) for _, what in inputs]
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
                own = gain * (own - bias)
                found.append(own if kind == "Simple" else 1 / (1 + jnp.exp(-own)))
        if found:
            values = jnp.where(count != last, jnp.concatenate(found), values)
        rows = [
            jnp.zeros_like(middle[0]) if row is None else 2 * jnp.clip(values[row], 0, 1) - 1
            for row in outputs
        ]
        asked = jnp.stack(rows) if rows else jnp.zeros_like(middle)
        return (count, values), middle + reach * asked

    names = []
    for kind, which in changing:
        if kind == "weight":
            one = network.connections[which]
            names.append(f"weight {which + 1} {one.src}>{one.dst}")
        else:
            names.append(f"{kind} {neurons[which[0]].id}")
    genes = tuple(Gene(name, "robot") for name in names)
    return Controller(len(genes), tuple(names), decode, init, step, genes, feels)


def _feel(sense: Sense, what: tuple[str, int]) -> Any:
    """An input's value: a component of the core's, or how hard a cell is touched."""
    field, k = what
    if is_place(field):
        return jnp.clip(sense.places[field].cells[k], 0, 1)
    return getattr(sense, field)[k]


def _find_inputs(
    network: Network, body: Morphology, place: str
) -> list[tuple[int, tuple[str, int]]]:
    """Input neurons, and the field of the sense, or the place, with its component."""
    modules = {module.name: k for k, module in enumerate(body.modules)}
    seen = dict.fromkeys(modules, 0)
    found = []
    for k, neuron in enumerate(network.neurons):
        if neuron.type != "Input":
            continue
        name = str(neuron.part_id)
        where = f"{place}.neurons.{neuron.id}.part_id"
        if name not in modules:
            raise InputError(f"{where}: expected a module's id; found {show(neuron.part_id)}")
        module, number = body.modules[modules[name]], seen[name]
        seen[name] += 1
        most = _INERTIAL if module.parent < 0 else _CELLS if module.kind.sensor else 0
        if number >= most:
            has = f"a module with {number + 1} inputs (a core has 6, a touch sensor 2, others none)"
            raise InputError(f"{where}: expected {has}; found {name!r} of type {module.type}")
        what = (f"at {name}", number)
        if module.parent < 0:
            what = ("force", number) if number < 3 else ("spin", number - 3)
        found.append((k, what))
    return found


def _find_outputs(
    network: Network, body: Morphology, plant: Plant, row_of: Mapping[str, int], place: str
) -> list[int | None]:
    """Which neuron drives each row of the plant."""
    driven: dict[int, int] = {}
    for neuron in network.neurons:
        if neuron.layer != "output":
            continue
        name = str(neuron.part_id)
        if name not in plant.names:
            raise InputError(
                f"{place}.neurons.{neuron.id}.part_id: expected the id of a hinge or a thruster; "
                f"found {show(neuron.part_id)}"
            )
        driven.setdefault(plant.names.index(name), row_of[str(neuron.id)])
    return [driven.get(int(k)) for k in np.asarray(plant.source)[:, 0]]
