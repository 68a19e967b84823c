"""Brains for bodies that change: what is inherited, and how it becomes genes of a controller.

A brain is a plain value that JSON can hold: genes by name (`joints`), or the weights of a network
that tells each joint's genes from its place (`cppn`, after Stanley's HyperNEAT, Artificial Life 15,
2009). For learning it is a vector, as long as in all other bodies, so that one strategy serves all.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np
from annotated_types import Len

from mjx_revolve.control.controller import Controller, Gene, gene_places
from mjx_revolve.engine.plant import Plant
from mjx_revolve.episodes.bodies_config import BrainsConfig
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.schema import Number, read, words

# The network's hidden nodes, one each of these functions in turn, and the length by which places
# are divided before they enter it [m], about two modules. Choices.
_HIDDEN = 12
_LENGTH = 0.1
# A brain of genes by name. (Of a `dict`, messages would name the gene that is wrong.)
_NAMED = Annotated[Mapping[str, Number], words("genes by name")]
# What edits put behind the name of a copy.
_COPY = re.compile(r"_\d+$")
_FUNCTIONS: tuple[Callable[[np.ndarray], np.ndarray], ...] = (
    np.sin,
    np.tanh,
    lambda x: np.exp(-x * x),
    np.abs,
)


class Layout(NamedTuple):
    """The genes of one body's controller, and where they belong.

    Attributes:
        names: `[n]`, after the body's own joints.
        genes: `[n]` what each belongs to.
        place: `[n, 3]` of its joint at rest, of a pair the middle, else 0; core frame [m].
        reach: `[n, 3]` from a pair's earlier joint to the later one, else 0 [m].
        columns: `[n]` where each stands among the genes for all bodies.
        width: how many of those there are.
    """

    names: tuple[str, ...]
    genes: tuple[Gene, ...]
    place: np.ndarray
    reach: np.ndarray
    columns: np.ndarray
    width: int


def lay_out_genes(own: Controller, common: Controller, plant: Plant) -> Layout:
    """Where the genes of a body belong.

    Args:
        own: the body's controller.
        common: of the same kind, for the largest body there may be.
        plant: the body's.

    Returns:
        The layout.
    """
    at = np.zeros((plant.num_actuators, 3))
    at[np.asarray(plant.source)[:, 0]] = np.asarray(plant.place)[..., 0]
    ends = np.asarray(plant.source)[:, 0][np.hstack([plant.first, plant.second])].reshape(-1, 2)
    place, reach = np.zeros((len(own.genes), 3)), np.zeros((len(own.genes), 3))
    for k, gene in enumerate(own.genes):
        if gene.place == "pair":
            i, j = at[ends[gene.number]]
            place[k], reach[k] = (i + j) / 2, j - i
        elif gene.place != "robot":
            place[k] = at[gene.number + plant.num_hinges * (gene.place == "thruster")]
    columns = gene_places(own, common)
    return Layout(own.gene_names, own.genes, place, reach, columns, common.num_genes)


class Brains(NamedTuple):
    """A kind of brain: plain functions, all randomness from NumPy's generator that they are given.

    Attributes:
        draw: (generator, layout) → a brain drawn anew.
        inherit: (generator, parents' brains, layout) → a child's; the first parent's body is the
            child's, too, but for mutations.
        size: length of the vectors.
        to_vector: (brain, layout) → `[size]`.
        from_vector: (`[size]`, layout) → the brain.
        express: (`[..., size]`, layout) → `[..., width]` genes for all bodies.
        check: (what a file holds) → the brain.
    """

    draw: Callable[[np.random.Generator, Layout], Any]
    inherit: Callable[[np.random.Generator, Sequence[Any], Layout], Any]
    size: int
    to_vector: Callable[[Any, Layout], np.ndarray]
    from_vector: Callable[[np.ndarray, Layout], Any]
    express: Callable[[np.ndarray, Layout], np.ndarray]
    check: Callable[[Any], Any]


def make_brains(settings: BrainsConfig, common: Controller) -> Brains:
    """The kind of brain that a configuration names.

    Args:
        settings: its type and numbers.
        common: the controller for the largest body there may be.

    Returns:
        The kind.

    Raises:
        InputError: the controller does not say what its genes belong to.
    """
    if common.num_genes and not common.genes:
        raise InputError(
            "bodies: expected a controller that says what its genes belong to (Controller.genes), "
            "so that they can be inherited; found none"
        )
    return {"joints": _make_joints, "cppn": _make_cppn}[settings.type](settings, common)


# ------------------------------------------------------------------ genes by name


def _make_joints(settings: BrainsConfig, common: Controller) -> Brains:
    """A brain is `{name of a gene: value}`."""

    def draw(rng: np.random.Generator, layout: Layout) -> dict[str, float]:
        return _named(layout, settings.std_init * rng.standard_normal(len(layout.names)))

    def inherit(rng: np.random.Generator, parents: Sequence[Any], layout: Layout) -> Any:
        noise = settings.mutation * rng.standard_normal(len(layout.names))
        fresh = settings.std_init * rng.standard_normal(len(layout.names))
        known: Mapping[str, float] = {k: v for p in reversed(parents) for k, v in p.items()}
        # A copy has a number behind its original's name; so has what a second parent gives where
        # the first one has that name, too.
        copied = {k: v for p in parents for k, v in p.items()}
        found = [known.get(n, copied.get(_COPY.sub("", n))) for n in layout.names]
        have = np.array([value is not None for value in found], bool)
        values = np.array([0.0 if value is None else value for value in found])
        for k in np.flatnonzero(~have):
            # Where the body has grown: as the nearest joint does that had a parent.
            alike = [i for i in np.flatnonzero(have) if _alike(layout.genes[i], layout.genes[k])]
            away = np.linalg.norm(layout.place[alike] - layout.place[k], axis=1)
            values[k] = values[alike[int(np.argmin(away))]] if alike else fresh[k]
        return _named(layout, values + noise)

    def to_vector(brain: Any, layout: Layout) -> np.ndarray:
        vector = np.zeros(layout.width, np.float32)
        vector[layout.columns] = [brain.get(name, 0.0) for name in layout.names]
        return vector

    def express(vectors: np.ndarray, layout: Layout) -> np.ndarray:
        genes = np.zeros(vectors.shape, np.float32)
        genes[..., layout.columns] = vectors[..., layout.columns]
        return genes

    def check(brain: Any) -> dict[str, float]:
        return read(_NAMED, brain, "brain")

    return Brains(
        draw,
        inherit,
        common.num_genes,
        to_vector,
        lambda vector, layout: _named(layout, vector[layout.columns]),
        express,
        check,
    )


def _named(layout: Layout, values: Any) -> dict[str, float]:
    return {n: float(np.float32(x)) for n, x in zip(layout.names, values, strict=True)}


def _alike(one: Gene, other: Gene) -> bool:
    return one.what == other.what and one.place == other.place


# ------------------------------------------------------------------ a network over places


def _make_cppn(settings: BrainsConfig, common: Controller) -> Brains:
    """A brain is the list of the network's weights.

    Inputs are 1, x, y, z of the gene's place and, for pairs, the way from one joint to the other;
    there is one output for each kind of gene, and one weight for each gene of the robot as a whole.
    """
    kinds = list(dict.fromkeys((g.what, g.place) for g in common.genes if g.place != "robot"))
    whole = [gene for gene in common.genes if gene.place == "robot"]
    inputs = 7
    shape_in, shape_out = (_HIDDEN, inputs), (len(kinds), _HIDDEN + inputs)
    first, second = _HIDDEN * inputs, len(kinds) * (_HIDDEN + inputs)
    size = first + second + len(whole)

    def express(vectors: np.ndarray, layout: Layout) -> np.ndarray:
        flat = np.asarray(vectors, np.float64).reshape(-1, size)
        ones = np.ones((len(layout.names), 1))
        x = np.hstack([ones, layout.place / _LENGTH, layout.reach / _LENGTH])
        hidden = np.einsum("vhi,ni->vnh", flat[:, :first].reshape(-1, *shape_in), x)
        for k in range(_HIDDEN):
            hidden[..., k] = _FUNCTIONS[k % len(_FUNCTIONS)](hidden[..., k])
        seen = np.concatenate([hidden, np.broadcast_to(x, (len(flat), *x.shape))], -1)
        weights = flat[:, first : first + second].reshape(-1, *shape_out)
        outputs = np.einsum("voh,vnh->vno", weights, seen)
        genes = np.zeros((len(flat), layout.width), np.float32)
        for k, gene in enumerate(layout.genes):
            if gene.place == "robot":
                value = flat[:, first + second + whole.index(gene)]
            else:
                value = outputs[:, k, kinds.index((gene.what, gene.place))]
            genes[:, layout.columns[k]] = value
        return genes.reshape(*np.shape(vectors)[:-1], layout.width)

    def draw(rng: np.random.Generator, layout: Layout) -> list[float]:
        weights = rng.standard_normal(size)
        # So that genes, whatever their number of inputs, come out about as wide as drawn ones.
        weights[first : first + second] *= settings.std_init / np.sqrt(_HIDDEN / 2)
        weights[first + second :] *= settings.std_init
        return _weights(weights)

    def inherit(rng: np.random.Generator, parents: Sequence[Any], layout: Layout) -> list[float]:
        found = np.array(parents[0])
        if len(parents) > 1:
            found = np.where(rng.random(size) < 0.5, found, parents[1])
        return _weights(found + settings.mutation * rng.standard_normal(size))

    def check(brain: Any) -> list[float]:
        weights = Annotated[list[Number], Len(size, size), words(f"{size} weights")]
        return read(weights, brain, "brain")

    return Brains(
        draw,
        inherit,
        size,
        lambda brain, layout: np.array(brain, np.float32),
        lambda vector, layout: _weights(vector),
        express,
        check,
    )


def _weights(values: Any) -> list[float]:
    return [float(x) for x in np.asarray(values, np.float32)]
