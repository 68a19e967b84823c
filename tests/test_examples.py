"""Each script in `examples/` and each notebook runs as it stands; scripts stay short."""

import ast
import importlib.util
import json
import runpy
import sys
import types
from pathlib import Path

import pytest

from laboratory import ROOT

# What examples of other people's libraries need.
LIBRARIES = ("gymnasium", "stable_baselines3", "ribs", "qdax")
pytestmark = pytest.mark.usefixtures("quick_compiles")
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def long_ones(path):
    """What evolves, draws pages, differentiates or learns takes a quarter of a minute."""
    long = path.stem[:2] in ("03", "04", "05", "08", "10", "11", "12", "13", "16")
    return pytest.param(path, marks=pytest.mark.long if long else pytest.mark.slow)


@pytest.mark.parametrize("path", map(long_ones, EXAMPLES), ids=lambda path: path.stem)
def test_an_example_runs(path, tmp_path, monkeypatch, capsys):
    text = path.read_text(encoding="utf-8")
    needed = [name for name in LIBRARIES if f"import {name}" in text or f"from {name}" in text]
    missing = [name for name in needed if importlib.util.find_spec(name) is None]
    if missing:
        pytest.skip(f"not installed: {', '.join(missing)}")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(path)])
    try:
        runpy.run_path(str(path), run_name="__main__")
    except SystemExit as end:
        assert end.code in (0, None)
    said = capsys.readouterr().out
    assert said.strip() and "nan" not in said


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short_and_starts_with_what_it_shows(path):
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 55
    assert ast.get_docstring(ast.parse(text))


def show(path, **_):
    """What notebooks show pictures and pages with: they are there."""
    assert Path(path).stat().st_size > 10_000


@pytest.mark.long
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(path, tmp_path, monkeypatch, capsys):
    """Cell by cell in one namespace, with a stand-in for what only a notebook's program has."""
    monkeypatch.chdir(tmp_path)
    display = types.SimpleNamespace(Image=show, IFrame=show)
    monkeypatch.setitem(sys.modules, "IPython", types.SimpleNamespace(version_info=(9,)))
    monkeypatch.setitem(sys.modules, "IPython.display", display)
    names = {"__name__": "__main__"}
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), f"{path.name}: {cell['id']}", "exec"), names)
    assert [*tmp_path.glob("*.html")] and "nan" not in capsys.readouterr().out


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_stored_without_results(path):
    book = json.loads(path.read_text(encoding="utf-8"))
    assert (book["nbformat"], book["nbformat_minor"]) == (4, 5)
    for cell in book["cells"]:
        assert not cell.get("outputs") and cell.get("execution_count") is None
