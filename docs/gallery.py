"""Writes the gallery: pages that replay robots, tasks, a fall and a colony in any browser.

    python docs/gallery.py build/docs [--only spider fish_swim]

They lie in `gallery/` there beside one three.js, with a small picture each, and `index.json` by
which `docs/reference.py` makes the page that leads to them. Champions are not evolved here: their
genes and configurations are in `docs/champions/`, as `evolve` wrote them.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import html
import json
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import jax
import numpy as np
from PIL import Image

from mjx_revolve import (
    InputError,
    build_robot,
    evolve,
    load_morphology,
    load_world,
    make_mixed_fitness,
    prepare_process,
    simulate,
    trim_neutral,
)
from mjx_revolve.body import Morphology
from mjx_revolve.episodes import Episode, load_episode
from mjx_revolve.inputs.shipped import list_shipped
from mjx_revolve.view import record_colony, write_colony_page, write_viewer
from mjx_revolve.view.body_pictures import draw_bodies

DOCS = Path(__file__).parent
_PAGE = DOCS.parent / "mjx_revolve" / "view" / "viewer_page"
GROUPS = {
    "robots": "All shipped robots, with sines of random amplitudes and phases at their hinges and "
    "thrusters. Nothing is evolved here: this is how they move, not how well they could.",
    "tasks": "One champion for each task, from one run of a shipped configuration each, with the "
    "forces on its modules.",
    "falls": "The thesis's spider, dropped 0.25 m above the water: as it fell in the thesis, which "
    "had buoyancy only, and as it falls in the default water.",
    "colony": "Robots that live together: random bodies and brains, the first two minutes of a "
    "colony, and one more.",
}
SECONDS, DROP = 8.0, 0.25  # of the robots' swims [s]; of the fall [m]
_THESIS = {"buoyancy": "mask", "drag": "off", "added_mass": False}


@dataclasses.dataclass
class Page:
    """A page of the gallery.

    Attributes:
        group: one of `GROUPS`.
        name: of its files.
        title: above it.
        words: a line about it.
        body: what its picture shows.
        write: writes it to a path.
    """

    group: str
    name: str
    title: str
    words: str
    body: Morphology
    write: Callable[[Path], object]


def swim_randomly(names: Sequence[str]) -> Iterator[Page]:
    """Shipped robots, all by one compiled program."""
    water = load_world("lake")
    bodies = []
    for name in names:
        body = load_morphology(name)
        if body.num_hinges or body.num_thrusters:  # what cannot swim, sinks
            with contextlib.suppress(InputError):  # what floats, floats
                body = trim_neutral(body, water.density)
        bodies.append(body)
    sines = {"controller.type": "sine", "trim": "none"}
    fitness = make_mixed_fitness(
        "smoke", bodies, **sines, **{"task.duration": SECONDS, "task.start_tilt": 0.0}
    )
    robots = [fitness.build(body) for body in bodies]
    draw = np.random.default_rng(0)
    genes = [draw.normal(0, 0.6, fitness.controller_of(robot).num_genes) for robot in robots]
    for name, robot, swim in zip(
        names, robots, fitness.replay(robots, genes, jax.random.key(0)), strict=True
    ):
        episode = Episode(robot.morphology.title, robot, swim)
        write = partial(write_viewer, episode, forces=False)
        yield Page("robots", name, episode.title, robot.morphology.counts, robot.morphology, write)


def replay_champion(name: str) -> Page:
    """The champion of a run of a shipped configuration, its score left out: that was then."""
    episode = dataclasses.replace(load_episode(DOCS / "champions" / name), score=None)
    comment = list_shipped("configs")[name].read_text("utf-8").removeprefix("# ")
    words = " ".join(comment.partition("\n#\n")[0].replace("\n# ", " ").split()).partition(".")[0]
    write = partial(write_viewer, episode)
    return Page("tasks", name, episode.title, words, episode.robot.morphology, write)


def fall(name: str) -> Page:
    """The spider, dropped above the water."""
    changes = _THESIS if name == "fall_thesis" else {}
    robot = build_robot(load_morphology("spider"), load_world("empty_underwater", **changes))
    swim = simulate(robot, None, 6.0, qpos=robot.start_qpos(depth=-DROP), once=True)
    title = "A fall into the thesis's water" if changes else "A fall into the default water"
    write = partial(write_viewer, Episode(title, robot, swim))
    return Page("falls", name, title, f"from {DROP} m, joints held", robot.morphology, write)


def colony(name: str) -> Page:
    """A colony, from its beginning."""
    settings = ["evolution.generations=12", "evolution.checkpoint_every=12",
                "evolution.population_size=32", "colony.birth.initial=20", "colony.birth.least=8",
                "evolution.passport=false", "bodies.selection.passport=made"]  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "colony"
        if evolve.main(["lake_colony", "--out", str(run), *(f"--set={x}" for x in settings)]):
            raise RuntimeError("the colony did not run")
        seen = record_colony(run)
    words = f"{len(seen.robots)} robots, {seen.start:.0f} to {seen.end:.0f} s of its life"
    write = partial(
        write_colony_page, seen.robots, title="A colony", marks=seen.marks, leap=seen.leap
    )
    return Page("colony", name, "A colony", words, seen.robots[0].robot.morphology, write)


def list_names() -> dict[str, list[str]]:
    """The names of all pages by group."""
    champions = sorted(path.name for path in (DOCS / "champions").iterdir())
    return {"robots": list(list_shipped("morphologies")), "tasks": champions,
            "falls": ["fall_thesis", "fall"], "colony": ["colony"]}  # fmt: skip


def make_pages(names: dict[str, list[str]]) -> Iterator[Page]:
    """All pages of these names, each as soon as it can be written."""
    if names["robots"]:
        yield from swim_randomly(names["robots"])
    makers = {"tasks": replay_champion, "falls": fall, "colony": colony}
    for group, make in makers.items():
        yield from map(make, names[group])


def write_gallery(folder: Path, only: Sequence[str] = ()) -> list[dict[str, str]]:
    """Writes the pages.

    Args:
        folder: of the site.
        only: names of pages; by default all.

    Returns:
        Group, name, title and words of each.
    """
    folder = folder / "gallery"
    folder.mkdir(parents=True, exist_ok=True)
    three = (_PAGE / "three.min.js").read_text("utf-8")
    (folder / "three.min.js").write_text(three, "utf-8")
    names = {k: [x for x in v if x in only or not only] for k, v in list_names().items()}
    pages, found = [], []
    for page in make_pages(names):
        path = folder / f"{page.name}.html"
        page.write(path)
        text = path.read_text("utf-8")
        shared = text.replace(
            f"{three}\n</script>", '</script>\n<script src="three.min.js"></script>'
        )
        shared = shared.replace("script-src ", "script-src 'self' file: ")
        assert len(shared) < len(text) - len(three) // 2, "three.js is no longer where it was"
        path.write_text(shared, "utf-8")
        print(f"{path}: {len(shared) / 1e6:.2f} MB", flush=True)
        pages.append(page)
        found.append({k: getattr(page, k) for k in ("group", "name", "title", "words")})
    for group in GROUPS:  # the robots of a group to one scale
        own = [page for page in pages if page.group == group]
        for page, picture in zip(own, draw_bodies([page.body for page in own]), strict=True):
            Image.fromarray(picture).save(folder / f"{page.name}.png", optimize=True)
    (folder / "index.json").write_text(json.dumps(found, indent=1) + "\n", "utf-8")
    return found


def describe_gallery(folder: Path) -> str:
    """The page that leads to a site's gallery, as Markdown; "" where there is none."""
    index = folder / "gallery" / "index.json"
    if not index.is_file():
        return ""
    pages = json.loads(index.read_text("utf-8"))
    parts = [
        "# Gallery",
        f"{len(pages)} pages that move: each replays what was simulated when this site was built. "
        "Drag to turn, scroll to zoom; `docs/viewer.md` has all keys.",
    ]
    for group, words in GROUPS.items():
        own = [page for page in pages if page["group"] == group]
        cards = (
            '<a href="gallery/{name}.html"><img src="gallery/{name}.png" alt="" width="240" '
            'height="180"><b>{title}</b><span>{words}</span></a>'.format_map(
                {key: html.escape(value) for key, value in page.items()}
            )
            for page in own
        )
        if own:
            parts += [f"## {group.capitalize()}", words]
            parts.append(f'<div class="gallery">{"".join(cards)}</div>')
    return "\n\n".join(parts) + "\n"


def main() -> int:
    """Runs the command."""
    parser = argparse.ArgumentParser(description="Writes the gallery of a site.")
    parser.add_argument("folder", type=Path, help="of the site, such as build/docs")
    parser.add_argument("--only", nargs="+", default=(), help="names of pages (default: all)")
    arguments = parser.parse_args()
    prepare_process()
    print(f"{len(write_gallery(arguments.folder, arguments.only))} pages")
    return 0


if __name__ == "__main__":
    sys.exit(main())
