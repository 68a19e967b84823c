"""The README, and the programs on the other pages, as they are written.

Quick: every program can be read from top to bottom without a name that nothing gave it, what it
imports exists, every command is one of ours, and its configurations, robots and settings are
accepted. Slow: the README's programs run, one after the other, as somebody who types them would.
"""

import ast
import builtins
import importlib
import importlib.util
import os
import re
import shlex
import subprocess
import sys
from itertools import pairwise

import pytest

from laboratory import ROOT, XLA_FLAGS
from mjx_revolve.episodes.config import load_config
from mjx_revolve.inputs.shipped import list_shipped

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
COMMAND = re.compile(r"python -m (mjx_revolve|experiments)\.(\w+)(.*)")


def blocks(page, language):
    found = BLOCK.findall(page.read_text(encoding="utf-8"))
    return [text for name, text in found if name == language]


def programs(page):
    return blocks(page, "python")


def commands(page):
    """Module and words of each command; lines that go on are put together, remarks left out."""
    for listing in blocks(page, ""):
        for line in listing.replace("\\\n", " ").splitlines():
            found = COMMAND.search(line)
            if found:
                yield f"{found[1]}.{found[2]}", shlex.split(found[3].partition(" # ")[0])


def given_by(tree):
    """Names that a program makes: by import, assignment, definition, loop or argument."""
    for node in ast.walk(tree):
        if isinstance(node, ast.alias):
            yield (node.asname or node.name).partition(".")[0]
        elif isinstance(node, ast.Name) and not isinstance(node.ctx, ast.Load):
            yield node.id
        elif isinstance(node, ast.FunctionDef | ast.ClassDef | ast.ExceptHandler) and node.name:
            yield node.name
        elif isinstance(node, ast.arg):
            yield node.arg


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_no_program_uses_a_name_that_nothing_gave_it(page):
    """The programs of a page are typed one after the other."""
    assert page.name != "README.md" or len(programs(page)) > 3  # they are found
    known = set(vars(builtins))
    for text in programs(page):
        tree = ast.parse(text)
        known |= {*given_by(tree)}
        used = {x.id for x in ast.walk(tree) if isinstance(x, ast.Name)}
        assert used <= known, f"{page.name}: {', '.join(used - known)} in:\n{text}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_is_ours_and_its_settings_are_taken(page):
    configs = list_shipped("configs")
    assert page.name != "README.md" or len([*commands(page)]) > 20  # they are found
    for module, words in commands(page):
        assert importlib.util.find_spec(module), module
        name = words[0] if words else ""
        if module.endswith((".evolve", ".sweep")) and name in configs:
            sets = [after for word, after in pairwise(words) if word == "--set"]
            first = [re.sub(r"^([^=]+=[^,\[{]*),.*", r"\1", s) for s in sets]  # of a grid
            load_config(name, first)


@pytest.mark.long
def test_the_readmes_programs_run():
    """Smaller, so that they take less."""
    text = "\n".join(programs(PAGES[0]))
    smaller = {
        "(64, fitness": "(16, fitness", '"popsize": 64': '"popsize": 16', "maxiter=10": "maxiter=1",
        "countiter < 10": "countiter < 2",
    }  # fmt: skip
    for long, short in smaller.items():
        assert long in text
        text = text.replace(long, short)
    mistake = next(line for line in text.splitlines() if "print(error)" in line)
    done = subprocess.run(
        [sys.executable, "-c", text], cwd=ROOT, capture_output=True, text=True,
        env={**os.environ, **XLA_FLAGS},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert mistake.partition("... ")[2] in done.stdout
