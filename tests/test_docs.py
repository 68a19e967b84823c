"""The documentation as HTML: made without complaint, with a page for each module and each text."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
import subprocess
import sys

import pytest

import mjx_revolve
from laboratory import ROOT

FOUND = [m.name for m in pkgutil.walk_packages(mjx_revolve.__path__, "mjx_revolve.")]
MODULES = [name for name in FOUND if "._" not in name]


@pytest.mark.parametrize("name", MODULES)
def test_every_public_name_has_a_docstring(name):
    module = importlib.import_module(name)
    assert (module.__doc__ or "").strip()
    for key, value in vars(module).items():
        ours = getattr(value, "__module__", None) == module.__name__
        if (
            ours
            and not key.startswith("_")
            and (inspect.isfunction(value) or inspect.isclass(value))
        ):
            assert (value.__doc__ or "").strip(), key


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder of pages."""
    pytest.importorskip("pdoc", reason="the reference is made by pdoc")
    folder = tmp_path_factory.mktemp("docs")
    command = [sys.executable, str(ROOT / "docs" / "reference.py"), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, ""), done.stderr
    assert done.stdout.endswith(f"open {folder / 'index.html'}\n")
    return folder


@pytest.mark.slow
def test_every_module_and_every_promised_name_has_its_place(site):
    for name in MODULES:
        place = f"{name.replace('.', '/')}.html"
        text = (site / place).read_text()
        assert f'href="{"../" * name.count(".")}{place}"' in text  # in its own table of contents
    front = (site / "mjx_revolve.html").read_text()
    for name in mjx_revolve.__all__:
        assert f'<section id="{name}">' in front, name
        value = getattr(mjx_revolve, name)
        if inspect.isfunction(value):
            home = (site / f"{value.__module__.replace('.', '/')}.html").read_text()
            assert f'<section id="{name}">' in home


@pytest.mark.slow
def test_rooms_are_listed_in_the_order_in_which_they_are_imported(site):
    """Each room in the table of contents, with its idea; none imports from those behind it."""
    front = (site / "index.html").read_text()
    listed = re.findall(
        r'<p class="idea">\s*<a href="mjx_revolve/(\w+)\.html">.*?</a>\s*(\S)', front
    )
    rooms = [room for room, _ in listed]
    assert {*rooms} == {name.split(".")[1] for name in MODULES if name.count(".") > 1}
    for name in MODULES:
        room = name.split(".")[1]
        if room not in rooms:  # a command
            continue
        behind = rooms[rooms.index(room) + 1 :]
        code = inspect.getsource(importlib.import_module(name))
        for other in re.findall(r"^\s*(?:from|import) mjx_revolve\.(\w+)", code, re.MULTILINE):
            assert other not in behind, f"{name} imports from {other}"


@pytest.mark.slow
def test_every_text_is_a_page_and_links_lead_somewhere(site):
    pages = ["index", *(path.stem for path in (ROOT / "docs").glob("*.md"))]
    assert "tutorial" in pages
    for name in pages:
        path = site / f"{name}.html"
        text = re.sub(r"<script.*?</script>", "", path.read_text(), flags=re.DOTALL)
        for target in re.findall(r'(?:href|src)="([^"#]+)', text):
            if not target.startswith(("http", "data:")):
                assert (path.parent / target).is_file(), f"{name}: {target}"
    # Names of our texts and modules are links.
    assert '<a href="physics.html"><code>docs/physics.md</code></a>' in (
        (site / "index.html").read_text()
    )


@pytest.mark.slow
def test_nothing_is_fetched_from_elsewhere(site):
    for path in site.rglob("*.html"):
        assert not re.search(r'(?:src|rel="stylesheet" href)="http', path.read_text()), path.name
