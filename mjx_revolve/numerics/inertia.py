"""How the bodies of one level move, and their spatial inertias.

Spatial quantities are (angular, linear), in each body's own frame, about its own origin
(Featherstone 2008, Rigid Body Dynamics Algorithms, chapter 2).
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

from mjx_revolve.numerics.spatial import (
    NO_MATRIX,
    SYM,
    Mat,
    Scalar,
    Sym,
    Vec,
    cross,
    diagonal,
    full,
    madd,
    matmul,
    matvec,
    mscale,
    mul,
    skew,
    sub,
    symvec,
    total,
    transpose,
    vadd,
    vscale,
)


class BodyMotion(NamedTuple):
    """Pose and velocity of the bodies of a level, `[nbody, lanes]` each.

    Attributes:
        angular_velocity: body frame [rad/s].
        velocity: of the body's origin, body frame [m/s].
        z_axis: the world's z axis, body frame.
        height: world z of the origin [m].
        x_axis: the world's x axis, body frame; None where no law needs the horizontal position.
        y_axis: the world's y axis, body frame, or None.
        xy: world x and y of the origin [m], or None.
        midpoint: angular and linear velocity half a step ahead, for the water's forces and for
            momenta that turn with the body; None outside of steps.
        begun: angular and linear velocity at the step's beginning, where the velocity is another;
            else None.
    """

    angular_velocity: Vec
    velocity: Vec
    z_axis: Vec
    height: Scalar
    x_axis: Any
    y_axis: Any
    xy: Any
    midpoint: Any = None
    begun: Any = None

    @property
    def twist(self) -> tuple[Vec, Vec]:
        """Angular and linear velocity."""
        return self.angular_velocity, self.velocity

    @property
    def midpoint_velocity(self) -> tuple[Vec, Vec]:
        """Angular and linear velocity with which momenta turn."""
        return self.midpoint or self.twist

    @property
    def position(self) -> Vec:
        """World coordinates of the bodies' origins; only where `xy` is known."""
        return (*self.xy, self.height)

    @property
    def axes(self) -> tuple[Vec, Vec, Vec]:
        """The world's three axes, body frame: the rows of the rotation world from body."""
        return self.x_axis, self.y_axis, self.z_axis


class SpatialInertia(NamedTuple):
    """A 6×6 spatial inertia [[angular, cross], [crossᵀ, linear]]."""

    angular: Sym
    cross: Mat
    linear: Sym


class Block(NamedTuple):
    """A 6×6 matrix that need not be symmetric, [[angular, across], [back, linear]]."""

    angular: Mat
    across: Mat
    back: Mat
    linear: Mat


def block_of(inertia: SpatialInertia) -> Block:
    """A spatial inertia with all of its entries."""
    return Block(
        full(inertia.angular), inertia.cross, transpose(inertia.cross), full(inertia.linear)
    )


def gyroscope(angular: Vec, linear: Vec) -> Block:
    """K(h) with K(h) ν = ν ×* h: the rate of change of a body-fixed momentum h as its body moves.

    It is antisymmetric: for any h that force does no work.
    """
    turned = mscale(-1.0, skew(linear))
    return Block(mscale(-1.0, skew(angular)), turned, turned, NO_MATRIX)


def add_block(a: Block, s: Scalar, b: Block) -> Block:
    """A + s b."""
    scaled = ((map(partial(mul, s), row) for row in matrix) for matrix in b)
    return Block(*map(madd, a, scaled))


def apply_block(a: Block, angular_velocity: Vec, velocity: Vec) -> tuple[Vec, Vec]:
    """Matrix times a motion, (angular, linear)."""
    return (
        vadd(matvec(a.angular, angular_velocity), matvec(a.across, velocity)),
        vadd(matvec(a.back, angular_velocity), matvec(a.linear, velocity)),
    )


def apply_inertia(inertia: SpatialInertia, angular_velocity: Vec, velocity: Vec) -> tuple[Vec, Vec]:
    """Inertia times a motion: its momentum, (angular, linear)."""
    angular = vadd(symvec(inertia.angular, angular_velocity), matvec(inertia.cross, velocity))
    linear = vadd(
        matvec(transpose(inertia.cross), angular_velocity), symvec(inertia.linear, velocity)
    )
    return angular, linear


def diagonal_inertia(angular: Vec, linear: Vec) -> SpatialInertia:
    """The inertia with these on its diagonal."""
    return SpatialInertia(diagonal(angular), NO_MATRIX, diagonal(linear))


def add_inertia(a: SpatialInertia, b: SpatialInertia) -> SpatialInertia:
    """The sum of two spatial inertias."""
    return SpatialInertia(
        vadd(a.angular, b.angular), madd(a.cross, b.cross), vadd(a.linear, b.linear)
    )


def scale_inertia(s: Scalar, a: SpatialInertia) -> SpatialInertia:
    """A spatial inertia times a scalar."""
    return SpatialInertia(vscale(s, a.angular), mscale(s, a.cross), vscale(s, a.linear))


def shift_inertia(
    linear: Sym, angular: Sym, position: Vec, cross: Mat | None = None
) -> SpatialInertia:
    """A 6×6 inertia or damping that is given at a point, shifted to the body's origin.

    Args:
        linear: 3×3, force per velocity (or acceleration) of the point, body frame.
        angular: 3×3, torque per angular velocity (or acceleration).
        position: of the point, body frame [m].
        cross: 3×3, torque per velocity (or acceleration) of the point; None: zero.

    Returns:
        The 6×6 about the origin: [[A - C [r] - (C [r])ᵀ - [r] L [r], C + [r] L], [·, L]].
    """
    x = skew(position)
    across = matmul(x, full(linear))
    second = matmul(across, x)
    if cross is not None:
        once = matmul(cross, x)
        second = madd(second, map(vadd, once, transpose(once)))
        across = madd(cross, across)
    return SpatialInertia(
        tuple(sub(angular[k], second[i][j]) for k, (i, j) in enumerate(SYM)), across, linear
    )


def cross_force(angular_velocity: Vec, velocity: Vec, angular: Vec, linear: Vec) -> tuple[Vec, Vec]:
    """The spatial force cross product v ×* f (Featherstone 2008, § 2.8)."""
    return vadd(cross(angular_velocity, angular), cross(velocity, linear)), cross(
        angular_velocity, linear
    )


def sum_parts(x: Scalar, n: int) -> Scalar:
    """Sum over the first of three axes, written out: a small call must not contain a reduction.

    Args:
        x: `[n or 1, nbody, lanes]`, or a smaller array that stands for n equal terms.
        n: how many terms.

    Returns:
        `[nbody, lanes]`.
    """
    if not hasattr(x, "shape") or x.ndim < 3:
        return mul(float(n), x)
    return total(*[x[k] for k in range(x.shape[0])]) if x.shape[0] > 1 else mul(float(n), x[0])
