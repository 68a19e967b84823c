"""The tree of one robot, level by level: how its step is traversed when the tree is known.

Known, that is, while the step is traced. Bodies at equal depth are stacked on the first axis, so
one operation moves all of them. `rows` has the traversal of many different robots, behind the same
functions.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.engine.columns import Columns, pick_level, read_columns
from mjx_revolve.engine.level import Laws, Level, Thrusters
from mjx_revolve.engine.model_changes import changed_assembly, changed_columns
from mjx_revolve.engine.robot import Robot
from mjx_revolve.engine.thrusters import read_thrusters
from mjx_revolve.engine.variation import Variation, vary_level
from mjx_revolve.numerics.spatial import add, fold, total
from mjx_revolve.water.world import World


@dataclass(frozen=True, eq=False)
class Levels:
    """One robot for the step; see `rows.Rows` for what the two have in common.

    Attributes:
        world: around it.
        root: constants of the root, numbers or `[1, 1]`.
        below: of the levels below it, numbers or `[nbody, 1]`.
        parents: of each level below, where each body's parent stands in the level above.
        bodies: `[level][nbody]` MuJoCo ids, the root's level first.
        frames: `[nbody, 3, 3]` of each level, MuJoCo's body frame from ours.
        part_rows: `[level][group][npart, nbody]` rows of the fluid table, -1 for padding.
        point_rows: `[level][npoint, nbody]` of the assembly's points, likewise.
        hinge_order: `[nhinge]` where the hinges, level by level, stand in the robot's own order.
        thrusters: of the robot.
        carries: whether water is carried along by any part.
        robot: the source.
    """

    world: World
    root: Level
    below: tuple[Level, ...]
    parents: tuple[tuple[int, ...], ...]
    bodies: tuple[tuple[int, ...], ...]
    frames: tuple[np.ndarray, ...]
    part_rows: tuple[tuple[np.ndarray, ...], ...]
    point_rows: tuple[np.ndarray, ...]
    hinge_order: np.ndarray
    thrusters: Thrusters
    carries: bool
    robot: Robot

    @property
    def all(self) -> tuple[Level, ...]:
        """The root's level and those below."""
        return (self.root, *self.below)

    @property
    def touches(self) -> bool:
        """Whether any body may touch the bed."""
        return any(level.points is not None for level in self.all)

    def varied(self, variation: Variation) -> Levels:
        """The same robot with other coefficients, traced ones."""
        below = tuple(vary_level(level, variation) for level in self.below)
        return replace(self, root=vary_level(self.root, variation), below=below)

    # What hinges are, level by level, and in the robot's order.

    def spread(self, hinges: jax.Array) -> tuple[jax.Array, ...]:
        """`[nhinge, lanes]` in the robot's order to `[nbody, lanes]` for each level below."""
        return self.split(hinges[self.hinge_order]) if self.below else ()

    def split(self, rows: jax.Array) -> tuple[jax.Array, ...]:
        """`[nhinge, ...]` in the order of the levels, likewise."""
        edges = np.cumsum([0] + [level.count for level in self.below])
        return tuple(rows[a:b] for a, b in itertools.pairwise(edges))

    def gather(self, values: Sequence[jax.Array], like: jax.Array) -> jax.Array:
        """The way back from `spread`; `[0, lanes]` of the kind of `like` without hinges."""
        if not self.below:
            return jnp.zeros((0, *like.shape), like.dtype)
        return jnp.concatenate(values)[np.argsort(self.hinge_order).astype(np.int32)]

    def merge(self, values: Sequence[jax.Array], like: jax.Array) -> jax.Array:
        """The way back from `split`; `[0, lanes]` of the kind of `like` without hinges."""
        return jnp.concatenate(values) if self.below else jnp.zeros((0, *like.shape), like.dtype)

    def lay_out(self, kept: Any, which: Callable[[Any], Any], like: jax.Array) -> Any:
        """What `which` takes of a value that `down` has kept, each number as `merge` has it.

        None without hinges.
        """
        if not self.below:
            return None

        def join(*xs: Any) -> jax.Array:
            pairs = zip(xs, self.below, strict=True)
            wide = [jnp.broadcast_to(x, (level.count, *like.shape)) for x, level in pairs]
            return jnp.concatenate(wide)

        return jax.tree.map(join, *map(which, kept))

    # What parts are, group by group.

    def set_apart(self, groups: tuple[jax.Array, ...]) -> tuple[Any, ...]:
        """`[npart, nbody, lanes]` of groups, as a traversal keeps them."""
        return groups

    def put_together(self, kept: Any, which: Callable[[Any], Any]) -> tuple[Any, ...]:
        """The way back from `set_apart`, of what `which` takes of a value that was kept."""
        return tuple(map(which, kept))

    def all_wet(self, lanes: tuple[int, ...], dtype: Any) -> tuple[Any, Any]:
        """`State.wet` of parts that are wholly under water."""

        def ones(level: Level) -> tuple[jax.Array, ...]:
            return tuple(jnp.ones((n, level.count, *lanes), dtype) for n in level.carrying)

        return ones(self.root), tuple(map(ones, self.below))

    # The traversal.

    def map(self, fun: Callable[..., Any], *xs: Any) -> Any:
        """What `fun` (level, a value of each of `xs`) gives for the levels below the root."""
        return tuple(fun(*args) for args in zip(self.below, *xs, strict=True))

    def down(self, fun: Callable[..., Any], root: Any, *xs: Any) -> Any:
        """From the root to the tips.

        Args:
            fun: (level, its parents' values, a value of each of `xs`) → its own value for its
                children, and what to keep of it.
            root: the root's value.
            xs: values as `map` and `down` give them.

        Returns:
            What was kept of the levels below the root.
        """
        value, found = root, []
        for level, parents, *x in zip(self.below, self.parents, *xs, strict=True):
            value, keep = fun(level, _of_parents(parents, value), *x)
            found.append(keep)
        return tuple(found)

    def up(self, fun: Callable[..., Any], nothing: Any, *xs: Any) -> tuple[Any, Any, Any]:
        """From the tips to the root.

        Args:
            fun: (level, sum of its children's values or None without any, a value of each of `xs`)
                → its value for its parent, what to keep of it, and what to add up over all bodies.
            nothing: such a value and such a sum of nothing, in numbers.
            xs: as in `down`.

        Returns:
            The sum of the values of the root's children (None without any), what was kept, and the
            sums `[lanes]` (those of nothing without bodies below the root).
        """
        gathered, kept, sums = None, [], nothing[1]
        counts = [level.count for level in self.all]
        for d in reversed(range(len(self.below))):
            value, keep, terms = fun(self.below[d], gathered, *(x[d] for x in xs))
            gathered = _of_children(self.parents[d], counts[d], value)
            kept.append(keep)
            terms = jax.tree.map(lambda x: total(*[x[k] for k in range(x.shape[0])]), terms)
            sums = jax.tree.map(add, sums, terms)
        return gathered, tuple(reversed(kept)), sums


def _of_parents(parents: tuple[int, ...], value: Any) -> Any:
    """A value of the level above, for each body of this one."""

    def pick(x: Any) -> Any:
        if not hasattr(x, "shape") or x.shape[0] == 1 or parents == tuple(range(x.shape[0])):
            return x
        return jnp.concatenate([x[k : k + 1] for k in parents])

    return jax.tree.map(pick, value)


def _of_children(parents: tuple[int, ...], above: int, value: Any) -> Any:
    """The sum over each parent's children, for each body of the level above."""
    n = len(parents)

    def gather(x: Any) -> Any:
        if parents == tuple(range(above)):
            return x
        if not isinstance(x, jax.Array):  # a constant stays one, so that it still folds away
            return fold(np.equal.outer(range(above), parents) @ np.broadcast_to(x, (n, 1)))
        if x.shape[0] == 1 and n > 1:
            x = jnp.broadcast_to(x, (n, *x.shape[1:]))
        if above == 1:
            return total(*[x[k : k + 1] for k in range(n)])
        sums = []
        for parent in range(above):
            children = [x[k : k + 1] for k in range(n) if parents[k] == parent]
            sums.append(total(*children) if children else jnp.zeros_like(x[:1]))
        return jnp.concatenate(sums)

    return jax.tree.map(gather, value)


def make_levels(robot: Robot, contact: bool = True) -> Levels:
    """Reads the constants of the step of one robot.

    Args:
        robot: from `build_robot`.
        contact: whether the robot can touch the bed; without, its points are left out.

    Returns:
        The levels.
    """
    assembly = changed_assembly(robot)
    columns = changed_columns(robot, read_columns(assembly))
    parent = assembly.parent.tolist()
    depth = {1: 0}
    for body in range(2, len(parent)):
        depth[body] = depth[parent[body]] + 1
    ids = [[b for b in depth if depth[b] == d] for d in range(max(depth.values()) + 1)]
    made = [_make_level(columns, bodies, contact, d == 0) for d, bodies in enumerate(ids)]
    parents = tuple(
        tuple(above.index(parent[b]) for b in bodies) for above, bodies in itertools.pairwise(ids)
    )
    return Levels(
        world=robot.world,
        root=made[0][0],
        below=tuple(level for level, _, _ in made[1:]),
        parents=parents,
        bodies=tuple(map(tuple, ids)),
        frames=tuple(columns.frame[bodies] for bodies in ids),
        part_rows=tuple(rows for _, rows, _ in made),
        point_rows=tuple(rows for _, _, rows in made),
        # Hinge k carries body k + 2: the root is 1.
        hinge_order=np.array([b - 2 for bodies in ids[1:] for b in bodies], np.int32),
        thrusters=read_thrusters(assembly, robot.num_thrusters),
        carries=columns.parts.carried is not None,
        robot=robot,
    )


def _make_level(
    columns: Columns, bodies: list[int], contact: bool, root: bool
) -> tuple[Level, tuple[np.ndarray, ...], np.ndarray]:
    """One level, and the rows of the fluid table of each of its groups, and of the points."""
    held: dict[Laws, list[list[int]]] = {}
    for k, body in enumerate(bodies):
        for part in np.flatnonzero(columns.part_body == body):
            lists = held.setdefault(columns.laws[columns.part_laws[part]], [[] for _ in bodies])
            lists[k].append(int(part))
    parts = {
        laws: _stack(rows)
        for laws, rows in held.items()
        # Nothing acts on a group that neither floats nor drags nor carries nor pushes.
        if laws[:2] != ("off", "off") or laws.pushes or _carries(columns, rows)
    }
    points = None
    if contact:
        lists = [np.flatnonzero(columns.point_body == b).tolist() for b in bodies]
        points = _stack(lists) if any(lists) else None
    finish = lambda x: x[..., None] if x.dtype.kind == "i" else fold(x[..., None])  # noqa: E731
    level = pick_level(columns, np.array(bodies), parts, points, root, len(bodies), finish)
    none = np.zeros((0, len(bodies)), int)
    rows = tuple(parts[laws] for laws in sorted(parts))
    return level, rows, none if points is None else points


def _stack(lists: list[list[int]]) -> np.ndarray:
    """`[nbody][k]` ragged to `[kmax, nbody]`, padded with -1, the column of nothing."""
    most = max(len(row) for row in lists)
    return np.array([[row[k] if k < len(row) else -1 for row in lists] for k in range(most)])


def _carries(columns: Columns, lists: list[list[int]]) -> bool:
    if columns.parts.carried is None:
        return False
    rows = [p for row in lists for p in row]
    return any(np.any(x[rows]) for x in jax.tree.leaves(columns.parts.carried.linear))
