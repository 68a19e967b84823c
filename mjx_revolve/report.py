"""Command line: a page about one run or several, with pictures, tables and how to repeat them.

    python -m mjx_revolve.report RUN [RUN ...] [--out FILE.html]
    python -m mjx_revolve.report SWEEP [--out FILE.html]

Runs of one configuration with different seeds are put together; different configurations are
compared. A run that is incomplete or damaged is named as such, and the page shows what is left.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from mjx_revolve.inputs.commands import Parser, check_place, program, read_path, run_command
from mjx_revolve.inputs.errors import InputError, plain
from mjx_revolve.inputs.files import PAGES, SWEEP, check_name, short_path, write_atomic
from mjx_revolve.inputs.trust import add_trust_argument, opening
from mjx_revolve.numerics import runtime


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog=program("report"),
        description="Writes a page about runs: one HTML file that needs nothing else.",
        examples=("report runs/mine", "report runs/a runs/b --out both.html"),
    )
    add = parser.add_argument
    add("runs", nargs="+", type=read_path, metavar="RUN",
        help="a run folder; or the folder of one sweep")  # fmt: skip
    add("--out", type=read_path, metavar="FILE.html",
        help="the page (default: report.html in a run's or sweep's folder; of several runs, here)",
    )  # fmt: skip
    add("--every-champion", action="store_true",
        help="show each run's champion in full, not only the best of each configuration",
    )  # fmt: skip
    add("--individuals", type=_read_individuals, metavar="NUMBERS",
        help="where bodies evolve: pages on which individuals swim, RUN/individuals/N.html, with "
        "links from the report: best (of the last generation, and the champion's family), archive "
        "(all in it), or numbers such as 17,42; a minute or two")  # fmt: skip
    add_trust_argument(parser)
    return parser


def _read_individuals(text: str) -> str | list[int]:
    """Reads the option --individuals."""
    if text in ("best", "archive"):
        return text
    numbers = text.split(",")
    if not all(n.isascii() and n.isdigit() and len(n) < 10 for n in numbers):
        raise argparse.ArgumentTypeError(
            f"expected best, archive, or numbers such as 17,42; found {text!r}"
        )
    return [int(n) for n in numbers]


def _named_page(arguments: argparse.Namespace, usual: Path) -> Path:
    """The page that --out names; without it the default in the folder `usual`."""
    from mjx_revolve.view.report.page import default_page

    if arguments.out is None:
        path = default_page(usual)
        check_place(path, str(path))
        return path
    path = check_name(arguments.out, PAGES, f"--out {arguments.out}")
    if not path.parent.is_dir():
        raise InputError(f"--out {path}", f"the folder {path.parent}", "none")
    check_place(path, f"--out {path}")
    return path


def _report_sweep(sweep: str, arguments: argparse.Namespace) -> int:
    """The page about a sweep, as far as it has got."""
    from mjx_revolve.view.report.sweep import write_report

    if len(arguments.runs) > 1:
        raise InputError(sweep, "nothing beside a sweep", f"{len(arguments.runs)} folders")
    for option, value in (
        ("every-champion", arguments.every_champion), ("individuals", arguments.individuals)
    ):  # fmt: skip
        if value:
            raise InputError(f"--{option}", "run folders", f"the sweep {sweep}")
    report = write_report(sweep, _named_page(arguments, Path(sweep)))
    for line in report.lost:
        print(f"warning: {line}", file=sys.stderr)
    print(f"report: {short_path(report.page)}; {short_path(report.table)}")
    return 0


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
    runtime.fix_environment()
    from mjx_revolve.episodes.run_reader import check_runs

    check_runs(arguments.runs)
    runtime.prepare_process()
    with opening(*arguments.runs, trust=arguments.trust):
        return _report(arguments)


def _report(arguments: argparse.Namespace) -> int:
    """Writes the page, and those of individuals."""
    from mjx_revolve.view.report.bodies import PAGE_FOLDER, choose_individuals, write_pages
    from mjx_revolve.view.report.data import read_runs
    from mjx_revolve.view.report.page import make_report

    for name in arguments.runs:
        if (Path(name) / SWEEP).is_file():
            return _report_sweep(name, arguments)
    records, lost = read_runs(arguments.runs)
    folder = Path(records[0].label)
    folder = folder if folder.is_dir() else records[0].folder
    path = _named_page(arguments, folder if len(arguments.runs) == 1 else Path("."))
    which = arguments.individuals
    if isinstance(which, list) and len(records) > 1:
        raise InputError("--individuals", "numbers of one run", f"{len(records)} runs")
    chosen = [(r, choose_individuals(r, which)) for r in records] if which is not None else []
    for record, numbers in chosen:
        written = write_pages(record, numbers)
        print(f"{record.label}/{PAGE_FOLDER}: {len(numbers)} pages, {written} of them new")
    page = make_report(records, lost, arguments.every_champion, path.parent).encode()
    for line in lost:
        print(f"warning: nothing could be read: {plain(line)}", file=sys.stderr)
    for record in records:
        if record.problems:
            print(f"warning: {plain(record.warning)}", file=sys.stderr)
    write_atomic(path, page)
    print(f"report: {short_path(path)} ({len(page) / 1e6:.1f} MB)")
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
