"""New individuals, in generations and in a colony: founders and children."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from numpy.random import Generator

from mjx_revolve.body.tree import Morphology
from mjx_revolve.evolution.body_fitness import BodyFitness
from mjx_revolve.evolution.individuals import Individual


def make_founders(
    fitness: BodyFitness, rngs: Sequence[Generator], number: int, generation: int, sow: bool
) -> Iterator[Individual]:
    """Individuals without parents: the configured seeds, mutants of them, then random ones.

    Args:
        fitness: its genotype, brains and seeds.
        rngs: all randomness of each.
        number: of the first; they are numbered in order.
        generation: in which they are born.
        sow: whether there are seeds among them; otherwise all are random.

    Yields:
        As many individuals as there are generators.
    """
    seeds = fitness.seeds if sow else ()
    sown = round((1 - fitness.bodies.random) * len(rngs))
    sown = max(sown, min(len(seeds), len(rngs))) if seeds else 0
    for k, rng in enumerate(rngs):
        seed = seeds[k % len(seeds)] if k < sown else None
        yield make_founder(fitness, rng, number + k, generation, seed, mutant=k >= len(seeds))


def make_founder(
    fitness: BodyFitness,
    rng: Generator,
    number: int,
    generation: int,
    seed: Morphology | None = None,
    mutant: bool = False,
) -> Individual:
    """An individual without parents: random, a given robot or a mutant of it.

    Args:
        fitness: its genotype and brains.
        rng: all randomness.
        number: of the individual.
        generation: in which it is born.
        seed: the robot; None: a random body.
        mutant: whether the robot is mutated.

    Returns:
        The individual, with a brain drawn anew.
    """
    genotype = fitness.genotype
    if seed is None:
        return _grow(fitness, rng, number, (), generation, "random", genotype.random(rng))
    assert genotype.adopt is not None  # checked where the fitness is made
    genome, origin = genotype.adopt(seed), f"seed {seed.name}"
    if mutant:
        genome, origin = genotype.mutate(rng, genome), f"mutant of {seed.name}"
    return _grow(fitness, rng, number, (), generation, origin, genome)


def make_child(
    fitness: BodyFitness,
    rng: Generator,
    number: int,
    generation: int,
    first: Individual,
    second: Individual,
    both_brains: bool = False,
) -> Individual:
    """A child: a clone's body, or crossover with probability `bodies.crossover`, then mutation.

    A child that is not crossed is always mutated, one that is crossed with probability
    `bodies.mutation`; of a clone, with probability `bodies.cloning`, only the brain is.

    Args:
        fitness: genotype, brains and probabilities.
        rng: all randomness.
        number: of the child.
        generation: in which it is born.
        first: the parent that gives the body.
        second: the other one; `first` again: there is only one.
        both_brains: whether the second counts as a parent, and gives its brain, where bodies are
            not crossed.

    Returns:
        The child, with a brain inherited as `bodies.brains` says.
    """
    genotype, settings = fitness.genotype, fitness.bodies
    genome, origin = first.genome, "cloning"
    cloned = bool(settings.cloning) and rng.random() < settings.cloning
    crossed = not cloned and first is not second and rng.random() < settings.crossover
    if crossed:
        genome, origin = genotype.cross(rng, genome, second.genome), "crossover"
    if not cloned and (not crossed or rng.random() < settings.mutation):
        genome = genotype.mutate(rng, genome)
        origin = "crossover, mutation" if crossed else "mutation"
    parents = (first, second) if crossed or both_brains else (first,)
    return _grow(fitness, rng, number, parents, generation, origin, genome)


def _grow(
    fitness: BodyFitness,
    rng: Generator,
    number: int,
    parents: Sequence[Individual],
    generation: int,
    origin: str,
    genome: object,
) -> Individual:
    """The body that a genome develops into, and its brain at birth."""
    genome, origins = fitness.genotype.settle(genome)
    body = fitness.genotype.develop(genome)
    layout, brains = fitness.layout(body), fitness.brains
    inheritance = fitness.bodies.brains.inheritance
    if not parents or inheritance == "none":
        brain = brains.draw(rng, layout)
    else:
        learnt = inheritance == "lamarckian"
        inherited = [p.learnt if learnt and p.learnt is not None else p.brain for p in parents]
        brain = brains.inherit(rng, inherited, layout, origins)
    numbers = tuple(parent.number for parent in parents)
    return Individual(number, numbers, generation, origin, genome, body, brain)
