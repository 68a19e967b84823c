"""Which boxes of a robot can meet, as the step looks for contacts among them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.engine.level import Level
from mjx_revolve.numerics.spatial import Mat, Vec, matvec, vadd
from mjx_revolve.numerics.xla import materialize

# Pairs of robots that differ which are looked at together. A choice.
_WIDTH = 256


class Boxes(NamedTuple):
    """Boxes on bodies, `[nshell, lanes]` or `[nshell, 1]` each, body frame.

    Attributes:
        position: of their centres [m].
        rotation: body from box; None where all boxes stand square on their bodies.
        half_size: half edges [m].
    """

    position: Vec
    rotation: Mat | None
    half_size: Vec

    @staticmethod
    def of(levels: Sequence[Level], dtype: Any) -> Boxes:
        """The shells of levels, one behind the other."""
        found = []
        every = [level.shells.rotation for level in levels if level.shells is not None]
        square = all(_is_identity(x) for x in every)
        for level in levels:
            if level.shells is not None:
                own = level.shells
                numbers = Boxes(own.position, None if square else own.rotation, own.half_size)
                found.append(jax.tree.map(partial(_flat, level, own.count, dtype), numbers))
        lanes = max(x.shape[-1] for x in jax.tree.leaves(found))
        wide = lambda x: jnp.broadcast_to(x, (len(x), lanes))  # noqa: E731
        joined: Boxes = jax.tree.map(lambda *x: jnp.concatenate(list(map(wide, x))), *found)
        return joined


def _is_identity(rotation: Mat) -> bool:
    """Whether a rotation is known to be none while it is traced."""
    return all(
        isinstance(x, float) and x == (i == j)
        for i, row in enumerate(rotation)
        for j, x in enumerate(row)
    )


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

    def centers(self, position: Vec, rotation: Mat) -> Vec:
        """`[nshell, lanes]` centres of the boxes [m], of `[nbody, lanes]` poses of the bodies."""
        lanes, own = position[0].shape[1], self.boxes.position
        counts = np.bincount(self.body, minlength=len(position[0]))
        if np.any(np.diff(self.body) < 0) or len(set(counts[1:].tolist())) > 1:
            position, rotation = jax.tree.map(lambda x: x[self.body], (position, rotation))
            return vadd(position, matvec(rotation, own))
        # Root and rows by themselves, box after box, as XLA:CPU has vectors for it.
        parts = []
        root, row = int(counts[0]), int(counts[-1])
        for bodies, start, n in (slice(0, 1), 0, root), (slice(1, None), root, row):
            if not n:
                continue
            at, turn = jax.tree.map(lambda x: x[bodies], (position, rotation))  # noqa: B023
            place = [x[start:][: n * len(at[0])].reshape(-1, n, x.shape[-1]) for x in own]
            each = [vadd(at, matvec(turn, tuple(x[:, k] for x in place))) for k in range(n)]
            parts.append([jnp.stack([materialize(x[i]) for x in each], 1) for i in range(3)])
        return tuple(
            materialize(jnp.concatenate([x.reshape(-1, lanes) for x in component]))
            for component in zip(*parts, strict=True)
        )

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
