"""Vectors and matrices as tuples of arrays: each operation is on a whole population.

A 3-vector is a tuple of three arrays, a 3×3 matrix a tuple of three rows, a symmetric one the tuple
(xx, xy, xz, yy, yz, zz). Every component has the population on its last axis. XLA:CPU turns such
code into straight vector loops, where arrays `[..., 3]` and `dot` would cost a kernel each.

Constants are Python floats or NumPy arrays; products with 0 and 1 are folded away while tracing, so
that an axis-aligned robot pays nothing for rotations that it does not have.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from mjx_revolve.numerics.lazy import jax, jnp

Scalar = Any  # float, NumPy array or jax.Array that broadcast against each other
Vec = tuple[Scalar, ...]  # 3
Mat = tuple[Vec, ...]  # 3 rows
Sym = tuple[Scalar, ...]  # 6: xx, xy, xz, yy, yz, zz

ZERO: Vec = (0.0, 0.0, 0.0)
NO_MATRIX: Mat = (ZERO, ZERO, ZERO)
UNIT: Mat = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
SYM = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_SYM_INDEX = ((0, 1, 2), (1, 3, 4), (2, 4, 5))


def _constant(a: Scalar) -> bool:
    return isinstance(a, int | float | np.ndarray | np.generic)


def clean(x: np.ndarray) -> np.ndarray:
    """Rounds 1e-17 to 0 and 0.9999999 to 1, so that products with them fold away."""
    near = np.round(x)
    return np.where(np.abs(x - near) < 1e-12, near, x)


def fold(a: np.ndarray) -> float | np.ndarray:
    """A constant that is the same everywhere as one float, which products can fold away."""
    a = np.asarray(a, np.float64)
    return float(a.flat[0]) if a.size and np.all(a == a.flat[0]) else a


def _as(a: Scalar, like: jax.Array) -> Scalar:
    """A number, NumPy's in the other's dtype: its float64 must not widen float32."""
    return np.asarray(a, like.dtype) if isinstance(a, np.ndarray | np.generic) else a


def cast(a: Scalar, like: Scalar) -> Scalar:
    """A constant, plain numbers too, in the dtype of what it meets; a traced number as it is."""
    return a if isinstance(a, jax.Array) else np.asarray(a, like.dtype)


def is_present(x: Scalar) -> bool:
    """Whether a number is more than a plain zero; what is traced counts as something."""
    return isinstance(x, jax.Array) or bool(np.any(x))


def mul(a: Scalar, b: Scalar) -> Scalar:
    """Product; folds constant 0, 1 and -1."""
    if _constant(a) and _constant(b):
        return a * b
    if _constant(b):
        a, b = b, a
    if not _constant(a):
        return a * b
    if np.all(np.equal(a, 0)):
        return 0.0
    if np.all(np.equal(a, 1)):
        return b
    if np.all(np.equal(a, -1)):
        return -b
    return _as(a, b) * b


def add(a: Scalar, b: Scalar) -> Scalar:
    """Sum; folds constant 0."""
    if _constant(a) and np.all(np.equal(a, 0)):
        return b
    if _constant(b) and np.all(np.equal(b, 0)):
        return a
    if _constant(a) and _constant(b):
        return a + b
    return _as(a, b) + _as(b, a)


def neg(a: Scalar) -> Scalar:
    """Negative."""
    return mul(-1.0, a)


def sub(a: Scalar, b: Scalar) -> Scalar:
    """Difference; folds constant 0."""
    return add(a, -b) if _constant(a) or _constant(b) else a - b


def total(*terms: Scalar) -> Scalar:
    """Sum of several terms, from the left."""
    result: Scalar = 0.0
    for term in terms:
        result = add(result, term)
    return result


def dot(a: Vec, b: Vec) -> Scalar:
    """A · b."""
    return total(*[mul(x, y) for x, y in zip(a, b, strict=True)])


def cross(a: Vec, b: Vec) -> Vec:
    """A × b."""
    return (
        sub(mul(a[1], b[2]), mul(a[2], b[1])),
        sub(mul(a[2], b[0]), mul(a[0], b[2])),
        sub(mul(a[0], b[1]), mul(a[1], b[0])),
    )


def vadd(a: Iterable[Scalar], b: Iterable[Scalar]) -> Vec:
    """A + b, component by component."""
    return tuple(add(x, y) for x, y in zip(a, b, strict=True))


def vsub(a: Iterable[Scalar], b: Iterable[Scalar]) -> Vec:
    """A - b, component by component."""
    return tuple(sub(x, y) for x, y in zip(a, b, strict=True))


def vscale(s: Scalar, a: Iterable[Scalar]) -> Vec:
    """S a, component by component."""
    return tuple(mul(s, x) for x in a)


def madd(a: Iterable[Iterable[Scalar]], b: Iterable[Iterable[Scalar]]) -> Mat:
    """A + b of two matrices."""
    return tuple(vadd(x, y) for x, y in zip(a, b, strict=True))


def mscale(s: Scalar, a: Iterable[Vec]) -> Mat:
    """S a of a matrix."""
    return tuple(vscale(s, row) for row in a)


def matvec(r: Mat, x: Vec) -> Vec:
    """R x: from the child's frame to the parent's."""
    return tuple(dot(row, x) for row in r)


def transpose(r: Mat) -> Mat:
    """Rᵀ."""
    return tuple(tuple(r[i][j] for i in range(3)) for j in range(3))


def matTvec(r: Mat, x: Vec) -> Vec:  # noqa: N802  (T for transposed)
    """Rᵀ x: from the parent's frame to the child's."""
    return matvec(transpose(r), x)


def matmul(a: Mat, b: Mat) -> Mat:
    """A B."""
    columns = transpose(b)
    return tuple(tuple(dot(row, column) for column in columns) for row in a)


def full(s: Sym) -> Mat:
    """The nine entries of a symmetric matrix."""
    return tuple(tuple(s[k] for k in row) for row in _SYM_INDEX)


def diagonal(x: Vec) -> Sym:
    """The symmetric matrix with these three on its diagonal."""
    return x[0], 0.0, 0.0, x[1], 0.0, x[2]


def symvec(s: Sym, x: Vec) -> Vec:
    """S x for a symmetric S."""
    return matvec(full(s), x)


def skew(r: Vec) -> Mat:
    """[r]ₓ, so that [r]ₓ x = r × x."""
    return ((0.0, neg(r[2]), r[1]), (r[2], 0.0, neg(r[0])), (neg(r[1]), r[0], 0.0))


def rotate(r: Mat, m: Mat) -> Mat:
    """R M Rᵀ."""
    return matmul(matmul(r, m), transpose(r))


def rotate_sym(r: Mat, s: Sym) -> Sym:
    """R S Rᵀ for a symmetric S."""
    half = matmul(r, full(s))
    return tuple(dot(half[i], r[j]) for i, j in SYM)


def safe_norm(a: Vec) -> Scalar:
    """|a|, with gradient 0 instead of NaN where a = 0."""
    square = dot(a, a)
    # The inner `where` keeps the square root's infinite gradient out of the backward pass.
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


def namespace(x: object) -> Any:
    """The functions for an array: NumPy's for NumPy's own, else JAX's.

    Building a robot is done in NumPy: it happens once, and JAX would compile a program for each
    operation.
    """
    return np if isinstance(x, np.ndarray) else jnp


def sincos(angle: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Sine and cosine by one argument reduction and two short polynomials.

    XLA:CPU does not vectorise its own sine inside a called loop. Coefficients: Cephes `sinf`,
    `cosf` (Moshier 1992), good to 1 ulp of float32 for |angle| < 8192 where the compiler fuses
    multiplications and additions, as under `jit`; else to 4e-8 |angle|. float64 uses XLA's own
    functions.

    Args:
        angle: any shape [rad].

    Returns:
        (sin, cos), same shape.
    """
    xp = namespace(angle)
    if angle.dtype != np.float32:
        return xp.sin(angle), xp.cos(angle)
    f = np.float32
    turns = xp.round(angle * f(2 / np.pi))
    # π/2 in two parts, so that the reduced angle keeps its digits (Cody & Waite).
    r = (angle - turns * f(1.5707963705062866)) - turns * f(-4.371139000186241e-08)
    z = r * r
    s = ((f(-1.9515295891e-4) * z + f(8.3321608736e-3)) * z + f(-1.6666654611e-1)) * z * r + r
    c = ((f(2.443315711809948e-5) * z + f(-1.388731625493765e-3)) * z + f(4.166664568298827e-2)) * (
        z * z
    ) + (f(1) - f(0.5) * z)
    quadrant = turns.astype(np.int32)
    odd = (quadrant & 1) != 0
    sine = xp.where(odd, c, s)
    cosine = xp.where(odd, s, c)
    sine = xp.where((quadrant & 2) != 0, -sine, sine)
    cosine = xp.where(((quadrant + 1) & 2) != 0, -cosine, cosine)
    return sine, cosine


def quat_mul(p: tuple[Scalar, ...], q: tuple[Scalar, ...]) -> tuple[Scalar, ...]:
    """The product p q of quaternions (w, x, y, z): rotation by q, then by p."""
    (a, b, c, d), (e, f, g, h) = p, q
    return (
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    )


def quat_to_mat(q: tuple[Scalar, ...]) -> Mat:
    """Rotation matrix (world from body) of a unit quaternion (w, x, y, z)."""
    a, b, c, d = q
    return (
        (a * a + b * b - c * c - d * d, 2 * (b * c - a * d), 2 * (b * d + a * c)),
        (2 * (b * c + a * d), a * a - b * b + c * c - d * d, 2 * (c * d - a * b)),
        (2 * (b * d - a * c), 2 * (c * d + a * b), a * a - b * b - c * c + d * d),
    )


def quat_to_matrix(quat: np.ndarray) -> np.ndarray:
    """`[..., 4]` unit quaternions (w, x, y, z) to `[..., 3, 3]` rotation matrices."""
    rows = quat_to_mat(tuple(np.moveaxis(np.asarray(quat, np.float64), -1, 0)))
    return np.stack([np.stack(row, -1) for row in rows], -2)


def matrix_to_quat(matrix: np.ndarray) -> np.ndarray:
    """`[..., 3, 3]` rotation matrices to `[..., 4]` unit quaternions (w, x, y, z).

    As MuJoCo's `mju_mat2Quat`: w is positive where the trace is, else the largest of the others.
    """
    m = np.asarray(matrix, np.float64)
    x, y, z = (m[..., i, i] for i in range(3))
    # 4 q qᵀ, of which every row is the quaternion but for its length.
    products = np.empty((*m.shape[:-2], 4, 4))
    diagonal = (1 + x + y + z, 1 + x - y - z, 1 - x + y - z, 1 - x - y + z)
    for k, value in enumerate(diagonal):
        products[..., k, k] = value
    for k, (i, j) in enumerate(((2, 1), (0, 2), (1, 0)), 1):
        products[..., 0, k] = products[..., k, 0] = m[..., i, j] - m[..., j, i]
    for i, j in ((0, 1), (0, 2), (1, 2)):
        products[..., i + 1, j + 1] = products[..., j + 1, i + 1] = m[..., i, j] + m[..., j, i]
    largest = np.argmax(np.stack((x, y, z), -1), -1) + 1
    row = np.where(x + y + z > 0, 0, largest)
    quat = np.take_along_axis(products, row[..., None, None], -2)[..., 0, :]
    return quat / np.linalg.norm(quat, axis=-1, keepdims=True)


def continuous_quaternions(quaternion: np.ndarray) -> np.ndarray:
    """Quaternions `[S, ..., 4]` of which neighbours in time are close: q and -q turn alike."""
    flips = np.where((quaternion[1:] * quaternion[:-1]).sum(-1) < 0, -1.0, 1.0)
    signs = np.concatenate([np.ones_like(quaternion[:1, ..., 0]), np.cumprod(flips, axis=0)])
    return quaternion * signs[..., None]
