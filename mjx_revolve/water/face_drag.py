"""Drag on the faces of parts, quadratic and implicit: by default that of compact ones.

The functions work on many parts and many individuals at once: vectors are tuples of three arrays
(see `spatial`), numbers of parts are constants that broadcast against them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from mjx_revolve.numerics.lazy import jnp
from mjx_revolve.numerics.spatial import Scalar, mul
from mjx_revolve.water.laws import (
    Coefficient,
    Drag,
    Export,
    PartDragLaw,
    PartFlow,
    PartShapes,
    law_numbers,
    part_field,
)
from mjx_revolve.water.plates import CUBE_DRAG

if TYPE_CHECKING:
    from mjx_revolve.water.world import World


@law_numbers
class FaceNumbers:
    """Drag of the faces of parts.

    Attributes:
        linear: ρ ½ C_d A of each pair of faces [kg/m].
        angular: the same against turning about each axis [kg·m²].
    """

    linear: Any = part_field("kg/m", axes="size", varied=("drag", "density"))
    angular: Any = part_field("kg m2", axes="size", varied=("drag", "density"))


def face_drag_coefficients(
    size: Float[np.ndarray, "*n 3"],
    face_areas: Float[np.ndarray, "*n 3"],
    drag_coefficient: Any,
    exposed: Float[np.ndarray, "*n 3"] | None = None,
) -> tuple[Float[np.ndarray, "*n 3"], Float[np.ndarray, "*n 3"]]:
    """Quadratic drag of boxes from their faces, per unit density.

    Along axis i the pressure acts on the face A_i: F = ½ ρ C_d A_i |v| v. Turning about axis i,
    each strip of the two pairs of faces beside it meets the water at ω r; integrating ½ ρ C_d (ω
    r)² r over them gives T = ρ C_d b_i (b_j⁴ + b_k⁴) / 64 |ω| ω (the form of MuJoCo's inertia-box
    law); each pair of faces with its own C_d.

    Args:
        size: `[..., 3]` edges of the box [m].
        face_areas: `[..., 3]` area that faces each axis [m²].
        drag_coefficient: `[...]` C_d of a face that meets the flow, or `[..., 3]` across each axis
            [-].
        exposed: `[..., 3]` share of each pair of faces that the water reaches [-]; by default all.

    Returns:
        `[..., 3]` ½ C_d A [m²] and `[..., 3]` the angular one [m⁵].
    """
    b = np.asarray(size, np.float64)
    e = np.ones(3) if exposed is None else np.asarray(exposed, np.float64)
    drag = np.asarray(drag_coefficient, np.float64)
    drag = np.broadcast_to(drag if drag.ndim == b.ndim else drag[..., None], b.shape)
    linear = 0.5 * drag * e * np.asarray(face_areas, np.float64)
    most, share = split_axes(drag)
    strips = beside(share * e, b**4)
    return linear, most * b * strips / 64


def split_axes(coefficient: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`[..., 3]` as its largest and the shares of it, which are 1 where all three are the same."""
    most = coefficient.max(-1, keepdims=True)
    return most, np.divide(coefficient, most, out=np.ones_like(coefficient), where=most > 0)


def beside(faces: np.ndarray, edges: Any = 1.0) -> np.ndarray:
    """For each axis, the sum over the faces beside it; those across k are strips along j."""
    j, k, edges = [1, 2, 0], [2, 0, 1], np.broadcast_to(edges, faces.shape)
    return faces[..., k] * edges[..., j] + faces[..., j] * edges[..., k]


def quadratic_drag(rate: Scalar, coefficient: Scalar, share: Scalar) -> tuple[Scalar, Scalar]:
    """-c |x| x for one component, and the damping c |x| for its implicit treatment.

    A step takes the speed |x| at its beginning and the velocity at its end: dt c |x| joins the
    inertia that meets the force. For a single part that is exact, v / (1 + c v dt / m), at any time
    step: drag can stop a motion but never reverse it, and terminal speeds are those of the law.

    Args:
        rate: velocity [m/s] or angular velocity [rad/s] relative to the water.
        coefficient: ρ ½ C_d A [kg/m], or the angular one [kg·m²].
        share: submerged share [-].

    Returns:
        Force [N] or torque [N·m], and damping [N·s/m] or [N·m·s].
    """
    damping = mul(mul(coefficient, jnp.abs(rate)), share)
    return -damping * rate, damping


def _face_numbers(parts: PartShapes, world: World) -> FaceNumbers:
    drag = parts.coefficients["drag_coefficient"]
    size = 2 * parts.half_size
    linear, angular = face_drag_coefficients(size, parts.silhouette, drag, parts.exposed)
    return FaceNumbers(world.density * linear, world.density * angular)


def _face_drag(flow: PartFlow, numbers: FaceNumbers, world: World) -> Drag:
    pairs = zip(flow.velocity, numbers.linear, strict=True)
    each = [quadratic_drag(x, c, flow.submerged) for x, c in pairs]
    return Drag(tuple(f for f, _ in each), (0.0, 0.0, 0.0), tuple(d for _, d in each))


FACES = PartDragLaw(
    name="faces",
    summary="quadratic drag on the true faces of the parts, and against their turning",
    steepest=3.0,  # C_d of 1.05
    by_faces=True,
    coefficients=(
        Coefficient(
            "drag_coefficient",
            "-",
            "C_d of a face that meets the flow",
            CUBE_DRAG,
            own_field=True,
            per_axis=True,
        ),
    ),
    numbers=_face_numbers,
    force=_face_drag,
    angular=lambda numbers: numbers.angular,
    mjcf=Export(
        "inertia_box",
        note="drag is MuJoCo's inertia-box law: one box for all modules that are welded together, "
        "in place of the modules' own faces",
    ),
    sdf=Export("faces", note="Hydrodynamics drags each part with the coefficients of its faces"),
)
