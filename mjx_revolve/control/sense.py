"""What a robot feels, from the engine's state: for one robot and for many, in every engine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_revolve.control.courses import Course
from mjx_revolve.control.places import Past, feel_place, past_of
from mjx_revolve.control.pursuit import Chase, Pursuer, pursue, start_chase
from mjx_revolve.engine.collisions import ALONE, Meeting
from mjx_revolve.engine.state import Engine, Root
from mjx_revolve.numerics.inertia import Motion
from mjx_revolve.numerics.spatial import Vec, dot, matTvec, quat_to_rows, vadd, vscale, vsub
from mjx_revolve.water.bed import bed_height
from mjx_revolve.water.flow import Water, flow
from mjx_revolve.water.world import World

FEELS = ("force", "load", "work", "touch", "nearest", "forces", "cells")
"""What is there only for a `Controller` that names it in `feels`, beside places.

The first five are fields of `Sense`, the others of `Place`: `forces` is its specific force. A place
is named "at ID", a module of one robot, or "each TYPE", modules of a type; `Sense.places` then has
it by that name. Touch, cells and places need a sweep over the body, who is nearest a look at all
others, and the rest a memory, which travels with the state; all else costs nothing unless it is
used, as the compiler leaves out what nobody reads.
"""
_PLACED = ("at ", "each ")


def is_place(name: str) -> bool:
    """Whether what is asked for is a place."""
    return name.startswith(_PLACED)


NOBODY = Meeting()
"""Where each robot has a world to itself."""


class Cues(NamedTuple):
    """What an episode gives its robots to feel beside their own state, `[lanes]` each or None.

    Attributes:
        target: where the target is at the start, world frame, three of `[lanes]` [m].
        drift: its velocity, likewise [m/s]; None where it keeps still.
        noise: what noise is drawn from, uint32 `[lanes]`; the same for all individuals in a trial.
        sight: from how far away the target is felt [m]; None for any distance.
        chase: how the target swims at the robot; None where it does not.
        course: a direction to keep to.
    """

    target: Any = None
    drift: Any = None
    noise: Any = None
    sight: Any = None
    chase: Chase | None = None
    course: Course | None = None

    def target_at(self, time: Any) -> Vec:
        """Where the target is that does not chase the robot, world frame [m].

        Args:
            time: since the episode's start [s].
        """
        if self.drift is None:
            return tuple(self.target)
        return vadd(self.target, vscale(time, self.drift))


_NO_CUES = Cues()


class Other(NamedTuple):
    """Another robot, as one may see it.

    Attributes:
        toward: from core to core, core frame, three of `[lanes]` [m]; `ALONE` far where there is
            nobody.
        tag: by which it can be told apart, `[lanes]` [-]; 0 likewise.
    """

    toward: Any
    tag: Any


class Memory(NamedTuple):
    """What is kept from step to step of what is felt; None where nobody asks for it.

    Attributes:
        acceleration: of the core over the last step, world frame, three of `[lanes]` [m/s²].
        ctrl: the last command, `[n, lanes]` in the plant's order.
        work: done so far `[lanes]` [J].
        past: how all rigid bodies moved before the last step.
        pursuer: a target that chases the robot; None where it does not.
    """

    acceleration: Any = None
    ctrl: Any = None
    work: Any = None
    past: Past | None = None
    pursuer: Pursuer | None = None


class Sense(NamedTuple):
    """What a controller may know of a robot's state, `[lanes]` each.

    Attributes:
        height: z of the core's centre above the still surface, negative under water [m].
        climb: its vertical velocity [m/s].
        up: the world's vertical, core frame, three of `[lanes]` [-].
        spin: angular velocity, core frame, three of `[lanes]` [rad/s].
        north: the world's x axis, core frame, three of `[lanes]` [-]: a compass.
        angle: of the hinges, `[hinge rows, lanes]` in the plant's order; 0 for rows that are no
            hinge [rad].
        speed: of the hinges, likewise [rad/s].
        flow: velocity of the water at the core relative to the core, core frame, three of `[lanes]`
            [m/s].
        altitude: of the core's centre above the bed, straight down [m]; infinite without a bed.
        target: from the core to the target, core frame, three of `[lanes]` [m]; 0 without one, and
            where it is too far away to be felt.
        noise: what noise of sensors is drawn from, uint32 `[lanes]`; None without.
        force: specific force at the core, core frame, three of `[lanes]` [m/s²]: what an
            accelerometer feels, the acceleration over the last step less gravity's. None unless
            asked for; see `FEELS`.
        load: torque of the servos under the last command, `[hinge rows, lanes]` [N·m]; likewise.
        work: done by servos and propellers so far [J]; likewise.
        touch: how hard the bed pushes the core's rigid body, then what each hinge carries,
            `[1 + hinge rows, lanes]` [N]; likewise.
        nearest: an `Other`, the nearest other robot in the same world; likewise.
        places: what is felt at modules, a `Place` for each name; likewise.
        course: the direction to keep to, a unit vector, core frame, three of `[lanes]`; 0 without.
        seen: whether the target is near enough to be felt, `[lanes]`; None where it always is.
    """

    height: jax.Array
    climb: jax.Array
    up: Vec
    spin: Vec
    north: Any = None
    angle: Any = None
    speed: Any = None
    flow: Any = None
    altitude: Any = None
    target: Any = None
    noise: Any = None
    force: Any = None
    load: Any = None
    work: Any = None
    touch: Any = None
    nearest: Any = None
    places: Any = None
    course: Any = None
    seen: Any = None


def feel(
    world: World | None,
    engine: Engine,
    state: Any,
    water: Water,
    time: jax.Array,
    cues: Cues,
    memory: Memory,
    feels: Sequence[str] = (),
    meeting: Meeting = NOBODY,
    motion: Motion | None = None,
) -> Sense:
    """What robots feel.

    Args:
        world: around them; None where nobody asks for water or bed.
        engine: what steps them.
        state: of the population.
        water: its still surface is what heights are measured from.
        time: since the episode's start [s].
        cues: of the episode.
        memory: from `start_memory` or `remember`.
        feels: which of `FEELS`, and which places, are asked for.
        meeting: with the other robots of the same world.
        motion: of all rigid bodies, where it is known already.

    Returns:
        The senses.

    Raises:
        InputError: there is no such place.
    """
    root = engine.root(state)
    turn = quat_to_rows(root.quat)
    angle, speed = engine.joints(state)
    zero = jnp.zeros_like(root.position[2])
    moving: Any = (zero, zero, zero)
    altitude = zero + jnp.inf
    if world is not None:
        current, _ = flow(world, water, *root.position)
        moving = matTvec(turn, vsub(current, root.velocity))
        if world.bed is not None:
            altitude = root.position[2] - bed_height(world.bed, *root.position[:2])
    target: Any = (zero, zero, zero)
    seen, place = None, None
    if cues.target is not None:
        place = cues.target_at(time) if memory.pursuer is None else memory.pursuer.place
        target = matTvec(turn, vsub(place, root.position))
        if cues.sight is not None:
            seen = dot(target, target) < cues.sight * cues.sight
            target = tuple(jnp.where(seen, x, 0.0) for x in target)
    course: Any = (zero, zero, zero)
    if cues.course is not None:
        course = matTvec(turn, cues.course.at(time))
    nearest = None
    if "nearest" in feels:
        lone = meeting.nearest is None
        toward = (zero, zero, zero + ALONE) if lone else meeting.nearest
        nearest = Other(matTvec(turn, toward), zero if lone else meeting.tag)
    force = None
    if memory.acceleration is not None:
        gravity = 9.81 if world is None else world.gravity
        x, y, z = memory.acceleration
        force = matTvec(turn, (x, y, z + gravity))
    sense = Sense(
        height=root.position[2] - water.surface_height,
        climb=root.velocity[2],
        up=turn[2],
        spin=root.spin,
        north=turn[0],
        angle=angle,
        speed=speed,
        flow=moving,
        altitude=altitude,
        target=target,
        noise=cues.noise,
        force=force,
        load=None if memory.ctrl is None else engine.load(state, memory.ctrl),
        work=memory.work,
        touch=engine.touch(state, water) if "touch" in feels else None,
        nearest=nearest,
        course=course,
        seen=seen,
    )
    names = tuple(filter(is_place, feels))
    if not names:
        return sense
    motion = engine.motions(state) if motion is None else motion
    goal = place
    dt, places = engine.plant.timestep, {}
    cells = engine.cells(state, water) if "cells" in feels and engine.cells else None
    for name in names:
        sites = engine.plant.site(name)
        found = feel_place(world, water, goal, motion, memory.past, dt, sites)
        if sites.module is not None:
            found = found._replace(
                touch=None if sense.touch is None else sense.touch[sites.row],
                cells=None if cells is None else cells[sites.module],
            )
        if sites.hinge is not None:
            found = found._replace(
                angle=angle[sites.hinge],
                speed=speed[sites.hinge],
                load=None if sense.load is None else sense.load[sites.hinge],
            )
        places[name] = found
    return sense._replace(places=places)


def start_memory(feels: Sequence[str], engine: Engine, state: Any, cues: Cues = _NO_CUES) -> Memory:
    """What is remembered before the first step: rest, no work, servos told to stay where they are.

    Args:
        feels: which of `FEELS` are asked for.
        engine: what steps the robots.
        state: at the start.
        cues: of the episode.

    Returns:
        The memory.
    """
    place = engine.root(state).position
    zero = jnp.zeros_like(place[0])
    angle = engine.joints(state)[0]
    pad = jnp.zeros((engine.plant.num_rows - angle.shape[0], *angle.shape[1:]), angle.dtype)
    return Memory(
        acceleration=(zero, zero, zero) if "force" in feels else None,
        ctrl=jnp.concatenate([angle, pad]) if "load" in feels else None,
        work=zero if "work" in feels else None,
        past=past_of(engine.motions(state)) if "forces" in feels else None,
        pursuer=None if cues.chase is None else start_chase(cues.target, place),
    )


def remember(
    memory: Memory,
    before: Root,
    after: Root,
    ctrl: jax.Array,
    work: jax.Array,
    dt: float,
    motion: Motion | None = None,
    cues: Cues = _NO_CUES,
) -> Memory:
    """The memory after a step.

    Args:
        memory: before it.
        before: where the cores were and how they moved.
        after: where they are.
        ctrl: what was asked for, `[n, lanes]`.
        work: done in the step `[lanes]` [J].
        dt: of the step [s].
        motion: of all rigid bodies before it, where specific forces are asked for.
        cues: of the episode.

    Returns:
        The memory.
    """
    acceleration, pursuer = memory.acceleration, memory.pursuer
    if acceleration is not None:
        acceleration = vscale(1 / dt, vsub(after.velocity, before.velocity))
    if pursuer is not None and cues.chase is not None:
        pursuer = pursue(pursuer, cues.chase, before.position, dt)
    return Memory(
        acceleration=acceleration,
        ctrl=None if memory.ctrl is None else ctrl,
        work=None if memory.work is None else memory.work + work,
        past=None if motion is None else past_of(motion),
        pursuer=pursuer,
    )
