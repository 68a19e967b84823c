"""What an engine is: the simulator of a population, and the passes over its bodies."""

from __future__ import annotations

from typing import Any, Protocol, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_revolve.engine import forces, kinematics
from mjx_revolve.engine.interaction import RobotInteraction
from mjx_revolve.engine.plant import Plant
from mjx_revolve.engine.single_tree import SingleTree
from mjx_revolve.engine.state import RootState, State
from mjx_revolve.engine.tree import Tree
from mjx_revolve.engine.variation import Variation
from mjx_revolve.numerics.inertia import BodyMotion
from mjx_revolve.numerics.spatial import Vec
from mjx_revolve.water.flow import Water

S = TypeVar("S")


class Engine(Protocol[S]):
    """A simulator of a population: `PopulationEngine` or `MjxEngine`.

    `S` is the engine's own state, a pytree. Arrays have the population, `lanes`, on the last axis.
    "Rows of hinges" are those of the plant. What needs a pass over the bodies says so: passes go
    over a tree of the robots, and are the same for all engines.

    Attributes:
        tree: of the robots.
        plant: the actuators, in the order of `step`'s ctrl.
        elementwise: whether a step is element-wise, so that it may be compiled as one function.
        interaction: contact and sight between robots of one world, which is not element-wise; or
            None.
    """

    tree: Tree
    plant: Plant
    elementwise: bool
    interaction: RobotInteraction | None

    def with_variation(self, variation: Variation) -> Engine[S]:
        """The same engine with other coefficients.

        Raises:
            InputError: it cannot have others.
        """

    def init(self, qpos: Float[Array, "nq lanes"], qvel: Float[Array, "nv lanes"]) -> S:
        """The state of robots at rest: thrusters off, no acceleration known."""

    def step(
        self, state: S, ctrl: Float[Array, "n lanes"], water: Water, wrench: Any = ()
    ) -> tuple[S, Float[Array, " lanes"]]:
        """One step of the world's timestep.

        Args:
            state: before it.
            ctrl: targets of hinges [rad] and commands of thrusters [-], in the plant's order.
            water: surface and current.
            wrench: of other robots, `InteractionForces.wrench`; () for none.

        Returns:
            The state after it, and the power that actuators deliver or take up, summed without
            sign [W].
        """

    def observe(self, state: S) -> tuple[Float[Array, "nq lanes"], Float[Array, "nv lanes"]]:
        """Qpos and qvel in MuJoCo's order."""

    def root(self, state: S) -> RootState:
        """Pose and velocity of the core; cheaper than `observe`."""

    def joints(self, state: S) -> tuple[Float[Array, "hinges lanes"], ...]:
        """Angles [rad] and speeds [rad/s] of the rows of hinges; cheaper than `observe`."""

    def servo_torque(self, state: S, ctrl: Float[Array, "n lanes"]) -> Float[Array, "hinges lanes"]:
        """Torque of the servos under a command, for the rows of hinges [N·m]."""
        tree, targets = self._varied, self._targets(ctrl)
        seen = self._state(state)
        return self._ordered(forces.servo_torque(tree, seen, targets), seen)

    def thruster_command(self, state: S) -> Float[Array, "nthruster lanes"]:
        """The thrusters' commands behind their lag [-]."""

    def body_motions(self, state: S) -> BodyMotion:
        """Motion over ground of the core's rigid body, then of what each hinge carries (a pass).

        `[1 + rows of hinges, lanes]` each; each body's frame at its hinge.
        """
        seen = self._state(state)
        rows = kinematics.body_motions(self.tree, seen)
        return jax.tree.map(lambda x: self._ordered(x, seen), rows)

    def center_of_mass(self, state: S) -> Vec:
        """Centre of mass of whole robots without their water, world frame [m] (a pass)."""
        return kinematics.center_of_mass(self.tree, self._state(state))

    def with_touch(self, state: Any) -> Any:
        """The state from which on contacts between own modules are felt by the two functions below.

        None is before the first step.
        """
        if not self.tree.meets:
            return state
        rows, like = 1 + self.plant.num_hinge_rows, state.position[0]
        if isinstance(self.tree, SingleTree):
            rows += 2 * self.tree.robot.morphology.num_modules
        return state._replace(pressed=jnp.zeros((rows, *like.shape), like.dtype))

    def contact_force(
        self, state: S, water: Water, wrench: Any = ()
    ) -> Float[Array, "bodies lanes"]:
        """Force of contacts on the core's rigid body, then on what each hinge carries [N] (a pass).

        Args:
            state: of the robots.
            water: surface and current.
            wrench: of other robots, `InteractionForces.wrench`; () for none.

        Returns:
            `[1 + rows of hinges, lanes]` of the bed and other robots; and of own modules, in the
            last step, where the state is one `with_touch`.
        """
        seen = self._state(state)
        return self._ordered(forces.contact_force(self.tree, seen, water, wrench), seen)

    def contact_by_half(self, state: S, water: Water) -> tuple[tuple[Array, Array], ...] | None:
        """Normal force of contacts on the left and right half of each module [N] (a pass).

        Of the bed; and of own modules, in the last step, where the state is one `with_touch`. None
        for many different robots.
        """
        if not isinstance(self.tree, SingleTree):
            return None
        return forces.contact_by_half(self.tree, self._state(state), water)

    def external_force(
        self, state: S, ctrl: Float[Array, "n lanes"], water: Water
    ) -> tuple[Vec, Vec]:
        """Force of the bed and of the water on whole robots, world frame [N] (a pass)."""
        tree = self._varied
        thrusts = self._thrusts(tree, state, ctrl)
        return forces.external_force(tree, self._state(state), water, thrusts)

    # How an engine's own state and order stand to those of the tree.

    @property
    def _varied(self) -> Tree:
        """The tree with the engine's coefficients."""
        return self.tree

    def _state(self, state: Any) -> State:
        """The state as passes take it."""
        return state

    def _ordered(self, rows: jax.Array, seen: State) -> jax.Array:
        """Rows of hinges in the plant's order, behind that of the core where there is one."""
        return rows

    def _targets(self, ctrl: jax.Array) -> Any:
        """Targets of the tree's hinges."""
        return self.tree.split_rows(ctrl[: len(ctrl) - self.tree.thrusters.count])

    def _thrusts(self, tree: Tree, state: Any, ctrl: jax.Array) -> Any:
        """Thrusts under a command [N]; () without thrusters."""
