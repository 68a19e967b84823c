"""Fitness: genes to scores, as pure JAX functions that any optimiser can call.

`make_fitness` builds the robot, the controller and the task of a configuration once, and returns a
function of (population, key). `make_mixed_fitness` does the same for bodies that differ from
individual to individual: a function of (robots, population, key), one compiled program for all
bodies that it has room for, generation after generation. Both run under jit, vmap and grad, though
XLA takes minutes to compile derivatives for many bodies; `evaluation` does the work for both.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from mjx_revolve.body.edits import add_module, replace_module
from mjx_revolve.body.module_types import ModuleType
from mjx_revolve.body.morphology import Morphology, trim_neutral
from mjx_revolve.control.controller import Controller, as_plant, bind_genes, gene_indices
from mjx_revolve.control.kinds import find_controller
from mjx_revolve.control.readings import EpisodeContext, SensorMemory
from mjx_revolve.control.sensors import resolve_sensors
from mjx_revolve.engine.batch import Capacity, PackedBodies, fit_capacity, pack_bodies
from mjx_revolve.engine.batched_trees import make_batched_trees
from mjx_revolve.engine.engine import Engine
from mjx_revolve.engine.engines import make_engine
from mjx_revolve.engine.kinematics import body_poses
from mjx_revolve.engine.plant import (
    BodyGeometry,
    Plant,
    actuators_of,
    body_geometry,
    least_lift,
    plant_of,
)
from mjx_revolve.engine.population import PopulationEngine
from mjx_revolve.engine.robot import Robot, build_robot, check_timestep
from mjx_revolve.engine.variation import Variation
from mjx_revolve.episodes.config import Config, ControllerConfig, load_config, make_config
from mjx_revolve.episodes.evaluation import (
    EpisodeSpec,
    as_precise,
    task_recorder,
)
from mjx_revolve.episodes.named_files import read_modules, read_morphology, read_world
from mjx_revolve.episodes.rollout import RolloutState, with_variation
from mjx_revolve.episodes.scoring import average_trials, list_episodes, max_distance, may_touch_bed
from mjx_revolve.episodes.simulate import Trajectory, simulate
from mjx_revolve.episodes.starts import Starts, episode_context, target_path
from mjx_revolve.episodes.tasks import TASKS, Task, find_task, start_above_bed, start_at_depth
from mjx_revolve.inputs.errors import InputError, note
from mjx_revolve.numerics.xla import materialize, over_chunks
from mjx_revolve.water.bed import bed_height
from mjx_revolve.water.drag import DRAG_LAWS, find_drag_law
from mjx_revolve.water.flow import Water, water_of
from mjx_revolve.water.world import World

# Greatest time between the rows of a trace: enough for pictures that move [s].
_TRACE_INTERVAL = 0.02


@dataclass(frozen=True, eq=False, repr=False)
class Fitness(EpisodeSpec[tuple[()]]):
    """Scores of a population of one body: `fitness(population, key)`.

    Attributes:
        robot: the body.
        engine: steps it.
        geometry: its size.
    """

    robot: Robot
    engine: Engine
    geometry: BodyGeometry

    def __repr__(self) -> str:
        """A line: `Fitness(directed_swim in lake, Morphology('spider': ...), 57 genes)`."""
        what = f"{self.config.subject}, {self.robot.morphology!r}"
        return f"Fitness({what}, {self.num_genes} genes)"

    def _engine(self, bodies: tuple[()], lanes: int, differentiable: bool) -> Engine:
        return self.engine

    def _geometry(self, bodies: tuple[()]) -> BodyGeometry:
        return self.geometry

    @property
    def _bodies_key(self) -> object:
        # Workers have copies of the file elsewhere, each time.
        body = replace(self.robot.morphology, path=None)
        return body, with_sensors(self.config, body).model_dump_json()

    def __call__(self, population: ArrayLike, key: jax.Array) -> jax.Array:
        """Scores a population.

        Args:
            population: `[P, num_genes]`.
            key: draws the episodes' start poses and water, the same for every individual.

        Returns:
            `[P]` mean score over the episodes, higher is better; `WORST` where a rollout blew up.
        """
        return self.evaluate(population, key)[0]

    def evaluate(
        self, population: ArrayLike, key: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Scores and measures of a population.

        Args:
            population: `[P, num_genes]`.
            key: draws the episodes' start poses and water, the same for every individual.

        Returns:
            `[P]` scores and `[P]` measures (see `measures.measure`), means over the episodes.

        Raises:
            InputError: the population has another shape, there are no genes to evolve, or the key
                is none.
        """
        population = self.check_population(population)
        return self.program(population, key)((), population, key)

    def precompile(self, population: ArrayLike, key: jax.Array) -> None:
        """Compiles `evaluate` for such a population, or reads its program, without an episode."""
        self.scorer.precompile((), self.check_population(population), key)

    def bare_controller(self) -> Controller:
        """The controller for a real device: called at its rate, with readings of real sensors.

        It gives a command at each call and simulates no noise, rate or delay of sensors: its inputs
        have those already. It takes the same genes as the controller in the simulation.
        """
        rate, plant = self.controller.rate, plant_of(self.robot)
        body = self.robot.morphology
        settings = with_sensors(self.config, body)
        exact = [replace(s, noise=0.0, rate=None, delay=0.0) for s in settings.sensors or ()]
        sensors = None if settings.sensors is None else tuple(exact)
        settings = settings.model_copy(update={"rate": None, "sensors": sensors})
        if rate is not None:
            plant = plant.at_rate(rate)
        return _find_controller(self.config, settings, plant, body)

    def replay(self, genes: ArrayLike, key: jax.Array, trial: int = 0) -> Trajectory:
        """One episode of one individual, in full.

        Args:
            genes: `[num_genes]`.
            key: as in `evaluate`.
            trial: which of the key's episodes.

        Returns:
            The trajectory.
        """
        return simulate(
            self.robot,
            bind_genes(self.controller, genes),
            self.num_timesteps * self.world.timestep,
            qpos=self.starts(key)[0][:, trial],
            water=self.water(key, trial),
            engine=self.config.engine,
            once=True,
            context=self.context(key, trial),
            variation=self.variation(key, trial),
        )

    def judge(
        self, trajectory: Trajectory, key: jax.Array, trial: int = 0
    ) -> tuple[float, dict[str, float]]:
        """Scores one episode, as evolution does, from its trajectory.

        A trajectory has poses, not wakes: of laws with a memory (thin plates and fins in the
        default water), a task with the record "forces" gets those of parts without a past.

        Args:
            trajectory: from `replay(genes, key, trial)`, all rows.
            key: draws its start.
            trial: its number.

        Returns:
            The score, NaN where the rollout blew up, and the measures.
        """
        every, steps, dt = self.record_every, self.num_timesteps, self.world.timestep
        rows = slice(every - 1, steps, every)
        water = self.water(key, trial) or water_of(self.world)
        if self.world.waves:
            water = water._replace(time=water.time + dt * jnp.arange(steps))
        command = trajectory.command
        score, measures = self._judge(
            *(jnp.asarray(x)[rows].T for x in (trajectory.qpos, trajectory.qvel, trajectory.ctrl)),
            jnp.zeros((0, self.num_records)) if command is None else jnp.asarray(command)[rows].T,
            jnp.asarray(trajectory.power * dt).reshape(-1, every).sum(1)[:, None],
            jax.tree.map(lambda x: jnp.broadcast_to(x, (steps,))[rows], water),
            self.start_point(self.geometry, self.draw_starts(key))[:, trial : trial + 1],
            jax.tree.map(lambda x: jnp.asarray(x)[..., None], self.context(key, trial)),
            self.variation(key, trial),
            None if trajectory.target is None else jnp.asarray(trajectory.target)[rows],
        )
        return float(score[0]), {name: float(value[0]) for name, value in measures.items()}

    @cached_property
    def _judge(self) -> Any:
        """The task and the measures of one lane, compiled once for all champions."""

        def run(
            qpos: jax.Array, qvel: jax.Array, ctrl: jax.Array, command: jax.Array,
            energy: jax.Array, water: Water, start: jax.Array,
            context: EpisodeContext, variation: Variation | None, target: PyTree,
        ) -> PyTree:  # fmt: skip
            # The rows of the episode are the lanes, like a population.
            engine = with_variation(self.engine, variation)
            state = engine.init(qpos, qvel)
            if command.shape[0] and hasattr(state, "command"):
                state = state._replace(command=command)
            ctrl = engine.plant.arrange(ctrl[actuators_of(self.robot)])
            now = RolloutState(state, (), SensorMemory(), energy[:, 0], jnp.zeros((), jnp.int32))
            rows = task_recorder(engine, self.task, self.world)(now, ctrl, water)
            track = {name: jnp.moveaxis(x, -1, 0)[..., None] for name, x in rows.items()}
            if context.pursuit is not None:
                track["target"] = target[..., None]
            found = self.score(track | {"energy": energy}, start, self.geometry, context)
            return jnp.where(found.sane, found.score, jnp.nan), found.measures

        return jax.jit(run)

    def context(self, key: jax.Array, trial: int = 0) -> EpisodeContext:
        """The sensors' context in one of a key's episodes, as `simulate` takes it."""
        start = self.draw_start(key, trial)
        return episode_context(self.settings, start, self.starts(key)[0][:3, trial])

    def starts(self, key: jax.Array) -> tuple[jax.Array, Water | None]:
        """Start poses and water of a key's episodes.

        Args:
            key: draws them.

        Returns:
            `[nq, trials]` qpos, and the water `[trials]` where it varies, else None.
        """
        starts = self.draw_starts(key)
        root = self.start_pose(self.geometry, starts)
        rest = jnp.asarray(self.robot.qpos0, root.dtype)[7:, None]
        rest = jnp.broadcast_to(rest, (rest.shape[0], root.shape[1]))
        return jnp.concatenate([root, rest]), starts.water


@dataclass(frozen=True, eq=False, repr=False)
class MixedFitness(EpisodeSpec[PackedBodies]):
    """Scores of different bodies: `fitness(robots, population, key)`.

    Attributes:
        capacity: what the bodies must fit.
        touches: whether robots may come near the bed.
        controller_settings: of the controller, with all sensors.
    """

    capacity: Capacity
    touches: bool
    controller_settings: ControllerConfig

    def __repr__(self) -> str:
        """A line: `MixedFitness(directed_swim in lake, at most 113 genes)`."""
        return f"MixedFitness({self.config.subject}, at most {self.num_genes} genes)"

    def _engine(self, bodies: PackedBodies, lanes: int, differentiable: bool) -> Engine:
        trees = make_batched_trees(self.world, self.capacity, bodies, lanes, steady=differentiable)
        return PopulationEngine(trees, bodies.plant)

    def _geometry(self, bodies: PackedBodies) -> BodyGeometry:
        # In kernels of its own: of one individual, XLA:CPU would take the reciprocal of a length
        # that is the same in all lanes, and round its score otherwise than beside others.
        return jax.tree.map(materialize, bodies.figure)

    @property
    def _bodies_key(self) -> object:
        return self.capacity, self.touches, self.controller_settings.model_dump_json()

    def build(self, morphology: Morphology) -> Robot:
        """Compiles a body for this world, trimmed if the configuration says so."""
        return _build(self.config, self.world, morphology)

    def controller_of(self, body: Plant | Robot) -> Controller:
        """The controller of one body alone, with genes named after its own joints."""
        return _find_controller(self.config, self.controller_settings, as_plant(body))

    def pad_genes(self, genes: ArrayLike, robot: Robot) -> Any:
        """The genes of one body's own controller as this fitness takes them.

        Args:
            genes: `[..., n]` of the body's own controller.
            robot: the body.

        Returns:
            `[..., num_genes]`: genes of joints that the body lacks are 0. A JAX array for a JAX
            array, else one of NumPy's.
        """
        genes = genes if isinstance(genes, jax.Array) else np.asarray(genes)
        indices = self._indices(robot)
        if genes.shape[-1:] != (len(indices),):
            raise InputError("genes", f"[..., {len(indices)}]", list(genes.shape))
        shape = (*genes.shape[:-1], self.num_genes)
        if isinstance(genes, jax.Array):
            return jnp.zeros(shape, genes.dtype).at[..., indices].set(genes)
        wide = np.zeros(shape, genes.dtype)
        wide[..., indices] = genes
        return wide

    def own_genes(self, genes: ArrayLike, robot: Robot) -> Any:
        """The inverse: those of `[..., num_genes]` that a body's own controller takes."""
        genes = genes if isinstance(genes, jax.Array) else np.asarray(genes)
        if genes.shape[-1:] != (self.num_genes,):
            raise InputError("genes", f"[..., {self.num_genes}]", list(genes.shape))
        return genes[..., self._indices(robot)]

    def _indices(self, robot: Robot) -> np.ndarray:
        own = self.controller_of(robot)
        if not set(own.genes) <= set(self.controller.genes):
            self.pack([robot])  # says in which way the body is too large
        return gene_indices(own, self.controller)

    def __call__(
        self, robots: Robot | Sequence[Robot] | PackedBodies, population: ArrayLike, key: jax.Array
    ) -> Any:
        """Scores a population; arguments as in `evaluate`."""
        return self.evaluate(robots, population, key)[0]

    def evaluate(
        self, robots: Robot | Sequence[Robot] | PackedBodies, population: ArrayLike, key: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Scores and measures of a population.

        Bodies with populations of their own are stepped twice as fast as individuals of different
        bodies side by side, if a population has 64 episodes or more (on a CPU).

        Args:
            robots: a body for each individual, from `build`; one object may stand there many
                times. One body for all of them. Or B bodies, each with a population of its own.
                Or their tables, from `pack`.
            population: `[P, num_genes]`; with a population for each body `[B, P, num_genes]`.
            key: draws the episodes' starts and water, the same for every individual.

        Returns:
            Scores `[P]` or `[B, P]` and measures of that shape, as `Fitness.evaluate` has them.

        Raises:
            InputError: the numbers of bodies and of individuals differ, a body does not fit or is
                none, or the key is none.
        """
        bodies, populations = self._beside(robots, population)
        found = self.program(populations, key)(bodies, populations, key)
        single = np.ndim(population) < populations.ndim
        return jax.tree.map(lambda x: x[0], found) if single else found

    def precompile(
        self, robots: Robot | Sequence[Robot] | PackedBodies, population: ArrayLike, key: jax.Array
    ) -> None:
        """Compiles `evaluate` for such arguments, or reads its program, without an episode."""
        self.scorer.precompile(*self._beside(robots, population), key)

    def _beside(
        self, robots: Robot | Sequence[Robot] | PackedBodies, population: ArrayLike
    ) -> tuple[PackedBodies, jax.Array]:
        """Tables of bodies with their genes, as `_score` takes them."""
        population = self.check_population(population, (2, 3))
        if isinstance(robots, Robot):
            robots = self.pack([robots])
        count = robots.count.shape[-1] if isinstance(robots, PackedBodies) else len(robots)
        if population.ndim == 2 and isinstance(robots, PackedBodies) and count == 1:
            population = population[None]
        if count != len(population):
            raise InputError("robots", f"{len(population)}, one each", count)
        return robots if isinstance(robots, PackedBodies) else self.pack(robots), population

    def _score(self, bodies: PackedBodies, population: jax.Array, key: jax.Array) -> PyTree:
        starts, bodies = self.precise_starts(population, key), as_precise(bodies, population)
        if population.ndim == 2:
            return self._score_different(bodies, population, starts)
        if min(self.capacity.rows, self.capacity.slots) < 2:
            # The program for one body has loops over rows, and a stack of slots; with less than two
            # of them their indices fold away, over which XLA:CPU aborts (see `xla`). The program
            # for different bodies does without.
            count, size, n = population.shape
            beside = jax.tree.map(lambda x: jnp.repeat(jnp.asarray(x), size, -1), bodies)
            found = self._score_different(beside, population.reshape(count * size, n), starts)
            return jax.tree.map(lambda x: x.reshape(count, size), found)
        trials = self.settings.trials
        individual, trial = list_episodes(population.shape[1], trials)

        def run(own: tuple[PackedBodies, jax.Array]) -> PyTree:
            chunk = self.chunk_scores(True, *own, starts)
            return average_trials(over_chunks(chunk)(individual, trial), trials)

        each = jax.tree.map(lambda x: jnp.moveaxis(jnp.asarray(x), -1, 0)[..., None], bodies)
        return jax.lax.map(run, (each, population))

    def _score_different(
        self, bodies: PackedBodies, population: jax.Array, starts: Starts
    ) -> PyTree:
        """Scores and measures `[P]` of a population of different bodies."""
        trials = self.settings.trials
        individual, trial = list_episodes(len(population), trials)
        # A chunk takes as long as its largest body: bodies of equal size share chunks.
        order = jnp.argsort(bodies.count, stable=True).astype(individual.dtype)
        chunk = self.chunk_scores(False, bodies, population, starts)
        scores = average_trials(over_chunks(chunk)(order[individual], trial), trials)
        return jax.tree.map(lambda x: jnp.zeros_like(x).at[order].set(x), scores)

    @property
    def trace_every(self) -> int:
        """Timesteps between the rows of a replay: those of a track share them evenly."""
        most = max(1, int(_TRACE_INTERVAL / self.world.timestep + 1e-6))
        return max(n for n in range(1, most + 1) if self.record_every % n == 0)

    def replay(
        self, robots: Sequence[Robot], genes: Sequence[ArrayLike], key: jax.Array, trial: int = 0
    ) -> list[Trajectory]:
        """One episode of each of many bodies, from the same start.

        Args:
            robots: from `build`.
            genes: of each, as its own controller has them.
            key: as in `evaluate`.
            trial: which of the key's episodes.

        Returns:
            Their trajectories, with a row about every 0.02 s.
        """
        padded = [self.pad_genes(own, robot) for own, robot in zip(genes, robots, strict=True)]
        bodies, trials = self.pack(robots), jnp.full(len(padded), trial, jnp.int32)
        population = self.check_population(jnp.stack(padded))
        rows = jax.tree.map(np.asarray, self._trace(bodies, population, key, trials))
        source, step = np.asarray(bodies.plant.source), self.trace_every * self.world.timestep
        varied = self.variation(key, trial)
        return [
            _own_trajectory(robot, self.capacity, step, source[:, lane], varied, {
                name: x[..., lane] for name, x in rows.items()
            })
            for lane, robot in enumerate(robots)
        ]  # fmt: skip

    @cached_property
    def _trace(self) -> Any:
        """A function of (bodies, population, key, trials) that records whole episodes."""

        def run(
            bodies: PackedBodies, population: jax.Array, key: jax.Array, trial: jax.Array
        ) -> PyTree:
            starts = self.precise_starts(population, key)

            def trace(individual: jax.Array, trial: jax.Array) -> PyTree:
                chunk = self.prepare(False, False, bodies, population, starts, individual, trial)
                engine, every = chunk.rollout.engine, self.trace_every

                def record(now: RolloutState, ctrl: jax.Array, water: Water) -> PyTree:
                    qpos, qvel = engine.observe(now.state)
                    row = {"qpos": qpos, "qvel": qvel, "ctrl": ctrl, "energy": now.energy,
                           "command": engine.thruster_command(now.state)}  # fmt: skip
                    if now.memory.pursuer is not None:
                        row["target"] = jnp.stack(now.memory.pursuer.position)
                    return row

                count, context = self.num_timesteps // every, chunk.rollout.context
                rows = chunk.rollout.advance(chunk.state, record, count, every, chunk.inputs)[1]
                if context.target is not None and "target" not in rows:
                    time = every * self.world.timestep * jnp.arange(1, count + 1)
                    rows["target"] = target_path(context, time.astype(rows["energy"].dtype))
                return rows

            return over_chunks(trace)(jnp.arange(len(population), dtype=jnp.int32), trial)

        return self.keep(run, "trace")

    def water(self, key: jax.Array, trial: int = 0) -> Water | None:
        """The water of one of a key's episodes at a replay's rows; None: the world's."""
        every = self.trace_every
        water = super().water(key, trial)
        return jax.tree.map(lambda x: x[every - 1 :: every] if jnp.ndim(x) else x, water)

    def pack(self, robots: Sequence[Robot]) -> PackedBodies:
        """Tables of the bodies, for many evaluations of the same ones."""
        for robot in robots:
            if not isinstance(robot, Robot):
                raise InputError("robots", "what `build` returns", type(robot).__name__)
            if robot.world is not self.world and robot.world != self.world:
                name = robot.morphology.name
                raise InputError(f"robot {name!r}", "what `build` returns", "one of another world")
        bodies = pack_bodies(robots, self.capacity)
        if not self.touches:
            reach = max_distance(self.settings, self.world, bodies.figure)
            k = int(np.argmax(reach))
            if may_touch_bed(self.task, self.settings, self.world, reach[k]):
                low = "a body that cannot reach the bed, as the examples cannot"
                found = "one that may (give one like it as an example)"
                raise InputError(f"robot {robots[k].morphology.name!r}", low, found)
        return bodies


def _own_trajectory(
    robot: Robot, capacity: Capacity, step: float, source: np.ndarray,
    variation: Variation | None, rows: dict[str, np.ndarray],
) -> Trajectory:  # fmt: skip
    """The trajectory of one of many robots.

    `step`: between rows [s]; `source`: `[n]` actuator of each row of ctrl; `rows`: `[T, ...]` each.
    """
    count, model = robot.num_hinges, robot.mj_model
    own = [*range(count), *range(capacity.hinges, capacity.hinges + robot.num_thrusters)]
    ctrl = np.zeros((len(rows["ctrl"]), model.nu))
    for row, actuator in zip(own, actuators_of(robot), strict=True):
        ctrl[:, actuator] = rows["ctrl"][:, np.flatnonzero(source == row)[0]]
    qpos = rows["qpos"][:, : 7 + count]
    return Trajectory(
        time=jnp.asarray(step * np.arange(1, len(qpos) + 1)),
        qpos=jnp.asarray(qpos),
        qvel=jnp.asarray(rows["qvel"][:, : 6 + count]),
        xpos=body_poses(robot, jnp.asarray(qpos))[0],
        ctrl=jnp.asarray(ctrl),
        power=jnp.asarray(rows["energy"] / step),
        command=jnp.asarray(rows["command"][:, : robot.num_thrusters]),
        target=None if "target" not in rows else jnp.asarray(rows["target"]),
        variation=variation,
    )


# ------------------------------------------------------------------ making them


def make_fitness(
    config: Config | str | Path | Mapping[str, object], **overrides: object
) -> Fitness:
    """Builds the fitness function of a configuration.

    Args:
        config: a `Config`, the path of a YAML file, or a mapping like one.
        **overrides: settings that replace the configuration's, dotted names through `**`:
            `make_fitness(path, engine="mjx", **{"task.duration": 5.0})`.

    Returns:
        The fitness function.

    Raises:
        InputError: the configuration, the morphology or the world is wrong; the message says where.
    """
    config = _read(config, overrides)
    if config.morphology is None:
        one = "one, as this is the fitness of one body"
        found = "bodies that evolve (see make_mixed_fitness)"
        raise InputError(f"{config.source}: morphology", one, found)
    return fit_body(config, read_morphology(config))


def fit_body(config: Config, morphology: Morphology) -> Fitness:
    """The fitness of one body, whatever body the configuration names.

    Args:
        config: all but the body.
        morphology: the body, not trimmed.

    Returns:
        The fitness function.

    Raises:
        InputError: as `make_fitness`.
    """
    world, task = _place(config)
    robot = _build(config, world, morphology)
    figure = body_geometry(robot)
    reach = max_distance(config.task, world, figure)
    engine = make_engine(robot, config.engine, may_touch_bed(task, config.task, world, reach))
    settings = with_sensors(config, morphology)
    controller = _find_controller(config, settings, engine.plant, morphology)
    return Fitness(config, world, task, controller, robot, engine, figure)


def make_mixed_fitness(
    config: Config | str | Path | Mapping[str, object],
    examples: Sequence[Morphology],
    hinges: int = 0,
    rows: int = 0,
    kinds: Sequence[ModuleType] = (),
    modules: int = 0,
    **overrides: object,
) -> MixedFitness:
    """Builds the fitness function of a configuration for bodies of many kinds.

    Args:
        config: as `make_fitness` takes it; its morphology is not used.
        examples: bodies of the kinds that will come: made of the types of modules that will come,
            and the largest of them sets the size.
        hinges: most hinges that a body may have, if more than the examples'.
        rows: most rows of tables that a body may need (see `engine.batched_trees`), if more.
        kinds: types of modules that bodies may be made of, beside those of the examples.
        modules: most modules that a body may have: there is then room for all bodies of these types
            with so many modules and hinges, whatever their shape.
        **overrides: as in `make_fitness`.

    Returns:
        The fitness function.

    Raises:
        InputError: the configuration or the world is wrong, or has a setting that requires bodies
            of one kind; the message says where.
    """
    config = _read(config, overrides)
    config.require_population("as bodies differ")
    for place, value in (("hinges", hinges), ("rows", rows), ("modules", modules)):
        if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 0:
            raise InputError(place, "a whole number >= 0", repr(value))
    if isinstance(examples, Morphology | str):
        raise InputError("examples", "a list of morphologies", repr(examples)[:60])
    world, task = _place(config)
    robots = [_build(config, world, morphology) for morphology in examples]
    for robot in robots:
        check_timestep(robot)
    if not robots:
        raise InputError("examples", "at least one morphology", "none")
    figures = [body_geometry(robot) for robot in robots]
    if modules:  # no body is longer than this, and one sinks only if one of its types does
        types = [*(m.kind for robot in robots for m in robot.morphology.modules), *kinds]
        longest = modules * max(map(_diagonal, types))
        least = least_lift(world)
        heavy = any(world.density * kind.volume < least * kind.mass for kind in types)
        sinks = world.buoyancy == "off" or (heavy and config.trim != "neutral")
        thrust = modules * max(
            sum(p.thruster.largest_thrust for p in kind.parts if p.thruster is not None)
            for kind in types
        )
        figures.append(figures[0]._replace(length=longest, sinks=sinks, thrust=thrust))
    reach = max(max_distance(config.task, world, figure) for figure in figures)
    touches = may_touch_bed(task, config.task, world, reach)
    if config.colony is not None:  # in a long life a robot may get anywhere
        touches = world.bed is not None
    shown = [*robots, *_show_kinds(kinds, robots, hinges)]
    _check_alike(config, examples)
    controller_settings = with_sensors(config)
    sites = dict.fromkeys(s.each for s in controller_settings.sensors or () if s.each is not None)
    if config.controller.is_user_code:  # of which types it reads is known only when it is made
        sites |= dict.fromkeys(kind.name for kind in read_modules(config).values())
    capacity = fit_capacity(shown, kinds, touches, hinges, rows, modules, tuple(sites))
    # As many as no other axis has, so that a controller that takes one for the other is noticed.
    example = jax.tree.map(jnp.asarray, pack_bodies([robots[0]] * 7, capacity)).plant
    controller = _find_controller(config, controller_settings, capacity.plant, example=example)
    return MixedFitness(config, world, task, controller, capacity, touches, controller_settings)


def _show_kinds(
    kinds: Sequence[ModuleType], robots: Sequence[Robot], hinges: int
) -> Iterator[Robot]:
    """Bodies with a module of each type that the robots lack, so that the capacity includes it.

    Types with a hinge are left out if bodies may have none.
    """
    known = {module.kind.name for robot in robots for module in robot.morphology.modules}
    bodies = [robot.morphology for robot in robots]
    body = next((body for body in bodies if body.modules[0].kind.slots), bodies[0])
    core = replace(body, modules=body.modules[:1], overlaps=())
    hinged = hinges > 0 or any(robot.num_hinges for robot in robots)
    for kind in kinds:
        if kind.name in known or (kind.hinge is not None and not hinged):
            continue
        catalogue = {kind.name: kind}
        if kind.mount is None:
            found = replace_module(core, 0, kind.name, modules=catalogue)
        elif core.modules[0].kind.slots:
            slot = min(core.modules[0].kind.slots)
            found = add_module(core, 0, slot, kind.name, modules=catalogue, allow_overlap=True)
        else:
            continue
        yield build_robot(found, robots[0].world)


def _diagonal(kind: ModuleType) -> float:
    """An upper bound of the length that a module adds to a body [m]."""
    return sum(float(np.linalg.norm(box.size)) for part in kind.parts for box in part.boxes)


def _read(
    config: Config | str | Path | Mapping[str, object], overrides: dict[str, object]
) -> Config:
    """A configuration from a `Config`, a path or a mapping, with overrides."""
    if isinstance(config, Config):
        if not overrides:
            return config
        return make_config(config.model_dump(), overrides=overrides, source=config.source)
    if isinstance(config, Mapping):
        return make_config(config, overrides=overrides)
    return load_config(config, overrides=overrides)


def _place(config: Config) -> tuple[World, Task]:
    """The world and the task, checked for compatibility."""
    world = read_world(config)
    try:
        task = find_task(config.task, config.source)
    except InputError as error:
        about = str(error).startswith(f"{config.source}: ")  # rather than about a user's own file
        raise (config.blame(error) if about else error) from None
    if task.on_bed and world.bed is None:
        raise InputError(
            f"{config.origin('task.type')}task.type: {config.task.name} expected a world with a "
            "bed; found none"
        )
    if task.on_bed and config.task.start_attitude != "level":
        level = f"level, as {config.task.name} starts on the bed"
        raise config.misfit("task.start_attitude", level, config.task.start_attitude)
    if world.bed is not None and config.colony is None:
        deepest = world.surface_height - float(bed_height(world.bed, *np.zeros((2, 1)))[0])
        if task.start is start_at_depth and config.task.depth >= deepest:
            least = f"one above the bed, which is {deepest:g} m below the surface"
            raise config.misfit("task.depth", least, f"{config.task.depth:g}")
        height = config.task.height
        if task.start is start_above_bed and height is not None and height >= deepest:
            most = f"one below the surface, which is {deepest:g} m above the bed"
            raise config.misfit("task.height", most, f"{height:g}")
    _check_robust(config, world)
    return world, task


def _check_robust(config: Config, world: World) -> None:
    """Refuses `task.robust` for laws with coefficients that cannot be varied."""
    if config.task.robust is None:
        return
    place = f"{config.source}: task.robust"
    if config.engine != "population":
        off = f"off, as engine is {config.engine}, which has its coefficients as constants"
        raise InputError(place, off, "some ranges")
    if not find_drag_law(world.drag).varied:
        *most, last = (name for name, law in DRAG_LAWS.items() if law.varied)
        known = f"a world with drag {', '.join(most)} or {last}, as MuJoCo's laws are not varied"
        raise InputError(place, known, world.drag)


def _build(config: Config, world: World, morphology: Morphology) -> Robot:
    if config.trim == "neutral":
        if world.density == 0:
            none = "none, as water of density 0 carries nothing"
            raise InputError(f"{config.source}: trim", none, "neutral")
        morphology = trim_neutral(morphology, world.density)
        added = sum(part.electronics_volume for part in morphology.modules[0].kind.parts)
        if added > (boxes := morphology.box_volume):  # no electronics are larger than their robot
            note(
                f"{config.source}: trim: neutral with {1e6 * added:.4g} cm3 in the core, and all "
                f"boxes have {1e6 * boxes:.4g}: are masses in kg, and is {world.density:g} kg/m3 "
                "the water's density?"
            )
    return build_robot(morphology, world)


def _check_alike(config: Config, bodies: Sequence[Morphology]) -> None:
    """Refuses bodies with sensors of their own where all must have the same."""
    for body in bodies:
        if body.sensors is not None and config.controller.sensors is None:
            own = f"none, and sensors of its own in {body.name!r}"
            same = "some, the same for all bodies"
            raise InputError(f"{config.source}: controller.sensors", same, own)


def with_sensors(config: Config, body: Morphology | None = None) -> ControllerConfig:
    """Settings of the controller with all its sensors, those of types of modules, too."""
    declared = config.controller.sensors
    if declared is None and body is not None:
        declared = body.sensors
    sensors = resolve_sensors(declared, read_modules(config), config.source)
    return config.controller.model_copy(update={"sensors": sensors})


def _find_controller(
    config: Config,
    settings: ControllerConfig,
    plant: Plant,
    body: Morphology | None = None,
    example: Plant | None = None,
) -> Controller:
    if settings.depth is None:
        task = TASKS.get(config.task.type)
        if settings.type == "feedback" and task is not None and task.on_bed:
            depth = f"a depth [m], as {config.task.type} does not start at task.depth"
            raise config.misfit("controller.depth", depth, "none")
        settings = settings.model_copy(update={"depth": config.task.depth})
    try:
        return find_controller(plant, settings, config.source, example, body)
    except InputError as error:
        if config.controller.sensors is None or not str(error).startswith("sensors."):
            raise
        raise config.blame(InputError(f"controller.{error}")) from None
