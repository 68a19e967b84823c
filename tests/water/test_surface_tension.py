"""Surface tension on a box: the textbook's pull at upright walls, one energy, nothing far away."""

import itertools
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from laboratory import QUICK
from mjx_revolve.water.buoyancy import surface_tension

TENSION = 0.0728  # N/m, water against air at 20 °C
WEIGHT = 9801.0  # N/m³
BLUR = np.sqrt(TENSION / WEIGHT)  # the capillary length, 2.7 mm

CORE = np.array([0.0445, 0.0445, 0.0225])
BOXES = {"core": CORE, "plate": np.array([0.03, 0.02, 5e-4]), "cube": np.full(3, 0.02)}


@lru_cache
def _pull(angle, exposed):
    """One program for all boxes."""
    return jax.jit(
        lambda up, depth, half: surface_tension(up, depth, half, TENSION, WEIGHT, angle, exposed),
        compiler_options=QUICK,
    )


def pull(up, depth, half, angle=0.0, exposed=(1.0, 1.0, 1.0), x64=True):
    """`surface_tension` of many states of one box: `[n, 3]`, `[n]` to twice `[n, 3]`."""
    with jax.enable_x64(x64):
        up = tuple(jnp.asarray(x) for x in np.asarray(up, float).T)
        force, torque = _pull(angle, exposed)(up, jnp.asarray(depth), tuple(half))
        return np.stack(force, -1), np.stack(torque, -1)


def attitudes(n, seed=0):
    """`[n, 3]` verticals that see all edges."""
    draw = np.random.default_rng(seed)
    up = draw.normal(size=(20 * n, 3))
    up /= np.linalg.norm(up, axis=1)[:, None]
    return up[np.abs(up).min(1) > 0.1][:n]


def faces(half):
    """Area, centre and the two edges' axes of each face."""
    for i, side in itertools.product(range(3), (-1.0, 1.0)):
        j, k = (i + 1) % 3, (i + 2) % 3
        yield 4 * half[j] * half[k], side * half[i] * np.eye(3)[i], j, k


def energy(up, depth, half, angle):
    """E by the corners of the faces: the textbook's sum, for edges far from level."""
    total = 0.0
    for area, center, j, k in faces(half):
        a, b = jnp.abs(up[j]) * half[j], jnp.abs(up[k]) * half[k]
        for weight, level in ((1, BLUR), (-2, 0.0), (1, -BLUR)):
            x = depth - up @ center + level
            for s, t in itertools.product((-1, 1), repeat=2):
                corner = jnp.maximum(x + s * a + t * b, 0.0) ** 4 / (96 * a * b)
                total -= area * weight * s * t * corner / BLUR**2
    return TENSION * jnp.cos(angle) * total


@lru_cache
def energy_slopes():
    """One program for all boxes and angles: slopes of `energy` by vertical and depth."""
    slope = jax.vmap(jax.grad(energy, (0, 1)), (0, 0, None, None))
    return jax.jit(slope, compiler_options=QUICK)


@pytest.mark.slow
@pytest.mark.parametrize("angle", [0.0, 2.5])
@pytest.mark.parametrize("axis", range(3))
def test_upright_walls_are_pulled_by_the_length_of_their_waterline(angle, axis):
    """The force of a Wilhelmy plate: -γ cos θ × perimeter, straight down, without a torque."""
    half = np.array([0.02, 0.03, 0.01])
    up = np.zeros((5, 3))
    up[:, axis] = [1, 1, 1, -1, -1]
    # Half-way and elsewhere, more than a capillary length from the edges.
    depth = half[axis] * np.array([0.0, 0.4, -0.7, 0.0, 0.6])
    perimeter = 4 * (half.sum() - half[axis])
    force, torque = pull(up, depth, half, angle)
    expected = -TENSION * np.cos(angle) * perimeter * up
    assert force == pytest.approx(expected, rel=1e-12, abs=1e-15)
    assert torque == pytest.approx(0.0, abs=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("name", BOXES)
@pytest.mark.parametrize("angle", [0.0, 2.0])
def test_force_and_torque_are_the_slopes_of_the_energy(name, angle):
    """Force ∂E/∂d along the vertical, torque (-∂E/∂n) × n, to the reference's rounding."""
    half, up = BOXES[name], attitudes(150, 3)
    reach = np.abs(up) @ half + BLUR
    depth = np.random.default_rng(5).uniform(-1.02, 1.02, len(up)) * reach
    force, torque = pull(up, depth, half, angle)
    with jax.enable_x64(True):
        slopes = energy_slopes()(jnp.asarray(up), jnp.asarray(depth), jnp.asarray(half), angle)
        by_up, by_depth = map(np.asarray, slopes)
    scale = TENSION * half.sum()
    assert force == pytest.approx(by_depth[:, None] * up, abs=1e-7 * scale)
    assert torque == pytest.approx(np.cross(-by_up, up), abs=1e-7 * scale * half.max())
    # float32: rounding of levels against λ.
    force32, torque32 = pull(up, depth, half, angle, x64=False)
    assert force32 == pytest.approx(force, abs=2e-4 * scale)
    assert torque32 == pytest.approx(torque, abs=2e-4 * scale * half.max())


@pytest.mark.parametrize("x64", [True, False])
def test_nothing_wholly_under_or_out(x64):
    up = np.concatenate([attitudes(30, 4), np.eye(3), -np.eye(3)])
    for sign in (-1, 1):
        for depth in (np.abs(up) @ CORE + 1.001 * BLUR, np.full(len(up), 1e4)):
            for part in pull(up, sign * depth, CORE, x64=x64):
                assert not part.any()


def test_nothing_without_tension_weight_or_wetting():
    up, depth = (jnp.zeros(1), jnp.zeros(1), jnp.ones(1)), jnp.zeros(1)
    for tension, weight in ((0.0, WEIGHT), (TENSION, 0.0)):
        for vector in surface_tension(up, depth, tuple(CORE), tension, weight):
            assert not np.any(np.stack(vector))
    force, _ = pull([[0.0, 0.0, 1.0]], [0.0], CORE, np.pi / 2)
    assert np.abs(force).max() < 1e-15


@pytest.mark.slow
@pytest.mark.parametrize("tilt", [0.0, 5e-3])
def test_force_and_torque_are_continuous_through_the_surface(tilt):
    """Halving the spacing of the samples halves the largest jump, for level faces too."""
    half = BOXES["plate"]
    up = np.array([0.6 * np.sin(tilt), 0.8 * np.sin(tilt), np.cos(tilt)])
    depth = np.linspace(-1.5, 1.5, 16001) * (half.max() + BLUR)
    force, torque = pull(np.tile(up, (len(depth), 1)), depth, half)
    rows = np.column_stack([force, torque])
    fine = np.abs(np.diff(rows, axis=0)).max(0)
    coarse = np.abs(np.diff(rows[::2], axis=0)).max(0)
    assert np.all(fine < 0.6 * coarse + 1e-12)


def test_a_level_face_is_wetted_over_one_capillary_length():
    """The bottom of a level box: a triangle of pull, its peak γ cos θ A/λ where it touches."""
    half = CORE
    depth = -half[2] + BLUR * np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
    force, _ = pull(np.tile([0.0, 0.0, 1.0], (5, 1)), depth, half)
    only_walls, _ = pull(np.tile([0.0, 0.0, 1.0], (5, 1)), depth, half, exposed=(1.0, 1.0, 0.0))
    bottom = -TENSION * 4 * half[0] * half[1] / BLUR * np.array([0.0, 0.5, 1.0, 0.5, 0.0])
    assert (force - only_walls)[:, 2] == pytest.approx(bottom, rel=1e-12, abs=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("x64", [True, False])
def test_gradients_are_finite_and_right(x64):
    """Everywhere finite; against differences where the slope has no jump of its own."""
    half = (0.03, 0.02, 0.02)
    level, edge = (0.0, 0.0, 1.0), (0.0, 0.5**0.5, -(0.5**0.5))
    anywhere = (0.36, -0.48, 0.8)
    with jax.enable_x64(x64):

        def everything(state):
            force, torque = surface_tension(tuple(state[1:]), state[0], half, TENSION, WEIGHT)
            return jnp.stack([*force, *torque])

        slopes = jax.jit(jax.jacrev(everything), compiler_options=QUICK)
        everything = jax.jit(everything, compiler_options=QUICK)
        for up in (level, edge, anywhere):
            reach = float(np.abs(up) @ np.array(half))
            for depth in (0.0, 0.004, reach, -reach, 2 * reach, -1e4, reach + BLUR):
                state = np.array([depth, *up])
                found = np.asarray(slopes(jnp.asarray(state)))
                assert np.all(np.isfinite(found))
                smooth = up is not level or abs(depth) < reach - 1.1 * BLUR
                if not x64 or not smooth:
                    continue
                rows = [
                    np.asarray(everything(state + e) - everything(state - e)) / 2e-8
                    for e in 1e-8 * np.eye(4)
                ]
                expected = np.stack(rows, -1)
                assert found == pytest.approx(expected, abs=2e-5 * max(1, np.abs(expected).max()))
