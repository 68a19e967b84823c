"""What a controller is: genes to parameters to commands. Zero genes keep everything still.

A controller is four plain functions over a population on the last axis, made from a table of the
plant, so that one and the same drives one robot or many different ones. The genes are unbounded
real numbers, folded into physical ranges by sin(gene), so that any optimiser can move them freely.
Folded, not squashed: with tanh, an optimum at the end of a range lies at infinity, and strategies
that adapt their step size run after it until their numbers overflow.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.control.sense import Sense
from mjx_revolve.control.sensors import Observer
from mjx_revolve.engine.plant import Plant, plant_of
from mjx_revolve.engine.robot import Robot

# How long commands take to fade in, so that no joint jumps at the start [s]; a choice.
_FADE = 0.5


class Gene(NamedTuple):
    """What a gene belongs to.

    Attributes:
        what: the number that it is, such as "w" or "offset".
        place: "hinge", "thruster", "pair" (of neighbouring hinges) or "robot".
        number: which of them.
    """

    what: str
    place: str
    number: int = 0


class Controller(NamedTuple):
    """What turns genes into commands.

    Attributes:
        num_genes: length of an individual's genes.
        gene_names: `[num_genes]` what each gene is, for tables and plots.
        decode: (genes `[num_genes, lanes]`, plant) → parameters; the plant's rows are those of the
            commands, and `plant.arrange` brings what follows the robot's order into theirs.
        init: parameters → controller state.
        step: (parameters, state, time [s], sense) → (state, `[n, lanes]` joint targets [rad] and
            commands of thrusters [-], in the plant's rows); `sense` is a `Sense`, what the robot
            feels.
        genes: `[num_genes]` what each belongs to, or () where that is not known: only needed to
            carry genes from one body to another.
        feels: which of `sense.FEELS` it reads: they are there only for those who ask.
        observer: of the declared sensors that it is told of; None without, so that nobody looks.
    """

    num_genes: int
    gene_names: tuple[str, ...]
    decode: Callable[[jax.Array, Plant], Any]
    init: Callable[[Any], Any]
    step: Callable[[Any, Any, jax.Array, Sense], tuple[Any, jax.Array]]
    genes: tuple[Gene, ...] = ()
    feels: tuple[str, ...] = ()
    observer: Observer | None = None


@dataclass(frozen=True)
class BoundController:
    """A controller with one individual's genes, as `simulate` takes it."""

    controller: Controller
    genes: Any


def bind_genes(controller: Controller, genes: Any) -> BoundController:
    """Joins a controller and one individual's genes.

    Args:
        controller: from `make_cpg` or `make_sine`.
        genes: `[num_genes]`.

    Returns:
        What `simulate` takes as `ctrl`.
    """
    return BoundController(controller, genes)


def as_plant(body: Plant | Robot) -> Plant:
    """The plant of a robot, or the plant itself."""
    return body if isinstance(body, Plant) else plant_of(body)


def of_actuators(plant: Plant, *what: str) -> tuple[Gene, ...]:
    """Genes for each actuator, in the robot's order: all of the first kind, then of the second."""
    places = [("hinge", k) for k in range(plant.num_hinges)]
    places += [("thruster", k) for k in range(plant.num_thrusters)]
    return tuple(Gene(name, *place) for name in what for place in places)


def make_controller(
    plant: Plant,
    genes: Sequence[Gene],
    decode: Callable[[jax.Array, Plant], Any],
    init: Callable[[Any], Any],
    step: Callable[[Any, Any, jax.Array, Sense], tuple[Any, jax.Array]],
) -> Controller:
    """A controller whose genes are named after what they belong to; fields as of `Controller`."""

    def name(gene: Gene) -> str:
        if gene.place == "robot":
            return gene.what
        names = plant.pairs if gene.place == "pair" else plant.names
        shift = plant.num_hinges if gene.place == "thruster" else 0
        return f"{gene.what} {names[gene.number + shift]}"

    return Controller(len(genes), tuple(map(name, genes)), decode, init, step, tuple(genes))


def fade_in(time: jax.Array) -> jax.Array:
    """By what share commands have faded in.

    Args:
        time: since the start [s].

    Returns:
        From 0 at the start to 1 after half a second and ever after.
    """
    return jnp.minimum(time / _FADE, 1)


def gene_places(own: Controller, common: Controller) -> np.ndarray:
    """Where the genes of one body's controller stand in those for all bodies.

    Args:
        own: made for the body's plant.
        common: of the same kind, made for the largest body there may be.

    Returns:
        `[own.num_genes]` indices.
    """
    place = {gene: k for k, gene in enumerate(common.genes)}
    return np.array([place[gene] for gene in own.genes], int)
