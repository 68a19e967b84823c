"""The motor curve at its corners, where a division by zero would end a rollout."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from laboratory import elbow_robot, world
from mjx_revolve.engine.servos import servo
from mjx_revolve.engine.single_tree import make_single_tree


@pytest.fixture(scope="module")
def hinges():
    return make_single_tree(elbow_robot(world())).below[0].hinges


def curve(hinges, speed, target):
    zero = jnp.zeros_like(speed)
    return servo(hinges, zero, speed, target, 0.005, zero + 1e-4, zero)


@pytest.mark.slow
def test_the_curve_is_finite_exactly_at_the_top_speed(hinges):
    """For every push from none through the friction that it meets there to full effort."""
    friction, slope, top = (np.float32(np.max(x)) for x in hinges.motor)
    gain = float(np.max(hinges.gain))
    push = np.linspace(-1, 1, 41, dtype=np.float32) * np.float32(np.max(hinges.effort[1]))
    push = np.append(push, [friction, -friction, 0.5 * friction, 1e-9])
    for speed in (top, -top, np.nextafter(top, np.float32(0)), np.nextafter(top, np.float32(9))):
        speeds = jnp.full((1, push.size), speed, jnp.float32)
        targets = jnp.asarray(push / gain, jnp.float32)[None]
        torque, inertia = curve(hinges, speeds, targets)
        assert np.isfinite(torque).all() and np.isfinite(inertia).all()
        assert (inertia >= 0).all()
        # No push beyond what friction eats; slope times rounding is the tolerance.
        forward = np.asarray(torque)[0] * np.sign(speed)
        assert forward.max() <= friction + 4 * slope * np.spacing(top)
        slopes = jax.grad(lambda x, t=targets: sum(map(jnp.sum, curve(hinges, x, t))))(speeds)
        assert np.isfinite(slopes).all()


def test_below_the_knee_the_servo_is_mujocos(hinges):
    """clip(k_p (target - q), ± effort), and nothing implicit, at rest under a small push."""
    gain, effort = float(np.max(hinges.gain)), float(np.max(hinges.effort[1]))
    target = jnp.asarray([[1e-6, -1e-6]], jnp.float32)
    torque, inertia = curve(hinges, jnp.zeros((1, 2), jnp.float32), target)
    assert np.asarray(torque) == pytest.approx(gain * np.asarray(target), rel=1e-5)
    assert np.abs(torque).max() < effort
    assert (inertia == 0).all()
