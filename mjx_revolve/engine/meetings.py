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

# Pairs of robots that differ which are looked at together. A choice.
_WIDTH = 256


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
    """Pairs of boxes that can meet, of all robots: in blocks, as the step looks at them.

    Boxes are the shells of the levels, the root's first; box k of robot r has the number
    k · lanes + r.

    Attributes:
        boxes: their shapes; of one lane where robots are alike.
        body: `[nshell]` the body of each: 0 is the root, k + 1 the tree's row k; NumPy's.
        first: `[nblock, width]` the one box of each pair, int32.
        second: the other box; the same one for padding. A robot's pairs stand in its own order.
        count: how many blocks to look at, a number or int32.
    """

    boxes: Boxes
    body: np.ndarray
    first: Any
    second: Any
    count: Any

    @property
    def steady(self) -> bool:
        """Whether loops are to have a known length, so that they have derivatives."""
        return isinstance(self.count, int)

    def at_bodies(self, x: jax.Array) -> jax.Array:
        """`[nshell, lanes]` of each box's body, of `[nbody, lanes]`."""
        counts = np.bincount(self.body, minlength=len(x))
        if np.any(np.diff(self.body) < 0) or len(set(counts[1:].tolist())) > 1:
            return x[self.body]
        # As XLA:CPU has vectors for it.
        lanes, each = x.shape[1], [counts[0], *counts[1:2]]
        parts = [
            jnp.broadcast_to(rows[:, None], (len(rows), n, lanes)).reshape(-1, lanes)
            for rows, n in zip((x[:1], x[1:]), each, strict=False)
        ]
        return jnp.concatenate(parts)

    @staticmethod
    def alike(
        boxes: Boxes, body: np.ndarray, first: Any, second: Any, count: Any, lanes: int
    ) -> Meetings:
        """Of robots that are all alike, from `[npair, 1]` shells: a block for each pair."""
        lane = np.arange(lanes, dtype=np.int32)
        return Meetings(boxes, body, first * lanes + lane, second * lanes + lane, count)

    @staticmethod
    def different(
        boxes: Boxes, body: np.ndarray, first: jax.Array, second: jax.Array, steady: bool
    ) -> Meetings:
        """Of robots with pairs of their own, from `[npair, lanes]` shells: one list of all pairs.

        `steady` says whether loops are to have a known length.
        """
        lanes = first.shape[1]
        real = (first != second).reshape(-1)
        place = jnp.where(real, jnp.cumsum(real, dtype=jnp.int32) - 1, 2 * len(real) + _WIDTH)
        lane = jnp.arange(lanes, dtype=jnp.int32)

        def listed(shell: jax.Array) -> jax.Array:
            number = (shell * lanes + lane).reshape(-1)
            found = jnp.zeros(-(-len(real) // _WIDTH) * _WIDTH, jnp.int32)
            return found.at[place].set(number, mode="drop").reshape(-1, _WIDTH)

        one, other = listed(first), listed(second)
        count = -(-jnp.sum(real, dtype=jnp.int32) // _WIDTH)
        return Meetings(boxes, body, one, other, len(one) if steady else count)
