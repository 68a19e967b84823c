"""Slopes of scores by genes through the water, a window of an episode at a time.

What a robot does now follows from what it did, so the slope of a long episode by its genes is a
product of very many matrices: it grows without bound where the motion is chaotic, as a closed loop
of sensors, network and servos easily is. Truncated backpropagation through time (Williams and Peng
1990, Neural Computation 2) cuts the episode into windows: each begins where the one before it has
ended, and what came before it is taken as given. A window's gain is the task's score so far, less
that at its beginning, as of `environment`; so the gains of an episode add up to its score. Short
windows of many episodes side by side are also how SHAC learns (Xu et al. 2022, Accelerated policy
learning with parallel differentiable simulation, ICLR), which adds a critic for what comes after a
window; there is none here.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_revolve.control.sense import Cues
from mjx_revolve.engine.state import Engine
from mjx_revolve.episodes.environment import RATES
from mjx_revolve.episodes.evaluation import make_recorder, record_cues, vary_engine
from mjx_revolve.episodes.fitness import Fitness
from mjx_revolve.episodes.rollout import Passage, begin, flow_at, make_drive, make_step
from mjx_revolve.episodes.scoring import WORST, first_counted, list_episodes, score_episodes
from mjx_revolve.episodes.starts import Starts, check_key, cues_of, gusty_water, start_pose
from mjx_revolve.episodes.tape import floats_of, roll_out_taped, wide_of
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics.xla import compiler_options, over_chunks
from mjx_revolve.water.flow import Water, water_of


class Episodes(NamedTuple):
    """Episodes between two windows, `[..., lanes]` each.

    Lanes are individual after individual, and within each its trials.

    Attributes:
        under_way: bodies, brains, and what is kept of what is felt.
        starts: of the episodes.
        place: `[3, lanes]` where the cores started, world frame [m].
        rows: the track so far, `[S, ..., lanes]` each; rows to come repeat the present.
        score: `[lanes]` so far.
    """

    under_way: Passage
    starts: Starts
    place: jax.Array
    rows: dict[str, jax.Array]
    score: jax.Array


class Slopes(NamedTuple):
    """What comes of a window.

    Attributes:
        gain: `[P, trials]` the score so far, less that of the window before. Of a rollout that
            blows up, what brings the sum to `scoring.WORST`.
        slope: `[P, trials, num_genes]` of the gain by the individual's genes within the window; 0
            where it is no number.
    """

    gain: jax.Array
    slope: jax.Array


@dataclass(frozen=True, eq=False, repr=False)
class Windows:
    """Slopes of one body's scores, window after window.

    Attributes:
        fitness: whose episodes they are.
        records: rows of the track in a window.
    """

    fitness: Fitness
    records: int

    def __repr__(self) -> str:
        """A line: `Windows(directed_swim in lake, 5 of 1 s)`."""
        return f"Windows({self.fitness.config.subject}, {self.count} of {self.horizon:g} s)"

    @property
    def count(self) -> int:
        """How many windows an episode has."""
        return self.fitness.num_records // self.records

    @property
    def horizon(self) -> float:
        """Length of a window [s]."""
        setup = self.fitness.setup
        return self.records * setup.record_every * setup.world.timestep

    def begin(self, population: Any, key: jax.Array) -> Episodes:
        """Episodes at their starts, those of `fitness(population, key)`.

        Args:
            population: `[P, num_genes]`.
            key: draws the starts, the same for every individual.

        Returns:
            The episodes.

        Raises:
            InputError: the population has another shape, or the key is none.
        """
        check_key(key)
        return self._begin(self._checked(population), key)

    def climb(self, population: Any, episodes: Episodes) -> tuple[Slopes, Episodes]:
        """Goes a window further, and says how the genes should have been other in it.

        The genes need not be those of the window before: that is how one learns on the way.

        Args:
            population: `[P, num_genes]`.
            episodes: from `begin`, or of the window before.

        Returns:
            The slopes, and the episodes at the window's end.

        Raises:
            InputError: the population has another shape than the episodes, or these are over.
        """
        population = self._checked(population)
        lanes, trials = episodes.score.shape[0], self.fitness.config.task.trials
        if len(population) * trials != lanes:
            raise InputError(
                f"population: expected [{lanes // trials}, {self.fitness.num_genes}], as the "
                f"episodes began with; found {list(population.shape)}"
            )
        clock = episodes.under_way.count
        if not isinstance(clock, jax.core.Tracer):
            steps = self.fitness.num_records * self.fitness.record_every
            if int(clock[0]) >= steps:
                raise InputError("episodes: expected some under way; found their end")
        return self._climb(population, episodes)

    def _checked(self, population: Any) -> jax.Array:
        shape, count = jnp.shape(population), self.fitness.num_genes
        if len(shape) != 2 or shape[-1] != count or 0 in shape:
            raise InputError(f"population: expected [P, {count}]; found {list(shape)}")
        return jnp.asarray(population)

    @cached_property
    def _begin(self) -> Any:
        def run(population: jax.Array, key: jax.Array) -> Episodes:
            setup = self.fitness.setup
            individual, trial = list_episodes(len(population), setup.settings.trials)
            starts = jax.tree.map(lambda x: x[..., trial], setup.starts_as(population, key))
            return over_chunks(self._start)(population[individual].T, starts)

        return jax.jit(run, compiler_options=compiler_options())

    @cached_property
    def _climb(self) -> Any:
        def run(population: jax.Array, episodes: Episodes) -> tuple[Slopes, Episodes]:
            trials = self.fitness.config.task.trials
            individual, _ = list_episodes(len(population), trials)
            gain, slope, episodes = over_chunks(self._window)(population[individual].T, episodes)
            shape = (len(population), trials)
            return Slopes(gain.reshape(shape), slope.T.reshape(*shape, -1)), episodes

        return jax.jit(run, compiler_options=compiler_options())

    # ------------------------------------------------------------------ one chunk

    def _start(self, genes: jax.Array, starts: Starts) -> Episodes:
        """Episodes of a chunk at their starts; `genes`: `[num_genes, lanes]`."""
        setup = self.fitness.setup
        root = start_pose(setup.task, setup.settings, setup.world, setup.figure_of(None), starts)
        under_way = self._rest(genes, root)
        engine = vary_engine(self.fitness.engine, starts.variation)
        still = self._still(root)
        first = jax.tree.map(lambda x: x[0, 0], self._gusts(starts, under_way.count))
        rows = jax.eval_shape(partial(self._record, engine, starts), under_way, still, first)
        count = setup.num_records
        blank = {name: jnp.zeros((count, *x.shape), x.dtype) for name, x in rows.items()}
        wide = _widen(under_way, root[0])
        return Episodes(wide, starts, root[:3], blank, jnp.zeros_like(root[0]))

    def _rest(self, genes: jax.Array, root: jax.Array) -> Passage:
        """A chunk's rollout before its first step."""
        setup, engine = self.fitness.setup, self.fitness.engine
        hinges = jnp.zeros((engine.plant.num_hinges, root.shape[-1]), root.dtype)
        qvel = jnp.concatenate([jnp.zeros_like(root[:6]), hinges])
        state = engine.init(jnp.concatenate([root, hinges]), qvel)
        drive_state = setup.controller.init(setup.controller.decode(genes, engine.plant))
        return begin(engine, state, drive_state, setup.controller.feels)

    def _still(self, like: jax.Array) -> jax.Array:
        """`[n, lanes]` no commands."""
        return jnp.zeros((self.fitness.engine.plant.num_rows, like.shape[-1]), like.dtype)

    def _water(self, starts: Starts, row: Any, time: Any) -> Water:
        """The water of a step."""
        world = self.fitness.setup.world
        still = water_of(world) if starts.water is None else starts.water
        return flow_at(world, still if row is None else row)(time, None)

    def _record(
        self, engine: Engine, starts: Starts, now: Passage, ctrl: jax.Array, row: Any
    ) -> Any:
        """What the task has recorded after a step."""
        setup = self.fitness.setup
        last = (now.count - 1).astype(now.energy.dtype) * setup.world.timestep
        record = make_recorder(engine, setup.task, setup.world)
        return record(now.state, ctrl, now.energy, self._water(starts, row, last))

    def _window(
        self, genes: jax.Array, episodes: Episodes
    ) -> tuple[jax.Array, jax.Array, Episodes]:
        """Gains `[lanes]`, slopes `[num_genes, lanes]` and the episodes after a window."""
        setup, starts = self.fitness.setup, episodes.starts
        controller, plant, every = setup.controller, self.fitness.engine.plant, setup.record_every
        parameters, like = controller.decode(genes, plant), genes[:1]
        cues = cues_of(setup.settings, starts, episodes.place)
        engine = vary_engine(self.fitness.engine, starts.variation)
        timestep = setup.world.timestep
        root = jax.ShapeDtypeStruct((7, genes.shape[-1]), genes.dtype)
        now = _narrow(episodes.under_way, jax.eval_shape(self._rest, genes, root))

        def told(parameters: Any, now: Passage, row: Any, *meeting: Any) -> Any:
            return make_drive(
                engine,
                lambda state, time, row, sense: controller.step(parameters, state, time, sense),
                lambda time, row: self._water(starts, row, time),
                timestep=timestep,
                world=setup.world,
                cues=cues,
                feels=controller.feels,
            )(now, row, *meeting)

        then, kept, pull = roll_out_taped(
            told,
            make_step(engine, partial(told, parameters), timestep),
            partial(self._record, engine, starts),
            parameters,
            now,
            self._still(like),
            self._gusts(starts, now.count),
            records=self.records,
            every=every,
        )
        score, by_kept, rows = self._judge(kept, episodes, cues, now.count)
        by_now, by_parameters = pull(by_kept)
        # Brains may begin as their genes say.
        begins = now.count == 0
        by_brain = [jnp.where(begins, x, 0.0) for x in wide_of(by_now.drive_state)]
        slope = jax.vjp(self._brains, genes)[1]((by_parameters, by_brain))[0]
        slope = jnp.where(jnp.all(jnp.isfinite(slope), 0), slope, 0.0)
        after = Episodes(_widen(then, like[0]), starts, episodes.place, rows, score)
        return score - episodes.score, slope, after

    def _brains(self, genes: jax.Array) -> tuple[list[jax.Array], list[jax.Array]]:
        """What genes say: parameters, and states at the start."""
        controller = self.fitness.controller
        parameters = controller.decode(genes, self.fitness.engine.plant)
        return floats_of(parameters), wide_of(controller.init(parameters))

    def _gusts(self, starts: Starts, clock: jax.Array) -> Any:
        """Water `[records, every, lanes]` along the paths of gusts in a window; None without."""
        if starts.gusts is None:
            return None
        shape = (self.records, self.fitness.record_every)
        path = jax.lax.dynamic_slice_in_dim(starts.gusts, clock, shape[0] * shape[1] + 1)
        water = gusty_water(self.fitness.setup.world, path, starts.water)
        wide = (shape[0] * shape[1], path.shape[-1])
        return jax.tree.map(
            lambda x: jnp.broadcast_to(jnp.asarray(x, path.dtype), wide).reshape(*shape, -1), water
        )

    def _judge(
        self, kept: dict[str, jax.Array], episodes: Episodes, cues: Cues, clock: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array], dict[str, jax.Array]]:
        """Scores so far `[lanes]`, their slopes by the window's rows, and the track so far."""
        setup = self.fitness.setup
        every, timestep = setup.record_every, setup.world.timestep
        first = first_counted(setup.settings, timestep)
        counts = clock + self.records * every >= (first + 1) * every
        begins, index = clock // every, jnp.arange(setup.num_records)
        own = jnp.clip(index - begins, 0, self.records - 1)

        def run(kept: dict[str, jax.Array]) -> Any:
            rows = {}
            for name, x in kept.items():
                fit = lambda mask, x=x: mask.reshape(-1, *[1] * (x.ndim - 1))  # noqa: E731
                later = x[own]
                if name in RATES:
                    later = jnp.where(fit(index < begins + self.records), later, 0.0)
                rows[name] = jnp.where(fit(index >= begins), later, episodes.rows[name])
            found = score_episodes(
                setup.task,
                setup.settings,
                setup.world,
                record_cues(setup, rows, cues),
                episodes.place,
                setup.figure_of(None),
            )
            return jnp.where(found.sane, jnp.where(counts, found.score, 0.0), WORST), rows

        score, pull, rows = jax.vjp(run, kept, has_aux=True)
        return score, pull(jnp.ones_like(score))[0], rows


def _narrow(under_way: Passage, like: Passage) -> Passage:
    """A rollout whose scalars are scalars: between windows they have lanes, as chunks need them."""
    return jax.tree.map(lambda x, kind: x[..., 0] if kind.ndim == 0 else x, under_way, like)


def _widen(under_way: Passage, like: jax.Array) -> Passage:
    """A rollout whose scalars have lanes, as of `like`."""
    return jax.tree.map(lambda x: jnp.broadcast_to(x, like.shape) if x.ndim == 0 else x, under_way)


def make_windows(fitness: Fitness, horizon: float | None = None) -> Windows:
    """Slopes of a fitness by genes, window after window.

    Args:
        fitness: from `make_fitness`.
        horizon: length of a window [s]; by default the whole episode, whose slopes are then those
            of the fitness itself.

    Returns:
        The windows.

    Raises:
        InputError: an episode is not a whole number of such windows, or the engine is MJX's.
    """
    config, records = fitness.config, fitness.num_records
    if config.engine != "population":
        raise InputError(
            f"{config.source}: engine: expected population, to go back through its steps; found "
            f"{config.engine}"
        )
    if config.task.target_turn is not None:
        raise InputError(
            f"{config.source}: task.target_turn: expected none, as windows do not carry a pursuer "
            f"on; found {config.task.target_turn:g}"
        )
    row = fitness.record_every * fitness.robot.world.timestep
    if horizon is None:
        return Windows(fitness, records)
    known = {n: n * row for n in range(1, records + 1) if records % n == 0}
    if isinstance(horizon, int | float) and not isinstance(horizon, bool):
        for n, seconds in known.items():
            if abs(seconds - horizon) < 1e-3 * seconds:
                return Windows(fitness, n)
    shown = ", ".join(f"{seconds:.4g}" for seconds in known.values())
    raise InputError(f"horizon: expected one of {shown} s; found {horizon!r}")
