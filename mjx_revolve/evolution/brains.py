"""Brains for bodies that evolve: their inheritance, and their genes for a controller.

A brain is a plain value for JSON: genes by name (`joints`), or the weights of a network that
computes each joint's genes from its position (`cppn`, after Stanley's HyperNEAT, Artificial Life
15, 2009). For learning it is a vector of the same length for all bodies, so that one strategy can
be used for all.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Annotated, NamedTuple, Protocol, TypeVar

import numpy as np
from annotated_types import Len
from numpy.typing import ArrayLike

from mjx_revolve.control.controller import Controller, Gene, gene_indices
from mjx_revolve.engine.plant import Plant
from mjx_revolve.episodes.bodies_config import BrainsConfig
from mjx_revolve.genotypes.cppn import FUNCTIONS
from mjx_revolve.genotypes.genotype import Origins
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.schema import Number, read, words

# The network's hidden nodes, one each of these functions in turn, and the length by which positions
# are divided before they enter it [m], about two modules. Choices.
_HIDDEN = 12
_LENGTH = 0.1
# A brain of genes by name. (Of a `dict`, messages would name the gene that is wrong.)
_NAMED = Annotated[Mapping[str, Number], words("genes by name")]
_FUNCTIONS = [FUNCTIONS[name] for name in ("sin", "tanh", "gauss", "abs")]


class GeneLayout(NamedTuple):
    """The genes of one body's controller, and their joints.

    Attributes:
        names: `[n]`, after the body's own joints.
        genes: `[n]` meaning of each: the joint, pair or robot that it controls.
        place: `[n, 3]` position of its joint at rest, of a pair the middle, else 0; core frame [m].
        reach: `[n, 3]` from a pair's earlier joint to the later one, else 0 [m].
        columns: `[n]` its index among the genes for all bodies.
        width: number of the genes for all bodies.
    """

    names: tuple[str, ...]
    genes: tuple[Gene, ...]
    place: np.ndarray
    reach: np.ndarray
    columns: np.ndarray
    width: int


def gene_layout(own: Controller, common: Controller, plant: Plant) -> GeneLayout:
    """The layout of a body's genes.

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
    columns = gene_indices(own, common)
    return GeneLayout(own.gene_names, own.genes, place, reach, columns, common.num_genes)


B = TypeVar("B")  # a brain


class BrainEncoding(Protocol[B]):
    """A kind of brain. All randomness comes from the generators that are passed in."""

    size: int
    """Length of the vectors."""

    def draw(self, rng: np.random.Generator, layout: GeneLayout) -> B:
        """A brain drawn anew."""

    def inherit(
        self,
        rng: np.random.Generator,
        parents: Sequence[B],
        layout: GeneLayout,
        origins: Origins = MappingProxyType({}),
    ) -> B:
        """A child's brain; its body is the first parent's, but for mutations and what is copied."""

    def to_vector(self, brain: B, layout: GeneLayout) -> np.ndarray:
        """The brain as a vector `[size]`."""

    def from_vector(self, vector: np.ndarray, layout: GeneLayout) -> B:
        """The inverse of `to_vector`."""

    def express(self, vectors: np.ndarray, layout: GeneLayout) -> np.ndarray:
        """Vectors `[..., size]` as genes for all bodies `[..., width]`."""

    def check(self, brain: object) -> B:
        """The brain in a file; raises `InputError` for anything else."""


def make_brain_encoding(settings: BrainsConfig, common: Controller) -> BrainEncoding:
    """The kind of brain that a configuration names.

    Args:
        settings: its type and numbers.
        common: the controller for the largest body there may be.

    Raises:
        InputError: the controller has no `genes`.
    """
    if common.num_genes and not common.genes:
        raise InputError(
            "bodies: expected a controller that says what its genes belong to (Controller.genes), "
            "so that they can be inherited; found none"
        )
    if settings.type == "joints":
        return NamedGenes(settings, common)
    return PatternNetwork(settings, common)


class NamedGenes:
    """Brains that are `{name of a gene: value}`."""

    def __init__(self, settings: BrainsConfig, common: Controller) -> None:
        """See `make_brain_encoding`."""
        self.settings, self.size = settings, common.num_genes

    def draw(self, rng: np.random.Generator, layout: GeneLayout) -> dict[str, float]:
        """Normally distributed genes."""
        return _named(layout, self.settings.std_init * rng.standard_normal(len(layout.names)))

    def inherit(
        self,
        rng: np.random.Generator,
        parents: Sequence[dict[str, float]],
        layout: GeneLayout,
        origins: Origins = MappingProxyType({}),
    ) -> dict[str, float]:
        """Genes by name, the first parent's first, with noise.

        A copied joint has the genes of its original, a new one those of the nearest joint with
        inherited genes; if there is none, they are drawn. A pair of joints that have changed their
        order has the negative gene.
        """
        noise = self.settings.mutation * rng.standard_normal(len(layout.names))
        fresh = self.settings.std_init * rng.standard_normal(len(layout.names))

        def look(brain: dict[str, float], gene: Gene, joints: Sequence[str]) -> float | None:
            value = brain.get(f"{gene.what} {'~'.join(joints)}")
            if value is None and gene.place == "pair":  # the other way round
                opposite = brain.get(f"{gene.what} {'~'.join(reversed(joints))}")
                return None if opposite is None else -opposite
            return value

        def find(name: str, gene: Gene) -> float | None:
            joints: Sequence[str] = name[len(gene.what) + 1 :].split("~")
            known = parents
            if gene.place == "robot":
                return next((brain[name] for brain in parents if name in brain), None)
            originals = [_original(x, origins) for x in joints]
            if any(one is not None for one in originals):
                # A copy may have the name of another joint, which the body lost or a parent has.
                pairs = zip(originals, joints, strict=True)
                which, joints = zip(*(one or (0, x) for one, x in pairs), strict=True)
                known = [parents[which[0]]] if len(set(which)) == 1 else []
            values = (look(brain, gene, joints) for brain in known)
            return next((value for value in values if value is not None), None)

        found = [find(*gene) for gene in zip(layout.names, layout.genes, strict=True)]
        have = np.array([value is not None for value in found], bool)
        values = np.array([0.0 if value is None else value for value in found])
        kinds = [(gene.what, gene.place) for gene in layout.genes]
        for k in np.flatnonzero(~have):
            alike = [i for i in np.flatnonzero(have) if kinds[i] == kinds[k]]
            away = np.linalg.norm(layout.place[alike] - layout.place[k], axis=1)
            values[k] = values[alike[int(np.argmin(away))]] if alike else fresh[k]
        return _named(layout, values + noise)

    def to_vector(self, brain: dict[str, float], layout: GeneLayout) -> np.ndarray:
        """Genes for all bodies, 0 for those that the body lacks."""
        vector = np.zeros(layout.width, np.float32)
        vector[layout.columns] = [brain.get(name, 0.0) for name in layout.names]
        return vector

    def from_vector(self, vector: np.ndarray, layout: GeneLayout) -> dict[str, float]:
        """The body's own genes by name."""
        return _named(layout, vector[layout.columns])

    def express(self, vectors: np.ndarray, layout: GeneLayout) -> np.ndarray:
        """The same genes, 0 for those that the body lacks."""
        genes = np.zeros(vectors.shape, np.float32)
        genes[..., layout.columns] = vectors[..., layout.columns]
        return genes

    def check(self, brain: object) -> dict[str, float]:
        """Genes by name."""
        return read(_NAMED, brain, "brain")


def _original(joint: str, origins: Origins) -> tuple[int, str] | None:
    """The parent that a joint or thruster was copied from and its name there; None: it is no copy.

    Modules are copied, and one of several joints of a module is named `module/part`.
    """
    if joint in origins:
        return origins[joint]
    module, slash, part = joint.rpartition("/")
    if module not in origins:
        return None
    which, name = origins[module]
    return which, f"{name}{slash}{part}"


def _named(layout: GeneLayout, values: Iterable[float]) -> dict[str, float]:
    return {n: float(np.float32(x)) for n, x in zip(layout.names, values, strict=True)}


class PatternNetwork:
    """Brains that are the weights of a network over positions.

    Inputs are 1, x, y, z of the gene's position and, for pairs, the vector from one joint to the
    other; there is one output for each kind of gene, and one weight for each gene of the robot as a
    whole.
    """

    def __init__(self, settings: BrainsConfig, common: Controller) -> None:
        """See `make_brain_encoding`."""
        self.settings, inputs = settings, 7
        kinds = [(gene.what, gene.place) for gene in common.genes if gene.place != "robot"]
        self.kinds = list(dict.fromkeys(kinds))
        self.whole = [gene for gene in common.genes if gene.place == "robot"]
        self.shapes = (_HIDDEN, inputs), (len(self.kinds), _HIDDEN + inputs)
        # Ends of the weights of the first and of the second layer.
        self.first = _HIDDEN * inputs
        self.second = self.first + len(self.kinds) * (_HIDDEN + inputs)
        self.size = self.second + len(self.whole)

    def express(self, vectors: np.ndarray, layout: GeneLayout) -> np.ndarray:
        """The network's outputs at the genes' positions."""
        flat = np.asarray(vectors, np.float64).reshape(-1, self.size)
        ones = np.ones((len(layout.names), 1))
        x = np.hstack([ones, layout.place / _LENGTH, layout.reach / _LENGTH])
        hidden = np.einsum("vhi,ni->vnh", flat[:, : self.first].reshape(-1, *self.shapes[0]), x)
        for k in range(_HIDDEN):
            hidden[..., k] = _FUNCTIONS[k % len(_FUNCTIONS)](hidden[..., k])
        seen = np.concatenate([hidden, np.broadcast_to(x, (len(flat), *x.shape))], -1)
        weights = flat[:, self.first : self.second].reshape(len(flat), *self.shapes[1])
        outputs = np.einsum("voh,vnh->vno", weights, seen)
        genes = np.zeros((len(flat), layout.width), np.float32)
        for k, gene in enumerate(layout.genes):
            if gene.place == "robot":
                value = flat[:, self.second + self.whole.index(gene)]
            else:
                value = outputs[:, k, self.kinds.index((gene.what, gene.place))]
            genes[:, layout.columns[k]] = value
        return genes.reshape(*np.shape(vectors)[:-1], layout.width)

    def draw(self, rng: np.random.Generator, layout: GeneLayout) -> list[float]:
        """Normally distributed weights."""
        weights = rng.standard_normal(self.size)
        # Scaled so that the spread of genes does not depend on the number of inputs.
        weights[self.first : self.second] *= self.settings.std_init / np.sqrt(_HIDDEN / 2)
        weights[self.second :] *= self.settings.std_init
        return _weights(weights)

    def inherit(
        self,
        rng: np.random.Generator,
        parents: Sequence[list[float]],
        layout: GeneLayout,
        origins: Origins = MappingProxyType({}),
    ) -> list[float]:
        """Each weight is one of the parents', with noise."""
        found = np.array(parents[0])
        if len(parents) > 1:
            found = np.where(rng.random(self.size) < 0.5, found, parents[1])
        return _weights(found + self.settings.mutation * rng.standard_normal(self.size))

    def to_vector(self, brain: list[float], layout: GeneLayout) -> np.ndarray:
        """The weights."""
        return np.array(brain, np.float32)

    def from_vector(self, vector: np.ndarray, layout: GeneLayout) -> list[float]:
        """The weights."""
        return _weights(vector)

    def check(self, brain: object) -> list[float]:
        """As many weights as the network has."""
        count = self.size
        weights = Annotated[list[Number], Len(count, count), words(f"{count} weights")]
        return read(weights, brain, "brain")


def _weights(values: ArrayLike) -> list[float]:
    return [float(x) for x in np.asarray(values, np.float32)]
