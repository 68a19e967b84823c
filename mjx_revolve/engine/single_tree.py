"""The tree of one robot, level by level; the tree is static while a step is traced.

Bodies at equal depth are stacked on the first axis, so that one operation acts on all of them.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.body.placement import turned
from mjx_revolve.engine.assembly import Assembly
from mjx_revolve.engine.edited_model import edited_constants
from mjx_revolve.engine.level import Level, Thrusters
from mjx_revolve.engine.meetings import Boxes, Meetings
from mjx_revolve.engine.robot import Robot
from mjx_revolve.engine.self_pairs import rest_overlaps
from mjx_revolve.engine.step_constants import StepConstants, read_constants, select_bodies
from mjx_revolve.engine.thrusters import read_thrusters
from mjx_revolve.engine.variation import Variation, vary_level, vary_thrusters
from mjx_revolve.numerics.spatial import Vec, add, fold, namespace, total
from mjx_revolve.numerics.xla import take_lanes
from mjx_revolve.water.world import World


@dataclass(frozen=True, eq=False)
class SingleTree:
    """One robot as a `Tree`; its methods are described there.

    Joint values are tuples of `[nbody, lanes]`, one for each level below the root.

    Attributes:
        world: around it.
        root: constants of the root, numbers or `[1, 1]`.
        below: of the levels below it, numbers or `[nbody, 1]`.
        parents: of each level below, the index of each body's parent in the level above.
        bodies: `[level][nbody]` MuJoCo ids, the root's level first.
        frames: `[nbody, 3, 3]` of each level, MuJoCo's body frame from ours.
        part_rows: `[level][group][npart, nbody]` rows of the fluid table, -1 for padding.
        point_rows: `[level][npoint, nbody]` of the assembly's points, -1 for padding.
        hinge_order: `[nhinge]` the robot's own numbers of the hinges, level by level.
        thrusters: of the robot.
        carries: whether any part has added mass.
        shells: the body of each box that can meet others, level after level, as `Meetings.body`.
        halves: of these boxes, as `Meetings.halves`.
        pairs: `[npair, 2]` boxes that can meet, int32.
        rest: `[npair]` by how much they overlap at rest [m].
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
    shells: np.ndarray
    halves: np.ndarray
    pairs: np.ndarray
    rest: np.ndarray
    robot: Robot

    @property
    def all(self) -> tuple[Level, ...]:
        """The root's level and those below."""
        return (self.root, *self.below)

    @property
    def meets(self) -> bool:
        """Whether any of its modules can meet."""
        return len(self.pairs) > 0

    def meetings(self, like: jax.Array) -> Meetings:
        """Which boxes can meet, level after level."""
        first, second = self.pairs.T[..., None]
        boxes = Boxes.of(self.all, like.dtype)
        return Meetings.of(boxes, self.shells, first, second, self.rest[:, None], self.halves)

    @property
    def touches(self) -> bool:
        """Whether any body may touch the bed."""
        return any(level.points is not None for level in self.all)

    def with_variation(self, variation: Variation | None) -> SingleTree:
        """The same robot with other coefficients; None: with its own."""
        if variation is None:
            return self
        below = tuple(vary_level(level, variation) for level in self.below)
        thrusters = vary_thrusters(self.thrusters, variation)
        return replace(
            self, root=vary_level(self.root, variation), below=below, thrusters=thrusters
        )

    # Joint values, level by level and in the robot's order.

    def joints_to_tree(self, values: jax.Array) -> tuple[jax.Array, ...]:
        """`[nbody, lanes]` of each level from the robot's order."""
        return self.split_rows(values[self.hinge_order]) if self.below else ()

    def split_rows(self, rows: jax.Array) -> tuple[jax.Array, ...]:
        """`[nbody, lanes]` of each level from the order of the levels."""
        edges = np.cumsum([0] + [level.count for level in self.below])
        return tuple(rows[a:b] for a, b in itertools.pairwise(edges))

    def tree_to_joints(self, values: Sequence[jax.Array], like: jax.Array) -> jax.Array:
        """`[nhinge, lanes]` in the robot's order."""
        return self.join_rows(values, like)[np.argsort(self.hinge_order).astype(np.int32)]

    def join_rows(self, values: Sequence[jax.Array], like: jax.Array) -> jax.Array:
        """`[nhinge, lanes]` in the order of the levels."""
        if not self.below:
            return jnp.zeros((0, *like.shape), like.dtype)
        # What is the same for a whole level may be a plain number.
        pairs = zip(values, self.below, strict=True)
        wide = [jnp.broadcast_to(x, (level.count, *like.shape)) for x, level in pairs]
        return jnp.concatenate(wide)

    def stack_saved(self, saved: Any, select: Callable[[Any], Any], like: jax.Array) -> Any:
        """`[nhinge, lanes]` of selected saved values; None without hinges."""
        if not self.below:
            return None
        return jax.tree.map(lambda *xs: self.join_rows(xs, like), *map(select, saved))

    def at_lanes(self, which: jax.Array | None) -> SingleTree:
        """Itself: all lanes are this robot."""
        return self

    def saved_at_lanes(
        self, saved: Any, select: Callable[[Any], Any], which: jax.Array | None
    ) -> tuple[Any, ...]:
        """Columns of selected saved values; values equal in all lanes are returned unchanged."""
        pick = lambda x: take_lanes(x, which) if np.shape(x)[-1:] not in ((), (1,)) else x  # noqa: E731
        return tuple(jax.tree.map(pick, select(level)) for level in saved)

    def hinge_positions(self, which: jax.Array | None) -> tuple[Vec, ...]:
        """The levels' own."""
        return tuple(level.hinges.position for level in self.below if level.hinges is not None)

    # Values of parts, group by group.

    def unstack_parts(self, groups: tuple[jax.Array, ...]) -> tuple[Any, ...]:
        """The groups themselves."""
        return groups

    def stack_parts(self, saved: Any, select: Callable[[Any], Any]) -> tuple[Any, ...]:
        """Selected saved values of each level."""
        return tuple(map(select, saved))

    def fully_submerged(self, lanes: tuple[int, ...], dtype: Any) -> tuple[Any, Any]:
        """`[npart, nbody, lanes]` of each group and level."""
        axes = 3 if self.world.near_surface else 1

        def first(level: Level) -> tuple[jax.Array, ...]:
            return level.at_first(axes, (level.count, *lanes), dtype)

        return first(self.root), tuple(map(first, self.below))

    # The passes.

    def map(self, fun: Callable[..., Any], *xs: Any) -> Any:
        """`fun` for each level."""
        return tuple(fun(*args) for args in zip(self.below, *xs, strict=True))

    def forward_pass(self, fun: Callable[..., Any], root: Any, *xs: Any) -> Any:
        """Level after level from the root."""
        value, found = root, []
        for level, parents, *x in zip(self.below, self.parents, *xs, strict=True):
            value, save = fun(level, _of_parents(parents, value), *x)
            found.append(save)
        return tuple(found)

    def backward_pass(self, fun: Callable[..., Any], zero: Any, *xs: Any) -> tuple[Any, Any, Any]:
        """Level after level from the tips."""
        children, saved, sums = None, [], zero[1]
        counts = [level.count for level in self.all]
        for d in reversed(range(len(self.below))):
            value, save, terms = fun(self.below[d], children, *(x[d] for x in xs))
            children = _sum_of_children(self.parents[d], counts[d], value)
            saved.append(save)
            terms = jax.tree.map(lambda x: total(*[x[k] for k in range(x.shape[0])]), terms)
            sums = jax.tree.map(add, sums, terms)
        return children, tuple(reversed(saved)), sums


def _of_parents(parents: tuple[int, ...], value: Any) -> Any:
    """A value of the level above, for each body of this one."""

    def pick(x: Any) -> Any:
        if not hasattr(x, "shape") or x.shape[0] == 1 or parents == tuple(range(x.shape[0])):
            return x
        return namespace(x).concatenate([x[k : k + 1] for k in parents])

    return jax.tree.map(pick, value)


def _sum_of_children(parents: tuple[int, ...], above: int, value: Any) -> Any:
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


@lru_cache(maxsize=32)
def make_single_tree(robot: Robot, contact: bool = True) -> SingleTree:
    """The constants of the step of one robot; the same object for the same arguments.

    Args:
        robot: from `build_robot`.
        contact: whether the robot can touch the bed; without, its points are left out.

    Returns:
        The tree.
    """
    assembly = robot.assembly
    columns = read_constants(assembly, assembly.meeting_pairs)
    if robot.edited_model is not None:
        columns = edited_constants(columns, robot.edited_model, robot.servos)
    parent = assembly.parent.tolist()
    depth = {1: 0}
    for body in range(2, len(parent)):
        depth[body] = depth[parent[body]] + 1
    ids = [[b for b in depth if depth[b] == d] for d in range(max(depth.values()) + 1)]
    pairs = assembly.meeting_pairs
    active = np.unique(pairs)
    made = [_make_level(columns, bodies, contact, active, d == 0) for d, bodies in enumerate(ids)]
    parents = tuple(
        tuple(above.index(parent[b]) for b in bodies) for above, bodies in itertools.pairwise(ids)
    )
    return SingleTree(
        world=robot.world,
        root=made[0][0],
        below=tuple(level for level, *_ in made[1:]),
        parents=parents,
        bodies=tuple(map(tuple, ids)),
        frames=tuple(columns.frame[bodies] for bodies in ids),
        part_rows=tuple(rows for _, rows, *_ in made),
        point_rows=tuple(rows for _, _, rows, _ in made),
        # Hinge k carries body k + 2: the root is 1.
        hinge_order=np.array([b - 2 for bodies in ids[1:] for b in bodies], np.int32),
        thrusters=read_thrusters(assembly, robot.num_thrusters),
        carries=columns.parts.carried is not None,
        **_find_meetings(pairs, [rows for *_, rows in made], assembly, columns.frame),
        rest=rest_overlaps(assembly, pairs),
        robot=robot,
    )


def _find_meetings(
    pairs: np.ndarray, shells: list[np.ndarray], assembly: Assembly, frame: np.ndarray
) -> dict[str, np.ndarray]:
    """Pairs of parts as pairs of the levels' shells, level after level, their bodies and halves."""
    order = np.concatenate([rows.ravel() for rows in shells])
    starts = np.cumsum([0] + [rows.shape[-1] for rows in shells])
    body = [
        np.tile(start + np.arange(rows.shape[-1]), len(rows))
        for start, rows in zip(starts, shells, strict=False)
    ]
    place = np.zeros(1 + max(order.max(initial=0), pairs.max(initial=0)), np.int32)
    place[order[order >= 0]] = np.flatnonzero(order >= 0)
    (right, middle), module = assembly.halves, assembly.layout.module
    right = turned(frame[assembly.fluid.body].swapaxes(1, 2), right)
    halves = np.column_stack([module, right, middle])[order]
    return {"shells": np.concatenate(body), "pairs": place[pairs], "halves": halves}


def _make_level(
    columns: StepConstants, bodies: list[int], contact: bool, active: np.ndarray, root: bool
) -> tuple[Level, tuple[np.ndarray, ...], np.ndarray, np.ndarray]:
    """One level; rows of the fluid table of its groups, of the points, and of the shells."""

    def stack(items: np.ndarray, owner: np.ndarray) -> np.ndarray:
        """`[most, nbody]` of the items that bodies own, padded with -1, the column of nothing."""
        lists = [items[owner[items] == body] for body in bodies]
        return np.array([*itertools.zip_longest(*lists, fillvalue=-1)], int).reshape(-1, len(lists))

    parts, carried = {}, columns.parts.carried
    for k, laws in enumerate(columns.laws):
        rows = stack(np.flatnonzero(columns.part_laws == k), columns.part_body)
        # Nothing acts on a group that neither floats nor drags nor carries nor pushes.
        linear = () if carried is None else carried.inertia.linear
        if len(rows) and (not laws.idle or any(np.any(x[rows]) for x in linear)):
            parts[laws] = rows
    points = stack(np.arange(len(columns.point_body) * contact), columns.point_body)
    shells = stack(active, columns.part_body)
    finish = lambda x: x[..., None] if x.dtype.kind == "i" else fold(x[..., None])  # noqa: E731
    level = select_bodies(
        columns, np.array(bodies), parts, points, shells, root, len(bodies), finish
    )
    return level, tuple(parts[laws] for laws in sorted(parts)), points, shells
