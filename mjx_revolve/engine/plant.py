"""What control and tasks may know of a robot: its actuators as a table, and its size.

The same for one robot, where the numbers are constants, and for many different ones, where they
have the population on the last axis: so a controller or a task is written once for both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.engine.robot import Robot


class Figure(NamedTuple):
    """A body's size, a number or `[lanes]` each.

    Attributes:
        length: largest extent at rest [m].
        weight: in air [N].
        lowest: how far the rest pose reaches below the core's centre [m].
        radius: how far it reaches from the core's vertical [m].
        sinks: whether the water carries less than half of its weight.
        num_hinges: how many hinges it has.
    """

    length: Any
    weight: Any
    lowest: Any
    radius: Any
    sinks: Any
    num_hinges: Any


def figure_of(robot: Robot) -> Figure:
    """The size of a robot, in its world."""
    body, world = robot.morphology, robot.world
    return Figure(
        length=body.length,
        weight=body.mass * max(world.gravity, 1e-9),
        lowest=body.lowest,
        radius=body.radius,
        sinks=world.buoyancy == "off" or world.density * body.volume < body.mass / 2,
        num_hinges=body.num_hinges,
    )


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["low", "high", "place", "source", "first", "second"],
    meta_fields=["num_hinges", "num_thrusters", "num_pairs", "names", "pairs", "timestep"],
)
@dataclass(frozen=True)
class Plant:
    """The actuators of a robot, as controllers see them.

    Rows follow the engine's order, which differs from robot to robot: `arrange` brings genes, which
    follow the robot's own order (hinges in the order of its modules, then thrusters), into it.

    Attributes:
        num_hinges: how many hinges; of different robots, the most that one may have.
        num_thrusters: how many thrusters, likewise.
        num_pairs: how many pairs of hinges share a rigid body, likewise.
        names: `[num_hinges + num_thrusters]` of the actuators, the robot's order.
        pairs: `[num_pairs]` names of the pairs.
        timestep: of the world [s].
        low: `[n, lanes]` least command of each row: hinges [rad], thrusters [-].
        high: `[n, lanes]` greatest.
        place: `[n, 3, lanes]` of hinges and thrusters at rest, core frame [m].
        source: `[n, lanes]` which of the robot's actuators a row is; past their end: none.
        first: `[num_pairs, lanes]` the row of the pair's earlier hinge; past the end: no pair.
        second: `[num_pairs, lanes]` of the later one.
    """

    num_hinges: int
    num_thrusters: int
    num_pairs: int
    names: tuple[str, ...]
    pairs: tuple[str, ...]
    timestep: float
    low: Any = None
    high: Any = None
    place: Any = None
    source: Any = None
    first: Any = None
    second: Any = None

    @property
    def num_actuators(self) -> int:
        """Hinges and thrusters."""
        return self.num_hinges + self.num_thrusters

    @property
    def num_rows(self) -> int:
        """Rows of the engine's order."""
        return int(self.source.shape[0])

    @property
    def num_hinge_rows(self) -> int:
        """Rows that are hinges; those of thrusters follow."""
        return self.num_rows - self.num_thrusters

    @property
    def active(self) -> Any:
        """`[n, lanes]` whether a row is an actuator at all."""
        return self.source < self.num_actuators

    def arrange(self, values: jax.Array) -> jax.Array:
        """Values of actuators in the engine's order.

        Args:
            values: `[num_hinges + num_thrusters, lanes]`, the robot's order.

        Returns:
            `[n, lanes]`; 0 where a row is no actuator.
        """
        if isinstance(self.source, np.ndarray) and self.source.shape[-1] == 1:
            return values[self.source[:, 0]]
        padded = jnp.concatenate([values, jnp.zeros_like(values[:1])])
        return jnp.take_along_axis(padded, jnp.asarray(self.source), 0)

    def middle(self, like: jax.Array) -> jax.Array:
        """Middle of each range, as wide as `[n, lanes]` values; 0 where there is no actuator."""
        return self._wide((self.low + self.high) / 2, like)

    def reach(self, like: jax.Array) -> jax.Array:
        """Half width of each range, likewise."""
        return self._wide((self.high - self.low) / 2, like)

    def _wide(self, x: Any, like: jax.Array) -> jax.Array:
        # NumPy's numbers take the genes' dtype: JAX keeps one typed copy of an array that it meets
        # in a trace, of whichever mode, 32 or 64 bits, it met it in first.
        x = x if isinstance(x, jax.Array) else np.asarray(x, like.dtype)
        return jnp.broadcast_to(x, (self.num_rows, *like.shape[1:])).astype(like.dtype)


def actuators_of(robot: Robot) -> np.ndarray:
    """`[nu]` MuJoCo's actuators in the robot's own order: hinges, then thrusters."""
    # 32 bits: JAX keeps one typed copy of an array that it meets, in either mode.
    return np.array([*robot.servos, *robot.thrusters], np.int32)


def plant_of(robot: Robot, order: Sequence[int] | None = None) -> Plant:
    """The plant of a robot.

    Args:
        robot: from `build_robot`.
        order: `[nu]` MuJoCo's actuators in the order of an engine; by default hinges in the order
            of the modules, then thrusters.

    Returns:
        Its table, `[n, 1]`.
    """
    m, own = robot.mj_model, actuators_of(robot).tolist()
    rows = np.asarray(own if order is None else order, int)
    source = np.array([own.index(k) for k in rows], np.int32)
    row = {int(k): i for i, k in enumerate(source)}
    names = tuple(m.actuator(k).name for k in own)
    pairs = robot.morphology.hinge_neighbours()
    low, high = m.actuator_ctrlrange[rows].reshape(-1, 2).T
    ends = np.array([(row[i], row[j]) for i, j in pairs], np.int32).reshape(-1, 2)
    return Plant(
        num_hinges=len(robot.servos),
        num_thrusters=len(robot.thrusters),
        num_pairs=len(pairs),
        names=names,
        pairs=tuple(f"{names[i]}~{names[j]}" for i, j in pairs),
        timestep=robot.world.timestep,
        low=low[:, None],
        high=high[:, None],
        place=actuator_places(robot)[source][..., None],
        source=source[:, None],
        first=ends[:, :1],
        second=ends[:, 1:],
    )


def actuator_places(robot: Robot) -> np.ndarray:
    """`[nu, 3]` of hinges, then thrusters, at rest, core frame [m]."""
    body, found = robot.morphology, []
    for index in body.hinges:
        module = body.modules[index]
        assert module.kind.hinge is not None
        found.append(module.position + module.rotation @ np.asarray(module.kind.hinge.anchor))
    for index, k in body.thrusters:
        module = body.modules[index]
        part = module.kind.parts[k]
        assert part.thruster is not None
        at = np.asarray(part.position) + np.asarray(part.thruster.position)
        found.append(module.position + module.rotation @ at)
    return np.array(found, float).reshape(-1, 3)
