"""Random bodies of cores, bricks and hinges that do not overlap, for benchmarks and tests."""

from __future__ import annotations

import random
from typing import Any

from mjx_revolve.body.catalogue import MODULES
from mjx_revolve.body.morphology import Morphology, make_morphology
from mjx_revolve.body.placement import GROWN_TOLERANCE, find_overlaps
from mjx_revolve.inputs.errors import InputError


def random_body(seed: int, hinges: int, bricks: int | None = None) -> Morphology:
    """Grows a body at random slots, one module after the other.

    Args:
        seed: of the draws.
        hinges: how many hinges it has.
        bricks: how many bricks; as many as hinges by default.

    Returns:
        The morphology.
    """
    draw = random.Random(seed)
    root: dict[str, Any] = {"type": "Core"}
    left = ["ActiveHinge"] * hinges + ["FixedBrick"] * (hinges if bricks is None else bricks)
    draw.shuffle(left)
    found = make_morphology(_in_order(root), name=f"random_{seed}")
    while left:
        free = _free(root)
        parent, slot = free[draw.randrange(len(free))]
        turn = draw.choice([0, 90, 180, 270])
        parent.setdefault("children", {})[slot] = {"type": left[-1], "orientation": turn}
        try:
            grown = make_morphology(_in_order(root), name=f"random_{seed}")
        except InputError:  # it would overlap
            grown = None
        if grown is None or find_overlaps(grown.modules, tolerance=GROWN_TOLERANCE):
            del parent["children"][slot]
        else:
            found = grown
            left.pop()
    return found


def _in_order(node: dict[str, Any]) -> dict[str, Any]:
    """The tree with its children by slot."""
    children = sorted(node.get("children", {}).items())
    return node | {"children": {slot: _in_order(child) for slot, child in children}}


def _free(node: dict[str, Any]) -> list[tuple[dict[str, Any], int]]:
    """Slots that nothing is attached to."""
    taken = node.get("children", {})
    found = [(node, slot) for slot in MODULES[node["type"]].slots if slot not in taken]
    for child in taken.values():
        found += _free(child)
    return found
