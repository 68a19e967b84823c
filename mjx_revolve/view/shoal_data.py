"""Robots that share a page: their meshes, bent by qpos in the page itself.

A page of one robot is given the poses of its bodies. Where there are many, qpos is all that is sent
or kept of a pose: 7 numbers and one for each hinge. So the page is told the tree of the bodies.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np

from mjx_revolve.engine.robot import Robot
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.view.packed import pack_whole
from mjx_revolve.view.pieces import make_pieces, mount_piece

MOST_BODIES = 96
"""Moving bodies of a robot that pages can bend: uniforms of a vertex shader, two for each body."""


@dataclass
class Shapes:
    """Triangles that pieces of all robots share.

    Attributes:
        packed: the distinct ones, for the page.
    """

    packed: list[dict[str, Any]] = field(default_factory=list)
    _numbers: dict[bytes, int] = field(default_factory=dict)

    def number(self, corners: np.ndarray) -> int:
        """Which one these triangles `[m, 3, 3]` [m] are; they join where they are new."""
        key = hashlib.blake2b(np.ascontiguousarray(corners).tobytes(), digest_size=16).digest()
        if key not in self._numbers:
            self._numbers[key] = len(self.packed)
            self.packed.append(pack_whole(corners))
        return self._numbers[key]


def body_data(robot: Robot, shapes: Shapes) -> dict[str, Any]:
    """A robot as a page draws it.

    Args:
        robot: from `build_robot`.
        shapes: those of the page so far; its own join them.

    Returns:
        `length` [m]; `tree`, for each moving body its parent (-1 for the core's), place and
        quaternion (w first) in the parent's frame, and its hinge's axis; `pieces`, each a body, a
        shape, a colour (0 to 255), place and quaternion in the body's frame.

    Raises:
        InputError: it has more moving bodies than a page can bend.
    """
    assembly, name = robot.assembly, robot.morphology.name
    count = len(assembly.parent) - 1
    if count > MOST_BODIES:
        raise InputError(
            f"{name}: expected at most {MOST_BODIES} moving bodies, to show many robots in a page; "
            f"found {count}"
        )
    place, turn = assembly.from_parents()
    tree = [
        [int(assembly.parent[k]) - 1, *_numbers(place[k], _quat(turn[k]), assembly.axis[k])]
        for k in range(1, count + 1)
    ]
    pieces = []
    for piece in make_pieces(robot.morphology):
        if piece.mark:  # rods and arrows are for pictures at rest
            continue
        body, position, rotation = mount_piece(robot, piece)
        color = [round(255 * float(x)) for x in piece.color]
        where = _numbers(position, _quat(rotation))
        pieces.append([body - 1, shapes.number(piece.corners), color, *where])
    return {"length": round(robot.morphology.length, 4), "tree": tree, "pieces": pieces}


class Bodies:
    """Distinct bodies of a page by number: robots that look alike share one.

    Attributes:
        shapes: of their pieces.
        data: of each, see `body_data`.
    """

    def __init__(self) -> None:
        self.shapes = Shapes()
        self.data: list[dict[str, Any]] = []
        self._by_robot: dict[int, tuple[Robot, int]] = {}
        self._by_text: dict[str, int] = {}

    def number(self, robot: Robot) -> int:
        """Which one a robot's is; it joins where it is new."""
        if id(robot) not in self._by_robot:
            data = body_data(robot, self.shapes)
            text = json.dumps(data)
            if text not in self._by_text:
                self._by_text[text] = len(self.data)
                self.data.append(data)
            self._by_robot[id(robot)] = robot, self._by_text[text]  # kept, so that its id is
        return self._by_robot[id(robot)][1]


def _quat(rotation: np.ndarray) -> np.ndarray:
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(rotation, np.float64).ravel())
    return quat


def _numbers(*vectors: Any) -> list[float]:
    """Numbers as short as a picture needs them."""
    return [round(float(x), 6) for vector in vectors for x in vector]
