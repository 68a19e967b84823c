"""Courses: a level direction to keep to, which turns while the episode goes on."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_revolve.numerics.spatial import Vec, sincos


class Course(NamedTuple):
    """A direction and how it turns, `[lanes]` each.

    Attributes:
        heading: at the start, from the world's x axis towards its y axis [rad].
        rate: at which it turns all the time [rad/s].
        moments: when it turns at once, one for each of these turns [s].
        turns: by how much, likewise [rad].
    """

    heading: Any
    rate: Any
    moments: tuple[Any, ...] = ()
    turns: tuple[Any, ...] = ()

    def at(self, time: Any) -> Vec:
        """The course at a moment: a unit vector, world frame.

        Args:
            time: since the episode's start [s].
        """
        angle = self.heading + self.rate * time
        for moment, turn in zip(self.moments, self.turns, strict=True):
            angle = angle + jnp.where(time >= moment, turn, 0.0)
        sine, cosine = sincos(jnp.asarray(angle))
        return cosine, sine, jnp.zeros_like(sine)


def course_path(course: Course, time: jax.Array) -> jax.Array:
    """`[S, 3, lanes]` the course at moments `[S]` [s], world frame."""
    return jnp.stack(jax.vmap(course.at)(time), 1)
