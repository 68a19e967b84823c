"""Different robots side by side: tables of one shape, so that one compiled program steps them all.

`fit_capacity` fixes what bodies made of some types of modules may differ in, and how large they may
be; `pack_bodies` puts robots into tables of that capacity. Everything here is NumPy; `rows` has the
traversal. What is the same in all bodies follows from the types of modules that they are made of,
not from the bodies at hand: products with such numbers fold away while the step is traced.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import numpy as np

from mjx_revolve.body.module_types import ModuleType
from mjx_revolve.engine.columns import (
    LIMIT_OVERSHOOT,
    Columns,
    motor_line,
    pick_level,
    read_columns,
)
from mjx_revolve.engine.level import Laws, Level, Parts, Thrusters
from mjx_revolve.engine.plant import Figure, Plant, actuator_places, figure_of
from mjx_revolve.engine.robot import FRICTION, Robot
from mjx_revolve.engine.thrusters import propeller_discs, stack_thrusters
from mjx_revolve.inputs.errors import InputError

# What a row costs in a step beside its parts, in parts [-]; measured, alike under both drag laws.
_ROW_COST = 5.0


class Group(NamedTuple):
    """Room for parts that obey the same laws.

    Attributes:
        laws: which.
        parts: of them in a row.
        root_parts: of them on the root.
    """

    laws: Laws
    parts: int
    root_parts: int


@dataclass(frozen=True, eq=False)
class Capacity:
    """What a compiled program for different robots depends on, apart from the world.

    Attributes:
        hinges: most hinges that a robot may have.
        thrusters: most thrusters.
        pairs: most pairs of hinges that share a rigid body.
        rows: most rows, which the root is not one of.
        slots: length of the stack.
        groups: room for the parts of a row and of the root.
        points: most contact points of a row, 0 without a bed within reach.
        root_points: of the root, likewise.
        carries: whether water may be carried along.
        timestep: of the world [s].
        nothing: a part that does nothing, with the numbers of every law.
        row: numbers that are the same in all rows of all robots, in their places; None elsewhere.
        root: likewise of the roots.
    """

    hinges: int
    thrusters: int
    pairs: int
    rows: int
    slots: int
    groups: tuple[Group, ...]
    points: int
    root_points: int
    carries: bool
    timestep: float
    nothing: Any
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


class Bodies(NamedTuple):
    """Robots side by side: leaves with the population on the last axis.

    Attributes:
        root: constants of the roots `[1, P]`, None where they are the capacity's.
        rows: of the rows `[rows, 1, P]`, likewise.
        slot: `[rows, P]` where each row stands in the stack, int32; the root stands in slot 0.
        source: `[rows, P]` its parent's slot; -1 for padding, int32.
        inner: `[rows, P]` whether a row has children, bool.
        hinge: `[rows, P]` which hinge each row turns on, `hinges` for none, int32.
        row: `[hinges, P]` the row of each hinge; `rows` for none, int32.
        count: `[P]` how many rows each robot has, int32.
        thrusters: `[thrusters, P]` each.
        plant: of the controllers.
        figure: `[P]` each.
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
    figure: Figure


class Row(NamedTuple):
    """A row of one robot.

    Attributes:
        body: MuJoCo's.
        parts: rows of the fluid table.
        rider: whether it is fixed to the body's first row.
        slot: where it stands in the stack.
        source: where its parent stands.
        inner: whether it has children.
    """

    body: int
    parts: tuple[int, ...]
    rider: bool
    slot: int
    source: int
    inner: bool


def list_rows(columns: Columns, room: dict[Laws, int]) -> list[Row]:
    """The rows of a robot, in preorder, the child with the largest subtree last.

    Args:
        columns: of the robot.
        room: how many parts of each kind a row holds.

    Returns:
        The rows.
    """
    nbody = len(columns.parent)
    chunks: dict[int, list[list[int]]] = {b: [[]] for b in range(1, nbody)}
    counts: dict[int, list[dict[Laws, int]]] = {b: [{}] for b in range(1, nbody)}
    for part, body in enumerate(columns.part_body.tolist()):
        laws = columns.laws[part]
        if body == 1 or laws not in room:
            continue
        spot = next((k for k, c in enumerate(counts[body]) if c.get(laws, 0) < room[laws]), None)
        if spot is None:
            spot = len(chunks[body])
            chunks[body].append([])
            counts[body].append({})
        chunks[body][spot].append(part)
        counts[body][spot][laws] = counts[body][spot].get(laws, 0) + 1
    children: dict[int, list[int]] = {b: [] for b in chunks}
    for b in range(2, nbody):
        children[int(columns.parent[b])].append(b)
    size: dict[int, int] = {}
    for b in reversed(range(1, nbody)):
        size[b] = len(chunks[b]) + sum(size[c] for c in children[b])
    rows: list[Row] = []

    def visit(body: int, slot: int, source: int) -> None:
        below = sorted(children[body], key=lambda c: size[c])
        riders = chunks[body][1:]
        if body > 1:
            inner = bool(below or riders)
            rows.append(Row(body, tuple(chunks[body][0]), False, slot, source, inner))
        for k, piece in enumerate(riders):
            last = not below and k == len(riders) - 1
            rows.append(Row(body, tuple(piece), True, slot if last else slot + 1, slot, False))
        for k, child in enumerate(below):
            visit(child, slot if k == len(below) - 1 else slot + 1, slot)

    visit(1, 0, 0)
    return rows


# ------------------------------------------------------------------ capacity


def fit_capacity(
    robots: Sequence[Robot],
    kinds: Iterable[ModuleType] = (),
    contact: bool = True,
    hinges: int = 0,
    rows: int = 0,
) -> Capacity:
    """The smallest capacity for bodies of some types of modules, as large as some robots.

    Args:
        robots: from `build_robot`, in one world: the largest of them set the size.
        kinds: further types of modules that bodies may be made of, beside those of the robots.
        contact: whether they can touch the bed.
        hinges: room for at least so many hinges; for robots that are not known yet.
        rows: room for at least so many rows.

    Returns:
        The capacity.

    Raises:
        InputError: there are no robots.
    """
    if not robots:
        raise InputError("robots: expected at least one; found none")
    all_columns = [read_columns(robot) for robot in robots]
    world = robots[0].world
    carries = any(c.parts.carried is not None for c in all_columns)
    most: dict[Laws, int] = {}
    most_root: dict[Laws, int] = {}
    for columns in all_columns:
        counts: dict[tuple[Laws, int], int] = {}
        for laws, body in zip(columns.laws, columns.part_body.tolist(), strict=True):
            # Nothing acts on what neither floats nor drags nor carries nor pushes.
            if laws[:2] != ("off", "off") or laws.pushes or columns.parts.carried is not None:
                counts[laws, body] = counts.get((laws, body), 0) + 1
        for (laws, body), count in counts.items():
            held = most_root if body == 1 else most
            held[laws] = max(held.get(laws, 0), count)
    every = sorted(most.keys() | most_root.keys())
    points, root_points = 0, 0
    if contact and world.bed is not None:
        for columns in all_columns:
            found = np.bincount(columns.point_body, minlength=len(columns.parent))
            points = max(points, int(found[2:].max(initial=0)))
            root_points = max(root_points, int(found[1]))
    # The inertia box belongs to a body as a whole, and so does its submerged share: no riders.
    least = max(1, *most.values()) if world.drag == "inertia_box" and most else 1
    best: tuple[float, dict[Laws, int], int, int] | None = None
    for limit in range(least, max(9, least + 1)):
        room = {laws: min(limit, most.get(laws, 1)) for laws in every}
        listed = [list_rows(columns, room) for columns in all_columns]
        count = max(1, rows, hinges, *map(len, listed))
        slots = 1 + max((r.slot for x in listed for r in x), default=0)
        cost = count * (_ROW_COST + sum(room.values()))
        if best is None or cost < best[0]:
            best = (cost, room, count, slots)
    assert best is not None
    _, room, count, slots = best
    if rows or hinges:
        # 2^n - 1 bodies are needed for n edges that do not lead to the largest subtree.
        slots = max(slots, int(np.log2(count + 2)))
    largest = max(robot.num_hinges for robot in robots)
    pairs = max(len(robot.morphology.hinge_neighbours()) for robot in robots)
    if hinges > largest:
        pairs = hinges * (hinges - 1) // 2  # any two may share the core
    capacity = Capacity(
        hinges=max(largest, hinges),
        thrusters=max(robot.num_thrusters for robot in robots),
        pairs=pairs,
        rows=count,
        slots=slots,
        groups=tuple(Group(laws, room[laws], max(1, most_root.get(laws, 0))) for laws in every),
        points=points,
        root_points=root_points,
        carries=carries,
        timestep=world.timestep,
        nothing=_nothing(all_columns),
    )
    types = {m.kind.name: m.kind for r in robots for m in r.morphology.modules}
    types |= {kind.name: kind for kind in kinds}
    one = _pick_rows(all_columns[:1], capacity, [list_rows(all_columns[0], room)])
    known = list(types.values())
    return replace(
        capacity, root=_constants(one[0], known, False), row=_constants(one[1], known, True)
    )


def resize(capacity: Capacity, **changes: Any) -> Capacity:
    """A capacity with other room.

    Args:
        capacity: from `fit_capacity`.
        **changes: fields of it, numbers of `rows`, `slots`, `hinges` and so on, or `groups` of the
            same laws.

    Returns:
        The capacity; what is constant stays so.
    """
    found = replace(capacity, **changes)

    def counted(level: Level, count: Callable[[Group], int]) -> Level:
        pairs = zip(level.parts, found.groups, strict=True)
        return replace(level, parts=tuple(replace(p, count=count(g)) for p, g in pairs))

    return replace(
        found,
        row=counted(found.row, lambda group: group.parts),
        root=counted(found.root, lambda group: group.root_parts),
    )


def _constants(level: Level, kinds: Sequence[ModuleType], hinges: bool) -> Level:
    """What is the same in all bodies of some types: those numbers, and None in all other places."""
    blank: Level = jax.tree.map(lambda _: None, level)
    if _is_square(kinds):
        # Such parts stand square on their bodies and are described along their axes.
        unit = tuple(tuple(float(i == j) for j in range(3)) for i in range(3))
        groups = []
        for parts in blank.parts:
            carried = parts.carried
            if carried is not None:
                cross = tuple(tuple(0.0 if i == j else None for j in range(3)) for i in range(3))
                carried = carried._replace(cross=cross, linear=(None, 0.0, 0.0, None, 0.0, None))
            groups.append(replace(parts, rotation=unit, carried=carried))
        blank = replace(blank, parts=tuple(groups))
    found = {_hinge_numbers(kind) for kind in kinds if kind.hinge is not None}
    if hinges and blank.hinges is not None and len(found) == 1:
        effort, reach, damping, motor = found.pop()
        same = blank.hinges._replace(
            damping=damping,
            servo_damping=0.0,
            effort=(-effort, effort),
            target=reach,
            range=reach,
            stop=effort / LIMIT_OVERSHOOT,
            motor=motor,
        )
        blank = replace(blank, hinges=same)
    return blank


def _hinge_numbers(kind: ModuleType) -> tuple[Any, ...]:
    """What hinges of a type have in common, as `robot` and `columns` make it."""
    hinge = kind.hinge
    assert hinge is not None
    damping = FRICTION * hinge.effort / hinge.speed
    motor = tuple(float(x) for x in motor_line(hinge.speed, hinge.effort, damping))
    return hinge.effort, tuple(hinge.range), damping, motor


def _is_square(kinds: Sequence[ModuleType]) -> bool:
    """Whether modules of these types stand at right angles to each other, however they are joined.

    Hinges turn about an axis of theirs, which may then be turned by any multiple of 90°.
    """

    def along_axis(vector: Sequence[float]) -> bool:
        return bool(np.count_nonzero(np.abs(vector) > 1e-12) == 1)

    for kind in kinds:
        vectors = [v for slot in kind.slots.values() for v in (slot.direction, slot.up)]
        vectors += [kind.mount.outward] if kind.mount is not None else []
        vectors += [kind.hinge.axis] if kind.hinge is not None else []
        if not all(map(along_axis, vectors)):
            return False
    return True


# ------------------------------------------------------------------ packing


def _pick_rows(
    listed: Sequence[Columns], capacity: Capacity, rows: Sequence[list[Row]]
) -> tuple[Level, Level]:
    """Roots `[1, R]` and rows `[rows, 1, R]` of R robots, all of their numbers."""
    count = len(listed)
    body = np.zeros((capacity.rows, count), int)
    parts = {g.laws: np.zeros((capacity.rows, g.parts, count), int) for g in capacity.groups}
    root_parts = {g.laws: np.zeros((g.root_parts, count), int) for g in capacity.groups}
    points = np.zeros((capacity.rows, capacity.points, count), int) if capacity.points else None
    root_points = np.zeros((capacity.root_points, count), int) if capacity.root_points else None
    roots = np.zeros(count, int)
    at_body = at_part = at_point = 0
    riders: list[tuple[int, int]] = []
    for r, (columns, own) in enumerate(zip(listed, rows, strict=True)):
        roots[r] = at_body + 1
        nothing = at_part + len(columns.laws)
        body[:, r] = at_body
        for laws, index in parts.items():
            index[:, :, r] = nothing
            held: Any = [
                p for p in np.flatnonzero(columns.part_body == 1) if columns.laws[p] == laws
            ]
            root_parts[laws][:, r] = nothing
            root_parts[laws][: len(held), r] = at_part + np.array(held, int)
        if points is not None:
            points[:, :, r] = at_point + len(columns.point_body)
        if root_points is not None:
            held = np.flatnonzero(columns.point_body == 1)
            root_points[:, r] = at_point + len(columns.point_body)
            root_points[: len(held), r] = at_point + held
        for k, row in enumerate(own):
            if row.rider:
                riders.append((k, r))
            else:
                body[k, r] = at_body + row.body
                if points is not None:
                    held = np.flatnonzero(columns.point_body == row.body)
                    points[k, : len(held), r] = at_point + held
            for laws, index in parts.items():
                held = [p for p in row.parts if columns.laws[p] == laws]
                index[k, : len(held), r] = at_part + np.array(held, int)
        at_body += len(columns.parent)
        at_part += len(columns.laws) + 1
        at_point += len(columns.point_body) + 1
    alike = [_alike(columns, capacity.nothing) for columns in listed]
    joined = alike[0]
    if count > 1:
        numbers = [(c.hinges, c.bodies, c.parts, c.points) for c in alike]
        together = jax.tree.map(lambda *x: np.concatenate(x), *numbers)
        joined = joined._replace(
            hinges=together[0], bodies=together[1], parts=together[2], points=together[3]
        )
    finish = lambda x: np.expand_dims(x, -2)  # noqa: E731
    root = pick_level(joined, roots, root_parts, root_points, True, 1, finish)
    level = pick_level(joined, body, parts, points, False, 1, finish)
    return root, level


# What parts have only where a law of the robot's asks for it.
_OPTIONAL = (
    "exposed", "drag_linear", "drag_angular", "carried", "plate", "plate_area", "plate_forward",
    "plate_upward", "plate_center", "ellipsoid", "mounts",
)  # fmt: skip


def _nothing(listed: Sequence[Columns]) -> Parts:
    """A part that does nothing, `[1]`, with the numbers of every law of any robot."""
    last = lambda x: x[-1:]  # noqa: E731
    found: Parts = jax.tree.map(last, listed[0].parts)
    for columns in listed:
        given = {name: getattr(columns.parts, name) for name in _OPTIONAL}
        more = {name: jax.tree.map(last, x) for name, x in given.items() if x is not None}
        found = replace(found, **more)
    return found


def _alike(columns: Columns, nothing: Parts) -> Columns:
    """Columns whose parts have all the numbers that `nothing` has."""
    count = len(columns.laws) + 1
    wide = lambda x: np.broadcast_to(x, (count,))  # noqa: E731
    missing = {
        name: jax.tree.map(wide, getattr(nothing, name))
        for name in _OPTIONAL
        if getattr(columns.parts, name) is None
    }
    return columns._replace(parts=replace(columns.parts, count=0, **missing))


def pack_bodies(robots: Sequence[Robot], capacity: Capacity, dtype: Any = np.float32) -> Bodies:
    """Robots side by side, as `rows.Rows` takes them.

    Args:
        robots: one for each individual; the same object may stand there many times.
        capacity: from `fit_capacity`.
        dtype: of the tables.

    Returns:
        The tables.

    Raises:
        InputError: a robot does not fit; the message says why.
    """
    unique: dict[int, Robot] = {id(robot): robot for robot in robots}
    place = {key: k for k, key in enumerate(unique)}
    pick = np.array([place[id(robot)] for robot in robots], int)
    listed = [read_columns(robot) for robot in unique.values()]
    room = {g.laws: g.parts for g in capacity.groups}
    rows = []
    for robot, columns in zip(unique.values(), listed, strict=True):
        _check_fit(robot, columns, capacity)
        rows.append(list_rows(columns, room))
        _check_rows(robot, rows[-1], capacity)
    root, level = _pick_rows(listed, capacity, rows)
    names = [str(robot.morphology.name) for robot in unique.values()]
    real = np.zeros((capacity.rows, 1, len(rows)), bool)
    for r, own in enumerate(rows):
        real[: len(own), 0, r] = [not row.rider for row in own]
    root = _leave_out(root, capacity.root, names, None)
    level = _leave_out(level, capacity.row, names, real)
    orders = [
        _order(robot, own, capacity) for robot, own in zip(unique.values(), rows, strict=True)
    ]
    order = {key: np.stack([x[key] for x in orders], -1) for key in orders[0]}
    wires = [_wire(robot, own, capacity) for robot, own in zip(unique.values(), rows, strict=True)]
    wire = {key: np.stack([x[key] for x in wires], -1) for key in wires[0]}
    thrusters = stack_thrusters(
        [[p.thruster for p in r.thruster_part if p.thruster] for r in unique.values()],
        [propeller_discs(r) for r in unique.values()],
        capacity.thrusters,
        capacity.timestep,
    )
    figures = Figure(*np.array([figure_of(r) for r in unique.values()], float).T)

    def wide(x: np.ndarray) -> np.ndarray:
        kinds = {"f": dtype, "i": np.int32, "b": bool}
        return x.astype(kinds[x.dtype.kind])[..., pick]

    return jax.tree.map(
        wide,
        Bodies(
            root=root,
            rows=level,
            thrusters=thrusters,
            plant=replace(capacity.plant, **wire),  # type: ignore[arg-type]
            figure=figures,
            **order,
        ),
    )


def _check_fit(robot: Robot, columns: Columns, capacity: Capacity) -> None:
    """Refuses what there is no room for."""
    name = robot.morphology.name
    own: Any = []
    if capacity.points or capacity.root_points:
        own = np.bincount(columns.point_body, minlength=len(columns.parent))
    held = columns.part_body == 1
    sizes = [
        ("hinges", robot.num_hinges, capacity.hinges),
        ("thrusters", robot.num_thrusters, capacity.thrusters),
        ("pairs of neighbouring hinges", len(robot.morphology.hinge_neighbours()), capacity.pairs),
        ("contact points in a body", int(max(own[2:], default=0)), capacity.points),
        ("contact points on the core's body", int(own[1]) if len(own) else 0, capacity.root_points),
    ]
    room = {group.laws: group for group in capacity.groups}
    for laws in sorted(set(columns.laws)):
        count = sum(1 for k in np.flatnonzero(held) if columns.laws[k] == laws)
        if laws in room:
            sizes.append(("parts on the core's body", count, room[laws].root_parts))
        elif laws[:2] != ("off", "off") or laws.pushes:
            known = [tuple(x) for x in room]
            raise InputError(
                f"robot {name!r}: expected parts under one of the laws {known} (buoyancy, drag, "
                f"thruster); found {tuple(laws)}"
            )
    for what, found, most in sizes:
        if found > most:
            raise InputError(f"robot {name!r}: expected at most {most} {what}; found {found}")


def _check_rows(robot: Robot, rows: list[Row], capacity: Capacity) -> None:
    deepest = max((row.slot for row in rows), default=0)
    if len(rows) > capacity.rows or deepest >= capacity.slots:
        raise InputError(
            f"robot {robot.morphology.name!r}: expected at most {capacity.rows} rows, "
            f"{capacity.slots} deep; found {len(rows)}, {deepest + 1} deep"
        )


def _leave_out(level: Level, constant: Level, names: list[str], real: Any) -> Level:
    """A level without the numbers that are the same in all robots, which must be those.

    Args:
        level: all numbers, robots on the last axis.
        constant: those that are the same, None elsewhere.
        names: of the robots.
        real: `[rows, 1, R]` which rows have a hinge; in others it may be anything.
    """

    def compare(path: Any, same: Any, x: Any) -> Any:
        if same is None or x is None:
            return x
        wrong = np.float32(x) != np.float32(same)
        place = jax.tree_util.keystr(path).lstrip(".")
        if place.startswith("hinges"):
            wrong &= real
        if np.any(wrong):
            which = np.unravel_index(int(np.argmax(wrong)), wrong.shape)
            raise InputError(
                f"robot {names[which[-1]]!r}: {place}: expected {same:g}, as in all bodies of the "
                f"types of modules that there is room for; found {float(x[which]):g}"
            )
        return None

    return jax.tree_util.tree_map_with_path(compare, constant, level, is_leaf=lambda x: x is None)


def _order(robot: Robot, rows: list[Row], capacity: Capacity) -> dict[str, np.ndarray]:
    """How the rows of a robot hang together, padded."""
    count = len(rows)
    slot, source = np.zeros(capacity.rows, int), np.full(capacity.rows, -1)
    # Padding writes where nobody reads any more: backwards it comes first, forwards last.
    slot[:count] = [r.slot for r in rows]
    source[:count] = [r.source for r in rows]
    inner = np.zeros(capacity.rows, bool)
    inner[:count] = [r.inner for r in rows]
    hinge, row = _hinge_rows(robot, rows, capacity)
    return {
        "slot": slot,
        "source": source,
        "inner": inner,
        "hinge": hinge,
        "row": row,
        "count": np.array(count),
    }


def _hinge_rows(robot: Robot, rows: list[Row], capacity: Capacity) -> tuple[np.ndarray, np.ndarray]:
    """`[rows]` the hinge of each row, and `[hinges]` the row of each hinge."""
    hinge = np.full(capacity.rows, capacity.hinges)
    row = np.full(capacity.hinges, capacity.rows)
    m = robot.mj_model
    for k, r in enumerate(rows):
        if not r.rider:
            index = int(m.jnt_qposadr[m.body_jntadr[r.body]]) - 7
            hinge[k], row[index] = index, k
    return hinge, row


def _wire(robot: Robot, rows: list[Row], capacity: Capacity) -> dict[str, np.ndarray]:
    """A robot's columns of the plant, padded."""
    n = capacity.rows + capacity.thrusters
    none = capacity.hinges + capacity.thrusters
    row = _hinge_rows(robot, rows, capacity)[1]
    low, high, source = np.zeros(n), np.zeros(n), np.full(n, none)
    place = np.zeros((n, 3))
    places, ranges = actuator_places(robot), robot.mj_model.actuator_ctrlrange
    for index, actuator in enumerate(robot.servos):
        k = int(row[index])
        source[k], place[k] = index, places[index]
        low[k], high[k] = ranges[actuator]
    for index, actuator in enumerate(robot.thrusters):
        k = capacity.rows + index
        source[k], place[k] = capacity.hinges + index, places[robot.num_hinges + index]
        low[k], high[k] = ranges[actuator]
    first, second = np.full(capacity.pairs, n), np.full(capacity.pairs, n)
    for k, (i, j) in enumerate(robot.morphology.hinge_neighbours()):
        first[k], second[k] = row[i], row[j]
    return {
        "low": low,
        "high": high,
        "place": place,
        "source": source,
        "first": first,
        "second": second,
    }
