"""Command line: a page about one run or several, with pictures, tables and how to repeat them.

    python -m mjx_revolve.report RUN [RUN ...] [--out FILE.html]

Runs of one configuration with different seeds are put together; different configurations are
compared. A run that is incomplete or damaged is named as such, and the page shows what is left.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mjx_revolve.inputs.commands import Parser, read_path, run_command
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics import runtime

if TYPE_CHECKING:
    from mjx_revolve.body.morphology import Morphology
    from mjx_revolve.view.report.champion import Replay
    from mjx_revolve.view.report.data import RunRecord
    from mjx_revolve.view.report.groups import Group


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
    return parser


def _choose_file(arguments: argparse.Namespace, records: Sequence[RunRecord]) -> Path:
    """Where the page goes; a file of somebody else's is replaced only where it was named."""
    from mjx_revolve.view.report.page import GENERATOR

    if arguments.out is not None:
        path = Path(arguments.out)
        if path.suffix.lower() not in (".html", ".htm"):
            raise InputError(f"--out {path}: expected a name that ends in .html; found {path.name}")
        if path.is_dir():
            raise InputError(f"--out {path}: expected a file; found a folder")
        if not path.parent.is_dir():
            raise InputError(f"--out {path}: expected the folder {path.parent}; found none")
        return path
    one = len(arguments.runs) == 1
    path = Path(records[0].label if one else ".") / "report.html"
    if one and not path.parent.is_dir():
        path = records[0].folder / "report.html"
    if path.exists():
        with open(path, "rb") as file:
            ours = f'content="{GENERATOR}"'.encode() in file.read(1000)
        if not ours:
            raise InputError(f"{path}: expected no file or an earlier report; found another file "
                             "(name it with --out to replace it)")  # fmt: skip
    return path


def _read(arguments: argparse.Namespace) -> tuple[list[RunRecord], list[str]]:
    """The runs, and a line about each folder of which nothing could be read."""
    from mjx_revolve.view.report.data import read_run

    records: list[RunRecord] = []
    lost: list[str] = []
    seen: dict[Path, str] = {}
    for name in arguments.runs:
        if not Path(name).is_dir():  # a slip of the finger rather than a damaged run
            read_run(name)
        try:
            record = read_run(name)
        except InputError as error:
            lost.append(str(error))
            continue
        place = record.folder.resolve()
        if place in seen:
            raise InputError(f"{name}: expected each run once; found it as {seen[place]}, too")
        seen[place] = name
        records.append(record)
    if not records:
        raise InputError(lost[0])
    return records, lost


def _replay(
    groups: Sequence[Group],
) -> tuple[dict[Path, Replay], list[tuple[str, Morphology]]]:
    """All champions' episodes by run folder, and the robots of the groups."""
    from mjx_revolve.episodes.fitness import make_fitness
    from mjx_revolve.evolution.fingerprints import model_hash
    from mjx_revolve.view.report.champion import replay_champion

    replays: dict[Path, Replay] = {}
    robots: list[tuple[str, Morphology]] = []
    for group in groups:
        fitness = None
        for record in (*group.records, *group.copies):
            if record.config is None:
                continue
            try:
                # The seed is all that differs within a group, and the fitness does not know it.
                fitness = make_fitness(record.config) if fitness is None else fitness
                known = record.info.get("model_hash")
                if isinstance(known, str) and known != model_hash(fitness):
                    record.note("version", "the robot or its world is built differently by this "
                                "version than when it evolved: the replay may differ")  # fmt: skip
                if record.genes is not None:
                    replays[record.folder] = replay_champion(record, fitness)
            except InputError as error:
                record.note("damaged", f"no replay: {error}")
        if fitness is not None:
            robots.append((group.name, fitness.robot.morphology))
        else:
            robots += _robot_alone(group)
    return replays, robots


def _robot_alone(group: Group) -> list[tuple[str, Morphology]]:
    """The body that a run left behind, where its configuration cannot be used."""
    from mjx_revolve.body.morphology import load_morphology

    for record in group.records:
        path = record.folder / "champion" / "morphology.yaml"
        if path.is_file():
            try:
                return [(group.name, load_morphology(path, allow_overlap=True))]
            except InputError as error:
                record.note("damaged", str(error))
    return []


def _champions(
    groups: Sequence[Group], replays: dict[Path, Replay], every: bool
) -> list[tuple[str, str, str]]:
    """A section for each champion that is shown in full."""
    from mjx_revolve.view.report import sections
    from mjx_revolve.view.report.plots import letter

    found = []
    for k, group in enumerate(groups):
        best = group.best()
        if best.folder not in replays:  # another seed's, rather than none
            best = next((r for r in group.records if r.folder in replays), best)
        chosen = [r for r in group.records if r is best or every]
        for record in chosen:
            heading = "Champion"
            if len(groups) > 1:
                heading += f" of {letter(k)}, {group.name}"
            if len(group.records) > 1:
                heading += f": {'the best, ' if record is best else ''}seed {record.seed}"
            if record.folder in replays:
                content = sections.champion(record, replays[record.folder])
            else:
                content = sections.saved_pictures(record)
            found.append((f"champion-{k}-{record.seed}", heading, content))
    return found


def make_report(
    records: Sequence[RunRecord], lost: Sequence[str] = (), every_champion: bool = False
) -> str:
    """Makes the page.

    Args:
        records: the runs, from `read_run`; problems that show only now are added to theirs.
        lost: lines about folders of which nothing could be read.
        every_champion: whether each run's champion is shown in full.

    Returns:
        A complete HTML document that needs no other file.
    """
    import datetime

    from mjx_revolve import __version__
    from mjx_revolve.view.report import appendix, sections
    from mjx_revolve.view.report.groups import group_runs
    from mjx_revolve.view.report.page import escape, make_page

    groups = group_runs(records)
    replays, robots = _replay(groups)
    first = records[0]
    if len(records) == 1:
        robot = f"{robots[0][1].name}: " if robots else ""
        title = f"{robot}{first.task.replace('_', ' ') or 'evolution'} ({Path(first.label).name})"
        words = first.label
    else:
        title = f"{len(records)} runs"
        title += f" of {groups[0].name}" if len(groups) == 1 else f", {len(groups)} configurations"
        words = ", ".join(record.label for record in records)
    champions = _champions(groups, replays, every_champion)
    content = [
        ("results", "Results", sections.results(groups)),
        ("convergence", "Convergence", sections.convergence(groups)),
        ("champions", "Champions side by side", sections.side_by_side(groups, replays)),
        *champions,
        ("robot", "Robot", appendix.robots(robots)),
        ("runs", "Runs", sections.runs_table(groups)),
        ("repeat", "Repeat it", appendix.repeat(groups)),
    ]
    lead = f'<p class="soft">{escape(words)}</p>{sections.headline(groups)}'
    lead += sections.problems(records, lost)
    now = datetime.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")
    return make_page(title, lead, content, f"Made by mjx_revolve {__version__}, {now}.")


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
    records, lost = _read(arguments)
    path = _choose_file(arguments, records)
    page = make_report(records, lost, arguments.every_champion)
    for line in lost:
        print(f"warning: nothing could be read: {line}", file=sys.stderr)
    for record in records:
        if record.problems:
            print(f"warning: {record.warning}", file=sys.stderr)

    from mjx_revolve.inputs.files import write_atomic

    write_atomic(path, page.encode())
    print(f"report: {path} ({len(page.encode()) / 1e6:.1f} MB)")
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
