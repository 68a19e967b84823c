"""Which boxes of a robot can meet, as the step looks for contacts among them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.engine.level import Level
from mjx_revolve.numerics.spatial import Mat, Vec


class Boxes(NamedTuple):
    """Boxes on bodies, `[nshell, lanes]` or `[nshell, 1]` each, body frame.

    Attributes:
        position: of their centres [m].
        rotation: body from box.
        half_size: half edges [m].
    """

    position: Vec
    rotation: Mat
    half_size: Vec

    @staticmethod
    def of(levels: Sequence[Level], dtype: Any) -> Boxes:
        """The shells of levels, one behind the other."""
        found = []
        for level in levels:
            if level.shells is not None:
                own = level.shells
                numbers = Boxes(own.position, own.rotation, own.half_size)
                found.append(jax.tree.map(partial(_flat, level, own.count, dtype), numbers))
        lanes = max(x.shape[-1] for x in jax.tree.leaves(found))
        wide = lambda x: jnp.broadcast_to(x, (len(x), lanes))  # noqa: E731
        joined: Boxes = jax.tree.map(lambda *x: jnp.concatenate(list(map(wide, x))), *found)
        return joined


def _flat(level: Level, count: int, dtype: Any, x: Any) -> jax.Array:
    """`[nshell nbody, lanes]` of `[nshell, nbody, lanes]`, or of such of rows, or of a number."""
    x = jnp.asarray(x, dtype)
    if x.ndim < 3:
        x = jnp.broadcast_to(x, (count, level.count, 1))
    return x.reshape(-1, x.shape[-1])


class Meetings(NamedTuple):
    """Pairs of boxes that can meet: of the shells of the levels, the root's first.

    Attributes:
        body: `[nshell]` the body of each: 0 is the root, k + 1 the tree's row k; NumPy's.
        first: `[npair, lanes]` or `[npair, 1]` the one box of each pair, int32.
        second: the other box; the same one where a robot has no further pairs.
        count: how many pairs to look at, a number or int32.
    """

    body: np.ndarray
    first: Any
    second: Any
    count: Any
