"""Gradients of scores by genes through the simulation, one window of an episode at a time.

The gradient of a long episode by its genes is a product of many Jacobians: it grows without bound
if the motion is chaotic, as a closed loop of sensors, network and servos easily is. Truncated
backpropagation through time (Williams and Peng 1990, Neural Computation 2) cuts the episode into
windows. Each begins where the one before it has ended, and its start state is a constant. A
window's gain is the increase of the task's score so far, as the reward in `environment`; so the
gains of an episode add up to its score. Short
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
from jaxtyping import Array, Float, PyTree
from numpy.typing import ArrayLike

from mjx_revolve.control.readings import EpisodeContext
from mjx_revolve.episodes.evaluation import Episodes, narrow, task_recorder, widen
from mjx_revolve.episodes.fitness import Fitness
from mjx_revolve.episodes.rollout import Rollout, StepInputs, controlled, no_commands
from mjx_revolve.episodes.scoring import extend_track, list_episodes, pick_near
from mjx_revolve.episodes.starts import Starts, check_key, gust_rows
from mjx_revolve.episodes.tape import advance_taped, float_leaves, wide_leaves
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics.xla import is_traced, jit, over_chunks


class Gradients(NamedTuple):
    """The result of a window.

    Attributes:
        gain: the score so far, less that of the window before. For a rollout that blows up, the sum
            of its gains is `scoring.WORST`.
        gradient: of the gain by the individual's genes within the window; 0 in place of NaN.
    """

    gain: Float[Array, "P trials"]
    gradient: Float[Array, "P trials num_genes"]


@dataclass(frozen=True, eq=False, repr=False)
class TruncatedBPTT:
    """Gradients of one body's scores, window after window.

    Attributes:
        fitness: scores the episodes.
        records: rows of the track in a window.
    """

    fitness: Fitness
    records: int

    def __repr__(self) -> str:
        """A line: `TruncatedBPTT(directed_swim in lake, 5 of 1 s)`."""
        return f"TruncatedBPTT({self.fitness.config.subject}, {self.count} of {self.horizon:g} s)"

    @property
    def count(self) -> int:
        """Windows of an episode."""
        return self.fitness.num_records // self.records

    @property
    def horizon(self) -> float:
        """Length of a window [s]."""
        return self.records * self.fitness.record_every * self.fitness.world.timestep

    def init(self, population: ArrayLike, key: jax.Array) -> Episodes:
        """Episodes at their starts, those of `fitness(population, key)`.

        Args:
            population: `[P, num_genes]`.
            key: draws the starts, the same for every individual.

        Returns:
            The episodes: individual after individual, and within each its trials.

        Raises:
            InputError: the population has another shape, or the key is none.
        """
        check_key(key)
        population = self.fitness.check_population(population)
        run = self._init if is_traced(population, key) else self._compiled[0]
        return run(population, key)

    def step(self, population: ArrayLike, episodes: Episodes) -> tuple[Gradients, Episodes]:
        """Advances episodes by a window.

        The genes need not be those of the window before: an optimiser may change them in between.

        Args:
            population: `[P, num_genes]`.
            episodes: from `init`, or of the window before.

        Returns:
            The gradients, and the episodes at the window's end.

        Raises:
            InputError: the population has another shape than the episodes, or these are over.
        """
        fitness, lanes = self.fitness, episodes.score.shape[0]
        population, trials = fitness.check_population(population), fitness.settings.trials
        if len(population) * trials != lanes:
            same = f"[{lanes // trials}, {fitness.num_genes}], as the episodes began with"
            raise InputError("population", same, list(population.shape))
        clock = episodes.rollout.steps
        if not is_traced(clock) and int(clock[0]) >= fitness.num_timesteps:
            raise InputError("episodes", "some under way", "their end")
        run = self._step if is_traced(population, episodes) else self._compiled[1]
        return run(population, episodes)

    @cached_property
    def _compiled(self) -> tuple[Any, Any]:
        return jit(self._init), jit(self._step)

    def _init(self, population: jax.Array, key: jax.Array) -> Episodes:
        individual, trial = list_episodes(len(population), self.fitness.settings.trials)
        starts = self.fitness.precise_starts(population, key)
        starts = jax.tree.map(lambda x: x[..., trial], starts)
        return over_chunks(self._start)(population[individual].T, starts)

    def _step(self, population: jax.Array, episodes: Episodes) -> tuple[Gradients, Episodes]:
        trials = self.fitness.settings.trials
        individual, _ = list_episodes(len(population), trials)
        gain, gradient, episodes = over_chunks(self._window)(population[individual].T, episodes)
        shape = (len(population), trials)
        return Gradients(gain.reshape(shape), gradient.T.reshape(*shape, -1)), episodes

    # ------------------------------------------------------------------ one chunk

    def _start(self, genes: Float[Array, "num_genes lanes"], starts: Starts) -> Episodes:
        """Episodes of a chunk at their starts."""
        fitness = self.fitness
        root = fitness.start_pose(fitness.geometry, starts)
        rollout, now = fitness.start_rollout(fitness.engine, genes, starts, root)
        inputs = jax.tree.map(lambda x: x[0, 0], self._inputs(starts, now.steps))
        return fitness.init_episodes(rollout, now, starts, root[:3], inputs)

    def _rollout(self, starts: Starts, position: jax.Array, parameters: PyTree) -> Rollout:
        controller, engine = self.fitness.controller, self.fitness.engine
        policy = controlled(controller, parameters)
        return self.fitness.make_rollout(engine, policy, controller.signals, starts, position)

    def _inputs(self, starts: Starts, clock: jax.Array) -> StepInputs:
        """Inputs `[records, every, lanes]` of the steps of a window."""
        shape = self.records, self.fitness.record_every
        rows = gust_rows(self.fitness.world, starts, shape[0] * shape[1], clock)
        return StepInputs(jax.tree.map(lambda x: x.reshape(*shape, -1), rows))

    def _window(
        self, genes: Float[Array, "num_genes lanes"], episodes: Episodes
    ) -> tuple[Float[Array, " lanes"], Float[Array, "num_genes lanes"], Episodes]:
        """Gains, gradients and the episodes after a window."""
        fitness, starts, every = self.fitness, episodes.starts, self.fitness.record_every
        parameters = fitness.controller.decode(genes, fitness.engine.plant)
        make = partial(self._rollout, starts, episodes.position)
        rollout = make(parameters)
        root = jax.ShapeDtypeStruct((7, genes.shape[-1]), genes.dtype)
        begin = partial(fitness.start_rollout, fitness.engine, genes, starts)
        now = narrow(episodes.rollout, jax.eval_shape(lambda root: begin(root)[1], root))
        recorder = task_recorder(rollout.engine, fitness.task, fitness.world)
        still = no_commands(fitness.engine, genes)
        given = parameters, now, still, self._inputs(starts, now.steps)
        then, rows, pull = advance_taped(make, recorder, *given, records=self.records, every=every)
        score, by_rows, track = self._judge(rows, episodes, rollout.context, now.steps)
        by_now, by_parameters = pull(by_rows)
        # A controller's state at the start may depend on its genes.
        begins = now.steps == 0
        by_state = [jnp.where(begins, x, 0.0) for x in wide_leaves(by_now.controller_state)]
        gradient = jax.vjp(self._decoded, genes)[1]((by_parameters, by_state))[0]
        gradient = jnp.where(jnp.all(jnp.isfinite(gradient), 0), gradient, 0.0)
        after = Episodes(widen(then), starts, episodes.position, track, score)
        return score - episodes.score, gradient, after

    def _decoded(self, genes: jax.Array) -> tuple[list[jax.Array], list[jax.Array]]:
        """A controller's parameters, and its state at the start."""
        controller = self.fitness.controller
        parameters = controller.decode(genes, self.fitness.engine.plant)
        return float_leaves(parameters), wide_leaves(controller.init(parameters))

    def _judge(
        self,
        rows: dict[str, jax.Array],
        episodes: Episodes,
        context: EpisodeContext,
        clock: jax.Array,
    ) -> tuple[Float[Array, " lanes"], dict[str, jax.Array], dict[str, jax.Array]]:
        """Scores so far, their gradients by the window's rows, and the track so far."""
        fitness, every = self.fitness, self.fitness.record_every
        place = fitness.start_point(fitness.geometry, episodes.starts)

        def run(rows: dict[str, jax.Array]) -> PyTree:
            track = extend_track(episodes.track, rows, clock // every)
            then = clock + self.records * every
            score, _ = fitness.score_so_far(track, place, fitness.geometry, context, then)
            return score, track

        score, pull, track = jax.vjp(run, rows, has_aux=True)
        return score, pull(jnp.ones_like(score))[0], track


def make_windows(fitness: Fitness, horizon: float | None = None) -> TruncatedBPTT:
    """Gradients of a fitness by genes, window after window.

    Args:
        fitness: from `make_fitness`.
        horizon: length of a window [s]; by default the whole episode: gradients are then those of
            the fitness itself.

    Returns:
        An optimiser's source of gradients.

    Raises:
        InputError: an episode is not a whole number of such windows, or the engine is MJX's.
    """
    config, records = fitness.config, fitness.num_records
    config.require_population("to go back through its steps")
    if config.task.target_turn is not None:
        none = "none, as windows do not carry a pursuer on"
        turn = f"{config.task.target_turn:g}"
        raise InputError(f"{config.source}: task.target_turn", none, turn)
    row = fitness.record_every * fitness.world.timestep
    if horizon is None:
        return TruncatedBPTT(fitness, records)
    known = {n: n * row for n in range(1, records + 1) if records % n == 0}
    return TruncatedBPTT(fitness, pick_near(known, horizon, "horizon", "s"))
