"""A Dask cluster on the loopback, which the tests share, in the order in which they stand here."""

import os
import shutil
import subprocess
import sys

import pytest

import toys
from laboratory import ROOT, XLA_FLAGS, check_refused
from mjx_revolve import sweep
from mjx_revolve.episodes.config import load_config
from mjx_revolve.evolution import jobs
from mjx_revolve.evolution import run_folder as runs
from mjx_revolve.evolution.executor import make_executor
from mjx_revolve.evolution.jobs import Limits
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.errors import InputError
from toys import check_scores, contents, wait_for

distributed = pytest.importorskip("distributed", reason="the extra [cluster] is not installed")
dask = pytest.importorskip("dask")
pytestmark = pytest.mark.slow


class Dask:
    """A scheduler, and workers with a nanny each; processes of the system."""

    def __init__(self, folder):
        self.folder = folder
        self.file = folder / "scheduler.json"
        self.log = open(folder / "dask.log", "w+")  # noqa: SIM115
        self.processes = []
        ports = ("--host", "127.0.0.1", "--port", "0", "--dashboard-address", "127.0.0.1:0")
        self.scheduler = self.start("dask_scheduler", *ports)
        wait_for(self.file.exists)

    def start(self, program, *argv, package=ROOT):
        path = f"{package}{os.pathsep}{ROOT / 'tests'}"
        environment = os.environ | {"PYTHONPATH": path, "TOY_TROUBLE": str(self.folder / "order")}
        environment |= XLA_FLAGS
        module = f"distributed.cli.{program}"
        process = subprocess.Popen(
            [sys.executable, "-m", module, "--scheduler-file", str(self.file), *argv],
            cwd=self.folder, env=environment, stdout=self.log, stderr=self.log,
        )  # fmt: skip
        self.processes.append(process)
        return process

    def add_worker(self, **more):
        self.start("dask_worker", "--nthreads", "1", "--no-dashboard", **more)

    def close(self):
        for process in reversed(self.processes):
            process.terminate()  # a killed nanny would leave its worker behind
        for process in self.processes:
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self.log.close()


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    one = Dask(tmp_path_factory.mktemp("cluster"))
    yield one
    one.close()


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    return load_config(toys.write_config(tmp_path_factory.mktemp("config") / "toy.yaml"))


@pytest.fixture(scope="module")
def executor(cluster, config):
    """One worker to begin with."""
    cluster.add_worker()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TOY_TROUBLE", str(cluster.folder / "order"))
        patch.setattr(jobs, "LIMITS", Limits(block=4.0, tries=2))
        with make_executor(config, None, toys.make_troubled, str(cluster.file)) as executor:
            yield executor


def said(caplog):
    return [r.getMessage() for r in caplog.records if r.name.startswith("mjx_revolve")]


def test_workers_may_join_at_any_time(cluster, executor, caplog):
    check_scores(executor, 1)
    assert executor.num_workers == 1 and len(executor.workers) == 1
    cluster.add_worker()
    wait_for(lambda: executor.attend() or executor.num_workers == 2)
    check_scores(executor, 2)
    assert executor.describe() == {"cluster": str(cluster.file), "block": 4}
    assert [line for line in said(caplog) if "waiting" not in line] == []


@pytest.mark.usefixtures("executor", "no_pictures")
def test_a_sweep_has_the_workers_of_a_cluster(cluster, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    toys.write_config(tmp_path / "toy.yaml", population_size=8, generations=3)
    for options in (["--out", "here"], ["--out", "there", "--cluster", str(cluster.file)]):
        argv = ["toy.yaml", "--seeds", "2", *options]
        assert run_command(lambda argv: sweep.main(argv, toys.make_toy), argv) == 0
    for name in ("toy/seed_0", "toy/seed_1"):
        assert "cluster" in runs.RunFolder(tmp_path / "there" / name).info["workers"]
        assert contents(tmp_path / "here" / name) == contents(tmp_path / "there" / name)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("kind", ["kill", "hang", "raise"])
def test_a_lost_worker_costs_nothing(cluster, executor, kind, caplog):
    check_scores(executor, 1)  # a worker is there
    before = {*executor.workers}
    (cluster.folder / "order").write_text(kind)
    check_scores(executor, 3)
    assert not (cluster.folder / "order").exists()
    gone = before - {*executor.workers}
    assert len(gone) == (kind != "raise")
    assert [line for line in said(caplog) if "waiting" not in line] == [
        f"the worker at {address} is gone" for address in gone
    ]


def test_workers_of_another_source_are_refused(cluster, executor, config, caplog, tmp_path):
    shutil.copytree(ROOT / "mjx_revolve", tmp_path / "mjx_revolve")
    with open(tmp_path / "mjx_revolve" / "water" / "drag.py", "a") as file:
        file.write("\n# Another law.\n")
    known = {*executor.workers}
    cluster.add_worker(package=tmp_path)

    def refused():
        executor.attend()
        return [w for w in executor.workers.values() if w.refused]

    wait_for(refused)
    (worker,) = refused()
    assert worker.address not in known
    ours = executor.identity["mjx_revolve"]
    (line,) = [line for line in said(caplog) if "refused" in line]
    assert line.startswith(
        f"the worker at {worker.address} is refused: mjx_revolve: expected {ours} as the run has "
        "it; found "
    )
    check_scores(executor, 5)
    assert worker.blocks == []


@pytest.mark.parametrize(("place", "message"), [
    ("none.json", "--cluster: expected a scheduler file; found none at none.json"),
    ("nonsense://a:1", "--cluster nonsense://a:1: expected a Dask scheduler; found "),
])  # fmt: skip
def test_places_without_a_scheduler_are_one_line(config, place, message):
    check_refused(message, make_executor, config, None, toys.make_toy, place)


def test_without_dask_it_says_what_to_install(config, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"--cluster: expected .* \(pip install 'distributed"):
        make_executor(config, None, toys.make_toy, "tcp://127.0.0.1:1")
