"""One step of a whole population: an articulated body in water, the population on the last axis.

Featherstone's articulated-body algorithm (2008, Rigid Body Dynamics Algorithms, § 7.3) over levels
of bodies, in components (`spatial`), with the water's forces (`hydrodynamics`) and the carried
water's mass inside each body's 6×6 inertia. Integration is MuJoCo's semi-implicit Euler with
implicit joint damping, so that trajectories can be compared step by step.

Spatial quantities are (angular, linear), in each body's own frame, about its own origin.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.contact import bed_contact, bed_plane
from mjx_revolve.hydrodynamics import (
    Water,
    buoyancy,
    ellipsoid,
    inertia_box,
    lift_drag,
    quadratic_drag,
    submersion,
)
from mjx_revolve.robot import Robot
from mjx_revolve.spatial import (
    SYM,
    Mat,
    Scalar,
    Sym,
    Vec,
    add,
    cross,
    dot,
    fold,
    full,
    matmul,
    matTvec,
    matvec,
    mul,
    neg,
    quat_to_rows,
    rotate,
    rotate_sym,
    sincos,
    skew,
    sub,
    symvec,
    total,
    transpose,
    vadd,
    vscale,
    vsub,
)
from mjx_revolve.tree import Level, Parts, Points, Tree, make_tree
from mjx_revolve.world import World


class State(NamedTuple):
    """State of a population, component by component.

    Attributes:
        position: of the root, world frame [m], three of `[lanes]`.
        quat: of the root, world from body (w, x, y, z), four of `[lanes]`.
        velocity: of the root's origin, world frame [m/s], three of `[lanes]`.
        spin: angular velocity of the root, body frame [rad/s], three of `[lanes]`.
        angle: of the hinges, one `[nbody, lanes]` for each level below the root [rad].
        speed: of the hinges, likewise [rad/s].
    """

    position: Vec
    quat: tuple[Scalar, Scalar, Scalar, Scalar]
    velocity: Vec
    spin: Vec
    angle: tuple[jax.Array, ...]
    speed: tuple[jax.Array, ...]


class Engine(NamedTuple):
    """What a rollout needs of a simulator; the population step and MJX's give the same.

    Attributes:
        init: (qpos `[nq, lanes]`, qvel `[nv, lanes]`) → state.
        step: (state, ctrl `[nu, lanes]` in `order`, water) → (state, power `[lanes]` that the
            servos deliver or take up, summed without sign [W]).
        observe: state → (qpos `[nq, lanes]`, qvel `[nv, lanes]`).
        root: state → root position, world frame [m], three of `[lanes]`; cheaper than observe.
        order: `[nu]` actuator of each row of `step`'s ctrl.
    """

    init: Callable[[jax.Array, jax.Array], Any]
    step: Callable[[Any, jax.Array, Water], tuple[Any, jax.Array]]
    observe: Callable[[Any], tuple[jax.Array, jax.Array]]
    root: Callable[[Any], Vec]
    order: np.ndarray


class Motion(NamedTuple):
    """Where the bodies of a level are and how they move."""

    spin: Vec  # body frame
    velocity: Vec  # of the origin, body frame
    up: Vec  # world z in the body frame
    height: Scalar  # world z of the origin
    x_axis: Any  # world x and y in the body frame, where something needs them
    y_axis: Any
    place: Any  # world x and y of the origin


class SpatialInertia(NamedTuple):
    """A 6×6 spatial inertia [[angular, cross], [crossᵀ, linear]]."""

    angular: Sym
    cross: Mat
    linear: Sym


# ------------------------------------------------------------------ between the levels


def _take(x: Scalar, k: int) -> Scalar:
    return x[k : k + 1] if hasattr(x, "shape") and x.shape[0] > 1 else x


def _down(level: Level, x: Any) -> Any:
    """A quantity of the level above, for each body of this one."""
    if isinstance(x, tuple):
        return tuple(_down(level, y) for y in x)
    if x is None or not hasattr(x, "shape") or x.shape[0] == 1:
        return x
    if level.parent == tuple(range(x.shape[0])):
        return x
    return jnp.concatenate([x[k : k + 1] for k in level.parent])


def _up(level: Level, above: int, x: Any) -> Any:
    """The sum over each parent's children, for each body of the level above."""
    if isinstance(x, tuple):
        return tuple(_up(level, above, y) for y in x)
    if level.parent == tuple(range(above)):
        return x
    n = len(level.parent)
    if not isinstance(x, jax.Array):  # a constant stays one, so that it still folds away
        rows = np.broadcast_to(x, (n, 1))
        children = np.equal.outer(range(above), level.parent)
        return fold(children @ rows)
    if x.shape[0] == 1 and n > 1:
        x = jnp.broadcast_to(x, (n, *x.shape[1:]))
    if above == 1:
        return total(*[x[k : k + 1] for k in range(n)])
    sums = []
    for parent in range(above):
        children = [x[k : k + 1] for k in range(n) if level.parent[k] == parent]
        sums.append(total(*children) if children else jnp.zeros_like(x[:1]))
    return jnp.concatenate(sums)


def _sum_first(x: Scalar, n: int) -> Scalar:
    """Sum over the first axis, written out: XLA cannot reduce inside a called loop."""
    if not hasattr(x, "shape") or x.ndim < 3:
        return mul(float(n), x)
    return total(*[x[k] for k in range(x.shape[0])]) if x.shape[0] > 1 else mul(float(n), x[0])


# ------------------------------------------------------------------ the water on a level


def _drag(world: World, parts: Parts, v: Vec, w: Vec, share: Scalar) -> tuple[Vec, Vec]:
    """Force and torque of the world's drag law on each part, part frame, at the box's centre."""
    zero = (0.0, 0.0, 0.0)
    if world.drag == "faces":
        push = [
            quadratic_drag(x, c, share, m)
            for x, c, m in zip(v, parts.drag_linear, parts.limit_linear, strict=True)
        ]
        twist = [
            quadratic_drag(x, c, share, m)
            for x, c, m in zip(w, parts.drag_angular, parts.limit_angular, strict=True)
        ]
        return tuple(push), tuple(twist)
    if world.drag == "lift_drag":
        force = lift_drag(
            v,
            parts.plate_forward,
            parts.plate_upward,
            parts.plate_area,
            world.density,
            world.lift_drag,
        )
        return vscale(share, force), zero
    if world.drag == "ellipsoid":
        force, torque = ellipsoid(
            v, w, parts.ellipsoid, world.density, world.viscosity, not world.added_mass
        )
        return vscale(share, force), vscale(share, torque)
    return zero, zero


def _water_on_level(
    world: World, level: Level, motion: Motion, drift: Vec | None, water: Water
) -> tuple[Vec, Vec, SpatialInertia | None]:
    """Sum of the water's forces on each body of a level, and the inertia of the carried water.

    Returns:
        Torque [N·m] and force [N] about the body's origin, body frame, and the added inertia.
    """
    parts = level.parts
    zero = (0.0, 0.0, 0.0)
    if parts is None or (world.buoyancy == "off" and world.drag == "off" and not world.added_mass):
        return zero, zero, None
    n = len(level.body)
    k = max(
        x.shape[0] if isinstance(x, np.ndarray) else 1
        for x in (parts.volume, *parts.position, *parts.half_size, parts.plate_area)
    )
    shape = (k, n, 1)
    lanes = jnp.shape(motion.height)[-1]
    wide = lambda x: jnp.broadcast_to(x, (k, n, lanes))  # noqa: E731
    relative = motion.velocity if drift is None else vsub(motion.velocity, drift)
    at_part = vadd(relative, cross(motion.spin, parts.position))
    v = matTvec(parts.rotation, at_part)
    w = matTvec(parts.rotation, motion.spin)
    up = tuple(wide(x) for x in matTvec(parts.rotation, motion.up))
    depth = wide(
        sub(water.surface_height, add(motion.height, dot(motion.up, parts.center_position)))
    )
    # Without buoyancy the water still drags what is below its surface.
    mode = "mask" if world.buoyancy == "off" else world.buoyancy
    share, moment = submersion(up, depth, parts.half_size, mode)
    force, torque = _drag(world, parts, v, w, share)
    if world.buoyancy != "off":
        lift, righting = buoyancy(
            up, share, moment, parts.volume, parts.center, world.density * world.gravity
        )
        force, torque = vadd(force, lift), vadd(torque, righting)
    force = matvec(parts.rotation, force)
    torque = vadd(matvec(parts.rotation, torque), cross(parts.position, force))
    force = tuple(_sum_first(wide(x) if _is_array(x) else x, k) for x in force)
    torque = tuple(_sum_first(wide(x) if _is_array(x) else x, k) for x in torque)
    if world.drag == "inertia_box":
        of_body = _share_of_body(parts, share, shape)
        at_com = vadd(relative, cross(motion.spin, level.box_position))
        f, t = inertia_box(
            matTvec(level.box_rotation, at_com),
            matTvec(level.box_rotation, motion.spin),
            level.box_size,
            world.density,
            world.viscosity,
        )
        f = vscale(of_body, matvec(level.box_rotation, f))
        t = vadd(vscale(of_body, matvec(level.box_rotation, t)), cross(level.box_position, f))
        force, torque = vadd(force, f), vadd(torque, t)
    if not world.added_mass:
        return torque, force, None
    weigh = lambda x: _sum_first(mul(x, share), k) if np.any(x) else 0.0  # noqa: E731
    added = SpatialInertia(
        tuple(weigh(x) for x in parts.added_angular),
        tuple(tuple(weigh(x) for x in row) for row in parts.added_cross),
        tuple(weigh(x) for x in parts.added_linear),
    )
    return torque, force, added


def _is_array(x: Scalar) -> bool:
    return hasattr(x, "shape")


def _share_of_body(parts: Parts, share: Scalar, shape: tuple[int, ...]) -> Scalar:
    """Submerged share of a whole body, its parts weighted by volume."""
    volume = np.broadcast_to(parts.volume, shape)
    weight = volume / np.maximum(volume.sum(0), 1e-30)
    return _sum_first(mul(weight, share), shape[0])


def _bed_on_level(world: World, level: Level, motion: Motion, points: Points) -> tuple[Vec, Vec]:
    """Torque and force of the bed on each body, body frame, about its origin."""
    n, lanes = len(level.body), jnp.shape(motion.height)[-1]
    k = max(x.shape[0] if isinstance(x, np.ndarray) else 1 for x in points.position)
    wide = lambda x: jnp.broadcast_to(x, (k, n, lanes))  # noqa: E731
    assert world.bed is not None  # there are points only above a bed
    rows = (motion.x_axis, motion.y_axis, motion.up)
    ground, normal = bed_plane(world.bed, motion.place)
    normal = matTvec(rows, normal)
    # Depth of the body's origin below the tangent plane, then of each point.
    origin = mul(sub(ground, motion.height), dot(normal, motion.up))
    depth = wide(sub(origin, dot(normal, points.position)))
    velocity = vadd(motion.velocity, cross(motion.spin, points.position))
    normal, velocity = tuple(wide(x) for x in normal), tuple(wide(x) for x in velocity)
    force = bed_contact(world.bed, depth, normal, velocity, points.mass, world.timestep)
    torque = cross(points.position, force)
    return tuple(_sum_first(x, k) for x in torque), tuple(_sum_first(x, k) for x in force)


# ------------------------------------------------------------------ articulated bodies


def _cross_force(spin: Vec, velocity: Vec, angular: Vec, linear: Vec) -> tuple[Vec, Vec]:
    """The force cross product (Featherstone's v ×*): rate of change of a momentum seen turning."""
    return vadd(cross(spin, angular), cross(velocity, linear)), cross(spin, linear)


def _apply_inertia(inertia: SpatialInertia, spin: Vec, velocity: Vec) -> tuple[Vec, Vec]:
    angular = vadd(symvec(inertia.angular, spin), matvec(inertia.cross, velocity))
    linear = vadd(matvec(transpose(inertia.cross), spin), symvec(inertia.linear, velocity))
    return angular, linear


def outer_forces(
    world: World, level: Level, motion: Motion, drift: Vec | None, water: Water
) -> tuple[Vec, Vec, SpatialInertia | None]:
    """What water and bed do to the bodies of a level, their weight apart.

    The carried water enters as an inertia and as the force that its momentum needs when the body
    turns (Kirchhoff; Fossen 2011, Handbook of Marine Craft Hydrodynamics, § 6.3): its momentum is A
    ν_r, and in a uniform current u, d(v - u)/dt in the body's frame is dv/dt + ω × u.

    Args:
        world: which laws act.
        level: the bodies.
        motion: where they are and how they move.
        drift: velocity of the water, body frame [m/s], or None in still water.
        water: surface and current.

    Returns:
        Torque [N·m] and force [N] about each body's origin, body frame, and the carried water's
        inertia, or None where there is none.
    """
    torque, force, added = _water_on_level(world, level, motion, drift, water)
    if level.points is not None:
        on_torque, on_force = _bed_on_level(world, level, motion, level.points)
        torque, force = vadd(torque, on_torque), vadd(force, on_force)
    if added is not None:
        relative = motion.velocity if drift is None else vsub(motion.velocity, drift)
        swirl = _cross_force(motion.spin, relative, *_apply_inertia(added, motion.spin, relative))
        torque, force = vsub(torque, swirl[0]), vsub(force, swirl[1])
        if drift is not None:
            turning = _apply_inertia(added, (0.0, 0.0, 0.0), cross(motion.spin, drift))
            torque, force = vsub(torque, turning[0]), vsub(force, turning[1])
    return torque, force, added


def _own(
    world: World, level: Level, motion: Motion, drift: Vec | None, water: Water
) -> tuple[SpatialInertia, tuple[Vec, Vec]]:
    """Each body's inertia with its carried water, and the bias force that needs no acceleration."""
    h = level.moment
    inertia = SpatialInertia(
        level.inertia, skew(h), (level.mass, 0.0, 0.0, level.mass, 0.0, level.mass)
    )
    momentum = _apply_inertia(inertia, motion.spin, motion.velocity)
    bias = _cross_force(motion.spin, motion.velocity, *momentum)
    torque, force, added = outer_forces(world, level, motion, drift, water)
    weight = vscale(-world.gravity, motion.up)
    force = vadd(force, vscale(level.mass, weight))
    torque = vadd(torque, cross(h, weight))
    if added is not None:
        inertia = SpatialInertia(
            vadd(inertia.angular, added.angular),
            tuple(vadd(a, b) for a, b in zip(inertia.cross, added.cross, strict=True)),
            vadd(inertia.linear, added.linear),
        )
    return inertia, (vsub(bias[0], torque), vsub(bias[1], force))


def water_drift(motion: Motion, water: Water) -> Vec:
    """The current seen from each body's frame [m/s]."""
    axes = (motion.x_axis, motion.y_axis, motion.up)
    return tuple(
        total(*[mul(c, axis[i]) for c, axis in zip(water.current, axes, strict=True)])
        for i in range(3)
    )


def is_drifting(water: Water) -> bool:
    """Whether there may be a current: a traced one counts, a plain 0 does not."""
    return any(not isinstance(c, int | float) or c != 0 for c in water.current)


def _to_parent(
    turn: Mat, position: Vec, inertia: SpatialInertia, bias: tuple[Vec, Vec]
) -> tuple[SpatialInertia, tuple[Vec, Vec]]:
    """An articulated inertia and its bias force, seen from the parent's frame and origin."""
    angular = rotate_sym(turn, inertia.angular)
    across = rotate(turn, inertia.cross)
    linear = rotate_sym(turn, inertia.linear)
    torque, force = (matvec(turn, x) for x in bias)
    r = skew(position)
    shifted = tuple(vadd(a, b) for a, b in zip(across, matmul(r, full(linear)), strict=True))
    first = matmul(r, transpose(across))  # [r]ₓ crossᵀ
    second = matmul(shifted, r)
    moved = tuple(sub(add(angular[k], first[i][j]), second[i][j]) for k, (i, j) in enumerate(SYM))
    return SpatialInertia(moved, shifted, linear), (vadd(torque, cross(position, force)), force)


def _solve_root(inertia: SpatialInertia, bias: tuple[Vec, Vec]) -> tuple[Vec, Vec]:
    """Acceleration of the free root: inertia a = -bias, by LDLᵀ, linear block first."""
    angular, across, linear = full(inertia.angular), inertia.cross, full(inertia.linear)
    a = [[0.0] * 6 for _ in range(6)]
    for i in range(3):
        for j in range(3):
            a[i][j], a[i + 3][j + 3] = linear[i][j], angular[i][j]
            a[i + 3][j] = across[i][j]
    rhs = [neg(x) for x in (*bias[1], *bias[0])]
    lower = [[0.0] * 6 for _ in range(6)]
    diagonal: list[Scalar] = [0.0] * 6
    inverse: list[Scalar] = [0.0] * 6
    for j in range(6):
        scaled = [mul(lower[j][k], diagonal[k]) for k in range(j)]
        diagonal[j] = sub(a[j][j], total(*[mul(lower[j][k], scaled[k]) for k in range(j)]))
        inverse[j] = 1 / diagonal[j]
        for i in range(j + 1, 6):
            rest = total(*[mul(lower[i][k], scaled[k]) for k in range(j)])
            lower[i][j] = mul(sub(a[i][j], rest), inverse[j])
    for i in range(6):
        rhs[i] = sub(rhs[i], total(*[mul(lower[i][k], rhs[k]) for k in range(i)]))
    rhs = [mul(x, y) for x, y in zip(rhs, inverse, strict=True)]
    for i in reversed(range(6)):
        rhs[i] = sub(rhs[i], total(*[mul(lower[k][i], rhs[k]) for k in range(i + 1, 6)]))
    return tuple(rhs[3:]), tuple(rhs[:3])


# Share of its top speed up to which a servo gives its full effort [-]. A choice, between the
# straight line of a bare motor (0) and Revolve's box of effort and speed (1).
_KNEE = 0.75


def servo(
    level: Level, angle: Scalar, speed: Scalar, target: Scalar, dt: float
) -> tuple[Scalar, Scalar]:
    """Torque of the position servos, and what an implicit step adds to the joints' inertia.

    MuJoCo's position actuator, clip(k_p (target - q), ± effort), on a motor whose driver limits its
    current: full effort up to three quarters of its top speed w, from there a line that the
    joint's friction d q̇ meets at the top speed,

        τ ≤ d w + k (w - q̇),   k = (effort - d w) / (w / 4),

    and likewise backwards. Below the knee it is stock MuJoCo. The line acts on the speed
    at the end of the step as soon as it may be met within the step: a light limb could otherwise
    pass the top speed in one step from rest.

    Args:
        level: whose hinges.
        angle: q `[nbody, lanes]` [rad].
        speed: q̇ `[nbody, lanes]` [rad/s].
        target: `[nbody, lanes]` [rad].
        dt: for which the line is implicit [s]; 0 for none.

    Returns:
        Torque [N·m] and inertia [kg·m²], `[nbody, lanes]`.
    """
    target = jnp.clip(target, _cast(level.target[0], target), _cast(level.target[1], target))
    torque = sub(mul(level.gain, target), mul(level.stiffness, angle))
    torque = sub(torque, mul(level.servo_damping, speed))
    low, high = (_cast(x, torque) for x in level.effort)
    torque = jnp.clip(torque, low, high)
    top = np.asarray(level.top_speed, np.float64)
    limited = np.isfinite(top) & np.isfinite(level.effort[1])
    if not np.any(limited):
        return torque, jnp.zeros_like(torque)
    w = np.where(limited, top, 1.0)
    friction = np.asarray(level.damping) * w
    effort = np.where(limited, level.effort[1], friction)
    slope = np.where(limited, np.maximum((effort - friction) / ((1 - _KNEE) * w), 0), 0)
    # No limb is lighter than the body that the hinge carries: where the line may be met.
    reach = dt / (np.asarray(level.inertia[5]) + np.asarray(level.armature) + dt * level.damping)
    forward = jnp.sign(torque)
    rate = forward * speed
    push = jnp.abs(torque)
    ahead = rate + _cast(reach, torque) * (push - _cast(level.damping, torque) * rate)
    f0, f1, f2 = (_cast(x, torque) for x in (friction, slope, w))
    line = lambda x: f0 + f1 * (f2 - x)  # noqa: E731
    met = (line(ahead) < push) & limited
    torque = jnp.where(met, forward * jnp.minimum(push, line(rate)), torque)
    return torque, jnp.where(met, dt * _cast(slope, torque), jnp.zeros_like(torque))


def _cast(x: Scalar, like: jax.Array) -> Scalar:
    return np.asarray(x, like.dtype)


def end_stop(level: Level, angle: Scalar, speed: Scalar, dt: float) -> tuple[Scalar, Scalar]:
    """Torque of the joint's end stops, and what an implicit step adds to the joint's inertia.

    A spring that acts on the angle at the end of the step, q + dt q̇: linearly implicit, so it is
    stable at any stiffness (cf. MuJoCo's soft limit constraint, which it stands in for).
    """
    low, high = (_cast(x, angle) for x in level.range)
    ahead = angle + dt * speed
    over = jnp.maximum(ahead - high, 0) - jnp.maximum(low - ahead, 0)
    stop = _cast(level.stop, angle)
    return -stop * over, jnp.where(over != 0, dt * dt * stop, jnp.zeros_like(angle))


def _acceleration(
    tree: Tree, state: State, targets: tuple[Scalar, ...], water: Water, dt: float
) -> tuple[Vec, Vec, tuple[Scalar, ...], Scalar]:
    """Accelerations, by the articulated-body algorithm.

    Args:
        tree: the robot.
        state: the population.
        targets: of the servos, one `[nbody, lanes]` for each level below the root [rad].
        water: surface and current.
        dt: for which joint damping and end stops are implicit [s]; 0 for none.

    Returns:
        Root: linear, world frame [m/s²], angular, body frame [rad/s²]; hinges [rad/s²]; servo
        power, summed over the hinges without sign [W], `[lanes]`.
    """
    world = tree.robot.world
    row = lambda xs: tuple(x[None] for x in xs)  # noqa: E731
    turn_root = tuple(row(r) for r in quat_to_rows(state.quat))
    drifting = is_drifting(water)
    located = drifting or any(level.points is not None for level in tree.levels)
    root = Motion(
        spin=row(state.spin),
        velocity=matTvec(turn_root, row(state.velocity)),
        up=turn_root[2],
        height=state.position[2][None],
        x_axis=turn_root[0] if located else None,
        y_axis=turn_root[1] if located else None,
        place=row(state.position[:2]) if located else None,
    )
    motions, owns = [root], []
    turns: list[Any] = [None]  # the root has no joint
    coriolis: list[Any] = [None]
    for level, angle, speed in zip(tree.levels[1:], state.angle, state.speed, strict=True):
        parent = Motion(*[_down(level, x) for x in motions[-1]])
        sine, cosine = sincos(angle)
        r = level.rotation
        turn = tuple(
            (
                add(mul(r[i][0], cosine), mul(r[i][1], sine)),
                sub(mul(r[i][1], cosine), mul(r[i][0], sine)),
                r[i][2],
            )
            for i in range(3)
        )
        spin = matTvec(turn, parent.spin)
        spin = (spin[0], spin[1], add(spin[2], speed))
        velocity = matTvec(turn, vadd(parent.velocity, cross(parent.spin, level.position)))
        place = None
        if located:
            place = (
                add(parent.place[0], dot(parent.x_axis, level.position)),
                add(parent.place[1], dot(parent.y_axis, level.position)),
            )
        motions.append(
            Motion(
                spin=spin,
                velocity=velocity,
                up=matTvec(turn, parent.up),
                height=add(parent.height, dot(parent.up, level.position)),
                x_axis=matTvec(turn, parent.x_axis) if located else None,
                y_axis=matTvec(turn, parent.y_axis) if located else None,
                place=place,
            )
        )
        turns.append(turn)
        # Velocity times joint velocity (Featherstone's c_J): ν × (z q̇).
        coriolis.append(
            (
                (mul(spin[1], speed), neg(mul(spin[0], speed)), 0.0),
                (mul(velocity[1], speed), neg(mul(velocity[0], speed)), 0.0),
            )
        )
    for level, motion in zip(tree.levels, motions, strict=True):
        drift = water_drift(motion, water) if drifting else None
        owns.append(_own(world, level, motion, drift, water))

    # Tips to root: articulated inertias.
    inertias = [inertia for inertia, _ in owns]
    biases = [bias for _, bias in owns]
    power: Scalar = 0.0
    joint: list[Any] = [None] * len(tree.levels)
    for d in range(len(tree.levels) - 1, 0, -1):
        level, angle, speed = tree.levels[d], state.angle[d - 1], state.speed[d - 1]
        inertia, bias = inertias[d], biases[d]
        motor, motor_inertia = servo(level, angle, speed, targets[d - 1], dt)
        delivered = jnp.abs(motor * speed)
        power = add(power, total(*[delivered[k] for k in range(delivered.shape[0])]))
        stop, stop_inertia = end_stop(level, angle, speed, dt)
        torque = sub(add(motor, stop), mul(level.damping, speed))
        column_a = full(inertia.angular)[2]
        column_l = inertia.cross[2]
        own = add(
            add(column_a[2], level.armature),
            add(mul(dt, level.damping), add(stop_inertia, motor_inertia)),
        )
        inverse = 1 / own
        rest = sub(torque, bias[0][2])
        joint[d] = (column_a, column_l, inverse, rest)
        scaled_a, scaled_l = vscale(inverse, column_a), vscale(inverse, column_l)
        left = SpatialInertia(
            tuple(
                sub(inertia.angular[k], mul(column_a[i], scaled_a[j]))
                for k, (i, j) in enumerate(SYM)
            ),
            tuple(
                tuple(sub(inertia.cross[i][j], mul(column_a[i], scaled_l[j])) for j in range(3))
                for i in range(3)
            ),
            tuple(
                sub(inertia.linear[k], mul(column_l[i], scaled_l[j]))
                for k, (i, j) in enumerate(SYM)
            ),
        )
        carried = _apply_inertia(left, *coriolis[d])
        bias = (
            vadd(vadd(bias[0], carried[0]), vscale(rest, scaled_a)),
            vadd(vadd(bias[1], carried[1]), vscale(rest, scaled_l)),
        )
        above = len(tree.levels[d - 1].body)
        moved, bias = _to_parent(turns[d], level.position, left, bias)
        moved, bias = _up(level, above, tuple(moved)), _up(level, above, bias)
        inertias[d - 1] = SpatialInertia(
            vadd(inertias[d - 1].angular, moved[0]),
            tuple(vadd(a, b) for a, b in zip(inertias[d - 1].cross, moved[1], strict=True)),
            vadd(inertias[d - 1].linear, moved[2]),
        )
        biases[d - 1] = tuple(vadd(a, b) for a, b in zip(biases[d - 1], bias, strict=True))

    # Root to tips: accelerations.
    angular, linear = _solve_root(inertias[0], biases[0])
    accelerations, hinges = [(angular, linear)], []
    for d in range(1, len(tree.levels)):
        level, turn = tree.levels[d], turns[d]
        column_a, column_l, inverse, rest = joint[d]
        up_angular, up_linear = (_down(level, x) for x in accelerations[-1])
        a = vadd(matTvec(turn, up_angular), coriolis[d][0])
        b = vadd(matTvec(turn, vadd(up_linear, cross(up_angular, level.position))), coriolis[d][1])
        hinge = mul(inverse, sub(sub(rest, dot(column_a, a)), dot(column_l, b)))
        hinges.append(hinge)
        accelerations.append(((a[0], a[1], add(a[2], hinge)), b))
    world_linear = matvec(turn_root, vadd(linear, cross(root.spin, root.velocity)))
    lane = lambda x: jnp.broadcast_to(x, (1, state.position[0].shape[0]))[0]  # noqa: E731
    return (
        tuple(lane(x) for x in world_linear),
        tuple(lane(x) for x in angular),
        tuple(hinges),
        power if _is_array(power) else jnp.zeros_like(state.position[0]),
    )


def turn_quat(quat: tuple[Scalar, ...], spin: Vec, dt: float) -> tuple[Scalar, ...]:
    """Turns a quaternion by a body-frame rotation of spin · dt, and normalises it."""
    half = vscale(0.5 * dt, spin)
    square = dot(half, half)
    if square.dtype == jnp.float32:
        # sin(x)/x and cos(x) as series: below half a turn per step they are exact to float32.
        sine = 1 + square * (-1 / 6 + square * (1 / 120 + square * (-1 / 5040)))
        cosine = 1 + square * (-1 / 2 + square * (1 / 24 + square * (-1 / 720)))
    else:
        angle = jnp.sqrt(square + 1e-300)
        sine, cosine = jnp.sin(angle) / angle, jnp.cos(angle)
    a, b, c, d = quat
    e, (f, g, h) = cosine, vscale(sine, half)
    turned = (
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    )
    scale = 1 / jnp.sqrt(total(*[x * x for x in turned]))
    return tuple(x * scale for x in turned)


# ------------------------------------------------------------------ the engine


def make_population_engine(robot: Robot, contact: bool = True) -> Engine:
    """The population step of a robot.

    Args:
        robot: from `build_robot`.
        contact: whether the robot can touch the bed; leaving it out makes a step much cheaper.

    Returns:
        The engine; its functions are pure, and run under jit, vmap and grad.

    Raises:
        InputError: the model holds something that the population step cannot do.
    """
    tree = make_tree(robot, contact)
    model, dt = robot.mj_model, robot.world.timestep
    sizes = [len(level.body) for level in tree.levels[1:]]
    edges = np.concatenate([[0], np.cumsum(sizes)]).astype(int)
    spans = list(itertools.pairwise(edges))

    def init(qpos: jax.Array, qvel: jax.Array) -> State:
        angle, speed = qpos[tree.qpos_index], qvel[tree.qvel_index]
        # MuJoCo accepts quaternions of any length and normalises them before use.
        length = jnp.sqrt(jnp.sum(qpos[3:7] ** 2, 0))
        return State(
            position=tuple(qpos[:3]),
            quat=tuple(qpos[3:7] / length),
            velocity=tuple(qvel[:3]),
            spin=tuple(qvel[3:6]),
            angle=tuple(angle[a:b] for a, b in spans),
            speed=tuple(speed[a:b] for a, b in spans),
        )

    def observe(state: State) -> tuple[jax.Array, jax.Array]:
        qpos = jnp.stack([*state.position, *state.quat])
        qvel = jnp.stack([*state.velocity, *state.spin])
        if spans:
            back = np.argsort(tree.qpos_index)
            qpos = jnp.concatenate([qpos, jnp.concatenate(state.angle)[back]])
            qvel = jnp.concatenate([qvel, jnp.concatenate(state.speed)[back]])
        return qpos, qvel

    def step(state: State, ctrl: jax.Array, water: Water) -> tuple[State, jax.Array]:
        targets = tuple(ctrl[a:b] for a, b in spans)
        linear, angular, hinges, power = _acceleration(tree, state, targets, water, dt)
        velocity = tuple(v + dt * a for v, a in zip(state.velocity, linear, strict=True))
        spin = tuple(w + dt * a for w, a in zip(state.spin, angular, strict=True))
        speed = tuple(w + dt * a for w, a in zip(state.speed, hinges, strict=True))
        new = State(
            position=tuple(x + dt * v for x, v in zip(state.position, velocity, strict=True)),
            quat=turn_quat(state.quat, spin, dt),
            velocity=velocity,
            spin=spin,
            angle=tuple(q + dt * w for q, w in zip(state.angle, speed, strict=True)),
            speed=speed,
        )
        return new, power

    assert model.nq == 7 + len(tree.qpos_index)
    return Engine(init, step, observe, lambda state: state.position, tree.ctrl_index)


def acceleration(
    robot: Robot, qpos: jax.Array, qvel: jax.Array, ctrl: jax.Array, water: Water
) -> jax.Array:
    """Acceleration of a population in MuJoCo's coordinates, as `mj_forward` defines it.

    Args:
        robot: from `build_robot`.
        qpos: `[nq, lanes]`.
        qvel: `[nv, lanes]`.
        ctrl: `[nu, lanes]` servo targets, in MuJoCo's order [rad].
        water: surface and current.

    Returns:
        `[nv, lanes]` qacc: root linear, world frame [m/s²], root angular, body frame [rad/s²],
        hinges [rad/s²].
    """
    tree, engine = make_tree(robot), make_population_engine(robot)
    ctrl = ctrl[tree.ctrl_index]
    edges = np.cumsum([len(level.body) for level in tree.levels[1:]])[:-1]
    targets = tuple(jnp.split(ctrl, edges)) if len(tree.levels) > 1 else ()
    linear, angular, hinges, _ = _acceleration(tree, engine.init(qpos, qvel), targets, water, 0.0)
    root = jnp.stack([*linear, *angular])
    if not hinges:
        return root
    return jnp.concatenate([root, jnp.concatenate(hinges)[np.argsort(tree.qvel_index)]])
