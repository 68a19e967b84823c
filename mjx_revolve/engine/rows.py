"""Many different robots, row by row: how their step is traversed when trees differ lane by lane.

Every robot is a root and a list of rows, padded to a stated number (`batch` makes them): a row is a
moving body with a few of its parts; a body with more parts than a row holds gets riders, rows that
are rigidly fixed to it. Rows stand in preorder, the child with the largest subtree last. Sweeps
over the rows then need no list of parents, only a short stack: let a row's slot be the number of
edges on its way from the root that do not lead to a largest subtree, at most log2(rows). When a row
is reached in preorder, the slot of its parent still holds the parent's values, and when it is
reached backwards, its own slot has gathered the sums of just its children (cf. heavy paths: Sleator
& Tarjan 1983, A data structure for dynamic trees).

So the program, and the time to compile it, do not grow with the trees. The water's part is in the
loops, too: that of all rows at once would not fit into the first-level cache.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.engine.batch import Bodies, Capacity
from mjx_revolve.engine.level import Level, Thrusters
from mjx_revolve.numerics.spatial import Scalar
from mjx_revolve.numerics.xla import share_once
from mjx_revolve.water.world import World


@dataclass(frozen=True, eq=False)
class Rows:
    """Different robots for the step; see `levels.Levels` for what the two have in common.

    Attributes:
        world: around all of them.
        capacity: what the tables have room for.
        bodies: the tables.
    """

    world: World
    capacity: Capacity
    bodies: Bodies

    @property
    def root(self) -> Level:
        """Constants of the roots, `[1, lanes]`."""
        return self._constant(self.capacity.root, self.bodies.root)

    @property
    def rows(self) -> Level:
        """Constants of the rows, `[rows, 1, lanes]`."""
        return self._constant(self.capacity.row, self.bodies.rows)

    @staticmethod
    def _constant(constant: Level, varying: Level) -> Level:
        """A level with the numbers that are the same in all robots put in their places."""
        given = lambda c, x: jnp.asarray(x) if c is None and x is not None else c  # noqa: E731
        return jax.tree.map(given, constant, varying, is_leaf=lambda x: x is None)

    @property
    def thrusters(self) -> Thrusters:
        """Of the robots, `[nthruster, lanes]`."""
        return jax.tree.map(jnp.asarray, self.bodies.thrusters)

    @property
    def carries(self) -> bool:
        """Whether water may be carried along."""
        return self.capacity.carries

    @property
    def touches(self) -> bool:
        """Whether any body may touch the bed."""
        return self.capacity.root.points is not None or self.capacity.row.points is not None

    # What hinges are, row by row, and in each robot's order.

    def spread(self, hinges: jax.Array) -> jax.Array:
        """`[nhinge, lanes]` in each robot's order to `[rows, 1, lanes]`; 0 for no hinge."""
        padded = jnp.concatenate([hinges, jnp.zeros_like(hinges[:1])])
        return jnp.take_along_axis(padded, jnp.asarray(self.bodies.hinge), 0)[:, None]

    def split(self, rows: jax.Array) -> jax.Array:
        """`[rows, ...]` as the traversal has it."""
        return rows[:, None]

    def gather(self, values: jax.Array, like: jax.Array) -> jax.Array:
        """The way back from `spread`; 0 where a robot has fewer hinges than others."""
        rows = values[:, 0]
        padded = jnp.concatenate([rows, jnp.zeros_like(rows[:1])])
        return jnp.take_along_axis(padded, jnp.asarray(self.bodies.row), 0)

    # The traversal.

    def map(self, fun: Callable[..., Any], *xs: Any) -> Any:
        """What `fun` (level, a value of each of `xs`), element-wise, gives for all rows at once."""
        return fun(self.rows, *xs)

    def down(self, fun: Callable[..., Any], root: Any, *xs: Any) -> Any:
        """From the roots to the tips; see `Levels.down`."""
        root = self._wide(root)

        def visit(stack: list[Any], row: Any) -> tuple[list[Any], Any]:
            source, own, level, x = row
            value, keep = fun(level, _pick(stack, source), *x)
            return _put(stack, own, self._wide(value)), self._wide(keep)

        rows = (self.bodies.source, self.bodies.slot, self.rows, xs)
        return _sweep(visit, [root] * self.capacity.slots, rows)[1]

    def up(self, fun: Callable[..., Any], nothing: Any, *xs: Any) -> tuple[Any, Any, Any]:
        """From the tips to the roots; see `Levels.up`."""
        empty, sums = self._wide(nothing)

        def visit(carry: Any, row: Any) -> tuple[Any, Any]:
            stack, sums = carry
            source, own, inner, level, x = row
            # A slot that nobody has filled for this row holds what another row has left.
            gathered = jax.tree.map(lambda v: jnp.where(inner, v, 0), _pick(stack, own))
            value, keep, terms = fun(level, gathered, *x)
            stack = _give(stack, own, source, self._wide(value))
            return (stack, jax.tree.map(jnp.add, sums, terms)), self._wide(keep)

        rows = (self.bodies.source, self.bodies.slot, self.bodies.inner, self.rows, xs)
        carry = ([empty] * self.capacity.slots, sums)
        (stack, sums), kept = _sweep(visit, carry, rows, reverse=True)
        # Nobody has written into slot 0 where the root has no children.
        return stack[0], kept, jax.tree.map(lambda x: x[0], sums)

    def _wide(self, value: Any) -> Any:
        """Every number of one row as an array `[1, lanes]`."""
        lanes, dtype = self.bodies.slot.shape[-1], self.bodies.figure.length.dtype
        return jax.tree.map(lambda x: jnp.broadcast_to(jnp.asarray(x, dtype), (1, lanes)), value)


def _pick(stack: list[Any], slot: Scalar) -> Any:
    """What stands in a slot, lane by lane; anything where there is no such slot."""
    found = stack[0]
    for k in range(1, len(stack)):
        found = jax.tree.map(lambda a, b, k=k: jnp.where(slot == k, b, a), found, stack[k])
    return found


def _put(stack: list[Any], slot: Scalar, value: Any) -> list[Any]:
    """The stack with a value in a slot; unchanged where there is no such slot."""
    return [
        jax.tree.map(lambda a, b, k=k: jnp.where(slot == k, b, a), old, value)
        for k, old in enumerate(stack)
    ]


def _give(stack: list[Any], own: Scalar, to: Scalar, value: Any) -> list[Any]:
    """Adds a row's value to its parent's slot.

    A row that stands in its parent's own slot leads to the largest subtree and comes first on the
    way up: it replaces what stands there, the sums that it has itself taken in.
    """
    before = _pick(stack[:-1], to) if len(stack) > 1 else value
    summed = jax.tree.map(lambda new, old: new + jnp.where(to == own, 0, old), value, before)
    return _put(stack, to, summed)


def _sweep(
    body: Callable[[Any, Any], tuple[Any, Any]], carry: Any, rows: Any, reverse: bool = False
) -> tuple[Any, Any]:
    """A loop over rows.

    Args:
        body: (carry, row) → (carry, what to keep of the row).
        carry: before the first row.
        rows: leaves `[rows, ...]`, or plain numbers that all rows share.
        reverse: from the last row to the first.

    Returns:
        The carry behind the last row, and what was kept, leaves `[rows, ...]`.
    """
    leaves, tree = jax.tree.flatten(rows)
    moves = [isinstance(x, jax.Array | np.ndarray) for x in leaves]

    def visit(carry: Any, xs: Any) -> tuple[Any, Any]:
        rest = iter(xs)
        row = [next(rest) if moving else x for x, moving in zip(leaves, moves, strict=True)]
        return body(carry, jax.tree.unflatten(tree, row))

    moving = [x for x, moving in zip(leaves, moves, strict=True) if moving]
    return jax.lax.scan(share_once(visit), carry, moving, reverse=reverse)
