"""Command line: what a morphology file holds, what it weighs in air and in water, how it looks.

``python -m mjx_revolve.inspect spider.yaml --picture spider.png``
"""

from __future__ import annotations

import sys
from pathlib import Path

from mjx_revolve.body.catalogue import MODULES, load_modules
from mjx_revolve.body.morphology import load_morphology
from mjx_revolve.body.table import module_table, summary, thruster_table
from mjx_revolve.inputs.commands import Parser, positive, program, read_path, run_command
from mjx_revolve.inputs.errors import plain

# Fresh water at 15 °C, the thesis's value [kg/m³].
_DENSITY = 999.1026
_GRAVITY = 9.81  # m/s²


def main(argv: list[str] | None = None) -> int:
    """Prints what a morphology file holds; with `--picture`, draws it.

    Args:
        argv: the arguments; None: those of the process.

    Returns:
        0.

    Raises:
        InputError: an argument or a file is wrong.
    """
    parser = Parser(
        prog=program("inspect"),
        description="Show the modules, weights and descriptors of a morphology.",
        examples=(
            "inspect spider --picture spider.png",
            "inspect mine.yaml --modules my_modules.yaml",
        ),
    )
    add = parser.add_argument
    add("file", type=read_path, help="morphology YAML")
    add("--picture", type=read_path, metavar="OUT.png", help="draw it as well")
    add("--density", type=positive("kg/m3"), default=_DENSITY,
        help="of the water, kg/m³ (default %(default)s)")  # fmt: skip
    add("--gravity", type=positive("m/s2"), default=_GRAVITY, help="m/s² (default %(default)s)")
    add("--modules", type=read_path, metavar="MY.yaml", help="module types of your own")
    add("--allow-overlap", action="store_true", help="accept modules that reach into each other")
    arguments = parser.parse_args(argv)
    modules = {} if arguments.modules is None else load_modules(arguments.modules)
    morphology = load_morphology(
        arguments.file, modules=MODULES | modules, allow_overlap=arguments.allow_overlap
    )
    if arguments.picture is not None:
        # Matplotlib takes a second to import: only for a picture.
        from mjx_revolve.view.pictures import draw_morphology

        draw_morphology(morphology, arguments.picture)
    named = "" if Path(arguments.file).stem == morphology.name else f": {morphology.name}"
    print(plain(f"{arguments.file}{named}"), end="\n\n")
    for table in (module_table(morphology), thruster_table(morphology)):
        if table:
            print("\n".join(map(plain, table)), end="\n\n")
    print("\n".join(summary(morphology, arguments.density, arguments.gravity)))
    passport = Path(arguments.file).absolute().parent / "passport.yaml"
    in_run = passport.parent.name == "champion" and Path(arguments.file).is_file()
    if in_run and passport.is_file():
        from mjx_revolve.episodes.passport import load_passport

        print(f"\nchampion of a run: {load_passport(passport).mark or 'passes its passport'}")
    if arguments.picture is not None:
        print(f"\npicture: {arguments.picture}")
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
