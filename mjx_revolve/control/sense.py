"""What a robot feels, from the engine's state: for one robot and for many, in every engine."""

from __future__ import annotations

from typing import NamedTuple

import jax

from mjx_revolve.engine.state import Root
from mjx_revolve.numerics.spatial import Vec, quat_to_rows
from mjx_revolve.water.flow import Water


class Sense(NamedTuple):
    """What a controller may know of a robot's state, `[lanes]` each.

    Attributes:
        height: z of the core's centre above the still surface, negative under water [m].
        climb: its vertical velocity [m/s].
        up: the world's vertical, core frame, three of `[lanes]` [-].
        spin: angular velocity, core frame, three of `[lanes]` [rad/s].
    """

    height: jax.Array
    climb: jax.Array
    up: Vec
    spin: Vec


def feel(root: Root, water: Water) -> Sense:
    """What robots feel.

    Args:
        root: where their cores are and how they move.
        water: its still surface is what heights are measured from.

    Returns:
        The senses.
    """
    return Sense(
        root.position[2] - water.surface_height,
        root.velocity[2],
        quat_to_rows(root.quat)[2],
        root.spin,
    )
