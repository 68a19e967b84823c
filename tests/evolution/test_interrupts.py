"""Signals sent to real processes: what was finished is saved, and no run is begun by accident."""

import os
import re
import signal
import subprocess
import sys
import time

import pytest

import toys
from laboratory import ROOT, XLA_FLAGS
from mjx_revolve import evolve
from mjx_revolve.evolution.run_folder import RunFolder

SCRIPT = """
import os, sys
from mjx_revolve import evolve
from mjx_revolve.inputs.commands import run_command

def make_fitness(config):
    import jax, toys

    class Slow(toys.Quadratic):
        count = 0

        def evaluate(self, population, key):
            self.count += 1
            if self.count == int(os.environ["STUCK"]):  # in a compiled program, for an hour
                print("stuck", flush=True)
                jax.jit(lambda x: jax.lax.fori_loop(0, 10**12, lambda i, x: x + i, x))(1.0)
            return super().evaluate(population, key)

    return Slow(noise=0.1)

assert "numpy" not in sys.modules and "jax" not in sys.modules, "loaded before the settings"
sys.exit(run_command(lambda argv: evolve.main(argv, make_fitness), sys.argv[1:]))
"""
PATH = f"{ROOT}{os.pathsep}{ROOT / 'tests'}"


@pytest.fixture(autouse=True)
def heard():
    """Tests started under nohup or in the background ignore signals, as would what they start."""
    numbers = (signal.SIGINT, signal.SIGHUP, signal.SIGTERM)
    ignored = [n for n in numbers if signal.getsignal(n) == signal.SIG_IGN]
    for number in ignored:
        signal.signal(number, signal.SIG_DFL)
    yield
    for number in ignored:
        signal.signal(number, signal.SIG_IGN)


ENDING = """
import atexit, sys, time

from mjx_revolve.inputs.commands import run_command


def leave():
    print("leaving", flush=True)
    time.sleep(60)


atexit.register(leave)
sys.exit(run_command(lambda argv: 0))
"""


def test_ctrl_c_while_the_process_ends_is_no_traceback(tmp_path):
    (tmp_path / "mjx-revolve").write_text(ENDING)
    process = subprocess.Popen(
        [sys.executable, str(tmp_path / "mjx-revolve")], text=True, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, env=os.environ | {"PYTHONPATH": PATH},
    )  # fmt: skip
    toys.read_until(process, "leaving")
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=30)
    assert (process.returncode, err) == (130, "interrupted\n")


@pytest.fixture
def folder(tmp_path):
    """A configuration that saves nothing by itself."""
    toys.write_config(
        tmp_path / "toy.yaml", population_size=8, checkpoint_every=10**6, generations=10**6
    )
    (tmp_path / "script.py").write_text(SCRIPT)
    return tmp_path


def start(folder, stuck=0):
    """The command in a process of its own, stuck in a generation if asked for."""
    return subprocess.Popen(
        [sys.executable, "script.py", "toy.yaml", "--out", "run"], cwd=folder,
        text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=os.environ | XLA_FLAGS | {
            "PYTHONPATH": PATH, "STUCK": str(stuck),
        },
    )  # fmt: skip


def saved(folder):
    """The generation of the newest checkpoint, and how many lines the metrics have there."""
    run = RunFolder(folder / "run")
    checkpoint = run.load_checkpoint()
    assert not checkpoint.damaged
    lines = run.metrics_path.read_bytes()[: checkpoint.meta["metrics_position"]].splitlines()
    assert len(lines) == 1 + checkpoint.meta["generation"]
    return checkpoint.meta["generation"]


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGTERM])
def test_a_signal_saves(folder, number):
    process = start(folder)
    toys.read_until(process, "generation 1/")
    process.send_signal(number)
    out, _ = process.communicate(timeout=60)
    assert process.returncode == 128 + number, out
    assert int(re.search(r"stopped after generation (\d+); all of it", out)[1]) == saved(folder)


@pytest.mark.slow
def test_two_signals_at_once_save_even_inside_a_compiled_program(folder, monkeypatch):
    process = start(folder, 8)
    toys.read_until(process, "stuck")
    process.send_signal(signal.SIGINT)
    time.sleep(0.002)
    process.send_signal(signal.SIGTERM)
    out, _ = process.communicate(timeout=60)
    # Signals that are pending together may arrive in any order.
    assert process.returncode in (128 + signal.SIGINT, 128 + signal.SIGTERM), out
    assert "ended at once; what was finished is saved" in out
    assert saved(folder) == 7
    monkeypatch.chdir(folder)
    more = ["--resume", "run", "--set", "evolution.generations=9"]
    assert evolve.main(more, lambda config: toys.Quadratic(noise=0.1)) == 0
    assert RunFolder(folder / "run").load_metrics()["generation"].tolist() == list(range(1, 10))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "module"), [("evolve", "argparse"), ("viewer", "numpy._core.multiarray")]
)
def test_ctrl_c_while_importing_is_one_line(folder, command, module):
    process = subprocess.Popen(
        [sys.executable, "-X", "importtime", "-m", f"mjx_revolve.{command}", "toy.yaml"],
        cwd=folder, text=True, stderr=subprocess.PIPE, env=os.environ | {"PYTHONPATH": PATH},
    )  # fmt: skip
    words = []
    for line in process.stderr:
        if line.split("|")[-1].strip() == module:
            process.send_signal(signal.SIGINT)
        if not line.startswith("import time:"):
            words.append(line)
    assert process.wait(60) == 130, words
    assert "".join(words).startswith("interrupted")
    assert len(words) == 1
    assert not (folder / "runs").exists()
