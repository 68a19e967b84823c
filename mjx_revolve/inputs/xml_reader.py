"""XML files of robots, read before anything heavy is imported."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from mjx_revolve.inputs.errors import InputError, reading
from mjx_revolve.inputs.files import read_file


def load_robot_xml(path: str | Path) -> ElementTree.Element:
    """The root of a URDF or an MJCF file.

    Raises:
        InputError: the file cannot be read, or holds something else.
    """
    text = read_file(path)
    with reading(path):
        try:
            root = ElementTree.fromstring(text)
        except (ElementTree.ParseError, LookupError, ValueError) as error:  # and encodings
            raise InputError(f"expected XML; found: {error}") from None
        if root.tag not in ("robot", "mujoco"):
            raise InputError(f"expected URDF (robot) or MJCF (mujoco); found <{root.tag}>")
    return root
