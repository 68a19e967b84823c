"""Compositional pattern-producing networks: small graphs of functions that grow as they evolve.

CPPNs are those of Stanley (Genetic Programming and Evolvable Machines 8, 2007); variation is that
of NEAT (Stanley and Miikkulainen, Evolutionary Computation 10, 2002): weights and functions change,
links are added and removed, and a node splits a link.

NEAT numbers innovations, so that crossover can align the genes of two parents. Here the number of a
link is the pair of its ends, and that of a node follows from the link that it splits: the same
innovation gets the same number in every genome, without a shared register.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Sequence
from typing import Annotated, NamedTuple, TypeVar

import numpy as np
from annotated_types import Ge, Unit
from pydantic import BeforeValidator, Strict

from mjx_revolve.genotypes.genotype import pick
from mjx_revolve.inputs.schema import (
    Boolean,
    ConstraintError,
    Integer,
    NonNegative,
    Number,
    Positive,
    Share,
    Text,
    TupleOf,
    as_tuple,
    checked,
    read,
    words,
)

FUNCTIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "identity": lambda x: x,
    "sin": np.sin,
    "gauss": lambda x: np.exp(-x * x),
    "tanh": np.tanh,
    "abs": np.abs,
}
"""What nodes may make of the sum of their inputs."""

# Numbers of nodes fit into a float without loss, and so into JSON everywhere.
_NUMBERS = 2**53
# Draws of two random ends for a new link before the mutation is skipped.
_LINK_TRIES = 10


class Node(NamedTuple):
    """A node between inputs and outputs.

    Attributes:
        number: its innovation number; inputs have -1, -2, ..., outputs 0, 1, ...
        function: a name in `FUNCTIONS`.
    """

    number: int
    function: str


class Connection(NamedTuple):
    """A weighted link.

    Attributes:
        source: number of the input or node that it comes from.
        target: number of the node or output that it leads to.
        weight: [-].
    """

    source: int
    target: int
    weight: float


G = TypeVar("G", Node, Connection)


class CPPN(NamedTuple):
    """A network without loops; an output is the weighted sum of its incoming links.

    Attributes:
        num_inputs: inputs; a constant input of 1 serves as bias.
        num_outputs: outputs.
        nodes: in topological order.
        links: at most one between two ends.
    """

    num_inputs: int
    num_outputs: int
    nodes: tuple[Node, ...]
    links: tuple[Connection, ...]

    def evaluate(self, inputs: np.ndarray) -> np.ndarray:
        """Outputs `[n, num_outputs]` of inputs `[n, num_inputs]`."""
        columns = np.asarray(inputs, float).T
        values = {-1 - i: columns[i] for i in range(self.num_inputs)}
        leading: dict[int, list[Connection]] = {}
        for link in self.links:
            leading.setdefault(link.target, []).append(link)

        def total(number: int) -> np.ndarray:
            found = np.zeros(columns.shape[1])
            for link in leading.get(number, ()):
                found += link.weight * values[link.source]
            return found

        for node in self.nodes:
            values[node.number] = FUNCTIONS[node.function](total(node.number))
        return np.stack([total(k) for k in range(self.num_outputs)], axis=1)

    def to_plain(self) -> dict[str, object]:
        """The network as plain values for JSON, exactly; `read_cppn` is the inverse."""
        return {
            "num_inputs": self.num_inputs,
            "num_outputs": self.num_outputs,
            "nodes": [list(node) for node in self.nodes],
            "links": [list(link) for link in self.links],
        }


@checked
class CPPNSettings:
    """Settings of initialization, mutation and crossover of networks.

    Attributes:
        max_nodes: most nodes between inputs and outputs.
        first_nodes: number of nodes of a new network.
        std: standard deviation of weights that are drawn anew [-].
        step: standard deviation of a weight's change [-].
        weights: probability of each weight to change in a mutation.
        add_node: probability of a new node that splits a link.
        add_link: probability of a new link.
        drop_link: probability of removing a link.
        function: probability of drawing a node's function anew.
        innovations: whether crossover aligns the parents by innovation numbers. If not, each output
            comes from either parent with the whole subnetwork that leads to it.

    Raises:
        InputError: a number is out of range.
    """

    # Choices. With these, half of the mutants of bodies of 16 modules differ in two or fewer.
    max_nodes: Annotated[Integer, Ge(0)] = 16
    first_nodes: Annotated[Integer, Ge(0)] = 3
    std: Annotated[Positive, Unit("-")] = 1.0
    step: Annotated[NonNegative, Unit("-")] = 0.15
    weights: Share = 0.2
    add_node: Share = 0.1
    add_link: Share = 0.15
    drop_link: Share = 0.05
    function: Share = 0.05
    innovations: Boolean = True

    def __post_init__(self) -> None:
        """Checks that first nodes fit in."""
        if self.first_nodes > self.max_nodes:
            most = f"at most max_nodes ({self.max_nodes})"
            raise ConstraintError("first_nodes", most, str(self.first_nodes))


# ------------------------------------------------------------------------- variation


def draw_cppn(
    rng: np.random.Generator, num_inputs: int, num_outputs: int, settings: CPPNSettings
) -> CPPN:
    """A random network: all inputs linked to all outputs, then `settings.first_nodes` nodes."""
    weights = rng.normal(0.0, settings.std, (num_inputs, num_outputs)).tolist()
    links = [Connection(-1 - i, k, w) for i, row in enumerate(weights) for k, w in enumerate(row)]
    network = CPPN(num_inputs, num_outputs, (), tuple(links))
    for _ in range(settings.first_nodes):
        network = _add_node(rng, network, settings)
    return network


def mutate_cppn(rng: np.random.Generator, network: CPPN, settings: CPPNSettings) -> CPPN:
    """A mutant of a network; of functions that are drawn anew some stay."""
    changes = [
        (settings.add_node, _add_node),
        (settings.add_link, _add_link),
        (settings.drop_link, _drop_link),
        (settings.function, _change_function),
    ]
    child = network
    for chance, change in changes:
        if rng.random() < chance:
            child = change(rng, child, settings)
    changed = rng.random(len(child.links)) < settings.weights
    if child is network and child.links and not changed.any():
        changed[rng.integers(len(changed))] = True
    steps = rng.normal(0.0, settings.step, len(child.links)).tolist()
    links = [
        link._replace(weight=link.weight + step) if hit else link
        for link, step, hit in zip(child.links, steps, changed, strict=True)
    ]
    return child._replace(links=tuple(links))


def _add_node(rng: np.random.Generator, network: CPPN, settings: CPPNSettings) -> CPPN:
    """Splits a link by a node: a link of weight 1 leads to it, one of the old weight from it."""
    if len(network.nodes) >= settings.max_nodes or not network.links:
        return network
    which = int(rng.integers(len(network.links)))
    source, target, weight = network.links[which]
    taken = {node.number for node in network.nodes}
    number, count = -1, 0
    while number < network.num_outputs or number in taken:
        if settings.innovations:
            number, count = _number(source, target, count), count + 1
        else:
            number = int(rng.integers(_NUMBERS))
    order = [node.number for node in network.nodes]
    place = order.index(target) if target in order else len(order)
    node = Node(number, pick(rng, [*FUNCTIONS]))
    return network._replace(
        nodes=(*network.nodes[:place], node, *network.nodes[place:]),
        links=(
            *network.links[:which],
            *network.links[which + 1 :],
            Connection(source, number, 1.0),
            Connection(number, target, weight),
        ),
    )


def _number(source: int, target: int, count: int) -> int:
    """The innovation number of the node that splits a link for the `count`-th time, from 0."""
    text = f"{source} {target} {count}".encode()
    return int.from_bytes(hashlib.blake2b(text, digest_size=8).digest()) % _NUMBERS


def _add_link(rng: np.random.Generator, network: CPPN, settings: CPPNSettings) -> CPPN:
    """A link between two ends that have none."""
    hidden = [node.number for node in network.nodes]
    sources = [*(-1 - i for i in range(network.num_inputs)), *hidden]
    targets = [*hidden, *range(network.num_outputs)]
    taken = {(link.source, link.target) for link in network.links}
    for _ in range(_LINK_TRIES):
        i, k = int(rng.integers(len(sources))), int(rng.integers(len(targets)))
        # A node's index among the sources is larger by `num_inputs`; sources come before targets.
        if i - network.num_inputs < k and (sources[i], targets[k]) not in taken:
            link = Connection(sources[i], targets[k], float(rng.normal(0.0, settings.std)))
            return network._replace(links=(*network.links, link))
    return network


def _drop_link(rng: np.random.Generator, network: CPPN, settings: CPPNSettings) -> CPPN:
    """Removes a link, and the nodes that then lead to no output."""
    if not network.links:
        return network
    which = int(rng.integers(len(network.links)))
    links = (*network.links[:which], *network.links[which + 1 :])
    return _part(network._replace(links=links), range(network.num_outputs))


def _part(network: CPPN, outputs: Iterable[int]) -> CPPN:
    """The subnetwork that leads to some of the outputs."""
    needed = {*outputs}
    for node in reversed(network.nodes):
        if any(link.source == node.number and link.target in needed for link in network.links):
            needed.add(node.number)
    return network._replace(
        nodes=tuple(node for node in network.nodes if node.number in needed),
        links=tuple(link for link in network.links if link.target in needed),
    )


def _change_function(rng: np.random.Generator, network: CPPN, settings: CPPNSettings) -> CPPN:
    """Draws the function of one node anew."""
    if not network.nodes:
        return network
    which = int(rng.integers(len(network.nodes)))
    node = network.nodes[which]._replace(function=pick(rng, [*FUNCTIONS]))
    return network._replace(nodes=(*network.nodes[:which], node, *network.nodes[which + 1 :]))


def cross_cppns(rng: np.random.Generator, a: CPPN, b: CPPN, settings: CPPNSettings) -> CPPN:
    """A child of two networks.

    With innovations: matching genes have the weight and function of either parent; all others are
    the first parent's, as NEAT takes them from the fitter one. Without: each output comes from
    either parent with the subnetwork that leads to it; if that exceeds `max_nodes`, all outputs
    come from one parent.

    Args:
        rng: random generator.
        a: the first parent.
        b: the second, with as many inputs and outputs.
        settings: `innovations` and `max_nodes`.

    Returns:
        The child.
    """
    if settings.innovations:
        links, nodes = _either(rng, a.links, b.links), _either(rng, a.nodes, b.nodes)
        return a._replace(links=links, nodes=nodes)
    other = rng.random(a.num_outputs) < 0.5
    one = _part(a, [k for k in range(a.num_outputs) if not other[k]])
    two = _part(b, [k for k in range(a.num_outputs) if other[k]])
    # Nodes with equal numbers may have different inputs: those of the second get new numbers.
    new = {node.number: int(rng.integers(a.num_outputs, _NUMBERS)) for node in two.nodes}
    nodes = tuple(node._replace(number=new[node.number]) for node in two.nodes)
    if len(one.nodes) + len(nodes) > settings.max_nodes:
        return b if rng.random() < 0.5 else a
    links = tuple(
        Connection(new.get(source, source), new.get(target, target), weight)
        for source, target, weight in two.links
    )
    return a._replace(nodes=(*one.nodes, *nodes), links=(*one.links, *links))


def _either(rng: np.random.Generator, ours: Sequence[G], theirs: Sequence[G]) -> tuple[G, ...]:
    """Links or nodes, with even chance theirs of the same number: all values but the last."""
    matching = {gene[:-1]: gene for gene in theirs}
    other = rng.random(len(ours)) < 0.5
    pairs = zip(ours, other, strict=True)
    return tuple(matching.get(gene[:-1], gene) if hit else gene for gene, hit in pairs)


# ------------------------------------------------------------------------- reading


_Node = Annotated[
    tuple[Integer, Text], Strict(), BeforeValidator(as_tuple), words("a node's number and function")
]
_Link = Annotated[
    tuple[Integer, Integer, Number],
    Strict(),
    BeforeValidator(as_tuple),
    words("a link's source, target and weight"),
]


@checked
class _Plain:
    """A network as plain values for JSON."""

    num_inputs: Annotated[Integer, Ge(1)]
    num_outputs: Annotated[Integer, Ge(1)]
    nodes: TupleOf[_Node]
    links: TupleOf[_Link]

    def __post_init__(self) -> None:
        """Checks that the pieces make a network."""
        reached = {-1 - i for i in range(self.num_inputs)}
        numbers = [number for number, _ in self.nodes]
        for k, (number, function) in enumerate(self.nodes):
            if function not in FUNCTIONS:
                names = f"one of {', '.join(FUNCTIONS)}"
                raise ConstraintError(f"nodes.{k}.1", names, repr(function))
            if number < self.num_outputs or number in numbers[:k]:
                least = f"a number >= {self.num_outputs} that no other node has"
                raise ConstraintError(f"nodes.{k}.0", least, str(number))
        order = [*sorted(reached), *numbers, *range(self.num_outputs)]
        for k, (source, target, _) in enumerate(self.links):
            known = source in order and target in order and target not in reached
            inner = known and (source < 0 or source >= self.num_outputs)
            if not inner or order.index(source) >= order.index(target):
                on = "a link from an input or node to a later node or an output"
                raise ConstraintError(f"links.{k}", on, f"{source} to {target}")
        if len({link[:2] for link in self.links}) < len(self.links):
            raise ConstraintError("links", "one between two ends", "two with the same ends")


def read_cppn(plain: object) -> CPPN:
    """A network from what `CPPN.to_plain` made.

    Raises:
        InputError: it is no network.
    """
    found = read(_Plain, plain, "genome")
    nodes = tuple(Node(*node) for node in found.nodes)
    links = tuple(Connection(*link) for link in found.links)
    return CPPN(found.num_inputs, found.num_outputs, nodes, links)
