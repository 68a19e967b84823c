"""Pure pursuit: a point that heads for the robot at constant speed, its turning rate limited.

It has no body and is moved by neither water nor bed. It depends on where the robot was, so its
state is part of the rollout's, in `SensorMemory`.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from mjx_revolve.numerics.spatial import Scalar, Vec, dot, safe_norm, sincos, vadd, vscale, vsub


class PursuitLimits(NamedTuple):
    """Capabilities of a pursuer, `[lanes]` each.

    Attributes:
        speed: over ground [m/s].
        turn: largest turning rate [rad/s].
    """

    speed: Scalar
    turn: Scalar


class Pursuer(NamedTuple):
    """State of a pursuer, world frame, three of `[lanes]` each.

    Attributes:
        position: [m].
        heading: unit vector.
    """

    position: Vec
    heading: Vec


def init_pursuer(position: Vec, robot: Vec) -> Pursuer:
    """A pursuer at a position that heads for the robot's, world frame [m]."""
    position = tuple(p + 0 * x for p, x in zip(position, robot, strict=True))
    return Pursuer(position, _unit(vsub(robot, position)))


def step_pursuer(pursuer: Pursuer, limits: PursuitLimits, robot: Vec, dt: float) -> Pursuer:
    """The pursuer after a step: it turns towards the robot and moves on.

    Args:
        pursuer: before it.
        limits: its speed and turning rate.
        robot: position before the step, world frame, three of `[lanes]` [m].
        dt: timestep [s].
    """
    ahead, wanted = pursuer.heading, vsub(robot, pursuer.position)
    away = safe_norm(wanted)
    # Where the two coincide, the heading stays.
    pairs = zip(wanted, ahead, strict=True)
    wanted = tuple(jnp.where(away > 0, w / jnp.maximum(away, 1e-12), a) for w, a in pairs)
    along = dot(ahead, wanted)
    aside = vsub(wanted, vscale(along, ahead))
    # To the left where the robot is straight behind; x axis of the world if it heads up or down.
    x, y, _ = ahead
    behind = dot(aside, aside) < 1e-12
    steep = x * x + y * y < 1e-12
    left = (jnp.where(steep, 1.0, -y), jnp.where(steep, 0.0, x), jnp.zeros_like(x))
    aside = _unit(tuple(jnp.where(behind, b, a) for a, b in zip(aside, left, strict=True)))
    sine, cosine = sincos(jnp.asarray(limits.turn * dt))
    turned = vadd(vscale(cosine, ahead), vscale(sine, aside))
    # Within one step's turn it heads for the robot itself. (No turn is of more than π.)
    near = along >= jnp.where(limits.turn * dt < jnp.pi, cosine, -1.0)
    heading = _unit(tuple(jnp.where(near, w, t) for w, t in zip(wanted, turned, strict=True)))
    # It does not overshoot the robot.
    gone = jnp.where(near, jnp.minimum(limits.speed * dt, away), limits.speed * dt)
    return Pursuer(vadd(pursuer.position, vscale(gone, heading)), heading)


def _unit(a: Vec) -> Vec:
    """The same direction, of length 1; 0 for 0."""
    return vscale(1 / jnp.maximum(safe_norm(a), 1e-12), a)
