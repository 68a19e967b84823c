"""Which boxes of a robot can meet, as the step looks for contacts among them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.engine.level import Level
from mjx_revolve.numerics.spatial import Mat, Vec, dot


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
        every = [(level, level.shells) for level in levels if level.shells is not None]
        square = all(_is_identity(own.rotation) for _, own in every)
        for level, own in every:
            numbers = Boxes(own.position, None if square else own.rotation, own.half_size)
            found.append(jax.tree.map(partial(_flat, level, own.count, dtype), numbers))
        lanes = max(x.shape[-1] for x in jax.tree.leaves(found))
        wide = lambda x: jnp.broadcast_to(x, (len(x), lanes))  # noqa: E731
        return jax.tree.map(lambda *x: jnp.concatenate(list(map(wide, x))), *found)


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
    """Pairs of boxes of a robot that can meet, `[npair, lanes]`, or `[npair, 1]` of robots alike.

    Boxes are the shells of the levels, the root's first.

    Attributes:
        lanes: of the shapes: 1 of robots alike.
        shapes: `[n, nshell lanes]` the numbers of `Boxes` side by side, and last the radius of each
            one's bounding sphere [m]: one loop finds all of a box.
        body: `[nshell]` the body of each: 0 is the root, k + 1 the tree's row k; NumPy's.
        first: the one box of each pair, int32.
        second: the other box; the same one for padding, which stands behind all pairs.
        rest: by how much the boxes of each pair overlap at rest [m].
        count: `[lanes]` or `[1]` how many pairs a robot has, int32.
        halves: `[nshell, 5]` the module of each, the way to its right and its middle along that
            way, body frame [m]; None in `BatchedTrees`.
    """

    lanes: int
    shapes: Any
    body: np.ndarray
    first: Any
    second: Any
    rest: Any
    count: Any
    halves: np.ndarray | None = None

    @property
    def steady(self) -> bool:
        """Whether loops have a known length: in a `SingleTree` XLA:CPU aborts over others."""
        return self.halves is not None

    @staticmethod
    def of(
        boxes: Boxes,
        body: np.ndarray,
        first: Any,
        second: Any,
        rest: Any,
        halves: np.ndarray | None = None,
    ) -> Meetings:
        """Of pairs of shells."""
        radius = jnp.sqrt(dot(boxes.half_size, boxes.half_size))
        count = (first != second).sum(0).astype(np.int32)
        shapes = jnp.stack([x.reshape(-1) for x in (*jax.tree.leaves(boxes), radius)])
        return Meetings(radius.shape[1], shapes, body, first, second, rest, count, halves)
