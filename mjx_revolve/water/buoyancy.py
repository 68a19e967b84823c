"""Buoyancy: the submerged fraction of a box, Archimedes' force, surface tension.

A box of half edges h, its centre at depth d and the vertical n in its frame, is cut by a plane.
With a_i = h_i |n_i| the mean over the box of max(0, depth) is W(d, a), and everything else is its
gradient: the submerged fraction ∂W/∂d, its first moment -∂W/∂n. W is a box spline, usually
written as a sum over the corners of (±) (d ± a₁ ± a₂ ± a₃)⁴ / (192 a₁a₂a₃), which is 0/0 when an
edge is level and a difference of large numbers long before. Here the longest of the a_i is
integrated last, over a rectangle with integrals written without differences; so the form
is exact at every attitude, in float32 too.

All are pure functions on tuples of arrays (see `spatial`), run under `jit`, `vmap` and `grad` and
have finite gradients everywhere.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from mjx_revolve.numerics.lazy import jnp
from mjx_revolve.numerics.spatial import Scalar, Vec, cross, mul, total, vadd, vscale
from mjx_revolve.water.laws import BuoyancyLaw, Export, find_law


class _Rectangle(NamedTuple):
    """Half heights of a tilted rectangle's edges, and what its cuts need of them.

    Attributes:
        short: half height of the flatter edge [m].
        long: half height of the steeper edge [m].
        ratio: short / long, at most 1.
        per_long: 1 / long [1/m].
        steepness: long / (2 short).
    """

    short: Scalar
    long: Scalar
    ratio: Scalar
    per_long: Scalar
    steepness: Scalar


class _Cut(NamedTuple):
    """Integrals over what of a rectangle rises above level |x|, of order 1; see `_cut`."""

    first: Scalar
    second: Scalar
    by_short: Scalar


def _exchange(a: Any, b: Any) -> tuple[Any, Any, Any]:
    """The smaller, the larger, and whether they changed places.

    Selects and no min and max: where two are equal, those would split the gradient between both.
    """
    swap = a > b
    return jnp.where(swap, b, a), jnp.where(swap, a, b), swap


def _back(swap: Any, a: Any, b: Any) -> tuple[Any, Any]:
    """Undoes `_exchange`."""
    return jnp.where(swap, b, a), jnp.where(swap, a, b)


def _rectangle(short: Any, long: Any, scale: Any) -> _Rectangle:
    """Prepares a rectangle; the rounding error of the length `scale` is its smallest tilt."""
    # A level edge is 0/0. The levels of the cuts are rounded to one unit in the last place of
    # `scale`, so a smaller tilt is not seen in them; in float32, eight units already show.
    floor = scale * float(np.finfo(jnp.result_type(short)).eps)
    short, long = jnp.maximum(short, floor), jnp.maximum(long, floor)
    per_long = 1 / long
    return _Rectangle(short, long, short * per_long, per_long, 0.5 * long / short)


def _cut(x: Any, r: _Rectangle) -> _Cut:
    """What of a rectangle of half heights a₁ ≤ a₂ rises above level |x|.

    With t = x + a₁u + a₂v over the square u, v ∈ [-1, 1] and means over it, for x < 0

        mean max(0, t)    = a₂/12 first            =: M(x)
        mean ½ max(0, t)² = a₂²/12 second          =: N(x)
        mean u max(0, t)  = a₁/6 by_short          =: F₁(x) = ∂N/∂a₁
        mean v max(0, t)  = a₂/12 (first - second) =: F₂(x) = ∂N/∂a₂

    and from there, because max(0, t) - max(0, -t) = t, M(-x) = M(x) - x, N(-x) = ½x² +
    (a₁² + a₂²)/6 - N(x), F_i(-x) = a_i/3 - F_i(x).

    Only the corners a₂ + a₁ and a₂ - a₁ rise above |x|. Half the sum z and half the difference w of
    what they rise, in units of a₂, carry all integrals as sums of positive terms; s = w a₂/a₁ is
    the share of the strips along the steeper edge that reach above.

    Args:
        x: level above the rectangle's centre [m].
        r: the rectangle.

    Returns:
        The integrals.
    """
    # The one-sided gradient at 0 must be the same here and in every `x >= 0` below.
    b = 1 - jnp.where(x >= 0, x, -x) * r.per_long
    whole = b >= r.ratio
    s = jnp.where(whole, 1.0, jnp.maximum(0.5 + b * r.steepness, 0))
    w = r.ratio * s
    z = jnp.where(whole, b, w)
    zz, ww = z * z, w * w
    return _Cut(s * (3 * zz + ww), s * z * (zz + ww), s * s * (z + w * (1 - s)))


def cut_box(up: Vec, depth: Scalar, half_size: Vec) -> tuple[Scalar, Vec]:
    """Submerged fraction of a tilted box, and the centre of the submerged piece.

    The exact volume and centroid of the box cut by a plane. Let a₁ ≤ a₂ ≤ a₃ be the
    h_i |n_i| in order and M, N, F_i the integrals of `_cut` over the rectangle of a₁, a₂. Then

        share = [M(d + a₃) - M(d - a₃)] / 2a₃,    W = [N(d + a₃) - N(d - a₃)] / 2a₃,
        ∂W/∂a_i = [F_i(d + a₃) - F_i(d - a₃)] / 2a₃  for i = 1, 2,
        ∂W/∂a₃ = [M(d + a₃) + M(d - a₃)] / 2a₃ - W/a₃,

    and the moment is -∂W/∂n_i = -h_i² n_i (∂W/∂a_i / a_i), the quotient without division by a
    vanishing a_i: righting moments have their true gradient at a level attitude. Force and moment
    come from one potential, so they conserve energy; they are continuous at all depths and
    attitudes. Their gradients are too, with one true exception: the force on a level box gets
    its full gradient at once, when a whole face meets the surface.

    Errors in units of the box: 1e-14 in float64, 1e-6 in float32 (`tests/water/test_buoyancy.py`).

    Args:
        up: the world's vertical, part frame.
        depth: depth of the box's centre below the surface [m], positive under water.
        half_size: half edges [m].

    Returns:
        The submerged fraction [-], and fraction times centre of the submerged piece relative to the
        box's centre, part frame [m].
    """
    a, b, c = (mul(h, jnp.abs(n)) for h, n in zip(half_size, up, strict=True))
    a, b, swap_first = _exchange(a, b)
    b, c, swap_last = _exchange(b, c)
    a, b, swap_again = _exchange(a, b)
    r = _rectangle(a, b, c)
    per_c = 1 / c
    high, low = depth + c, depth - c
    upper, lower = _cut(high, r), _cut(low, r)
    second = upper.second + lower.second
    by_short = upper.by_short + lower.by_short
    by_long = upper.first + lower.first - second
    # [max(0, d + c) - max(0, d - c)] / c; wholly in or out, one of the cuts is empty.
    reached, covered = high >= 0, low >= 0
    between = reached & ~covered
    plain = jnp.where(covered, 2.0, jnp.where(reached, jnp.minimum(high * per_c, 2), 0.0))
    gradient_a = jnp.where(between, 2 - by_short, by_short) * (1 / 12)
    gradient_b = jnp.where(between, 4 - by_long, by_long) * (1 / 24)
    second = jnp.where(between, 2 + 2 * r.ratio * r.ratio - second, second)
    tilt = r.long * per_c
    share = 0.5 * plain + tilt * (1 / 24) * (upper.first - lower.first)
    gradient_c = 0.25 * plain * (2 - plain) + tilt * (1 / 24) * (
        upper.first + lower.first - tilt * second
    )
    gradient_a, gradient_b = _back(swap_again, gradient_a, gradient_b)
    gradient_b, gradient_c = _back(swap_last, gradient_b, gradient_c)
    gradient_a, gradient_b = _back(swap_first, gradient_a, gradient_b)
    moment = [
        mul(-(h * h), n * (gradient * per_c))
        for h, n, gradient in zip(half_size, up, (gradient_a, gradient_b, gradient_c), strict=True)
    ]
    return share, tuple(moment)


def mask_box(up: Vec, depth: Scalar, half_size: Vec) -> tuple[Scalar, Vec]:
    """As `cut_box`, but all of the box once its centre is below the surface, and no moment."""
    zero = jnp.zeros_like(depth)
    return jnp.asarray(depth > 0, zero.dtype), (zero, zero, zero)


def displaced_water(
    share: Scalar, moment: Vec, volume: Scalar, center: Vec, density: Scalar
) -> tuple[Scalar, Vec]:
    """The water that a part displaces: its mass and the first moment of it.

    The surface cuts the box where it is. The box's submerged share is that of the part's own
    volume; its centre is as far from the submerged piece's as it is from the box's when all is
    under water: exact there, and for a part that fills its box. Where the centre of volume is
    off the box's by e and the surface cuts the box, force and moment have no potential: a part that
    goes in with e downwards and comes out with e upwards has gained 2 ρ V g |e| on its way round.

    Args:
        share: submerged share of the box [-].
        moment: share times centre of the submerged piece, from the box's centre [m].
        volume: displaced when wholly submerged [m³].
        center: centre of volume, from where moments are taken, in the frame of `moment` [m].
        density: of the water [kg/m³].

    Returns:
        Mass [kg], and mass times centre [kg·m].
    """
    whole = mul(density, volume)
    return mul(whole, share), vscale(whole, vadd(moment, vscale(share, center)))


def surface_tension(
    up: Vec,
    depth: Scalar,
    half_size: Vec,
    tension: float,
    weight_density: float,
    contact_angle: float = 0.0,
    exposed: Vec = (1.0, 1.0, 1.0),
) -> tuple[Vec, Vec]:
    """Pull of the surface on the waterline of a box: an approximation, from one energy.

    E = -γ cos θ × wetted area, by Young's equation (de Gennes, Brochard-Wyart & Quéré 2004,
    Capillarity and Wetting Phenomena, ch. 1 and 2). Where upright walls cross the surface, this is
    Wilhelmy's γ cos θ per metre of waterline, downward on a body that water wets. The surface is
    taken as flat and unbounded: no meniscus that climbs, breaks or is shared by bodies, no energy
    of the water's own surface where the body covers it (γ × waterplane, constant between upright
    walls), no hysteresis of the contact angle.

    A face that lies level would be wetted in an instant. So a point at depth t counts as wetted by
    a share that rises from 0 to 1 for t in ±λ, λ = √(γ/ρg) the capillary length (2.7 mm in water),
    with the triangle (λ - |t|)/λ² as its derivative: force and torque are then continuous. For the
    mean over a face with centre at depth d and half heights a₁, a₂ that is a second difference,

        wetted share = [N(d + λ) - 2 N(d) + N(d - λ)] / λ²,

    with N, and its derivatives M by d and F_i by a_i, from `_cut`. Force ∂E/∂d along `up` and
    torque (-∂E/∂n) × n are sums of the same differences of M and F. They vanish when the whole box
    is further than λ from the surface.

    Args:
        up: the world's vertical, part frame.
        depth: depth of the box's centre below the surface [m], positive under water.
        half_size: half edges [m].
        tension: γ of the water against air [N/m], 0.0728 at 20 °C (IAPWS R1-76).
        weight_density: ρ g of the water [N/m³]; without weight there is no capillary length, the
            wetting is spread over all depths, and force and torque are 0.
        contact_angle: θ [rad]; below π/2 water wets the body and pulls it down.
        exposed: share of each pair of faces that the water reaches [-].

    Returns:
        Force [N] and torque [N·m], part frame, at the box's centre.
    """
    zero = jnp.zeros_like(depth)
    if tension == 0 or weight_density <= 0:
        return (zero, zero, zero), (zero, zero, zero)
    blur = math.sqrt(tension / weight_density)
    heights = [mul(h, jnp.abs(n)) for h, n in zip(half_size, up, strict=True)]
    line: Scalar = 0.0
    lever: list[Scalar] = [0.0, 0.0, 0.0]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        area = 4 * half_size[j] * half_size[k] * exposed[i]
        short, long, swap = _exchange(heights[j], heights[k])
        r = _rectangle(short, long, blur)
        gradient_short, gradient_long = 0.0, 0.0
        for side in (1, -1):
            x = depth - side * mul(half_size[i], up[i])
            first, by_short, by_long = 0.0, 0.0, 0.0
            for weight, level in ((1, x + blur), (-2, x), (1, x - blur)):
                cut = _cut(level, r)
                first = total(first, mul(weight, cut.first))
                part = jnp.where(level >= 0, 2 - cut.by_short, cut.by_short)
                by_short = total(by_short, mul(weight, part))
                part = cut.first - cut.second
                part = jnp.where(level >= 0, 4 - part, part)
                by_long = total(by_long, mul(weight, part))
            # The same difference of max(0, x).
            plain = jnp.where(
                x + blur >= 0,
                jnp.where(x >= 0, jnp.where(x - blur >= 0, 0.0, blur - x), x + blur),
                0.0,
            )
            of_face = mul(area, plain + r.long * (1 / 12) * first)
            line = total(line, of_face)
            lever[i] = total(lever[i], mul(side * half_size[i], of_face))
            gradient_short = total(gradient_short, by_short)
            gradient_long = total(gradient_long, by_long)
        gradient_j, gradient_k = _back(swap, gradient_short * (1 / 6), gradient_long * (1 / 12))
        for axis, gradient in ((j, gradient_j), (k, gradient_k)):
            square = half_size[axis] * half_size[axis]
            lever[axis] = total(lever[axis], mul(-area * square, up[axis] * gradient))
    strength = -tension * math.cos(contact_angle) / blur**2
    force = vscale(mul(strength, line), up)
    return force, cross(vscale(strength, lever), up)


# ------------------------------------------------------------------------- the table

_LIFT = (
    "the bodies with names that end in /lift weigh nothing (10 micrograms), at the centres of "
    "buoyancy; their gravcomp lifts with the weight of the displaced water"
)
_BOXES = (
    "Buoyancy lifts with the volume of the collision boxes, so these have the volume that a part "
    "displaces, at its centre of volume, and the proportions of its box: not its size"
)

PARTIAL = BuoyancyLaw(
    name="partial",
    summary="the submerged share of each module's box, cut by the surface",
    submersion=cut_box,
    mjcf=Export("partial", note=_LIFT),
    sdf=Export("partial", note=_BOXES),
)
MASK = BuoyancyLaw(
    name="mask",
    summary="all or nothing, by the box's centre: the thesis's rule",
    submersion=mask_box,
    mjcf=Export("partial", note=_LIFT),
    sdf=Export("partial", _BOXES, missing="buoyancy: mask, all or nothing at the surface"),
)
OFF = BuoyancyLaw(
    name="off",
    summary="no lift; what is dragged is dragged as with mask",
    submersion=mask_box,
    lifts=False,
    mjcf=Export(""),
    sdf=Export(""),
)

BUOYANCY_LAWS = {law.name: law for law in (PARTIAL, MASK, OFF)}
"""The buoyancy laws by the names that worlds and modules give."""


def find_buoyancy_law(name: str) -> BuoyancyLaw:
    """The buoyancy law of a name; an unknown one is an `InputError`."""
    return find_law(BUOYANCY_LAWS, name)
