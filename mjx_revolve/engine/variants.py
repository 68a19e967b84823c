"""One robot with many sets of numbers in one compiled program, a set for each lane.

Robots of the same modules differ in the numbers of their steps only: coefficients, masses, servos,
thrusters. Those numbers that differ are arguments of the program, `[..., lanes]`; the others stay
constants. Any number of a morphology can be varied in this way, without a change in the laws.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from mjx_revolve.engine.batch import distinct
from mjx_revolve.engine.population import PopulationEngine, tree_plant
from mjx_revolve.engine.robot import Robot, check_timestep
from mjx_revolve.engine.single_tree import SingleTree, make_single_tree
from mjx_revolve.engine.step_constants import NO_LIMIT
from mjx_revolve.numerics.spatial import fold

# Inertia of a hinge that moves as prescribed [kg·m²]: so much that no other torque counts.
_DRIVEN_INERTIA = 1e6
# How fast it returns to its course, per step [-]; only rounding ever leads it away.
_RETURN = 0.2


def _numbers(tree: SingleTree) -> Any:
    return tree.root, tree.below, tree.thrusters


@dataclass(frozen=True, eq=False)
class Variants:
    """Robots that differ in numbers only.

    Attributes:
        tree: of the first one.
        rows: which leaves of its numbers differ in any of the examples.
        prescribed: `[hinges]` whether a hinge moves as `course_targets` says, the robot's order.
    """

    tree: SingleTree
    rows: tuple[int, ...]
    prescribed: np.ndarray

    def stack(self, robots: Sequence[Robot]) -> list[np.ndarray]:
        """The numbers that differ, `[..., robots]` each; of robots that repeat, read once."""
        unique, pick = distinct(robots)
        read = [jax.tree.leaves(_numbers(_tree(robot, self.prescribed))) for robot in unique]
        leaves = [read[k] for k in pick]
        found = []
        for row in self.rows:
            each = np.broadcast_arrays(*(np.asarray(x[row]) for x in leaves))
            # A number, or `[..., 1]`.
            found.append(np.stack([x[..., 0] if x.ndim else x for x in each], -1))
        return found

    def engine(self, numbers: Sequence[Any]) -> PopulationEngine:
        """The engine of these numbers, `[..., lanes]` each."""
        leaves, structure = jax.tree.flatten(_numbers(self.tree))
        for row, x in zip(self.rows, numbers, strict=True):
            leaves[row] = x
        root, below, thrusters = jax.tree.unflatten(structure, leaves)
        tree = replace(self.tree, root=root, below=below, thrusters=thrusters)
        return PopulationEngine(tree, tree_plant(self.tree))


def make_variants(robots: Sequence[Robot], prescribed: Sequence[bool] = ()) -> Variants:
    """What differs between robots of the same modules.

    Args:
        robots: examples; what is the same in all of them stays so.
        prescribed: `[hinges]` which hinges move as prescribed; by default none.

    Raises:
        InputError: the world is not one that the engine can step.
    """
    check_timestep(robots[0])
    mask = np.array(prescribed or [False] * robots[0].num_hinges, bool)
    tree = _tree(robots[0], mask)
    first = jax.tree.leaves(_numbers(tree))
    rows: set[int] = set()
    for robot in robots[1:]:
        other = jax.tree.leaves(_numbers(_tree(robot, mask)))
        pairs = enumerate(zip(first, other, strict=True))
        rows |= {k for k, (a, b) in pairs if np.shape(a) != np.shape(b) or np.any(a != b)}
    return Variants(tree, tuple(sorted(rows)), mask)


def _tree(robot: Robot, prescribed: np.ndarray) -> SingleTree:
    """The constants of a robot, some of its hinges driven."""
    tree: SingleTree = make_single_tree.__wrapped__(robot, robot.world.bed is not None)
    if not prescribed.any():
        return tree
    rate = _RETURN / robot.world.timestep
    stiffness = _DRIVEN_INERTIA * rate**2
    course: dict[str, Any] = {
        "armature": _DRIVEN_INERTIA,
        "servo_damping": 2 * _DRIVEN_INERTIA * rate,
        **dict.fromkeys(("gain", "stiffness"), stiffness),
        **dict.fromkeys(("damping", "implicit_stiffness", "stop"), 0.0),
        **dict.fromkeys(("effort", "target", "range"), (-NO_LIMIT, NO_LIMIT)),
        "motor": (NO_LIMIT, 0.0, 1.0),
    }
    below, done = [], 0
    for level in tree.below:
        assert level.hinges is not None
        driven = prescribed[tree.hinge_order[done : done + level.count]][:, None]
        done += level.count
        put = lambda a, b, driven=driven: fold(np.asarray(np.where(driven, b, a)))  # noqa: E731
        own = {name: getattr(level.hinges, name) for name in course}
        changed = level.hinges._replace(**jax.tree.map(put, own, course))
        below.append(replace(level, hinges=changed))
    return replace(tree, below=tuple(below))


def course_targets(course: np.ndarray, timestep: float) -> np.ndarray:
    """Targets with which prescribed hinges follow a course, exactly.

    Args:
        course: `[T + 2, ...]` angles before each of T steps, after the last one, and one more
            before the first one [rad].
        timestep: [s].

    Returns:
        `[T, ...]` targets [rad].
    """
    rate = _RETURN / timestep
    speed = np.diff(course, axis=0) / timestep
    push = np.diff(speed, axis=0) / timestep
    return course[1:-1] + 2 / rate * speed[:-1] + push / rate**2
