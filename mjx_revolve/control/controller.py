"""The interface of controllers: genes to parameters to commands.

A controller is a set of pure functions over a population on the last axis, made from a table of the
plant; the same controller drives one robot or many different ones. The genes are unbounded real
numbers, mapped to physical ranges by sin(gene), so that any optimiser can change them freely. A
periodic map is used rather than a sigmoid: with tanh, an optimum at the end of a range is at
infinity, and strategies that adapt their step size follow it until numbers overflow. With genes of
zero no joint moves but to the middle of its range.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from mjx_revolve.control.readings import SensorReadings
from mjx_revolve.control.sensors import Observer
from mjx_revolve.engine.plant import Plant, plant_of
from mjx_revolve.engine.robot import Robot
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics.spatial import Scalar

# How long commands take to fade in, so that no joint jumps at the start [s]; a choice.
_FADE = 0.5
# What an input's name ought to be.
_UNLIKE = "names that no other input of the network has"

StepOutput = tuple[PyTree, jax.Array]
"""State and commands after a controller's step."""


class Gene(NamedTuple):
    """The meaning of a gene.

    Attributes:
        what: the parameter that it encodes, such as "w" or "offset".
        place: "hinge", "thruster", "pair" (of neighbouring hinges in their order; the other way
            round the gene is the negative) or "robot".
        number: index of the hinge, thruster or pair.
    """

    what: str
    place: str
    number: int = 0


class _Controller(NamedTuple):
    num_genes: int
    gene_names: tuple[str, ...]
    decode: Callable[[jax.Array, Plant], PyTree]
    init: Callable[[PyTree], PyTree]
    step: Callable[[PyTree, PyTree, jax.Array, SensorReadings], StepOutput]
    genes: tuple[Gene, ...] = ()
    signals: tuple[str, ...] = ()
    observer: Observer | None = None
    rate: float | None = None


class Controller(_Controller):
    """Functions that turn genes into commands.

    Attributes:
        num_genes: length of an individual's genes.
        gene_names: `[num_genes]` names for tables and plots.
        decode: (genes `[num_genes, lanes]`, plant) → parameters. The plant's rows are those of the
            commands; `plant.arrange` brings values in the robot's order into theirs.
        init: parameters → controller state.
        step: (parameters, state, time [s], `SensorReadings`) → (state, `[n, lanes]` joint targets
            [rad] and commands of thrusters [-], in the plant's rows).
        genes: `[num_genes]` meanings of the genes, or () if unknown: only used to transfer genes
            from one body to another.
        signals: the `OPTIONAL_SIGNALS`, and the modules, that it reads.
        observer: of the declared sensors; None if there are none.
        rate: of its commands, which are held in between (see `rate.hold_commands`) [Hz]; None: a
            new command at every step.
    """

    __slots__ = ()

    def __new__(cls, *args: Any, feels: tuple[str, ...] | None = None, **kwargs: Any) -> Controller:
        """`feels` is the old name of `signals`, for one more release."""
        if feels is not None:
            kwargs["signals"] = feels
        return super().__new__(cls, *args, **kwargs)

    def _replace(self, **kwargs: Any) -> Controller:
        """A copy with other fields."""
        if "feels" in kwargs:
            kwargs["signals"] = kwargs.pop("feels")
        return super()._replace(**kwargs)


@dataclass(frozen=True)
class BoundController:
    """A controller with one individual's genes, as `simulate` takes it."""

    controller: Controller
    genes: ArrayLike


def bind_genes(controller: Controller, genes: ArrayLike) -> BoundController:
    """Joins a controller and one individual's genes `[num_genes]`, as `ctrl` of `simulate`."""
    return BoundController(controller, genes)


def as_plant(body: Plant | Robot) -> Plant:
    """The plant of a robot, or the plant itself."""
    return body if isinstance(body, Plant) else plant_of(body)


class GeneBlocks:
    """The genes of a controller in blocks, one number for each hinge, thruster or pair.

    Attributes:
        blocks: (what, place) in the order of the genes; `place` is that of a `Gene`, or "actuator"
            for hinges and then thrusters.
    """

    def __init__(self, plant: Plant, *blocks: tuple[str, str]) -> None:
        self.blocks = blocks
        names = [what for what, _ in blocks]
        if twice := [what for k, what in enumerate(names) if what in names[:k]]:
            raise InputError("controller.sensors", _UNLIKE, f"two genes {twice[0]}")
        sizes = {"hinge": plant.num_hinges, "thruster": plant.num_thrusters}
        self._sizes = sizes | {"pair": plant.num_pairs, "robot": 1}

    @property
    def genes(self) -> tuple[Gene, ...]:
        """The genes in order."""
        parts = {"actuator": ("hinge", "thruster")}
        return tuple(
            Gene(what, place, k)
            for what, block in self.blocks
            for place in parts.get(block, (block,))
            for k in range(self._sizes[place])
        )

    def split(self, values: jax.Array, plant: Plant) -> dict[str, jax.Array]:
        """Values of all genes, by block.

        Args:
            values: `[num_genes, lanes]`.
            plant: of the rows.

        Returns:
            `[n, lanes]` of actuators, `[hinge rows, lanes]` of hinges, `[thrusters, lanes]`, all in
            the plant's rows; pairs and "robot" in the order of the genes.
        """
        start, found, rows = 0, {}, plant.num_hinge_rows
        hinges, thrusters = self._sizes["hinge"], self._sizes["thruster"]
        for what, place in self.blocks:
            count = hinges + thrusters if place == "actuator" else self._sizes[place]
            own = values[start : start + count]
            start += count
            if place in ("actuator", "hinge", "thruster"):
                around = hinges * (place == "thruster"), thrusters * (place == "hinge")
                own = plant.arrange(jnp.pad(own, (around, *[(0, 0)] * (own.ndim - 1))))
                own = {"hinge": own[:rows], "thruster": own[rows:]}.get(place, own)
            found[what] = own
        return found


def make_controller(
    plant: Plant,
    genes: Sequence[Gene],
    decode: Callable[[jax.Array, Plant], PyTree],
    init: Callable[[PyTree], PyTree],
    step: Callable[[PyTree, PyTree, jax.Array, SensorReadings], StepOutput],
) -> Controller:
    """A controller with `gene_names` made from `genes`; arguments are fields of `Controller`."""

    def name(gene: Gene) -> str:
        if gene.place == "robot":
            return gene.what
        names = plant.pairs if gene.place == "pair" else plant.names
        shift = plant.num_hinges if gene.place == "thruster" else 0
        return f"{gene.what} {names[gene.number + shift]}"

    return Controller(len(genes), tuple(map(name, genes)), decode, init, step, tuple(genes))


def lag_share(plant: Plant, constant: Scalar) -> Scalar:
    """Share of the step response that a first-order lag reaches from one command to the next.

    Exact for an input that is held. Without a rate, as in runs of older versions, Euler's method.

    Args:
        plant: of the controller.
        constant: the lag's time constant [s].
    """
    if plant.rate is None:
        return jnp.minimum(plant.timestep / constant, 1)
    return -jnp.expm1(-plant.timestep / constant)


def fade_in(time: jax.Array) -> jax.Array:
    """Share of the commands that is applied: 0 at the start, 1 after half a second."""
    return jnp.minimum(time / _FADE, 1)


def gene_indices(own: Controller, common: Controller) -> np.ndarray:
    """Indices `[own.num_genes]` of one body's genes in those for all bodies.

    Args:
        own: made for the body's plant.
        common: of the same kind, made for the largest body there may be.

    Raises:
        InputError: two genes have one name, as a sensor is called like another input.
    """
    place = {gene: k for k, gene in enumerate(common.genes)}
    if len(place) < len(common.genes):
        twice = next(gene for k, gene in enumerate(common.genes) if place[gene] > k)
        raise InputError("controller.sensors", _UNLIKE, f"two genes {twice.what}")
    return np.array([place[gene] for gene in own.genes], int)
