"""The measures of an episode by name: names in texts, units, and the records that they require.

Their formulas are in `measures.py`; the table is separate, so that a configuration can be checked
without JAX.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple


class Measure(NamedTuple):
    """Properties of a measure.

    Attributes:
        words: its name in texts.
        unit: of its values; "-" for a pure number.
        record: the one of `tasks.RECORDS` that it is computed from; "" for fields of every track.
            Measures with "" are always computed, others only if `task.measures` names them.
    """

    words: str
    unit: str
    record: str = ""


MEASURES: dict[str, Measure] = {
    "speed_bl_s": Measure("speed over ground", "body lengths/s"),
    "speed_m_s": Measure("speed over ground", "m/s"),
    "path_speed_m_s": Measure("speed along the path", "m/s"),
    "displacement_m": Measure("displacement", "m"),
    "path_length_m": Measure("path length", "m"),
    "straightness": Measure("straightness", "-"),
    "energy_j": Measure("energy", "J"),
    "cost_of_transport": Measure("cost of transport", "-"),
    "depth_m": Measure("depth", "m"),
    "depth_error_m": Measure("depth error", "m"),
    "water_speed_m_s": Measure("speed through the water", "m/s", "water"),
    "gait_frequency_hz": Measure("gait frequency", "Hz", "joints"),
    "gait_phase_spread_rad": Measure("spread of gait phases", "rad", "joints"),
    "gait_phase_lag_rad": Measure("gait phase lag", "rad", "joints"),
    "joint_amplitude_rad": Measure("joint amplitude", "rad", "joints"),
    "turn_rate_rad_s": Measure("turn rate", "rad/s", "core"),
    "tilt_rad": Measure("tilt", "rad", "core"),
    "balance": Measure("balance", "-", "core"),
    "bed_contact": Measure("time on the bed", "-", "contacts"),
    "bed_force_n": Measure("force of the bed", "N", "contacts"),
}
"""All measures, in the order of reports."""


def records_of(names: Iterable[str]) -> tuple[str, ...]:
    """The records that some measures are computed from, each once."""
    return tuple(sorted({MEASURES[name].record for name in names} - {""}))
