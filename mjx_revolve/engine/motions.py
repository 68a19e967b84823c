"""Where all rigid bodies of robots are and how they move, for those who look at more than the core.

One sweep over the body; nothing of it is done where nobody asks.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mjx_revolve.engine.dynamics import Bodies, move_bodies
from mjx_revolve.engine.state import State
from mjx_revolve.numerics.inertia import Motion


def motions_of(bodies: Bodies, state: State) -> Motion:
    """Where rigid bodies are and how they move.

    Args:
        bodies: the robots.
        state: the population.

    Returns:
        Of the core's rigid body, then of what each hinge carries, in the order of `bodies.merge`:
        `[1 + nhinge, lanes]` each, velocities over ground. Each body's frame lies at its hinge and
        has the hinge's axis for its z (see `level`).
    """
    like = state.position[0]
    root, moved, _ = move_bodies(bodies, state, True, 0.0)
    wide = lambda x: jnp.broadcast_to(x, (1, *like.shape))  # noqa: E731
    own = jax.tree.map(wide, root.motion)
    below = bodies.lay_out(moved, lambda kept: kept[0].motion, like)
    if below is None:
        return own
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), own, below)
