"""Many different robots as tables of one shape: what lets one compiled program step them all.

Every robot becomes a root with all of its parts, and a list of rows, padded to a stated number: a
row is a moving body with a few of its parts; a body with more parts than a row holds gets riders,
rows that are rigidly fixed to it. Rows stand in preorder, the child with the largest subtree last.
Sweeps over the rows then need no list of parents, only a short stack: let a row's slot be the
number of edges on its way from the root that do not lead to a largest subtree, at most log2(rows).
When a row is reached in preorder, the slot of its parent still holds the parent's values, and when
it is reached backwards, its own slot has gathered the sums of just its children (cf. heavy paths:
Sleator & Tarjan 1983, A data structure for dynamic trees).

Here everything is NumPy, one robot at a time; `mixed_step` does the physics.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from mjx_revolve.engine.robot import Robot
from mjx_revolve.engine.tree import (
    Level,
    Parts,
    Points,
    depths_and_frames,
    make_level,
    make_parts,
    make_points,
)
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.water.drag import ellipsoid_constants

# A hinge of this inertia does not move [kg·m²]: that is how riders and padding are held.
LOCKED = 1e30
# What a row costs in a step beside its parts, in parts [-]; measured, alike under both drag laws.
_ROW_COST = 5.0
# Stands for infinity where arithmetic must stay finite.
_FAR = 1e30

# What the places of the root in the tables begin with.
ROOT = "root."

# What the fields of the tables hold where there is nothing.
_JOINT_PADDING: dict[str, Any] = {
    "rotation": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "offset": (1.0, 0.0),
    "position": (0.0, 0.0, 0.0),
    "armature": LOCKED,
    "damping": 0.0,
    "gain": 0.0,
    "stiffness": 0.0,
    "servo_damping": 0.0,
    "effort": (0.0, 0.0),
    "target": (0.0, 0.0),
    "range": (-_FAR, _FAR),
    "stop": 0.0,
    "motor": (_FAR, 0.0, 1.0),
    "base_inertia": 1.0,
}
_BODY_PADDING: dict[str, Any] = {
    "mass": 0.0,
    "moment": (0.0, 0.0, 0.0),
    "inertia": (0.0,) * 6,
    "box_rotation": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "box_position": (0.0, 0.0, 0.0),
    "box_size": (0.0, 0.0, 0.0),
}
_PART_PADDING: dict[str, Any] = {
    "position": (0.0, 0.0, 0.0),
    "rotation": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "half_size": (1.0, 1.0, 1.0),
    "center_position": (0.0, 0.0, 0.0),
    "volume": 0.0,
    "exposed": (0.0, 0.0, 0.0),
    "drag_linear": (0.0, 0.0, 0.0),
    "drag_angular": (0.0, 0.0, 0.0),
    "carried_linear": (0.0,) * 6,
    "carried_cross": ((0.0,) * 3,) * 3,
    "carried_angular": (0.0,) * 6,
}


@dataclass(frozen=True)
class Shape:
    """What a compiled program for different robots depends on, apart from the world.

    Attributes:
        hinges: most hinges that a robot may have.
        rows: most rows, which the root is not one of.
        parts: parts in a row.
        root_parts: parts of the root.
        slots: length of the stack.
        points: most contact points of a row, 0 without a bed within reach.
        root_points: of the root, likewise.
        laws: laws of the parts, (buoyancy, drag) each.
        carries: whether water may be carried along.
        constants: those numbers of the tables that are the same in all robots, by their place:
            products with 0 and 1 fold away.
    """

    hinges: int
    rows: int
    parts: int
    root_parts: int
    slots: int
    points: int
    root_points: int
    laws: tuple[tuple[str, str], ...]
    carries: bool
    constants: tuple[tuple[str, float], ...] = ()


class Bodies(NamedTuple):
    """Robots side by side: leaves with the population on the last axis.

    Attributes:
        tables: `[rows, P]`, or `[rows, parts, P]` of parts and points, by their place; those of the
            root, which begin with `root.`, without the axis of rows.
        slot: `[rows, P]` where each row stands in the stack, int32; the root stands in slot 0.
        source: `[rows, P]` its parent's slot; -1 for padding, int32.
        inner: `[rows, P]` whether a row has children, bool.
        hinge: `[rows, P]` which hinge each row turns on, `hinges` for none, int32.
        row: `[hinges, P]` the row of each hinge; `rows` for none, int32.
        count: `[P]` how many rows each robot has, int32.
        length: `[P]` body length [m].
        weight: `[P]` in air [N].
        below: `[P]` how far the lowest corner may be below the core, at any attitude [m].
    """

    tables: dict[str, Any]
    slot: Any
    source: Any
    inner: Any
    hinge: Any
    row: Any
    count: Any
    length: Any
    weight: Any
    below: Any


@dataclass(frozen=True)
class _Row:
    """A row of one robot: the body, its parts, and where it stands."""

    body: int
    parts: tuple[int, ...]
    rider: bool
    slot: int
    source: int
    inner: bool


def _rows(robot: Robot, parts: int) -> list[_Row]:
    """The rows of a robot, in preorder, the child with the largest subtree last."""
    m = robot.mj_model
    chunks: dict[int, list[tuple[int, ...]]] = {1: [()]}
    for b in range(2, m.nbody):
        own = np.flatnonzero(robot.fluid.body == b).tolist()
        pieces = [tuple(own[k : k + parts]) for k in range(0, len(own), parts)]
        chunks[b] = pieces or [()]
    children: dict[int, list[int]] = {b: [] for b in chunks}
    for b in range(2, m.nbody):
        children[int(m.body_parentid[b])].append(b)
    size: dict[int, int] = {}
    for b in reversed(range(1, m.nbody)):
        size[b] = len(chunks[b]) + sum(size[c] for c in children[b])
    rows: list[_Row] = []

    def visit(body: int, slot: int, source: int) -> None:
        below = sorted(children[body], key=lambda c: size[c])
        riders = chunks[body][1:]
        if body > 1:
            rows.append(
                _Row(body, chunks[body][0], False, slot, source, inner=bool(below or riders))
            )
        for k, piece in enumerate(riders):
            last = not below and k == len(riders) - 1
            rows.append(_Row(body, piece, True, slot if last else slot + 1, slot, False))
        for k, child in enumerate(below):
            visit(child, slot if k == len(below) - 1 else slot + 1, slot)

    visit(1, 0, 0)
    return rows


def _flat(prefix: str, value: Any) -> dict[str, Any]:
    """The numbers of nested tuples by their place, like `joint.rotation.0.2`."""
    if isinstance(value, tuple):
        found: dict[str, Any] = {}
        for k, x in enumerate(value):
            found |= _flat(f"{prefix}.{k}", x)
        return found
    return {prefix: value}


def _padding(shape: Shape) -> dict[str, tuple[float, tuple[int, ...]]]:
    """What every place of the tables holds where there is nothing, and its shape without lanes."""
    places: dict[str, tuple[float, tuple[int, ...]]] = {}
    for name, value in _JOINT_PADDING.items():
        places |= {k: (x, (shape.rows,)) for k, x in _flat(f"joint.{name}", value).items()}
    return (
        places
        | _body_padding(shape.laws, "", (shape.rows,), shape.parts, shape.points)
        | _body_padding(shape.laws, ROOT, (), shape.root_parts, shape.root_points)
    )


def _body_padding(
    laws: Sequence[tuple[str, str]], prefix: str, rows: tuple[int, ...], parts: int, points: int
) -> dict[str, tuple[float, tuple[int, ...]]]:
    """The same of bodies, so many `rows` of them."""
    places: dict[str, tuple[float, tuple[int, ...]]] = {}

    def put(name: str, value: Any, dims: tuple[int, ...]) -> None:
        flat = _flat(f"{prefix}{name}", value)
        places.update({k: (float(x), dims) for k, x in flat.items()})

    for name, value in _BODY_PADDING.items():
        put(f"body.{name}", value, rows)
    for buoyancy, drag in laws:
        group = f"parts/{buoyancy}/{drag}"
        for name, value in _PART_PADDING.items():
            put(f"{group}.{name}", value, (*rows, parts))
        if drag == "ellipsoid":
            for name, value in _no_ellipsoid().items():
                put(f"{group}.ellipsoid.{name}", value, (*rows, parts))
    if points:
        for name, value in {"position": (0.0, 0.0, 0.0), "mass": 0.0}.items():
            put(f"points.{name}", value, (*rows, points))
    return places


def _no_ellipsoid() -> dict[str, Any]:
    return ellipsoid_constants(np.ones(3), np.zeros(12), 0.0, 0.0)


@dataclass(frozen=True)
class _Description:
    """One robot's rows and unpadded tables."""

    rows: list[_Row]
    tables: dict[str, np.ndarray]
    joints: dict[int, int]


def _describe(robot: Robot, shape: Shape) -> _Description:
    """Tables of one robot, `[n]` or `[n, k]` without padding, n rows; the root's `[]` or `[k]`."""
    m = robot.mj_model
    if robot.thrusters:
        raise InputError(
            "engine population, different bodies: expected robots without thrusters; found "
            f"{len(robot.thrusters)} in {robot.morphology.name!r}"
        )
    _, frames = depths_and_frames(robot)
    rows = _rows(robot, shape.parts)
    servo = {int(m.actuator_trnid[k, 0]): k for k in robot.servos}
    bodies = list(range(1, m.nbody))
    moving = bodies[1:]
    tables: dict[str, np.ndarray] = {}
    empty = _padding(shape)

    def add(prefix: str, value: Any, rows: list[int | None], count: int) -> None:
        """Takes the given bodies of a level's field; None is padding."""
        for name, x in _flat(prefix, value).items():
            whole = np.broadcast_to(np.asarray(x, np.float64), (count, 1))[:, 0]
            # What is idle anyway takes a value that may then be the same everywhere.
            blank = whole[0] if _harmless(name) else empty[name][0]
            tables[name] = np.array([blank if k is None else whole[k] for k in rows])

    if moving:
        level = make_level(robot, moving, bodies, frames, servo, False, [[] for _ in moving])
        own: list[int | None] = [None if r.rider else r.body - 2 for r in rows]
        for name, blank in _JOINT_PADDING.items():
            value = getattr(level, name)
            # None: no servo has a top speed.
            add(f"joint.{name}", blank if value is None else value, own, len(moving))
        for name in _BODY_PADDING:
            add(f"body.{name}", getattr(level, name), own, len(moving))
        held = [list(r.parts) for r in rows]
        for group in make_parts(robot, [r.body for r in rows], frames, held):
            tables |= _part_tables(group, len(rows), shape, robot)
    root = make_level(robot, [1], [], frames, servo, False, [[]])
    for name in _BODY_PADDING:
        add(f"{ROOT}body.{name}", getattr(root, name), [0], 1)
        for key in _flat(f"{ROOT}body.{name}", getattr(root, name)):
            tables[key] = tables[key][0]
    for group in make_parts(robot, [1], frames, [list(np.flatnonzero(robot.fluid.body == 1))]):
        found = _part_tables(group, 1, shape, robot)
        tables |= {ROOT + key: x[0] for key, x in found.items()}
    if shape.points or shape.root_points:
        real = np.array([not r.rider for r in rows], bool)
        found = _point_tables(robot, frames, [r.body for r in rows], shape.points)
        tables |= {key: np.where(real[:, None], x, 0.0) for key, x in found.items()}
        found = _point_tables(robot, frames, [1], shape.root_points)
        tables |= {ROOT + key: x[0] for key, x in found.items()}
    return _Description(rows, tables, {r.body: k for k, r in enumerate(rows) if not r.rider})


def _part_tables(group: Parts, count: int, shape: Shape, robot: Robot) -> dict[str, np.ndarray]:
    """Parts of so many bodies, `[count, k]`."""
    law = (group.buoyancy, group.drag)
    if group.drag == "lift_drag" or law not in shape.laws:
        known = [x for x in shape.laws if x[1] != "lift_drag"]
        raise InputError(
            "engine population, different bodies: expected parts under one of the laws "
            f"{known} (buoyancy, drag); found {law} in {robot.morphology.name!r}"
        )
    prefix = f"parts/{group.buoyancy}/{group.drag}"
    fields = {name: getattr(group, name) for name in _PART_PADDING}
    if group.drag == "ellipsoid":
        fields |= {f"ellipsoid.{name}": x for name, x in group.ellipsoid.items()}
    k, tables = len(group.rows), {}
    for name, value in fields.items():
        for key, x in _flat(f"{prefix}.{name}", value).items():
            tables[key] = np.broadcast_to(np.asarray(x, np.float64), (k, count, 1))[..., 0].T
    return tables


def _point_tables(
    robot: Robot, frames: dict[int, np.ndarray], bodies: list[int], most: int
) -> dict[str, np.ndarray]:
    """Contact points of bodies, `[len(bodies), k]`; nothing where they have none."""
    points = make_points(robot, bodies, frames) if bodies else None
    if points is None:
        return {}
    leaves = _flat("points.position", points.position) | {"points.mass": points.mass}
    k = max(np.shape(x)[0] if np.ndim(x) == 3 else 1 for x in leaves.values())
    if k > most:
        raise InputError(
            f"engine population, different bodies: expected at most {most} contact points "
            f"in a body; found {k} in {robot.morphology.name!r}"
        )
    return {
        key: np.broadcast_to(np.asarray(x, np.float64), (k, len(bodies), 1))[..., 0].T
        for key, x in leaves.items()
    }


def fit_shape(
    robots: Sequence[Robot], contact: bool = True, hinges: int = 0, rows: int = 0
) -> Shape:
    """The smallest shape that holds some robots.

    Args:
        robots: from `build_robot`, in one world.
        contact: whether they can touch the bed.
        hinges: at least so many; for robots that are not known yet.
        rows: at least so many.

    Returns:
        The shape. Robots with other module types, sizes or orientations than these may not fit it,
        because numbers that are the same in all of these count as constants: `pack_bodies` says so.

    Raises:
        InputError: there are none, or one has what only bodies of one kind may have.
    """
    if not robots:
        raise InputError("robots: expected at least one; found none")
    most = max(robot.num_hinges for robot in robots)
    laws: set[tuple[str, str]] = set()
    for robot in robots:
        table = robot.fluid
        pairs = set(zip(table.buoyancy, table.drag, strict=True))
        carried = bool(np.any(table.carried_mass))
        laws |= {p for p in pairs if p != ("off", "off") or carried}
    carries = any(
        bool(np.any(r.fluid.carried_mass) or np.any(r.fluid.carried_inertia)) for r in robots
    )
    points, root_points = 0, 0
    if contact and robots[0].world.bed is not None:
        for robot in robots:
            _, frames = depths_and_frames(robot)
            found = [make_points(robot, [b], frames) for b in range(1, robot.mj_model.nbody)]
            sizes = [_num_points(x) for x in found]
            points, root_points = max(points, *sizes[1:], 0), max(root_points, sizes[0])
    best: tuple[float, int, int, int] | None = None
    numbers = [np.bincount(r.fluid.body, minlength=r.mj_model.nbody) for r in robots]
    # The inertia box belongs to a body as a whole, and so does its submerged share: no riders.
    boxed = robots[0].world.drag == "inertia_box"
    least = max(1, *(int(x[2:].max(initial=0)) for x in numbers)) if boxed else 1
    for parts in range(least, max(9, least + 1)):
        listed = [_rows(robot, parts) for robot in robots]
        count = max(1, rows, hinges, *map(len, listed))
        slots = 1 + max((r.slot for x in listed for r in x), default=0)
        # What a row costs, in parts (measured under the ellipsoid law and in the default water).
        cost = count * (_ROW_COST + parts)
        if best is None or cost < best[0]:
            best = (cost, parts, count, slots)
    assert best is not None
    _, parts, count, slots = best
    if rows or hinges:
        # 2^n - 1 bodies are needed for n edges that do not lead to the largest subtree.
        slots = max(slots, int(np.log2(count + 2)))
    shape = Shape(
        hinges=max(most, hinges),
        rows=count,
        parts=parts,
        root_parts=max(1, *(int(x[1]) for x in numbers)),
        slots=slots,
        points=points,
        root_points=root_points,
        laws=tuple(sorted(laws)),
        carries=carries,
    )
    same: dict[str, set[float]] = {}
    for robot in robots:
        for key, x in _describe(robot, shape).tables.items():
            same.setdefault(key, set()).update(np.unique(x).tolist())
    places = _padding(shape)
    constants = []
    for key, (blank, _) in places.items():
        values = {_round(x) for x in same.get(key, {blank})}
        if not _harmless(key):
            values.add(blank)
        if len(values) == 1:
            constants.append((key, values.pop()))
    return dataclasses.replace(shape, constants=tuple(constants))


def _harmless(key: str) -> bool:
    """Whether padding and riders may have any value there, because others make them idle."""
    owner, _, field = key.removeprefix(ROOT).partition(".")
    idle = {"position", "rotation", "half_size", "center_position"}
    if owner == "joint":
        return field.partition(".")[0] not in {"armature", "rotation", "offset", "position"}
    return owner.startswith("parts/") and field.partition(".")[0] in idle


def _num_points(points: Points | None) -> int:
    """How many points the body with the most of them has."""
    if points is None:
        return 0
    return max(np.shape(x)[0] if np.ndim(x) == 3 else 1 for x in (*points.position, points.mass))


def _round(x: float) -> float:
    """A number with the rounding of its arithmetic taken off, so that equal ones are equal."""
    return float(f"{x:.12g}")


def pack_bodies(robots: Sequence[Robot], shape: Shape, dtype: Any = np.float32) -> Bodies:
    """Robots side by side, as `mixed_step` takes them.

    Args:
        robots: one for each individual; the same object may stand there many times.
        shape: from `fit_shape`.
        dtype: of the tables.

    Returns:
        The tables.

    Raises:
        InputError: a robot does not fit; the message says why.
    """
    constants = dict(shape.constants)
    places = {k: v for k, v in _padding(shape).items() if k not in constants}
    known: dict[int, int] = {}
    columns: list[tuple[Any, ...]] = []
    order = []
    for robot in robots:
        if id(robot) not in known:
            known[id(robot)] = len(columns)
            columns.append(_column(robot, shape, places, constants))
        order.append(known[id(robot)])
    pick = np.array(order, int)
    stack = lambda k: np.stack([c[k] for c in columns], -1)[..., pick]  # noqa: E731
    tables = {
        key: np.stack([c[0][key] for c in columns], -1).astype(dtype)[..., pick] for key in places
    }
    scale = np.array(
        [
            (r.morphology.length, r.morphology.mass * r.world.gravity, c[-1])
            for r, c in zip(robots, (columns[k] for k in order), strict=True)
        ]
    )
    return Bodies(tables, *(stack(k) for k in range(1, 7)), *scale.T.astype(dtype))


def _column(robot: Robot, shape: Shape, places: dict[str, Any], constants: dict[str, float]) -> Any:
    """One robot, padded."""
    name = robot.morphology.name
    if robot.num_hinges > shape.hinges:
        raise InputError(
            f"robot {name!r}: expected at most {shape.hinges} hinges; found {robot.num_hinges}"
        )
    found = _describe(robot, shape)
    count, deepest = len(found.rows), max((r.slot for r in found.rows), default=0)
    if count > shape.rows or deepest >= shape.slots:
        raise InputError(
            f"robot {name!r}: expected at most {shape.rows} rows of {shape.parts} parts; found "
            f"{count}"
        )
    held = int(np.sum(robot.fluid.body == 1))
    if held > shape.root_parts:
        raise InputError(
            f"robot {name!r}: expected at most {shape.root_parts} parts on the core's body; found "
            f"{held}"
        )
    tables = {}
    for key, x in found.tables.items():
        if key in constants and np.any(np.float32(x) != np.float32(constants[key])):
            raise InputError(
                f"robot {name!r}: {key}: expected {constants[key]:g}, as in the robots that the "
                f"shape was made for; found {float(np.ravel(x)[0]):g}; fit the shape to it, too"
            )
    for key, (blank, dims) in places.items():
        table = np.full(dims, blank)
        if key in found.tables:
            x = found.tables[key]
            table[tuple(slice(n) for n in x.shape)] = x
        tables[key] = table
    slot, source = np.zeros(shape.rows, np.int32), np.full(shape.rows, -1, np.int32)
    # Padding writes where nobody reads any more: backwards it comes first, forwards last.
    slot[:count] = [r.slot for r in found.rows]
    source[:count] = [r.source for r in found.rows]
    inner = np.zeros(shape.rows, bool)
    inner[:count] = [r.inner for r in found.rows]
    hinge = np.full(shape.rows, shape.hinges, np.int32)
    row = np.full(shape.hinges, shape.rows, np.int32)
    m = robot.mj_model
    for body, k in found.joints.items():
        index = int(m.jnt_qposadr[m.body_jntadr[body]]) - 7
        hinge[k], row[index] = index, k
    return tables, slot, source, inner, hinge, row, np.array(count, np.int32), _radius(robot)


def _radius(robot: Robot) -> float:
    """Of the sphere around the core's centre that holds the robot at rest [m]."""
    farthest = 0.0
    for module in robot.morphology.modules:
        for part in module.kind.parts:
            low, high = part.bounds
            for corner in np.ndindex(2, 2, 2):
                local = np.asarray(part.position) + np.where(corner, high, low)
                place = module.position + module.rotation @ local
                farthest = max(farthest, float(np.linalg.norm(place)))
    return farthest


def joint_of(shape: Shape, row: dict[str, Any]) -> Level:
    """The hinges of one row of many robots, as far as `servos` and `dynamics` ask for them.

    Args:
        shape: of the tables.
        row: of the tables, `[lanes]` each; only those of the hinges are read.

    Returns:
        A level, `[lanes]`.
    """
    constants = dict(shape.constants)

    def fill(prefix: str, like: Any) -> Any:
        if isinstance(like, tuple):
            return tuple(fill(f"{prefix}.{k}", x) for k, x in enumerate(like))
        return constants[prefix] if prefix in constants else row[prefix]

    fields = {name: fill(f"joint.{name}", like) for name, like in _JOINT_PADDING.items()}
    return _level(_BODY_PADDING | fields, (), None)


def _level(fields: dict[str, Any], parts: tuple[Parts, ...], points: Points | None) -> Level:
    return Level(
        body=(0,),
        frame=np.zeros((0, 3, 3)),
        parent=(),
        top_speed=0.0,
        parts=parts,
        propellers=(),
        points=points,
        **fields,
    )


def level_of(shape: Shape, row: dict[str, Any], prefix: str = "") -> Level:
    """One row of many robots as a `tree.Level` of one body, or their roots.

    Args:
        shape: of the tables.
        row: of the tables: `[lanes]`, or `[parts, lanes]` of parts and points.
        prefix: `ROOT` for the roots.

    Returns:
        The level, `[1, lanes]` and `[parts, 1, lanes]`.
    """
    constants = dict(shape.constants)

    def read(key: str) -> Any:
        if key in constants:
            return constants[key]
        return row[key][..., None, :]

    def fill(prefix: str, like: Any) -> Any:
        if isinstance(like, tuple):
            return tuple(fill(f"{prefix}.{k}", x) for k, x in enumerate(like))
        return read(prefix)

    at_root = prefix == ROOT
    fields = {
        name: like if at_root else fill(f"joint.{name}", like)
        for name, like in _JOINT_PADDING.items()
    }
    fields |= {name: fill(f"{prefix}body.{name}", like) for name, like in _BODY_PADDING.items()}
    parts, points = [], None
    for buoyancy, drag in shape.laws:
        group = f"{prefix}parts/{buoyancy}/{drag}"
        numbers = {name: fill(f"{group}.{name}", like) for name, like in _PART_PADDING.items()}
        ellipsoid = None
        if drag == "ellipsoid":
            ellipsoid = {
                name: fill(f"{group}.ellipsoid.{name}", like)
                for name, like in _no_ellipsoid().items()
            }
        parts.append(
            Parts(
                rows=((-1,),) * (shape.root_parts if at_root else shape.parts),
                buoyancy=buoyancy,
                drag=drag,
                plate=None,
                plate_area=0.0,
                plate_forward=(1.0, 0.0, 0.0),
                plate_upward=(0.0, 0.0, 1.0),
                plate_center=(0.0, 0.0, 0.0),
                ellipsoid=ellipsoid,
                **numbers,
            )
        )
    if shape.root_points if at_root else shape.points:
        at = fill(f"{prefix}points.position", (0.0, 0.0, 0.0))
        points = Points(at, read(f"{prefix}points.mass"))
    return _level(fields, tuple(parts), points)
