"""Evolved bodies in a report: the best ones, the champion's family, the archive."""

from __future__ import annotations

import io
import math
import os
import re
import shlex
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

import numpy as np
from PIL import Image

from mjx_revolve.body.catalogue import MODULES
from mjx_revolve.body.module_types import ModuleType
from mjx_revolve.body.morphology import Morphology
from mjx_revolve.episodes.champion import load_individuals
from mjx_revolve.episodes.individual_log import LoggedIndividual
from mjx_revolve.episodes.named_files import read_modules
from mjx_revolve.evolution import archive as archives
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.view.archive_map import plot_archive
from mjx_revolve.view.body_pictures import count_modules, draw_bodies, plot_descriptors
from mjx_revolve.view.plots import figure_svg, with_unit
from mjx_revolve.view.population import LineageStep, pick_evenly, rank, trace_lineage
from mjx_revolve.view.report.record import RunRecord
from mjx_revolve.view.report.tables import format_number
from mjx_revolve.view.viewer import write_viewer

# Bodies that are shown: of the last generation, of each of so many earlier ones, and of an archive.
_LAST, _EARLIER, _GENERATIONS, _ELITES = 12, 6, 3, 256
PAGE_FOLDER = "individuals"
"""The folder of a run that has pages of individuals."""


class Card(NamedTuple):
    """An individual in a few words, with its picture.

    Attributes:
        number: its number.
        picture: PNG; None where its body cannot be read.
        score: in words.
        size: modules and hinges, in words.
        birth: generation and origin, in words.
        parents: their numbers.
        page: address of its page; "" without one.
    """

    number: int
    picture: bytes | None
    score: str
    size: str
    birth: str
    parents: tuple[int, ...]
    page: str


class ShownPopulation(NamedTuple):
    """Content of the section about a run's bodies.

    Attributes:
        generations: a generation and its best individuals each, the last one first.
        family: of the champion, the oldest first.
        sizes: SVG of descriptors over the generations, or None.
        archive: SVG, or None without an archive.
        elites: the archive's individuals.
        card: makes the card of any of them.
    """

    generations: dict[int, list[LoggedIndividual]]
    family: list[LineageStep]
    sizes: bytes | None
    archive: bytes | None
    elites: list[LoggedIndividual]
    card: Callable[[LoggedIndividual], Card]


def show_population(record: RunRecord, at: Path) -> ShownPopulation:
    """Draws the bodies of a run.

    Args:
        record: the run, with a population; what cannot be drawn is added to its problems.
        at: folder of the report, from where links to pages of individuals start.

    Returns:
        The section's content.
    """
    population = record.population
    assert population is not None
    shown = [g for g in population.living if population.alive(g)]
    groups = {g: population.alive(g)[:_LAST] for g in shown[-1:]}
    for generation in pick_evenly(shown, _GENERATIONS + 1)[-2::-1]:
        groups.setdefault(generation, population.alive(generation)[:_EARLIER])
    family, archive = _family(record), fill_archive(record)
    elites: list[LoggedIndividual] = []
    if archive is not None:
        elites = [population.lives[n] for n in archive.ids[archives.filled(archive)].tolist()]
        elites.sort(key=rank)
    pictured = [life for lives in groups.values() for life in lives] + elites[:_ELITES]
    pictured += [life for step in family for life in (step.life, step.mate) if life is not None]
    sizes = plot_descriptors(population, _named(record), record.round)
    return ShownPopulation(
        groups, family, None if sizes is None else figure_svg(sizes),
        None if archive is None else _draw_archive(record, archive, elites, at), elites,
        _make_cards(record, pictured, at),
    )  # fmt: skip


def _champion(record: RunRecord) -> int | None:
    """Number of the champion, or of the best individual."""
    assert record.population is not None
    best = record.population.best()
    known = record.individual
    return known if known is not None else None if best is None else best.number


def _family(record: RunRecord) -> list[LineageStep]:
    """The champion's line of descent."""
    champion = _champion(record)
    assert record.population is not None
    return [] if champion is None else trace_lineage(record.population, champion)


# --- cards ----------------------------------------------------------------------------------------


def _make_cards(
    record: RunRecord, lives: Iterable[LoggedIndividual], at: Path
) -> Callable[[LoggedIndividual], Card]:
    """Draws individuals to one scale; the function that it returns makes the card of any."""
    modules: Mapping[str, ModuleType] = MODULES
    if record.config is not None:
        with record.noting_damage():
            modules = read_modules(record.config)
    bodies: dict[int, Morphology] = {}
    for life in lives:
        if life.number not in bodies:
            with record.noting_damage():
                bodies[life.number] = life.grow(modules)
    pictures = dict(zip(bodies, map(_png, draw_bodies(list(bodies.values()))), strict=True))

    def make(life: LoggedIndividual) -> Card:
        return Card(
            life.number, pictures.get(life.number), format_number(life.score), count_modules(life),
            f"{record.round} {life.born}, {life.origin}", life.parents, _page(record, life, at),
        )  # fmt: skip

    return make


def _png(picture: np.ndarray) -> bytes:
    """A picture with few colours: a third of the size."""
    buffer = io.BytesIO()
    reduced = Image.fromarray(picture).quantize(64, dither=Image.Dither.NONE)
    reduced.save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def _page(record: RunRecord, life: LoggedIndividual, at: Path) -> str:
    """Address of an individual's page from the report's folder; "" without one."""
    path = record.folder / PAGE_FOLDER / f"{life.number}.html"
    if not path.is_file():
        return ""
    return quote(Path(os.path.relpath(path, at.absolute())).as_posix())


# --- the archive ----------------------------------------------------------------------------------


def _named(record: RunRecord) -> tuple[str, ...]:
    """Features that the search itself uses, beside scores."""
    bodies = record.config.bodies if record.config is not None else None
    if bodies is None:
        return ()
    selection = bodies.selection
    names = [name.removeprefix("-") for name in (*selection.objectives, *selection.novelty)]
    names += bodies.archive.axes if bodies.archive is not None else ()
    return tuple(dict.fromkeys(name for name in names if name not in ("score", "novelty")))


def fill_archive(record: RunRecord) -> archives.Archive | None:
    """The archive as all individuals of a run have filled it; None without one."""
    config, population = record.config, record.population
    if config is None or config.bodies is None or config.bodies.archive is None:
        return None
    assert population is not None
    archive = archives.make_archive(config.bodies.archive, config.evolution.seed)
    lives = list(population.lives.values())
    points = [[life.features.get(name, np.nan) for name in archive.names] for life in lives]
    return archives.insert(
        archive,
        np.array([life.number for life in lives], int),
        np.array([life.score for life in lives], float),
        np.array(points, float).reshape(len(lives), len(archive.names)),
    )


def _draw_archive(
    record: RunRecord, archive: archives.Archive, elites: Sequence[LoggedIndividual], at: Path
) -> bytes:
    """The map as SVG with links in its cells: to pages, or to cards on the same page."""
    links = {
        life.number: _page(record, life, at) or f"#{anchor(record, life.number)}" for life in elites
    }
    label = with_unit("score", record.unit)
    return figure_svg(plot_archive(archive, label, champion=_champion(record), links=links))


def anchor(record: RunRecord, number: int) -> str:
    """Anchor of an individual's card on a page about several runs."""
    return f"individual-{zlib.crc32(record.label.encode()):08x}-{number}"


def choose_individuals(record: RunRecord, which: str | Sequence[int]) -> list[int]:
    """Numbers of the individuals that an option names.

    Args:
        record: the run.
        which: "best": those of the last generation that the report shows, and the champion's
            family; "archive": all in the archive; or numbers.

    Returns:
        The numbers; of "best" and "archive" only individuals with a score.

    Raises:
        InputError: bodies did not evolve, there is no archive, or no individual has such a number.
    """
    population = record.population
    if population is None:
        raise InputError(record.label, "a run in which bodies evolve", "another")
    if not isinstance(which, str):
        for number in which:
            if number not in population.lives:
                raise InputError(record.label, f"individual {number}", "none")
        return list(dict.fromkeys(which))
    if which == "archive":
        archive = fill_archive(record)
        if archive is None:
            raise InputError(record.label, "a run with an archive", "none")
        return archive.ids[archives.filled(archive)].tolist()
    found = [*population.alive(population.last)[:_LAST], *(s.life for s in _family(record))]
    return list(dict.fromkeys(life.number for life in found if not math.isnan(life.score)))


def write_pages(record: RunRecord, numbers: Sequence[int]) -> int:
    """Writes pages on which individuals swim, into the run folder; those that are there stay.

    One compiled program serves all, and the pages have no arrows of forces, which would have to be
    compiled for each.

    Args:
        record: the run.
        numbers: of the individuals.

    Returns:
        How many were written.

    Raises:
        InputError: an individual cannot be simulated.
        OSError: a page cannot be written.
    """
    folder = record.folder / PAGE_FOLDER
    missing = [number for number in numbers if not (folder / f"{number}.html").is_file()]
    for number, episode in zip(
        missing, load_individuals(record.folder, missing) if missing else (), strict=True
    ):
        write_viewer(episode, folder / f"{number}.html", forces=False)
    return len(missing)


def viewer_command(record: RunRecord, *options: object) -> str:
    """The command line that shows a run, or an individual of it, in a browser."""
    return shlex.join(["python", "-m", "mjx_revolve.viewer", record.path, *map(str, options)])


def inline_svg(svg: bytes) -> str:
    """An SVG as a part of a page: without its head and size, its links named, in this window."""
    text = svg[svg.index(b"<svg") :].decode().replace(' target="_blank"', "")
    named = r'<a \1 aria-label="individual \2"'
    text = re.sub(r'<a (xlink:href="[^"]*?(\d+)[^"\d]*")', named, text)
    start, end = text.split(">", 1)
    return re.sub(r' (width|height)="[^"]*"', "", start) + ">" + end
