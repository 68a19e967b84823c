"""The installed package: a wheel holds all that a checkout has, and works from any folder."""

import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

from mjx_revolve.numerics.runtime import source_hash

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[1]
SCRIPT = """
import mjx_revolve
from mjx_revolve import load_config, load_morphology, load_world
from mjx_revolve.numerics.runtime import describe_process, source_hash
print(mjx_revolve.__file__)
print(load_config("lake_swim").morphology)
print(load_config("smoke", ["morphology=snake"]).morphology)
print(load_morphology("spider").num_hinges, load_world("lake").density > 0)
print(source_hash(), describe_process()["git"])
"""


def run(folder, *command):
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [str(part) for part in command], cwd=folder, env=clean, capture_output=True, text=True,
        timeout=300,
    )  # fmt: skip
    return done.returncode, done.stdout + done.stderr


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel, built from a copy, so that the checkout stays clean."""
    folder = tmp_path_factory.mktemp("wheel")
    copy = folder / "source"
    copy.mkdir()
    for name in ("mjx_revolve", "configs", "morphologies"):
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "setup.py", "MANIFEST.in", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, copy / name)
    code, said = run(folder, sys.executable, "-m", "pip", "wheel", "--no-deps", "-w", folder, copy)
    if code and "No matching distribution found for setuptools" in said:
        pytest.skip("no package index to build with")
    assert code == 0, said
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """An environment that holds the wheel, and borrows the packages that it needs from this one."""
    folder = tmp_path_factory.mktemp("environment")
    code, said = run(folder, sys.executable, "-m", "venv", "--without-pip", folder)
    assert code == 0, said
    python = folder / "bin" / "python"
    install = ("pip", "--python", python, "install", "--no-deps", "--no-index", wheel)
    code, said = run(folder, sys.executable, "-m", *install)
    assert code == 0, said
    (site,) = folder.glob("lib/python*/site-packages")
    # Added by a .pth, a folder's own .pth files, an editable install's among them, do not count.
    (site / "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return folder


def test_a_wheel_holds_all_that_a_checkout_has(wheel):
    with zipfile.ZipFile(wheel) as file:
        held = set(file.namelist())
    expected = set()
    for folder, patterns in (
        (
            "mjx_revolve",
            ("*.py", "py.typed", "*.html", "*.js", "*.css", "*.jinja", "worlds/*.yaml"),
        ),
        ("configs", ("*",)),
        ("morphologies", ("*",)),
    ):
        for pattern in patterns:
            for path in (ROOT / folder).rglob(pattern):
                name = path.relative_to(ROOT).as_posix()
                expected.add(name if folder == "mjx_revolve" else f"mjx_revolve/{name}")
    assert len(expected) > 100
    assert not expected - held
    assert {name.partition("/")[0] for name in held} == {
        "mjx_revolve",
        f"{wheel.name[:17]}.dist-info",
    }


def test_shipped_names_work_from_any_folder(installed, tmp_path):
    python = installed / "bin" / "python"
    code, said = run(tmp_path, python, "-c", SCRIPT)
    assert code == 0, said
    where, config, other, facts, source = said.splitlines()
    assert Path(where).is_relative_to(installed)
    assert Path(config).is_relative_to(installed) and Path(config).name == "spider.yaml"
    assert Path(other).is_relative_to(installed) and Path(other).name == "snake.yaml"
    assert facts == "8 True"
    assert source == f"{source_hash()} None"


def test_commands_of_the_installed_package(installed, tmp_path):
    command = installed / "bin" / "mjx-revolve"
    code, said = run(tmp_path, command, "inspect", "spider")
    assert code == 0 and "hinge" in said, said
    code, said = run(tmp_path, command, "evolve", "lake_swimm")
    assert code == 2
    assert said.startswith("error: lake_swimm: expected a file, or one of auv_escape, ")
    assert "lake_target, smoke, which come with the package; found none\n" in said
    code, said = run(tmp_path, command, "dance")
    assert (code, said.count("\n")) == (2, 1)
    assert said.startswith("error: expected one of evolve, sweep, inspect, ")
    for name in ("replay", "report", "export", "viewer", "live"):
        code, said = run(tmp_path, installed / "bin" / "python", "-m", f"mjx_revolve.{name}", "-h")
        assert code == 0 and "usage" in said, said
    assert not list(tmp_path.iterdir())
