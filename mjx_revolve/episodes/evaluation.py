"""Scores of a population: the evaluation behind `Fitness` and `MixedFitness`.

`EpisodeSpec` holds the common properties of all episodes of a configuration; its two subclasses in
`fitness` add one body, or a capacity for many. An individual's episodes run in lanes of a chunk of
fixed shape, so its score does not depend on the population around it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, Generic, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree
from numpy.typing import ArrayLike

from mjx_revolve.control.controller import Controller
from mjx_revolve.control.courses import course_path
from mjx_revolve.control.readings import EpisodeContext
from mjx_revolve.engine.engine import Engine
from mjx_revolve.engine.plant import BodyGeometry
from mjx_revolve.engine.variation import Variation
from mjx_revolve.episodes.config import Config, TaskConfig
from mjx_revolve.episodes.measures import measure
from mjx_revolve.episodes.rollout import (
    Policy,
    Recorder,
    Rollout,
    RolloutState,
    StepInputs,
    controlled,
    no_commands,
    start_at_rest,
    with_variation,
)
from mjx_revolve.episodes.scoring import (
    LEAST,
    WORST,
    Scores,
    average_trials,
    first_scored_row,
    list_episodes,
    max_distance,
    sample_rows,
)
from mjx_revolve.episodes.starts import (
    Starts,
    check_key,
    draw_starts,
    episode_context,
    gust_rows,
    gusty_water,
    start_pose,
    steady_water,
    target_path,
)
from mjx_revolve.episodes.tasks import Task, Track
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics.adjoint import differentiate_as
from mjx_revolve.numerics.executables import StoredProgram
from mjx_revolve.numerics.spatial import matvec, quat_to_mat
from mjx_revolve.numerics.xla import is_traced, over_chunks
from mjx_revolve.water.bed import bed_height
from mjx_revolve.water.flow import Water, flow
from mjx_revolve.water.world import World

B = TypeVar("B")  # bodies: their tables, or () where the specification has one body


class Chunk(NamedTuple):
    """A chunk of episodes before their first step.

    Attributes:
        rollout: steps them.
        state: at their starts.
        inputs: of all steps.
        position: of the robots at their starts, see `EpisodeSpec.start_point`.
        geometry: of the bodies.
    """

    rollout: Rollout
    state: RolloutState
    inputs: StepInputs
    position: Float[Array, "3 lanes"]
    geometry: BodyGeometry


class Episodes(NamedTuple):
    """Episodes between two calls of a function that advances them, `[..., lanes]` each.

    Attributes:
        rollout: their state; its scalars have lanes, as chunks need them.
        starts: of the episodes.
        position: of the cores at the start, world frame [m].
        track: so far, `[S, ..., lanes]` each; rows to come repeat the present.
        score: so far.
    """

    rollout: RolloutState
    starts: Starts
    position: Float[Array, "3 lanes"]
    track: dict[str, jax.Array]
    score: Float[Array, " lanes"]


@dataclass(frozen=True, eq=False, repr=False)
class EpisodeSpec(ABC, Generic[B]):
    """The common properties of all episodes of a configuration.

    Attributes:
        config: what it was made from.
        world: the world.
        task: where episodes start, what is recorded, and the score.
        controller: genes to commands; for the largest of many bodies.
    """

    config: Config
    world: World
    task: Task
    controller: Controller

    @abstractmethod
    def _engine(self, bodies: B, lanes: int, differentiable: bool) -> Engine:
        """The engine for bodies `[lanes]`."""

    @abstractmethod
    def _geometry(self, bodies: B) -> BodyGeometry:
        """Sizes of bodies, `[lanes]` or one."""

    @property
    def settings(self) -> TaskConfig:
        """Of the task."""
        return self.config.task

    @property
    def num_genes(self) -> int:
        """Length of an individual's genes; of the largest body, where bodies differ."""
        return self.controller.num_genes

    @property
    def worst_score(self) -> float:
        """The score of a rollout that blew up."""
        return WORST

    @property
    def record_every(self) -> int:
        """Timesteps between the rows of the track that tasks see."""
        return sample_rows(self.settings, self.world.timestep)[0]

    @property
    def num_records(self) -> int:
        """Rows of an episode's track, before the settling time is cut off."""
        return sample_rows(self.settings, self.world.timestep)[1]

    @property
    def num_timesteps(self) -> int:
        """Timesteps of an episode."""
        return self.num_records * self.record_every

    def draw_starts(self, key: jax.Array) -> Starts:
        """The starts of a key's episodes, the same for all bodies."""
        check_key(key)
        return draw_starts(self.settings, self.world, key, self.num_timesteps)

    def draw_start(self, key: jax.Array, trial: int) -> Starts:
        """The start of one of a key's episodes.

        Raises:
            InputError: the key has no such episode.
        """
        whole = isinstance(trial, int | np.integer) and not isinstance(trial, bool)
        if not whole or not 0 <= trial < self.settings.trials:
            known = f"a whole number from 0 to {self.settings.trials - 1}"
            raise InputError("trial", known, repr(trial))
        return jax.tree.map(lambda x: x[..., trial], self.draw_starts(key))

    def variation(self, key: jax.Array, trial: int = 0) -> Variation | None:
        """The coefficients of one of a key's episodes, as `simulate` takes them; None: as given."""
        return self.draw_start(key, trial).variation

    def water(self, key: jax.Array, trial: int = 0) -> Water | None:
        """The water of one of a key's episodes, as `simulate` takes it; None: the world's."""
        start = self.draw_start(key, trial)
        if start.gusts is None:
            return start.water
        return gusty_water(self.world, start.gusts, start.water)

    def precise_starts(self, population: jax.Array, key: jax.Array) -> Starts:
        """`draw_starts` in the population's precision."""
        return as_precise(self.draw_starts(key), population)

    def start_pose(self, geometry: BodyGeometry, starts: Starts) -> Float[Array, "7 lanes"]:
        """Poses of the cores at the start, world frame; see `starts.start_pose`."""
        return start_pose(self.task, self.settings, self.world, geometry, starts)

    def start_point(self, geometry: BodyGeometry, starts: Starts) -> Float[Array, "3 lanes"]:
        """Places of the robots at the start, by the task's point, world frame [m]."""
        root = self.start_pose(geometry, starts)
        if self.task.point == "core":
            return root[:3]
        center = tuple(jnp.asarray(x, root.dtype) for x in geometry.center)
        return root[:3] + jnp.stack(matvec(quat_to_mat(tuple(root[3:7])), center))

    def check_population(self, population: ArrayLike, ranks: tuple[int, ...] = (2,)) -> jax.Array:
        """A population as an array.

        Raises:
            InputError: it has another shape than `[P, num_genes]` (or, of rank 3, `[B, P,
                num_genes]`), or there are no genes to evolve.
        """
        shape, count = np.shape(population), self.num_genes
        if len(shape) in ranks and shape[-1] == count and 0 not in shape:
            genes = jnp.asarray(population)
            if jnp.iscomplexobj(genes):
                raise InputError("population", "real numbers", str(genes.dtype))
            return genes if genes.dtype in (jnp.float32, jnp.float64) else genes.astype(float)
        if count == 0:
            none = "none, so that there are no genes to evolve"
            raise InputError("population", "bodies with a hinge or a thruster to control", none)
        wanted = " or ".join(f"[{'B, ' * (rank - 2)}P, {count}]" for rank in ranks)
        raise InputError("population", wanted, list(shape))

    def make_rollout(
        self,
        engine: Engine,
        policy: Policy,
        signals: tuple[str, ...],
        starts: Starts,
        position: Float[Array, "3 lanes"],
        clock: Int[Array, " lanes"] | None = None,
    ) -> Rollout:
        """The rollout of episodes from these starts and core positions."""
        engine, water = with_variation(engine, starts.variation), steady_water(self.world, starts)
        context = episode_context(self.settings, starts, position)
        return Rollout(engine, policy, self.world, water, context, signals, clock)

    def start_rollout(
        self, engine: Engine, genes: jax.Array, starts: Starts, root: Float[Array, "7 lanes"]
    ) -> tuple[Rollout, RolloutState]:
        """The rollout of episodes under the controller, and its state before the first step.

        Args:
            engine: of the bodies.
            genes: `[num_genes, lanes]`.
            starts: of the episodes.
            root: poses of the cores at the start, from `start_pose`.
        """
        controller, parameters = self.controller, self.controller.decode(genes, engine.plant)
        policy = controlled(controller, parameters)
        rollout = self.make_rollout(engine, policy, controller.signals, starts, root[:3])
        state = start_at_rest(rollout.engine, root)
        return rollout, rollout.init(state, controller.init(parameters))

    def init_episodes(
        self,
        rollout: Rollout,
        now: RolloutState,
        starts: Starts,
        position: Float[Array, "3 lanes"],
        inputs: StepInputs,
    ) -> Episodes:
        """Episodes before their first step, from its inputs and the state before it."""
        recorder = task_recorder(rollout.engine, self.task, self.world)
        still, shape = no_commands(rollout.engine, position), (self.num_records,)
        row = jax.eval_shape(partial(rollout.record, recorder), now, still, inputs)
        track = {name: jnp.zeros(shape + x.shape, x.dtype) for name, x in row.items()}
        return Episodes(widen(now), starts, position, track, jnp.zeros_like(position[0]))

    # ------------------------------------------------------------------ scores

    def program(self, population: jax.Array, key: jax.Array) -> PyTree:
        """A function of (bodies, population, key) that scores; compiled, unless it is traced."""
        check_key(key)
        return self._score if is_traced(population, key) else self.scorer

    @cached_property
    def scorer(self) -> StoredProgram:
        """What `program` compiles."""
        return self.keep(self._score, "score")

    def keep(
        self, fun: Callable[..., PyTree], name: str, *more: object, fast: bool = False
    ) -> StoredProgram:
        """A compiled function of this specification, kept on disk unless a user's code is in it.

        Args:
            fun: the function.
            name: unique in this specification.
            *more: further values that it depends on.
            fast: as of `xla.jit`.
        """
        config = self.config
        if config.has_user_code:
            return StoredProgram(fun, None, fast)
        settings = config.task.model_dump_json(), config.controller.model_dump_json()
        made_of = name, settings, config.engine, self.world, self._bodies_key, more
        return StoredProgram(fun, made_of, fast)

    @property
    @abstractmethod
    def _bodies_key(self) -> object:
        """The properties of the bodies that compiled programs depend on."""

    def _score(self, bodies: B, population: jax.Array, key: jax.Array) -> PyTree:
        """Scores and measures `[P]` of a population of one body."""
        individual, trial = list_episodes(len(population), self.settings.trials)
        starts = self.precise_starts(population, key)
        chunk = self.chunk_scores(True, bodies, population, starts)
        return average_trials(over_chunks(chunk)(individual, trial), self.settings.trials)

    def chunk_scores(
        self, alike: bool, bodies: B, population: jax.Array, starts: Starts
    ) -> Callable[[jax.Array, jax.Array], Scores]:
        """A function of (individuals, their trials) `[lanes]` that scores these episodes."""
        score: Any = partial(self._score_chunk, alike, False)
        if self.config.engine == "population":  # MJX's step is differentiated by JAX itself
            score = differentiate_as(score, partial(self._score_chunk, alike, True))
        return partial(score, bodies, population, starts)

    def _score_chunk(self, alike: bool, differentiable: bool, *given: Any) -> Scores:
        """Scores of one chunk of episodes; arguments of `prepare`."""
        chunk = self.prepare(alike, differentiable, *given)
        track = self.record_track(chunk, differentiable)
        return self.score(track, chunk.position, chunk.geometry, chunk.rollout.context)

    def record_track(self, chunk: Chunk, differentiable: bool = False) -> dict[str, jax.Array]:
        """The track of a chunk of episodes, from their starts to their ends."""
        recorder = task_recorder(chunk.rollout.engine, self.task, self.world)
        size = self.num_records, self.record_every
        return chunk.rollout.advance(chunk.state, recorder, *size, chunk.inputs, differentiable)[1]

    def prepare(
        self,
        alike: bool,
        differentiable: bool,
        bodies: B,
        population: jax.Array,
        starts: Starts,
        individual: Int[Array, " lanes"],
        trial: Int[Array, " lanes"],
    ) -> Chunk:
        """One chunk of episodes at their starts.

        A chunk selects its own starts and genes from those of all chunks, so that only scores are
        kept for each episode of a population. `alike`: whether all individuals have one body.
        """
        own = (lambda x: x) if alike else (lambda x: x[..., individual])
        bodies = jax.tree.map(lambda x: own(jnp.asarray(x)), bodies)
        starts = jax.tree.map(lambda x: x[..., trial], starts)
        geometry = self._geometry(bodies)
        root = self.start_pose(geometry, starts)
        engine = self._engine(bodies, root.shape[-1], differentiable)
        rollout, now = self.start_rollout(engine, population[individual].T, starts, root)
        inputs = StepInputs(gust_rows(self.world, starts, self.num_timesteps))
        return Chunk(rollout, now, inputs, self.start_point(geometry, starts), geometry)

    def score(
        self,
        track: dict[str, jax.Array],
        position: Float[Array, "3 lanes"],
        geometry: BodyGeometry,
        context: EpisodeContext,
    ) -> Scores:
        """Scores of episodes from their tracks.

        Args:
            track: from `task_recorder`, sampled as `scoring.sample_rows` has it.
            position: of the robots at the start, from `start_point`.
            geometry: of the bodies, `[lanes]` or one.
            context: of the episodes.

        Returns:
            The scores.
        """
        score, measures = self.judge_track(track, position[2], geometry, context)
        sane = jnp.isfinite(score) & self._is_near(track, position, geometry)
        return Scores(jnp.where(sane, jnp.maximum(score, LEAST), WORST), sane, measures)

    def _is_near(
        self,
        track: dict[str, jax.Array],
        position: Float[Array, "3 lanes"],
        geometry: BodyGeometry,
    ) -> Bool[Array, " lanes"]:
        """Whether robots have stayed where a robot can get, see `max_distance`."""
        away = jnp.max(jnp.abs(track["position"] - position), (0, 1))
        # Written so that NaN counts as too far.
        return away < max_distance(self.settings, self.world, geometry)

    def score_so_far(
        self,
        track: dict[str, jax.Array],
        position: Float[Array, "3 lanes"],
        geometry: BodyGeometry,
        context: EpisodeContext,
        clock: Int[Array, "..."],
    ) -> tuple[Float[Array, " lanes"], Array]:
        """Scores of episodes under way, if nothing moved from now on.

        Args:
            track: future rows repeat the present one, as from `scoring.extend_track`.
            position: of the robots at the start, from `start_point`.
            geometry: of the bodies.
            context: of the episodes.
            clock: timesteps since the start.

        Returns:
            The scores, 0 until the settling time is over; and whether the rollouts are sane.
        """
        if "target" in self.task.records and "target" not in track and context.target is not None:
            # What drifts stands from now on, too.
            time = self._record_times(track["position"].dtype, -(-clock // self.record_every))
            track = dict(track) | {"target": target_path(context, time)}
        found = self.score(track, position, geometry, context)
        first = first_scored_row(self.settings, self.world.timestep)
        counts = clock >= (first + 1) * self.record_every
        # Before anything counts, a task's score may be 0 / 0: only the way says what blew up.
        sane = jnp.where(counts, found.sane, self._is_near(track, position, geometry))
        return jnp.where(sane, jnp.where(counts, found.score, 0.0), WORST), sane

    def judge_track(
        self,
        track: dict[str, jax.Array],
        start_height: Float[Array, " lanes"],
        geometry: BodyGeometry,
        context: EpisodeContext,
    ) -> tuple[Float[Array, " lanes"], dict[str, jax.Array]]:
        """Scores and measures of tracks, blown up or not; arguments as of `score`."""
        settings, world = self.settings, self.world
        track = self._complete(track, context)
        first = first_scored_row(settings, world.timestep)
        rows = {name: x[first:] for name, x in track.items()}
        position = rows["position"]
        clearance = jnp.full_like(position[:, 0], jnp.inf)
        if world.bed is not None:
            clearance = position[:, 2] - bed_height(world.bed, position[:, 0], position[:, 1])
        scored = Track(
            clearance=clearance,
            interval=self.record_every * world.timestep,
            start_height=start_height,
            length=geometry.stretched if settings.length == "stretched" else geometry.length,
            weight=geometry.weight,
            surface_height=world.surface_height,
            num_hinges=geometry.num_hinges,
            **rows,
        )
        measures = measure(scored, settings.measures)
        score = self.task.score(scored, settings) - settings.energy_weight * measures["energy_j"]
        return score, measures

    def _complete(
        self, track: dict[str, jax.Array], context: EpisodeContext
    ) -> dict[str, jax.Array]:
        """A track with the paths of target and course, if the task records them."""
        time = self._record_times(track["position"].dtype)
        track = dict(track)
        if "target" not in self.task.records:
            track.pop("target", None)
        elif "target" not in track and context.target is not None:
            track["target"] = target_path(context, time)
        if "course" in self.task.records and context.course is not None:
            track["course"] = course_path(context.course, time)
        return track

    def _record_times(self, dtype: Any, last: jax.Array | None = None) -> jax.Array:
        """`[S]` times of the rows [s]; `[S, lanes]` up to the last row of each lane."""
        row = jnp.arange(1, self.num_records + 1, dtype=dtype)
        if last is not None:
            row = jnp.minimum(row.reshape(-1, *[1] * last.ndim), last.astype(dtype))
        return self.record_every * self.world.timestep * row


def widen(now: RolloutState) -> RolloutState:
    """A rollout state with its scalars broadcast to lanes."""
    lanes = now.energy.shape
    return jax.tree.map(lambda x: jnp.broadcast_to(x, lanes) if x.ndim == 0 else x, now)


def narrow(now: RolloutState, like: RolloutState) -> RolloutState:
    """The inverse of `widen`; `like`: shapes of the state before it."""
    return jax.tree.map(lambda x, kind: x[..., 0] if kind.ndim == 0 else x, now, like)


def as_precise(tree: PyTree, like: jax.Array) -> PyTree:
    """The tree with its floats in the precision of `like`."""
    number = lambda x: jnp.issubdtype(x.dtype, jnp.floating)  # noqa: E731
    return jax.tree.map(lambda x: x.astype(like.dtype) if number(x) else x, tree)


def task_recorder(engine: Engine, task: Task, world: World) -> Recorder:
    """The recorder of a task: fields of a `tasks.Track`, and the position of a pursuer, if any."""

    def record(now: RolloutState, ctrl: jax.Array, water: Water) -> dict[str, jax.Array]:
        root = engine.root(now.state)
        place = root.position
        if task.point == "center_of_mass":
            place = engine.center_of_mass(now.state)
        row = {"position": jnp.stack(place), "energy": now.energy}
        if "core" in task.records:
            row["quat"] = jnp.stack(root.quat)
            row["velocity"] = jnp.stack(root.velocity)
            row["spin"] = jnp.stack(root.angular_velocity)
        if "joints" in task.records:
            qpos, qvel = engine.observe(now.state)
            row["angle"], row["speed"] = qpos[7:], qvel[6:]
        if {"contacts", "forces"} & set(task.records):
            bed, wet = engine.external_force(now.state, ctrl, water)
            if "contacts" in task.records:
                row["bed_force"] = jnp.stack(bed)
            if "forces" in task.records:
                row["water_force"] = jnp.stack(wet)
        if "water" in task.records:
            velocity, _ = flow(world, water, *place)
            like = now.energy
            wide = [jnp.broadcast_to(jnp.asarray(v, like.dtype), like.shape) for v in velocity]
            row["water_velocity"] = jnp.stack(wide)
        if now.memory.pursuer is not None:
            row["target"] = jnp.stack(now.memory.pursuer.position)
        return row

    return record
