"""Courses: a horizontal direction to keep to, which turns during the episode."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from mjx_revolve.numerics.spatial import Scalar, Vec, sincos


class Course(NamedTuple):
    """A direction and how it turns, `[lanes]` each.

    Attributes:
        heading: at the start, from the world's x axis towards its y axis [rad].
        rate: constant turning rate [rad/s].
        moments: times of sudden turns [s].
        turns: angles of sudden turns [rad].
    """

    heading: Scalar
    rate: Scalar
    moments: tuple[Scalar, ...] = ()
    turns: tuple[Scalar, ...] = ()

    def at(self, time: Scalar) -> Vec:
        """The course at a time since the episode's start [s]: a unit vector, world frame."""
        angle = self.heading + self.rate * time
        for moment, turn in zip(self.moments, self.turns, strict=True):
            angle = angle + jnp.where(time >= moment, turn, 0.0)
        sine, cosine = sincos(jnp.asarray(angle))
        return cosine, sine, jnp.zeros_like(sine)


def course_path(course: Course, time: jax.Array) -> jax.Array:
    """`[S, 3, lanes]` the course at times `[S]` [s], world frame."""
    return jnp.stack(jax.vmap(course.at)(time), 1)
