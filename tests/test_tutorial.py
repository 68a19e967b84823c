"""The tutorial works as it is written: every file, command and program of it, in its order.

Blocks of `docs/tutorial.md` are told apart by what they say they are:

    `mine/x.yaml`:      and a block of any language: a file that the reader writes
    ```                 commands, one to a line
    ```python           a program
    ```text             lines that the command or program before prints, numbers apart

They are run literally, in an empty folder. `.venv/bin/python` is there a script that starts the
Python that runs the tests; and XLA compiles by its older emitters, which takes half of the time.
"""

import os
import re
import subprocess
import sys
from typing import NamedTuple

import pytest
import yaml

from laboratory import ROOT, check_error
from mjx_revolve import evolve
from mjx_revolve.episodes.config import load_config
from mjx_revolve.episodes.tasks import score_unit
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.numerics.xla import OLD_EMITTERS
from mjx_revolve.view.report.data import read_run

TEXT = (ROOT / "docs" / "tutorial.md").read_text()
QUICKLY = " ".join(f"--{name}=false" for name in OLD_EMITTERS)
BLOCK = re.compile(r"(?:^`([^`\n]+)`:\n\n)?^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


class Block(NamedTuple):
    path: str  # of a file; else ""
    language: str
    body: str


BLOCKS = [Block(*(x or "" for x in match.groups())) for match in BLOCK.finditer(TEXT)]


def plain_text():
    """The text without its blocks."""
    return BLOCK.sub("", TEXT)


def as_pattern(line):
    """A line of output whose numbers may be others, and that may go on."""
    parts = [" ".join(part.split()) for part in NUMBER.split(line)]
    return rf"\s*{NUMBER.pattern}\s*".join(re.escape(part) for part in parts)


def test_every_block_is_of_a_known_kind():
    assert len(BLOCKS) == TEXT.count("\n```") / 2
    assert {b.language for b in BLOCKS if not b.path} == {"", "python", "text"}
    for block in BLOCKS:
        if block.path:
            assert block.path.startswith("mine/")
        elif not block.language:
            lines = block.body.splitlines()
            assert lines and all(line.startswith(".venv/bin/python ") for line in lines)


def test_what_the_text_refers_to_exists():
    for name in re.findall(r"`((?:docs|tests|mjx_revolve|configs)/[\w./]+)`", plain_text()):
        assert (ROOT / name).is_file(), name


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    """A folder in which everything was done, and what was printed: (folder, [(block, output)])."""
    folder = tmp_path_factory.mktemp("tutorial")
    return folder, follow(BLOCKS, folder)


@pytest.fixture
def files(tmp_path):
    """A folder with the files that the reader writes; no command was run."""
    follow([block for block in BLOCKS if block.path], tmp_path)
    return tmp_path


def follow(blocks, folder):
    """Does all that blocks say in a folder; what was printed, [(block, output)]."""
    python = folder / ".venv" / "bin" / "python"
    python.parent.mkdir(parents=True)
    python.write_text(f'#!/bin/sh\nexec "{sys.executable}" "$@"\n')
    python.chmod(0o755)
    place = {**os.environ, "PYTHONPATH": str(ROOT), "XLA_FLAGS": QUICKLY, "JAX_PLATFORMS": "cpu"}
    printed = []

    def run(words):
        done = subprocess.run(words, cwd=folder, env=place, capture_output=True, text=True)
        assert done.returncode == 0, f"{words}: {done.returncode}\n{done.stdout}{done.stderr}"
        assert "Traceback" not in done.stderr and "arning" not in done.stderr, done.stderr
        return done.stdout

    output = ""
    for block in blocks:
        if block.path:
            path = folder / block.path
            path.parent.mkdir(exist_ok=True)
            path.write_text(block.body)
        elif block.language == "python":
            output = run([python, "-c", block.body])
        elif block.language == "text":
            printed.append((block, output))
        else:
            output = "".join(run(["/bin/sh", "-c", line]) for line in block.body.splitlines())
    return printed


@pytest.mark.long
def test_it_prints_what_the_text_says(desk):
    _, printed = desk
    assert len(printed) == sum(block.language == "text" for block in BLOCKS)
    for block, output in printed:
        found = " ".join(output.split())
        place = 0
        for line in block.body.splitlines():
            match = re.compile(as_pattern(line)).search(found, place)
            assert match, f"{line!r} is not in:\n{output}"
            place = match.end()


@pytest.mark.long
def test_it_writes_what_the_text_says(desk):
    folder, _ = desk
    names = set(re.findall(r"`((?:mine|runs)/[\w./]+)`", plain_text()))
    assert len(names) > 15
    for name in names:
        path = folder / name
        assert path.is_dir() if name.endswith("/") else path.is_file(), name


@pytest.mark.long
def test_numbers_are_about_those_of_the_text(desk):
    """Masses and counts to the digit; scores as far as few generations and other CPUs give them."""
    folder, printed = desk
    for block, output in printed:
        for line in block.body.splitlines():
            if line.startswith(("champion", "generation", "joints held")):
                continue
            assert " ".join(line.split()) in " ".join(output.split()), line
    swim, stay, wave = (read_run(folder / "runs" / name) for name in ("swim", "stay", "wave"))
    for record in (swim, stay, wave):
        assert record.problems == []
    assert 0.065 < swim.champion["score"] < 0.095
    # A robot that does nothing comes to -0.27.
    for record in (stay, wave):
        assert -0.21 < record.champion["score"] < -0.12
        assert record.unit == "body lengths"
    assert score_unit(str(folder / "mine" / "tasks.py") + ":stay") == "body lengths"
    [(page, climb)] = [
        (b.body, output) for b, output in printed if b.body.startswith("joints held")
    ]
    assert -0.35 < float(re.search(r"still: (-[\d.]+)", climb)[1]) < -0.22
    means, shown = ([float(x) for x in re.findall(r"mean (-[\d.]+)", s)] for s in (climb, page))
    assert len(means) == 4 and means == pytest.approx(shown, abs=0.03)
    assert float(re.findall(r"best (-[\d.]+)", climb)[-1]) > -0.23
    assert "generation 30:" in climb


def test_the_settings_that_it_proposes_exist(files, monkeypatch):
    """Each `--set` in the text, and each line of YAML for the world."""
    monkeypatch.chdir(files)
    settings = re.findall(r"--set (\S+?=[^\s`]+)", plain_text())
    assert len(settings) >= 5
    for setting in settings:
        load_config("mine/swim.yaml", [setting])
    from mjx_revolve import load_world

    proposed = re.findall(r"`((?:gust|bed): \{[^`]+\})`", plain_text())
    assert len(proposed) == 2
    for text in proposed:
        load_world("mine/sea.yaml", **yaml.safe_load(text))


@pytest.mark.slow
def test_the_mistake_that_it_mentions_is_one_line(files, monkeypatch, capsys):
    monkeypatch.chdir(files)
    own = (files / "mine" / "tasks.py").read_text()
    (files / "mine" / "slip.py").write_text(own.replace("track.position -", "track.positions -"))
    argv = ["mine/stay.yaml", "--set", "task.type=mine/slip.py:stay", "--workers", "1"]
    assert run_command(evolve.main, argv) == 2
    check_error(capsys.readouterr(), "mine/slip.py: line 6: expected stay to")
