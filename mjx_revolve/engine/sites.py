"""Sites of sensors at modules: their poses on the rigid bodies of robots.

A site is named "at ID", the module of that name of one robot, or "each TYPE", all modules of a
type, for one robot and for many different ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import jax
import numpy as np

from mjx_revolve.body.placement import turned
from mjx_revolve.engine.assembly import Assembly
from mjx_revolve.engine.robot import Robot
from mjx_revolve.engine.step_constants import hinge_frames
from mjx_revolve.inputs.errors import InputError, show
from mjx_revolve.numerics.spatial import Mat, Vec, clean


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Sites:
    """Sites on rigid bodies: one on each, `[1 + hinge rows, lanes]`, or a single one, numbers.

    Rigid bodies are in the order of `Engine.body_motions`: the core's, then the one that each hinge
    moves.

    Attributes:
        there: 1 where there is such a module, else 0.
        position: in the body's frame, that of `BodyMotion` [m].
        rotation: body from module.
        row: the body of a single place; None where there is one on each.
        hinge: which row of the plant is the module's own hinge; None without one.
        module: which of the robot's modules a single place is.
    """

    there: Any
    position: Vec
    rotation: Mat
    row: int | None = field(default=None, metadata={"static": True})
    hinge: int | None = field(default=None, metadata={"static": True})
    module: int | None = field(default=None, metadata={"static": True})


@dataclass(frozen=True, eq=False)
class ModuleSites:
    """The places of one robot, read when they are first used.

    Attributes:
        robot: the robot.
        hinges: `[hinge rows]` which of its hinges each row of the plant is.
    """

    robot: Robot
    hinges: tuple[int, ...]

    @cached_property
    def _poses(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return _poses(self.robot.assembly)

    def _row(self, body: int) -> int:
        # Body 1 is the root, and body 2 is what the first hinge carries.
        return 0 if body == 1 else 1 + self.hinges.index(body - 2)

    def find(self, place: str) -> Sites:
        """A place by name.

        Args:
            place: "at ID" or "each TYPE".

        Returns:
            The site; for a type that the robot lacks, `there` is 0 everywhere.

        Raises:
            InputError: there is no such module.
        """
        where, name = place.split(" ", 1)
        modules = self.robot.morphology.modules
        bodies, position, rotation = self._poses
        if where == "at":
            names = [module.name for module in modules]
            if name not in names:
                known = ", ".join(names)
                raise InputError(f"expected the id of a module; found {show(name)}, of {known}")
            k = names.index(name)
            row = self._row(int(bodies[k]))
            turn = tuple(tuple(x) for x in rotation[k].tolist())
            hinge = None if modules[k].kind.hinge is None else row - 1
            return Sites(1.0, tuple(position[k].tolist()), turn, row, hinge, k)
        chosen = _firsts(self.robot.assembly, name, bodies)
        rows = np.array([self._row(body) for body in bodies[chosen].tolist()], int)
        lanes = np.zeros(len(rows), int)
        return _spread(rows, lanes, position[chosen], rotation[chosen], 1 + len(self.hinges), 1)


def place_types(
    assembly: Assembly, row: np.ndarray, types: Sequence[str], rows: int
) -> dict[str, Sites]:
    """The places of robots side by side.

    Args:
        assembly: of the robots.
        row: `[nbody]` the row of its robot's plant that each rigid body is; of roots anything.
        types: of modules.
        rows: of hinges that there is room for.

    Returns:
        By the names of the places, `[1 + rows, robots]`.
    """
    if not types:
        return {}
    bodies, position, rotation = _poses(assembly)
    found = {}
    for name in types:
        chosen = _firsts(assembly, name, bodies)
        body = bodies[chosen]
        at = np.where(assembly.parent[body] == 0, 0, 1 + row[body])
        found[f"each {name}"] = _spread(
            at, assembly.robot[body], position[chosen], rotation[chosen], 1 + rows,
            len(assembly.roots),
        )  # fmt: skip
    return found


def _poses(assembly: Assembly) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of all modules: the rigid body `[n]`, and position `[n, 3]` and rotation in its frame.

    A sensor sits in the middle of the module's main box: of the part that moves, where there is a
    hinge, as do the module's slots.
    """
    module, table = assembly.layout.module, assembly.fluid
    first = np.flatnonzero(np.append(True, np.diff(module) > 0))
    last = np.append(first[1:], len(module)) - 1
    hinged = [m.kind.hinge is not None for m in assembly.modules]
    part = np.where(hinged, last, first)
    body = table.body[part]
    back = hinge_frames(assembly)[body].swapaxes(1, 2)
    return body, clean(turned(back, table.position[part])), clean(back @ table.rotation[part])


def _firsts(assembly: Assembly, name: str, bodies: np.ndarray) -> np.ndarray:
    """The first module of a type on each body that has one."""
    kinds = np.array([m.kind.name for m in assembly.modules])
    chosen = np.flatnonzero(kinds == name)
    return chosen[np.unique(bodies[chosen], return_index=True)[1]]


def _spread(
    row: np.ndarray,
    lane: np.ndarray,
    position: np.ndarray,
    rotation: np.ndarray,
    rows: int,
    lanes: int,
) -> Sites:
    there, place = np.zeros((rows, lanes)), np.zeros((3, rows, lanes))
    turn = np.tile(np.eye(3)[:, :, None, None], (1, 1, rows, lanes))
    there[row, lane] = 1.0
    place[:, row, lane] = position.T
    turn[:, :, row, lane] = rotation.transpose(1, 2, 0)
    return Sites(there, tuple(place), tuple(tuple(x) for x in turn))
