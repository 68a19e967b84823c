"""The robots of Revolve's and revolve2's standard library."""

import pytest

from laboratory import body

# Modules and hinges, counted in revolve2-standards 1.2.4.
ROBOTS = {
    "ant": (17, 8), "babya": (16, 8), "babyb": (21, 10), "blokky": (15, 5), "garrix": (15, 10),
    "gecko": (13, 6), "insect": (12, 9), "linkin": (15, 12), "longleg": (15, 12), "park": (15, 8),
    "penguin": (19, 12), "pentapod": (15, 10), "queen": (14, 9), "revolve_snake": (16, 8),
    "salamander": (25, 14), "spider": (17, 8), "squarish": (13, 6), "stingray": (15, 9),
    "tinlicker": (15, 8), "turtle": (20, 13), "ww": (15, 10), "zappa": (15, 11),
}  # fmt: skip


@pytest.mark.parametrize("name", ROBOTS)
def test_a_robot_of_revolve2_has_its_modules(name):
    robot = body(name)
    assert (robot.num_modules, robot.num_hinges) == ROBOTS[name]
