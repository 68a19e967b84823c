"""Thrusters: lag, curves and torque in closed form, in both precisions, with their gradients."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_revolve.body.catalogue import MODULES, Thruster
from mjx_revolve.water.thrusters import (
    ideal_power,
    interpolated_thrust,
    lag_decay,
    lagged_command,
    thrust,
)

LANES = np.linspace(-1.5, 1.5, 61)  # commands, some beyond the range
LINE = Thruster(
    curve="interpolated", commands=(-1.0, -0.2, 0.1, 1.0), thrusts=(-0.7, 0.0, 0.0, 2.0)
)
BAND = Thruster(curve="dead_band", gain=2.0, gain_backward=0.5, dead_band=(-0.1, 0.3))
BASIC = Thruster(gain=3.0)
CATALOGUES = MODULES["Thruster"].parts[0].thruster
ALL = {"basic": BASIC, "dead_band": BAND, "interpolated": LINE, "catalogue's": CATALOGUES}


@pytest.mark.parametrize("dt", [0.005, 1.0])
def test_a_step_passes_the_lag_as_an_exponential(dt):
    """s(t) = x (1 - e^(-t/τ)), whatever the step; rounding alone, of at most 200 steps."""
    tau, asked = 0.08, 0.7
    state, time = 0.0, 0.0
    for _ in range(200):
        state, time = lagged_command(state, asked, lag_decay(tau, dt)), time + dt
        assert state == pytest.approx(asked * (1 - math.exp(-time / tau)), rel=1e-12)


def test_basic_thrust_goes_with_the_square_of_the_command():
    assert thrust(BASIC, LANES) == pytest.approx(3 * np.sign(LANES) * LANES**2)


def test_dead_band_of_bessa():
    """b = x|x|: k_l (b - δ_l) below δ_l, k_r (b - δ_r) above δ_r, else nothing."""
    x = np.array([-1.0, -0.5, -math.sqrt(0.1), -0.3, 0.0, 0.5, math.sqrt(0.3), 0.6, 1.0])
    expected = [0.5 * -0.9, 0.5 * (-0.25 + 0.1), 0, 0, 0, 0, 0, 2 * (0.36 - 0.3), 2 * 0.7]
    assert thrust(BAND, x) == pytest.approx(np.array(expected), abs=1e-15)
    one_sided = Thruster(curve="dead_band", gain=2.0, dead_band=(-0.1, 0.3))
    assert thrust(one_sided, np.array([-1.0, 1.0])) == pytest.approx([-1.8, 1.4])


def test_interpolation_through_many_random_points_is_numpys():
    rng = np.random.default_rng(0)
    for count in (2, 3, 8, 40):
        commands = np.sort(rng.uniform(-1, 1, count))
        thrusts = rng.normal(size=count)
        found = interpolated_thrust(LANES, commands, thrusts)
        assert found == pytest.approx(np.interp(LANES, commands, thrusts), abs=1e-13)


@pytest.mark.parametrize("name", ALL)
def test_the_table_of_a_thruster_is_its_curve(name):
    """`Thruster.thrust_at`, for tables and pictures, against the law that acts in the water."""
    thruster = ALL[name]
    clamped = LANES.clip(*thruster.range)
    assert thrust(thruster, clamped) == pytest.approx([thruster.thrust_at(x) for x in LANES])
    line = np.linspace(*thruster.range, 2001)
    assert thruster.largest_thrust >= max(abs(thruster.thrust_at(x)) for x in line)
    twice = thruster.scaled(2.0)
    assert thrust(twice, clamped) == pytest.approx(2 * thrust(thruster, clamped), abs=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("name", ALL)
def test_gradients_are_finite_everywhere_and_true_off_the_corners(name):
    thruster = ALL[name]
    with jax.enable_x64(True):

        def push(asked):
            return thrust(thruster, asked.clip(*thruster.range))

        edge = math.sqrt(0.3)
        corners = jnp.array([-1.0, -0.2, -0.1, 0.0, 0.1, 0.3, edge, 1.0])
        assert np.isfinite(jax.vmap(jax.grad(push))(corners)).all()
        smooth = jnp.array([-1.3, -0.77, -0.15, 0.05, 0.45, 0.9, 1.2])
        slope = jax.vmap(jax.grad(push))(smooth)
        h = 1e-6
        numeric = (push(smooth + h) - push(smooth - h)) / (2 * h)
        assert np.asarray(slope) == pytest.approx(np.asarray(numeric), abs=1e-8)

        def power(asked):
            return ideal_power(push(asked), 5e-4, 1000.0)

        assert np.isfinite(jax.vmap(jax.grad(power))(corners)).all()


def test_ideal_power_is_thrust_times_the_speed_in_the_disc():
    """At rest T = 2 ρ A u² (Froude), P = T u; the tiny term of the root costs 1e-12 of it."""
    density, disc, speed = 1000.0, 5e-4, 0.6
    push = 2 * density * disc * speed**2
    with jax.enable_x64(True):
        found = ideal_power(jnp.array([push, -push, 0.0]), disc, density)
    assert np.asarray(found) == pytest.approx([push * speed, push * speed, 0.0], rel=1e-11)
    assert float(ideal_power(jnp.array(1.0), disc, 0.0)) == 0.0
