"""Episodes step by step, for learning while acting: observation, action, reward.

An `Environment` is two pure functions over environments on the last axis: `start` begins episodes,
`step` holds an action for a control period. Each lane is an episode of its own, with a clock of its
own, that follows from its seed and the episode's number alone.

**Reward.** The difference of the score so far from that of the step before. The score so far is the
task's score if nothing moved from now on: future rows of the track repeat the present one, without
work and in still water. For progress along a direction, that is the progress in the step; for any
other score of a whole track, users' own tasks included, it is the change by the step. It is 0 until
the settling time is over. So the rewards of an episode add up to the score that evolution uses: a
shaping by a potential that begins at 0 (Ng, Harada and Russell 1999, ICML).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

from mjx_revolve.control.sensors import Observer, make_observer
from mjx_revolve.episodes.config import make_config
from mjx_revolve.episodes.evaluation import Episodes, task_recorder
from mjx_revolve.episodes.fitness import Fitness, with_sensors
from mjx_revolve.episodes.rollout import (
    Rollout,
    RolloutState,
    StepInputs,
    held,
    start_at_rest,
)
from mjx_revolve.episodes.scoring import extend_track, pick_near
from mjx_revolve.episodes.starts import Starts, draw_starts, gust_rows
from mjx_revolve.inputs.errors import InputError, show

_USUAL_RATE = 20.0  # control steps in a second, a choice: ten to a stroke of 2 Hz [Hz]


class EnvironmentState(NamedTuple):
    """Episodes under way, the environments on the last axis of every array.

    Attributes:
        episodes: their rollouts, tracks and scores; the controller state is the observer's.
        seed: of the environment.
        episode: which of that seed's.
        ended: whether the episode is over.
    """

    episodes: Episodes
    seed: UInt[Array, " lanes"]
    episode: Int[Array, " lanes"]
    ended: Bool[Array, " lanes"]


class StepResult(NamedTuple):
    """The result of a control step.

    Attributes:
        reward: the increase of `score` in the step.
        terminated: whether the rollout blew up; the rewards then add up to `scoring.WORST`.
        truncated: whether the episode's time is over.
        score: so far; the episode's where it is over.
    """

    reward: Float[Array, " lanes"]
    terminated: Bool[Array, " lanes"]
    truncated: Bool[Array, " lanes"]
    score: Float[Array, " lanes"]


@dataclass(frozen=True, eq=False)
class Environment:
    """Steps episodes of one body; all functions are pure, for chunks of lanes (see `over_chunks`).

    Attributes:
        fitness: of the body; of its controller only the declared sensors are used.
        observer: of the declared sensors, which are read once in each control period.
        every: timesteps in a control period.
        observation_names: `[k]` of the numbers of an observation: those of the robot as a whole,
            then those of joint after joint, in the robot's order.
        action_names: `[n]` of the actuators, in the robot's order: hinges, then thrusters.
    """

    fitness: Fitness
    observer: Observer
    every: int
    observation_names: tuple[str, ...]
    action_names: tuple[str, ...]

    @property
    def control_rate(self) -> float:
        """Control steps in a second [Hz]."""
        return 1 / (self.every * self.fitness.world.timestep)

    @property
    def num_steps(self) -> int:
        """Control steps of an episode."""
        return self.fitness.num_timesteps // self.every

    def start(self, seed: UInt[Array, " lanes"], episode: Int[Array, " lanes"]) -> EnvironmentState:
        """Episodes at their starts.

        An episode starts as the first of `fold_in(key(seed), episode)` does in a fitness of one
        trial.

        Args:
            seed: of the environments.
            episode: which of that seed's.

        Returns:
            The state.
        """
        fitness, engine = self.fitness, self.fitness.engine
        starts = jax.vmap(self._draw, in_axes=-1, out_axes=-1)(seed, episode)
        root = fitness.start_pose(fitness.geometry, starts)
        still = jnp.zeros((engine.plant.num_rows, root.shape[-1]), root.dtype)
        rollout = self._rollout(starts, root[:3], still)
        body = start_at_rest(engine, root)
        now = rollout.init(body, self.observer.init(engine.joints(body)[0]))
        inputs = self._inputs(starts, seed * 0)
        episodes = fitness.init_episodes(rollout, now, starts, root[:3], inputs)
        return EnvironmentState(episodes, seed, episode, jnp.zeros(seed.shape, bool))

    def _draw(self, seed: jax.Array, episode: jax.Array) -> Starts:
        """The start of one episode."""
        fitness = self.fitness
        task = fitness.settings.model_copy(update={"trials": 1})
        key = jax.random.fold_in(jax.random.key(seed), episode)
        steps = self.num_steps * self.every
        return jax.tree.map(lambda x: x[..., 0], draw_starts(task, fitness.world, key, steps))

    def _rollout(
        self, starts: Starts, position: jax.Array, ctrl: jax.Array, clock: jax.Array | None = None
    ) -> Rollout:
        """A rollout under constant commands, `clock` timesteps after the start."""
        fitness, signals = self.fitness, self.observer.signals
        return fitness.make_rollout(fitness.engine, held(ctrl), signals, starts, position, clock)

    def _inputs(self, starts: Starts, clock: Int[Array, " lanes"]) -> StepInputs:
        """The water of a timestep; in gusts, that of the end after it."""
        rows = gust_rows(self.fitness.world, starts, 1, clock)
        return StepInputs(jax.tree.map(lambda x: x[0], rows))

    def _at(
        self, episodes: Episodes, ctrl: Any, clock: Int[Array, " lanes"]
    ) -> tuple[Rollout, RolloutState]:
        """The rollout, and its state as that of its first step."""
        rollout = self._rollout(episodes.starts, episodes.position, ctrl, clock)
        return rollout, episodes.rollout._replace(steps=jnp.zeros((), jnp.int32))

    def observe(self, state: EnvironmentState) -> tuple[EnvironmentState, Float[Array, "k lanes"]]:
        """The observations; once after each start or step.

        Args:
            state: of the episodes.

        Returns:
            The state, and numbers between -1 and 1 (see `sensors.Observer`); 0 in place of NaN, as
            in a rollout that blew up.
        """
        plant, episodes = self.fitness.engine.plant, state.episodes
        clock, seen = episodes.rollout.steps, episodes.rollout.controller_state
        rollout, now = self._at(episodes, None, clock)
        time, _, readings = rollout.read(now, self._inputs(episodes.starts, clock))
        number = jnp.asarray(plant.source[: plant.num_hinge_rows])
        seen, found = self.observer.observe(seen, time, readings, number)
        numbers = [jnp.broadcast_to(x, time.shape) for x in found.robot]
        order = np.argsort(plant.source[: plant.num_hinge_rows, 0])
        numbers += [x[row] for row in order for x in found.joint]
        whole = jnp.stack(numbers) if numbers else jnp.zeros((0, *time.shape), time.dtype)
        # Rounding may exceed the end of a range by the last bit.
        whole = jnp.where(jnp.isfinite(whole), jnp.clip(whole, -1, 1), 0.0)
        episodes = episodes._replace(rollout=episodes.rollout._replace(controller_state=seen))
        return state._replace(episodes=episodes), whole

    def step(
        self, state: EnvironmentState, action: Float[Array, "n lanes"]
    ) -> tuple[EnvironmentState, StepResult]:
        """A control period.

        Args:
            state: of the episodes.
            action: in the robot's order, held for the period; -1 and 1 are the ends of the range of
                each hinge's targets and of each thruster's commands. Values beyond are clipped.

        Returns:
            The state, and the result. Episodes that were over are stepped, too.

        Raises:
            InputError: the robot has another number of actuators.
        """
        fitness, episodes, plant = self.fitness, state.episodes, self.fitness.engine.plant
        if action.shape[0] != len(self.action_names):
            raise InputError("action", f"{len(self.action_names)} numbers", action.shape[0])
        # Whole numbers would round the ends of ranges to 0.
        action = jnp.asarray(action, jnp.result_type(action, 0.0))
        share = plant.arrange(jnp.clip(action, -1, 1))
        ctrl = plant.middle(share) + plant.reach(share) * share
        before, starts = episodes.rollout, episodes.starts
        rollout, now = self._at(episodes, ctrl, before.steps)
        inputs = StepInputs(gust_rows(fitness.world, starts, self.every, before.steps))
        recorder = task_recorder(rollout.engine, fitness.task, fitness.world)
        now = now._replace(controller_state=())
        now, row = rollout.advance(now, recorder, 1, self.every, inputs)
        row["energy"] += before.energy
        clock, seen = before.steps + self.every, before.controller_state
        now = now._replace(controller_state=seen, energy=row["energy"][0], steps=clock)
        track = extend_track(episodes.track, row, (clock - 1) // fitness.record_every)
        place = fitness.start_point(fitness.geometry, starts)
        score, sane = fitness.score_so_far(track, place, fitness.geometry, rollout.context, clock)
        over = clock >= self.num_steps * self.every
        result = StepResult(score - episodes.score, ~sane, over & sane, score)
        whole = clock % fitness.record_every == 0
        now = now._replace(energy=jnp.where(whole, 0.0, now.energy))
        episodes = episodes._replace(rollout=now, track=track, score=score)
        return state._replace(episodes=episodes, ended=over | ~sane), result

    def begin(
        self, seed: UInt[Array, " lanes"], episode: Int[Array, " lanes"]
    ) -> tuple[EnvironmentState, Float[Array, "k lanes"]]:
        """Episodes at their starts (see `start`), and the observations there."""
        return self.observe(self.start(seed, episode))

    def step_and_restart(
        self, state: EnvironmentState, action: Float[Array, "n lanes"]
    ) -> tuple[EnvironmentState, Float[Array, "k lanes"], StepResult, Float[Array, "k lanes"]]:
        """A control period, after which episodes that are over begin anew at once.

        Args:
            state: of the episodes.
            action: as in `step`.

        Returns:
            The state, the observations, the result, and the observations before any began anew.
        """
        moved, result = self.step(state, action)
        moved, last = self.observe(moved)
        state, seen = jax.lax.cond(
            jnp.any(moved.ended),
            lambda: choose(moved.ended, self.begin(moved.seed, moved.episode + 1), (moved, last)),
            lambda: (moved, last),
        )
        return state, seen, result, last


T = TypeVar("T")


def choose(mask: Bool[Array, " lanes"], new: T, old: T) -> T:
    """Pytrees `[..., lanes]`, the new one where the mask is true."""
    return jax.tree.map(lambda a, b: jnp.where(mask, a, b), new, old)


def make_environment(
    fitness: Fitness, control_rate: float | None = None, sensors: Sequence[object] | None = None
) -> Environment:
    """Makes the environment of a fitness.

    Args:
        fitness: from `make_fitness`; of its controller only the declared sensors are used.
        control_rate: actions in a second [Hz]; by default the one nearest to 20. Rows of the
            track, which tasks see every 0.1 s or so, hold a whole number of control periods.
        sensors: in the form of `controller.sensors`; by default those of the configuration, or else
            the robot's own, or else `sensors.DEFAULT_SENSORS`.

    Returns:
        The environment.

    Raises:
        InputError: such a rate is not possible, a sensor is wrong, or there are no actuators or no
            sensors.
    """
    config = fitness.config
    config.require_population("to step environments")
    plant = fitness.engine.plant
    if plant.num_actuators == 0:
        needed = "a hinge or a thruster to act with"
        raise InputError(f"{config.source}: morphology", needed, "none")
    every = _period(control_rate, fitness.record_every, fitness.world.timestep)
    if sensors is not None:
        if isinstance(sensors, str) or not isinstance(sensors, Sequence):
            raise InputError("sensors", "a list", show(sensors))
        data = config.model_dump() | {"controller": {"type": "mlp", "sensors": list(sensors)}}
        config = make_config(data, "/", source=config.source)
    declared = with_sensors(config, fitness.robot.morphology).sensors
    observer = make_observer(declared, every * fitness.world.timestep, plant)
    hinges = plant.names[: plant.num_hinges]
    joints = [f"{name} {joint}" for joint in hinges for name in observer.joint_names]
    names = (*observer.robot_names, *joints)
    if not names:
        needed = "some that this robot can have"
        raise InputError(f"{config.source}: controller.sensors", needed, "none")
    return Environment(fitness, observer, every, names, plant.names)


def _period(rate: float | None, record_every: int, timestep: float) -> int:
    """Timesteps in a control period."""
    rates = {n: 1 / (n * timestep) for n in range(record_every, 0, -1) if record_every % n == 0}
    if rate is None:
        return min(rates, key=lambda n: abs(np.log(rates[n] / _USUAL_RATE)))
    return pick_near(rates, rate, "control_rate", "Hz")
