"""Drag of thin plates with a memory of their wake.

A plate that swings meets the vortices that it has shed a moment ago, and is dragged by several
times its steady drag: C_d = A / KC + B across a flow that oscillates, KC = U T / b the
Keulegan-Carpenter number (Ikeda's fit, ITTC). Amplitude and period are not known in a step, so each
plate keeps four numbers of its middle's motion along its normal, v its velocity there through the
water and τ a time (the filters are a choice; no simulator that was read has such a memory):

    v̄' = (v - v̄) / τ          its mean velocity
    ξ' = (v - v̄) - ξ / τ      its way off the mean
    E' = (ξ² - E) / τ          the mean square of that
    G' = ((v - v̄)² - G) / τ   the mean square of the velocity off the mean

with KC = 2 π a / width, a the larger of √(2 E) and |ξ|, which is there as soon as a motion begins,
σ = G / (G + v̄²) the share of what oscillates, and the steady drag times 1 + σ (R - 1), where R is
min(A / KC + B, most) / C_d of a long plate: what plates of other aspect ratios share is the ratio.
Steady flow has σ = 0, and the steady law. The factor is never below 1 and even in v, so that drag
opposes every motion; all four know velocities through the water only, so that a current changes
nothing. They are stepped exactly for a velocity that holds for the step. Out of the water a plate
forgets: v counts with its submerged share. Share and KC are ratios, which the least motion of a
middle has, too; where turning moves a plate's strips faster than its middle, by a factor s, the
share is less by s⁻², down to the steady drag of a plate that turns about its middle (a choice).

Beside that a thin part is one of a chain, a rod or a compact one (`cross_flow`), but for its steady
drag, which rises with its aspect ratio. The factor holds for the force across it, by strips where
it is a rod; what a compact plate has against its turning stays steady. Edges that are square,
those of boxes, do not grow their drag so (Graham 1980), so how thin a part is, is a share: 1 where
it is a tenth as thick as wide, 0 where it is twice that. Width, length and thickness are those of
the row of parts that the plate belongs to, so that a plate in pieces is one plate.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from mjx_revolve.numerics.lazy import jnp
from mjx_revolve.numerics.spatial import Scalar, cross, dot, mul
from mjx_revolve.water.coefficients import TODAY
from mjx_revolve.water.cross_flow import CROSS_FLOW, CrossFlowNumbers, chain_shares, split_drag
from mjx_revolve.water.face_drag import FACES
from mjx_revolve.water.laws import Drag, PartDragLaw, PartFlow, PartShapes, law_numbers, part_field

if TYPE_CHECKING:
    from mjx_revolve.water.world import World

_THIN, _LONG = TODAY["plate_thinness"].value, TODAY["long_plate_drag"].value
_A, _B, _MOST = (TODAY[f"swing_{name}"].value for name in ("drag", "large_drag", "most"))
_TAU = TODAY["swing_memory"].value


@law_numbers
class PlateWakeNumbers(CrossFlowNumbers):
    """Drag of thin parts: that of `cross_flow`, and more.

    Attributes:
        normal: 1 at the axis across the plate.
        thin: how thin it is [-].
        width: shorter edge of the plate [m].
    """

    normal: Any = part_field("-", axes="size", fixed="the robot's shape, which is known")
    thin: Any = part_field("-", fixed="the robot's shape, which is known")
    width: Any = part_field("m", blank=1.0, fixed="the robot's shape, which is known")


def thinness(size: Any) -> np.ndarray:
    """`[...]` how thin boxes of edges `[..., 3]` are: 1 of a thin plate, 0 of a box."""
    thick, width, _ = np.moveaxis(np.sort(np.asarray(size, float)), -1, 0)
    return np.clip(2 - thick / width / _THIN, 0, 1)


def _numbers(parts: PartShapes, world: World) -> PlateWakeNumbers:
    chain = CROSS_FLOW.numbers(parts, world)
    normal = np.eye(3)[parts.half_size.argmin(-1)]
    thick = (normal * parts.rows).sum(-1)
    flat = np.sort(np.where(normal, np.inf, parts.rows))
    width, length = flat[..., 0], flat[..., 1]
    thin = thinness(np.stack([thick, width, length], -1)) * (thick <= width)
    square, slope = TODAY["plate_drag"].value, TODAY["plate_drag_slope"].value
    steady = np.minimum(square + slope * (length / width - 1), _LONG) / TODAY["cube_drag"].value
    plate = FACES.numbers(parts, world).linear * steady[..., None]
    along, share = chain_shares(parts)
    linear = along * chain.head[:, None] + chain.faces + chain.strips
    linear += normal * thin[..., None] * (plate - linear)
    names = ("head", "faces", "strips")
    own = vars(chain) | dict(zip(names, split_drag(linear, along, share), strict=True))
    return PlateWakeNumbers(**own, normal=normal, thin=thin, width=width)


def _factor(flow: PartFlow, numbers: PlateWakeNumbers) -> Scalar:
    """What the wake multiplies the steady drag by."""
    mean, way, square, changing = flow.memory
    reach = jnp.sqrt(jnp.maximum(jnp.maximum(2 * square, way * way), 1e-30))
    number = 2 * np.pi * reach / numbers.width
    swinging = jnp.minimum(_A / jnp.maximum(number, 1e-6) + _B, _MOST) / _LONG
    whole = changing + mean * mean
    v = dot(flow.velocity, numbers.normal)
    # The gradient at rest, where there is no force, is that of plates that have hardly moved.
    known = whole > 0
    share = jnp.where(known, changing / jnp.where(known, whole, 1), jnp.where(v == 0, 1.0, 0.0))
    spin = dot(cross(flow.angular_velocity, numbers.along), numbers.normal)
    turning = mul(numbers.reach, spin)
    turning = turning * turning
    moving = v * v + whole
    turned = turning > moving
    share = share * jnp.where(turned, moving / jnp.where(turned, turning, 1), 1)
    return 1 + mul(numbers.thin, share * (swinging - 1))


def _force(flow: PartFlow, numbers: PlateWakeNumbers, world: World) -> Drag:
    if flow.memory:
        factor = _factor(flow, numbers)
        more = tuple(1 + mul(n, factor - 1) for n in numbers.normal)
        numbers = replace(
            numbers,
            faces=tuple(map(mul, numbers.faces, more)),
            strips=tuple(map(mul, numbers.strips, more)),
        )
    return CROSS_FLOW.force(flow, numbers, world)


def _remember(
    flow: PartFlow, numbers: PlateWakeNumbers, world: World, dt: float
) -> tuple[Scalar, ...]:
    """Exactly, for a velocity that holds for the step."""
    v = mul(dot(flow.velocity, numbers.normal), flow.submerged)
    mean, way, square, changing = flow.memory
    off, x = v - mean, dt / _TAU
    kept = np.exp(-x)
    # With off falling as e^(-t/τ), ξ = (way + off t) e^(-t/τ) and ∫ ξ² e^(t/τ) dt / τ is
    # way² I0 + 2 way off I1 + off² I2, In = ∫ t^n e^(-t/τ) dt / τ.
    i0 = -np.expm1(-x)
    i1 = _TAU * (i0 - x * kept)
    i2 = 2 * _TAU * i1 - dt * dt * kept
    return (
        v - off * kept,
        (way + off * dt) * kept,
        (square + way * way * i0 + 2 * way * off * i1 + off * off * i2) * kept,
        (changing + off * off * i0) * kept,
    )


PLATE_WAKE = PartDragLaw(
    name="plate_wake",
    summary="cross_flow, and of thin plates a drag that remembers their wake",
    steepest=10.0,  # C_d of up to 10 where a plate swings a little
    numbers=_numbers,
    force=_force,
    angular=CROSS_FLOW.angular,
    memory=4,
    remember=_remember,
    mjcf=CROSS_FLOW.mjcf,
    sdf=CROSS_FLOW.sdf._replace(missing=f"{CROSS_FLOW.sdf.missing}, plates' memory of their wake"),
)
