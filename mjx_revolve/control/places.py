"""What a robot feels at its modules: the senses of the core, at other places of the body.

Written for one place, `[lanes]`, and for one on each rigid body, `[1 + hinge rows, lanes]`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.engine.sites import Sites
from mjx_revolve.numerics.inertia import Motion
from mjx_revolve.numerics.spatial import Vec, cross, dot, matTvec, vadd, vscale, vsub
from mjx_revolve.water.bed import bed_height
from mjx_revolve.water.flow import Water, flow
from mjx_revolve.water.world import World


class Past(NamedTuple):
    """How rigid bodies moved before the last step, `[1 + hinge rows, lanes]` each.

    Attributes:
        velocity: of their origins, world frame [m/s].
        spin: angular velocity, body frame [rad/s].
    """

    velocity: Vec
    spin: Vec


class Place(NamedTuple):
    """What is felt at a module, in its frame: in the middle of its main box, that which moves.

    `[lanes]` each at a single module; on a type of modules `[1 + hinge rows, lanes]`, of the first
    such module on the core's rigid body and on what each hinge carries. Names are `sense.Sense`'s.

    Attributes:
        there: 1 where there is such a module, else 0.
        height: above the still surface, negative under water [m].
        climb: vertical velocity [m/s].
        up: the world's vertical [-].
        north: the world's x axis [-].
        spin: angular velocity [rad/s].
        flow: velocity of the water relative to the module [m/s].
        altitude: above the bed, straight down [m]; infinite without a bed.
        target: from the module to the target [m]; 0 without one.
        force: specific force over the last step [m/s²]; None unless asked for, as below.
        angle: of the module's own hinge [rad]; None without one, as below.
        speed: of it [rad/s].
        load: torque of its servo [N·m].
        touch: how hard the bed pushes the rigid body that the module is part of [N].
        cells: how hard it pushes the module's left and right half, along the bed's normal [N].
    """

    there: Any
    height: Any
    climb: Any
    up: Vec
    north: Vec
    spin: Vec
    flow: Vec
    altitude: Any
    target: Vec
    force: Any = None
    angle: Any = None
    speed: Any = None
    load: Any = None
    touch: Any = None
    cells: Any = None


def axes_of(motion: Motion) -> tuple[Vec, Vec, Vec]:
    """The world's axes in the bodies' frames: the rows of the rotation world from body."""
    return motion.x_axis, motion.y_axis, motion.up


def past_of(motion: Motion) -> Past:
    """What is remembered of how bodies move."""
    axes = axes_of(motion)
    return Past(tuple(dot(axis, motion.velocity) for axis in axes), motion.spin)


def feel_place(
    world: World | None,
    water: Water,
    target: Vec | None,
    motion: Motion,
    past: Past | None,
    timestep: float,
    sites: Sites,
) -> Place:
    """What is felt at a module, or on a type of modules; what is no motion's left out.

    Args:
        world: around the robots; None where nobody asks for water or bed.
        water: at the time.
        target: where it is, world frame [m]; None without one.
        motion: of all rigid bodies, from `Engine.motions`.
        past: how they moved before the last step; None where nobody asks for specific force.
        timestep: of the last step [s].
        sites: where the modules are.

    Returns:
        The senses.
    """
    if sites.row is not None:
        motion, past = jax.tree.map(lambda x: x[sites.row], (motion, past))
    like = motion.height
    wide = lambda xs: tuple(jnp.broadcast_to(x, like.shape) for x in xs)  # noqa: E731
    fit = lambda x: np.asarray(x, like.dtype) if isinstance(x, np.ndarray) else x  # noqa: E731
    place, rotation, there = jax.tree.map(fit, (sites.position, sites.rotation, sites.there))
    axes = axes_of(motion)
    own = lambda x: wide(matTvec(rotation, x))  # noqa: E731
    into = lambda x: matTvec(axes, x)  # noqa: E731  (from the world's frame to the bodies')
    velocity = vadd(motion.velocity, cross(motion.spin, place))
    offset = [dot(axis, place) for axis in axes]
    x, y, z = wide(a + b for a, b in zip((*motion.place, motion.height), offset, strict=True))
    zero = jnp.zeros_like(like)
    moving: Vec = (zero, zero, zero)
    altitude = zero + jnp.inf
    if world is not None:
        moving = own(vsub(into(flow(world, water, x, y, z)[0]), velocity))
        if world.bed is not None:
            altitude = z - bed_height(world.bed, x, y)
    force = None
    if past is not None:
        rate = 1 / timestep
        gravity = 9.81 if world is None else world.gravity
        gain = vscale(rate, vsub(past_of(motion).velocity, past.velocity))
        turning = vscale(rate, vsub(motion.spin, past.spin))
        # In the middle of the step, so that the mean over it is good to second order.
        spin = vscale(0.5, vadd(motion.spin, past.spin))
        push = vadd(into((gain[0], gain[1], gain[2] + gravity)), cross(turning, place))
        force = own(vadd(push, cross(spin, cross(spin, place))))
    return Place(
        there=jnp.broadcast_to(there, like.shape),
        height=z - water.surface_height,
        climb=dot(motion.up, velocity),
        up=own(motion.up),
        north=own(motion.x_axis),
        spin=own(motion.spin),
        flow=moving,
        altitude=altitude,
        target=(zero, zero, zero) if target is None else own(into(vsub(target, (x, y, z)))),
        force=force,
    )
