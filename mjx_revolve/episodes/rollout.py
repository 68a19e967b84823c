"""Rollouts: a scan of steps, from a start to what is recorded of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_revolve.control.sense import NOBODY, Cues, Memory, Sense, feel, remember, start_memory
from mjx_revolve.engine.collisions import Meeting
from mjx_revolve.engine.state import Engine
from mjx_revolve.numerics.xla import fused_scan, share_once
from mjx_revolve.water.flow import Water
from mjx_revolve.water.world import World

_NO_CUES = Cues()


class Passage(NamedTuple):
    """What travels from step to step.

    Attributes:
        state: of the engine.
        drive_state: of the controller.
        memory: of what is felt.
        energy: since the last record, `[lanes]` [J].
        count: how many steps there were, int32: time is exact however long the run.
    """

    state: Any
    drive_state: Any
    memory: Any
    energy: Any
    count: Any


def begin(
    engine: Engine,
    state: Any,
    drive_state: Any,
    feels: Sequence[str] = (),
    cues: Cues = _NO_CUES,
) -> Passage:
    """What travels before the first step.

    Args:
        engine: what steps.
        state: from `engine.init`.
        drive_state: of the controller.
        feels: which of `sense.FEELS` are asked for.
        cues: of the episodes.

    Returns:
        The start of a rollout.
    """
    energy = jnp.zeros_like(engine.root(state).spin[0])
    memory = start_memory(feels, engine, state, cues)
    return Passage(state, drive_state, memory, energy, jnp.zeros((), jnp.int32))


def make_drive(
    engine: Engine,
    drive: Callable[[Any, jax.Array, Any, Sense], tuple[Any, jax.Array]],
    flow: Callable[[jax.Array, Any], Water],
    *,
    timestep: float,
    world: World | None = None,
    cues: Cues = _NO_CUES,
    feels: Sequence[str] = (),
    since: Any = None,
) -> Callable[..., tuple[Any, jax.Array, Water, Any]]:
    """What a rollout does before each step of the engine: robots feel, brains drive.

    Args:
        engine: this and all others as of `go_on`.
        drive: likewise.
        flow: likewise.
        timestep: likewise.
        world: likewise.
        cues: likewise.
        feels: likewise.
        since: likewise.

    Returns:
        (rollout, inputs of this step, and with whom robots meet, by default nobody) → (controller
        state, ctrl, water, and how the bodies move where that is remembered, or None).
    """

    def told(now: Passage, row: Any, meeting: Meeting = NOBODY) -> Any:
        time = _clock(now.count, now.energy, timestep)
        water = flow(time, row)
        # One sweep over the body serves what is felt now and what is remembered of it.
        motion = engine.motions(now.state) if now.memory.past is not None else None
        felt = feel(world, engine, now.state, water, time, cues, now.memory, feels, meeting, motion)
        own = time if since is None else _clock(now.count - since, now.energy, timestep)
        drive_state, ctrl = drive(now.drive_state, own, row, felt)
        return drive_state, ctrl, water, motion

    return told


def make_step(
    engine: Engine,
    told: Callable[..., tuple[Any, jax.Array, Water, Any]],
    timestep: float,
    cues: Cues = _NO_CUES,
) -> Callable[..., tuple[Passage, jax.Array]]:
    """A step of a rollout.

    Args:
        engine: what steps the robots.
        told: from `make_drive`.
        timestep: [s].
        cues: of the episodes.

    Returns:
        (rollout, inputs of this step) → (the rollout a step later, ctrl). A third argument is added
        to ctrl: by it, slopes by commands are found. A fourth says with whom robots meet.
    """

    def step(
        now: Passage, row: Any, push: Any = None, meeting: Meeting = NOBODY
    ) -> tuple[Passage, jax.Array]:
        drive_state, ctrl, water, motion = told(now, row, meeting)
        if push is not None:
            ctrl = ctrl + push
        before = engine.root(now.state)
        pushes = () if engine.meet is None else (meeting.push,)
        state, power = engine.step(now.state, ctrl, water, *pushes)
        work = timestep * power
        after = engine.root(state)
        memory = remember(now.memory, before, after, ctrl, work, timestep, motion, cues)
        return Passage(state, drive_state, memory, now.energy + work, now.count + 1), ctrl

    return step


def _clock(count: Any, like: jax.Array, timestep: float) -> jax.Array:
    return count.astype(like.dtype) * timestep


def roll_out(
    engine: Engine,
    drive: Callable[[Any, jax.Array, Any, Sense], tuple[Any, jax.Array]],
    flow: Callable[[jax.Array, Any], Water],
    record: Callable[[Any, jax.Array, jax.Array, Water], Any],
    state: Any,
    drive_state: Any,
    inputs: Any,
    *,
    feels: Sequence[str] = (),
    cues: Cues = _NO_CUES,
    **settings: Any,
) -> tuple[Any, Any]:
    """Steps a chunk of a population from its start and records it now and then.

    Args:
        engine: what steps it.
        drive: as in `go_on`.
        flow: likewise.
        record: likewise.
        state: from `engine.init`.
        drive_state: initial controller state.
        inputs: as in `go_on`.
        feels: which of `sense.FEELS` are asked for.
        cues: what else they are given to feel.
        **settings: of `go_on`.

    Returns:
        The last state, and the records, `[records, ...]` each.
    """
    start = begin(engine, state, drive_state, feels, cues)
    last, kept = go_on(
        engine, drive, flow, record, start, inputs, feels=feels, cues=cues, **settings
    )
    return last.state, kept


def go_on(
    engine: Engine,
    drive: Callable[[Any, jax.Array, Any, Sense], tuple[Any, jax.Array]],
    flow: Callable[[jax.Array, Any], Water],
    record: Callable[[Any, jax.Array, jax.Array, Water], Any],
    passage: Passage,
    inputs: Any,
    *,
    records: int,
    every: int,
    timestep: float,
    derived: bool = False,
    world: World | None = None,
    cues: Cues = _NO_CUES,
    feels: Sequence[str] = (),
    since: Any = None,
    recall: Callable[[Any, Memory], Any] = lambda kept, memory: kept,
) -> tuple[Passage, Any]:
    """Steps a chunk of a population on and records it now and then.

    Args:
        engine: what steps it.
        drive: (controller state, time [s], inputs of this step, what the robot senses) →
            (controller state, ctrl `[nu, lanes]` in the engine's order).
        flow: (time [s], inputs of this step) → the water.
        record: (state, ctrl, energy since the last record `[lanes]` [J], the water of the last
            step) → what to keep.
        passage: from `begin`, or what the steps before have left.
        inputs: None, or arrays `[records * every, ...]`, one row for each step.
        records: how many records.
        every: steps between them.
        timestep: [s].
        derived: whether it is to be differentiated: each step is then computed again on the way
            back, so that memory grows with the state and not with its working.
        world: whose water and bed the robots feel; None where they feel neither.
        cues: what else they are given to feel.
        feels: which of `sense.FEELS` are asked for.
        since: `[lanes]` int32 step at which each robot's own time began; None: all at the first.
        recall: (what `record` keeps, what is remembered of what was felt) → what to keep; by
            default nothing of the latter.

    Returns:
        What travels on, and the records, `[records, ...]` each.
    """
    told = make_drive(
        engine, drive, flow, timestep=timestep, world=world, cues=cues, feels=feels, since=since
    )
    one = make_step(engine, told, timestep, cues)
    step: Any = lambda now, given: one(now, given[0], None, given[1])  # noqa: E731
    first = None if inputs is None else jax.tree.map(lambda x: x[0], inputs)
    # What robots do to each other is no element-wise function of them, so it stays outside.
    look = (lambda state, watch: (NOBODY, watch)) if engine.meet is None else engine.meet.look
    watch = () if engine.meet is None else engine.meet.start(passage.state)
    pack = unpack = lambda x: x
    if engine.fuses and not derived:
        step, pack, unpack = fused_scan(step, passage, (first, look(passage.state, watch)[0]))
    else:
        step = share_once(step)
        if derived:
            step = jax.checkpoint(step, prevent_cse=False)

    def look_and_step(carry: Any, row: Any) -> tuple[Any, jax.Array]:
        packed, watch = carry
        meeting, watch = look(unpack(packed).state, watch)
        packed, ctrl = step(packed, (row, meeting))
        return (packed, watch), ctrl

    def block(carry: Any, rows: Any) -> tuple[Any, Any]:
        packed, watch = carry
        start = unpack(packed)
        start = pack(start._replace(energy=jnp.zeros_like(start.energy)))
        last = None if rows is None else jax.tree.map(lambda x: x[-1], rows)
        if every == 1:
            (packed, watch), ctrl = look_and_step((start, watch), last)
        else:
            (packed, watch), ctrls = jax.lax.scan(look_and_step, (start, watch), rows, length=every)
            ctrl = jax.tree.map(lambda x: x[-1], ctrls)
        state, _, memory, energy, count = unpack(packed)
        water = flow(_clock(count - 1, energy, timestep), last)
        return (packed, watch), recall(record(state, ctrl, energy, water), memory)

    if inputs is not None:
        inputs = jax.tree.map(lambda x: x.reshape(records, every, *x.shape[1:]), inputs)
    carry = pack(passage), watch
    (packed, _), kept = jax.lax.scan(block, carry, inputs, length=records)
    return unpack(packed), kept


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
