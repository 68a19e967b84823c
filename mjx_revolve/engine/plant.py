"""The interface of a robot for controllers and tasks: its actuators as a table, and its size.

For one robot the numbers are constants; for many different ones they have the population on the
last axis. So a controller or a task is written once for both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.body.morphology import Morphology
from mjx_revolve.body.placement import turned
from mjx_revolve.engine.assembly import Assembly
from mjx_revolve.engine.robot import Robot
from mjx_revolve.engine.sites import ModuleSites, Sites
from mjx_revolve.inputs.errors import InputError, show
from mjx_revolve.numerics.spatial import cast
from mjx_revolve.water.world import World

# Centres of mass and of volume nearer than this are one point [m]: those of symmetric bodies are,
# but for rounding. A choice.
_ONE_POINT = 1e-6


class BodyGeometry(NamedTuple):
    """A body's size and balance, a number or `[lanes]` each.

    Attributes:
        length: largest extent at rest [m].
        stretched: largest extent that the body can reach; see `stretched_lengths` [m].
        weight: in air [N].
        lowest: extent of the rest pose below the core's centre [m].
        radius: extent of the rest pose from the core's vertical axis [m].
        sinks: whether it may fall fast: the water carries less than `least_lift` of its weight.
        num_hinges: how many hinges it has.
        up: `[3]` or `[3, lanes]` direction from the centre of mass to that of the displaced volume
            at rest, core frame: it points up when the body is in equilibrium in deep water.
            (0, 0, 1) if the two coincide.
        center: `[3]` or `[3, lanes]` centre of mass at rest, core frame [m].
        thrust: of all thrusters together, at full command [N].
    """

    length: Any
    stretched: Any
    weight: Any
    lowest: Any
    radius: Any
    sinks: Any
    num_hinges: Any
    up: Any
    center: Any
    thrust: Any


def body_geometry(robot: Robot) -> BodyGeometry:
    """The size of a robot, in its world."""
    return BodyGeometry(*(x[..., 0].tolist() for x in body_geometries(robot.assembly)))


def body_geometries(assembly: Assembly) -> BodyGeometry:
    """The sizes of robots, in their world, `[robots]`."""
    layout, table, world = assembly.layout, assembly.fluid, assembly.world
    robots = len(assembly.morphologies)
    first = np.searchsorted(layout.body, np.arange(robots))
    boxes = np.searchsorted(layout.box_part, first)
    center, reach = layout.box_centers(), layout.box_reaches()
    extent = np.maximum.reduceat(center + reach, boxes) - np.minimum.reduceat(center - reach, boxes)
    corners = layout.core_corners()
    across = np.hypot(corners[..., 0], corners[..., 1])
    mass = np.bincount(layout.body, table.mass)
    if assembly.inertia_axes is not None:  # an edited model has masses of its own
        mass = assembly.mass.sum(keepdims=True)
    heavy = _mass_center(assembly)
    lever = _buoyancy_center(assembly) - heavy
    arm = np.linalg.norm(lever, axis=1, keepdims=True)
    hangs = arm > _ONE_POINT
    displaced = world.density * np.bincount(layout.body, table.lifted)
    thrust = [p.thruster.largest_thrust if p.thruster else 0.0 for p in assembly.thruster_part]
    return BodyGeometry(
        length=extent.max(1),
        stretched=np.maximum(extent.max(1), stretched_lengths(assembly)),
        weight=mass * max(world.gravity, 1e-9),
        lowest=-np.minimum.reduceat(corners[..., 2].min(1), first),
        radius=np.maximum.reduceat(across.max(1), first),
        sinks=(displaced < least_lift(world) * mass) | (world.buoyancy == "off"),
        num_hinges=np.array([float(body.num_hinges) for body in assembly.morphologies]),
        up=np.where(hangs, lever / np.where(hangs, arm, 1.0), (0.0, 0.0, 1.0)).T,
        center=heavy.T,
        thrust=np.bincount(layout.body[assembly.thruster_row], np.array(thrust, float), robots),
    )


def least_lift(world: World) -> float:
    """Share of its weight that the water must carry so that a body sinks no faster than it swims.

    Where nothing drags, whatever is heavier than the water falls freely; neutral to rounding, as
    from `trim_neutral`, counts as neutral.
    """
    return 1 - 1e-6 if world.drag in ("off", "fossen") else 0.5


def stretched_lengths(assembly: Assembly) -> np.ndarray:
    """Lengths of the longest ways through bodies, as if their hinges could straighten them.

    A way leads from the middle of a box's face to another's, straight through each rigid body from
    hinge to hinge. No pose is longer, up to the boxes' breadths, and no fold makes it shorter.

    Args:
        assembly: of the robots.

    Returns:
        `[robots]` [m].
    """
    layout, count = assembly.layout, len(assembly.parent)
    turn = layout.rotation[layout.box_part].swapaxes(1, 2)
    aside = turn * layout.box_half[..., None]
    faces = layout.box_centers()[:, None] + np.concatenate([aside, -aside], 1)
    owner = assembly.fluid.body[layout.box_part]
    # Of each body: its boxes' faces, and its children's hinges with the longest way beyond them.
    ends = [
        [(place, 0.0) for place in faces[owner == body].reshape(-1, 3)] for body in range(count)
    ]
    longest = np.zeros(len(assembly.roots))
    for body in range(count - 1, 0, -1):  # children come after their parents
        place = np.array([x for x, _ in ends[body]])
        beyond = np.array([x for _, x in ends[body]])
        across = np.linalg.norm(place[:, None] - place, axis=-1) + beyond[:, None] + beyond
        np.fill_diagonal(across, 0.0)
        robot = assembly.robot[body]
        longest[robot] = max(longest[robot], across.max())
        if assembly.parent[body]:
            hinge = assembly.position[body]
            reach = np.linalg.norm(place - hinge, axis=-1) + beyond
            ends[assembly.parent[body]].append((hinge, reach.max()))
    return longest


def _mass_center(assembly: Assembly) -> np.ndarray:
    """`[robots, 3]` centres of mass at rest, core frame [m]."""
    place = assembly.position + turned(assembly.rotation, assembly.center)
    return _mean(place[1:], assembly.mass[1:], assembly.robot[1:], len(assembly.morphologies))


def _buoyancy_center(assembly: Assembly) -> np.ndarray:
    """`[robots, 3]` centres of what lifts the parts at rest, core frame [m]."""
    layout, table = assembly.layout, assembly.fluid
    place = layout.position + turned(layout.rotation, table.center_of_volume)
    return _mean(place, table.lifted, layout.body, len(assembly.morphologies))


def _mean(place: np.ndarray, weight: np.ndarray, owner: np.ndarray, count: int) -> np.ndarray:
    """`[count, 3]` weighted means of what each owns; 0 where nothing weighs."""
    moment = np.stack([np.bincount(owner, weight * x, count) for x in place.T], 1)
    whole = np.bincount(owner, weight, count)[:, None]
    return moment / np.where(whole > 0, whole, 1.0)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Plant:
    """The actuators of a robot, as controllers see them.

    Rows follow the engine's order, which differs from robot to robot: `arrange` brings genes, which
    follow the robot's own order (hinges in the order of its modules, then thrusters), into it.

    Attributes:
        num_hinges: how many hinges; of different robots, the most that one may have.
        num_thrusters: how many thrusters.
        num_pairs: how many pairs of hinges share a rigid body.
        names: `[num_hinges + num_thrusters]` of the actuators, the robot's order.
        pairs: `[num_pairs]` names of the pairs.
        timestep: between calls of a controller [s]: the world's, or one over `rate`.
        low: `[n, lanes]` least command of each row: hinges [rad], thrusters [-].
        high: `[n, lanes]` greatest.
        place: `[n, 3, lanes]` of hinges and thrusters at rest, core frame [m].
        axis: `[n, 3, lanes]` about which hinges turn and along which thrusters push, at rest, unit
            vectors, core frame [-]; 0 where a row is no actuator.
        source: `[n, lanes]` which of the robot's actuators a row is; past their end: none.
        first: `[num_pairs, lanes]` the row of the pair's earlier hinge; past the end: no pair.
        second: `[num_pairs, lanes]` of the later one.
        mounts: positions of sensors on types of modules, for robots that differ.
        modules: places of all modules of one robot; None where robots differ.
        rate: of commands, held in between [Hz]; None: one for each of the world's steps.
    """

    num_hinges: int = field(metadata={"static": True})
    num_thrusters: int = field(metadata={"static": True})
    num_pairs: int = field(metadata={"static": True})
    names: tuple[str, ...] = field(metadata={"static": True})
    pairs: tuple[str, ...] = field(metadata={"static": True})
    timestep: float = field(metadata={"static": True})
    low: Any = None
    high: Any = None
    place: Any = None
    axis: Any = None
    source: Any = None
    first: Any = None
    second: Any = None
    mounts: Any = field(default_factory=dict)
    modules: ModuleSites | None = field(default=None, metadata={"static": True})
    rate: float | None = field(default=None, metadata={"static": True})

    def at_rate(self, rate: float) -> Plant:
        """The same for a controller that gives so many commands a second [Hz].

        The world's steps are the most that there are.
        """
        rate = min(rate, 1 / self.timestep)
        return replace(self, rate=rate, timestep=1 / rate)

    def site(self, place: str) -> Sites:
        """Where sensors sit.

        Args:
            place: "at ID", a module of one robot, or "each TYPE", modules of a type.

        Returns:
            The place, or one on each rigid body.

        Raises:
            InputError: there is no such module, or robots differ.
        """
        if place in self.mounts:
            return self.mounts[place]
        if self.modules is None:
            raise InputError(
                "expected `each` a type of modules in place of `at`, as bodies differ; found "
                f"{show(place.split(' ', 1)[1])}"
            )
        return self.modules.find(place)

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

    def arrange(self, values: jax.Array) -> jax.Array:
        """Values of actuators in the engine's order.

        Args:
            values: `[num_hinges + num_thrusters, lanes]`, the robot's order.

        Returns:
            `[n, lanes]`; 0 where a row is no actuator.
        """
        if isinstance(self.source, np.ndarray) and self.source.shape[-1] == 1:
            if values.shape[0] != self.num_actuators:
                known = f"one of this robot, of {self.num_actuators} hinges and thrusters"
                raise InputError("controller", known, f"one of {values.shape[0]}")
            return values[self.source[:, 0]]
        padded = jnp.concatenate([values, jnp.zeros_like(values[:1])])
        return jnp.take_along_axis(padded, jnp.asarray(self.source), 0)

    def middle(self, like: jax.Array) -> jax.Array:
        """Middle of each range, as wide as `[n, lanes]` values; 0 where there is no actuator."""
        return self._wide((self.low + self.high) / 2, like)

    def reach(self, like: jax.Array) -> jax.Array:
        """Half width of each range, as `middle` has it."""
        return self._wide((self.high - self.low) / 2, like)

    def _wide(self, x: Any, like: jax.Array) -> jax.Array:
        # NumPy's numbers take the genes' dtype: JAX keeps one typed copy of an array that it meets
        # in a trace, of whichever mode, 32 or 64 bits, it met it in first.
        return jnp.broadcast_to(cast(x, like), (self.num_rows, *like.shape[1:])).astype(like.dtype)


def actuators_of(robot: Robot) -> np.ndarray:
    """`[nu]` MuJoCo's actuators in the robot's own order: hinges, then thrusters."""
    # 32 bits: JAX keeps one typed copy of an array that it meets, in either mode.
    return np.array([*robot.servos, *robot.thrusters], np.int32)


def plant_of(robot: Robot, order: Sequence[int] | None = None) -> Plant:
    """The plant of a robot.

    Args:
        robot: from `build_robot`.
        order: `[nu]` its actuators in the order of an engine; by default hinges in the order of the
            modules, then thrusters.

    Returns:
        Its table, `[n, 1]`.
    """
    body, (low, high, place, axis) = robot.morphology, read_actuators([robot.morphology])
    if robot.edited_model is not None:  # without limits of commands, those as built
        model, own = robot.edited_model, actuators_of(robot)
        limited = model.actuator_ctrllimited[own].astype(bool)
        low, high = np.where(limited, model.actuator_ctrlrange[own].T, (low, high))
    source = np.array(range(len(low)) if order is None else order, np.int32)
    row = np.argsort(source)
    names = (*(body.modules[k].name for k in body.hinges), *body.thruster_names)
    pairs = body.hinge_neighbours()
    ends = np.array([(row[i], row[j]) for i, j in pairs], np.int32).reshape(-1, 2)
    return Plant(
        num_hinges=robot.num_hinges,
        num_thrusters=robot.num_thrusters,
        num_pairs=len(pairs),
        names=names,
        pairs=tuple(f"{names[i]}~{names[j]}" for i, j in pairs),
        timestep=robot.world.timestep,
        low=low[source, None],
        high=high[source, None],
        place=place[source][..., None],
        axis=axis[source][..., None],
        source=source[:, None],
        first=ends[:, :1],
        second=ends[:, 1:],
        modules=ModuleSites(robot, tuple(source[: robot.num_hinges].tolist())),
    )


def read_actuators(
    bodies: Sequence[Morphology],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Hinges of all bodies, then thrusters of all: their commands' ranges, places and axes.

    Args:
        bodies: of the robots.

    Returns:
        `[n]` and `[n]` ends of the range [rad] or [-], `[n, 3]` places at rest, core frame [m], and
        `[n, 3]` axes of hinges and directions of thrust, core frame [-].
    """
    modules = [module for body in bodies for module in body.modules]
    hinges = [(m, m.kind.hinge) for m in modules if m.kind.hinge is not None]
    thrusters = [
        (m, p, p.thruster) for m in modules for p in m.kind.parts if p.thruster is not None
    ]
    carriers = [*(m for m, _ in hinges), *(m for m, _, _ in thrusters)]
    local = [hinge.anchor for _, hinge in hinges]
    local += [tuple(np.add(part.position, jet.position)) for _, part, jet in thrusters]
    axes = [hinge.axis for _, hinge in hinges] + [jet.axis for *_, jet in thrusters]
    ranges = [*(hinge.range for _, hinge in hinges), *(jet.range for *_, jet in thrusters)]
    origin = np.array([m.position for m in carriers]).reshape(-1, 3)
    rotation = np.array([m.rotation for m in carriers]).reshape(-1, 3, 3)
    low, high = np.array(ranges).reshape(-1, 2).T
    place, axis = (turned(rotation, np.array(x).reshape(-1, 3)) for x in (local, axes))
    return low, high, origin + place, axis
