"""One step of a population in which every individual may have another body.

The same physics as `dynamics`, from tables of numbers that differ from lane to lane
(`menagerie.Bodies`). What hinges do by themselves is computed for all rows at once; the three
sweeps along the tree are loops over the rows with a short stack, so the program, and the time to
compile it, do not grow with the trees. The water's part is in the loops, too: that of all rows at
once would not fit into the first-level cache.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.engine.menagerie import ROOT, Bodies, Shape, joint_of, level_of
from mjx_revolve.engine.servos import end_stop, servo
from mjx_revolve.engine.step import (
    Engine,
    Sense,
    State,
    advance,
    felt_gravity,
    is_pulled,
    own_inertia,
    turn_hinges,
)
from mjx_revolve.engine.tree import Level
from mjx_revolve.numerics.articulated import lift_off, solve_root, to_parent, upper
from mjx_revolve.numerics.inertia import Block, Motion
from mjx_revolve.numerics.spatial import (
    Scalar,
    Vec,
    add,
    cross,
    dot,
    full,
    matTvec,
    mul,
    neg,
    quat_to_rows,
    sub,
    transpose,
    vadd,
    vsub,
)
from mjx_revolve.numerics.xla import share_once
from mjx_revolve.water.flow import Water, needs_place
from mjx_revolve.water.world import World

# ------------------------------------------------------------------ the stack


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
    moving = [x for x in leaves if isinstance(x, jax.Array)]

    def visit(carry: Any, xs: Any) -> tuple[Any, Any]:
        rest = iter(xs)
        row = [next(rest) if isinstance(x, jax.Array) else x for x in leaves]
        return body(carry, jax.tree.unflatten(tree, row))

    return jax.lax.scan(share_once(visit), carry, moving, reverse=reverse)


# ------------------------------------------------------------------ the sweeps


def _wide(value: Any, lanes: int, dtype: Any) -> Any:
    """Every number of one row as an array `[lanes]`."""

    def widen(x: Any) -> jax.Array:
        x = jnp.asarray(x, dtype)
        return jnp.broadcast_to(x[0] if x.ndim == 2 else x, (lanes,))

    return jax.tree.map(widen, value)


def _flatten(block: Block, bias: tuple[Vec, Vec], symmetric: bool) -> tuple[Any, ...]:
    """A block and its bias as the numbers that are their own."""
    if symmetric:
        return upper(block.angular), block.across, upper(block.linear), bias
    return tuple(block), bias


def _unflatten(value: tuple[Any, ...], symmetric: bool) -> tuple[Block, tuple[Vec, Vec]]:
    if symmetric:
        angular, across, linear, bias = value
        return Block(full(angular), across, transpose(across), full(linear)), bias
    block, bias = value
    return Block(*block), bias


def _coriolis(rate: tuple[Vec, Vec], speed: Scalar) -> tuple[Vec, Vec]:
    """Velocity times joint velocity (Featherstone's c_J): ν × (z q̇)."""
    spin, velocity = rate
    return (
        (mul(spin[1], speed), neg(mul(spin[0], speed)), 0.0),
        (mul(velocity[1], speed), neg(mul(velocity[0], speed)), 0.0),
    )


def _child_rate(turn: Any, position: Vec, rate: tuple[Vec, Vec], speed: Scalar) -> Any:
    """Angular and linear velocity of a child from those of its parent."""
    spin, velocity = rate
    below = matTvec(turn, spin)
    return (below[0], below[1], add(below[2], speed)), matTvec(
        turn, vadd(velocity, cross(spin, position))
    )


def _strip(x: Any) -> Any:
    """`[1, lanes]` to `[lanes]`; numbers stay."""
    return jax.tree.map(lambda y: y[0] if isinstance(y, jax.Array) else y, x)


def _lift(x: Any) -> Any:
    """`[lanes]` to `[1, lanes]`."""
    return jax.tree.map(lambda y: y[None] if isinstance(y, jax.Array) else y, x)


def _acceleration(
    world: World,
    shape: Shape,
    bodies: Bodies,
    state: State,
    targets: jax.Array,
    water: Water,
    dt: float,
) -> tuple[Vec, Vec, jax.Array, jax.Array]:
    """Accelerations, as `dynamics` has them; hinges `[rows, lanes]`."""
    symmetric = not (shape.carries and dt)
    dtype, lanes = state.position[0].dtype, state.position[0].shape[0]
    touches = shape.points > 0 or shape.root_points > 0
    located = is_pulled(water) or needs_place(world) or touches
    angle, speed = state.angle[0], state.speed[0]
    midway = speed
    turn_root = quat_to_rows(state.quat)
    rate = (state.spin, matTvec(turn_root, state.velocity))
    root: dict[str, Any] = {"rate": rate, "up": turn_root[2], "height": state.position[2]}
    if state.pace and dt:
        half = lambda v, a: add(v, mul(0.5 * dt, a))  # noqa: E731
        linear, angular, hinges = state.pace
        root["middle"] = (tuple(map(half, rate[0], angular)), tuple(map(half, rate[1], linear)))
        midway = half(speed, hinges[0])
    if located:
        root["axes"] = (turn_root[0], turn_root[1])
        root["place"] = tuple(state.position[:2])
    tables = {k: x for k, x in bodies.tables.items() if not k.startswith(ROOT)}
    joints = joint_of(shape, tables)
    turns, position = turn_hinges(joints, angle), joints.position
    stop, stop_inertia = end_stop(joints, angle, speed, dt)
    load = sub(stop, mul(joints.damping, speed))
    inertia = add(joints.armature, add(mul(dt, joints.damping), stop_inertia))

    def down(stack: list[Any], row: Any) -> tuple[list[Any], Any]:
        source, own, turn, position, speed, midway = row
        parent = _pick(stack, source)
        value: dict[str, Any] = {
            "rate": _child_rate(turn, position, parent["rate"], speed),
            "up": matTvec(turn, parent["up"]),
            "height": add(parent["height"], dot(parent["up"], position)),
        }
        if "middle" in root:
            value["middle"] = _child_rate(turn, position, parent["middle"], midway)
        if located:
            value["axes"] = tuple(matTvec(turn, axis) for axis in parent["axes"])
            value["place"] = tuple(
                add(x, dot(axis, position))
                for x, axis in zip(parent["place"], parent["axes"], strict=True)
            )
        value = _wide(value, lanes, dtype)
        return _put(stack, own, value), value

    slots = (bodies.source, bodies.slot)
    _, motions = _sweep(down, [root] * shape.slots, (*slots, turns, position, speed, midway))

    def own_of(level: Level, motion: dict[str, Any]) -> Any:
        """Inertia and bias of a row or of the roots by themselves, `[lanes]` each."""
        seen = _lift(motion)
        spin, velocity = seen["rate"]
        x_axis, y_axis = seen.get("axes", (None, None))
        moving = Motion(
            spin, velocity, seen["up"], seen["height"], x_axis, y_axis, seen.get("place")
        )
        gravity = felt_gravity(world, water, moving)
        swirling = seen.get("middle", seen["rate"])
        own = own_inertia(world, shape.carries, level, moving, swirling, water, (), gravity, dt)
        return _wide(_flatten(*own, symmetric), lanes, dtype)

    def up(carry: Any, row: Any) -> tuple[Any, Any]:
        stack, power = carry
        source, own_slot, inner, table, motion, turn, load, inertia = row[:8]
        angle, speed, midway, target = row[8:]
        # A slot that nobody has filled for this row holds what another row has left.
        summed = jax.tree.map(
            lambda a, b: a + jnp.where(inner, b, 0),
            own_of(level_of(shape, table), motion),
            _pick(stack, own_slot),
        )
        block, bias = _unflatten(summed, symmetric)
        joint = joint_of(shape, table)
        motor, motor_inertia = servo(
            joint, angle, speed, target, dt,
            add(block.angular[2][2], inertia), sub(load, bias[0][2]),
        )  # fmt: skip
        coriolis = _coriolis(motion.get("middle", motion["rate"]), midway)
        left, bias, hinge = lift_off(
            block, bias, add(inertia, motor_inertia), add(motor, load), coriolis, symmetric
        )
        moved, bias = to_parent(turn, joint.position, left, bias, symmetric)
        value = _wide(_flatten(moved, bias, symmetric), lanes, dtype)
        stack = _give(stack, own_slot, source, value)
        hinge = _wide(tuple(hinge), lanes, dtype)
        return (stack, add(power, jnp.abs(motor * speed))), hinge

    empty = _wide(_flatten(*_no_block(), symmetric), lanes, dtype)
    (stack, power), hinges = _sweep(
        up,
        ([empty] * shape.slots, jnp.zeros(lanes, dtype)),
        (
            *slots,
            bodies.inner,
            tables,
            motions,
            turns,
            load,
            inertia,
            angle,
            speed,
            midway,
            targets,
        ),
        reverse=True,
    )
    # Nobody has written into slot 0 where the root has no children.
    whole = jax.tree.map(jnp.add, own_of(level_of(shape, bodies.tables, ROOT), root), stack[0])
    angular, linear = solve_root(*_unflatten(whole, symmetric), symmetric)

    def out(stack: list[Any], row: Any) -> tuple[list[Any], Any]:
        source, own, turn, position, rate, midway, hinge = row
        row_a, row_l, inverse, rest = hinge
        coriolis = _coriolis(rate, midway)
        above_a, above_l = _pick(stack, source)
        a = vadd(matTvec(turn, above_a), coriolis[0])
        b = vadd(matTvec(turn, vadd(above_l, cross(above_a, position))), coriolis[1])
        acceleration = mul(inverse, sub(sub(rest, dot(row_a, a)), dot(row_l, b)))
        value = _wide(((a[0], a[1], add(a[2], acceleration)), b), lanes, dtype)
        return _put(stack, own, value), acceleration

    rate = motions.get("middle", motions["rate"])
    _, found = _sweep(
        out,
        [(angular, linear)] * shape.slots,
        (*slots, turns, position, rate, midway, hinges),
    )
    return linear, angular, found, power


def _no_block() -> tuple[Block, tuple[Vec, Vec]]:
    none = ((0.0,) * 3,) * 3
    return Block(none, none, none, none), ((0.0,) * 3, (0.0,) * 3)


# ------------------------------------------------------------------ the engine


def make_mixed_engine(world: World, shape: Shape, bodies: Bodies) -> Engine:
    """The population step of different bodies.

    Args:
        world: around all of them.
        shape: of the tables.
        bodies: of the individuals that are stepped together; arrays of JAX, traced or not.

    Returns:
        The engine. Its qpos is `[7 + hinges, lanes]`, each robot's own first and zeros behind them;
        its ctrl is `[rows, lanes]`, row by row (`bodies.hinge`).
    """
    dt = world.timestep

    def init(qpos: jax.Array, qvel: jax.Array) -> State:
        length = jnp.sqrt(jnp.sum(qpos[3:7] ** 2, 0))
        angle, speed = to_rows(bodies, qpos[7:]), to_rows(bodies, qvel[6:])
        velocity, spin = tuple(qvel[:3]), tuple(qvel[3:6])
        pace = (velocity, spin, (speed,)) if shape.carries else ()
        return State(
            position=tuple(qpos[:3]),
            quat=tuple(qpos[3:7] / length),
            velocity=velocity,
            spin=spin,
            angle=(angle,),
            speed=(speed,),
            pace=jax.tree.map(jnp.zeros_like, pace),
        )

    def observe(state: State) -> tuple[jax.Array, jax.Array]:
        return (
            jnp.concatenate(
                [jnp.stack([*state.position, *state.quat]), to_hinges(bodies, state.angle[0])]
            ),
            jnp.concatenate(
                [jnp.stack([*state.velocity, *state.spin]), to_hinges(bodies, state.speed[0])]
            ),
        )

    def step(state: State, ctrl: jax.Array, water: Water) -> tuple[State, jax.Array]:
        relative = state._replace(velocity=vsub(state.velocity, water.current))
        linear, angular, hinges, power = _acceleration(
            world, shape, bodies, relative, ctrl, water, dt
        )
        return advance(state, water, (linear, angular, (hinges,)), dt, shape.carries), power

    def sense(state: State) -> Sense:
        return Sense(
            state.position[2] - world.surface_height,
            state.velocity[2],
            quat_to_rows(state.quat)[2],
            state.spin,
        )

    def command(state: State) -> jax.Array:
        return jnp.zeros((0, *state.spin[0].shape), state.spin[0].dtype)

    order = np.arange(shape.rows)
    return Engine(init, step, observe, lambda state: state.position, sense, command, order)


def to_rows(bodies: Bodies, hinges: jax.Array) -> jax.Array:
    """`[hinges, lanes]` in each robot's order to `[rows, lanes]`; 0 where there is no hinge."""
    padded = jnp.concatenate([hinges, jnp.zeros_like(hinges[:1])])
    return jnp.take_along_axis(padded, jnp.asarray(bodies.hinge), 0)


def to_hinges(bodies: Bodies, rows: jax.Array) -> jax.Array:
    """The way back: `[rows, lanes]` to `[hinges, lanes]`."""
    padded = jnp.concatenate([rows, jnp.zeros_like(rows[:1])])
    return jnp.take_along_axis(padded, jnp.asarray(bodies.row), 0)


def acceleration(
    world: World,
    shape: Shape,
    bodies: Bodies,
    qpos: jax.Array,
    qvel: jax.Array,
    ctrl: jax.Array,
    water: Water,
) -> jax.Array:
    """Acceleration in MuJoCo's coordinates, as `dynamics.acceleration`, each robot's first.

    Args:
        world: around all of them.
        shape: of the tables.
        bodies: the individuals.
        qpos: `[7 + hinges, lanes]`.
        qvel: `[6 + hinges, lanes]`.
        ctrl: `[hinges, lanes]` joint targets [rad].
        water: surface and current.

    Returns:
        `[6 + hinges, lanes]`.
    """
    engine = make_mixed_engine(world, shape, bodies)
    state = engine.init(qpos, qvel)._replace(pace=())
    relative = state._replace(velocity=vsub(state.velocity, water.current))
    linear, angular, hinges, _ = _acceleration(
        world, shape, bodies, relative, to_rows(bodies, ctrl), water, 0.0
    )
    turn = quat_to_rows(state.quat)
    seen = matTvec(turn, relative.velocity)
    pushed = vadd(linear, cross(state.spin, seen))
    linear = tuple(dot(row, pushed) for row in turn)
    root = jnp.stack([*vadd(linear, water.acceleration), *angular])
    return jnp.concatenate([root, to_hinges(bodies, hinges)])
