"""Rollouts: `Rollout.init` a state, `Rollout.advance` it step by step, recording on the way."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from mjx_revolve.control.controller import Controller
from mjx_revolve.control.readings import (
    NO_INTERACTION,
    EpisodeContext,
    SensorMemory,
    SensorReadings,
    init_memory,
    read_sensors,
    update_memory,
)
from mjx_revolve.engine.engine import Engine
from mjx_revolve.engine.interaction import InteractionForces
from mjx_revolve.engine.variation import Variation
from mjx_revolve.numerics.inertia import BodyMotion
from mjx_revolve.numerics.spatial import Scalar
from mjx_revolve.numerics.xla import fuse, fuse_step
from mjx_revolve.water.flow import Water
from mjx_revolve.water.world import World


class RolloutState(NamedTuple):
    """State of a chunk of rollouts between two steps.

    Attributes:
        state: of the engine.
        controller_state: of the policy.
        memory: of the sensors.
        energy: work since the last record [J].
        steps: since the first one, exact; times in float32 resolve 5 ms for half a day.
    """

    state: PyTree
    controller_state: PyTree
    memory: SensorMemory
    energy: Float[Array, " lanes"]
    steps: Int[Array, ""]


class StepInputs(NamedTuple):
    """Values given for each step, `[T, ...]` for T steps.

    Attributes:
        water: surface and current, `[T, lanes]`; None: `Rollout.water` in all steps.
        ctrl: commands of an open loop, the plant's order [rad, -]; None under a controller.
    """

    water: Water | None = None
    ctrl: Float[Array, "T n lanes"] | None = None


NO_INPUTS = StepInputs()
_NO_CONTEXT = EpisodeContext()


class Policy(Protocol):
    """Maps sensor readings to commands."""

    def __call__(
        self,
        controller_state: PyTree,
        time: Float[Array, "..."],
        readings: SensorReadings,
        ctrl: Float[Array, "n lanes"] | None,
        /,
    ) -> tuple[PyTree, Float[Array, "n lanes"]]:
        """(its state, time [s], readings, the step's open-loop input) → (its state, ctrl)."""


class Recorder(Protocol):
    """Selects the recorded values of a rollout."""

    def __call__(self, now: RolloutState, ctrl: Float[Array, "n lanes"], water: Water, /) -> PyTree:
        """(state after a step, its ctrl, its water) → a pytree of arrays."""


def controlled(controller: Controller, parameters: PyTree) -> Policy:
    """The policy of a controller with decoded parameters."""
    return lambda state, time, readings, _: controller.step(parameters, state, time, readings)


def held(ctrl: Float[Array, "n lanes"]) -> Policy:
    """The policy of constant commands."""
    return lambda state, time, readings, _: (state, ctrl)


def open_loop(
    state: PyTree, time: Float[Array, "..."], readings: SensorReadings, ctrl: PyTree
) -> tuple[PyTree, Float[Array, "n lanes"]]:
    """The policy of the commands in `StepInputs.ctrl`."""
    return state, ctrl


def start_at_rest(engine: Engine, root: Float[Array, "7 lanes"]) -> PyTree:
    """An engine's state at root poses, at rest, hinges at 0."""
    hinges = jnp.zeros((engine.plant.num_hinges, root.shape[-1]), root.dtype)
    qvel = jnp.concatenate([jnp.zeros_like(root[:6]), hinges])
    return engine.init(jnp.concatenate([root, hinges]), qvel)


def no_commands(engine: Engine, like: Float[Array, "... lanes"]) -> Float[Array, "n lanes"]:
    """Commands of 0, of the lanes and precision of `like`."""
    return jnp.zeros((engine.plant.num_rows, like.shape[-1]), like.dtype)


def with_variation(engine: Engine, variation: Variation | None) -> Engine:
    """An engine with the coefficients of an episode; the same one where they are not varied."""
    return engine if variation is None else engine.with_variation(variation)


@dataclass(frozen=True, eq=False)
class Rollout:
    """A simulator with a policy, in a world; its functions are pure.

    Attributes:
        engine: steps the robots.
        policy: commands them.
        world: water and bed of the sensors; its timestep.
        water: of all steps without one of their own; with waves, its time is at the start.
        context: of the episodes, for sensors.
        signals: which of `readings.OPTIONAL_SIGNALS`, and which modules, the policy reads.
        clock: timesteps of each episode before `steps` 0; None: 0.
        birth: `steps` at which each robot's own time began, which its policy reads; None: the
            episode's time.
    """

    engine: Engine
    policy: Policy
    world: World
    water: Water
    context: EpisodeContext = _NO_CONTEXT
    signals: Sequence[str] = ()
    clock: Int[Array, " lanes"] | None = None
    birth: Int[Array, " lanes"] | None = None

    def init(self, state: PyTree, controller_state: PyTree = ()) -> RolloutState:
        """The state before the first step, of an engine's state and a policy's."""
        energy = jnp.zeros_like(self.engine.root(state).angular_velocity[0])
        memory = init_memory(self.signals, self.engine, state, self.context)
        if "touch" in self.signals or "cells" in self.signals:
            state = self.engine.with_touch(state)
        return RolloutState(state, controller_state, memory, energy, jnp.zeros((), jnp.int32))

    def _seconds(self, steps: Scalar, like: Float[Array, " lanes"]) -> Float[Array, "..."]:
        return steps.astype(like.dtype) * self.world.timestep

    def water_at(self, steps: Scalar, now: RolloutState, inputs: StepInputs) -> Water:
        """The water a number of steps after `steps` 0, under the inputs of that step."""
        water = self.water if inputs.water is None else inputs.water
        if not self.world.waves:
            return water
        return water._replace(time=water.time + self._episode_time(steps, now))

    def _episode_time(self, steps: Scalar, now: RolloutState) -> Float[Array, "..."]:
        return self._seconds(steps if self.clock is None else self.clock + steps, now.energy)

    def read(
        self,
        now: RolloutState,
        inputs: StepInputs = NO_INPUTS,
        forces: InteractionForces = NO_INTERACTION,
        motion: BodyMotion | None = None,
    ) -> tuple[Float[Array, "..."], Water, SensorReadings]:
        """Time [s], water and sensor readings; `motion`: of all bodies, where it is known."""
        time, water = self._episode_time(now.steps, now), self.water_at(now.steps, now, inputs)
        given = now.state, water, time, self.context, now.memory, self.signals
        return time, water, read_sensors(self.world, self.engine, *given, forces, motion)

    def act(
        self, now: RolloutState, inputs: StepInputs, forces: InteractionForces = NO_INTERACTION
    ) -> tuple[PyTree, Float[Array, "n lanes"], Water, BodyMotion | None]:
        """The first half of a step: controller state, ctrl, water, and motion if remembered."""
        # One pass over the tree serves the readings and what is remembered of them.
        motion = self.engine.body_motions(now.state) if now.memory.past is not None else None
        time, water, readings = self.read(now, inputs, forces, motion)
        if self.birth is not None:
            time = self._seconds(now.steps - self.birth, now.energy)
        controller_state, ctrl = self.policy(now.controller_state, time, readings, inputs.ctrl)
        return controller_state, ctrl, water, motion

    def update(
        self,
        now: RolloutState,
        state: PyTree,
        power: Float[Array, " lanes"],
        controller_state: PyTree,
        ctrl: Float[Array, "n lanes"],
        motion: BodyMotion | None,
    ) -> RolloutState:
        """The second half of a step: the state after the engine's step and `act`."""
        dt, context = self.world.timestep, self.context
        work = dt * power
        before, after = self.engine.root(now.state), self.engine.root(state)
        memory = update_memory(now.memory, before, after, ctrl, work, dt, motion, context)
        return RolloutState(state, controller_state, memory, now.energy + work, now.steps + 1)

    def step(
        self,
        now: RolloutState,
        given: tuple[StepInputs, InteractionForces],
        offset: Float[Array, "n lanes"] | None = None,
    ) -> tuple[RolloutState, Float[Array, "n lanes"]]:
        """One step.

        Args:
            now: before it.
            given: its inputs, and the forces between robots of one world.
            offset: added to ctrl: the gradient by it is that by the commands.

        Returns:
            The state after it, and ctrl.
        """
        inputs, forces = given
        controller_state, ctrl, water, motion = self.act(now, inputs, forces)
        ctrl = ctrl if offset is None else ctrl + offset
        wrench = () if self.engine.interaction is None else (forces.wrench,)
        state, power = self.engine.step(now.state, ctrl, water, *wrench)
        return self.update(now, state, power, controller_state, ctrl, motion), ctrl

    def record(
        self, recorder: Recorder, now: RolloutState, ctrl: PyTree, inputs: StepInputs
    ) -> PyTree:
        """The record after a step with these inputs."""
        return recorder(now, ctrl, self.water_at(now.steps - 1, now, inputs))

    def advance(
        self,
        now: RolloutState,
        recorder: Recorder,
        records: int,
        every: int = 1,
        inputs: StepInputs = NO_INPUTS,
        differentiable: bool = False,
    ) -> tuple[RolloutState, PyTree]:
        """Steps the rollouts, and records them at equal intervals.

        Args:
            now: from `init`, or of an earlier `advance`.
            recorder: makes a record.
            records: number of records.
            every: steps between them.
            inputs: `[records * every, ...]`.
            differentiable: whether each step is computed again in the backward pass
                (checkpointing), so that only states are kept.

        Returns:
            The state after the last step, and the records, `[records, ...]` each.
        """
        step: Callable[..., Any] = self.step
        pack = unpack = lambda x: x
        # Interaction between robots is not element-wise, so it stays outside of the fused step.
        interaction = self.engine.interaction
        neighbours: PyTree = () if interaction is None else interaction.init(now.state)

        def detect(state: PyTree, neighbours: PyTree) -> tuple[InteractionForces, PyTree]:
            if interaction is None:
                return NO_INTERACTION, neighbours
            return interaction.detect(state, neighbours)

        if self.engine.elementwise and not differentiable:
            first = jax.tree.map(lambda x: x[0], inputs)
            example = first, detect(now.state, neighbours)[0]
            step, pack, unpack = fuse_step(step, now, example)
        else:
            step = fuse(step, inline=True)
            if differentiable:
                step = jax.checkpoint(step, prevent_cse=False)

        def detect_and_step(carry: PyTree, row: StepInputs) -> tuple[PyTree, jax.Array]:
            packed, neighbours = carry
            forces, neighbours = detect(unpack(packed).state, neighbours)
            packed, ctrl = step(packed, (row, forces))
            return (packed, neighbours), ctrl

        def block(carry: PyTree, rows: StepInputs) -> tuple[PyTree, PyTree]:
            packed, neighbours = carry
            begun = unpack(packed)
            carry = pack(begun._replace(energy=jnp.zeros_like(begun.energy))), neighbours
            last = jax.tree.map(lambda x: x[-1], rows)
            if every == 1:
                carry, ctrl = detect_and_step(carry, last)
            else:
                carry, ctrls = jax.lax.scan(detect_and_step, carry, rows, length=every)
                ctrl = jax.tree.map(lambda x: x[-1], ctrls)
            return carry, self.record(recorder, unpack(carry[0]), ctrl, last)

        inputs = jax.tree.map(lambda x: x.reshape(records, every, *x.shape[1:]), inputs)
        (packed, _), kept = jax.lax.scan(block, (pack(now), neighbours), inputs, length=records)
        return unpack(packed), kept
