"""Episodes step by step, for those who learn while they act: observation, action, reward.

An `Environment` is two pure functions over environments on the last axis: `start` begins episodes,
`step` holds an action for a control period. Each lane is an episode of its own, with a clock of its
own, that follows from its seed and the episode's number alone.

**Reward.** The task's score so far, less that of the step before. The score so far is what the task
would say if from now on nothing moved: rows of the track that are still to come repeat the present
(no work is done in them, and the water is still). For progress along a direction that is the
progress of the step; for what a task makes of the track as a whole, users' own tasks too, it is
what the step has changed of it. It is 0 until the settling time is over. So the rewards of an
episode add up to its score, the one that evolution sees: a shaping by a potential that begins at 0
(Ng, Harada and Russell 1999, ICML).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.control.sense import Memory, feel, remember, start_memory
from mjx_revolve.control.sensors import Observer, make_observer, with_types
from mjx_revolve.episodes.config import make_config
from mjx_revolve.episodes.evaluation import Setup, make_recorder, recall_pursuer, record_cues
from mjx_revolve.episodes.fitness import Fitness, read_modules
from mjx_revolve.episodes.rollout import flow_at
from mjx_revolve.episodes.scoring import WORST, first_counted, score_episodes
from mjx_revolve.episodes.starts import Starts, cues_of, draw_starts, gusty_water, start_pose
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics.xla import fused_scan, share_once
from mjx_revolve.water.flow import Water, water_of

_USUAL_RATE = 20.0  # control steps in a second, a choice: ten to a stroke of 2 Hz [Hz]

# What stands still has none of: these rows are 0 where the score so far looks ahead.
RATES = ("energy", "water_velocity")


class EnvironmentState(NamedTuple):
    """Episodes under way, the environments on the last axis of every array.

    Attributes:
        body: the engine's state.
        memory: what is kept of what is felt.
        seen: what the observer keeps.
        starts: of the episodes, `[..., lanes]`.
        place: `[3, lanes]` where the cores started, world frame [m].
        rows: the track so far, `[S, ..., lanes]` each; rows to come repeat the present.
        energy: `[lanes]` work since the last whole row [J].
        score: `[lanes]` so far.
        clock: `[lanes]` timesteps since the start, int32.
        seed: `[lanes]` of the environment, uint32.
        episode: `[lanes]` which of that seed's, int32.
        ended: `[lanes]` whether the episode is over.
    """

    body: Any
    memory: Memory
    seen: Any
    starts: Starts
    place: jax.Array
    rows: dict[str, jax.Array]
    energy: jax.Array
    score: jax.Array
    clock: jax.Array
    seed: jax.Array
    episode: jax.Array
    ended: jax.Array


class Outcome(NamedTuple):
    """What comes of a control step, `[lanes]` each.

    Attributes:
        reward: see this module's head.
        terminated: whether the rollout blew up; the rewards then add up to `scoring.WORST`.
        truncated: whether the episode's time is over.
        score: so far; the episode's where it is over.
    """

    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    score: jax.Array


@dataclass(frozen=True, eq=False)
class Environment:
    """Steps episodes of one body; all functions are pure, for chunks of lanes (see `over_chunks`).

    Attributes:
        setup: what all episodes have in common.
        observer: of the declared sensors, which are read once in each control period.
        every: timesteps in a control period.
        observation_names: `[k]` of the numbers of an observation: those of the robot as a whole,
            then those of joint after joint, in the robot's order.
        action_names: `[n]` of the actuators, in the robot's order: hinges, then thrusters.
    """

    setup: Setup
    observer: Observer
    every: int
    observation_names: tuple[str, ...]
    action_names: tuple[str, ...]

    @property
    def control_rate(self) -> float:
        """Control steps in a second [Hz]."""
        return 1 / (self.every * self.setup.world.timestep)

    @property
    def num_steps(self) -> int:
        """Control steps of an episode."""
        return self.setup.num_records * self.setup.record_every // self.every

    def start(self, seed: jax.Array, episode: jax.Array) -> EnvironmentState:
        """Episodes at their starts.

        An episode starts as the first of `fold_in(key(seed), episode)` does in a fitness of one
        trial.

        Args:
            seed: `[lanes]` uint32.
            episode: `[lanes]` which of that seed's, int32.

        Returns:
            The state.
        """
        setup, engine, feels = self.setup, self.setup.engine_of(None), self.observer.feels
        starts = jax.vmap(self._draw, in_axes=-1, out_axes=-1)(seed, episode)
        figure = setup.figure_of(None)
        root = start_pose(setup.task, setup.settings, setup.world, figure, starts)
        hinges = jnp.zeros((engine.plant.num_hinges, root.shape[-1]), root.dtype)
        qvel = jnp.concatenate([jnp.zeros_like(root[:6]), hinges])
        body = engine.init(jnp.concatenate([root, hinges]), qvel)
        none = jnp.zeros_like(root[0])

        def lanes_of(x: jax.Array) -> jax.Array:
            return jnp.broadcast_to(x, (*x.shape, *none.shape)) if x.ndim == 0 else x

        seen = jax.tree.map(lanes_of, self.observer.init(engine.joints(body)[0]))
        count = jnp.zeros(none.shape, jnp.int32)
        memory = start_memory(feels, engine, body, cues_of(setup.settings, starts, root[:3]))
        state = EnvironmentState(
            body, memory, seen, starts, root[:3], {}, none, none, count,
            seed, episode, count > 0,
        )  # fmt: skip
        still = jnp.zeros((engine.plant.num_rows, *none.shape), none.dtype)
        present = jax.eval_shape(lambda: self._record(state, still))
        shape = (setup.num_records,)
        rows = {name: jnp.zeros(shape + x.shape, x.dtype) for name, x in present.items()}
        return state._replace(rows=rows)

    def _draw(self, seed: jax.Array, episode: jax.Array) -> Starts:
        """The start of one episode."""
        task = self.setup.settings.model_copy(update={"trials": 1})
        key = jax.random.fold_in(jax.random.key(seed), episode)
        steps = self.num_steps * self.every
        return jax.tree.map(lambda x: x[..., 0], draw_starts(task, self.setup.world, key, steps))

    def observe(self, state: EnvironmentState) -> tuple[EnvironmentState, jax.Array]:
        """What the robots are told now; once after each start or step.

        Args:
            state: of the episodes.

        Returns:
            The state, and `[k, lanes]` numbers between -1 and 1 (see `sensors.Observer`); 0 for
            what is no number, as in a rollout that blew up.
        """
        setup, engine = self.setup, self.setup.engine_of(None)
        time = state.clock.astype(state.energy.dtype) * setup.world.timestep
        water = flow_at(setup.world, self._water(state, state.clock))(time, None)
        cues = cues_of(setup.settings, state.starts, state.place)
        sense = feel(
            setup.world, engine, state.body, water, time, cues, state.memory, self.observer.feels
        )
        number = jnp.asarray(engine.plant.source[: engine.plant.num_hinge_rows])
        seen, found = self.observer.observe(state.seen, time, sense, number)
        told = [jnp.broadcast_to(x, time.shape) for x in found.robot]
        order = np.argsort(engine.plant.source[: engine.plant.num_hinge_rows, 0])
        told += [x[row] for row in order for x in found.joint]
        whole = jnp.stack(told) if told else jnp.zeros((0, *time.shape), time.dtype)
        # Rounding may leave the end of a range by the last bit.
        whole = jnp.where(jnp.isfinite(whole), jnp.clip(whole, -1, 1), 0.0)
        return state._replace(seen=seen), whole

    def step(self, state: EnvironmentState, action: jax.Array) -> tuple[EnvironmentState, Outcome]:
        """A control period.

        Args:
            state: of the episodes.
            action: `[n, lanes]` between -1 and 1, in the robot's order: ends of each hinge's range
                of targets and of each thruster's of commands, held for the period. What is beyond
                is clipped.

        Returns:
            The state, and what came of it. Episodes that were over go on all the same.
        """
        setup, engine = self.setup, self.setup.engine_of(None)
        asked = engine.plant.arrange(jnp.clip(action, -1, 1))
        ctrl = engine.plant.middle(asked) + engine.plant.reach(asked) * asked
        body, memory, work = self._hold(state, ctrl)
        state = state._replace(
            body=body, memory=memory, energy=state.energy + work, clock=state.clock + self.every
        )
        row = (state.clock - 1) // setup.record_every
        rows = {
            name: _fill(state.rows[name], x, row, name in RATES)
            for name, x in self._record(state, ctrl).items()
        }
        whole = state.clock % setup.record_every == 0
        cues = cues_of(setup.settings, state.starts, state.place)
        found = score_episodes(
            setup.task,
            setup.settings,
            setup.world,
            record_cues(setup, rows, cues),
            state.place,
            setup.figure_of(None),
        )
        first = first_counted(setup.settings, setup.world.timestep)
        counts = state.clock >= (first + 1) * setup.record_every
        score = jnp.where(found.sane, jnp.where(counts, found.score, 0.0), WORST)
        over = state.clock >= self.num_steps * self.every
        outcome = Outcome(score - state.score, ~found.sane, over & found.sane, score)
        state = state._replace(
            rows=rows,
            energy=jnp.where(whole, 0.0, state.energy),
            score=score,
            ended=over | ~found.sane,
        )
        return state, outcome

    def _water(self, state: EnvironmentState, count: jax.Array) -> Water:
        """The water of a timestep, the sea's own time not added; `count`: `[lanes]`."""
        world, starts = self.setup.world, state.starts
        if starts.gusts is None:
            return water_of(world) if starts.water is None else starts.water
        rows = self._gusts(state, jnp.minimum(count, starts.gusts.shape[0] - 2), 1)
        return jax.tree.map(lambda x: x[0], rows)

    def _gusts(self, state: EnvironmentState, count: jax.Array, steps: int) -> Water:
        """Water `[steps, lanes]` along the paths of gusts."""
        gusts, shape = state.starts.gusts, (steps, *count.shape)
        assert gusts is not None
        index = jnp.minimum(count + jnp.arange(steps + 1)[:, None], gusts.shape[0] - 1)
        path = jnp.take_along_axis(gusts, index[:, None], 0)
        water = gusty_water(self.setup.world, path, state.starts.water)
        return jax.tree.map(lambda x: jnp.broadcast_to(jnp.asarray(x, path.dtype), shape), water)

    def _hold(self, state: EnvironmentState, ctrl: jax.Array) -> tuple[Any, Memory, jax.Array]:
        """Body and memory after a control period, and the work done in it [J]."""
        world, engine = self.setup.world, self.setup.engine_of(None)
        dt, still = world.timestep, self._water(state, state.clock)
        cues = cues_of(self.setup.settings, state.starts, state.place)
        rows = None
        if state.starts.gusts is not None:
            rows = self._gusts(state, state.clock, self.every)

        def tick(carry: Any, row: Any) -> tuple[Any, None]:
            body, memory, energy, count = carry
            time = (state.clock + count).astype(energy.dtype) * dt
            water = flow_at(world, still if row is None else row)(time, None)
            before = engine.root(body)
            motion = engine.motions(body) if memory.past is not None else None
            body, power = engine.step(body, ctrl, water)
            work = dt * power
            after = engine.root(body)
            memory = remember(memory, before, after, ctrl, work, dt, motion, cues)
            return (body, memory, energy + work, count + 1), None

        carry = (state.body, state.memory, jnp.zeros_like(state.energy), jnp.zeros((), jnp.int32))
        first = None if rows is None else jax.tree.map(lambda x: x[0], rows)
        if engine.fuses:
            step, pack, unpack = fused_scan(tick, carry, first)
            packed, _ = jax.lax.scan(step, pack(carry), rows, length=self.every)
            body, memory, work, _ = unpack(packed)
        else:
            (body, memory, work, _), _ = jax.lax.scan(share_once(tick), carry, rows, self.every)
        return body, memory, work

    def _record(self, state: EnvironmentState, ctrl: jax.Array) -> dict[str, jax.Array]:
        """What the task has recorded of the present, `[..., lanes]` each."""
        setup, engine = self.setup, self.setup.engine_of(None)
        last = jnp.maximum(state.clock - 1, 0)
        time = last.astype(state.energy.dtype) * setup.world.timestep
        water = flow_at(setup.world, self._water(state, last))(time, None)
        record = make_recorder(engine, setup.task, setup.world)
        return recall_pursuer(record(state.body, ctrl, state.energy, water), state.memory)


def _fill(rows: jax.Array, now: jax.Array, row: jax.Array, ceases: bool) -> jax.Array:
    """`[S, ..., lanes]` rows, the present in its own and in all that are to come."""
    index = jnp.arange(rows.shape[0]).reshape(-1, *[1] * (rows.ndim - 1))
    later = jnp.where(index == row, now, 0.0) if ceases else now
    return jnp.where(index >= row, later, rows)


def make_environment(
    fitness: Fitness, control_rate: float | None = None, sensors: Sequence[Any] | None = None
) -> Environment:
    """Makes the environment of a fitness.

    Args:
        fitness: from `make_fitness`; of its controller only the declared sensors are used.
        control_rate: actions in a second [Hz]; by default the one nearest to 20. Rows of the
            track, which tasks see every 0.1 s or so, hold a whole number of control periods.
        sensors: as `controller.sensors` would have them; by default these, which only some types of
            controllers may have, or else the robot's own, or else `sensors.USUAL`.

    Returns:
        The environment.

    Raises:
        InputError: such a rate is not possible, a sensor is none, there is nothing to act with, or
            nothing to see.
    """
    setup, config, body = fitness.setup, fitness.config, fitness.robot.morphology
    if config.engine != "population":
        raise InputError(
            f"{config.source}: engine: expected population, to step environments; found "
            f"{config.engine}"
        )
    plant = fitness.engine.plant
    if plant.num_actuators == 0:
        raise InputError(
            f"{config.source}: morphology: expected a hinge or a thruster to act with; found none"
        )
    every = _period(control_rate, setup.record_every, setup.world.timestep)
    declared = config.controller.sensors
    if sensors is not None:
        data = config.model_dump() | {"controller": {"type": "mlp", "sensors": list(sensors)}}
        declared = make_config(data, "/", source=config.source).controller.sensors
    elif declared is None:
        declared = body.sensors
    declared = with_types(declared, read_modules(config), config.source)
    observer = make_observer(declared, every * setup.world.timestep, plant)
    hinges = plant.names[: plant.num_hinges]
    joints = [f"{name} {joint}" for joint in hinges for name in observer.joint_names]
    names = (*observer.robot_names, *joints)
    if not names:
        raise InputError(
            f"{config.source}: controller.sensors: expected some that this robot can have; found "
            "none"
        )
    return Environment(setup, observer, every, names, plant.names)


def _period(rate: float | None, record_every: int, timestep: float) -> int:
    """Timesteps in a control period."""
    rates = {n: 1 / (n * timestep) for n in range(record_every, 0, -1) if record_every % n == 0}
    if rate is None:
        return min(rates, key=lambda n: abs(np.log(rates[n] / _USUAL_RATE)))
    if isinstance(rate, int | float | np.number) and not isinstance(rate, bool):
        for n, known in rates.items():
            if abs(known - rate) < 1e-3 * known:
                return n
    shown = ", ".join(f"{known:.4g}" for known in rates.values())
    raise InputError(f"control_rate: expected one of {shown} Hz; found {rate!r}")
