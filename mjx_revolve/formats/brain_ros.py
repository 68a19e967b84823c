"""A ROS 2 node around a brain's Python file."""

from __future__ import annotations

from mjx_revolve.formats.brain import Brain
from mjx_revolve.formats.brain_code import TEMPLATES


def make_brain_node(brain: Brain, stem: str) -> str:
    """Writes a ROS 2 node that runs a brain.

    Args:
        brain: from `make_brain`.
        stem: name of the Python file beside it, without its ending.

    Returns:
        A script; it needs rclpy and the brain's file. Topics and units are those of our bags.
    """
    return TEMPLATES.get_template("brain_node.py.jinja").render(brain=brain, stem=stem)
