"""Random bodies of cores, bricks and hinges that do not overlap, for benchmarks and tests."""

from __future__ import annotations

import random
import tempfile
from pathlib import Path
from typing import Any

import yaml

from mjx_revolve.body.catalogue import MODULES
from mjx_revolve.body.morphology import Morphology, load_morphology
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
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"random_{seed}.yaml"
        found = _load(root, path)
        while left:
            free = _free(root)
            parent, slot = free[draw.randrange(len(free))]
            turn = draw.choice([0, 90, 180, 270])
            parent.setdefault("children", {})[slot] = {"type": left[-1], "orientation": turn}
            try:
                found = _load(root, path)
                left.pop()
            except InputError:  # it would overlap
                del parent["children"][slot]
    return found


def _load(root: dict[str, Any], path: Path) -> Morphology:
    path.write_text(yaml.safe_dump({"id": path.stem, "body": root}), encoding="utf-8")
    return load_morphology(path)


def _free(node: dict[str, Any]) -> list[tuple[dict[str, Any], int]]:
    """Slots that nothing is attached to."""
    taken = node.get("children", {})
    found = [(node, slot) for slot in MODULES[node["type"]].slots if slot not in taken]
    for child in taken.values():
        found += _free(child)
    return found
