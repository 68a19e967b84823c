"""Water that a body carries along: added mass of its envelope, and water inside it.

Added mass comes from the outer shape (the envelope), not from the volume of the mesh. Entrained
water fills part of the envelope and moves with it like cargo.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy.special import elliprd

from mjx_revolve.numerics.inertia import SpatialInertia
from mjx_revolve.numerics.spatial import Scalar, Vec, mul, neg
from mjx_revolve.water.coefficients import TODAY
from mjx_revolve.water.laws import Coefficient, law_numbers, part_field

COEFFICIENTS = (
    Coefficient(
        "added_mass_coefficient",
        "-",
        "multiplies the envelope's added mass",
        1.0,
        own_field=True,
        per_axis=True,
        spread=1.35,
    ),
    Coefficient(
        "entrained_water",
        "-",
        "water that moves with the part, as a share of the box's volume without its material",
        0.0,
        high=1.0,
        own_field=True,
    ),
)


@law_numbers
class CarriedWater:
    """Water that parts carry along, wholly wet: added mass and entrained water.

    Attributes:
        inertia: about the body's origin, body frame.
        mass: along the part's axes [kg].
        angular: about them, about the box's centre [kg·m²].
        entrained: share of `mass` that is entrained water [-], for `near_surface`, else None.
    """

    inertia: SpatialInertia = part_field("kg m2", varied=("added_mass", "density"))
    mass: Vec = part_field("kg", axes="size", varied=("added_mass", "density"))
    angular: Vec = part_field("kg m2", axes="size", varied=("added_mass", "density"))
    entrained: Any = part_field("-", axes="size", fixed="a share", default=None)


def lamb_coefficients(semi_axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Added mass and added inertia of an ellipsoid in unbounded water, per unit density.

    Lamb, Hydrodynamics (1932), §§ 114-115; the integrals are Carlson's R_D (Carlson 1979).

    Args:
        semi_axes: `[..., 3]` semi-axes a, b, c [m].

    Returns:
        `[..., 3]` added mass along each axis [m³] and `[..., 3]` added inertia about each [m⁵].
    """
    a, b, c = (np.asarray(semi_axes, np.float64)[..., i] for i in range(3))
    abc = a * b * c
    volume = 4 / 3 * np.pi * abc
    alpha = 2 / 3 * abc * elliprd(b * b, c * c, a * a)
    beta = 2 / 3 * abc * elliprd(c * c, a * a, b * b)
    gamma = 2 / 3 * abc * elliprd(a * a, b * b, c * c)
    mass = [volume * x / (2 - x) for x in (alpha, beta, gamma)]

    def inertia(b: np.ndarray, c: np.ndarray, beta: np.ndarray, gamma: np.ndarray) -> np.ndarray:
        difference, square = b * b - c * c, b * b + c * c
        below = 2 * difference + square * (beta - gamma)
        # A body of revolution about this axis carries no water round with it.
        round_ = np.abs(difference) < 1e-9 * square
        safe = np.where(round_, 1.0, below)
        return np.where(round_, 0.0, volume / 5 * difference**2 * (gamma - beta) / safe)

    added_inertia = [
        inertia(b, c, beta, gamma),
        inertia(c, a, gamma, alpha),
        inertia(a, b, alpha, beta),
    ]
    return np.stack(mass, -1), np.stack(added_inertia, -1)


def box_added_mass(half_size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Added mass of a box: that of the ellipsoid of equal volume and equal proportions.

    A choice, which `coefficients` explains.

    Args:
        half_size: `[..., 3]` half edges [m].

    Returns:
        As `lamb_coefficients`.
    """
    share = TODAY["box_added_mass"].value
    return lamb_coefficients((6 / np.pi * share) ** (1 / 3) * np.asarray(half_size, np.float64))


def entrained_water(
    half_size: np.ndarray, free_volume: np.ndarray, fraction: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Water that fills a share of a part's envelope, per unit density.

    It is spread evenly over the box, so it resists every motion alike; under water its weight and
    its buoyancy cancel. A choice: what is flooded drains at once above the surface.

    Args:
        half_size: `[..., 3]` half edges of the box [m].
        free_volume: `[...]` volume of the box that the part's material leaves free [m³].
        fraction: `[...]` share of it that is flooded [-].

    Returns:
        `[..., 3]` mass [m³] and inertia [m⁵] along and about each axis.
    """
    volume = np.asarray(fraction, np.float64) * np.maximum(free_volume, 0)
    square = (2 * np.asarray(half_size, np.float64)) ** 2
    inertia = volume[..., None] / 12 * (square.sum(-1, keepdims=True) - square)
    return np.repeat(volume[..., None], 3, -1), inertia


def wetting_rate(share: Scalar, before: Scalar, dt: float) -> Scalar:
    """How fast a part's wet share grows; 0 where it shrinks.

    Args:
        share: of the part that is submerged [-].
        before: the same a step ago.
        dt: of the step [s].

    Returns:
        Its rate [1/s].
    """
    # A choice and no max: where both are 1, under water, that would split a gradient.
    return jnp.where(share > before, (share - before) * (1 / dt), 0)


def slam(rate: Scalar, carried: Any, speed: Vec) -> Vec:
    """Force of the water that a part begins to carry, or torque of what turns with it: -ṁ_a v.

    Von Karman's theory of the slam (1929, The impact on seaplane floats during landing, NACA TN
    321): body and carried water keep their momentum while more of it comes aboard, d/dt (m + m_a) v
    = f. Water that is left behind keeps its velocity, and so does the body: nothing acts while m_a
    falls. Either way ½ |ṁ_a| v² is lost to the body: entry gives it to the spray, exit to the water
    that is left. So no way in and out of the water makes energy.

    In a step, with E = Σ A_k max(0, s_k - s_k') over the parts k, with shares s_k' a step
    ago, this is (M + Σ A_k s_k) dt ν' = -E ν. What multiplies the old velocity, M + Σ A_k min(s_k,
    s_k'), is never negative and at most the inertia that the step solves with: a slam can stop a
    body but not throw it back, at any step, even where a share jumps from 0 to 1. And what comes
    aboard in one step is carried in the next, so that momentum is kept however long the step.

    Args:
        rate: from `wetting_rate` [1/s].
        carried: what the part carries wholly wet, along or about its axes [kg, or kg·m²].
        speed: relative to the water [m/s, or rad/s].

    Returns:
        [N, or N·m].
    """
    return tuple(mul(mul(rate, neg(m)), x) for m, x in zip(carried, speed, strict=True))
