"""Faults of machine and disk, done to runs for real: what each costs, and what is said."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

import toys
from laboratory import ROOT, XLA_FLAGS
from mjx_revolve import evolve
from mjx_revolve.episodes.config import load_config
from mjx_revolve.evolution import memory
from mjx_revolve.evolution.run_folder import RunFolder  # noqa: F401  (the script names it)
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.errors import InputError


@pytest.fixture
def folder(tmp_path, monkeypatch):
    return toys.enter_folder(tmp_path, monkeypatch)


def run_main(*argv, at=0, do=lambda: None):
    """The command; something is done in one of its generations."""

    class Toy(toys.Quadratic):
        count = 0

        def evaluate(self, population, key):
            self.count += 1
            if self.count == at:
                do()
            return super().evaluate(population, key)

    return run_command(lambda argv: evolve.main(argv, lambda _: Toy(noise=0.1)), list(argv))


def genes(name):
    return Path(name, "champion", "genes.yaml").read_text()


# In a process with a small disk of its own. Its first line of output is what stands there if the
# system allows no such thing.
SCRIPT = """
import os, shutil, subprocess, sys
from pathlib import Path

def call(*words):
    subprocess.run([*words, "disk"], check=True)

Path("disk").mkdir()
call("mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs")
print("mounted", flush=True)
import test_faults as faults

def check(what, name, at, do, undo):
    code = faults.run_main("toy.yaml", "--out", f"disk/{name}", at=at, do=do)
    undo()
    newest = faults.RunFolder(Path("disk", name)).checkpoints()[0].stem
    again = faults.run_main("--resume", f"disk/{name}")
    same = faults.genes(f"disk/{name}") == faults.genes("whole")
    print(what, code, newest, again, same, flush=True)

def fill():
    with open("disk/rest", "wb", buffering=0) as file:
        while True:
            try:
                file.write(bytes(4096))
            except OSError:
                return

def forbid():  # a second mount over the first, in which a file is open to write
    call("mount", "--bind", "disk")
    call("mount", "-o", "remount,bind,ro")

assert faults.run_main("toy.yaml", "--out", "whole") == 0
check("FULL", "a", 4, fill, Path("disk/rest").unlink)
check("READ-ONLY", "b", 4, forbid, lambda: call("umount"))
"""


@pytest.mark.slow
def test_a_full_and_a_read_only_disk(folder):
    (folder / "script.py").write_text(SCRIPT)
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests"), str(ROOT / "tests" / "evolution")])
    if shutil.which("unshare") is None:
        pytest.skip("needs unshare, of util-linux")
    done = subprocess.run(
        ["unshare", "--map-root-user", "--mount", sys.executable, "script.py"], cwd=folder,
        capture_output=True, text=True, env=os.environ | XLA_FLAGS | {"PYTHONPATH": path},
    )  # fmt: skip
    if "mounted" not in done.stdout:
        pytest.skip(f"no disk of one's own here: {done.stderr.strip()[-80:]}")
    assert "FULL 1 generation_000002 0 True" in done.stdout, done.stdout + done.stderr
    assert "READ-ONLY 1 generation_000002 0 True" in done.stdout, done.stdout + done.stderr
    for words in ("No space left on device", "Read-only file system"):
        assert f"{words}\nthe last checkpoint, disk/" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_population_beyond_the_memory_is_refused_beforehand(folder, capsys):
    huge = "evolution.population_size=1000000000000"
    for more in ((), ("--set", "evolution.strategy=DifferentialEvolution")):
        assert run_main("toy.yaml", "--out", "run", "--set", huge, *more) == 2
        err = capsys.readouterr().err
        assert "--set evolution.population_size: expected at most " in err
        assert err.endswith(" GB of memory are free; found 1000000000000\n")
        assert not os.path.exists("run")


def test_the_largest_population_fits(tmp_path, folder, monkeypatch):
    (tmp_path / "proc").mkdir()
    (tmp_path / "proc" / "meminfo").write_text("MemTotal: 9 kB\nMemAvailable:    8000 kB\n")
    assert memory.free_memory(tmp_path) == 8_192_000
    group = tmp_path / "sys" / "fs" / "cgroup"
    group.mkdir(parents=True)
    (group / "memory.current").write_text("1000000\n")
    (group / "memory.max").write_text("max\n")
    assert memory.free_memory(tmp_path) == 8_192_000
    (group / "memory.max").write_text("5000000\n")
    assert memory.free_memory(tmp_path) == 4_000_000
    # What the kernel keeps of files it gives back.
    (group / "memory.stat").write_text("anon 5\ninactive_file 600000\nactive_file 100000\n")
    assert memory.free_memory(tmp_path) == 4_700_000
    monkeypatch.setattr(memory, "free_memory", lambda: 4_000_000)
    for strategy in ("SNES", "DE"):
        for size, fits in ((10**9, False), (None, True), (1, False)):
            if size == 10**9:
                with pytest.raises(ValueError, match="expected at most") as caught:
                    memory.check_memory(config_of(strategy, size), 5)
                most = int(str(caught.value).split("at most ")[1].split(",")[0])
            elif fits:
                memory.check_memory(config_of(strategy, most), 5)
            else:
                with pytest.raises(ValueError, match=f"at most {most},"):
                    memory.check_memory(config_of(strategy, most + 1), 5)


def test_bodies_beyond_the_memory_are_refused(folder, monkeypatch):
    toys.write_bodies_config(folder / "bodies.yaml")
    monkeypatch.setattr(memory, "free_memory", lambda: 10_000_000)
    memory.check_memory(load_config("bodies.yaml"), 5)
    for place in ("evolution.population_size", "bodies.selection.offspring"):
        with pytest.raises(InputError, match=f"{place}: expected at most [1-9]"):
            memory.check_memory(load_config("bodies.yaml", {place: 5000}), 5)


def config_of(strategy, size):
    """As much of a configuration as counts."""
    evolution = SimpleNamespace(strategy=strategy, population_size=size)
    return SimpleNamespace(bodies=None, origin=lambda place: "toy.yaml: ", evolution=evolution)
