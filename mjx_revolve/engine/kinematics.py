"""Forward kinematics: pose and velocity of all bodies from the root to the tips."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_revolve.engine.level import Hinges, Level
from mjx_revolve.engine.robot import Robot
from mjx_revolve.engine.single_tree import make_single_tree
from mjx_revolve.engine.state import State
from mjx_revolve.engine.tree import Tree
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics.articulated import to_child
from mjx_revolve.numerics.inertia import BodyMotion
from mjx_revolve.numerics.spatial import (
    UNIT,
    ZERO,
    Mat,
    Scalar,
    Vec,
    add,
    dot,
    matmul,
    matTvec,
    matvec,
    mul,
    namespace,
    quat_to_mat,
    sincos,
    sub,
    vadd,
    vscale,
    vsub,
)


def forward_kinematics(
    tree: Tree, state: State, located: bool, dt: float = 0.0
) -> tuple[BodyMotion, Any]:
    """Pose and velocity of all bodies.

    Args:
        tree: the robots.
        state: their velocities relative to the uniform current.
        located: whether horizontal positions are needed.
        dt: timestep, for velocities at its midpoint [s]; 0 for none.

    Returns:
        The root's motion; (motion, rotation parent from child) of the bodies below it, as the tree
        stores them.
    """
    rotation = tuple(map(_row, quat_to_mat(state.quat)))
    velocity, midpoint_speed, midpoint = _row(state.velocity), state.speed, None
    root = BodyMotion(
        angular_velocity=_row(state.angular_velocity),
        velocity=matTvec(rotation, velocity),
        z_axis=rotation[2],
        height=state.position[2][None],
        x_axis=rotation[0] if located else None,
        y_axis=rotation[1] if located else None,
        xy=_row(state.position[:2]) if located else None,
    )
    if state.qacc_prev and dt:
        half = lambda v, a: add(v, mul(0.5 * dt, a))  # noqa: E731
        linear, angular, hinges = state.qacc_prev
        midpoint_speed = jax.tree.map(half, state.speed, hinges)
        pairs = (root.angular_velocity, angular), (root.velocity, linear)
        midpoint = tuple(tuple(map(half, v, _row(a))) for v, a in pairs)
        root = root._replace(midpoint=midpoint)

    def move(level: Level, parent: BodyMotion, angle: Scalar, speed: Scalar, ahead: Scalar) -> Any:
        assert level.hinges is not None
        rotation, position = hinge_rotation(level.hinges, angle), level.hinges.position
        angular_velocity, velocity = _child_velocity(rotation, position, parent.twist, speed)
        x_axis, y_axis, xy = None, None, None
        if located:
            x_axis, y_axis = matTvec(rotation, parent.x_axis), matTvec(rotation, parent.y_axis)
            xy = vadd(parent.xy, matvec((parent.x_axis, parent.y_axis), position))
        height = add(parent.height, dot(parent.z_axis, position))
        midpoint = parent.midpoint and _child_velocity(rotation, position, parent.midpoint, ahead)
        z_axis = matTvec(rotation, parent.z_axis)
        motion = BodyMotion(
            angular_velocity, velocity, z_axis, height, x_axis, y_axis, xy, midpoint
        )
        return motion, (motion, rotation)

    return root, tree.forward_pass(move, root, state.angle, state.speed, midpoint_speed)


def _row(xs: Any) -> Any:
    """The root as a level of one body."""
    return tuple(x[None] for x in xs)


def hinge_rotation(hinges: Hinges, angle: Scalar) -> Mat:
    """Rotation of each body's frame, parent from child."""
    sine, cosine = sincos(angle)
    c, s = hinges.offset
    cosine, sine = sub(mul(c, cosine), mul(s, sine)), add(mul(s, cosine), mul(c, sine))
    r = hinges.rotation
    return tuple(
        (
            add(mul(r[i][0], cosine), mul(r[i][1], sine)),
            sub(mul(r[i][1], cosine), mul(r[i][0], sine)),
            r[i][2],
        )
        for i in range(3)
    )


def _child_velocity(
    rotation: Mat, position: Vec, velocity: tuple[Vec, Vec], speed: Scalar
) -> tuple[Vec, Vec]:
    """Angular and linear velocity of a child from those of its parent."""
    (x, y, z), linear = to_child(rotation, position, velocity)
    return (x, y, add(z, speed)), linear


class BodyFrames(NamedTuple):
    """Poses of rigid bodies, `[1 + nhinge, lanes]` each, in the order of `Tree.join_rows`.

    Attributes:
        rotation: root's frame from body.
        position: of the origins, root's frame [m].
    """

    rotation: Mat
    position: Vec


def body_frames(
    tree: Tree, turns: Any, places: Any, steps: Any, like: jax.Array
) -> tuple[BodyFrames, BodyFrames]:
    """Poses of a robot's bodies now, and when its hinges have turned further; as in `level`.

    Args:
        tree: the robots.
        turns: joint values: parent from child now.
        places: joint values: of the hinges in the parents' frames [m].
        steps: joint values: by what angle they turn [rad].
        like: `[lanes]`.

    Returns:
        Both poses.
    """
    root = (UNIT, ZERO)

    def move(_: Level, parents: Any, turn: Mat, place: Vec, step: Scalar) -> Any:
        s, c = sincos(step)
        ahead = tuple((add(mul(c, x), mul(s, y)), sub(mul(c, y), mul(s, x)), z) for x, y, z in turn)
        found = tuple(
            (matmul(rotation, own), vadd(position, matvec(rotation, place)))
            for (rotation, position), own in zip(parents, (turn, ahead), strict=True)
        )
        return found, found

    below = tree.forward_pass(move, (root, root), turns, places, steps)
    rows = tree.stack_saved(below, lambda saved: saved, like)

    def join(first: float, others: jax.Array) -> jax.Array:
        return jnp.concatenate([jnp.full((1, *like.shape), first, like.dtype), others])

    frames = jax.tree.map(join, (root, root), rows)
    return BodyFrames(*frames[0]), BodyFrames(*frames[1])


def body_motions(tree: Tree, state: State) -> BodyMotion:
    """Motion of the core's rigid body, then of what each hinge carries.

    Returns:
        `[1 + nhinge, lanes]` each, in the order of `Tree.join_rows`; velocities over ground. Each
        body's frame lies at its hinge and has the hinge's axis for its z (see `level`).
    """
    (root, below), like = forward_kinematics(tree, state, True), state.position[0]
    root = jax.tree.map(lambda x: jnp.broadcast_to(x, (1, *like.shape)), root)
    rows = tree.stack_saved(below, lambda saved: saved[0], like)
    return root if rows is None else jax.tree.map(lambda *x: jnp.concatenate(x), root, rows)


def center_of_mass(tree: Tree, state: State) -> Vec:
    """Centre of mass of robots without the water that they hold or carry, world frame.

    Args:
        tree: the robots.
        state: the population.

    Returns:
        x, y and z, `[lanes]` each [m].
    """
    root, below = forward_kinematics(tree, state, True)
    core = state.position

    def weigh(level: Level, children: Any, moved: tuple[BodyMotion, Any]) -> tuple[Any, Any, Any]:
        motion = moved[0]
        wide = lambda x: add(x, jnp.zeros_like(motion.height))  # noqa: E731
        # From the core: far from the origin, products with a mass would lose digits.
        away = vscale(level.mass, vsub(motion.position, core))
        moment = tuple(map(wide, vadd(away, matvec(motion.axes, level.moment))))
        return (), (), (wide(level.mass), moment)

    _, _, (mass, moment) = tree.backward_pass(weigh, ((), (0.0, ZERO)), below)
    own_mass, own = jax.tree.map(lambda x: x[0], weigh(tree.root, None, (root, None))[2])
    whole = add(own_mass, mass)
    return tuple(x + add(m, n) / whole for x, m, n in zip(core, own, moment, strict=True))


def body_poses(
    robot: Robot, qpos: Float[Array, "n nq"]
) -> tuple[Float[Array, "n nbody 3"], Float[Array, "n nbody 3 3"]]:
    """Pose of every body: MuJoCo's `xpos` and `xmat`, for many configurations at once.

    Args:
        robot: from `build_robot`.
        qpos: of NumPy, then so is the result and nothing is compiled; or of JAX.

    Returns:
        Positions [m] and rotations (world from body) in the world frame; body 0 is the world.

    Raises:
        InputError: qpos has another shape.
    """
    nq = 7 + robot.num_hinges
    if len(np.shape(qpos)) != 2 or np.shape(qpos)[1] != nq:
        raise InputError("qpos", f"[n, {nq}]", list(np.shape(qpos)))
    xp, tree = namespace(qpos), make_single_tree(robot, contact=False)
    columns = qpos.T
    quat = columns[3:7] / xp.linalg.norm(columns[3:7], axis=0)
    angle = tree.joints_to_tree(columns[7:])
    zero = tuple(xp.zeros_like(columns[:3]))
    still = jax.tree.map(xp.zeros_like, angle)
    state = State(tuple(columns[:3]), tuple(quat), zero, zero, angle, still)
    root, below = forward_kinematics(tree, state, True)
    lanes, nbody = len(qpos), len(robot.assembly.parent)
    place: list[Any] = [xp.zeros((lanes, 3), qpos.dtype)] * nbody
    turn: list[Any] = [xp.broadcast_to(xp.eye(3, dtype=qpos.dtype), (lanes, 3, 3))] * nbody
    motions = (root, *(motion for motion, _ in below))
    for motion, bodies, frames in zip(motions, tree.bodies, tree.frames, strict=True):
        count = len(bodies)
        wide = lambda x, n=count: xp.broadcast_to(x, (n, lanes))  # noqa: E731
        positions = xp.stack([wide(x) for x in motion.position], -1)
        axes = xp.stack([xp.stack([wide(x) for x in axis], -1) for axis in motion.axes], -2)
        for k, (body, frame) in enumerate(zip(bodies, frames, strict=True)):
            # From the hinge's frame to MuJoCo's.
            place[body], turn[body] = positions[k], axes[k] @ xp.asarray(frame.T, qpos.dtype)
    return xp.stack(place, 1), xp.stack(turn, 1)


def mass_centers(robot: Robot, qpos: Float[np.ndarray, "n nq"]) -> Float[np.ndarray, "n 3"]:
    """`center_of_mass` of one robot in many configurations, by NumPy, world frame [m]."""
    place, turn = body_poses(robot, qpos)  # type: ignore[arg-type]  # of NumPy's arrays
    mass = robot.assembly.mass
    centers = place + np.einsum("nbij,bj->nbi", turn, robot.assembly.center)
    return np.einsum("b,nbi->ni", mass, centers) / mass.sum()
