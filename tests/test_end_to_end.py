"""The command line with the real robot: what a new user types, and what comes out."""

from __future__ import annotations

import csv
import subprocess
import sys

import numpy as np
import pytest
import yaml

from laboratory import ROOT
from toys import CLOCK


def evolve(*arguments, check=True):
    run = subprocess.run(
        [sys.executable, "-m", "mjx_revolve.evolve", *map(str, arguments)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=600,
    )
    if check:
        assert run.returncode == 0, run.stderr
    return run


def metrics(folder):
    with open(folder / "metrics.csv", newline="") as file:
        return [{k: v for k, v in row.items() if k not in CLOCK} for row in csv.DictReader(file)]


def champion(folder):
    genes = next((folder / "champion").glob("*genes*"))
    if genes.suffix == ".npz":
        return np.load(genes)["genes"]
    return np.array(yaml.safe_load(genes.read_text())["genes"])


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The folder of a run of four generations, from seed 0."""
    folder = tmp_path_factory.mktemp("runs") / "whole"
    evolve("configs/smoke.yaml", "--out", folder, "--set", "evolution.generations=4")
    return folder


@pytest.mark.slow
def test_a_stopped_run_resumed_equals_one_never_stopped(whole, tmp_path):
    parts = tmp_path / "parts"
    evolve("configs/smoke.yaml", "--out", parts, "--set", "evolution.generations=2")
    evolve("--resume", parts, "--set", "evolution.generations=4")
    assert metrics(parts) == metrics(whole)
    assert len(metrics(whole)) == 4
    np.testing.assert_array_equal(champion(parts), champion(whole))
    for name in ("config.yaml", "run.json", "fitness.png", "trajectory.png", "swim.png"):
        assert (whole / name).stat().st_size > 0
    for name in ("morphology.yaml", "robot.xml"):
        assert (whole / "champion" / name).stat().st_size > 0


@pytest.mark.slow
def test_another_seed_is_another_run(whole, tmp_path):
    other = tmp_path / "other"
    generations = "evolution.generations=1"
    evolve("configs/smoke.yaml", "--out", other, "--seed", 1, "--set", generations)
    assert len(metrics(other)) == 1
    assert metrics(other) != metrics(whole)[:1]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["configs/lake_swim.yaml", "--set", "world=laek"], "expected one of empty_underwater"),
        pytest.param(
            ["configs/lake_swim.yaml", "--set", "world.drag=facs"],
            "drag: expected one of faces",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            ["configs/lake_swim.yaml", "--set", "morphology=README.md"],
            "README.md",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            ["configs/lake_swim.yaml", "--set", "task.duration=-1"],
            "expected a number > 0",
            marks=pytest.mark.slow,
        ),
        (["configs/none.yaml"], "expected a file; found none"),
        pytest.param(
            ["configs/smoke.yaml", "--set", "task.type=crawl", "--set", "world.bed=off"],
            "a bed",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_wrong_input_is_one_line_and_code_2(arguments, message):
    run = evolve(*arguments, check=False)
    assert run.returncode == 2
    assert run.stderr.count("\n") == 1
    assert run.stderr.startswith("error: ") and message in run.stderr
    assert "Traceback" not in run.stderr
