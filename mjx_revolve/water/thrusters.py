"""Thrusters: command → lag → thrust and power, as pure functions.

Source: UUV Simulator (Manhães, Scherer, Voss, Douat, Rauschenbach, "UUV Simulator: A Gazebo-based
package for underwater intervention and multi-robot simulation", OCEANS 2016), package
`uuv_gazebo_plugins`: `ThrusterPlugin.cc` (the order), `Dynamics.cc` (first-order lag, stepped
exactly) and `ThrusterConversionFcn.cc` (thrust curves; the dead band is that of Bessa, Dutra and
Kreuzer, "Thruster dynamics compensation for the positioning of underwater robotic vehicles through
a fuzzy sliding mode based approach", ABCM Symposium Series in Mechatronics 2, 2006). Deviations:

- a lag starts from rest; the original ignores the first update of a run;
- the propeller's torque acts back on its robot, -c T about the axis; the original has none. Both go
  with the square of the propeller's speed at standstill, so that c = K_Q D / K_T is constant
  (Carlton, Marine Propellers and Propulsion, chapter 6);
- the original's lags of Yoerger and of Bessa are left out: explicit, and unstable at long steps.

Not modelled: the loss of thrust as the inflow grows, wake, wall and neighbouring propellers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.numerics.spatial import Scalar
from mjx_revolve.water.propellers import Thruster


def _numpy_of(x: Any) -> Any:
    """NumPy for what is known, so that tables can be made of it; JAX's for what is traced."""
    return jnp if isinstance(x, jax.Array) else np


def _like(constant: Any, x: Any) -> Any:
    """A constant in the dtype of x, which it must not widen."""
    traced = isinstance(constant, jax.Array)
    return np.asarray(constant, x.dtype) if hasattr(x, "dtype") and not traced else constant


# ------------------------------------------------------------------------- the laws


def lag_decay(time_constant: Any, dt: float) -> np.ndarray:
    """e^(-dt/τ), what a step leaves of a command behind its lag [-]; 0 where τ [s] is 0."""
    tau = np.asarray(time_constant, float)
    return np.where(tau > 0, np.exp(-dt / np.where(tau > 0, tau, 1.0)), 0.0)


def lagged_command(before: Any, command: Any, decay: Any) -> Any:
    """A command behind its lag after a step: s ← s e^(-dt/τ) + (1 - e^(-dt/τ)) x [-].

    Exact for a command that is held during the step, whatever the step. Source: `Dynamics.cc`.

    Args:
        before: s [-].
        command: x [-].
        decay: from `lag_decay` [-].
    """
    # Not x + decay (s - x): at rest at x, rounding must leave s alone.
    return before * _like(decay, before) + command * _like(1 - decay, command)


def basic_thrust(command: Any, gain: Any) -> Any:
    """T = k x|x|. Source: `ThrusterConversionFcn.cc`, "Basic".

    Args:
        command: x [-].
        gain: k, a number or an array of constants [N].

    Returns:
        T [N].
    """
    return _like(gain, command) * command * _numpy_of(command).abs(command)


def dead_band_thrust(command: Any, backward: Any, forward: Any, low: Any, high: Any) -> Any:
    """With b = x|x|: T = k_l (b - δ_l) where b ≤ δ_l, k_r (b - δ_r) where b ≥ δ_r, else 0.

    Source: `ThrusterConversionFcn.cc`, "Bessa".

    Args:
        command: x [-].
        backward: k_l ≥ 0, a number or an array of constants [N].
        forward: k_r ≥ 0 [N].
        low: δ_l ≤ 0 [-].
        high: δ_r ≥ 0 [-].

    Returns:
        T [N].
    """
    xp = _numpy_of(command)
    square = command * xp.abs(command)
    below = xp.minimum(square - _like(low, square), 0)
    above = xp.maximum(square - _like(high, square), 0)
    return _like(backward, square) * below + _like(forward, square) * above


def interpolated_thrust(command: Any, commands: Sequence[Any], thrusts: Sequence[Any]) -> Any:
    """A broken line through points, level beyond its ends.

    Source: `ThrusterConversionFcn.cc`, "LinearInterp". Written as a sum of ramps, since a look-up
    inside a compiled loop costs more than the whole sum.

    Args:
        command: x [-].
        commands: of the points, rising; each a number or an array of constants [-].
        thrusts: at the points [N].

    Returns:
        T [N].
    """
    clip = _numpy_of(command).clip
    result = _like(thrusts[0], command) + 0 * command
    for k in range(len(commands) - 1):
        left, right = commands[k], commands[k + 1]
        gradient = _like((thrusts[k + 1] - thrusts[k]) / (right - left), command)
        left, right = _like(left, command), _like(right, command)
        result = result + gradient * (clip(command, left, right) - left)
    return result


def ideal_power(thrust: Scalar, disc: Any, density: float) -> Scalar:
    """Power that an ideal propeller at rest in the water needs: |T|^(3/2) / √(2 ρ A).

    Source: momentum theory (Froude 1889); real ones need about twice as much.

    Args:
        thrust: T [N].
        disc: A, area of the propeller's disc, a number or an array [m²]; 0 for no propeller.
        density: of the water [kg/m³].

    Returns:
        Power [W].
    """
    xp = _numpy_of(disc)
    pushes = 2 * density * disc
    inverse = xp.where(pushes > 0, 1 / xp.sqrt(xp.where(pushes > 0, pushes, 1.0)), 0.0)
    size = jnp.abs(thrust)
    # The tiny term keeps the gradient finite at rest.
    return size * jnp.sqrt(size + 1e-12) * _like(inverse, size)


# ------------------------------------------------------------------------- of one thruster


def thrust(thruster: Thruster, command: Any) -> Any:
    """Thrust at a steady command, by the thruster's own curve.

    Args:
        thruster: its curve.
        command: x, clamped, `[...]` [-].

    Returns:
        Thrust along the thruster's axis [N].
    """
    if thruster.curve == "basic":
        return basic_thrust(command, thruster.gain)
    if thruster.curve == "interpolated":
        return interpolated_thrust(command, thruster.commands, thruster.thrusts)
    backward = thruster.gain if thruster.gain_backward is None else thruster.gain_backward
    return dead_band_thrust(command, backward, thruster.gain, *thruster.dead_band)
