"""Added mass of what floats, and the waves that it radiates."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from laboratory import at_rest, box_robot, march, random_states, world
from mjx_revolve.water.added_mass import CarriedWater
from mjx_revolve.water.buoyancy import BUOYANCY_LAWS
from mjx_revolve.water.near_surface import near_surface, turning_share

RHO, G = 999.1026, 9.81
LONG, BREADTH, HEIGHT = 2.0, 0.4, 0.25
MASS = (3.0, 40.0, 90.0)
pytestmark = pytest.mark.usefixtures("float64")


def close(up, depth, size=(LONG, BREADTH, HEIGHT), entrained=0.0, gravity=G):
    """The law on a box of carried water `MASS`."""
    half = tuple(x / 2 for x in size)
    up = tuple(map(jnp.asarray, up))
    carried = CarriedWater(None, MASS, MASS, (entrained,) * 3)  # type: ignore[arg-type]
    submerged, _ = BUOYANCY_LAWS["partial"].submersion(up, jnp.asarray(depth), half)
    return near_surface(up, jnp.asarray(depth), submerged, half, carried, gravity)


def test_an_upright_section_has_strip_theorys_values():
    """A quarter of the deep value in heave, 8/π² (T/H)² of it in sway, Jensen's damping."""
    draught = 0.15
    found = close((0.0, 0.0, 1.0), draught - HEIGHT / 2)
    onset = 1 - (1 - draught / HEIGHT) ** 4
    assert found.share[2] == pytest.approx(0.25 * onset, rel=1e-12)
    assert found.share[1] == pytest.approx(8 / np.pi**2 * (draught / HEIGHT) ** 2, rel=1e-12)
    # b = ρ g² A² / ω³ to the length, A = 2 sin(kB/2) exp(-kT); ρ B² per length stands for `MASS`.
    k = 1 / (draught + BREADTH / 2)
    amplitude = 2 * np.sin(k * BREADTH / 2) * np.exp(-k * draught)
    damping = G**2 * amplitude**2 / np.sqrt(G * k) ** 3 / BREADTH**2 * MASS[2] * onset
    assert found.damping.linear[5] == pytest.approx(damping, rel=1e-12)
    assert found.damping.linear[0] == found.damping.linear[3] == 0


def test_deep_down_nothing_is_left_of_it_and_entrained_water_knows_none():
    shares = [np.array(close((0.0, 0.6, 0.8), d).share) for d in (0.5, 1.0, 2.0, 4.0)]
    left = 1 - np.array(shares)
    assert np.all(left > 0)
    assert np.all(left[1:] < left[:-1] / 2.5)  # with the square of the depth
    assert np.all(np.array(close((0.0, 0.6, 0.8), 30.0).damping.linear) < 1e-9 * MASS[2])
    half = close((0.0, 0.6, 0.8), 0.01, entrained=1.0)
    assert np.ptp(np.array(half.share)) == 0  # what fills a part is its submerged share
    assert np.all(np.array(half.damping.linear) == 0)


@pytest.mark.slow
def test_shares_are_between_none_and_all_and_smooth():
    rng = np.random.default_rng(0)
    for up in rng.normal(size=(20, 3)):
        up /= np.linalg.norm(up)
        for depth in (-0.9, -0.1, 0.0, 0.13, 0.4):
            found = close(up, depth)
            assert all(-1e-12 <= x <= 1 for x in found.share)
            np.testing.assert_allclose(found.share, close(up * [1, -1, 1], depth).share, rtol=1e-12)
            xx, xy, xz, yy, yz, zz = map(float, found.damping.linear)
            matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            assert np.linalg.eigvalsh(matrix).min() > -1e-9 * (1 + matrix.max())
            assert min(map(float, (found.damping.angular[i] for i in (0, 3, 5)))) >= 0
    spins = turning_share((0.2, 0.4, 0.6), MASS, (1.0, 0.5, 0.2))
    assert all(0.2 <= x <= 0.6 for x in spins)
    slope = jax.grad(lambda d: close((0.0, 0.6, 0.8), d).share[2])
    for depth in (-0.05, 0.0, 0.1, 3.0):
        assert np.isfinite(slope(depth))


def test_a_floating_box_heaves_with_the_period_of_its_share():
    """ω² (m + a) = ρ g L B, a quarter of the deep added mass, damped as the law says."""
    size = (1.0, BREADTH, HEIGHT)
    mass = 0.6 * RHO * np.prod(size)
    tank = world(added_mass=True, gravity=G, buoyancy="partial", timestep=0.002, near_surface=True)
    robot = box_robot(size, mass, tank)
    qpos, qvel = at_rest(robot, 1, -0.1 * HEIGHT + 0.004)
    time, q, *_ = march(robot, 2.2, qpos, qvel)
    z = q[:, 2, 0] + 0.1 * HEIGHT
    k = np.flatnonzero(np.diff(np.sign(z)))
    crossings = time[k] - z[k] * (time[k + 1] - time[k]) / (z[k + 1] - z[k])
    deep, draught = RHO * robot.fluid.carried_mass[0, 2], 0.6 * HEIGHT
    onset = 1 - 0.4**4
    whole = mass + 0.25 * onset * deep
    square = RHO * G * size[0] * size[1] / whole
    wave = 1 / (draught + BREADTH / 2)
    amplitude = 2 * np.sin(wave * BREADTH / 2) * np.exp(-wave * draught)
    damping = np.sqrt(G) * amplitude**2 / wave**1.5 / BREADTH**2 * deep * onset
    omega = np.sqrt(square - (damping / whole / 2) ** 2)
    # Its added mass changes with the draught, and the slam acts on the way in: a few per cent.
    assert np.diff(crossings)[0] == pytest.approx(np.pi / omega, rel=0.03)


def test_boxes_that_fall_and_rise_through_the_surface_gain_nothing():
    """Weightless, from the air: what a body has is never more than it came with."""
    size = (0.2, 0.1, 0.06)
    robot = box_robot(size, 0.3, world(added_mass=True, buoyancy="partial", near_surface=True))
    qpos, qvel = random_states(robot, 32, seed=3, speed=0.5)
    qpos[2] = 0.13
    qvel[2] = -0.8
    _, q, v, _ = march(robot, 1.0, qpos, qvel)
    own = 0.3 / 12 * (np.sum(np.square(size)) - np.square(size))
    energy = 0.15 * (v[:, :3] ** 2).sum(1) + 0.5 * (own[:, None] * v[:, 3:6] ** 2).sum(1)
    start = 0.15 * (qvel[:3] ** 2).sum(0) + 0.5 * (own[:, None] * qvel[3:6] ** 2).sum(0)
    assert (q[:, 2].min(0) < 0).all()
    assert np.all(energy <= start * (1 + 1e-9))


@pytest.mark.slow
def test_what_bobs_and_tumbles_gains_no_energy():
    """Relative density .6, no drag: kinetic and potential energy never exceed the start's."""
    size, dt = np.array([0.2, 0.1, 0.06]), 0.01
    tank = world(added_mass=True, gravity=G, buoyancy="partial", timestep=dt, near_surface=True)
    mass = 0.6 * RHO * size.prod()
    robot = box_robot(tuple(size), mass, tank)
    qpos, qvel = random_states(robot, 16, seed=5, speed=0.0)
    qpos[2] = np.linspace(0.12, 0.3, 16)
    _, q, v, _ = march(robot, 20.0, qpos, qvel, every=round(0.02 / dt))
    # Dropped from the air: weight alone bounds the speed at each height above the lowest one.
    fallen = G * (qpos[2] - q[:, 2])
    own = mass / 12 * (np.sum(size**2) - size**2)
    energy = 0.5 * mass * (v[:, :3] ** 2).sum(1) + 0.5 * (own[:, None] * v[:, 3:6] ** 2).sum(1)
    assert np.all(energy <= mass * fallen * (1 + 3 * dt) + 1e-9 * mass)
    assert np.all(energy[-50:].max(0) < 0.05 * energy.max(0))
