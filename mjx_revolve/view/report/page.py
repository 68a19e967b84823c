"""The page of a report: numbers, tables and pictures of runs, put into the templates beside this.

Words and markup are in `sections.html`, a function for each section, and `page.html`, their frame.
"""

from __future__ import annotations

import datetime
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from markupsafe import Markup
from matplotlib.figure import Figure

from mjx_revolve import __version__
from mjx_revolve.body.morphology import Morphology, load_morphology
from mjx_revolve.episodes.config import Config
from mjx_revolve.episodes.fitness import fit_body, make_fitness
from mjx_revolve.episodes.named_files import read_modules
from mjx_revolve.episodes.scoring import REPORT_EPISODES
from mjx_revolve.evolution.fingerprints import model_hash
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.templates import data_address, make_templates
from mjx_revolve.inputs.trust import UntrustedError
from mjx_revolve.view import convergence, motion_plots
from mjx_revolve.view.colony_history import ColonyHistory
from mjx_revolve.view.colony_pictures import plot_history
from mjx_revolve.view.plots import COLORS, figure_jpeg, figure_png, figure_svg, letter
from mjx_revolve.view.report import tables
from mjx_revolve.view.report.bodies import anchor, inline_svg, show_population, viewer_command
from mjx_revolve.view.report.champion import ChampionReplay, replay_champion
from mjx_revolve.view.report.groups import RunGroup, group_runs
from mjx_revolve.view.report.record import RunRecord
from mjx_revolve.view.report.repeat import environment, repeat_command, sources
from mjx_revolve.view.sensor_plots import plot_sensors
from mjx_revolve.view.statistics import COVERAGE
from mjx_revolve.view.swim_picture import draw_motion, stroke_words

GENERATOR = "mjx_revolve.report"  # identifies pages of this package


_TEMPLATES = make_templates(Path(__file__).parent)
_TEMPLATES.filters |= {
    "digits": tables.format_number,
    "letter": letter,
    "color": lambda index: COLORS[index % len(COLORS)],
    "png": lambda data: data_address(data, "image/png"),
    "svg": lambda data: data_address(data, "image/svg+xml"),
    "inline": lambda data: Markup(inline_svg(data)),
}
_TEMPLATES.globals |= {"episodes": REPORT_EPISODES, "coverage": COVERAGE}
# Its macros, each a function from values to HTML.
sections: Any = _TEMPLATES.get_template("sections.html").module


def make_report(
    records: Sequence[RunRecord],
    lost: Sequence[str] = (),
    every_champion: bool = False,
    at: str | Path = ".",
) -> str:
    """Makes the page.

    Args:
        records: the runs, from `read_run`; problems that show only now are added to theirs.
        lost: lines about folders of which nothing could be read.
        every_champion: whether each run's champion is shown in full.
        at: the folder that the page goes to, where links to other files start.

    Returns:
        A complete HTML document that needs no other file.
    """
    groups = group_runs(records)
    replays, robots = _replay(groups)
    full = list(_in_full(groups, every_champion))
    single = len(records) == 1
    content = [
        ("results", "Results", _results(groups)),
        ("convergence", "Convergence", _convergence(groups)),
        *((f"colony-{key}", f"The colony{words}", _colony(record, record.history))
          for key, words, record in full if record.history is not None),
        *((f"bodies-{key}", f"Bodies{words}", _population(record, Path(at)))
          for key, words, record in full if record.population is not None),
        ("champions", "Champions side by side", _side_by_side(groups, replays)),
        *((f"champion-{key}", f"Champion{words}", _champion(record, replays.get(record.folder)))
          for key, words, record in full),
        ("robot", "Robot", _robots(robots)),
        ("runs", "Runs", "" if single else sections.runs(*tables.runs_table(groups))),
        ("repeat", "Repeat it", _repeat([r for group in groups for r in group.records])),
    ]  # fmt: skip
    kinds = {problem.kind for record in records for problem in record.problems}
    is_grave = bool(lost) or bool(kinds & {"damaged", "missing"})
    lead = sections.headline(tables.headline(groups))
    if single and records[0].is_finished:
        lead += sections.one_seed()
    lead += sections.problems([record for record in records if record.problems], lost, is_grave)
    labels = ", ".join(record.label for record in records)
    return make_page(_title(groups, robots), labels, lead, content)


def _title(groups: Sequence[RunGroup], robots: Sequence[tuple[str, Morphology]]) -> str:
    records = [record for group in groups for record in (*group.records, *group.copies)]
    first = records[0]
    if len(records) > 1:
        of = f" of {groups[0].name}" if len(groups) == 1 else f", {len(groups)} configurations"
        return f"{len(records)} runs{of}"
    robot = f"{robots[0][1].name}: " if robots else ""
    robot = robot if first.population is None else "evolved bodies: "
    robot = robot if first.history is None else "a colony, its champion's "
    return f"{robot}{first.task.replace('_', ' ') or 'evolution'} ({Path(first.label).name})"


def _in_full(groups: Sequence[RunGroup], every: bool) -> Iterator[tuple[str, str, RunRecord]]:
    """Runs that are shown in full: a key, words that headings add, and the run."""
    for k, group in enumerate(groups):
        best = group.best()
        for record in group.records if every else [best]:
            words = f" of {letter(k)}, {group.name}" if len(groups) > 1 else ""
            if len(group.records) > 1:
                words += f": {'the best, ' if record is best else ''}seed {record.seed}"
            yield f"{k}-{record.seed}", words, record


def default_page(folder: Path) -> Path:
    """Where the page about a folder goes.

    Args:
        folder: the folder.

    Returns:
        The path of its `report.html`.

    Raises:
        InputError: another program's file has that name.
    """
    path = folder / "report.html"
    if path.exists():
        with open(path, "rb") as file:
            ours = f'content="{GENERATOR}"'.encode() in file.read(1000)
        if not ours:
            found = "another file (name it with --out to replace it)"
            raise InputError(path, "no file or an earlier report", found)
    return path


def make_page(title: str, words: str, lead: str, content: Sequence[tuple[str, str, str]]) -> str:
    """The frame around the sections.

    Args:
        title: of the page.
        words: below the title.
        lead: HTML below that.
        content: anchor, heading and HTML of each section; those without HTML are left out.

    Returns:
        A complete HTML document.
    """
    now = datetime.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")
    return _TEMPLATES.get_template("page.html").render(
        generator=GENERATOR, title=title, words=words, lead=lead,
        sections=[section for section in content if section[2].strip()],
        foot=f"Made by mjx_revolve {__version__}, {now}.",
    )  # fmt: skip


# --- bodies and colonies --------------------------------------------------------------------------


def _colony(record: RunRecord, history: ColonyHistory) -> str:
    """A colony: births, lives, families and places."""
    if not history.spans:
        return ""
    colony = None if record.config is None else record.config.colony
    size = record.setting("evolution.population_size")
    room = size if isinstance(size, int) else None
    figures = plot_history(history, colony, room, record.individual)
    # Thousands of lines and dots take less room as points of a picture.
    pictures = {name: figure_png(figure) for name, figure in figures.items()}
    sources = {name: data_address(png, "image/png") for name, png in pictures.items()}
    command = viewer_command(record, "--colony")
    return sections.colony(tables.colony_table(history), sources, command)


def _population(record: RunRecord, at: Path) -> str:
    """The bodies of a run."""
    shown, command = show_population(record, at), partial(viewer_command, record, "--individual")
    return sections.population(shown, partial(anchor, record), command, record.round)


# --- what the champions do ------------------------------------------------------------------------


def _replay(
    groups: Sequence[RunGroup],
) -> tuple[dict[Path, ChampionReplay], list[tuple[str, Morphology]]]:
    """All champions' episodes by run folder, and the robots of the groups."""
    replays: dict[Path, ChampionReplay] = {}
    robots: list[tuple[str, Morphology]] = []
    for group in groups:
        fitness, bodies = None, {}
        for record in (*group.records, *group.copies):
            if record.config is None:
                continue
            try:
                if record.population is not None:
                    fitness = fit_body(record.config, _champions_body(record, record.config))
                # Runs of a group differ in their seed only, and a fitness does not depend on it.
                fitness = make_fitness(record.config) if fitness is None else fitness
                bodies[record.folder] = fitness.robot.morphology
                known = record.info.get("model_hash")
                alike = record.population is not None or not isinstance(known, str)
                if not alike and known != model_hash(fitness):
                    record.note("version", "the robot or its world is built differently by this "
                                "version than when it evolved: the replay may differ")  # fmt: skip
                if record.genes is not None:
                    replays[record.folder] = replay_champion(record, fitness)
            except UntrustedError as error:
                record.note("untrusted", f"no replay: {error}")
            except InputError as error:
                record.note("damaged", f"no replay: {error}")
        best = group.best().folder
        if best in bodies:
            robots.append((group.name, bodies[best]))
    return replays, robots


def _champions_body(record: RunRecord, config: Config) -> Morphology:
    """The body of a champion, not trimmed."""
    path, number = record.folder / "champion" / "morphology.yaml", record.individual
    body = load_morphology(path, read_modules(config), allow_overlap=True)
    return body if number is None else replace(body, name=f"individual {number}")


def _champion(record: RunRecord, replay: ChampionReplay | None) -> str:
    """A champion; nothing without a replay."""
    if replay is None:
        return ""
    motion, robot = replay.motion, replay.motion.robot
    drawn = {
        "way": motion_plots.plot_path(motion.time, motion.path, float(motion.surface[0])),
        "joints": motion_plots.plot_joints(motion) if robot.num_hinges else None,
        "thrusters": motion_plots.plot_thrusters(motion) if robot.num_thrusters else None,
        "energy": motion_plots.plot_energy(motion),
        # Readings are of the moment before each step.
        "senses": plot_sensors(motion.time - motion.time[0], replay.traces)
        if replay.traces else None,
    }  # fmt: skip
    pictures = {name: figure and svg_source(figure) for name, figure in drawn.items()}
    pictures["swim"] = data_address(figure_jpeg(draw_motion(motion)), "image/jpeg")
    origin = record.champion.get("origin")
    return sections.champion(
        robot.morphology.title, float(motion.time[-1]), motion.counted_from,
        origin if isinstance(origin, str) else "", tables.measures_table(record, replay),
        record.passport.rows if record.passport is not None else [], pictures, stroke_words(motion),
    )  # fmt: skip


def svg_source(figure: Figure) -> str:
    """A figure as an address that holds it."""
    return data_address(figure_svg(figure), "image/svg+xml")


# --- several runs ---------------------------------------------------------------------------------


def _results(groups: Sequence[RunGroup]) -> str:
    """Final scores of all configurations, and in what they differ."""
    if len(groups) == 1 and len(groups[0].records) == 1:
        return ""
    differ = tables.different_settings(groups)
    return sections.results(tables.task_tables(groups), differ, len(groups))


def _convergence(groups: Sequence[RunGroup]) -> str:
    """How the fitness grew."""
    styles = {group.name: k for k, group in enumerate(groups)}
    shown = [group for group in groups if group.shown]
    comparisons = []
    # A colony's fitness is not that of other runs, though their champions have one task.
    kinds = {group.name: (group.task, group.records[0].fitness) for group in groups}
    for kind in dict.fromkeys(kinds[group.name] for group in shown):
        members = [group for group in groups if kinds[group.name] == kind]
        if sum(len(group.shown) for group in members) > 1:
            comparisons.append(svg_source(convergence.plot_comparison(members, styles)))
    entries = []
    for group in (group for group in shown if len(group.shown) == 1):
        record = group.shown[0]
        quartiles = "lower_quartile" in record.metrics
        entries.append({
            "name": group.name,
            "index": styles[group.name] if len(groups) > 1 else None,
            "label": record.label,
            "below": "how far the search spreads" if record.population is None
            else "how full the archive is, or how large the living are",
            "band": "quartiles" if quartiles else "mean and standard deviation",
            "of": "the population" if record.population is None else "those born",
            "fitness": svg_source(_plot_fitness(record)),
            "colony": record.history is not None,
        })  # fmt: skip
    return sections.convergence(comparisons, entries)


def _plot_fitness(record: RunRecord) -> Figure:
    """One run's fitness: over generations, or over a colony's time."""
    needed = ("time", "best", "median", "lower_quartile", "upper_quartile", "champion")
    if record.history is not None and all(name in record.metrics for name in needed):
        return convergence.plot_colony(record.metrics)
    return convergence.plot_fitness(record.metrics, "", record.fitness)


def _side_by_side(groups: Sequence[RunGroup], replays: Mapping[Path, ChampionReplay]) -> str:
    """All champions in one picture, where there are several."""
    members = [
        (group.name, k, [replays[r.folder].motion for r in group.records if r.folder in replays])
        for k, group in enumerate(groups)
    ]
    members = [member for member in members if member[2]]
    if sum(len(found) for *_, found in members) < 2:
        return ""
    return sections.side_by_side(svg_source(motion_plots.plot_champions(members)))


# --- the end --------------------------------------------------------------------------------------


def _robots(found: Sequence[tuple[str, Morphology]]) -> str:
    """The robots, each once."""
    entries = []
    several = len({morphology.name for _, morphology in found}) > 1
    seen: list[Morphology] = []
    for name, morphology in found:
        if morphology in seen:
            continue
        seen.append(morphology)
        rows, foot = tables.count_modules(morphology)
        which = f" ({name})" if several else ""
        entries.append({
            "heading": f"{morphology.title}: {morphology.counts}{which}",
            "rows": rows, "foot": foot, "modules": tables.list_modules(morphology),
            "descriptors": tables.list_descriptors(morphology),
        })  # fmt: skip
    return sections.robots(entries)


def _repeat(records: Sequence[RunRecord]) -> str:
    """Commands, versions and sources that repeat the runs."""
    return sections.repeat([
        {"label": record.label, "seed": record.seed, "command": repeat_command(record),
         "environment": environment(record), "sources": sources(record)}
        for record in records
    ])  # fmt: skip
