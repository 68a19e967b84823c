"""Command line: a page about one run or several, with pictures, tables and how to repeat them.

    python -m mjx_revolve.report RUN [RUN ...] [--out FILE.html]

Runs of one configuration with different seeds are put together; different configurations are
compared. A run that is incomplete or damaged is named as such, and the page shows what is left.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from mjx_revolve.inputs.commands import Parser, read_path, run_command
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import PAGES, check_name, write_atomic
from mjx_revolve.numerics import runtime


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="python -m mjx_revolve.report",
        description="Writes a page about runs: one HTML file that needs nothing else.",
    )
    parser.add_argument("runs", nargs="+", type=read_path, metavar="RUN", help="a run folder")
    parser.add_argument(
        "--out", type=read_path, metavar="FILE.html",
        help="the page (default: RUN/report.html of one run, ./report.html of several)",
    )  # fmt: skip
    parser.add_argument(
        "--every-champion", action="store_true",
        help="show each run's champion in full, not only the best of each configuration",
    )  # fmt: skip
    parser.add_argument(
        "--individuals", type=_read_individuals, metavar="WHO",
        help="where bodies evolve: pages on which they swim, RUN/individuals/N.html, to which the "
        "report leads: best (of the last generation, and the champion's family), archive (all who "
        "live there), or numbers such as 17,42; a minute or two",
    )  # fmt: skip
    return parser


def _read_individuals(text: str) -> str | list[int]:
    """Reads whose pages are asked for."""
    if text in ("best", "archive"):
        return text
    numbers = text.split(",")
    if not all(n.isascii() and n.isdigit() and len(n) < 10 for n in numbers):
        raise argparse.ArgumentTypeError(
            f"expected best, archive, or numbers such as 17,42; found {text!r}"
        )
    return [int(n) for n in numbers]


def _named_file(out: str) -> Path:
    """The page that was asked for, whatever is there."""
    path = check_name(out, PAGES, f"--out {out}")
    if not path.parent.is_dir():
        raise InputError(f"--out {path}: expected the folder {path.parent}; found none")
    return path


def _usual_file(folder: Path, generator: str) -> Path:
    """The page's usual name in a folder, unless somebody else's file has it."""
    path = folder / "report.html"
    if path.exists():
        with open(path, "rb") as file:
            ours = f'content="{generator}"'.encode() in file.read(1000)
        if not ours:
            raise InputError(f"{path}: expected no file or an earlier report; found another file "
                             "(name it with --out to replace it)")  # fmt: skip
    return path


def main(argv: list[str] | None = None) -> int:
    """Runs the command.

    Args:
        argv: the arguments; None: `sys.argv[1:]`.

    Returns:
        0.

    Raises:
        InputError: the arguments are wrong, or nothing can be read of any run.
        OSError: the page cannot be written.
    """
    arguments = _parser().parse_args(argv)
    runtime.prepare_process()
    from mjx_revolve.view.report.bodies import INDIVIDUALS, choose_individuals, write_pages
    from mjx_revolve.view.report.data import read_runs
    from mjx_revolve.view.report.page import GENERATOR, make_report

    records, lost = read_runs(arguments.runs)
    if arguments.out is not None:
        path = _named_file(arguments.out)
    elif len(arguments.runs) > 1:
        path = _usual_file(Path("."), GENERATOR)
    else:
        folder = Path(records[0].label)
        path = _usual_file(folder if folder.is_dir() else records[0].folder, GENERATOR)
    which = arguments.individuals
    if which is not None and len(records) > 1 and not isinstance(which, str):
        raise InputError(f"--individuals: expected numbers of one run; found {len(records)} runs")
    for record, numbers in [
        (record, choose_individuals(record, which)) for record in records if which is not None
    ]:
        written = write_pages(record, numbers)
        print(f"{record.label}/{INDIVIDUALS}: {len(numbers)} pages, {written} of them new")
    page = make_report(records, lost, arguments.every_champion, path.parent).encode()
    for line in lost:
        print(f"warning: nothing could be read: {line}", file=sys.stderr)
    for record in records:
        if record.problems:
            print(f"warning: {record.warning}", file=sys.stderr)
    write_atomic(path, page)
    print(f"report: {path} ({len(page) / 1e6:.1f} MB)")
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
