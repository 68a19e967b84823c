"""Many robots, row by row: how their step is traversed when trees are not known in advance.

Every robot is a root and a list of rows, padded to a stated number (`batch` makes them): a row is a
moving body with a few of its parts; a body with more parts than a row holds gets riders, rows that
are rigidly fixed to it. Rows stand in preorder, the child with the largest subtree last. Sweeps
over the rows then need no list of parents, only a short stack: let a row's slot be the number of
edges on its way from the root that do not lead to a largest subtree, at most log2(rows). When a row
is reached in preorder, the slot of its parent still holds the parent's values, and when it is
reached backwards, its own slot has gathered the sums of just its children (cf. heavy paths: Sleator
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
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.engine.batch import Bodies, Capacity
from mjx_revolve.engine.level import Level, Thrusters
from mjx_revolve.engine.variation import Variation, vary_level
from mjx_revolve.numerics.spatial import Scalar
from mjx_revolve.numerics.xla import share_once, store
from mjx_revolve.water.world import World


class Ports(NamedTuple):
    """Where rows stand in the stack: what is taken from there and put there.

    Attributes:
        own: slot of each row: `[rows]` int32 where all robots are alike, else `[rows, slots,
            lanes]` 1 for the slot and 0 for others.
        parent: that of its parent, likewise; the root's for padding.
        to: where it adds up, likewise: its parent's; nowhere for padding.
        inner: `[rows]` or `[rows, lanes]` 1 where a row has children, else 0.
        apart: likewise, 1 where a row stands in another slot than its parent, else 0.
    """

    own: Any
    parent: Any
    to: Any
    inner: Any
    apart: Any


@partial(jax.tree_util.register_dataclass, data_fields=["data"], meta_fields=["tree"])
@dataclass(frozen=True)
class Joined:
    """Numbers `[1, lanes]` side by side: what is copied as a whole is copied fast.

    Attributes:
        data: `[n lanes]`, or those of all rows, `[rows, n lanes]`.
        tree: how they hang together.
    """

    data: Any
    tree: Any


@dataclass(frozen=True, eq=False)
class Rows:
    """Many robots for the step; see `levels.Levels` for what the two have in common.

    Attributes:
        world: around all of them.
        capacity: what the tables have room for.
        bodies: the tables.
        lanes: how many robots stand side by side.
        ports: of the rows.
        table: constants of the rows.
        count: how many rows to visit, a number or int32.
        variation: factors on the constants, or None.
    """

    world: World
    capacity: Capacity
    bodies: Bodies
    lanes: int
    ports: Ports
    table: _Table
    count: Any
    variation: Variation | None = None

    def varied(self, variation: Variation) -> Rows:
        """The same robots with other coefficients, traced ones."""
        return replace(self, variation=variation)

    def _own(self, level: Level) -> Level:
        """A level's constants, varied if need be."""
        return level if self.variation is None else vary_level(level, self.variation)

    @property
    def root(self) -> Level:
        """Constants of the roots, `[1, lanes]`."""
        return self._own(_whole(self.capacity.root, self.bodies.root))

    @property
    def thrusters(self) -> Thrusters:
        """Of the robots, `[nthruster, lanes]`."""
        return self.bodies.thrusters

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
        return jnp.take_along_axis(padded, self.bodies.hinge, 0)[:, None]

    def split(self, rows: jax.Array) -> jax.Array:
        """`[rows, ...]` as the traversal has it."""
        return rows[:, None]

    def gather(self, values: jax.Array, like: jax.Array) -> jax.Array:
        """The way back from `spread`; 0 where a robot has fewer hinges than others."""
        rows = values[:, 0]
        padded = jnp.concatenate([rows, jnp.zeros_like(rows[:1])])
        return jnp.take_along_axis(padded, self.bodies.row, 0)

    def merge(self, values: jax.Array, like: jax.Array) -> jax.Array:
        """The way back from `split`."""
        return values[:, 0]

    def lay_out(self, kept: Joined, which: Callable[[Any], Any], like: jax.Array) -> Any:
        """What `which` takes of a value that `down` has kept, each number as `merge` has it."""
        return which(self.unfold(kept))

    # What parts are, group by group.

    def set_apart(self, groups: tuple[jax.Array, ...]) -> tuple[Any, ...]:
        """`[npart, 1, lanes]` of groups, as a traversal keeps them: part by part."""
        return tuple(tuple(x[k] for k in range(x.shape[0])) for x in groups)

    def put_together(self, kept: Joined, which: Callable[[Any], Any]) -> tuple[Any, ...]:
        """The way back: `[rows, npart, 1, lanes]` of what `which` takes of a value."""
        count = kept.tree.num_leaves
        columns = kept.data.reshape(-1, count, 1, self.lanes)
        groups = which(jax.tree.unflatten(kept.tree, range(count)))
        return tuple(columns[:, own[0] : own[-1] + 1] for own in groups)

    def unfold(self, kept: Joined) -> Any:
        """What `down` has kept, `[rows, lanes]` each."""
        columns = kept.data.reshape(-1, kept.tree.num_leaves, self.lanes)
        return jax.tree.unflatten(kept.tree, list(jnp.moveaxis(columns, 1, 0)))

    def all_wet(self, lanes: tuple[int, ...], dtype: Any) -> tuple[Any, Any]:
        """`State.wet` of parts that are wholly under water."""
        row, count = _whole(self.capacity.row, self.bodies.rows), self.capacity.rows
        root = tuple(jnp.ones((n, 1, *lanes), dtype) for n in self.root.carrying)
        return root, tuple(jnp.ones((count, n, 1, *lanes), dtype) for n in row.carrying)

    # The traversal.

    def map(self, fun: Callable[..., Any], *xs: Any) -> Any:
        """What `fun`, element-wise, gives for all rows at once; see `Levels.map`."""
        return fun(self._own(_whole(self.capacity.row, self.bodies.rows)), *xs)

    def down(self, fun: Callable[..., Any], root: Any, *xs: Any) -> Any:
        """From the roots to the tips; see `Levels.down`."""
        first = self._join(root)
        own, parent = self.ports.own, self.ports.parent

        def visit(k: Scalar, above: Joined) -> tuple[Any, Any]:
            return fun(self._own(self.table.row(k)), self._part(above), *self._row(xs, k))

        def read(k: Scalar, stack: Any) -> Joined:
            return replace(first, data=self._pick(stack, _at(parent, k)))

        def write(k: Scalar, stack: Any, value: Any) -> Any:
            return self._put(stack, _at(own, k), self._join(value).data)

        return self._sweep(visit, read, write, self._stack(first.data))[1]

    def up(self, fun: Callable[..., Any], nothing: Any, *xs: Any) -> tuple[Any, Any, Any]:
        """From the tips to the roots; see `Levels.up`."""
        empty, sums = map(self._join, nothing)
        own, _, to, inner, apart = self.ports

        def visit(k: Scalar, gathered: Joined) -> tuple[Any, Any]:
            level = self._own(self.table.row(k))
            value, keep, terms = fun(level, self._part(gathered), *self._row(xs, k))
            return (value, terms), keep

        def read(k: Scalar, carry: Any) -> Joined:
            # A slot that nobody has filled for this row holds what another row has left.
            return replace(empty, data=self._pick(carry[0], _at(own, k), _at(inner, k)))

        def write(k: Scalar, carry: Any, found: Any) -> Any:
            stack, sums = carry
            value, terms = (self._join(x).data for x in found)
            # A row that stands in its parent's own slot leads to the largest subtree and comes
            # first: it replaces what stands there, the sums that it has itself taken in.
            return self._put(stack, _at(to, k), value, _at(apart, k)), sums + terms

        carry = self._stack(empty.data), sums.data
        (stack, found), kept = self._sweep(visit, read, write, carry, reverse=True)
        # Nobody has written into slot 0 where the root has no children.
        gathered = self._part(replace(empty, data=stack[0]))
        found = self._part(replace(sums, data=found))
        return gathered, kept, jax.tree.map(lambda x: x[0], found)

    def _sweep(self, visit: Any, read: Any, write: Any, carry: Any, reverse: bool = False) -> Any:
        """A loop over rows.

        Args:
            visit: (row, what `read` gives) → (what `write` takes, what to keep).
            read: (row, carry) → what the row is given.
            write: (row, carry, what the row has made) → carry.
            carry: before the first row.
            reverse: from the last row to the first.

        Returns:
            The carry behind the last row, and what was kept.
        """
        visit = jax.jit(visit)  # so that it is traced once
        zero = jnp.int32(0)
        joined = jax.eval_shape(lambda x: self._join(visit(zero, read(zero, x))[1]), carry)
        kept = replace(
            joined, data=jnp.zeros((self.capacity.rows, *joined.data.shape), joined.data.dtype)
        )
        visit = share_once(visit)

        def step(i: Scalar, found: tuple[Any, Any]) -> tuple[Any, Any]:
            carry, kept = found
            k = self.count - 1 - i if reverse else i
            # A copy of what is read, as it is written over while others still want it.
            value, keep = visit(k, jax.tree.map(store, read(k, carry)))
            data = jax.lax.dynamic_update_index_in_dim(kept.data, self._join(keep).data, k, 0)
            return write(k, carry, value), replace(kept, data=data)

        carry, kept = jax.lax.fori_loop(0, self.count, step, (carry, kept))
        if kept.tree.num_leaves == 1:
            return carry, jax.tree.unflatten(kept.tree, [kept.data[:, None]])
        return carry, kept

    # Numbers of a row side by side.

    def _join(self, value: Any) -> Joined:
        leaves, tree = jax.tree.flatten(value)
        dtype = self.table.data.dtype
        wide = [jnp.broadcast_to(jnp.asarray(x, dtype), (1, self.lanes))[0] for x in leaves]
        # What is still to be computed would be so number by number, behind a branch.
        joined = store(jnp.concatenate([store(x) for x in wide])) if wide else jnp.zeros(0, dtype)
        return Joined(joined, tree)

    def _part(self, joined: Joined) -> Any:
        rows = joined.data.reshape(-1, self.lanes)
        return jax.tree.unflatten(joined.tree, [rows[k : k + 1] for k in range(len(rows))])

    def _row(self, xs: Any, k: Scalar) -> Any:
        """What belongs to a row of each of `xs`."""

        def pick(x: Any) -> Any:
            return (
                self._part(replace(x, data=_at(x.data, k))) if isinstance(x, Joined) else _at(x, k)
            )

        return jax.tree.map(pick, xs, is_leaf=lambda x: isinstance(x, Joined))

    # Where values wait for children or for a parent: rows of the stack, or a list `[n, lanes]`.

    def _stack(self, first: jax.Array) -> Any:
        if self.bodies.alike:
            return jnp.broadcast_to(first, (self.capacity.slots, *first.shape))
        return [first.reshape(-1, self.lanes)] * self.capacity.slots

    def _pick(self, stack: Any, slot: Any, share: Any = 1.0) -> jax.Array:
        """A share of what stands in a slot."""
        if self.bodies.alike:
            return share * _at(stack, slot)
        found = slot[0] * stack[0]
        for k in range(1, len(stack)):
            found = found + slot[k] * stack[k]
        return share * found

    def _put(self, stack: Any, slot: Any, value: jax.Array, share: Any = 0.0) -> Any:
        """The stack with a value in a slot, and a share of what stands there."""
        if self.bodies.alike:
            if not isinstance(share, float):
                value = value + share * _at(stack, slot)
            return jax.lax.dynamic_update_index_in_dim(stack, value, slot, 0)
        value = value.reshape(-1, self.lanes)
        return [(1 - slot[k] + slot[k] * share) * x + slot[k] * value for k, x in enumerate(stack)]


class _Table(NamedTuple):
    """Constants of rows side by side.

    Attributes:
        data: `[rows, n]` of floating-point type.
        rest: `[rows, ...]` each, of other types.
        shapes: in the order of the leaves, those of a row; None for what is not in `data`.
        same: likewise, numbers that are the same in all rows; None for what is in `rest`.
        tree: of all leaves.
    """

    data: jax.Array
    rest: list[jax.Array]
    shapes: list[Any]
    same: list[Any]
    tree: Any

    @staticmethod
    def of(level: Level) -> _Table:
        """The table of `[rows, ...]` constants."""
        leaves, tree = jax.tree.flatten(level)
        arrays = [isinstance(x, jax.Array) for x in leaves]
        pairs = list(zip(leaves, arrays, strict=True))
        wide = [a and jnp.issubdtype(x.dtype, jnp.floating) for x, a in pairs]
        chosen = [x.reshape(x.shape[0], -1) for x, w in zip(leaves, wide, strict=True) if w]
        return _Table(
            jnp.concatenate(chosen, 1),
            [x for (x, a), w in zip(pairs, wide, strict=True) if a and not w],
            [x.shape[1:] if w else None for x, w in zip(leaves, wide, strict=True)],
            [None if a else x for x, a in pairs],
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


def make_rows(
    world: World, capacity: Capacity, bodies: Bodies, lanes: int, steady: bool = False
) -> Rows:
    """Many robots for the step, from their tables.

    Args:
        world: around all of them.
        capacity: what the tables have room for.
        bodies: the tables, of as many robots as there are lanes, or of one that they all are.
        lanes: how many robots stand side by side.
        steady: whether padding is visited, too: derivatives ask for loops of known length.

    Returns:
        The robots.
    """
    bodies = jax.tree.map(jnp.asarray, bodies)
    table = _Table.of(_whole(capacity.row, bodies.rows))
    number = lambda x: x.astype(table.data.dtype)  # noqa: E731
    own, to = bodies.slot, bodies.source
    parent = jnp.maximum(to, 0)
    inner, apart = number(bodies.inner), number(own != to)
    count = capacity.rows if steady else jnp.max(bodies.count)
    if bodies.alike:
        own, parent, inner, apart = (x[:, 0] for x in (own, parent, inner, apart))
        ports = Ports(own, parent, parent, inner, apart)
    else:
        each = jnp.arange(capacity.slots)[:, None]
        own, parent, to = (number(x[:, None] == each) for x in (own, parent, to))
        ports = Ports(own, parent, to, inner, apart)
    return Rows(world, capacity, bodies, lanes, ports, table, count)


def _whole(constant: Level, varying: Level) -> Level:
    """A level with the numbers that are the same in all robots put in their places."""
    given = lambda c, x: jnp.asarray(x) if c is None and x is not None else c  # noqa: E731
    return jax.tree.map(given, constant, varying, is_leaf=lambda x: x is None)


def _at(xs: jax.Array, k: Scalar) -> jax.Array:
    """One row of many."""
    return jax.lax.dynamic_index_in_dim(xs, k, 0, keepdims=False)
