"""Inertias of a robot's parts, each by itself, for programs in which every part is a link.

They are added as pseudo-inertias: Wensing, Kim and Slotine 2018, Linear matrix inequalities for
physically consistent inertial parameter identification.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from mjx_revolve.body.module_types import Part
from mjx_revolve.engine.assembly import BALLAST_RADIUS

# Mass of a link without mass [kg], as a link must have some.
LEAST = 1e-6
# Share of a thruster's mass that is its propeller: it only makes it spin.
_ROTOR = 0.05


def spread(mass: float, center: ArrayLike, square: np.ndarray) -> np.ndarray:
    """`[4, 4]` pseudo-inertia of a body; those of bodies in one frame add up.

    Args:
        mass: [kg].
        center: `[3]` of mass [m].
        square: `[3, 3]` mean of x xᵀ over the mass, x from the centre [m²].
    """
    place = np.append(center, 1.0)
    result = np.outer(place, place)
    result[:3, :3] += square
    return mass * result


def part_spread(part: Part) -> np.ndarray:
    """Pseudo-inertia of a part without its propeller, as the MuJoCo model has it.

    The mass is spread evenly over the main box; a ballast is a small ball.
    """
    return _whole(part) - (0 if part.thruster is None else propeller(part)[0])


def _whole(part: Part) -> np.ndarray:
    box = spread(part.mass, np.zeros(3), np.diag(np.square(part.boxes[0].size)) / 12)
    ball = spread(part.ballast_mass, part.ballast_position, BALLAST_RADIUS**2 / 5 * np.eye(3))
    return box + ball


def propeller(part: Part) -> tuple[np.ndarray, float]:
    """Pseudo-inertia of a thruster's propeller, a thin disc, part frame; its diameter [m]."""
    assert part.thruster is not None
    axis = np.asarray(part.thruster.axis)
    across = np.abs(axis) < 0.99 * np.abs(axis).max()
    size = np.asarray(part.boxes[0].size)
    diameter = 0.9 * float((size[across] if across.any() else size).min())
    square = diameter**2 / 16 * (np.eye(3) - np.outer(axis, axis))
    mass, one = _ROTOR * part.mass, spread(1.0, part.thruster.position, square)
    # Outside of the part's box it weighs less, or what is left has an inertia that no body has.
    while mass > LEAST and np.linalg.eigvalsh(_whole(part) - mass * one)[0] <= 0:
        mass /= 2
    return max(mass, LEAST) * one, diameter


def moments(body: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass [kg], `[3]` centre [m] and `[3, 3]` inertia about it [kg·m²] of a pseudo-inertia.

    A body without mass becomes a small one of `LEAST` at the origin.
    """
    if body[3, 3] <= 0:
        body = spread(LEAST, np.zeros(3), 5e-5 * np.eye(3))
    mass, center = body[3, 3], body[:3, 3] / body[3, 3]
    square = body[:3, :3] - mass * np.outer(center, center)
    return max(mass, LEAST), center, np.trace(square) * np.eye(3) - square
