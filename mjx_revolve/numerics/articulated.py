"""Articulated-body inertias: the apparent inertia of a subtree at its root.

The three parts of Featherstone's articulated-body algorithm (2008, Rigid Body Dynamics Algorithms,
§ 7.3) for hinges along z, independent of how the bodies are laid out in memory. Matrices need not
be symmetric: added mass taken at the step's midpoint makes them unsymmetric.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from mjx_revolve.numerics.inertia import Block, apply_block
from mjx_revolve.numerics.spatial import (
    SYM,
    Mat,
    Scalar,
    Vec,
    add,
    cross,
    dot,
    full,
    madd,
    matmul,
    matTvec,
    matvec,
    mul,
    neg,
    rotate,
    rotate_sym,
    skew,
    sub,
    total,
    transpose,
    vadd,
    vscale,
    vsub,
)


def to_parent(
    turn: Mat, position: Vec, block: Block, bias: tuple[Vec, Vec], symmetric: bool
) -> tuple[Block, tuple[Vec, Vec]]:
    """An articulated inertia and its bias force, seen from the parent's frame and origin."""
    across = rotate(turn, block.across)
    if symmetric:
        angular, linear = (full(rotate_sym(turn, upper(x))) for x in (block.angular, block.linear))
        back = transpose(across)
    else:
        angular, linear, back = (rotate(turn, x) for x in (block.angular, block.linear, block.back))
    torque, force = (matvec(turn, x) for x in bias)
    r = skew(position)
    shifted = madd(across, matmul(r, linear))
    below = transpose(shifted) if symmetric else tuple(map(vsub, back, matmul(linear, r)))
    first, second = matmul(r, back), matmul(shifted, r)
    entry = lambda i, j: sub(add(angular[i][j], first[i][j]), second[i][j])  # noqa: E731
    moved = _square(entry, symmetric)
    return Block(moved, shifted, below, linear), (vadd(torque, cross(position, force)), force)


def upper(m: Mat) -> Vec:
    """The upper half of a symmetric matrix."""
    return tuple(m[i][j] for i, j in SYM)


def _square(entry: Callable[[int, int], Scalar], symmetric: bool) -> Mat:
    """A 3×3 matrix from its entries; a symmetric one from its upper half alone."""
    if symmetric:
        return full(tuple(entry(i, j) for i, j in SYM))
    return tuple(tuple(entry(i, j) for j in range(3)) for i in range(3))


class JointElimination(NamedTuple):
    """Results of eliminating a hinge that the pass from the root to the leaves needs."""

    row_a: Vec
    row_l: Vec
    inverse: Scalar
    rest: Scalar


def eliminate_joint(
    block: Block,
    bias: tuple[Vec, Vec],
    column: tuple[Vec, Vec],
    inertia: Scalar,
    torque: Scalar,
    coriolis: tuple[Vec, Vec],
    symmetric: bool,
) -> tuple[Block, tuple[Vec, Vec], JointElimination]:
    """Eliminates a hinge (about z): the articulated inertia and bias that act on the parent.

    Args:
        block: articulated inertia of the hinge's body, its descendants included.
        bias: bias force of the same bodies.
        column: `block` times the body's acceleration per acceleration of the hinge.
        inertia: added about the hinge's axis: armature and implicit terms [kg·m²].
        torque: at the hinge [N·m].
        coriolis: velocity times joint velocity.
        symmetric: whether `block` is, and the acceleration about z.

    Returns:
        Inertia and bias for the parent, and what the pass from root to leaves needs.
    """
    column_a, column_l = column
    row_a, row_l = block.angular[2], block.across[2]
    inverse = 1 / add(column_a[2], inertia)
    rest = sub(torque, bias[0][2])
    scaled_a, scaled_l = vscale(inverse, row_a), vscale(inverse, row_l)
    less = lambda m, column, row: lambda i, j: sub(m[i][j], mul(column[i], row[j]))  # noqa: E731
    across = _square(less(block.across, column_a, scaled_l), False)
    other = less(block.back, column_l, scaled_a)
    back = transpose(across) if symmetric else _square(other, False)
    angular = _square(less(block.angular, column_a, scaled_a), symmetric)
    linear = _square(less(block.linear, column_l, scaled_l), symmetric)
    left = Block(angular, across, back, linear)
    carried = apply_block(left, *coriolis)
    pushed = mul(inverse, rest)
    bias = (
        vadd(vadd(bias[0], carried[0]), vscale(pushed, column_a)),
        vadd(vadd(bias[1], carried[1]), vscale(pushed, column_l)),
    )
    return left, bias, JointElimination(row_a, row_l, inverse, rest)


def to_child(turn: Mat, position: Vec, motion: tuple[Vec, Vec]) -> tuple[Vec, Vec]:
    """A motion (angular, linear) of a parent, seen from the child's frame and origin."""
    angular, linear = motion
    return matTvec(turn, angular), matTvec(turn, vadd(linear, cross(angular, position)))


def release_joint(
    joint: JointElimination, axis: tuple[Vec, Vec], held: tuple[Vec, Vec]
) -> tuple[tuple[Vec, Vec], Scalar]:
    """Accelerations of a body and of its hinge; `held`: the body's if the hinge did not move."""
    rest = sub(sub(joint.rest, dot(joint.row_a, held[0])), dot(joint.row_l, held[1]))
    hinge = mul(joint.inverse, rest)
    return (vadd(held[0], vscale(hinge, axis[0])), vadd(held[1], vscale(hinge, axis[1]))), hinge


def solve_root(block: Block, bias: tuple[Vec, Vec], symmetric: bool) -> tuple[Vec, Vec]:
    """Acceleration of the free root: block a = -bias, by elimination, linear rows first.

    Without pivoting, which the positive symmetric part makes safe (Golub & Van Loan 2013, § 4.3).
    """
    a = [[*block.linear[i], *block.back[i]] for i in range(3)]
    a += [[*block.across[i], *block.angular[i]] for i in range(3)]
    rhs = [neg(x) for x in (*bias[1], *bias[0])]
    inverse = []
    for i in range(6):
        inverse.append(1 / a[i][i])
        for j in range(i + 1, 6):
            factor = mul(a[i][j] if symmetric else a[j][i], inverse[i])
            for k in range(j if symmetric else i + 1, 6):
                a[j][k] = sub(a[j][k], mul(factor, a[i][k]))
            rhs[j] = sub(rhs[j], mul(factor, rhs[i]))
    for i in reversed(range(6)):
        known = total(*[mul(a[i][j], rhs[j]) for j in range(i + 1, 6)])
        rhs[i] = mul(sub(rhs[i], known), inverse[i])
    return tuple(rhs[3:]), tuple(rhs[:3])
