"""Workers: the same bits whatever their number, and whatever happens to them."""

import contextlib
import datetime
import json
import os
import pickle
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import jax
import numpy as np
import pytest

import toys
from laboratory import OAR, ROOT, XLA_FLAGS
from mjx_revolve import evolve as command
from mjx_revolve.episodes import evaluation
from mjx_revolve.episodes.config import load_config
from mjx_revolve.evolution import jobs
from mjx_revolve.evolution import run_folder as runs
from mjx_revolve.evolution.blocks import split_blocks
from mjx_revolve.evolution.executor import Executor, choose_workers, make_executor
from mjx_revolve.evolution.gene_search import GeneEvolution
from mjx_revolve.evolution.generations import run_generations
from mjx_revolve.evolution.jobs import Limits, WorkerError, make_job, open_job
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics import runtime
from mjx_revolve.water.world import load_world
from toys import check_scores, contents, wait_for

KEY = jax.random.key(1)
needs_proc = pytest.mark.skipif(not Path("/proc").is_dir(), reason="lists processes by /proc")
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module", autouse=True)
def same_flags():
    """Workers compile as this process does."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XLA_FLAGS", XLA_FLAGS["XLA_FLAGS"])
        yield


@pytest.fixture
def folder(tmp_path, monkeypatch, no_pictures):
    return toys.enter_folder(tmp_path, monkeypatch, population_size=10, checkpoint_every=4)


def toy_config(path, **evolution):
    return load_config(toys.write_config(path / "toy.yaml", **evolution))


def workers_of(pid):
    """Worker processes that a process has started and that have not ended."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        if entry.name.isdigit():
            with contextlib.suppress(OSError):
                state, parent = (entry / "stat").read_text().rpartition(")")[2].split()[:2]
                ours = b"mjx_revolve.evolution.processes" in (entry / "cmdline").read_bytes()
                if ours and int(parent) == pid and state != "Z":
                    found.append(int(entry.name))
    return sorted(found)


def is_alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def run_main(*argv, make_fitness=toys.make_toy):
    return run_command(lambda argv: command.main(argv, make_fitness), [str(a) for a in argv])


@pytest.mark.parametrize("size", [1, 4, 11])
def test_blocks_have_one_shape_and_are_padded_with_their_first_row(size):
    population = np.arange(2 * size, dtype=np.float32).reshape(size, 2)
    blocks = split_blocks(population, 4)
    assert [block.shape for block in blocks] == [(4, 2)] * -(-size // 4)
    assert np.array_equal(np.concatenate(blocks)[:size], population)
    assert all((row == blocks[-1][0]).all() for row in np.concatenate(blocks)[size:])


def test_there_are_workers_for_all_blocks(monkeypatch):
    """Of 24 bodies with two trials, 48 and 24 brains fill blocks of their own, 20 share them."""
    monkeypatch.setattr("mjx_revolve.numerics.runtime.usable_cores", lambda: 99)
    for tried, blocks in ((48, 48), (24, 24), (20, 15)):
        settings = [f"bodies.learning.population_size={tried}", "bodies.selection.offspring=24"]
        assert choose_workers(load_config("lake_coevolve", settings)) == blocks


def test_without_workers_or_blocks_a_pool_is_its_fitness():
    fitness = toys.Toy()
    population = np.random.default_rng(0).normal(size=(9, 5)).astype(np.float32)
    key = jax.random.key(3)
    with Executor(fitness, None) as executor:
        scores, measures = executor.evaluate(population, key)
        expected, expected_measures = fitness.evaluate(population, key)
        assert np.array_equal(scores, expected)
        assert np.array_equal(measures["distance_m"], expected_measures["distance_m"])
        assert np.array_equal(executor(population, key), scores)
    with pytest.raises(RuntimeError, match="expected an open executor"):
        executor.evaluate(population, key)
    with pytest.raises(InputError, match="workers: expected a whole number >= 1, or None; found 0"):
        make_executor("smoke", 0)


@pytest.fixture(scope="module")
def troubled(tmp_path_factory):
    """Two workers, and a file that says what happens to one of them."""
    folder = tmp_path_factory.mktemp("troubled")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TOY_TROUBLE", str(folder / "order"))
        patch.setattr(jobs, "LIMITS", Limits(block=15.0, tries=2))
        config = toy_config(folder, population_size=10, generations=6)
        with make_executor(config, 2, toys.make_troubled) as executor:
            executor(np.zeros((12, 5)), KEY)
            yield executor, folder / "order"


@pytest.mark.parametrize("size", [1, 5, 33])
def test_scores_do_not_depend_on_the_workers(troubled, size):
    check_scores(troubled[0], size, size)


def test_the_champion_does_not_depend_on_blocks(troubled):
    executor, order = troubled
    config = load_config(order.parent / "toy.yaml")
    whole = Executor(toys.Toy())
    evolutions = [GeneEvolution(config.evolution, each) for each in (executor, whole)]
    generations = config.evolution.generations
    searches = [list(run_generations(each, generations))[-1][0] for each in evolutions]
    assert np.array_equal(searches[0].elites, searches[1].elites)
    champions = [each.choose_champion(searches[0]) for each in evolutions]
    assert np.array_equal(champions[0].genes, champions[1].genes)
    assert champions[0].score == champions[1].score
    assert champions[0].origin == champions[1].origin


def test_workers_ignore_interrupts(troubled):
    executor, _ = troubled
    for worker in executor.workers:
        worker.process.send_signal(signal.SIGINT)
        worker.process.send_signal(signal.SIGTERM)
    before = workers_of(os.getpid())
    assert len(executor(np.zeros((12, 5)), jax.random.key(0))) == 12
    assert workers_of(os.getpid()) == before


def test_a_job_takes_all_files_along(tmp_path):
    (tmp_path / "sea.yaml").write_text("current_field: river.csv\n")
    (tmp_path / "river.csv").write_text("x,y,z,u,v,w\n0,0,0,1,0,0\n")
    (tmp_path / "grid.bin").write_bytes(b"grid")
    (tmp_path / "mine.py").write_text("def stay(track, settings):\n    return track.time[0]\n")
    config = load_config(
        toys.write_config(tmp_path / "toy.yaml"),
        [
            f"task.type={tmp_path / 'mine.py'}:stay",
            f"world={tmp_path / 'sea.yaml'}",
            f"task.params.grid={tmp_path / 'grid.bin'}",
            "task.params.gears={1: 0.5, since: 2026-11-29}",  # which JSON would change
        ],
    )
    job = make_job(config, read_back)
    for name in ("mine.py", "robot.yaml", "sea.yaml", "river.csv", "grid.bin"):
        (tmp_path / name).unlink()
    found = open_job(job, tmp_path / "scratch")
    assert found == ("id: robot\n", "def stay(track, settings):", "sea", b"grid")


def test_programs_do_not_depend_on_where_a_workers_files_lie(tmp_path, monkeypatch):
    """A worker's copies lie in another folder each time; a program is kept for the next run's."""
    made = []
    monkeypatch.setattr(evaluation, "StoredProgram", lambda fun, made_of, _: made.append(made_of))
    config = load_config("smoke")
    for name in ("one", "another"):
        open_job(make_job(config), tmp_path / name).keep(abs, "program")
    assert pickle.dumps(made[0]) == pickle.dumps(made[1])


def read_back(config):
    path, _, function = config.task.type.rpartition(":")
    assert function == "stay"
    world = load_world(config.world_name)
    assert world.current_field is not None
    code = Path(path).read_text().splitlines()[0]
    grid = Path(config.task.params["grid"]).read_bytes()
    assert config.task.params["gears"] == {1: 0.5, "since": datetime.date(2026, 11, 29)}
    return Path(config.morphology).read_text(), code, world.name, grid


def test_one_compiles_and_the_others_wait():
    entered, first_may_go = [], threading.Event()
    together = threading.Barrier(2, timeout=20)

    def first():
        with runtime.compile_lock("job", "fingerprint"):
            entered.append("first")
            assert first_may_go.wait(20)
            entered.append("first is done")

    def other():
        with runtime.compile_lock("job", "fingerprint"):
            entered.append("other")
            together.wait()  # both are inside at once

    threads = [threading.Thread(target=first)]
    threads[0].start()
    wait_for(lambda: entered)
    threads += [threading.Thread(target=other) for _ in range(2)]
    for thread in threads[1:]:
        thread.start()
    time.sleep(0.2)
    first_may_go.set()
    for thread in threads:
        thread.join(20)
    assert entered == ["first", "first is done", "other", "other"]
    assert not together.broken


def pids_of(executor):
    return [worker.process.pid for worker in executor.workers]


@pytest.mark.sampled(1)
@needs_proc
@pytest.mark.parametrize(("kind", "how"), [
    ("kill", "killed by SIGKILL"), ("stop", r"no answer for \d+ s"),
    ("exit", "exit code 3: out of luck"), ("raise", None),
])  # fmt: skip
def test_a_lost_worker_is_replaced_and_costs_nothing(troubled, kind, how, caplog):
    executor, order = troubled
    before = pids_of(executor)
    order.write_text(kind)
    check_scores(executor, 3)
    hit = int(next(order.parent.glob("order.*")).suffix[1:])
    order.with_suffix(f".{hit}").unlink()
    assert hit in before and is_alive(hit) == (kind == "raise")
    after = pids_of(executor)
    assert len(after) == 2 and {*after} <= {*workers_of(os.getpid())}
    assert (hit in after) == (kind == "raise")
    said = [record.getMessage() for record in caplog.records]
    if how is None:
        assert said == []
    else:
        assert len(said) == 1 and re.fullmatch(rf"a worker is replaced \({how}\)", said[0]), said


def test_a_block_that_kills_scores_worst_and_is_named(troubled, caplog):
    executor, _ = troubled
    population = np.random.default_rng(4).normal(size=(10, 5)).astype(np.float32)
    population[5] = 200.0
    scores, measures = executor.evaluate(population, KEY)
    alone, _ = Executor(toys.Toy(), 4).evaluate(population, KEY)
    assert np.isnan(scores[4:8]).all() and np.isnan(measures["distance_m"][4:8]).all()
    rest = [0, 1, 2, 3, 8, 9]
    assert scores[rest].tobytes() == alone[rest].tobytes()
    said = [record.getMessage() for record in caplog.records]
    assert said[:-1] == 2 * ["a worker is replaced (killed by SIGKILL)"]
    reason = "because their workers do (killed by SIGKILL)"
    assert said[-1] == f"4 individuals count as failed, {reason}"


def test_a_run_goes_on_when_workers_are_killed(folder, capsys, monkeypatch):
    monkeypatch.setenv("TOY_TROUBLE", str(folder / "order"))
    more = ("--set", "evolution.generations=40")
    others = {*workers_of(os.getpid())}
    killed = []

    def kill():
        wait_for((folder / "run" / "metrics.csv").exists)
        victim = min({*workers_of(os.getpid())} - others)
        os.kill(victim, signal.SIGKILL)
        killed.append(victim)

    killer = threading.Thread(target=kill)
    killer.start()
    argv = ("toy.yaml", "--out", "run", "--workers", 2)
    assert run_main(*argv, *more, make_fitness=toys.make_troubled) == 0
    killer.join()
    shown = capsys.readouterr()
    assert len(killed) == 1 and "a worker is replaced (killed by SIGKILL)" in shown.err
    assert " cores, 2 workers | " in next(x for x in shown.out.splitlines() if x.endswith("run"))
    assert run_main("toy.yaml", "--out", "whole", *more) == 0
    assert contents(folder / "run") == contents(folder / "whole")
    info = json.loads((folder / "run" / "run.json").read_text())["workers"]
    assert info == {"count": 2, "block": 4}
    host = runs.RunFolder(folder / "run").load_checkpoint().meta["host"]
    assert host == runs.RunFolder(folder / "whole").load_checkpoint().meta["host"]


def test_workers_that_cannot_be_built(folder, capsys, monkeypatch):
    monkeypatch.setenv("TOY_LEADER", str(os.getpid()))
    argv = ("toy.yaml", "--out", "run", "--workers", 2)
    assert run_main(*argv, make_fitness=toys.make_broken) == 1
    lines = capsys.readouterr().err.splitlines()
    why = r"\(RuntimeError: no such luck\)"
    assert re.fullmatch(rf"note: the run goes on with fewer workers, 1 {why}", lines[0])
    assert re.fullmatch(
        rf"error: no worker can be started {why}; the start, before any generation, is saved",
        lines[1],
    )
    assert re.fullmatch(r"resume: \S*python\S* -m mjx_revolve.evolve --resume run", lines[2])
    assert run_main("--resume", "run") == 0
    assert run_main("toy.yaml", "--out", "whole") == 0
    assert contents(folder / "run") == contents(folder / "whole")


def test_workers_of_another_program_score_nothing(tmp_path, caplog):
    with make_executor(toy_config(tmp_path), 2, toys.make_toy) as executor:
        executor.identity |= {"mjx_revolve": "abc"}
        found = r"mjx_revolve: expected abc as the run has it; found \w+"
        with pytest.raises(WorkerError, match=rf"no worker can be started \({found}\)"):
            executor(np.zeros((8, 5)), KEY)
    with pytest.raises(RuntimeError, match="expected an open executor"):
        executor(np.zeros((8, 5)), KEY)
    assert len(caplog.records) == 1


SCRIPT = """
import sys
import toys
from mjx_revolve import evolve
from mjx_revolve.inputs.commands import run_command

sys.exit(run_command(lambda argv: evolve.main(argv, toys.make_slow), sys.argv[1:]))
"""


def start(folder, *argv, script=SCRIPT, **environment):
    """The command in a process of its own, as from a terminal."""
    (folder / "script.py").write_text(script)
    path = f"{ROOT}{os.pathsep}{ROOT / 'tests'}"
    return subprocess.Popen(
        [sys.executable, str(folder / "script.py"), *map(str, argv)], cwd=folder, text=True,
        env=os.environ | {"PYTHONPATH": path} | environment, start_new_session=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip


LONG = ("toy.yaml", "--out", "run", "--workers", 2, "--set", "evolution.generations=5000")


def start_long(folder):
    """A run with two workers, past its first generation."""
    process = start(folder, *LONG)
    toys.read_until(process, "generation 1/")
    workers = workers_of(process.pid)
    assert len(workers) == 2
    return process, workers


@needs_proc
def test_ctrl_c_finishes_the_generation(folder):
    process, workers = start_long(folder)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    out, _ = process.communicate(timeout=120)
    assert process.returncode == 130, out
    assert "finishing what is under way; press Ctrl-C again to quit at once" in out
    assert re.search(r"resume: \S*python\S* -m mjx_revolve.evolve --resume run\n$", out)
    done = int(re.search(r"stopped after generation (\d+); all of it is saved", out)[1])
    assert not any(map(is_alive, workers))
    end = f"evolution.generations={done + 2}"
    assert run_main("--resume", "run", "--set", end) == 0
    assert run_main("toy.yaml", "--out", "whole", "--set", end) == 0
    assert contents(folder / "run") == contents(folder / "whole")


@needs_proc
def test_workers_do_not_outlive_their_leader(folder):
    process, workers = start_long(folder)
    os.kill(workers[0], signal.SIGSTOP)  # it is not asked
    process.kill()
    process.communicate(timeout=120)
    wait_for(lambda: not any(map(is_alive, workers)))


FORKING = """
import os, sys, time
import numpy as np
from mjx_revolve.evolution.executor import make_executor
from mjx_revolve.evolution.processes import can_fork, start_workers

assert can_fork()
import jax, toys
workers = start_workers(2, None, fork=True)
with make_executor("toy.yaml", 2, toys.make_toy, started=workers) as executor:
    population = np.random.default_rng(0).normal(size=(9, executor.num_genes))
    first = executor(population, jax.random.key(0))
    lost = workers[0]
    os.kill(lost.process.pid, 9)
    while lost in workers:
        assert np.array_equal(executor(population, jax.random.key(0)), first)
    alone = make_executor("toy.yaml", 1, toys.make_toy)
    assert np.array_equal(alone(population, jax.random.key(0)), first)
    print("pids", *(worker.process.pid for worker in workers), flush=True)
    time.sleep(60)
"""


@needs_proc
def test_forked_workers_score_are_replaced_and_end_with_their_leader(folder):
    process = start(folder, script=FORKING)
    pids = [int(pid) for pid in toys.read_until(process, "pids")[-1].split()[1:]]
    assert len(pids) == 2 and all(map(is_alive, pids))
    os.kill(pids[1], signal.SIGSTOP)  # it is not asked
    process.kill()
    process.communicate(timeout=120)
    wait_for(lambda: not any(map(is_alive, pids)))


def test_a_robot_does_not_depend_on_its_workers(tmp_path):
    path = toys.write_config(tmp_path / "knee.yaml", population_size=10)
    (tmp_path / "robot.yaml").write_text(OAR)
    config = load_config(path, ["task.trials=16", "task.duration=0.2", "task.settle=0.05"])
    found = []
    for count in (2, 1):
        with make_executor(config, count) as executor:
            genes = np.random.default_rng(0).normal(size=(10, executor.num_genes))
            found.append(executor.evaluate(np.float32(genes), KEY))
    (scores, measures), (alone, alone_measures) = found
    assert scores.tobytes() == alone.tobytes() and np.ptp(scores) > 0
    for name, values in measures.items():
        assert values.tobytes() == alone_measures[name].tobytes()
