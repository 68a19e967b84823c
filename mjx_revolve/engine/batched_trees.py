"""The trees of many robots, row by row; the trees are arguments of the traced step.

Every robot is a root and a list of rows, padded to a fixed number (`batch` makes them): a row is a
moving body with a few of its parts; a body with more parts than a row holds has overflow rows,
which are rigidly fixed to it. Rows stand in preorder, the child with the largest subtree last.
Passes over the rows then need no list of parents, only a short stack: a row's slot is the number of
edges on its way from the root that do not lead to a largest subtree, at most log2(rows). When a row
is reached in preorder, the slot of its parent still holds the parent's values, and when it is
reached backwards, its own slot holds the sums of just its children (cf. heavy paths: Sleator
& Tarjan 1983, A data structure for dynamic trees).

So the program, and the time to compile it, do not grow with the trees. The water's part is in the
loops, too: that of all rows at once would not fit into the first-level cache. Loops end with the
rows of the largest robot.

Where all robots are alike, their tables hold that one body: constants are the same in all lanes,
and a slot is an index. Where they differ, a slot is a weight of 0 or 1 for each place in the stack,
lane by lane: XLA:CPU makes a branch of a choice between numbers in memory, and no vectors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.engine.batch import Capacity, PackedBodies
from mjx_revolve.engine.level import Level, Thrusters
from mjx_revolve.engine.meetings import Boxes, Meetings
from mjx_revolve.engine.variation import Variation, vary_level, vary_thrusters
from mjx_revolve.numerics.spatial import Scalar, Vec
from mjx_revolve.numerics.xla import fuse, materialize, take_lanes
from mjx_revolve.water.world import World


class StackIndices(NamedTuple):
    """Where rows read and write the stack, `[rows]` int32 where all robots are alike.

    Where they differ, slots are `[rows, slots, lanes]`, 1 for the slot and 0 for others.

    Attributes:
        own: slot of each row.
        parent: slot of its parent; the root's for padding.
        to: slot to which it adds: its parent's; none for padding.
        inner: `[rows]` or `[rows, lanes]` 1 where a row has children, else 0.
        apart: as `inner`, 1 where a row stands in another slot than its parent, else 0.
    """

    own: Any
    parent: Any
    to: Any
    inner: Any
    apart: Any


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PackedRow:
    """Numbers `[1, lanes]` side by side, so that they are copied as a whole.

    Attributes:
        data: `[n lanes]`, or those of all rows, `[rows, n lanes]`.
        tree: the structure that holds them.
    """

    data: Any
    tree: Any = field(metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class BatchedTrees:
    """Many robots as a `Tree`; its methods are described there.

    Joint values are `[rows, 1, lanes]`.

    Attributes:
        world: around all of them.
        capacity: the size of the tables.
        bodies: the tables.
        lanes: number of robots.
        stack_indices: of the rows.
        table: constants of the rows.
        count: number of rows to visit, a number or int32.
        met: which boxes of robots that differ can meet.
        variation: factors on the constants, or None.
    """

    world: World = field(metadata={"static": True})
    capacity: Capacity = field(metadata={"static": True})
    bodies: PackedBodies
    lanes: int = field(metadata={"static": True})
    stack_indices: StackIndices
    table: PackedConstants
    count: Any
    met: Meetings | None = None
    variation: Variation | None = None

    def with_variation(self, variation: Variation | None) -> BatchedTrees:
        """The same robots with other coefficients; None: with their own."""
        return self if variation is None else replace(self, variation=variation)

    def _own(self, level: Level) -> Level:
        """A level's constants with the variation."""
        return level if self.variation is None else vary_level(level, self.variation)

    @property
    def root(self) -> Level:
        """Constants of the roots, `[1, lanes]`."""
        return self._own(_merged(self.capacity.root, self.bodies.root))

    @property
    def _rows(self) -> Level:
        """Constants of the rows, `[rows, 1, lanes]`, without the variation."""
        return _merged(self.capacity.row, self.bodies.rows)

    @property
    def thrusters(self) -> Thrusters:
        """Of the robots, `[nthruster, lanes]`."""
        own = self.bodies.thrusters
        return own if self.variation is None else vary_thrusters(own, self.variation)

    @property
    def carries(self) -> bool:
        """Whether any part has added mass."""
        return self.capacity.carries

    @property
    def meets(self) -> bool:
        """Whether any boxes of a robot can meet."""
        return self.met is not None

    def meetings(self, like: jax.Array) -> Meetings:
        """Which boxes of the robots can meet."""
        assert self.met is not None
        return self.met

    @property
    def touches(self) -> bool:
        """Whether any body can touch the bed."""
        return self.capacity.root.points is not None or self.capacity.row.points is not None

    # Joint values, row by row and in each robot's order.

    def joints_to_tree(self, values: jax.Array) -> jax.Array:
        """`[rows, 1, lanes]` from each robot's order; 0 for no hinge."""
        padded = jnp.concatenate([values, jnp.zeros_like(values[:1])])
        return jnp.take_along_axis(padded, self.bodies.hinge, 0)[:, None]

    def split_rows(self, rows: jax.Array) -> jax.Array:
        """`[rows, 1, lanes]`."""
        return rows[:, None]

    def tree_to_joints(self, values: jax.Array, like: jax.Array) -> jax.Array:
        """`[nhinge, lanes]`; 0 where a robot has fewer hinges than others."""
        rows = values[:, 0]
        padded = jnp.concatenate([rows, jnp.zeros_like(rows[:1])])
        return jnp.take_along_axis(padded, self.bodies.row, 0)

    def join_rows(self, values: jax.Array, like: jax.Array) -> jax.Array:
        """`[rows, lanes]`."""
        return values[:, 0]

    def stack_saved(self, saved: PackedRow, select: Callable[[Any], Any], like: jax.Array) -> Any:
        """`[rows, lanes]` of selected saved values."""
        columns = saved.data.reshape(-1, saved.tree.num_leaves, self.lanes)
        return select(jax.tree.unflatten(saved.tree, list(jnp.moveaxis(columns, 1, 0))))

    def at_lanes(self, which: jax.Array | None) -> BatchedTrees:
        """A tree with fewer lanes; its constants are not those of the robots in them."""
        if which is None:
            return self
        indices = self.stack_indices
        if not self.bodies.alike:
            indices = jax.tree.map(lambda x: take_lanes(x, which), indices)
        return replace(self, lanes=len(which), stack_indices=indices, variation=None)

    def saved_at_lanes(
        self, saved: PackedRow, select: Callable[[Any], Any], which: jax.Array | None
    ) -> PackedRow:
        """Columns of selected saved values."""
        count = saved.tree.num_leaves
        leaves, tree = jax.tree.flatten(select(jax.tree.unflatten(saved.tree, range(count))))
        columns = saved.data.reshape(-1, count, self.lanes)
        found = [take_lanes(columns[:, k], which) for k in leaves]
        return PackedRow(jnp.concatenate(found, 1), tree)

    def hinge_positions(self, which: jax.Array | None) -> Vec:
        """Of each lane, or one for all."""
        hinges = self._rows.hinges
        assert hinges is not None
        shape = self.capacity.rows, 1, 1 if self.bodies.alike else self.lanes
        wide = lambda x: jnp.broadcast_to(jnp.asarray(x, self.table.data.dtype), shape)  # noqa: E731
        return tuple(
            wide(x) if self.bodies.alike else take_lanes(wide(x), which) for x in hinges.position
        )

    # Values of parts, group by group.

    def unstack_parts(self, groups: tuple[jax.Array, ...]) -> tuple[Any, ...]:
        """Part by part, `[1, lanes]` each."""
        return tuple(tuple(x[k] for k in range(x.shape[0])) for x in groups)

    def stack_parts(self, saved: PackedRow, select: Callable[[Any], Any]) -> tuple[Any, ...]:
        """`[rows, npart, 1, lanes]` of each group."""
        count = saved.tree.num_leaves
        columns = saved.data.reshape(-1, count, 1, self.lanes)
        groups = select(jax.tree.unflatten(saved.tree, range(count)))
        return tuple(columns[:, own[0] : own[-1] + 1] for own in groups)

    def fully_submerged(self, lanes: tuple[int, ...], dtype: Any) -> tuple[Any, Any]:
        """`[npart, 1, lanes]` of the root and `[rows, npart, 1, lanes]` of the rows."""
        count, axes = self.capacity.rows, 3 if self.world.near_surface else 1
        below = self._rows.at_first(axes, (1, *lanes), dtype)
        every = tuple(jnp.broadcast_to(x, (count, *x.shape)) for x in below)
        return self.root.at_first(axes, (1, *lanes), dtype), every

    # The passes.

    def map(self, fun: Callable[..., Any], *xs: Any) -> Any:
        """`fun` for all rows at once."""
        return fun(self._own(self._rows), *xs)

    def forward_pass(self, fun: Callable[..., Any], root: Any, *xs: Any) -> Any:
        """Row after row from the roots."""
        first = self._join(root)
        own, parent = self.stack_indices.own, self.stack_indices.parent

        def visit(k: Scalar, above: PackedRow) -> tuple[Any, Any]:
            return fun(self._own(self.table.row(k)), self._part(above), *self._row(xs, k))

        def read(k: Scalar, stack: Any) -> PackedRow:
            return replace(first, data=self._pick(stack, _at(parent, k)))

        def write(k: Scalar, stack: Any, value: Any) -> Any:
            return self._put(stack, _at(own, k), self._join(value).data)

        return self._sweep(visit, read, write, self._stack(first.data))[1]

    def backward_pass(self, fun: Callable[..., Any], zero: Any, *xs: Any) -> tuple[Any, Any, Any]:
        """Row after row from the tips."""
        empty, sums = map(self._join, zero)
        own, _, to, inner, apart = self.stack_indices

        def visit(k: Scalar, gathered: PackedRow) -> tuple[Any, Any]:
            level = self._own(self.table.row(k))
            value, keep, terms = fun(level, self._part(gathered), *self._row(xs, k))
            return (value, terms), keep

        def read(k: Scalar, carry: Any) -> PackedRow:
            # A slot that is not filled for this row holds values of another row.
            return replace(empty, data=self._pick(carry[0], _at(own, k), _at(inner, k)))

        def write(k: Scalar, carry: Any, found: Any) -> Any:
            stack, sums = carry
            value, terms = (self._join(x).data for x in found)
            # A row in its parent's own slot leads to the largest subtree and comes first: it
            # replaces the sums there, which it has read itself.
            return self._put(stack, _at(to, k), value, _at(apart, k)), sums + terms

        carry = self._stack(empty.data), sums.data
        (stack, found), kept = self._sweep(visit, read, write, carry, reverse=True)
        # Slot 0 is unwritten where the root has no children.
        gathered = self._part(replace(empty, data=stack[0]))
        found = self._part(replace(sums, data=found))
        return gathered, kept, jax.tree.map(lambda x: x[0], found)

    def _sweep(self, visit: Any, read: Any, write: Any, carry: Any, reverse: bool = False) -> Any:
        """A loop over rows: the carry behind the last row, and the saved values.

        Args:
            visit: (row, input) → (output, values to save).
            read: (row, carry) → input of the row.
            write: (row, carry, output of the row) → carry.
            carry: before the first row.
            reverse: from the last row to the first.
        """
        visit = jax.jit(visit)  # so that it is traced once
        zero = jnp.int32(0)
        joined = jax.eval_shape(lambda x: self._join(visit(zero, read(zero, x))[1]), carry)
        kept = replace(
            joined, data=jnp.zeros((self.capacity.rows, *joined.data.shape), joined.data.dtype)
        )
        visit = fuse(visit, inline=True)

        def step(i: Scalar, found: tuple[Any, Any]) -> tuple[Any, Any]:
            carry, kept = found
            k = self.count - 1 - i if reverse else i
            # A copy of what is read, as it is overwritten before its last use.
            value, keep = visit(k, jax.tree.map(materialize, read(k, carry)))
            data = jax.lax.dynamic_update_index_in_dim(kept.data, self._join(keep).data, k, 0)
            return write(k, carry, value), replace(kept, data=data)

        carry, kept = jax.lax.fori_loop(0, self.count, step, (carry, kept))
        if kept.tree.num_leaves == 1:
            return carry, jax.tree.unflatten(kept.tree, [kept.data[:, None]])
        return carry, kept

    # Numbers of a row side by side.

    def _join(self, value: Any) -> PackedRow:
        leaves, tree = jax.tree.flatten(value)
        dtype = self.table.data.dtype
        wide = [jnp.broadcast_to(jnp.asarray(x, dtype), (1, self.lanes))[0] for x in leaves]
        # Without copies, XLA computes these number by number, behind a branch.
        if not wide:
            return PackedRow(jnp.zeros(0, dtype), tree)
        return PackedRow(materialize(jnp.concatenate(list(map(materialize, wide)))), tree)

    def _part(self, joined: PackedRow) -> Any:
        rows = joined.data.reshape(-1, self.lanes)
        return jax.tree.unflatten(joined.tree, [rows[k : k + 1] for k in range(len(rows))])

    def _row(self, xs: Any, k: Scalar) -> Any:
        """The values of a row of each of `xs`."""

        def pick(x: Any) -> Any:
            return self._part(replace(x, data=_at(x.data, k))) if packed(x) else _at(x, k)

        packed = lambda x: isinstance(x, PackedRow)  # noqa: E731
        return jax.tree.map(pick, xs, is_leaf=packed)

    # The stack of values for children or for a parent: rows of it, or a list of `[n, lanes]`.

    def _stack(self, first: jax.Array) -> Any:
        if self.bodies.alike:
            return jnp.broadcast_to(first, (self.capacity.slots, *first.shape))
        return [first.reshape(-1, self.lanes)] * self.capacity.slots

    def _pick(self, stack: Any, slot: Any, share: Any = 1.0) -> jax.Array:
        """A share of a slot's value."""
        if self.bodies.alike:
            return share * _at(stack, slot)
        found = slot[0] * stack[0]
        for k in range(1, len(stack)):
            found = found + slot[k] * stack[k]
        return share * found

    def _put(self, stack: Any, slot: Any, value: jax.Array, share: Any = 0.0) -> Any:
        """The stack with a value in a slot, added to a share of its former value."""
        if self.bodies.alike:
            if not isinstance(share, float):
                value = value + share * _at(stack, slot)
            return jax.lax.dynamic_update_index_in_dim(stack, value, slot, 0)
        value = value.reshape(-1, self.lanes)
        return [(1 - slot[k] + slot[k] * share) * x + slot[k] * value for k, x in enumerate(stack)]


class PackedConstants(NamedTuple):
    """Constants of rows side by side.

    Attributes:
        data: `[rows, n]` of floating-point type.
        rest: `[rows, ...]` each, of other types.
        shapes: of the leaves of a row, in order; None for what is not in `data`.
        same: the leaves that are the same in all rows; None for what is in `rest`.
        tree: the structure of all leaves.
    """

    data: jax.Array
    rest: list[jax.Array]
    shapes: list[Any]
    same: list[Any]
    tree: Any

    @staticmethod
    def of(level: Level) -> PackedConstants:
        """The table of `[rows, ...]` constants."""
        leaves, tree = jax.tree.flatten(level)
        arrays = [x for x in leaves if isinstance(x, jax.Array)]
        wide = lambda x: isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jnp.floating)  # noqa: E731
        return PackedConstants(
            jnp.concatenate([x.reshape(x.shape[0], -1) for x in arrays if wide(x)], 1),
            [x for x in arrays if not wide(x)],
            [x.shape[1:] if wide(x) else None for x in leaves],
            [None if isinstance(x, jax.Array) else x for x in leaves],
            tree,
        )

    def row(self, k: Scalar) -> Level:
        """The constants of a row."""
        flat, start, rest, found = _at(self.data, k), 0, iter(self.rest), []
        for shape, same in zip(self.shapes, self.same, strict=True):
            if shape is not None:
                size = int(np.prod(shape))
                found.append(flat[start : start + size].reshape(shape))
                start += size
            else:
                found.append(_at(next(rest), k) if same is None else same)
        return jax.tree.unflatten(self.tree, found)


def make_batched_trees(
    world: World, capacity: Capacity, bodies: PackedBodies, lanes: int, steady: bool = False
) -> BatchedTrees:
    """Many robots for the step, from their tables.

    Args:
        world: around all of them.
        capacity: the size of the tables.
        bodies: the tables, of `lanes` robots, or of one robot for all lanes.
        lanes: number of robots.
        steady: whether padding is visited, too: derivatives need loops of known length.

    Returns:
        The trees.
    """
    bodies = jax.tree.map(jnp.asarray, bodies)
    rows = _merged(capacity.row, bodies.rows)
    table = PackedConstants.of(rows)
    number = lambda x: x.astype(table.data.dtype)  # noqa: E731
    own, to = bodies.slot, bodies.source
    parent = jnp.maximum(to, 0)
    inner, apart = number(bodies.inner), number(own != to)
    count = capacity.rows if steady else jnp.max(bodies.count)
    if bodies.alike:
        own, parent, inner, apart = (x[:, 0] for x in (own, parent, inner, apart))
        stack_indices = StackIndices(own, parent, parent, inner, apart)
    else:
        each = jnp.arange(capacity.slots)[:, None]
        own, parent, to = (number(x[:, None] == each) for x in (own, parent, to))
        stack_indices = StackIndices(own, parent, to, inner, apart)
    met = None
    if capacity.meetings:
        rows = rows if rows.shells is None else replace(rows, count=capacity.rows)
        boxes = Boxes.of((_merged(capacity.root, bodies.root), rows), table.data.dtype)
        body = np.append(
            np.zeros(capacity.root_shells, int),
            np.repeat(np.arange(1, capacity.rows + 1), capacity.shells),
        )
        met = Meetings.of(boxes, body, bodies.first, bodies.second, bodies.rest)
    return BatchedTrees(world, capacity, bodies, lanes, stack_indices, table, count, met)


def _merged(constant: Level, varying: Level) -> Level:
    """A level of the numbers that are the same in all robots and of those that are not."""
    given = lambda c, x: jnp.asarray(x) if c is None and x is not None else c  # noqa: E731
    return jax.tree.map(given, constant, varying, is_leaf=lambda x: x is None)


def _at(xs: jax.Array, k: Scalar) -> jax.Array:
    """One row of many."""
    return jax.lax.dynamic_index_in_dim(xs, k, 0, keepdims=False)
