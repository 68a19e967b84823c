"""The command line with the real robot: what a new user types, and what comes out."""

import os
import shutil
import subprocess
import sys

import mujoco
import numpy as np
import pytest
import yaml

from laboratory import ROOT, XLA_FLAGS
from mjx_revolve.episodes.champion import load_genes
from mjx_revolve.evolution.run_folder import RunFolder
from toys import contents


def command(name, *arguments, check=True):
    program = ("-c", UNDRAWN) if name == "evolve undrawn" else ("-m", f"mjx_revolve.{name}")
    run = subprocess.run(
        [sys.executable, *program, *map(str, arguments)],
        cwd=ROOT,
        env=os.environ | XLA_FLAGS,
        capture_output=True,
        text=True,
        timeout=1800,  # a guard against hanging, on a busy machine too
    )
    if check:
        assert run.returncode == 0, run.stderr
    return run


# The command without its pictures, which the shipped run has drawn.
UNDRAWN = """
import sys
from mjx_revolve import evolve
from mjx_revolve.inputs.commands import run_command

evolve._save_pictures = lambda *_: None
sys.exit(run_command(evolve.main))
"""


@pytest.fixture(scope="module")
def smoke(tmp_path_factory):
    """The folder of the shipped run, as it is."""
    folder = tmp_path_factory.mktemp("runs") / "smoke"
    command("evolve", "configs/smoke.yaml", "--out", folder)
    return folder


@pytest.mark.slow
def test_the_shipped_smoke_run_leaves_all_that_the_readme_promises(smoke):
    assert len(RunFolder(smoke).load_metrics()["generation"]) == 3
    assert np.all(np.isfinite(load_genes(smoke)))
    for name in ("config.yaml", "run.json", "fitness.png", "trajectory.png", "swim.png"):
        assert (smoke / name).stat().st_size > 0
    for name in ("morphology.yaml", "robot.xml"):
        assert (smoke / "champion" / name).stat().st_size > 0
    # In MuJoCo's own water, held up by what it displaces.
    model = mujoco.MjModel.from_xml_path(str(smoke / "champion" / "robot.xml"))
    assert model.opt.density > 990 and model.opt.viscosity > 0 and model.nkey == 1
    assert model.body_gravcomp.max() > 0


@pytest.mark.slow
def test_a_killed_run_resumed_equals_one_never_stopped(smoke, tmp_path):
    """In a process of its own, which finds the first one's programs in the cache.

    It is as if the first were killed between the last row of its metrics and the last checkpoint.
    """
    killed = tmp_path / "killed"
    shutil.copytree(smoke, killed)
    shutil.rmtree(killed / "champion")
    (killed / "checkpoints" / "generation_000003.npz").unlink()
    RunFolder(killed).update_info(finished=None, champion=None)
    assert "resuming" in command("evolve undrawn", "--resume", killed).stdout
    assert contents(killed) == contents(smoke)


@pytest.mark.long
def test_the_shipped_auv_holds_its_depth_as_its_file_says(tmp_path):
    """With a seed that used to learn nothing; without thrust it scores -1.7 body lengths."""
    command("evolve", "auv_hold_depth", "--seed", 4, "--out", tmp_path / "auv")
    assert -0.06 < yaml.safe_load((tmp_path / "auv/champion/genes.yaml").read_text())["score"] < 0


@pytest.mark.parametrize("setting", ["world=laek", "evolution.strategy=CMA"])
def test_wrong_input_is_one_line_and_code_2(setting):
    run = command("evolve", "configs/lake_swim.yaml", "--set", setting, check=False)
    assert run.returncode == 2 and not run.stdout  # before JAX is loaded
    assert run.stderr.count("\n") == 1
    assert run.stderr.startswith("error: ") and ": expected one of " in run.stderr
