"""The engines: their interface, and the population engine and MJX's by name."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Protocol, TypeVar

from jaxtyping import Array, Float

from mjx_revolve.engine.interaction import RobotInteraction
from mjx_revolve.engine.plant import Plant
from mjx_revolve.engine.population import make_population_engine
from mjx_revolve.engine.robot import Robot
from mjx_revolve.engine.state import RootState
from mjx_revolve.engine.variation import Variation
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics.inertia import BodyMotion
from mjx_revolve.numerics.spatial import Vec
from mjx_revolve.water.flow import Water

ENGINES = ("population", "mjx")

S = TypeVar("S")


class Engine(Protocol[S]):
    """A simulator of a population: `PopulationEngine` or `MjxEngine`.

    `S` is the engine's own state, a pytree. Arrays have the population, `lanes`, on the last axis.
    "Rows of hinges" are those of the plant. What needs a pass over the bodies says so.
    """

    @property
    def plant(self) -> Plant:
        """The actuators, in the order of `step`'s ctrl."""

    @property
    def elementwise(self) -> bool:
        """Whether a step is element-wise, so that it may be compiled as one function."""

    @property
    def interaction(self) -> RobotInteraction | None:
        """Contact and sight between robots of one world, which is not element-wise; or None."""

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

    def thruster_command(self, state: S) -> Float[Array, "nthruster lanes"]:
        """The thrusters' commands behind their lag [-]."""

    def body_motions(self, state: S) -> BodyMotion:
        """Motion over ground of the core's rigid body, then of what each hinge carries (a pass).

        `[1 + rows of hinges, lanes]` each; each body's frame at its hinge.
        """

    def center_of_mass(self, state: S) -> Vec:
        """Centre of mass of whole robots without their water, world frame [m] (a pass)."""

    def with_touch(self, state: S) -> S:
        """The state from which on contacts between own modules are felt by the two functions below.

        None is before the first step.
        """

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

    def contact_by_half(self, state: S, water: Water) -> tuple[tuple[Array, Array], ...] | None:
        """Normal force of contacts on the left and right half of each module [N] (a pass).

        Of the bed; and of own modules, in the last step, where the state is one `with_touch`. None
        for many different robots.
        """

    def external_force(
        self, state: S, ctrl: Float[Array, "n lanes"], water: Water
    ) -> tuple[Vec, Vec]:
        """Force of the bed and of the water on whole robots, world frame [N] (a pass)."""


def make_engine(robot: Robot, engine: str = "population", contact: bool = True) -> Engine[Any]:
    """The simulator of a robot; the same object for the same arguments.

    Args:
        robot: from `build_robot`.
        engine: "population" or "mjx".
        contact: whether the robot can touch the bed.

    Returns:
        The engine.

    Raises:
        InputError: an unknown engine, or a world that it cannot step, or a model that was edited
            beyond what `Robot.with_model` takes.
    """
    return _make_engine(robot.as_edited(), engine, contact)


@lru_cache(maxsize=32)
def _make_engine(robot: Robot, engine: str, contact: bool) -> Engine[Any]:
    if engine == "population":
        return make_population_engine(robot, contact)
    if engine == "mjx":
        from mjx_revolve.engine.mjx_engine import make_mjx_engine

        return make_mjx_engine(robot, contact)
    raise InputError("engine", f"one of {', '.join(ENGINES)}", repr(engine))
