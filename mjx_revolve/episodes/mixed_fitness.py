"""Fitness of a population in which every individual has its own body.

`make_mixed_fitness` fixes the world, the task, the controller's kind and the largest body once;
then any bodies within that size run through one compiled program, generation after generation.
Where all individuals happen to have one body, the faster program for that body is used instead.
Derivatives are for bodies of one kind (`fitness`): here, XLA takes minutes to compile them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from mjx_revolve.body.morphology import Morphology, trim_neutral
from mjx_revolve.control.controllers import CONTROLLERS, decode_sine, step_sine
from mjx_revolve.engine.menagerie import Bodies, Shape, fit_shape, joint_of, pack_bodies
from mjx_revolve.engine.mixed_step import make_mixed_engine, to_rows
from mjx_revolve.engine.robot import Robot, build_robot, check_timestep
from mjx_revolve.episodes.config import Config, load_config, make_config
from mjx_revolve.episodes.fitness import (
    Fitness,
    check_key,
    draw_gusts,
    draw_starts,
    farthest,
    may_touch_bed,
)
from mjx_revolve.episodes.rollout import flow_at, gusty_water, make_engine, roll_out
from mjx_revolve.episodes.scoring import (
    WORST,
    Scores,
    average_trials,
    list_episodes,
    sample_rows,
    score_episodes,
)
from mjx_revolve.episodes.tasks import find_task
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics.xla import compiler_options, derived_by, over_chunks
from mjx_revolve.water.flow import water_of
from mjx_revolve.water.world import World, load_world


@dataclass(frozen=True, eq=False)
class MixedFitness:
    """Scores of different bodies: `fitness(robots, population, key)`.

    Attributes:
        config: task, world and controller; its morphology is not used.
        world: the world.
        shape: what the bodies must fit.
        contact: whether they can touch the bed.
    """

    config: Config
    world: World
    shape: Shape
    contact: bool
    _single: dict[int, Any] = field(default_factory=dict, repr=False)

    @property
    def num_genes(self) -> int:
        """Length of an individual's genes: those of the largest body; others leave some unused."""
        return (2 * self.config.controller.harmonics + 1) * self.shape.hinges + 1

    @property
    def worst_score(self) -> float:
        """The score of a rollout that blew up."""
        return WORST

    def build(self, morphology: Morphology) -> Robot:
        """Compiles a body for this world, trimmed as the configuration says."""
        if self.config.trim == "neutral":
            morphology = trim_neutral(morphology, self.world.density)
        return build_robot(morphology, self.world)

    def pad_genes(self, genes: Any, robot: Robot) -> jax.Array:
        """The genes of one body's own controller as this fitness takes them.

        Args:
            genes: `[..., (2 harmonics + 1) n + 1]`, n the robot's hinges, as `make_sine` has them.
            robot: whose they are.

        Returns:
            `[..., num_genes]`: for each kind of gene, one for every hinge that a body may have.
        """
        genes = jnp.asarray(genes)
        n, kinds = robot.num_hinges, 2 * self.config.controller.harmonics + 1
        if genes.shape[-1] != kinds * n + 1:
            raise InputError(f"genes: expected [..., {kinds * n + 1}]; found {list(genes.shape)}")
        wide = genes[..., :-1].reshape(*genes.shape[:-1], kinds, n)
        room = [(0, 0)] * (wide.ndim - 1) + [(0, self.shape.hinges - n)]
        flat = jnp.pad(wide, room).reshape(*genes.shape[:-1], -1)
        return jnp.concatenate([flat, genes[..., -1:]], -1)

    def own_genes(self, genes: Any, robot: Robot) -> jax.Array:
        """The way back: those of `[..., num_genes]` that a body's own controller takes."""
        genes = jnp.asarray(genes)
        kinds = 2 * self.config.controller.harmonics + 1
        wide = genes[..., :-1].reshape(*genes.shape[:-1], kinds, self.shape.hinges)
        flat = wide[..., : robot.num_hinges].reshape(*genes.shape[:-1], -1)
        return jnp.concatenate([flat, genes[..., -1:]], -1)

    def __call__(self, robots: Sequence[Robot] | Bodies, population: Any, key: jax.Array) -> Any:
        """Scores a population; arguments as in `evaluate`."""
        return self.evaluate(robots, population, key)[0]

    def evaluate(
        self, robots: Sequence[Robot] | Bodies, population: Any, key: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Scores a population and says how it moved.

        Args:
            robots: a body for each individual, from `build`; one object may stand there many
                times. Or their tables, from `pack`.
            population: `[P, num_genes]`.
            key: draws the episodes' starts and water, the same for every individual.

        Returns:
            `[P]` scores and `[P]` measures, as `Fitness.evaluate` has them.

        Raises:
            InputError: the numbers of bodies and of individuals differ, a body does not fit or is
                none, or the key is none.
        """
        population = jnp.asarray(population)
        if population.ndim != 2 or population.shape[1] != self.num_genes:
            raise InputError(
                f"population: expected [P, {self.num_genes}]; found {list(population.shape)}"
            )
        if not isinstance(robots, Bodies):
            if len(robots) != len(population):
                raise InputError(
                    f"robots: expected {len(population)}, one each; found {len(robots)}"
                )
            for robot in robots:
                if not isinstance(robot, Robot):
                    raise InputError(
                        f"robots: expected what `build` returns; found {type(robot).__name__}"
                    )
        check_key(key)
        traced = any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves((population, key)))
        run = self._evaluate if traced else self._jitted
        if isinstance(robots, Bodies):
            return run(robots, population, key)
        if all(robot is robots[0] for robot in robots):
            single = self._alone(robots[0])
            return single.evaluate(self.own_genes(population, robots[0]), key)
        return run(self.pack(robots), population, key)

    def pack(self, robots: Sequence[Robot]) -> Bodies:
        """Tables of the bodies, for many evaluations of the same ones."""
        return pack_bodies(robots, self.shape)

    def _alone(self, robot: Robot) -> Fitness:
        """The fitness of one body, its compiled program kept."""
        if id(robot) not in self._single:
            controller = CONTROLLERS[self.config.controller.type](robot, self.config.controller)
            engine = make_engine(robot, self.config.engine, self.contact)
            # The robot goes along, so that its id is not given to another.
            self._single[id(robot)] = Fitness(self.config, robot, controller, engine)
        return self._single[id(robot)]

    @cached_property
    def _jitted(self) -> Any:
        return jax.jit(self._evaluate, compiler_options=compiler_options())

    def _evaluate(self, bodies: Bodies, population: Any, key: jax.Array) -> Any:
        task, world = self.config.task, self.world
        place, quat, water = draw_starts(task, world, key, 0.0)
        root = jnp.concatenate([place, quat]).astype(population.dtype)
        every, records = sample_rows(task, world.timestep)
        gusts = draw_gusts(task, world, key, records * every)
        run = partial(self._episode, bodies, population, root, water, gusts)
        episodes = list_episodes(len(population), task.trials)
        return average_trials(over_chunks(run)(*episodes), task.trials)

    @property
    def _longest(self) -> float:
        # Longer than any body of so many rows: what has blown up is far beyond it.
        return 0.2 * (1 + self.shape.rows)

    def _episode(
        self,
        bodies: Bodies,
        population: Any,
        root: Any,
        water: Any,
        gusts: Any,
        individual: jax.Array,
        trial: jax.Array,
    ) -> Scores:
        """Scores of one chunk of episodes; arguments as of `Fitness._episode`.

        `bodies` are of all individuals, and `root` are `[7, trials]` start poses of the core.
        """
        world, shape, settings = self.world, self.shape, self.config.controller
        count = len(individual)
        bodies = jax.tree.map(lambda x: jnp.asarray(x)[..., individual], bodies)
        genes = population[individual].T
        root = root[:, trial]
        if self.config.task.type == "crawl":
            root = root.at[2].add(bodies.below)
        water = jax.tree.map(lambda x: x[trial], water)
        kinds = genes[:-1].reshape(-1, shape.hinges, count)
        low, high = joint_of(shape, bodies.tables).target
        half = jnp.broadcast_to(jnp.asarray((high - low) / 2, genes.dtype), (shape.rows, count))
        center = jnp.broadcast_to(jnp.asarray((high + low) / 2, genes.dtype), half.shape)
        moves = bodies.hinge < shape.hinges
        parameters = decode_sine(
            [to_rows(bodies, row) for row in kinds],
            genes[-1:],
            jnp.where(moves, settings.amplitude * half, 0),
            jnp.where(moves, center, 0),
            settings.max_frequency,
        )
        rest = jnp.zeros((shape.hinges, count), root.dtype)
        qpos = jnp.concatenate([root, rest])
        qvel = jnp.zeros((6 + shape.hinges, count), root.dtype)
        start = make_mixed_engine(world, shape, bodies).init(qpos, qvel)
        rows = None
        if gusts is not None:
            rows = gusty_water(world, gusts[..., trial], water)
            steps = gusts.shape[0] - 1
            rows = jax.tree.map(lambda x: jnp.broadcast_to(x, (steps, count)), rows)

        every, records = sample_rows(self.config.task, world.timestep)

        def loop(bodies: Any, start: Any, parameters: Any, water: Any, rows: Any, mode: str) -> Any:
            engine = make_mixed_engine(world, shape, bodies)
            still = water_of(world) if water is None else water
            _, kept = roll_out(
                engine,
                lambda state, time, row, sense: step_sine(parameters, state, time, sense),
                lambda time, row: flow_at(world, still if row is None else row)(time, None),
                lambda state, ctrl, energy: (engine.root(state), energy),
                start,
                (),
                rows,
                records=records,
                every=every,
                timestep=world.timestep,
                mode=mode,
            )
            return kept

        episode = derived_by(partial(loop, mode="fused"), partial(loop, mode="derived"))
        place, energy = episode(bodies, start, parameters, water, rows)
        return score_episodes(
            self.config.task,
            find_task(self.config.task, self.config.source),
            world,
            jnp.stack(place, 1),
            energy,
            root[:3],
            bodies.length,
            jnp.maximum(bodies.weight, 1e-9),
            farthest(self.config, world, self._longest, sinks=True),
        )


def make_mixed_fitness(
    config: Config | str | Path | dict[str, Any],
    examples: Sequence[Morphology],
    hinges: int = 0,
    rows: int = 0,
    **overrides: Any,
) -> MixedFitness:
    """Builds the fitness function of a configuration for bodies of many kinds.

    Args:
        config: as `make_fitness` takes it; its morphology is not used.
        examples: bodies of the kinds that will come: what is the same in all of them counts as
            constant, and the largest of them sets the size.
        hinges: most hinges that a body may have, if more than the examples'.
        rows: most rows of tables that a body may need (see `menagerie`), likewise.
        **overrides: as in `make_fitness`.

    Returns:
        The fitness function.

    Raises:
        InputError: the configuration or the world is wrong, or asks for what only bodies of one
            kind may have; the message says where.
    """
    if isinstance(config, Config):
        if overrides:
            config = make_config(config.model_dump(), overrides=overrides, source=config.source)
    elif isinstance(config, dict):
        config = make_config(config, overrides=overrides)
    else:
        config = load_config(config, overrides=overrides)
    where = config.source
    if config.engine != "population":
        raise InputError(
            f"{where}: engine: expected population, as bodies differ; found {config.engine}"
        )
    if config.controller.type != "sine":
        raise InputError(
            f"{where}: controller.type: expected sine, as bodies differ; found "
            f"{config.controller.type}"
        )
    try:
        world = load_world(config.world_name, **config.world_overrides)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    if config.task.type == "crawl" and world.bed is None:
        raise InputError(f"{where}: task.type: crawl expected a world with a bed; found none")
    draft = MixedFitness(config, world, Shape(0, 1, 1, 1, 1, 0, 0, (), False), False)
    robots = [draft.build(morphology) for morphology in examples]
    for robot in robots:
        check_timestep(robot)
    if not robots:
        raise InputError("examples: expected at least one morphology; found none")
    contact = any(may_touch_bed(config, robot) for robot in robots)
    return MixedFitness(config, world, fit_shape(robots, contact, hinges, rows), contact)
