"""Scores of a population over a batch of bodies, one or many: the one fitness behind all faces.

`Setup` holds what all episodes of a configuration have in common. Bodies are an argument: None for
the one body that the setup was made for, or the tables of many. An individual's episodes run in
lanes of a chunk of fixed shape, so its score does not depend on who swims beside it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp

from mjx_revolve.control.controller import Controller
from mjx_revolve.control.courses import course_path
from mjx_revolve.control.sense import Cues, Memory
from mjx_revolve.engine.batch import Bodies, Capacity
from mjx_revolve.engine.plant import Figure
from mjx_revolve.engine.rows import make_rows
from mjx_revolve.engine.state import Engine
from mjx_revolve.engine.step import make_step_engine
from mjx_revolve.engine.variation import Variation
from mjx_revolve.episodes.config import Config, TaskConfig
from mjx_revolve.episodes.rollout import flow_at, roll_out
from mjx_revolve.episodes.scoring import (
    Scores,
    average_trials,
    list_episodes,
    sample_rows,
    score_episodes,
)
from mjx_revolve.episodes.starts import (
    Starts,
    check_key,
    cues_of,
    draw_starts,
    gusty_water,
    start_pose,
    target_path,
)
from mjx_revolve.episodes.tasks import Task
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics.xla import compiler_options, derived_by, over_chunks
from mjx_revolve.water.flow import Water, flow, water_of
from mjx_revolve.water.world import World

_TRACE = 0.02  # between the rows of a trace [s]: enough for pictures that move


@dataclass(frozen=True, eq=False, repr=False)
class Setup:
    """What all episodes of a configuration have in common.

    Attributes:
        config: what it was made from.
        world: the world.
        task: what episodes are about.
        controller: genes to commands; for the largest of many bodies.
        engine: what steps the one body; None for many.
        figure: of the one body; None for many.
        capacity: room for many bodies; None for one.
    """

    config: Config
    world: World
    task: Task
    controller: Controller
    engine: Engine | None = None
    figure: Figure | None = None
    capacity: Capacity | None = None

    @property
    def settings(self) -> TaskConfig:
        """Of the task."""
        return self.config.task

    @property
    def record_every(self) -> int:
        """Timesteps between the rows of the track that tasks see."""
        return sample_rows(self.settings, self.world.timestep)[0]

    @property
    def num_records(self) -> int:
        """How many rows the track of an episode has, before the settling time is cut off."""
        return sample_rows(self.settings, self.world.timestep)[1]

    def starts(self, key: jax.Array) -> Starts:
        """What a key's episodes start from."""
        steps = self.num_records * self.record_every
        return draw_starts(self.settings, self.world, key, steps)

    def engine_of(self, bodies: Bodies | None, lanes: int = 1, derived: bool = False) -> Engine:
        """What steps the bodies, so many side by side, perhaps to be differentiated."""
        if bodies is None:
            assert self.engine is not None
            return self.engine
        assert self.capacity is not None
        rows = make_rows(self.world, self.capacity, bodies, lanes, steady=derived)
        return make_step_engine(rows, bodies.plant)

    def figure_of(self, bodies: Bodies | None) -> Figure:
        """The bodies' size."""
        if bodies is not None:
            return bodies.figure
        assert self.figure is not None
        return self.figure

    def evaluate(
        self, bodies: Bodies | None, population: Any, key: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Scores a population and says how it moved.

        Args:
            bodies: the tables of a body for each individual, or None for the one body.
            population: `[P, num_genes]`; or `[B, P, num_genes]`, a population for each of the
                bodies, whose chunks then hold one body: much faster.
            key: draws the episodes' starts and water, the same for every individual.

        Returns:
            Scores `[P]` or `[B, P]` and measures (see `measures.measure`) likewise, means over the
            episodes.

        Raises:
            InputError: the population has another shape, there are no genes to evolve, or the key
                is none.
        """
        shape, count = jnp.shape(population), self.controller.num_genes
        ranks = (2,) if bodies is None else (2, 3)
        if len(shape) not in ranks or shape[-1] != count or 0 in shape:
            if count == 0:
                raise InputError(
                    "population: expected bodies with a hinge or a thruster to control; found "
                    "none, so that there are no genes to evolve"
                )
            raise InputError(f"population: expected [P, {count}]; found {list(shape)}")
        check_key(key)
        traced = any(isinstance(x, jax.core.Tracer) for x in (population, key))
        run = self._evaluate if traced else self._jitted
        return run(bodies, jnp.asarray(population), key)

    def starts_as(self, population: jax.Array, key: jax.Array) -> Starts:
        """What a key's episodes start from, in the population's precision."""
        return _as_precise(self.starts(key), population)

    @cached_property
    def _jitted(self) -> Any:
        # Compiler options belong to the outermost jit, so under somebody else's we go without.
        return jax.jit(self._evaluate, compiler_options=compiler_options())

    def _evaluate(self, bodies: Bodies | None, population: Any, key: jax.Array) -> Any:
        starts, bodies = self.starts_as(population, key), _as_precise(bodies, population)
        if population.ndim == 2:
            return self._score(bodies, population, starts, bodies is None)
        if self.capacity is not None and self.capacity.rows < 2:
            # The program for one body of less than two rows has loops over nothing or over one,
            # over which XLA:CPU aborts (see `xla`); the one for different bodies does as well.
            count, size, n = population.shape
            beside = jax.tree.map(lambda x: jnp.repeat(jnp.asarray(x), size, -1), bodies)
            found = self._score(beside, population.reshape(count * size, n), starts, False)
            return jax.tree.map(lambda x: x.reshape(count, size), found)
        each = jax.tree.map(lambda x: jnp.moveaxis(jnp.asarray(x), -1, 0)[..., None], bodies)
        run = lambda own: self._score(own[0], own[1], starts, True)  # noqa: E731
        return jax.lax.map(run, (each, population))

    def _score(self, bodies: Any, population: jax.Array, starts: Starts, alike: bool) -> Any:
        """Scores and measures of one population; `alike`: of one body."""
        trials = self.settings.trials
        run = partial(self._episode, bodies, alike, population, starts)
        individual, trial = list_episodes(len(population), trials)
        if alike:
            return average_trials(over_chunks(run)(individual, trial), trials)
        # A chunk takes as long as its largest body: those of a size share chunks.
        order = jnp.argsort(bodies.count, stable=True).astype(individual.dtype)
        scores = average_trials(over_chunks(run)(order[individual], trial), trials)
        return jax.tree.map(lambda x: jnp.zeros_like(x).at[order].set(x), scores)

    def _episode(
        self,
        bodies: Bodies | None,
        alike: bool,
        population: jax.Array,
        starts: Starts,
        individual: jax.Array,
        trial: jax.Array,
    ) -> Scores:
        """Scores of one chunk of episodes; see `_roll`."""
        recorded, root, figure, cues = self._roll(
            bodies, alike, population, starts, individual, trial, self.record_every,
            partial(make_recorder, task=self.task, world=self.world),
        )  # fmt: skip
        recorded = record_cues(self, recorded, cues)
        return score_episodes(self.task, self.settings, self.world, recorded, root[:3], figure)

    @property
    def trace_every(self) -> int:
        """Timesteps between the rows of a trace: those of a track share them evenly."""
        most = max(1, int(_TRACE / self.world.timestep + 1e-6))
        return max(n for n in range(1, most + 1) if self.record_every % n == 0)

    def trace(
        self, bodies: Bodies, population: jax.Array, key: jax.Array, trial: int
    ) -> tuple[float, dict[str, jax.Array]]:
        """What many bodies do in one of a key's episodes.

        Args:
            bodies: of `[P]` individuals.
            population: `[P, num_genes]`.
            key: draws the start.
            trial: which of the key's episodes.

        Returns:
            Time between rows [s], and `qpos`, `qvel`, `command` (of thrusters, behind their lag),
            `ctrl` in the engine's order, `[T, n, P]` each, and `energy` since the last row `[T, P]`
            [J]; `target`, where that chases the robots, world frame [m].
        """
        every = self.trace_every
        found = self._traced(bodies, population, key, jnp.full(len(population), trial, jnp.int32))
        return every * self.world.timestep, found

    @cached_property
    def _traced(self) -> Any:
        def make_record(engine: Engine) -> Any:
            def record(state: Any, ctrl: jax.Array, energy: jax.Array, water: Water) -> Any:
                qpos, qvel = engine.observe(state)
                command = engine.command(state)
                return {"qpos": qpos, "qvel": qvel, "ctrl": ctrl, "energy": energy,
                        "command": command}  # fmt: skip

            return record

        def run(bodies: Bodies, population: jax.Array, key: jax.Array, trial: jax.Array) -> Any:
            starts = self.starts_as(population, key)

            def chunk(individual: jax.Array, trial: jax.Array) -> Any:
                return self._roll(
                    bodies, False, population, starts, individual, trial, self.trace_every,
                    make_record,
                )[0]  # fmt: skip

            return over_chunks(chunk)(jnp.arange(len(population), dtype=jnp.int32), trial)

        return jax.jit(run, compiler_options=compiler_options())

    def _roll(
        self,
        bodies: Bodies | None,
        alike: bool,
        population: jax.Array,
        starts: Starts,
        individual: jax.Array,
        trial: jax.Array,
        every: int,
        make_record: Callable[[Engine], Callable[..., dict[str, jax.Array]]],
    ) -> tuple[dict[str, jax.Array], jax.Array, Figure, Cues]:
        """What is recorded of one chunk of episodes.

        A chunk picks what is its own from what all chunks share, so that nothing is kept for each
        episode of a population but its scores.

        Args:
            bodies: of all individuals, or None.
            alike: whether they are one body's, which all individuals have.
            population: `[P, num_genes]`.
            starts: of all trials.
            individual: `[lanes]` whose episode each is.
            trial: `[lanes]` which of that individual's.
            every: timesteps between records, which share `record_every` evenly.
            make_record: engine → what `rollout.roll_out` takes as `record`.

        Returns:
            Records, the cores' start poses `[7, lanes]`, the bodies' sizes, and the cues.
        """
        world, controller, settings = self.world, self.controller, self.settings
        own = (lambda x: x) if alike else (lambda x: x[..., individual])
        bodies = jax.tree.map(lambda x: own(jnp.asarray(x)), bodies)
        starts = jax.tree.map(lambda x: x[..., trial], starts)
        root = start_pose(self.task, settings, world, self.figure_of(bodies), starts)
        cues = cues_of(settings, starts, root[:3])
        plant = self.engine_of(None).plant if bodies is None else bodies.plant
        parameters = controller.decode(population[individual].T, plant)
        rows = None
        if starts.gusts is not None:
            rows = gusty_water(world, starts.gusts, starts.water)
            shape = (starts.gusts.shape[0] - 1, root.shape[-1])
            rows = jax.tree.map(lambda x: jnp.broadcast_to(x, shape), rows)

        def run(
            derived: bool, bodies: Any, root: Any, parameters: Any, water: Any, rows: Any,
            cues: Any, variation: Any,
        ) -> Any:  # fmt: skip
            engine = vary_engine(self.engine_of(bodies, root.shape[-1], derived), variation)
            still = water_of(world) if water is None else water
            hinges = jnp.zeros((engine.plant.num_hinges, root.shape[-1]), root.dtype)
            qvel = jnp.concatenate([jnp.zeros_like(root[:6]), hinges])
            _, kept = roll_out(
                engine,
                lambda state, time, row, sense: controller.step(parameters, state, time, sense),
                lambda time, row: flow_at(world, still if row is None else row)(time, None),
                make_record(engine),
                engine.init(jnp.concatenate([root, hinges]), qvel),
                controller.init(parameters),
                rows,
                records=self.num_records * (self.record_every // every),
                every=every,
                timestep=world.timestep,
                derived=derived,
                world=world,
                cues=cues,
                feels=controller.feels,
                recall=recall_pursuer,
            )
            return kept

        episode: Any = partial(run, False)
        if self.engine is None or self.engine.fuses:  # MJX's step is differentiated as it is
            episode = derived_by(episode, partial(run, True))
        recorded = episode(bodies, root, parameters, starts.water, rows, cues, starts.variation)
        return recorded, root, self.figure_of(bodies), cues


def _as_precise(tree: Any, like: jax.Array) -> Any:
    """The tree with its floats in the precision of `like`."""
    number = lambda x: jnp.issubdtype(x.dtype, jnp.floating)  # noqa: E731
    cast = lambda x: x.astype(like.dtype) if number(x) else x  # noqa: E731
    return jax.tree.map(cast, tree)


def vary_engine(engine: Engine, variation: Variation | None) -> Engine:
    """An engine with the coefficients of an episode; the same one where they are not varied."""
    if variation is None:
        return engine
    assert engine.varied is not None, "`fitness` refuses worlds and engines that cannot"
    return engine.varied(variation)


def recall_pursuer(recorded: dict[str, Any], memory: Memory) -> dict[str, Any]:
    """Records with the place of a target that chases the robot, if there is one."""
    if memory.pursuer is None:
        return recorded
    return recorded | {"target": jnp.stack(memory.pursuer.place)}


def record_cues(setup: Setup, recorded: dict[str, Any], cues: Cues) -> dict[str, Any]:
    """Records with target and course along the way, if the task asks for them and they exist."""
    interval = setup.record_every * setup.world.timestep
    time = interval * jnp.arange(1, setup.num_records + 1, dtype=recorded["position"].dtype)
    found = dict(recorded)
    if "target" not in setup.task.records:
        found.pop("target", None)
    elif "target" not in found and cues.target is not None:
        found["target"] = target_path(cues, time)
    if "course" in setup.task.records and cues.course is not None:
        found["course"] = course_path(cues.course, time)
    return found


def make_recorder(
    engine: Engine, task: Task, world: World
) -> Callable[[Any, jax.Array, jax.Array, Water], dict[str, jax.Array]]:
    """What `rollout.roll_out` records for a task: fields of a `tasks.Track`."""

    def record(state: Any, ctrl: jax.Array, energy: jax.Array, water: Water) -> Any:
        root = engine.root(state)
        found = {"position": jnp.stack(root.position), "energy": energy}
        if "core" in task.records:
            found["quat"] = jnp.stack(root.quat)
            found["velocity"], found["spin"] = jnp.stack(root.velocity), jnp.stack(root.spin)
        if "joints" in task.records:
            qpos, qvel = engine.observe(state)
            found["angle"], found["speed"] = qpos[7:], qvel[6:]
        if {"contacts", "forces"} & set(task.records):
            bed, wet = engine.push(state, ctrl, water)
            if "contacts" in task.records:
                found["bed_force"] = jnp.stack(bed)
            if "forces" in task.records:
                found["water_force"] = jnp.stack(wet)
        if "water" in task.records:
            velocity, _ = flow(world, water, *root.position)
            found["water_velocity"] = jnp.stack(
                [jnp.broadcast_to(jnp.asarray(v, energy.dtype), energy.shape) for v in velocity]
            )
        return found

    return record


def pick_water(world: World, starts: Starts, trial: int) -> Water | None:
    """The water of one episode, as `simulate` takes it; None: just the world's."""
    water = jax.tree.map(lambda x: x[trial], starts.water)
    if starts.gusts is None:
        return water
    return gusty_water(world, starts.gusts[..., trial], water)
