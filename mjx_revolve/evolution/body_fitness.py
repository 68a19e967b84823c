"""Scores of bodies that evolve: morphologies and genes to scores, in any process.

A worker receives morphologies, compiles them, and evaluates all in one program, which follows from
the configuration alone. If each body tries enough brains at a time to fill most of a chunk, a chunk
holds one body, which is faster; else bodies share chunks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import jax
import numpy as np

from mjx_revolve.body.morphology import Morphology, load_morphology, trim_neutral
from mjx_revolve.engine.plant import plant_of
from mjx_revolve.engine.robot import Robot
from mjx_revolve.episodes.bodies_config import BodiesConfig
from mjx_revolve.episodes.config import Config
from mjx_revolve.episodes.fitness import Fitness, MixedFitness, fit_body, make_mixed_fitness
from mjx_revolve.episodes.measure_table import MEASURES
from mjx_revolve.episodes.named_files import read_modules, read_world
from mjx_revolve.evolution.blocks import block_size
from mjx_revolve.evolution.brains import BrainEncoding, GeneLayout, gene_layout, make_brain_encoding
from mjx_revolve.genotypes.genotype import Genotype, accept_all, cached, make_space
from mjx_revolve.genotypes.kinds import find_genotype
from mjx_revolve.inputs.errors import InputError

# Random bodies from which the number of parts in a row of the tables follows. A choice.
_EXAMPLES = 64
# Long episodes of each body that are looked at, each with coefficients of its own. A choice.
_LONG_TRIALS = 8

Genes = Sequence[np.ndarray]
"""Of several bodies."""


@dataclass(frozen=True, eq=False)
class BodyFitness:
    """Scores of different bodies with different brains.

    Attributes:
        config: the configuration.
        genotype: of the bodies.
        mixed: the fitness of any bodies within the space.
        brains: the kind of brain.
        seeds: robots that begin the population.
    """

    config: Config
    genotype: Genotype
    mixed: MixedFitness
    brains: BrainEncoding
    seeds: tuple[Morphology, ...]

    @property
    def bodies(self) -> BodiesConfig:
        """Settings of the evolution of bodies."""
        assert self.config.bodies is not None
        return self.config.bodies

    @property
    def num_genes(self) -> int:
        """Length of the genes of the largest body."""
        return self.mixed.num_genes

    @property
    def worst_score(self) -> float:
        """The score of a rollout that blew up."""
        return self.mixed.worst_score

    @cached_property
    def block_size(self) -> int | None:
        """Individuals in a block; None: all."""
        return block_size(self.config.task.trials)

    @property
    def one_body_per_block(self) -> bool:
        """Whether each block holds one body."""
        block = self.block_size
        return block is not None and self.bodies.learning.blocks_of_body(block) > 0

    def step_changes(
        self, bodies: Sequence[Morphology], genes: Genes, key: jax.Array
    ) -> np.ndarray:
        """`[bodies]` shares by which scores of bodies with brains change at half the timestep.

        In the world's own water, without gusts: their paths are drawn anew for each timestep.
        """
        world = self.mixed.world
        calm: dict[str, Any] = {} if world.gust is None else {"world.gust": None}
        half = calm | {"world.timestep": world.timestep / 2}
        usual, fine = (self._scores_with(bodies, genes, key, **x) for x in (calm, half))
        return np.abs(fine - usual) / np.maximum(np.abs(usual), 1e-9)

    def kept_shares(
        self, bodies: Sequence[Morphology], genes: Genes, key: jax.Array, seconds: float
    ) -> np.ndarray:
        """`[bodies]` shares of scores, as rates, that bodies with brains keep for `seconds` [s].

        Swum, not foretold, in water and with motors of all of the task's range, while the score is
        that of the usual time in the world's own water.
        """
        task = self.config.task
        swum: dict[str, Any] = {
            "task.duration": seconds, "task.horizon": None, "task.trials": _LONG_TRIALS,
            "task.robust": task.robust and task.robust.model_dump(),
            "task.energy_weight": task.energy_weight_over(seconds),
        }  # fmt: skip
        usual, kept = (self._scores_with(bodies, genes, key, **x) for x in ({}, swum))
        return kept / np.maximum(usual, 1e-9)

    def _scores_with(
        self, bodies: Sequence[Morphology], genes: Genes, key: jax.Array, **changes: Any
    ) -> np.ndarray:
        """`[bodies]` scores of bodies with brains, with other settings; robust only if so given."""
        mixed = make_mixed_fitness(self.config, bodies, **({"task.robust": None} | changes))
        robots = [mixed.build(body) for body in bodies]
        padded = [mixed.pad_genes(own, robot) for own, robot in zip(genes, robots, strict=True)]
        return np.asarray(mixed(mixed.pack(robots), np.stack(padded), key))

    @cached_property
    def identity(self) -> str:
        """Fingerprint of the world and the types of modules, on which scores depend."""
        modules = read_modules(self.config)
        kinds = [repr(modules[name]) for name in (self.bodies.core, *self.bodies.modules)]
        return "\n".join([repr(self.mixed.world), *kinds, *(repr(s.modules) for s in self.seeds)])

    @property
    def measure_names(self) -> tuple[str, ...]:
        """Names of the measures of an individual."""
        wanted = self.config.task.measures
        return tuple(name for name, m in MEASURES.items() if not m.record or name in wanted)

    @cached_property
    def features(self) -> tuple[str, ...]:
        """Names of all features of an individual: the score, measures and descriptors."""
        return ("score", *self.measure_names, *self._example.descriptors)

    @cached_property
    def _example(self) -> Morphology:
        """A random body, the same in all processes."""
        return self.genotype.develop(self.genotype.random(np.random.default_rng(0)))

    def body_fitness(self, body: Morphology) -> Fitness:
        """The fitness of one body alone, for replays."""
        return fit_body(self.config, body)

    @cached_property
    def build(self) -> Callable[[Morphology], Robot]:
        """Body → robot, with a cache of the last generations' in the run's own process."""
        return cached(self.mixed.build)

    @cached_property
    def layout(self) -> Callable[[Morphology], GeneLayout]:
        """Body → layout of its genes, with the same cache."""

        def lay_out(body: Morphology) -> GeneLayout:
            plant = plant_of(self.build(body))
            own = self.mixed.controller_of(plant)
            return gene_layout(own, self.mixed.controller, plant)

        return cached(lay_out)

    def example_block(self) -> tuple[Any, ...]:
        """A block to compile for."""
        size = self.block_size or self.config.evolution.population_size
        genes = np.zeros((size, self.num_genes), np.float32)
        return genes, np.zeros(size, np.int32), [self._example]

    def evaluate(
        self, genes: np.ndarray, which: np.ndarray, bodies: Sequence[Morphology], key: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Scores a block.

        Args:
            genes: `[P, num_genes]`.
            which: `[P]` the body of each individual.
            bodies: not trimmed; just one where each block holds one.
            key: draws the episodes' starts and water.

        Returns:
            `[P]` scores and `[P]` measures.
        """
        return self.mixed.evaluate(self._robots(which, bodies), genes, key)

    def precompile(
        self, genes: np.ndarray, which: np.ndarray, bodies: Sequence[Morphology], key: jax.Array
    ) -> None:
        """Compiles `evaluate` for such a block, or reads its program, without an episode."""
        self.mixed.precompile(self._robots(which, bodies), genes, key)

    def _robots(self, which: np.ndarray, bodies: Sequence[Morphology]) -> Robot | Sequence[Robot]:
        robots = [self.build(body) for body in bodies]
        return robots[0] if self.one_body_per_block else [robots[k] for k in which]


def make_body_fitness(config: Config) -> BodyFitness:
    """Builds the fitness of a configuration in which bodies evolve.

    Raises:
        InputError: the configuration, a seed or the world is wrong; the message says where.
    """
    config = _ask_for_measures(config)
    bodies = config.bodies
    assert bodies is not None
    modules = read_modules(config)
    try:
        space = make_space(bodies, modules, _bound_of_trim(config))
        seeds = []
        for path in bodies.seeds:
            seeds.append(load_morphology(path, modules, config.allow_overlap))
            if reason := space.refuses(seeds[-1]):
                raise InputError(f"bodies.seeds: {path}: {reason}")
        genotype = find_genotype(bodies.genotype, space, bodies.params, config.source)
        if seeds and genotype.adopt is None:
            none = f"none, as no {bodies.name} grows into a given robot"
            raise InputError("bodies.seeds", none, len(seeds))
        rng = np.random.default_rng(0)  # so that they are the same in all processes
        examples = [*seeds, *(genotype.develop(genotype.random(rng)) for _ in range(_EXAMPLES))]
        kinds = [modules[name] for name in (bodies.core, *bodies.modules)]
        there = [*kinds, *(module.kind for seed in seeds for module in seed.modules)]
        if not any(kind.hinge or kind.is_thruster for kind in there):
            moving = "a type with a hinge or a thruster, as brains are to evolve"
            raise InputError("bodies.modules", moving, ", ".join(bodies.modules))
        mixed = make_mixed_fitness(
            config, examples, bodies.max_hinges, modules=bodies.max_modules, kinds=kinds
        )
        brains = make_brain_encoding(bodies.brains, mixed.controller)
    except InputError as error:
        raise config.blame(error) from None

    return BodyFitness(config, genotype, mixed, brains, tuple(seeds))


def _ask_for_measures(config: Config) -> Config:
    """The configuration, with the measures of objectives and archive added to `task.measures`."""
    bodies = config.bodies
    assert bodies is not None
    selection = bodies.selection
    named = [name.removeprefix("-") for name in (*selection.objectives, *selection.novelty)]
    named += bodies.archive.axes if bodies.archive else ()
    extra = [name for name in named if name in MEASURES and MEASURES[name].record]
    wanted = tuple(dict.fromkeys((*config.task.measures, *extra)))
    task = config.task.model_copy(update={"measures": wanted})
    return config.model_copy(update={"task": task})


def _bound_of_trim(config: Config) -> Callable[[Morphology], bool]:
    """Body → whether the configuration can trim it: no child may end a run because it floats."""
    if config.trim == "none":
        return accept_all
    density = read_world(config).density
    # Water without a density is refused when the first body is built.
    return partial(_can_be_trimmed, density=density) if density > 0 else accept_all


def _can_be_trimmed(body: Morphology, density: float) -> bool:
    with suppress(InputError):
        trim_neutral(body, density)
        return True
    return False
