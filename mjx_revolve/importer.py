"""Command line: a rigid robot from elsewhere, as a robot of ours.

``python -m mjx_revolve.importer robot.urdf``, or ``mjx-revolve import robot.urdf``

Reads URDF or MuJoCo's MJCF; writes a morphology and its types of modules as YAML.
"""

from __future__ import annotations

import shlex
import sys

from mjx_revolve.inputs.commands import (
    Parser,
    check_absent,
    check_output_folder,
    program,
    read_path,
    run_command,
)
from mjx_revolve.inputs.errors import plain
from mjx_revolve.inputs.files import short_path
from mjx_revolve.inputs.xml_reader import load_robot_xml


def main(argv: list[str] | None = None) -> int:
    """Writes a robot of a URDF or an MJCF file as YAML, and prints what was not taken over.

    Args:
        argv: the arguments; None: those of the process.

    Returns:
        0.

    Raises:
        InputError: an argument or the file is wrong.
        OSError: a file cannot be written.
    """
    parser = Parser(
        prog=program("import"),
        description="Make a robot of a URDF or an MJCF file: links become modules with boxes, "
        "volumes and hinges. What cannot be taken over is listed.",
        examples=("import robot.urdf --out robots",),
    )
    add = parser.add_argument
    add("file", type=read_path, help="URDF or MJCF")
    add("--out", type=read_path, metavar="DIR",
        help="folder; files of these names in it are replaced (default: here, where none is)",
    )  # fmt: skip
    arguments = parser.parse_args(argv)
    load_robot_xml(arguments.file)
    check_output_folder(arguments.out or ".", "--out" if arguments.out else "")
    # MuJoCo takes a second to import: not for `--help`.
    from mjx_revolve.formats.import_robot import import_robot

    robot = import_robot(arguments.file)
    if arguments.out is None:
        for path in robot.paths():
            check_absent(path)
    body, modules = (short_path(path) for path in robot.save(arguments.out or "."))
    print(f"{body}, {modules}: {robot.morphology.counts}, {robot.morphology.mass:.4g} kg, "
          f"{1e6 * robot.morphology.volume:.4g} cm³")  # fmt: skip
    for line in robot.missing:
        print(plain(f"  not taken over: {line}"))
    options = shlex.join(["--set", f"morphology={body}", "--set", f"modules={modules}"])
    print(f"evolve it with: {options}")
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
