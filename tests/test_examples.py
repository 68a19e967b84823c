"""Each script in `examples/` runs as it stands, imports public names only, and stays short."""

from __future__ import annotations

import ast
import importlib.util
import runpy
import sys

import pytest

from laboratory import ROOT

# What examples of other people's libraries need.
LIBRARIES = ("gymnasium", "stable_baselines3", "ribs", "qdax")
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


@pytest.mark.slow
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
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
