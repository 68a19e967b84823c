"""Colours that pages, films and still pictures share, and where their light comes from.

Colours are red, green and blue from 0 to 1 as a screen shows them. All are choices.
"""

from __future__ import annotations

import math

RGB = tuple[float, float, float]

# Open water: looking up, straight ahead and down.
WATER_UP: RGB = (0.38, 0.77, 0.86)
WATER_AHEAD: RGB = (0.11, 0.37, 0.48)
WATER_DOWN: RGB = (0.02, 0.12, 0.20)
# The sky at the horizon and overhead, and the bed.
SKY_LOW: RGB = (0.80, 0.88, 0.93)
SKY_HIGH: RGB = (0.38, 0.62, 0.86)
SAND: RGB = (0.79, 0.71, 0.56)

# Unit vector towards the light, world frame: high, from one side.
_TOWARDS = (-0.38, -0.25, 0.92)
SUN: RGB = tuple(x / math.hypot(*_TOWARDS) for x in _TOWARDS)  # type: ignore[assignment]

FORCES: dict[str, RGB] = {
    "buoyancy": (0.56, 0.93, 1.0),
    "drag": (1.0, 0.30, 0.42),
    "thrust": (1.0, 0.83, 0.25),
}
TARGET: RGB = (1.0, 0.30, 0.57)
CURRENT: RGB = (0.46, 1.0, 0.85)
ACCENT: RGB = (1.0, 0.55, 0.235)  # the way so far, and switches that are on
DUST: RGB = (0.84, 0.97, 0.99)
PLACE: RGB = (1.0, 0.80, 0.55)  # rings around places, as chargers
BIRTH: RGB = (0.62, 1.0, 0.55)
DEATH: RGB = (1.0, 0.42, 0.40)

# Modules without a colour of their own, as evolution grows them, have one of these: those of the
# shipped robots, and their neighbours.
MODULES: dict[str, RGB] = {
    "core": (0.95, 0.42, 0.32),
    "hinge": (0.94, 0.92, 0.84),
    "sensor": (0.55, 0.42, 0.72),
    "thruster": (0.38, 0.40, 0.45),
    "fin": (0.20, 0.65, 0.60),
    "brick": (0.93, 0.72, 0.26),
}
HINGE_AXIS: RGB = (1.0, 0.47, 0.1)  # thin rods in still pictures
THRUST_AXIS: RGB = (0.13, 0.66, 0.30)  # arrows in still pictures, along a command ahead


def page_palette() -> dict[str, object]:
    """What the scripts and the style of pages use, by name."""
    names = ("WATER_UP", "WATER_AHEAD", "WATER_DOWN", "SKY_LOW", "SKY_HIGH", "SAND", "SUN",
             "TARGET", "CURRENT", "ACCENT", "DUST", "PLACE")  # fmt: skip
    return {name.lower(): globals()[name] for name in names} | {"forces": FORCES}
