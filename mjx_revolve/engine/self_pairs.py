"""Which modules of one robot can meet."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from mjx_revolve.body.placement import turned
from mjx_revolve.engine.assembly import Assembly
from mjx_revolve.numerics.boxes import box_gap, pair_of

# Parts that overlap by more than this at rest [m] are built that way, and pass through each other
# later on, too. A choice: less than what contact allows.
REST_OVERLAP = 1e-3


def candidate_pairs(assembly: Assembly) -> Int[np.ndarray, "pairs 2"]:
    """Pairs of parts that might meet: of different rigid bodies of the same robot.

    Left out are parts of a rigid body and of the one that carries it, as the hinge between them
    ends before they meet (see `hinge_stops`), and parts that overlap at rest by more than
    `REST_OVERLAP`.

    Args:
        assembly: of a robot, or of several.

    Returns:
        Rows of the fluid table, the lower one first.
    """
    body = assembly.fluid.body
    robot = assembly.robot[body]
    first, second = np.triu_indices(len(body), 1)
    a, b = body[first], body[second]
    parent = assembly.parent
    apart = (robot[first] == robot[second]) & (a != b) & (parent[a] != b) & (parent[b] != a)
    pairs = np.stack([first[apart], second[apart]], 1)
    if not len(pairs):
        return pairs
    return pairs[part_gaps(assembly, pairs) > -REST_OVERLAP]


def part_gaps(assembly: Assembly, pairs: np.ndarray) -> Float[np.ndarray, " pairs"]:
    """Gaps of pairs of parts at rest [m]."""
    table, body = assembly.fluid, assembly.fluid.body
    center = assembly.position[body] + turned(assembly.rotation[body], table.position)
    rotation = assembly.rotation[body] @ table.rotation
    i, j = pairs.T
    half = table.half_size
    return box_gap(pair_of(center[i], rotation[i], half[i], center[j], rotation[j], half[j]))
