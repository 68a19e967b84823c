"""What a report shows of bodies that evolved: the best ones, the champion's family, the archive."""

from __future__ import annotations

import io
import math
import os
import re
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from mjx_revolve.body.catalogue import MODULES
from mjx_revolve.body.morphology import Morphology
from mjx_revolve.episodes.champion import load_individuals
from mjx_revolve.episodes.fitness import read_modules
from mjx_revolve.episodes.lives import Life
from mjx_revolve.evolution import archive as archives
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.view.archive_map import plot_archive
from mjx_revolve.view.plots import figure_svg
from mjx_revolve.view.population import pick_evenly, trace_family
from mjx_revolve.view.report.record import RunRecord
from mjx_revolve.view.report.sizes import plot_sizes
from mjx_revolve.view.report.tables import format_number
from mjx_revolve.view.thumbnails import count_modules, draw_bodies
from mjx_revolve.view.viewer import write_viewer

# Bodies that are shown: of the last generation, of each of so many earlier ones, and of an archive.
_LAST, _EARLIER, _GENERATIONS, _ELITES = 12, 6, 3, 256
INDIVIDUALS = "individuals"
"""The folder of a run that has pages of individuals."""


@dataclass(frozen=True)
class Card:
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


def show_population(record: RunRecord, at: Path) -> dict[str, Any]:
    """All that the section of a run's bodies is made of.

    Args:
        record: the run, with a population; what cannot be drawn is added to its problems.
        at: folder of the report, from where links to pages of individuals start.

    Returns:
        `generations`: a generation and its cards each; `family`: steps of `card`, `mate` and
        `skipped`; `sizes`: SVG or None; `archive`: SVG, or None without an archive; `elites`: cards
        of those who live there.
    """
    population = record.population
    assert population is not None
    shown = [g for g in population.living if population.alive(g)]
    earlier = pick_evenly(shown, _GENERATIONS + 1)[:-1]
    groups = {g: population.alive(g)[:_EARLIER] for g in earlier}
    groups |= {g: population.alive(g)[:_LAST] for g in shown[-1:]}
    champion = _champion(record)
    family = trace_family(population, champion) if champion is not None else []
    archive = _fill_archive(record)
    elites: list[Life] = []
    if archive is not None:
        living = [population.lives[n] for n in archive.ids[archives.filled(archive)].tolist()]
        elites = sorted(living, key=lambda life: (-life.score, life.number))
    everybody = [life for lives in groups.values() for life in lives] + elites[:_ELITES]
    everybody += [life for kin in family for life in (kin.life, kin.mate) if life is not None]
    make = _make_cards(record, everybody, at)
    return {
        "generations": [
            (g, [make(life) for life in groups[g]]) for g in sorted(groups, reverse=True)
        ],
        "family": [
            {"card": make(kin.life), "mate": kin.mate and make(kin.mate), "skipped": kin.skipped}
            for kin in family
        ],
        "sizes": _draw(plot_sizes(population, _named(record), record.round), figure_svg),
        "archive": None if archive is None else _draw_archive(record, archive, elites, at),
        "elites": [make(life) for life in elites],
    }


def _champion(record: RunRecord) -> int | None:
    """Whose family is shown."""
    assert record.population is not None
    best = record.population.best()
    known = record.individual
    return known if known is not None else None if best is None else best.number


def _draw(figure: Figure | None, write: Callable[[Figure], bytes]) -> bytes | None:
    return None if figure is None else write(figure)


# --- cards ----------------------------------------------------------------------------------------


def _make_cards(record: RunRecord, lives: Iterable[Life], at: Path) -> Callable[[Life], Card]:
    """Draws all to one scale; what is returned makes anybody's card."""
    modules = MODULES if record.config is None else read_modules(record.config)
    bodies: dict[int, Morphology] = {}
    for life in lives:
        if life.number not in bodies:
            with record.noting_damage():
                bodies[life.number] = life.grow(modules)
    pictures = dict(zip(bodies, map(_png, draw_bodies(list(bodies.values()))), strict=True))

    def make(life: Life) -> Card:
        return Card(
            life.number,
            pictures.get(life.number),
            format_number(life.score),
            count_modules(life),
            f"{record.round} {life.born}, {life.origin}",
            life.parents,
            _page(record, life, at),
        )

    return make


def _png(picture: np.ndarray) -> bytes:
    """A picture with few colours: a third of the size."""
    buffer = io.BytesIO()
    Image.fromarray(picture).quantize(64, dither=Image.Dither.NONE).save(
        buffer, "PNG", optimize=True
    )
    return buffer.getvalue()


def _page(record: RunRecord, life: Life, at: Path) -> str:
    """Address of an individual's page from the report's folder; "" without one."""
    path = record.folder / INDIVIDUALS / f"{life.number}.html"
    if not path.is_file():
        return ""
    return Path(os.path.relpath(path, at.absolute())).as_posix()


# --- figures and the archive ----------------------------------------------------------------------


def _named(record: RunRecord) -> tuple[str, ...]:
    """What the search itself looks at, beside scores."""
    bodies = record.config.bodies if record.config is not None else None
    if bodies is None:
        return ()
    selection = bodies.selection
    names = [name.lstrip("-") for name in (*selection.objectives, *selection.novelty)]
    names += bodies.archive.axes if bodies.archive is not None else ()
    return tuple(dict.fromkeys(name for name in names if name not in ("score", "novelty")))


def _fill_archive(record: RunRecord) -> archives.Archive | None:
    """The archive as all who were born have filled it; None without one."""
    config, population = record.config, record.population
    if config is None or config.bodies is None or config.bodies.archive is None:
        return None
    assert population is not None
    archive = archives.make_archive(config.bodies.archive, config.evolution.seed)
    lives = list(population.lives.values())
    points = [[life.figures.get(name, np.nan) for name in archive.names] for life in lives]
    return archives.insert(
        archive,
        np.array([life.number for life in lives], int),
        np.array([life.score for life in lives], float),
        np.array(points, float).reshape(len(lives), len(archive.names)),
    )[0]


def _draw_archive(
    record: RunRecord, archive: archives.Archive, elites: Sequence[Life], at: Path
) -> bytes:
    """The map as SVG whose cells are links: to pages, or to cards on the same page."""
    links: Mapping[int, str] = {
        life.number: _page(record, life, at) or f"#{anchor(record, life.number)}" for life in elites
    }
    label = f"score ({record.unit})" if record.unit else "score"
    figure = plot_archive(archive, label, champion=_champion(record), links=links)
    return figure_svg(figure)


def anchor(record: RunRecord, number: int) -> str:
    """What an individual's card is called on a page about several runs."""
    return f"individual-{re.sub('[^A-Za-z0-9]+', '-', record.label)}-{number}"


def choose_individuals(record: RunRecord, which: str | Sequence[int]) -> list[int]:
    """Whose pages are asked for.

    Args:
        record: the run.
        which: "best": those of the last generation that the report shows, and the champion's
            family; "archive": who lives there; or numbers.

    Returns:
        Their numbers; those who have learnt nothing, and have nothing to show, are left out, but
        for numbers that were asked for.

    Raises:
        InputError: bodies did not evolve, there is no archive, or nobody has such a number.
    """
    population = record.population
    if population is None:
        raise InputError(f"{record.label}: expected a run in which bodies evolve; found another")
    if not isinstance(which, str):
        for number in which:
            if number not in population.lives:
                raise InputError(f"{record.label}: expected individual {number}; found none")
        return list(dict.fromkeys(which))
    if which == "archive":
        archive = _fill_archive(record)
        if archive is None:
            raise InputError(f"{record.label}: expected a run with an archive; found none")
        return archive.ids[archives.filled(archive)].tolist()
    champion = _champion(record)
    family = trace_family(population, champion) if champion is not None else []
    found = [*population.alive(population.last)[:_LAST], *(kin.life for kin in family)]
    return list(dict.fromkeys(life.number for life in found if not math.isnan(life.score)))


def write_pages(record: RunRecord, numbers: Sequence[int]) -> int:
    """Writes pages on which individuals swim, into the run folder; those that are there stay.

    One compiled program serves all, and the pages have no arrows of forces, which would have to be
    compiled for each.

    Args:
        record: the run.
        numbers: whose.

    Returns:
        How many were written.

    Raises:
        InputError: somebody cannot be simulated.
        OSError: a page cannot be written.
    """
    folder = record.folder / INDIVIDUALS
    missing = [number for number in numbers if not (folder / f"{number}.html").is_file()]
    for number, episode in zip(
        missing, load_individuals(record.folder, missing) if missing else (), strict=True
    ):
        write_viewer(episode, folder / f"{number}.html", forces=False)
    return len(missing)


def viewer_command(record: RunRecord, number: int) -> str:
    """The command line that shows an individual swim."""
    words = ["python", "-m", "mjx_revolve.viewer", record.label, "--individual", str(number)]
    return shlex.join(words)


def inline_svg(svg: bytes) -> str:
    """An SVG as a part of a page.

    Without its head; without its size, which the page decides on; and without its links' wish for a
    window of their own.
    """
    text = svg[svg.index(b"<svg") :].decode().replace(' target="_blank"', "")
    start, end = text.split(">", 1)
    return re.sub(r' (width|height)="[^"]*"', "", start) + ">" + end
