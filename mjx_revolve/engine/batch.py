"""Different robots side by side: tables of one shape, so that one compiled program steps them all.

`fit_capacity` fixes in what bodies made of some types of modules may differ, and how large they may
be; `pack_bodies` writes robots into tables of that capacity. Everything here is NumPy;
`batched_trees` has the traversal. Numbers that are equal in all bodies of these types of modules
are constants: products with them fold away while the step is traced.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import itemgetter
from typing import Any, NamedTuple

import jax
import numpy as np

from mjx_revolve.body.module_types import ModuleType
from mjx_revolve.body.placement import counted
from mjx_revolve.engine.assembly import FRICTION, Assembly, assemble
from mjx_revolve.engine.level import Level, PartLaws, Parts, Thrusters
from mjx_revolve.engine.plant import BodyGeometry, Plant, body_geometries, read_actuators
from mjx_revolve.engine.robot import Robot
from mjx_revolve.engine.self_pairs import rest_overlaps
from mjx_revolve.engine.sites import place_types
from mjx_revolve.engine.step_constants import (
    LIMIT_OVERSHOOT,
    StepConstants,
    motor_line,
    read_constants,
    select_bodies,
)
from mjx_revolve.engine.thrusters import curve_points, read_thrusters
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics.spatial import UNIT
from mjx_revolve.water.drag import drags_whole_bodies
from mjx_revolve.water.laws import part_fields
from mjx_revolve.water.world import World

# What a row costs in a step beside its parts, in parts [-]; measured, alike under both drag laws.
_ROW_COST = 5.0
# Room for parts of the root that is tried where bodies are not known yet. A choice.
_ROOT_PARTS = (2, 3, 4, 6, 8, 12)


class PartGroup(NamedTuple):
    """Room for parts that obey the same laws.

    Attributes:
        laws: which.
        parts: of them in a row.
        root_parts: of them on the root.
    """

    laws: PartLaws
    parts: int
    root_parts: int


@dataclass(frozen=True, eq=False)
class Capacity:
    """What a compiled program for different robots depends on, apart from the world.

    Attributes:
        hinges: most hinges that a robot may have.
        thrusters: most thrusters.
        curve_points: most points of a thruster's broken line, 0 where all have another curve.
        pairs: most pairs of hinges that share a rigid body.
        rows: most rows, which the root is not one of.
        slots: length of the stack.
        groups: room for the parts of a row and of the root.
        points: most contact points of a row, 0 without a bed within reach.
        root_points: most contact points of the root.
        shells: most boxes of a row that may meet others of the same robot; 0 where none does.
        root_shells: most of them of the root.
        meetings: most pairs of them, 0 where none may meet.
        carries: whether water may be carried along.
        timestep: of the world [s].
        nothing: a part that does nothing, with the numbers of every law.
        sites: types of modules on which sensors sit.
        row: numbers that are the same in all rows of all robots, in their places; None elsewhere.
        root: the same for the roots.
    """

    hinges: int
    thrusters: int
    curve_points: int
    pairs: int
    rows: int
    slots: int
    groups: tuple[PartGroup, ...]
    points: int
    root_points: int
    shells: int
    root_shells: int
    meetings: int
    carries: bool
    timestep: float
    nothing: Any
    sites: tuple[str, ...] = ()
    row: Any = None
    root: Any = None

    @property
    def plant(self) -> Plant:
        """What controllers are made for: the largest robot that there is room for."""
        hinges = tuple(f"hinge{k}" for k in range(self.hinges))
        thrusters = tuple(f"thruster{k}" for k in range(self.thrusters))
        pairs = tuple(f"pair{k}" for k in range(self.pairs))
        return Plant(
            self.hinges, self.thrusters, self.pairs, hinges + thrusters, pairs, self.timestep
        )


class PackedBodies(NamedTuple):
    """Robots side by side: leaves with the population on the last axis, or one for all of it.

    Attributes:
        root: constants of the roots `[1, P]`, None where they are the capacity's.
        rows: of the rows `[rows, 1, P]`, None where they are the capacity's.
        slot: `[rows, P]` where each row stands in the stack, int32; the root stands in slot 0.
        source: `[rows, P]` its parent's slot; -1 for padding, int32.
        inner: `[rows, P]` whether a row has children, bool.
        hinge: `[rows, P]` which hinge each row turns on, `hinges` for none, int32.
        row: `[hinges, P]` the row of each hinge; `rows` for none, int32.
        count: `[P]` how many rows each robot has, int32.
        thrusters: `[thrusters, P]` each.
        plant: of the controllers.
        figure: `[P]` each.
        first: `[meetings, P]` of pairs of boxes that can meet, see `Meetings`, int32.
        second: the other box of each pair.
        rest: by how much they overlap at rest [m].
    """

    root: Any
    rows: Any
    slot: Any
    source: Any
    inner: Any
    hinge: Any
    row: Any
    count: Any
    thrusters: Thrusters
    plant: Plant
    figure: BodyGeometry
    first: Any
    second: Any
    rest: Any

    @property
    def alike(self) -> bool:
        """Whether the tables hold one robot."""
        return bool(self.slot.shape[-1] == 1)


class RowOrder(NamedTuple):
    """The rows of robots: which bodies and parts they hold, and how they hang together.

    Those of a robot stand in preorder, the child with the largest subtree last; all rows stand
    robot after robot, the roots, which are no rows, not among them. Piece 0 of a body is its first
    row, or the root itself; its overflow rows are the further ones.

    Attributes:
        length: `[robots]` how many rows each has.
        robot: `[row]` its robot.
        place: `[row]` which of its robot's rows.
        body: `[row]` moving body that it is, or is fixed to.
        overflow: `[row]` whether it is fixed to the body's first row.
        slot: `[row]` where it stands in the stack.
        source: `[row]` where its parent stands.
        inner: `[row]` whether it has children.
        first: `[nbody]` the first row of each body, counted through all robots; of a root, where
            its first overflow row would stand, less one.
        piece: `[npart]` which of its body's pieces a part stands in.
        rank: `[npart]` which of the parts there that obey its laws it is.
    """

    length: np.ndarray
    robot: np.ndarray
    place: np.ndarray
    body: np.ndarray
    overflow: np.ndarray
    slot: np.ndarray
    source: np.ndarray
    inner: np.ndarray
    first: np.ndarray
    piece: np.ndarray
    rank: np.ndarray

    @property
    def body_rows(self) -> np.ndarray:
        """`[nbody]` which of its robot's rows each body's first one is; of roots anything."""
        return self.place[np.clip(self.first, 0, None)] if len(self.place) else self.first


def order_rows(columns: StepConstants, groups: Sequence[PartGroup]) -> RowOrder:
    """The rows of robots.

    Args:
        columns: of the robots.
        groups: how many parts of each kind a row and the root hold.

    Returns:
        The rows.
    """
    assembly = columns.assembly
    nbody, parent = len(assembly.parent), assembly.parent.tolist()
    # How many parts before each one are on its body and obey its laws.
    rank = _ranks(columns.part_body * len(columns.laws) + columns.part_laws)
    # What no law acts on takes no room.
    room = {group.laws: (group.parts, group.root_parts) for group in groups}
    plenty = nbody + len(rank)
    rooms = np.array([room.get(laws, (plenty, plenty)) for laws in columns.laws]).reshape(-1, 2)
    most, at_root = rooms[columns.part_laws].T
    below = np.array(parent)[columns.part_body] > 0
    beyond = rank - np.where(below, most, at_root)  # what the first piece has room for
    piece = np.where(beyond < 0, 0, 1 + beyond // most)
    rank = np.where(beyond < 0, rank, beyond % most)
    pieces = np.ones(nbody, int)
    np.maximum.at(pieces, columns.part_body, piece + 1)
    own = pieces.tolist()
    size = list(own)
    children: list[list[int]] = [[] for _ in own]
    for b in reversed(range(1, nbody)):
        if parent[b]:
            size[parent[b]] += size[b]
            children[parent[b]].append(b)
    first, slot, source = [-1] * nbody, [0] * nbody, [0] * nbody
    start = 0
    for b in range(1, nbody):
        if not parent[b]:  # a root stands before its rows, in slot 0
            first[b], spot, start = start - 1, start + own[b] - 1, start + size[b] - 1
        else:
            spot = first[b] + own[b]
        left = sorted(reversed(children[b]), key=size.__getitem__)
        for child in left:
            first[child], spot = spot, spot + size[child]
            source[child], slot[child] = slot[b], slot[b] + (child != left[-1])
    bodies = np.arange(1, nbody)
    bodies = bodies[np.argsort(np.array(first)[1:], kind="stable")]  # in the order of their rows
    which, number = counted(pieces[bodies])
    real = (np.array(parent)[bodies[which]] > 0) | (number > 0)  # all but the roots themselves
    body, number = bodies[which][real], number[real]
    leaf = np.array([not below for below in children])[body]
    base, overflow = np.array(slot)[body], number > 0
    # An overflow row is its body's last child where it has no other one.
    last = leaf & (number == pieces[body] - 1)
    robot = assembly.robot[body]
    length = np.bincount(robot, minlength=len(assembly.roots))
    return RowOrder(
        length=length,
        robot=robot,
        place=counted(length)[1],
        body=body,
        overflow=overflow,
        slot=np.where(overflow & ~last, base + 1, base),
        source=np.where(overflow, base, np.array(source)[body]),
        inner=~overflow & ~(leaf & (pieces[body] == 1)),
        first=np.array(first),
        piece=piece,
        rank=rank,
    )


def _ranks(key: np.ndarray) -> np.ndarray:
    """`[n]` how many before each one have the same key."""
    order = np.argsort(key, kind="stable")
    found = np.empty(len(key), int)
    found[order] = counted(np.unique(key, return_counts=True)[1])[1]
    return found


# ------------------------------------------------------------------ capacity


def fit_capacity(
    robots: Sequence[Robot],
    kinds: Iterable[ModuleType] = (),
    contact: bool = True,
    hinges: int = 0,
    rows: int = 0,
    modules: int = 0,
    sites: Sequence[str] = (),
) -> Capacity:
    """The smallest capacity for bodies of some types of modules, as large as some robots.

    Args:
        robots: from `build_robot`, in one world: the largest of them set the size.
        kinds: further types of modules that bodies may be made of, beside those of the robots.
        contact: whether they can touch the bed.
        hinges: room for at least so many hinges; for robots that are not known yet. Only beyond
            those of `robots`, or with `modules`, there is room for other bodies with so many.
        rows: room for at least so many rows.
        modules: room for all bodies of these types with at most so many modules and `hinges`
            hinges, whatever their shape.
        sites: types of modules on which sensors sit.

    Returns:
        The capacity.

    Raises:
        InputError: there are no robots.
    """
    columns, world = _read_all(robots), robots[0].world
    carries = columns.parts.carried is not None
    sizes = _sizes(columns)
    if modules and drags_whole_bodies(world.drag):  # no part may overflow
        sizes = _widest_bodies(columns, sizes, modules)
    # Of one name there may be several, with params of their own.
    types = {id(k): k for k in (*(m.kind for r in robots for m in r.morphology.modules), *kinds)}
    near = contact and world.bed is not None
    # Nothing acts on what neither floats nor drags nor carries nor pushes, unless it may meet
    # something: room for points and boxes follows from that for parts.
    meets = world.self_contact or (near and bool(modules))
    every = [x for x in columns.laws if not x.idle or carries or meets]
    if modules:
        hinges = max(hinges, int(sizes.hinges.max()))
    groups, order = _choose_groups(columns, sizes, every, bool(modules))
    count = max(1, rows, hinges, int(order.length.max()))
    slots = 1 + int(order.slot.max(initial=0))
    thrusters = int(sizes.thrusters.max())
    points, root_points = _find_points(columns, order).most if near else (0, 0)
    shells, root_shells = _find_shells(columns, order).most
    more = bool(modules or hinges or rows or kinds) and world.self_contact
    if more:
        shells = sum(group.parts for group in groups)
        root_shells = sum(group.root_parts for group in groups)
    if modules:
        count = max(count, _most_rows(columns, groups, modules, hinges))
        pushing = {True: 0, False: 0}  # of a core, and of another module
        for kind in types.values():
            own = sum(part.thruster is not None for part in kind.parts)
            pushing[kind.mount is None] = max(pushing[kind.mount is None], own)
        thrusters = pushing[True] + (modules - 1) * pushing[False]
        points = 8 * sum(group.parts for group in groups) if near else 0
        root_points = 8 * sum(group.root_parts for group in groups) if near else 0
    if rows or hinges or modules:
        # 2^n - 2 rows are needed for n - 1 edges that do not lead to the largest subtree.
        slots = max(slots, int(np.log2(count + 2)))
    largest, pairs = int(sizes.hinges.max()), int(sizes.pairs.max())
    if hinges > largest or modules:
        pairs = hinges * (hinges - 1) // 2  # any two may share the core
    most_shells = root_shells + count * shells
    meetings = [robot.assembly.meeting_pairs for robot in robots]
    capacity = Capacity(
        hinges=max(largest, hinges),
        thrusters=thrusters,
        curve_points=max(curve_points(x.thruster) for k in types.values() for x in k.parts),
        pairs=pairs,
        rows=count,
        slots=slots,
        groups=groups,
        points=points,
        root_points=root_points,
        shells=shells,
        root_shells=root_shells,
        meetings=most_shells * (most_shells - 1) // 2 if more else max(map(len, meetings)),
        carries=carries,
        timestep=world.timestep,
        nothing=jax.tree.map(lambda x: x[-1:], columns.parts),
        sites=tuple(sites),
    )
    root, row, *_ = _pick_rows(columns, capacity, order)
    known = list(types.values())
    return replace(capacity, root=_constants(root, known, world), row=_constants(row, known, world))


def _choose_groups(
    columns: StepConstants, sizes: _Sizes, every: Sequence[PartLaws], spilling: bool
) -> tuple[tuple[PartGroup, ...], RowOrder]:
    """Room for parts with which a step of these robots costs least, and their rows.

    `spilling` says whether the root's parts may overflow into rows, too.
    """
    most = {laws: int(sizes.parts[laws].max()) for laws in every}
    most_root = {laws: int(sizes.root_parts[laws].max()) for laws in every}
    # Drag and submerged share are of a body as a whole: no part may overflow into another row.
    whole = drags_whole_bodies(columns.assembly.world.drag)
    least = max(1, *most.values()) if whole and most else 1
    widest = max(1, *most_root.values()) if most_root else 1
    on_root = [widest]
    if spilling and not whole:
        on_root = [n for n in _ROOT_PARTS if n < widest] + on_root

    def room(limits: tuple[int, int]) -> tuple[float, tuple[PartGroup, ...], RowOrder]:
        """What a step costs with at most so many parts of each kind in a row and on the root."""
        limit, root_limit = limits
        groups = tuple(
            PartGroup(laws, min(limit, most[laws]) or 1, max(1, min(root_limit, most_root[laws])))
            for laws in every
        )
        order = order_rows(columns, groups)
        # A chunk of robots is as slow as its largest; one robot alone as it is itself.
        count = (order.length.max() + order.length.mean()) / 2 if spilling else order.length.max()
        cost = max(1, count) * (_ROW_COST + sum(group.parts for group in groups))
        return cost + sum(group.root_parts for group in groups) * spilling, groups, order

    tried = map(room, itertools.product(range(least, max(9, least + 1)), on_root))
    _, groups, order = min(tried, key=itemgetter(0))
    return groups, order


def _widest_bodies(columns: StepConstants, sizes: _Sizes, modules: int) -> _Sizes:
    """Sizes with room for the most parts on one body of the robots' types of modules."""
    assembly = columns.assembly
    module, nbody = assembly.layout.module, len(assembly.parent)
    is_core = np.array([m.parent < 0 for m in assembly.modules])
    parts, root_parts = {}, {}
    for k, laws in enumerate(columns.laws):
        held = columns.part_laws == k
        where, count = np.unique(module[held] * nbody + columns.part_body[held], return_counts=True)
        core = is_core[where // nbody]
        most = (modules - 1) * count[~core].max(initial=0)
        parts[laws] = np.maximum(sizes.parts[laws], most)
        root_parts[laws] = np.maximum(sizes.root_parts[laws], most + count[core].max(initial=0))
    return sizes._replace(parts=parts, root_parts=root_parts)


def _most_rows(
    columns: StepConstants, groups: Sequence[PartGroup], modules: int, hinges: int
) -> int:
    """The most rows of bodies of the robots' types of modules, with at most so many of them."""
    assembly = columns.assembly
    core = np.array([m.parent < 0 for m in assembly.modules])
    turns = np.array([m.kind.hinge is not None for m in assembly.modules])
    found = 0
    for count in range(min(hinges, modules - 1) + 1):
        rows = count
        for group in groups:
            held = columns.part_laws == columns.laws.index(group.laws)
            parts = np.bincount(assembly.layout.module[held], minlength=len(core))
            most = [int(parts[x].max(initial=0)) for x in (core, turns, ~(core | turns))]
            total = most[0] + count * most[1] + (modules - 1 - count) * most[2]
            # Each hinge's body has a part in no overflow row; so has the root, or it is full.
            spare = total - count * (most[1] > 1)
            rows += max((spare - 1) // group.parts, -((group.root_parts - spare) // group.parts), 0)
        found = max(found, rows)
    return found


class _Places(NamedTuple):
    """Where points or shells of robots stand.

    Attributes:
        body: `[n]` that each is on.
        piece: `[n]` which of the body's pieces.
        rank: `[n]` which of the things there.
        most: how many stand in a row, and on a root, at most.
    """

    body: np.ndarray
    piece: np.ndarray
    rank: np.ndarray
    most: tuple[int, int]


def _find_places(columns: StepConstants, order: RowOrder, part: np.ndarray) -> _Places:
    """Where things stand that belong to such parts, `[n]`."""
    body, piece = columns.part_body[part], order.piece[part]
    rank = _ranks(body * (1 + int(order.piece.max(initial=0))) + piece)
    at_root = (columns.assembly.parent[body] == 0) & (piece == 0)
    in_row, on_root = (int(rank[x].max(initial=-1)) + 1 for x in (~at_root, at_root))
    return _Places(body, piece, rank, (in_row, on_root))


def _find_points(columns: StepConstants, order: RowOrder) -> _Places:
    """Where contact points stand."""
    return _find_places(columns, order, columns.assembly.point_part)


def _find_shells(columns: StepConstants, order: RowOrder) -> _Places:
    """Where parts stand that can meet others, in the order of the fluid table."""
    return _find_places(columns, order, np.unique(columns.pairs))


def _read_all(robots: Sequence[Robot]) -> StepConstants:
    """The columns of robots of one world, one behind the other."""
    assembly = assemble_all(robots)
    counts = [len(robot.fluid.volume) for robot in robots]
    starts = np.cumsum([0, *counts])
    pairs = [robot.assembly.meeting_pairs + k for robot, k in zip(robots, starts, strict=False)]
    return read_constants(assembly, np.concatenate(pairs).astype(int))


def _constants(level: Level, kinds: Sequence[ModuleType], world: World) -> Level:
    """What is the same in all bodies of some types: those numbers, and None in all other places."""
    blank: Level = jax.tree.map(lambda _: None, level)
    if _is_square(kinds):
        # Such parts stand square on their bodies and are described along their axes.
        groups = []
        for parts in blank.parts:
            carried = parts.carried
            if carried is not None and not parts.laws.coupled:
                cross = tuple(tuple(0.0 if i == j else None for j in range(3)) for i in range(3))
                about = carried.inertia._replace(
                    cross=cross, linear=(None, 0.0, 0.0, None, 0.0, None)
                )
                carried = replace(carried, inertia=about)
            groups.append(replace(parts, rotation=UNIT, carried=carried))
        shells = blank.shells and replace(blank.shells, rotation=UNIT)
        blank = replace(blank, parts=tuple(groups), shells=shells)
    # Where neighbours meet, hinges of one type end at different angles.
    ends = level.hinges is not None and world.self_contact
    found = {_hinge_numbers(kind) for kind in kinds if kind.hinge is not None}
    if blank.hinges is not None and not ends:
        blank = replace(blank, hinges=blank.hinges._replace(lever=0.0))
    if blank.hinges is not None and len(found) == 1:
        effort, reach, damping, motor = found.pop()
        same = blank.hinges._replace(
            damping=damping,
            servo_damping=0.0,
            effort=(-effort, effort),
            target=reach,
            range=(None, None) if ends else reach,
            stop=effort / LIMIT_OVERSHOOT,
            motor=motor,
        )
        blank = replace(blank, hinges=same)
    return blank


def _hinge_numbers(kind: ModuleType) -> tuple[Any, ...]:
    """What hinges of a type have in common, as `robot` and `step_constants` make it."""
    hinge = kind.hinge
    assert hinge is not None
    damping = FRICTION * hinge.effort / hinge.speed
    motor = tuple(float(x) for x in motor_line(hinge.speed, hinge.effort, damping))
    return hinge.effort, tuple(hinge.range), damping, motor


def _is_square(kinds: Sequence[ModuleType]) -> bool:
    """Whether modules of these types stand at right angles to each other, however they are joined.

    Hinges turn about an axis of theirs, which may then be turned by any multiple of 90°.
    """
    slots = [slot for kind in kinds for slot in kind.slots.values()]
    vectors = [v for slot in slots for v in (slot.direction, slot.up)]
    vectors += [kind.mount.outward for kind in kinds if kind.mount is not None]
    vectors += [kind.hinge.axis for kind in kinds if kind.hinge is not None]
    return all(np.count_nonzero(np.abs(vector) > 1e-12) == 1 for vector in vectors)


# ------------------------------------------------------------------ packing


def _pick_rows(
    columns: StepConstants, capacity: Capacity, order: RowOrder
) -> tuple[Level, Level, np.ndarray, np.ndarray]:
    """Roots `[1, R]` and rows `[rows, 1, R]` of R robots; `[2, meetings, R]` pairs of shells.

    And `[meetings, R]` by how much these overlap at rest [m].
    """
    assembly, pairs = columns.assembly, columns.pairs
    count, rows = len(assembly.roots), capacity.rows
    whole = np.zeros((rows, count), int)
    whole[order.place, order.robot] = order.body
    body = whole.copy()
    body[order.place[order.overflow], order.robot[order.overflow]] = 0

    def place(
        held: np.ndarray, piece: np.ndarray, rank: np.ndarray, most: int, most_at_root: int,
        which: Any,
    ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        """Where `which` things on bodies `held` are: `[rows, most, R]`, `[most_at_root, R]`.

        Past the end stands what has no effect.
        """
        at_root = (assembly.parent[held] == 0) & (piece == 0)
        in_rows = np.full((rows, most, count), len(held))
        k = np.flatnonzero(which & ~at_root)
        row = order.place[order.first[held[k]] + piece[k]]
        in_rows[row, rank[k], assembly.robot[held[k]]] = k
        in_roots = np.full((most_at_root, count), len(held))
        k = np.flatnonzero(which & at_root)
        in_roots[rank[k], assembly.robot[held[k]]] = k
        return in_rows, in_roots

    parts, root_parts = {}, {}
    for laws, most, on_root in capacity.groups:
        own = columns.part_laws == (columns.laws.index(laws) if laws in columns.laws else -1)
        parts[laws], root_parts[laws] = place(
            columns.part_body, order.piece, order.rank, most, on_root, own
        )
    most, on_root = capacity.points, capacity.root_points
    found = _find_points(columns, order)
    points, root_points = place(*found[:3], most, on_root, most + on_root > 0)
    found, part = _find_shells(columns, order), np.unique(pairs)
    shells, root_shells = place(*found[:3], capacity.shells, capacity.root_shells, True)
    table = np.concatenate([root_shells, shells.reshape(-1, count)])
    shell, robot = np.nonzero(table < len(part))
    number = np.zeros(len(part), int)
    number[table[shell, robot]] = shell
    blank = np.append(part, len(assembly.fluid.volume))
    shells, root_shells = blank[shells], blank[root_shells]
    owner = assembly.robot[columns.part_body[pairs[:, 0]]]
    nth = _ranks(owner)
    met = np.zeros((2, capacity.meetings, count), int)
    met[:, nth, owner] = number[np.searchsorted(part, pairs)].T
    rest = np.zeros((capacity.meetings, count))
    rest[nth, owner] = rest_overlaps(assembly, pairs)
    alike = _alike(columns, capacity.nothing)
    finish = lambda x: x[..., None, :]  # noqa: E731
    root = select_bodies(
        alike, assembly.roots, root_parts, root_points, root_shells, True, 1, finish
    )
    level = select_bodies(alike, body, parts, points, shells, False, 1, finish, whole)
    return root, level, met, rest


def _alike(columns: StepConstants, nothing: Parts) -> StepConstants:
    """Constants of parts with all fields that `nothing` has."""
    wide = partial(jax.tree.map, lambda x: np.broadcast_to(x, (len(columns.part_laws) + 1,)))
    parts = columns.parts
    missing = {
        field: wide(getattr(nothing, field))
        for field in part_fields(Parts)
        if getattr(parts, field) is None
    }
    drag = {name: parts.drag.get(name) or wide(blank) for name, blank in nothing.drag.items()}
    return columns._replace(parts=replace(parts, count=0, **missing | {"drag": drag}))


def pack_bodies(
    robots: Sequence[Robot], capacity: Capacity, dtype: Any = np.float32
) -> PackedBodies:
    """Robots side by side, as `batched_trees.BatchedTrees` takes them.

    Args:
        robots: one for each individual; the same object may stand there many times.
        capacity: from `fit_capacity`.
        dtype: of the tables.

    Returns:
        The tables.

    Raises:
        InputError: a robot does not fit; the message says why.
    """
    unique, pick = distinct(robots)
    columns = _read_all(unique)
    assembly, order = columns.assembly, order_rows(columns, capacity.groups)
    _check_fit(columns, order, capacity)
    root, level, met, rest = _pick_rows(columns, capacity, order)
    names = [str(body.name) for body in assembly.morphologies]
    real = np.zeros((capacity.rows, 1, len(names)), bool)
    real[order.place, 0, order.robot] = ~order.overflow
    root = _leave_out(root, capacity.root, names, None)
    level = _leave_out(level, capacity.row, names, real)
    hanging = _hang(assembly, order, capacity)
    figures = BodyGeometry(*(x.astype(float) for x in body_geometries(assembly)))

    def wide(x: np.ndarray) -> np.ndarray:
        kinds = {"f": dtype, "i": np.int32, "b": bool}
        return x.astype(kinds[x.dtype.kind])[..., pick]

    return jax.tree.map(
        wide,
        PackedBodies(
            root=root,
            rows=level,
            thrusters=read_thrusters(assembly, capacity.thrusters, capacity.curve_points),
            plant=replace(
                _wire(assembly, hanging["row"], capacity),
                mounts=place_types(assembly, order.body_rows, capacity.sites, capacity.rows),
            ),
            figure=figures,
            first=met[0],
            second=met[1],
            rest=rest,
            **hanging,
        ),
    )


def distinct(robots: Sequence[Robot]) -> tuple[list[Robot], np.ndarray]:
    """The different robots among some, and which of them each one is."""
    unique = {id(robot): robot for robot in robots}
    place = {key: k for k, key in enumerate(unique)}
    return list(unique.values()), np.array([place[id(robot)] for robot in robots], int)


def assemble_all(robots: Sequence[Robot]) -> Assembly:
    """Robots of one world, one behind the other."""
    if not robots:
        raise InputError("robots", "at least one", "none")
    for robot in robots:
        if robot.as_edited().edited_model is not None:
            expected = "it as built, as batches of robots have no edited models"
            raise InputError(f"robot {robot.morphology.name!r}", expected, "one from with_model")
    first, *rest = robots
    if not rest:
        return first.assembly
    for robot in rest:
        if robot.world is not first.world and robot.world != first.world:
            expected = f"the world of {first.morphology.name!r}"
            raise InputError(f"robot {robot.morphology.name!r}", expected, "another one")
    return assemble([robot.morphology for robot in robots], first.world)


class _Sizes(NamedTuple):
    """How large robots are, `[robots]` each, or by laws: what a capacity must have room for."""

    hinges: np.ndarray
    thrusters: np.ndarray
    pairs: np.ndarray
    parts: dict[PartLaws, np.ndarray]
    root_parts: dict[PartLaws, np.ndarray]


def _sizes(columns: StepConstants) -> _Sizes:
    """How large robots are."""
    assembly = columns.assembly
    robots, nbody, roots = len(assembly.roots), len(assembly.parent), assembly.roots

    def most(held: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of things on bodies, those on each robot's root, and the most on another body of it."""
        count = np.bincount(held, minlength=nbody)
        on_root = count[roots]
        count[[0, *roots]] = 0
        return on_root, np.maximum.reduceat(count, roots)

    by_laws = {
        laws: most(columns.part_body[columns.part_laws == k]) for k, laws in enumerate(columns.laws)
    }
    return _Sizes(
        hinges=np.bincount(assembly.robot[1:], minlength=robots) - 1,
        thrusters=np.bincount(assembly.layout.body[assembly.thruster_row], minlength=robots),
        pairs=np.array([len(body.hinge_neighbours()) for body in assembly.morphologies]),
        parts={laws: x[1] for laws, x in by_laws.items()},
        root_parts={laws: x[0] for laws, x in by_laws.items()},
    )


def _check_fit(columns: StepConstants, order: RowOrder, capacity: Capacity) -> None:
    """Refuses robots that are larger than there is room for."""
    assembly = columns.assembly
    found, names = _sizes(columns), [str(body.name) for body in assembly.morphologies]
    room = {group.laws for group in capacity.groups}
    for k, laws in enumerate(columns.laws):
        if laws not in room and not laws.idle:
            part = int(np.argmax(columns.part_laws == k))
            shown = lambda x: tuple(x) if x.coupled or x.stated else tuple(x)[:3]  # noqa: E731
            expected = f"parts under one of the laws {sorted(map(shown, room))} (buoyancy, drag, "
            expected += "thruster, stated 6×6, stated added mass)"
            name = names[assembly.layout.body[part]]
            raise InputError(f"robot {name!r}", expected, shown(laws))
    slots = np.ones(len(order.length), int)
    np.maximum.at(slots, order.robot, 1 + order.slot)
    for what, counts, most in (
        ("hinges", found.hinges, capacity.hinges),
        ("thrusters", found.thrusters, capacity.thrusters),
        ("pairs of neighbouring hinges", found.pairs, capacity.pairs),
        ("rows", order.length, capacity.rows),
        ("slots of the stack", slots, capacity.slots),
    ):
        if np.any(counts > most):
            k = int(np.argmax(counts > most))
            raise InputError(f"robot {names[k]!r}", f"at most {most} {what}", counts[k])
    if drags_whole_bodies(assembly.world.drag) and np.any(order.overflow):
        k = int(np.argmax(order.overflow))
        raise InputError(
            f"robot {names[order.robot[k]]!r}: expected at most as many parts on a body as the "
            f"examples have, as {assembly.world.drag} drags bodies as a whole; found more"
        )
    room_for_points = capacity.points, capacity.root_points
    points = _find_points(columns, order).most if any(room_for_points) else (0, 0)
    shells = _find_shells(columns, order).most
    for what, (in_row, on_root), (row, root) in (
        ("contact points", points, room_for_points),
        ("boxes that can meet others", shells, (capacity.shells, capacity.root_shells)),
    ):
        if in_row > row or on_root > root:
            expected = f"at most {row} {what} in a row and {root} at the core"
            raise InputError("robots", expected, f"{in_row} and {on_root}")
    robot = assembly.robot[columns.part_body[columns.pairs[:, 0]]]
    meetings = int(np.bincount(robot, minlength=1).max())
    if meetings > capacity.meetings:
        expected = f"at most {capacity.meetings} pairs of boxes that can meet"
        raise InputError("robots", expected, meetings)


def _leave_out(level: Level, constant: Level, names: list[str], real: Any) -> Level:
    """A level without the numbers that are the same in all robots, which must be those.

    Args:
        level: all numbers, robots on the last axis.
        constant: those that are the same, None elsewhere.
        names: of the robots.
        real: `[rows, 1, R]` which rows have a hinge; in others it may be anything.
    """
    blank = lambda x: x is None  # noqa: E731

    def compare(where: Any, same: Any, x: Any) -> Any:
        if same is None or x is None:
            return x
        wrong = (np.float32(x) != np.float32(same)) & where
        if np.any(wrong):
            leaves = jax.tree_util.tree_flatten_with_path(level)[0]
            place = next(jax.tree_util.keystr(path) for path, leaf in leaves if leaf is x)
            which = np.unravel_index(int(np.argmax(wrong)), wrong.shape)
            raise InputError(
                f"robot {names[which[-1]]!r}: {place.lstrip('.')}",
                f"{same:g}, as in all bodies of the types of modules that there is room for",
                f"{float(x[which]):g}",
            )
        return None

    hinges = jax.tree.map(partial(compare, real), constant.hinges, level.hinges, is_leaf=blank)
    bare = replace(constant, hinges=None), replace(level, hinges=None)
    found: Level = jax.tree.map(partial(compare, True), *bare, is_leaf=blank)
    return replace(found, hinges=hinges)


def _hang(assembly: Assembly, order: RowOrder, capacity: Capacity) -> dict[str, np.ndarray]:
    """The tree structure of robots' rows, padded: fields of `PackedBodies`."""
    count = len(assembly.roots)
    at = order.place, order.robot
    slot, inner = np.zeros((capacity.rows, count), int), np.zeros((capacity.rows, count), bool)
    # Padding writes where nothing is read any more: backwards it comes first, forwards last.
    source = np.full((capacity.rows, count), -1)
    slot[at], source[at], inner[at] = order.slot, order.source, order.inner
    hinge = np.full((capacity.rows, count), capacity.hinges)
    row = np.full((capacity.hinges, count), capacity.rows)
    real = ~order.overflow
    place, robot = order.place[real], order.robot[real]
    # Behind its root, a robot's bodies stand in the order of its hinges.
    index = order.body[real] - assembly.roots[robot] - 1
    hinge[place, robot], row[index, robot] = index, place
    return dict(slot=slot, source=source, inner=inner, hinge=hinge, row=row, count=order.length)


def _wire(assembly: Assembly, row: np.ndarray, capacity: Capacity) -> Plant:
    """The plants of robots, padded; `row` of each hinge."""
    n, robots = capacity.rows + capacity.thrusters, len(assembly.roots)
    moved, jets = assembly.moved, assembly.layout.body[assembly.thruster_row]
    robot = np.concatenate([assembly.robot[moved], jets])
    hinge = moved - assembly.roots[assembly.robot[moved]] - 1
    rank = counted(np.bincount(jets, minlength=robots))[1]
    k = np.concatenate([row[hinge, assembly.robot[moved]], capacity.rows + rank])
    low, high = np.zeros((2, n, robots))
    place, axis = np.zeros((2, n, 3, robots))
    source = np.full((n, robots), capacity.hinges + capacity.thrusters)
    found = read_actuators(assembly.morphologies)
    low[k, robot], high[k, robot], place[k, :, robot], axis[k, :, robot] = found
    source[k, robot] = np.concatenate([hinge, capacity.hinges + rank])
    first, second = np.full((2, capacity.pairs, robots), n)
    for r, body in enumerate(assembly.morphologies):
        pairs = np.array(body.hinge_neighbours(), int).reshape(-1, 2)
        first[: len(pairs), r], second[: len(pairs), r] = row[pairs.T, r]
    plant = replace(capacity.plant, low=low, high=high, place=place, axis=axis, source=source)
    return replace(plant, first=first, second=second)
