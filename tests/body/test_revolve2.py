"""The robots of Revolve's and revolve2's standard library, beside revolve2's own objects.

revolve2 needs other versions than this package; it lives in an environment of its own, whose Python
is named by REVOLVE2_PYTHON: `pip install revolve2-standards==1.2.4`.
"""

from __future__ import annotations

import json
import os
import subprocess

import numpy as np
import pytest

from laboratory import body

PYTHON = os.environ.get("REVOLVE2_PYTHON", "")
# Modules and hinges, counted in revolve2-standards 1.2.4.
ROBOTS = {
    "ant": (17, 8), "babya": (16, 8), "babyb": (21, 10), "blokky": (15, 5), "garrix": (15, 10),
    "gecko": (13, 6), "insect": (12, 9), "linkin": (15, 12), "longleg": (15, 12), "park": (15, 8),
    "penguin": (19, 12), "pentapod": (15, 10), "queen": (14, 9), "revolve_snake": (16, 8),
    "salamander": (25, 14), "spider": (17, 8), "squarish": (13, 6), "stingray": (15, 9),
    "tinlicker": (15, 8), "turtle": (20, 13), "ww": (15, 10), "zappa": (15, 11),
}  # fmt: skip
# Ours looks along -y, revolve2's to the front.
TURNED = {"gecko"}
# All modules: type, cell in the grid, that of the parent, and its axes forward, left and up.
DUMP = """
import json
from pyrr import Quaternion, Vector3
from revolve2.standards import modular_robots_v1 as library
axes = [Vector3(row) for row in ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0])]
whole = lambda vector: [int(round(x)) for x in vector]
def walk(module, turn, cell, above):
    found = [[type(module).__name__, whole(cell), whole(above), [whole(turn * a) for a in axes]]]
    for number, point in module.attachment_points.items():
        child = module.children.get(number)
        if child is not None:
            own = turn * point.orientation * child.orientation
            found += walk(child, own, cell + own * axes[0], cell)
    return found
zero = Vector3([0.0, 0.0, 0.0])
print(json.dumps({name: walk(library.get(name).core, Quaternion(), zero, zero) for name in %r}))
"""
TYPES = {"CoreV1": "Core", "BrickV1": "FixedBrick", "ActiveHingeV1": "ActiveHinge"}
AHEAD = np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # revolve2's core looks along x, ours along y


def cells(robot, turn):
    """What `DUMP` prints, of a robot of ours whose core is turned first."""
    found = []
    for module in robot.modules:
        axes = turn @ module.rotation
        if module.type != "ActiveHinge":
            axes = axes @ AHEAD.T
        axes = np.rint(axes).astype(int)
        above = np.array(found[module.parent][1]) if module.parent >= 0 else np.zeros(3, int)
        cell = above + (axes[:, 0] if module.parent >= 0 else 0)
        found.append([module.type, cell.tolist(), above.tolist(), axes.T.tolist()])
    return found


@pytest.fixture(scope="module")
def theirs():
    if not PYTHON:
        pytest.skip("REVOLVE2_PYTHON names no Python that has revolve2")
    script = DUMP % [name.removeprefix("revolve_") for name in ROBOTS]
    done = subprocess.run([PYTHON, "-c", script], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("name", ROBOTS)
def test_a_robot_of_revolve2_has_its_modules(name):
    robot = body(name)
    assert (robot.num_modules, robot.num_hinges) == ROBOTS[name]


@pytest.mark.parametrize("name", ROBOTS)
def test_a_robot_is_revolve2s_module_by_module(name, theirs):
    half = np.diag([-1, -1, 1]) if name in TURNED else np.eye(3)
    found = sorted(cells(body(name), half @ AHEAD))
    expected = [[TYPES[kind], *rest] for kind, *rest in theirs[name.removeprefix("revolve_")]]
    for row in expected + found if name in TURNED else []:
        if row[0] == "Core":
            row[3] = None  # which side of a core is its front says nothing without its modules
    assert found == sorted(expected)
