"""Spheres that stand for the boxes of robots where these touch each other.

Two spheres touch along the line between their centres, whatever their attitude, so contact between
robots is a few operations, has no corner cases, and its force is the same, turned round, on both.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from mjx_revolve.body.placement import counted, turned
from mjx_revolve.engine.assembly import Assembly
from mjx_revolve.engine.batch import Capacity, assemble_all, distinct, order_rows
from mjx_revolve.engine.robot import Robot
from mjx_revolve.engine.step_constants import read_constants
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics.spatial import SYM

# The least radius as a share of a box's longest half edge, so that a rod has two spheres, and a
# plate five, which stick out of it by as much. A choice.
_THICKNESS = 1 / 2


class Spheres(NamedTuple):
    """Spheres of robots, `[S, P]` each; those past a robot's end have no radius.

    Attributes:
        row: body that each is fixed to: 0 is the root, k + 1 the traversal's row k; int32.
        center: body frame, three of `[S, P]` [m].
        radius: [m]; 0 for padding.
        mass_center: of that body, its own frame, three of `[S, P]` [m].
        inverse_mass: of that body, without the water that it carries [1/kg].
        inverse_inertia: of that body about its centre of mass, its own frame, six of `[S, P]`
            [1/(kg m²)].
    """

    row: Any
    center: Any
    radius: Any
    mass_center: Any
    inverse_mass: Any
    inverse_inertia: Any


def sphere_box(half_size: Sequence[float]) -> tuple[np.ndarray, float]:
    """Spheres for a box, all alike.

    Args:
        half_size: half edges [m].

    Returns:
        `[n, 3]` centres, box frame [m], and their radius [m]: half the edge of the cube of equal
        volume, or a quarter of the longest edge, whichever is more. They fill the box like a grid;
        a cube has one, which leaves out its corners; a plate has four and one in the middle,
        without which small things pass between them.
    """
    half = np.asarray(half_size, float)
    radius = max(float(np.cbrt(half.prod())), float(half.max()) * _THICKNESS)
    if radius <= 0:
        return np.zeros((0, 3)), 0.0
    counts = np.maximum(np.round(half / radius), 1).astype(int)
    lines = [h * ((2 * np.arange(n) + 1) / n - 1) for h, n in zip(half, counts, strict=True)]
    centers = np.stack(np.meshgrid(*lines, indexing="ij"), -1).reshape(-1, 3)
    if np.sum(counts > 1) > 1:
        centers = np.concatenate([centers, np.zeros((1, 3))])
    return centers, radius


def _balls(assembly: Assembly) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Spheres of robots one behind the other: `[n]` body, `[n, 3]` centre, body frame, radius."""
    table = assembly.fluid
    body, center, radius = [], [], []
    known: dict[tuple[float, ...], tuple[np.ndarray, float]] = {}
    for k in np.flatnonzero(assembly.touching):
        half = tuple(table.half_size[k].tolist())
        if half not in known:
            known[half] = sphere_box(half)
        places, size = known[half]
        body += [int(table.body[k])] * len(places)
        center.append(table.position[k] + places @ table.rotation[k].T)
        radius += [size] * len(places)
    none = np.zeros((0, 3))  # of a robot that touches nothing
    return np.array(body, int), np.concatenate([none, *center]), np.array(radius, float)


def pack_spheres(
    robots: Sequence[Robot], capacity: Capacity, count: int = 0, dtype: Any = np.float32
) -> Spheres:
    """The spheres of robots, as their rows stand in `batch.pack_bodies`.

    Args:
        robots: one for each individual, from `build_robot`.
        capacity: of the batch.
        count: room for so many spheres; by default as many as any of these robots has.
        dtype: of the tables.

    Returns:
        The spheres.

    Raises:
        InputError: a robot has more spheres than there is room for.
    """
    unique, pick = distinct(robots)
    assembly = assemble_all(unique)
    columns = read_constants(assembly)
    order = order_rows(columns, capacity.groups)
    body, center, radius = _balls(assembly)
    owner, total = assembly.robot[body], len(unique)
    counts = np.bincount(owner, minlength=total)
    room = count or int(counts.max())
    if np.any(counts > room):
        k = int(np.argmax(counts > room))
        place = f"robot {assembly.morphologies[k].name!r}"
        raise InputError(place, f"at most {room} spheres for contact", counts[k])
    back, rank = columns.frame.swapaxes(1, 2), counted(counts)[1]
    row = np.where(assembly.parent > 0, 1 + order.body_rows, 0)

    def table(values: np.ndarray) -> np.ndarray:
        found = np.zeros((room, total), values.dtype)
        found[rank, owner] = values
        return found

    center = turned(back[body], center)
    own, where = np.unique(body, return_inverse=True)
    lightness = np.linalg.inv(back[own] @ assembly.inertia[own] @ columns.frame[own])[where]
    middle = turned(back[body], assembly.center[body])
    found = Spheres(
        row=table(row[body].astype(np.int32)),
        center=tuple(table(center[:, i]) for i in range(3)),
        radius=table(radius),
        mass_center=tuple(table(middle[:, i]) for i in range(3)),
        inverse_mass=table(1 / assembly.mass[body]),
        inverse_inertia=tuple(table(lightness[:, i, j]) for i, j in SYM),
    )

    def wide(x: np.ndarray) -> np.ndarray:
        return x.astype(dtype if x.dtype.kind == "f" else np.int32)[..., pick]

    return jax.tree.map(wide, found)


def count_spheres(robots: Sequence[Robot]) -> int:
    """The most spheres that any of some robots has."""
    return max((len(_balls(robot.assembly)[0]) for robot in robots), default=0)
