"""The measures of an episode beside its score (`measure_table.MEASURES`), from a track."""

from __future__ import annotations

from collections.abc import Iterable

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.episodes.measure_table import MEASURES, records_of
from mjx_revolve.episodes.tasks import Track, moved_through_water
from mjx_revolve.numerics.spatial import quat_to_mat, safe_norm

# All below are choices. Fewer periods than this in the record are no gait, as for the reports.
_PERIODS = 2
# The spectrum has so many points per point of the record, between which a parabola finds the peak.
_FINER = 8
# Joints that swing less than this do not move [rad].
_STILL = 0.01
# Phases of which less than this is left when they are added up are spread all round.
_MIN_SHARE = 1e-3
# A robot that the bed bears with less than this share of its weight does not touch it.
_TOUCH = 1e-3


def measure(track: Track, names: Iterable[str] = ()) -> dict[str, jax.Array]:
    """Measures an episode.

    Means are over the rows of the track, and differences from row to row, so that motion between
    two rows (0.1 s) is not resolved: frequencies up to 5 Hz are distinguished.

    Args:
        track: the episode.
        names: of measures wanted beside those that are always there; the track must hold what
            they are made of. They have no derivatives.

    Returns:
        `[lanes]` each, by name, units as in `MEASURES`. Always:

        - `displacement_m` distance between the first and last place of the robot's point, by
          default its centre of mass (`task.point`); `speed_m_s` the same
          over time, so over ground, `speed_bl_s` in body lengths;
        - `path_length_m` length of its path, `path_speed_m_s` the same over time;
        - `straightness` displacement over path length;
        - `energy_j` work of servos and ideal propellers, summed without sign;
        - `cost_of_transport` energy over weight in air times displacement;
        - `depth_m` its mean depth, `depth_error_m` root mean square distance from the
          start's depth.

        By name, from the water: see `_through_water`; from joints: see `_gait`; from the core: see
        `_attitude`; from contacts: `bed_contact` share of the rows in which the bed bears a
        thousandth of the robot's weight in air or more, `bed_force_n` mean size of its force.
    """
    moved = jnp.diff(track.position, axis=0)
    net = safe_norm(tuple(jnp.sum(moved, 0)))
    path = jnp.sum(safe_norm(tuple(moved[:, i] for i in range(3))), 0)
    energy = jnp.sum(track.energy[1:], 0)
    error = track.position[:, 2] - track.start_height
    found = {
        "speed_bl_s": net / (track.duration * track.length),
        "speed_m_s": net / track.duration,
        "path_speed_m_s": path / track.duration,
        "displacement_m": net,
        "path_length_m": path,
        "straightness": net / jnp.maximum(path, 1e-9),
        "energy_j": energy,
        # A robot that stays where it is has no cost of transport; a millimetre bounds the number.
        "cost_of_transport": energy / (track.weight * jnp.maximum(net, 1e-3)),
        "depth_m": jnp.mean(track.surface_height - track.position[:, 2], 0),
        # The tiny term keeps the gradient finite where the error is 0.
        "depth_error_m": jnp.sqrt(jnp.mean(error * error, 0) + 1e-12),
    }
    wanted = {*found, *names}
    # Phases of what holds still have no derivatives; a NaN among them would spread to the score's.
    fixed = jax.lax.stop_gradient(track)
    for record in records_of(wanted):
        found |= _MAKERS[record](fixed)
    return {name: found[name] for name in MEASURES if name in wanted}


def _through_water(track: Track) -> dict[str, jax.Array]:
    """`water_speed_m_s`: net way through the water around the robot, over time: drift is none."""
    net = jnp.sum(moved_through_water(track), 0)
    return {"water_speed_m_s": safe_norm(tuple(net)) / track.duration}


def _gait(track: Track) -> dict[str, jax.Array]:
    """Measures of the hinges' coordination.

    - `gait_frequency_hz`: where the angles' power spectra, summed over all hinges, are greatest (of
      the record less its mean, under Hann's window; at least two periods in the record). 0 where no
      hinge swings by 0.01 rad, and where there is no such peak.
    - `gait_phase_spread_rad`: at that frequency each hinge swings as a_j sin(2π f t + φ_j): the
      phases' circular standard deviation √(-2 ln R), R = |Σ a_j exp(i φ_j)| / Σ a_j (Mardia and
      Jupp, Directional Statistics, 2000). 0 where all go together; at most 3.7, in antiphase.
    - `gait_phase_lag_rad`: by how much a hinge follows the one before it in the robot's order, from
      -π to π: the angle of Σ a_j a_{j+1} exp(i (φ_j - φ_{j+1})). In a snake, its wave runs to the
      later hinges where this is positive.
    - `joint_amplitude_rad`: √2 times the angles' standard deviation, mean over the hinges: a sine's
      amplitude.

    Hinges that a robot of a batch lacks have an amplitude of 0 and do not count.
    """
    angle = track.angle
    assert angle is not None
    count, first = len(angle), _FINER * _PERIODS
    angle = angle - jnp.mean(angle, 0)
    swing = jnp.sqrt(2 * jnp.mean(angle * angle, 0))
    window = np.hanning(count + 2)[1:-1].astype(angle.dtype)
    waves = angle * window[:, None, None]
    power = jnp.sum(jnp.abs(jnp.fft.rfft(waves, _FINER * count, axis=0)) ** 2, 1)
    # A record too short for any peak has one point behind it, where nothing is greater.
    power = jnp.pad(power, ((0, max(0, first + 2 - len(power))), (0, 0)))
    peak = first + jnp.argmax(power[first:-1], 0)
    before, here, after = (
        jnp.log(jnp.take_along_axis(power, peak[None] + k, 0)[0] + 1e-30) for k in (-1, 0, 1)
    )
    bend = before - 2 * here + after
    swings = jnp.max(swing, 0, initial=0.0) > _STILL
    moves = swings & (here >= before) & (here >= after) & (bend < 0)
    shift = (before - after) / (2 * jnp.where(moves, bend, 1.0))
    frequency = (peak + shift) / (_FINER * count * track.interval)
    time = track.interval * jnp.arange(count, dtype=angle.dtype)
    turn = 2 * np.pi * frequency * time[:, None]
    # Each hinge's a cos φ and a sin φ, up to a factor.
    u = jnp.sum(waves * jnp.sin(turn)[:, None], 0)
    v = jnp.sum(waves * jnp.cos(turn)[:, None], 0)
    whole = jnp.sum(jnp.hypot(u, v), 0)
    left = jnp.hypot(jnp.sum(u, 0), jnp.sum(v, 0)) / jnp.maximum(whole, 1e-9)
    spread = jnp.sqrt(-2 * jnp.log(jnp.clip(left, _MIN_SHARE, 1.0)))
    lag = jnp.arctan2(
        jnp.sum(v[:-1] * u[1:] - u[:-1] * v[1:], 0), jnp.sum(u[:-1] * u[1:] + v[:-1] * v[1:], 0)
    )
    found = {
        "gait_frequency_hz": frequency,
        "gait_phase_spread_rad": spread,
        "gait_phase_lag_rad": lag,
    }
    found = {name: jnp.where(moves, x, 0.0) for name, x in found.items()}
    found["joint_amplitude_rad"] = jnp.sum(swing, 0) / jnp.maximum(track.num_hinges, 1)
    return found


def _attitude(track: Track) -> dict[str, jax.Array]:
    """Measures of the core's attitude.

    - `turn_rate_rad_s`: turns about the vertical from row to row, summed, over time; positive where
      they are counter-clockwise from above. Each is the twist of swing and twist, < half a turn.
    - `tilt_rad`: mean angle between the core's z axis and the vertical.
    - `balance`: 1 - mean(|roll| + |pitch|) / 2π, Revolve's "head balance": 1 where the core stays
      level, 0.5 where it is upside down.
    """
    assert track.quat is not None
    quat = track.quat[:, 0], track.quat[:, 1], track.quat[:, 2], track.quat[:, 3]
    up = quat_to_mat(quat)[2]  # the vertical, core frame
    (a, e), (b, f), (c, g), (d, h) = ((x[:-1], x[1:]) for x in quat)
    # w and z of the turn from row to row, world frame; a quaternion and its opposite are one turn.
    w, z = a * e + b * f + c * g + d * h, a * h - d * e + b * g - c * f
    turned = 2 * jnp.arctan2(jnp.where(w < 0, -z, z), jnp.abs(w))
    roll, pitch = jnp.arctan2(up[1], up[2]), jnp.arcsin(jnp.clip(up[0], -1, 1))
    return {
        "turn_rate_rad_s": jnp.sum(turned, 0) / track.duration,
        "tilt_rad": jnp.mean(jnp.arccos(jnp.clip(up[2], -1, 1)), 0),
        "balance": 1 - jnp.mean(jnp.abs(roll) + jnp.abs(pitch), 0) / (2 * np.pi),
    }


def _contacts(track: Track) -> dict[str, jax.Array]:
    """Whether and how hard the bed bears the robot."""
    assert track.bed_force is not None
    force = safe_norm(tuple(track.bed_force[:, k] for k in range(3)))
    return {
        "bed_contact": jnp.mean(force > _TOUCH * track.weight, 0, dtype=force.dtype),
        "bed_force_n": jnp.mean(force, 0),
    }


# Measures by the record that they are computed from.
_MAKERS = {
    "water": _through_water, "joints": _gait, "core": _attitude, "contacts": _contacts,
}  # fmt: skip
