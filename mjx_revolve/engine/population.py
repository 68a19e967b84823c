"""The population engine: one step of many robots, for one body and for many different ones.

Integration is MuJoCo's semi-implicit Euler with implicit joint damping, so that trajectories can be
compared step by step. `Tree` traverses the robots, `dynamics` has their accelerations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_revolve.engine.dynamics import accelerate
from mjx_revolve.engine.engine import Engine
from mjx_revolve.engine.interaction import RobotInteraction
from mjx_revolve.engine.plant import Plant, actuators_of, plant_of
from mjx_revolve.engine.robot import Robot, check_timestep
from mjx_revolve.engine.single_tree import SingleTree, make_single_tree
from mjx_revolve.engine.state import RootState, State, integrate
from mjx_revolve.engine.thrusters import run_thrusters
from mjx_revolve.engine.tree import Tree
from mjx_revolve.engine.variation import Variation
from mjx_revolve.numerics.spatial import (
    Scalar,
    add,
    cross,
    matTvec,
    matvec,
    quat_to_mat,
    total,
    vadd,
    vsub,
)
from mjx_revolve.numerics.xla import fuse_outermost
from mjx_revolve.water.flow import Water


@dataclass(frozen=True, eq=False)
class PopulationEngine(Engine[State]):
    """The population step as an `Engine`; its functions are pure, and run under jit, vmap and grad.

    Attributes:
        tree: the robots.
        plant: their actuators.
        variation: factors on their coefficients; None for none.
        interaction: contact and sight between robots of one world; None for none.
    """

    tree: Tree
    plant: Plant
    variation: Variation | None = None
    interaction: RobotInteraction | None = None

    elementwise = True

    @property
    def _varied(self) -> Tree:
        # Varied where they are used: a loop then holds a few factors, not all constants by lanes.
        return self.tree.with_variation(self.variation)

    def with_variation(self, variation: Variation) -> PopulationEngine:
        """The same engine with other coefficients."""
        return replace(self, variation=variation)

    def init(self, qpos: Float[Array, "nq lanes"], qvel: Float[Array, "nv lanes"]) -> State:
        """The state of a population, thrusters at rest."""
        return init(self.tree, qpos, qvel)

    def step(
        self, state: State, ctrl: Float[Array, "n lanes"], water: Water, wrench: Any = ()
    ) -> tuple[State, Float[Array, " lanes"]]:
        """The state after a step, and the power of servos and ideal propellers [W]."""
        return fuse_outermost(self._step, state, ctrl, water, wrench)

    def _step(
        self, state: State, ctrl: jax.Array, water: Water, wrench: Any
    ) -> tuple[State, jax.Array]:
        tree = self._varied
        dt = tree.world.timestep
        targets, command, thrusts, pumped = actuate(tree, state, ctrl)
        # The whole step is seen from the uniform current: there, no current is left.
        relative = state._replace(velocity=vsub(state.velocity, water.current))
        qacc, power, submerged, clearance, pressed = accelerate(
            tree, relative, targets, water, thrusts, dt, wrench
        )
        new = integrate(state, water, qacc, dt, tree.carries)
        new = new._replace(
            command=command, submerged=submerged, clearance=clearance, pressed=pressed
        )
        return new, add(power, pumped)

    def observe(self, state: State) -> tuple[Float[Array, "nq lanes"], Float[Array, "nv lanes"]]:
        """Qpos and qvel in MuJoCo's order."""
        like = state.position[0]
        qpos = jnp.stack([*state.position, *state.quat])
        qvel = jnp.stack([*state.velocity, *state.angular_velocity])
        return (
            jnp.concatenate([qpos, self.tree.tree_to_joints(state.angle, like)]),
            jnp.concatenate([qvel, self.tree.tree_to_joints(state.speed, like)]),
        )

    def root(self, state: State) -> RootState:
        """Pose and velocity of the core."""
        return RootState(state.position, state.quat, state.velocity, state.angular_velocity)

    def joints(self, state: State) -> tuple[Float[Array, "hinges lanes"], ...]:
        """Angles [rad] and speeds [rad/s] of the hinges."""
        like = state.position[0]
        return self.tree.join_rows(state.angle, like), self.tree.join_rows(state.speed, like)

    def thruster_command(self, state: State) -> Float[Array, "nthruster lanes"]:
        """The thrusters' commands behind their lag."""
        if self.tree.thrusters.count:
            return state.command
        return jnp.zeros((0, *state.position[0].shape))

    def _thrusts(self, tree: Tree, state: State, ctrl: jax.Array) -> Any:
        return actuate(tree, state, ctrl)[2]


def actuate(tree: Tree, state: State, ctrl: jax.Array) -> tuple[Any, Any, Any, Scalar]:
    """Targets of the servos, then the thrusters' commands, thrusts and power."""
    count = tree.thrusters.count
    hinges = ctrl.shape[0] - count
    targets = tree.split_rows(ctrl[:hinges])
    if not count:
        return targets, (), (), 0.0
    given = tree.thrusters, state.command, ctrl[hinges:], tree.world.density
    command, thrusts, pumped = run_thrusters(*given)
    return targets, command, thrusts, total(*[pumped[k] for k in range(count)])


def init(tree: Tree, qpos: jax.Array, qvel: jax.Array) -> State:
    """The state of a population, thrusters at rest.

    Args:
        tree: the robots.
        qpos: `[nq, lanes]`.
        qvel: `[nv, lanes]`.

    Returns:
        The state.
    """
    # MuJoCo accepts quaternions of any length and normalises them before use.
    length = jnp.sqrt(jnp.sum(qpos[3:7] ** 2, 0))
    velocity, angular_velocity = tuple(qvel[:3]), tuple(qvel[3:6])
    speed, count, lanes = tree.joints_to_tree(qvel[6:]), tree.thrusters.count, qpos.shape[1:]
    rates = velocity, angular_velocity, speed
    # No slam before the first step, which finds the parts as submerged as they are.
    submerged = tree.fully_submerged(lanes, qpos.dtype)
    return State(
        position=tuple(qpos[:3]),
        quat=tuple(qpos[3:7] / length),
        velocity=velocity,
        angular_velocity=angular_velocity,
        angle=tree.joints_to_tree(qpos[7:]),
        speed=speed,
        qacc_prev=jax.tree.map(jnp.zeros_like, rates),
        command=jnp.zeros((count, *lanes), qpos.dtype) if count else (),
        submerged=submerged if tree.carries or jax.tree.leaves(submerged) else (),
        clearance=jnp.full(lanes, -1, qpos.dtype) if tree.meets else (),
    )


def make_population_engine(robot: Robot, contact: bool = True) -> PopulationEngine:
    """The population step of one robot.

    Args:
        robot: from `build_robot`.
        contact: whether the robot can touch the bed; leaving it out makes a step much cheaper.

    Returns:
        The engine.

    Raises:
        InputError: the world is not one that it can step.
    """
    tree = make_single_tree(robot, contact)
    check_timestep(robot)
    return PopulationEngine(tree, tree_plant(tree))


def tree_plant(tree: SingleTree) -> Plant:
    """The plant of one robot in the order of its levels."""
    robot, order = tree.robot, tree.hinge_order.tolist()
    return plant_of(robot, [*order, *range(len(order), len(order) + robot.num_thrusters)])


def robot_acceleration(
    robot: Robot, qpos: jax.Array, qvel: jax.Array, ctrl: jax.Array, water: Water
) -> jax.Array:
    """`acceleration` of one robot, its `[nu, lanes]` ctrl in MuJoCo's order."""
    tree = make_single_tree(robot)
    ctrl = tree_plant(tree).arrange(ctrl[actuators_of(robot)])
    return acceleration(tree, qpos, qvel, ctrl, water)


def acceleration(
    tree: Tree, qpos: jax.Array, qvel: jax.Array, ctrl: jax.Array, water: Water
) -> Float[Array, "nv lanes"]:
    """Acceleration of a population in MuJoCo's coordinates, as `mj_forward` defines it.

    Args:
        tree: the robots.
        qpos: `[nq, lanes]`.
        qvel: `[nv, lanes]`.
        ctrl: `[n, lanes]` servo targets [rad] and thrusters' commands [-], in the plant's order; a
            thruster with a lag is still.
        water: surface and current.

    Returns:
        `[nv, lanes]` qacc: root linear, world frame [m/s²], root angular, body frame [rad/s²],
        hinges [rad/s²].
    """
    return fuse_outermost(partial(_acceleration, tree), qpos, qvel, ctrl, water)


def _acceleration(
    tree: Tree, qpos: jax.Array, qvel: jax.Array, ctrl: jax.Array, water: Water
) -> jax.Array:
    state = init(tree, qpos, qvel)._replace(qacc_prev=(), submerged=())
    # As in mj_forward, a command has not passed the thruster's lag yet.
    targets, _, thrusts, _ = actuate(tree, state, ctrl)
    relative = state._replace(velocity=vsub(state.velocity, water.current))
    (linear, angular, hinges), *_ = accelerate(tree, relative, targets, water, thrusts, 0.0)
    rotation = quat_to_mat(state.quat)
    seen = matTvec(rotation, relative.velocity)
    linear = matvec(rotation, vadd(linear, cross(state.angular_velocity, seen)))
    root = jnp.stack([*vadd(linear, water.acceleration), *angular])
    return jnp.concatenate([root, tree.tree_to_joints(hinges, state.position[0])])
