"""A pursuer: a point that swims at the robot as fast as it can and turns no faster than it can.

It has no body, and knows neither water nor bed. Where it is depends on where the robot was, so it
is part of what travels with a rollout, `sense.Memory`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp

from mjx_revolve.numerics.spatial import Vec, dot, safe_norm, sincos, vadd, vscale, vsub


class Chase(NamedTuple):
    """What a pursuer can do, `[lanes]` each.

    Attributes:
        speed: over ground [m/s].
        turn: how fast it turns at most [rad/s].
    """

    speed: Any
    turn: Any


class Pursuer(NamedTuple):
    """A pursuer on its way, world frame.

    Attributes:
        place: where it is, three of `[lanes]` [m].
        heading: where it swims, a unit vector, likewise.
    """

    place: Vec
    heading: Vec


def start_chase(place: Vec, prey: Vec) -> Pursuer:
    """A pursuer that heads for its prey.

    Args:
        place: where it starts, three of `[lanes]` [m].
        prey: where the robot is, likewise.

    Returns:
        The pursuer.
    """
    place = tuple(p + 0 * x for p, x in zip(place, prey, strict=True))
    return Pursuer(place, _unit(vsub(prey, place)))


def pursue(pursuer: Pursuer, chase: Chase, prey: Vec, dt: float) -> Pursuer:
    """The pursuer after a step: it turns towards its prey, and swims on.

    Args:
        pursuer: before it.
        chase: what it can do.
        prey: where the robot was before the step, three of `[lanes]` [m].
        dt: of the step [s].

    Returns:
        The pursuer.
    """
    ahead, wanted = pursuer.heading, vsub(prey, pursuer.place)
    away = safe_norm(wanted)
    # What is where it is itself is ahead of it.
    wanted = tuple(
        jnp.where(away > 0, w / jnp.maximum(away, 1e-12), a)
        for w, a in zip(wanted, ahead, strict=True)
    )
    along = dot(ahead, wanted)
    aside = vsub(wanted, vscale(along, ahead))
    # To the left where the prey is right behind, and the world's x axis for who heads up or down.
    x, y, _ = ahead
    behind = dot(aside, aside) < 1e-12
    steep = x * x + y * y < 1e-12
    left = (jnp.where(steep, 1.0, -y), jnp.where(steep, 0.0, x), jnp.zeros_like(x))
    aside = _unit(tuple(jnp.where(behind, b, a) for a, b in zip(aside, left, strict=True)))
    sine, cosine = sincos(jnp.asarray(chase.turn * dt))
    turned = vadd(vscale(cosine, ahead), vscale(sine, aside))
    # Nearer than one step's turn it heads for the prey itself. (No turn is of more than π.)
    near = along >= jnp.where(chase.turn * dt < jnp.pi, cosine, -1.0)
    heading = _unit(tuple(jnp.where(near, w, t) for w, t in zip(wanted, turned, strict=True)))
    # It does not swim past what it has caught.
    gone = jnp.where(near, jnp.minimum(chase.speed * dt, away), chase.speed * dt)
    return Pursuer(vadd(pursuer.place, vscale(gone, heading)), heading)


def _unit(a: Vec) -> Vec:
    """The same direction, of length 1; 0 for 0."""
    return vscale(1 / jnp.maximum(safe_norm(a), 1e-12), a)
