"""Added mass of parts at the surface, and the waves that they radiate: strip theory, no memory.

Where a body moves faster than its waves can follow, the surface is one of constant pressure (φ =
0). A section of breadth B and draught T then carries

- in heave, half of what the section and its mirror image carry deep down: for an ellipse ½ ρ π b²
  whatever its draught, half of its deep value;
- in sway (2/π) ρ T²: the image moves the other way, the stream function on an ellipse is T |sin θ|
  and its energy does not depend on b. For a semicircle that is 4/π² of ρ π T²/2, the known value.
  Over the deep value of the whole box, (π/4) ρ H², it is 8/π² (T/H)².

In heave, where a part has a period of its own, ω² = g / (T + B/2) with the mass above, waves make a
difference. Their damping is b = ρ g² A² / ω³ to the length, A = 2 sin(kB/2) exp(-kT), k = ω²/g
(Jensen, Mansour and Olsen 2004, Ocean Engineering 31, 61-85; as in Fossen's MSS,
waveresponse345.m); what a damping by waves takes of the added mass follows from it by Kramers and
Kronig, a(ω) - a(∞) = (2/π) ∫ b(s) / (s² - ω²) ds: at that frequency half of a(∞), from 0.52 at B/T
= 4 to 0.48 at 1. Both are taken there. In roll the same waves come from bottom and sides, which
oppose each other.

Under water the image fades with (E/D)², E half the height and D the depth of the centre, as two
dipoles have it; waves with exp(-2 k d), d the depth of the top.

Each number is a factor along an axis of the part, between axes by the squares of the vertical's
components. So a part takes water aboard along each axis by itself, and `added_mass.slam` holds:
nothing that goes in and out, turns or dives gains energy.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from mjx_revolve.numerics.inertia import SpatialInertia
from mjx_revolve.numerics.spatial import NO_MATRIX, SYM, Scalar, Vec, diagonal, dot, mul, total
from mjx_revolve.water.added_mass import CarriedWater
from mjx_revolve.water.coefficients import TODAY

_TURNS = ((0, 1, 2), (1, 2, 0), (2, 0, 1))
# A flat bottom carries all of its water once it touches: spread over about a third of the height.
# A choice; it keeps what is carried continuous.
_ONSET = 4


class NearSurface(NamedTuple):
    """What the surface makes of parts, along and about their axes.

    Attributes:
        share: of the mass that they carry along each axis [-].
        damping: by the waves that they radiate, about the box's centre.
    """

    share: Vec
    damping: SpatialInertia


def turning_share(share: Vec, mass: Vec, half_size: Vec) -> Vec:
    """Shares of what turns about each axis: water across one axis at a lever along another."""
    found = []
    for _, j, k in _TURNS:
        a = mul(mass[j], half_size[k] * half_size[k])
        b = mul(mass[k], half_size[j] * half_size[j])
        whole = a + b
        part = jnp.where(whole > 0, a / jnp.where(whole > 0, whole, 1), 0.5)
        found.append(mul(part, share[j]) + mul(1 - part, share[k]))
    return tuple(found)


def near_surface(
    up: Vec, depth: Scalar, submerged: Scalar, half_size: Vec, carried: CarriedWater, gravity: float
) -> NearSurface:
    """What parts carry near the surface, of what they carry deep down, and their waves.

    Args:
        up: the surface's normal, part's axes.
        depth: of the box's centre below the surface [m].
        submerged: submerged fraction [-].
        half_size: half edges of the boxes [m].
        carried: the water that they carry deep down; entrained water stays with its fraction.
        gravity: [m/s²].
    """
    square = tuple(x * x for x in up)
    size = tuple(mul(2, x) for x in half_size)
    reach = dot(tuple(map(jnp.abs, up)), half_size)
    seen = total(*[mul(jnp.abs(up[i]), size[j] * size[k]) for i, j, k in _TURNS])
    draught = mul(submerged, size[0] * size[1] * size[2]) / seen
    narrow = tuple(jnp.minimum(size[j], size[k]) for _, j, k in _TURNS)
    breadth = dot(square, narrow)
    under = jnp.maximum(depth - reach, 0)
    image = (reach / (reach + under)) ** 2
    length = draught + 0.5 * breadth  # 1 / k
    fading = jnp.exp(-2 * under / length) * (gravity > 0)
    onset = 1 - (1 - submerged) ** _ONSET
    heave = onset * (1 - 0.5 * image - 0.5 * TODAY["wave_share"].value * fading)
    sway = submerged * submerged * (1 - (1 - 8 / np.pi**2) * image)
    assert carried.entrained is not None
    along = (sway + x * (heave - sway) for x in square)
    share = tuple(
        x + mul(inside, submerged - x) for x, inside in zip(along, carried.entrained, strict=True)
    )
    # Waves: b / m, with m the deep added mass, ρ B² to the length.
    pairs = zip(carried.mass, carried.entrained, strict=True)
    deep = dot(square, tuple(mul(m, 1 - inside) for m, inside in pairs))
    beta = 0.5 * breadth / length
    sine, fall = jnp.sin(beta), jnp.exp(beta - 1)  # k T = 1 - β
    rate = 4 * sine * sine * fall * fall * length**1.5 / (breadth * breadth)
    strength = float(np.sqrt(gravity)) * rate * fading * onset * deep
    bottom = (sine - beta * jnp.cos(beta)) * fall
    sides = sine * (1 - (2 - beta) * fall)
    roll = (length * (bottom - sides) / (sine * fall)) ** 2
    about = []
    for j in range(3):
        lever = 0.0
        for i in range(3):
            if i != j:
                k = 3 - i - j
                long = mul(size[k] * size[k], 1 / 12)
                lever = lever + square[i] * jnp.where(size[k] > size[j], long, roll)
        about.append(strength * lever)
    linear = tuple(strength * up[i] * up[j] for i, j in SYM)
    return NearSurface(share, SpatialInertia(diagonal(tuple(about)), NO_MATRIX, linear))
