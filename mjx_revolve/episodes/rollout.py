"""Rollouts: a scan of steps, from a start to what is recorded of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from mjx_revolve.control.sense import Cues, Sense, feel, remember, start_memory
from mjx_revolve.engine.state import Engine
from mjx_revolve.numerics.xla import fused_scan, share_once
from mjx_revolve.water.flow import Water
from mjx_revolve.water.world import World

_NO_CUES = Cues()


def roll_out(
    engine: Engine,
    drive: Callable[[Any, jax.Array, Any, Sense], tuple[Any, jax.Array]],
    flow: Callable[[jax.Array, Any], Water],
    record: Callable[[Any, jax.Array, jax.Array, Water], Any],
    state: Any,
    drive_state: Any,
    inputs: Any,
    *,
    records: int,
    every: int,
    timestep: float,
    derived: bool = False,
    world: World | None = None,
    cues: Cues = _NO_CUES,
    feels: Sequence[str] = (),
) -> tuple[Any, Any]:
    """Steps a chunk of a population and records it now and then.

    Args:
        engine: what steps it.
        drive: (controller state, time [s], inputs of this step, what the robot senses) →
            (controller state, ctrl `[nu, lanes]` in the engine's order).
        flow: (time [s], inputs of this step) → the water.
        record: (state, ctrl, energy since the last record `[lanes]` [J], the water of the last
            step) → what to keep.
        state: from `engine.init`.
        drive_state: initial controller state.
        inputs: None, or arrays `[records * every, ...]`, one row for each step.
        records: how many records.
        every: steps between them.
        timestep: [s].
        derived: whether it is to be differentiated: each step is then computed again on the way
            back, so that memory grows with the state and not with its working.
        world: whose water and bed the robots feel; None where they feel neither.
        cues: what else they are given to feel.
        feels: which of `sense.FEELS` are asked for.

    Returns:
        The last state, and the records, `[records, ...]` each.
    """

    def step(carry: Any, now: Any) -> tuple[Any, jax.Array]:
        state, drive_state, memory, energy, count = carry
        # The step counter travels as an integer, so that time is exact however long the run.
        time = count.astype(energy.dtype) * timestep
        water = flow(time, now)
        felt = feel(world, engine, state, water, time, cues, memory, feels)
        drive_state, ctrl = drive(drive_state, time, now, felt)
        before = engine.root(state)
        state, power = engine.step(state, ctrl, water)
        work = timestep * power
        memory = remember(memory, before, engine.root(state), ctrl, work, timestep)
        return (state, drive_state, memory, energy + work, count + 1), ctrl

    energy = jnp.zeros_like(engine.root(state).spin[0])
    memory = start_memory(feels, engine, state)
    carry = (state, drive_state, memory, energy, jnp.zeros((), jnp.int32))
    first = None if inputs is None else jax.tree.map(lambda x: x[0], inputs)
    pack = unpack = lambda x: x
    if engine.fuses and not derived:
        step, pack, unpack = fused_scan(step, carry, first)
    else:
        step = share_once(step)
        if derived:
            step = jax.checkpoint(step, prevent_cse=False)

    def block(packed: Any, rows: Any) -> tuple[Any, Any]:
        state, drive_state, memory, energy, count = unpack(packed)
        start = pack((state, drive_state, memory, jnp.zeros_like(energy), count))
        last = None if rows is None else jax.tree.map(lambda x: x[-1], rows)
        if every == 1:
            packed, ctrl = step(start, last)
        else:
            packed, ctrls = jax.lax.scan(step, start, rows, length=every)
            ctrl = jax.tree.map(lambda x: x[-1], ctrls)
        state, _, _, energy, count = unpack(packed)
        water = flow((count - 1).astype(energy.dtype) * timestep, last)
        return packed, record(state, ctrl, energy, water)

    if inputs is not None:
        inputs = jax.tree.map(lambda x: x.reshape(records, every, *x.shape[1:]), inputs)
    packed, kept = jax.lax.scan(block, pack(carry), inputs, length=records)
    return unpack(packed)[0], kept


def flow_at(world: World, water: Water) -> Callable[[jax.Array, Any], Water]:
    """The water at each moment of a rollout whose surface and current do not change.

    Args:
        world: the world.
        water: at the start; where there are waves, its time is when the rollout begins.

    Returns:
        What `roll_out` takes as `flow`.
    """
    if not world.waves:
        return lambda time, row: water
    return lambda time, row: water._replace(time=water.time + time)
