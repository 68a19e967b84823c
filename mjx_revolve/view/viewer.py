"""One HTML file that replays an episode in any browser.

The file holds everything: the robot's meshes, its poses and the forces on its modules along the
episode (`page_data`), three.js, and the page's own scripts in `viewer_page/`. It needs no server
and asks for nothing over the network.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjx_revolve.inputs.files import PAGES, check_name, write_atomic

if TYPE_CHECKING:
    from mjx_revolve.episodes.champion import Episode

_PAGE = Path(__file__).parent / "viewer_page"


def write_viewer(episode: Episode, path: str | Path, forces: bool = True) -> None:
    """Writes the replay of an episode as one HTML file.

    The file appears whole or not at all.

    Args:
        episode: what to show; rows after the first that is not finite are left out.
        path: of the file, which ends in `.html`; its folder is made if need be.
        forces: see `make_page`.

    Raises:
        InputError: `path` has another ending, or the episode has no finite row.
        OSError: the file cannot be written.
    """
    write_atomic(check_name(path, PAGES), make_page(episode, forces).encode())


def make_page(episode: Episode, forces: bool = True) -> str:
    """The replay of an episode as the text of an HTML file.

    Args:
        episode: what to show.
        forces: whether it has arrows of forces, which take seconds to compile.

    Returns:
        The page.

    Raises:
        InputError: the episode has no finite row.
    """
    from mjx_revolve.view.page_data import page_data

    return fill_page(
        "page.html",
        title=episode.title,
        subtitle=_subtitle(episode),
        data=page_data(episode, forces),
    )


def fill_page(template: str, **values: Any) -> str:
    """A page of `viewer_page/`, which holds all files that it needs.

    Args:
        template: its name there.
        values: what it is filled with: `title`, `subtitle`, and `data` for its scripts.

    Returns:
        The text of an HTML file.
    """
    import jinja2

    pages = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_PAGE), autoescape=True, undefined=jinja2.StrictUndefined
    )
    pages.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    file = lambda name: (_PAGE / name).read_text(encoding="utf-8")  # noqa: E731
    return pages.get_template(template).render(file=file, **values)


def _subtitle(episode: Episode) -> str:
    """Score, body and water in a line."""
    body, world = episode.robot.morphology, episode.robot.world
    words = []
    if episode.score is not None:
        words.append(f"{episode.score:.3g} {episode.score_unit} over {episode.starts}")
    counts = {
        "module": body.num_modules, "hinge": body.num_hinges, "thruster": body.num_thrusters,
    }  # fmt: skip
    words += [f"{n} {name}{'s' if n > 1 else ''}" for name, n in counts.items() if n]
    words.append(world.name.replace("_", " "))
    if any(world.current):
        words.append(f"current {math.hypot(*world.current):.2g} m/s")
    moving = {"gusts": world.gust, "shear": world.shear, "a field of currents": world.current_field}
    words += [name for name, value in moving.items() if value is not None]
    if world.waves:
        height = 2 * math.hypot(*(wave.amplitude for wave in world.waves))
        words.append(f"waves of {height:.2g} m")
    return " \u00b7 ".join(words)
