"""Numbers of Revolve's servo (SDF/joint.py): defaults of hinges and of sensors' ranges."""

from __future__ import annotations

import math

REACH = math.pi / 4
"""To both sides of the rest pose [rad]."""

EFFORT = 0.17658
"""Largest torque [N·m]."""

SPEED = 5.235988
"""Largest angular speed [rad/s]."""
