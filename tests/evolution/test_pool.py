"""Workers: the same bits whatever their number, and a clear end whatever happens to them."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import jax
import numpy as np
import pytest

import toys
from laboratory import ROOT, XLA_FLAGS
from mjx_revolve import evolve as command
from mjx_revolve.episodes.config import load_config
from mjx_revolve.evolution import leader, messages, runs
from mjx_revolve.evolution.blocks import block_size, split_blocks
from mjx_revolve.evolution.crew import Crew, WorkerError
from mjx_revolve.evolution.fingerprints import program_versions
from mjx_revolve.evolution.leader import Leader, Limits
from mjx_revolve.evolution.loop import choose_champion, evolve
from mjx_revolve.evolution.messages import Channel, SecretError
from mjx_revolve.evolution.place import RANKS, read_place
from mjx_revolve.evolution.pool import Pool, make_pool
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.errors import InputError
from toys import CLOCK

SECRET = "correct horse"
KEY = jax.random.key(1)
needs_proc = pytest.mark.skipif(not Path("/proc").is_dir(), reason="lists processes by /proc")


@pytest.fixture(autouse=True)
def nobody_is_left():
    """No test leaves a worker process behind."""
    before = workers_of(os.getpid())
    yield
    assert workers_of(os.getpid()) == before


@pytest.fixture(autouse=True)
def own_settings(monkeypatch):
    """Workers compile as this process does, and nothing goes into the user's cache."""
    for name, value in XLA_FLAGS.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with a config, current."""
    monkeypatch.chdir(tmp_path)
    toys.write_config(tmp_path / "toy.yaml", population_size=10, checkpoint_every=4)
    return tmp_path


def toy_config(path, **evolution):
    return load_config(toys.write_config(path / "toy.yaml", **evolution))


def workers_of(pid):
    """Worker processes that a process has started and that have not ended."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        if entry.name.isdigit():
            with contextlib.suppress(OSError):
                state, parent = (entry / "stat").read_text().rpartition(")")[2].split()[:2]
                command_line = (entry / "cmdline").read_bytes()
                if (
                    int(parent) == pid
                    and state != "Z"
                    and b"mjx_revolve.evolution.worker" in command_line
                ):
                    found.append(int(entry.name))
    return sorted(found)


def is_alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def wait_for(condition, seconds=20.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def run_main(*argv, make_fitness=toys.make_toy):
    return run_command(lambda argv: command.main(argv, make_fitness), [str(a) for a in argv])


def contents(folder):
    """What must be the same for two runs of the same seed."""
    found = {"champion": (folder / "champion" / "genes.yaml").read_text()}
    for table in (
        runs.load_metrics(folder / "metrics.csv"),
        runs.Run(folder).load_checkpoint().arrays,
    ):
        found |= {name: a.tolist() for name, a in table.items() if name not in CLOCK}
    return found


def differences(one, other):
    """What of two runs differs, to the last bit."""
    one, other = contents(one), contents(other)
    return [(k, one.get(k), other.get(k)) for k in one | other if one.get(k) != other.get(k)]


# --- blocks ---


@pytest.mark.parametrize("size", [1, 3, 4, 5, 8, 11])
def test_blocks_have_one_shape_and_are_padded_with_their_first_row(size):
    population = np.arange(2 * size, dtype=np.float32).reshape(size, 2)
    blocks = split_blocks(population, 4)
    assert [block.shape for block in blocks] == [(4, 2)] * -(-size // 4)
    assert np.array_equal(np.concatenate(blocks)[:size], population)
    assert all((row == blocks[-1][0]).all() for row in np.concatenate(blocks)[size:])


@pytest.mark.parametrize(("trials", "size"), [(1, 64), (3, 21), (64, 1), (100, 1)])
def test_a_block_fills_a_chunk_of_lanes(trials, size):
    assert block_size(trials) == size


def test_without_workers_or_blocks_a_pool_is_its_fitness():
    fitness = toys.Toy()
    population = np.random.default_rng(0).normal(size=(9, 5)).astype(np.float32)
    key = jax.random.key(3)
    with Pool(fitness, None) as pool:
        scores, measures = pool.evaluate(population, key)
        expected, expected_measures = fitness.evaluate(population, key)
        assert np.array_equal(scores, expected)
        assert np.array_equal(measures["distance_m"], expected_measures["distance_m"])
        assert np.array_equal(pool(population, key), scores)
        assert pool.target is fitness.target  # whatever else it has
        assert not hasattr(pool, "replay")
    with pytest.raises(RuntimeError, match="expected an open pool"):
        pool.evaluate(population, key)


@pytest.fixture(scope="module")
def crowd(tmp_path_factory):
    """Three workers."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in XLA_FLAGS.items():
            patch.setenv(name, value)
        patch.setenv("JAX_COMPILATION_CACHE_DIR", "")
        config = toy_config(tmp_path_factory.mktemp("crowd"), population_size=10, generations=6)
        with make_pool(config, 3, toys.make_toy) as pool:
            yield config, pool


@pytest.mark.parametrize("size", [1, 4, 5, 10, 33])
def test_scores_do_not_depend_on_the_workers(crowd, size):
    _, pool = crowd
    population = np.random.default_rng(size).normal(size=(size, 5)).astype(np.float32)
    key = jax.random.key(size)
    scores, measures = pool.evaluate(population, key)
    alone, alone_measures = Pool(toys.Toy(), 4).evaluate(population, key)
    assert scores.dtype == np.float32 and scores.shape == (size,)
    assert scores.tobytes() == alone.tobytes()
    assert measures.keys() == alone_measures.keys() == {"distance_m"}
    assert measures["distance_m"].tobytes() == alone_measures["distance_m"].tobytes()


def test_workers_know_other_kinds_of_keys(crowd):
    _, pool = crowd
    population = np.random.default_rng(0).normal(size=(6, 5)).astype(np.float32)
    key = jax.random.key(7, impl="rbg")
    assert np.array_equal(pool(population, key), Pool(toys.Toy(), 4)(population, key))


def test_the_champion_does_not_depend_on_blocks(crowd):
    config, pool = crowd
    whole = toys.Toy()
    searches = [list(evolve(config.evolution, fitness))[-1][0] for fitness in (pool, whole)]
    assert np.array_equal(searches[0].elites, searches[1].elites)
    champions = [choose_champion(config.evolution, f, searches[0]) for f in (pool, whole)]
    assert np.array_equal(champions[0].genes, champions[1].genes)
    assert champions[0].score == champions[1].score
    assert champions[0].origin == champions[1].origin


@pytest.mark.parametrize("shape", [(5,), (0, 5), (3, 4)])
def test_a_population_of_another_shape_leaves_the_pool_as_it_is(crowd, shape):
    _, pool = crowd
    with pytest.raises(InputError, match=r"population: expected \[P, 5\]; found"):
        pool.evaluate(np.zeros(shape), jax.random.key(0))
    assert len(pool(np.zeros((2, 5)), jax.random.key(0))) == 2


def test_each_worker_has_a_core_of_its_own(crowd):
    _, pool = crowd
    if not hasattr(os, "sched_getaffinity"):
        pytest.skip("this system does not pin processes")
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) > 3:
        pytest.skip("fewer workers than cores are not pinned")
    processes = [worker.process for worker in pool._workplace._crew.workers]
    expected = [{cores[i % len(cores)]} for i in range(3)]
    pool(np.zeros((2, 5)), jax.random.key(0))
    deadline = time.monotonic() + 30  # until the last one's first block is done
    while (found := [os.sched_getaffinity(p.pid) for p in processes]) != expected:
        assert time.monotonic() < deadline, found
        time.sleep(0.05)
    for process, core in zip(processes, expected, strict=True):
        threads = [int(name) for name in os.listdir(f"/proc/{process.pid}/task")]
        assert all(os.sched_getaffinity(thread) == core for thread in threads)


def test_workers_ignore_interrupts(crowd):
    _, pool = crowd
    for worker in pool._workplace._crew.workers:
        worker.process.send_signal(signal.SIGINT)
        worker.process.send_signal(signal.SIGTERM)
    assert len(pool(np.zeros((12, 5)), jax.random.key(0))) == 12


def test_functions_without_a_name_cannot_have_workers(tmp_path):
    with pytest.raises(ValueError, match="expected a function that can be imported; found"):
        make_pool(toy_config(tmp_path), 2, lambda config: toys.Toy())


# --- trouble ---


def test_a_run_is_the_same_with_any_number_of_workers(folder, capsys):
    for count in (1, 2):
        assert run_main("toy.yaml", "--out", f"run{count}", "--workers", count) == 0
    lines = capsys.readouterr().out.splitlines()
    assert " cores, 2 workers | " in next(line for line in lines if line.endswith("run2"))
    assert differences(folder / "run1", folder / "run2") == []
    info = json.loads((folder / "run2" / "run.json").read_text())["workers"]
    assert (info["count"], info["block"]) == (2, 4)
    assert info["hosts"][0]["workers"] == 2
    host = runs.Run(folder / "run2").load_checkpoint().meta["host"]
    assert host == runs.Run(folder / "run1").load_checkpoint().meta["host"]


@needs_proc
@pytest.mark.parametrize(
    ("kind", "how"),
    [
        ("kill", r"died \(killed by SIGKILL\)"),
        ("stop", r"hangs \(no answer for \d s\)"),
        ("raise", r"failed \(FloatingPointError: all is lost\)"),
        ("exit", r"died \(exit code 3: out of luck\)"),
    ],
)
def test_trouble_costs_one_generation(folder, kind, how, capsys, monkeypatch):
    monkeypatch.setenv("TOY_TROUBLE", f"{kind}:{folder / 'trouble'}")
    monkeypatch.setattr(leader, "LIMITS", Limits(later=2.0))
    assert run_main("toy.yaml", "--out", "whole") == 0
    capsys.readouterr()
    argv = ("toy.yaml", "--out", "run", "--workers", 2)
    began = time.monotonic()
    assert run_main(*argv, make_fitness=toys.make_troubled) == 1
    assert time.monotonic() - began < 40
    assert not is_alive(int((folder / "trouble").read_text()))
    error, resume = capsys.readouterr().err.splitlines()
    found = re.fullmatch(rf"error: worker [12] of 2 {how}; generation (\d) is saved", error)
    assert found, error
    done = int(found[1])
    assert re.fullmatch(r"resume: \S*python\S* -m mjx_revolve.evolve --resume run", resume)
    assert (folder / "run" / "checkpoints" / f"generation_{done:06d}.npz").exists()
    assert "not yet judged" in (folder / "run" / "champion" / "genes.yaml").read_text()
    assert len(runs.load_metrics(folder / "run" / "metrics.csv")["best"]) == done
    more = ("--workers", 3) if kind == "kill" else ()
    assert run_main("--resume", "run", *more) == 0
    assert differences(folder / "run", folder / "whole") == []


def test_trouble_in_the_first_generation(folder, capsys, monkeypatch):
    monkeypatch.setenv("TOY_TROUBLE", f"kill:{folder / 'trouble'}")
    size = ("--set", "evolution.population_size=80")
    argv = ("toy.yaml", "--out", "run", *size, "--workers", 2)
    assert run_main(*argv, make_fitness=toys.make_troubled) == 1
    err = capsys.readouterr().err
    assert "died (killed by SIGKILL); the start, before any generation, is saved\nresume: " in err
    assert run_main("--resume", "run") == 0
    assert run_main("toy.yaml", "--out", "whole", *size) == 0
    assert differences(folder / "run", folder / "whole") == []


def test_workers_that_cannot_be_built(folder, capsys, monkeypatch):
    monkeypatch.setenv("TOY_LEADER", str(os.getpid()))
    argv = ("toy.yaml", "--out", "run", "--workers", 2)
    assert run_main(*argv, make_fitness=toys.make_broken) == 1
    err = capsys.readouterr().err
    assert re.fullmatch(
        r"error: worker [12] of 2 ended \(exit code 1: RuntimeError: no such luck\)\n", err
    )
    assert not (folder / "run").exists()


SCRIPT = """
import sys
import toys
from mjx_revolve import evolve
from mjx_revolve.inputs.commands import run_command

sys.exit(run_command(lambda argv: evolve.main(argv, toys.make_slow), sys.argv[1:]))
"""


def start(folder, *argv, **environment):
    """The command in a process of its own, as from a terminal."""
    (folder / "script.py").write_text(SCRIPT)
    path = f"{ROOT}{os.pathsep}{ROOT / 'tests'}"
    return subprocess.Popen(
        [sys.executable, str(folder / "script.py"), *map(str, argv)], cwd=folder, text=True,
        env=os.environ | {"PYTHONPATH": path} | environment, start_new_session=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip


def read_until(process, words):
    lines = []
    clock = threading.Timer(30.0, process.kill)
    clock.start()
    for line in process.stdout:
        lines.append(line)
        if words in line:
            clock.cancel()
            return lines
    raise AssertionError("".join(lines))


LONG = ("toy.yaml", "--out", "run", "--workers", 2, "--set", "evolution.generations=5000")


@needs_proc
def test_ctrl_c_finishes_the_generation(folder):
    process = start(folder, *LONG)
    read_until(process, "generation 1/")
    workers = workers_of(process.pid)
    assert len(workers) == 2
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    out, _ = process.communicate(timeout=30)
    assert process.returncode == 130, out
    done = int(re.search(r"stopped after generation (\d+); all of it is saved", out)[1])
    assert not any(map(is_alive, workers))
    end = f"evolution.generations={done + 2}"
    assert run_main("--resume", "run", "--set", end) == 0
    assert run_main("toy.yaml", "--out", "whole", "--set", end) == 0
    assert differences(folder / "run", folder / "whole") == []


@needs_proc
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT], ids=["kill", "two-interrupts"])
def test_workers_do_not_outlive_their_leader(folder, number):
    process = start(folder, *LONG)
    read_until(process, "generation 1/")
    workers = workers_of(process.pid)
    assert len(workers) == 2
    process.send_signal(number)
    if number == signal.SIGINT:
        time.sleep(0.01)
        process.send_signal(number)
    process.communicate(timeout=30)
    wait_for(lambda: not any(map(is_alive, workers)))


# --- the leader, with workers that are threads of this process ---


class FakeWorker(threading.Thread):
    """Speaks as a worker does; `act(channel, order, block)` is what it does with a block."""

    def __init__(self, address, secret=SECRET, act=None, **hello):
        super().__init__(daemon=True)
        self.address, self.secret, self.act = address, secret, act or answer
        self.hello = HELLO | hello
        self.seen, self.outcome = [], None
        self.start()

    def run(self):
        try:
            channel = Channel(socket.create_connection(self.address), 20.0)
            channel.prove_secret(self.secret.encode(), leads=False)
            channel.send_message(self.hello)
            reply, block = channel.receive_message()
            while reply["type"] == "block":
                self.seen.append(reply["block"])
                self.act(channel, reply, block)
                reply, block = channel.receive_message()
            self.outcome = reply
            channel.close()
        except (OSError, EOFError) as error:
            self.outcome = error


def answer(channel, order, block):
    scores = np.stack([block.sum(1), block.min(1)])
    channel.send_message({"type": "scores", "measures": ["least"]}, scores)


IDENTITY = {"versions": program_versions(), "settings_hash": "s", "model_hash": "m"}
HELLO = IDENTITY | {
    "type": "hello", "protocol": messages.PROTOCOL, "host": 1, "hosts": 2, "worker": 0,
    "workers": 1, "node": "node7", "cpu": "a cpu", "xla_flags": "", "cached": False,
}  # fmt: skip


@pytest.fixture
def lead():
    """Makes a leader without workers of its own, and closes it."""
    made = []

    def make(hosts=2, **limits):
        listener = socket.create_server(("127.0.0.1", 0))
        address = listener.getsockname()
        limits = Limits(**{"start": 5.0} | limits)
        made.append(Leader(listener, Crew(0, {}), SECRET.encode(), IDENTITY, hosts, limits))
        return made[-1], address

    yield make
    for one in made:
        one.close("the test is over")


def gather(one):
    one.gather(4, 5)


def blocks_of(count):
    return [np.full((4, 5), i, np.float32) for i in range(count)]


def test_whoever_is_free_gets_the_next_block(lead):
    one, address = lead()

    def slow(channel, order, block):
        time.sleep(0.15)
        answer(channel, order, block)

    workers = [
        FakeWorker(address, act=act, worker=i, workers=2) for i, act in [(0, slow), (1, None)]
    ]
    gather(one)
    for _ in range(2):
        results, names = one.score(blocks_of(12), KEY)
        assert [result[0].tolist() for result in results] == [[5.0 * i] * 4 for i in range(12)]
        assert names == ["least"]
    assert len(workers[0].seen) < 8 < len(workers[1].seen)
    assert len(workers[0].seen) + len(workers[1].seen) == 24 + 2  # each warmed up
    one.close()
    for worker in workers:
        worker.join(5.0)
        assert worker.outcome == {"type": "stop", "reason": ""}


def test_where_there_is_a_cache_one_compiles_for_all(lead):
    one, address = lead()
    order = []

    def note(name):
        def act(channel, message, block):
            order.append(name)
            answer(channel, message, block)

        return act

    for i in (1, 0):
        FakeWorker(address, act=note(i), worker=i, workers=2, cached=True)
    gather(one)

    def both_score():
        one.score(blocks_of(6), KEY)
        return order.count(1) > 1

    wait_for(both_score)
    assert order[0] == 0


@pytest.mark.parametrize(
    ("hello", "message"),
    [
        ({"versions": IDENTITY["versions"] | {"jaxlib": "0.1"}},
         rf"host 1 \(node7\): jaxlib: expected the leader's version {jax.lib.__version__}; "
         "found 0.1"),
        ({"versions": IDENTITY["versions"] | {"mjx_revolve": "abc"}},
         r"host 1 \(node7\): mjx_revolve: expected the leader's source \w+; found abc"),
        ({"settings_hash": "x"}, r"host 1 \(node7\): expected the leader's configuration \(the same"
         r" command line and the same files on each host\); found another"),
        ({"model_hash": "x"}, r"host 1 \(node7\): expected the leader's robot and world"),
        ({"hosts": 3}, r"host 1 \(node7\): --hosts: expected 2 as on host 0; found 3"),
        ({"protocol": 99}, "expected workers of the leader's version of mjx_revolve"),
        ({"host": 5}, r"host 5 \(node7\): --host-index: expected 0 to 1; found 5"),
    ],
)  # fmt: skip
def test_workers_of_another_run_are_refused_on_both_sides(lead, hello, message):
    one, address = lead()
    worker = FakeWorker(address, **hello)
    with pytest.raises(InputError, match=message) as caught:
        gather(one)
    worker.join(5.0)
    assert worker.outcome == {"type": "refused", "reason": str(caught.value)}
    assert "\n" not in str(caught.value)


def test_an_index_twice(lead):
    one, address = lead(hosts=3)
    for _ in range(2):
        FakeWorker(address, hosts=3)
    with pytest.raises(InputError, match="--host-index: expected each host once; found 1 twice"):
        gather(one)


def test_strangers_are_noted_and_change_nothing(lead, caplog, monkeypatch):
    monkeypatch.setattr(leader, "_HANDSHAKE", 0.3)
    one, address = lead()
    liar = FakeWorker(address, secret="another one")
    wait_for(lambda: one._attend() or not liar.is_alive())
    with socket.create_connection(address) as silent, socket.create_connection(address) as loud:
        loud.sendall(b"GET / HTTP/1.1\r\n" + 100 * b"\r\n")
        worker = FakeWorker(address)
        gather(one)
        assert silent.fileno() and one.score(blocks_of(2), KEY)
    said = [record.getMessage() for record in caplog.records]
    assert "refused a connection from 127.0.0.1: it has another MJX_REVOLVE_SECRET" in said
    assert said.count("refused a connection from 127.0.0.1: no worker of ours") == 2
    assert len(said) == 3
    assert isinstance(liar.outcome, SecretError)
    assert worker.outcome is None


def test_a_leader_must_know_the_secret_too():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        ours = socket.create_connection(listener.getsockname())
        theirs, _ = listener.accept()
    with Channel(theirs, 5.0) as impostor, Channel(ours, 5.0) as worker:
        for _ in ("a number", "a proof"):
            impostor.send_bytes(bytes(32))
        with pytest.raises(SecretError):
            worker.prove_secret(SECRET.encode(), leads=False)


@pytest.mark.parametrize(
    ("count", "missing"),
    [(0, "host 1, host 2 missing"), (1, "2 of 3 workers of host 1, host 2 missing")],
)
def test_hosts_that_do_not_come(lead, count, missing):
    one, address = lead(hosts=3, start=0.6)
    for i in range(count):
        FakeWorker(address, worker=i, workers=3, hosts=3)
    with pytest.raises(WorkerError, match=f"expected all workers within 1 s; found {missing}"):
        gather(one)


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda channel, order, block: time.sleep(9), r"hangs \(no answer for \d s\)"),
        (lambda channel, order, block: channel.close(), r"died \(its connection closed\)"),
        (lambda channel, order, block: os.write(channel.fileno(), b"\0\0"),
         "hangs in the middle of"),
        (lambda channel, order, block: os.write(channel.fileno(), 8 * b"\x7f"),
         r"died \(bad message length\)"),
        (lambda channel, order, block: channel.send_bytes(b"hello"), r"died \(expected one of our"),
        (lambda channel, order, block: channel.send_message({"type": "failed", "reason": "no"}),
         r"failed \(no\)"),
    ],
)  # fmt: skip
def test_whatever_a_worker_does_the_leader_goes_on(lead, act, message, monkeypatch):
    monkeypatch.setattr(leader, "_MESSAGE", 0.5)
    one, address = lead(later=1.0, factor=2.0)
    FakeWorker(address, act=lambda *args: (answer if args[1]["block"] == 0 else act)(*args))
    gather(one)
    with pytest.raises(WorkerError, match=rf"worker 1 of 1 of host 1 \(node7\) {message}"):
        one.score(blocks_of(2), KEY)


def test_a_slow_block_is_no_hang(lead):
    one, address = lead(later=0.3, factor=50.0)

    def act(channel, order, block):
        time.sleep({0: 0.6, 9: 0.8}.get(order["block"], 0.1))
        answer(channel, order, block)

    FakeWorker(address, act=act)
    gather(one)
    assert len(one.score(blocks_of(9), KEY)[0]) == 9


# --- several hosts ---


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as found:
        return found.getsockname()[1]


def on_hosts(port, index, hosts=2):
    return ("--hosts", hosts, "--coordinator", f"localhost:{port}", "--host-index", index)


@needs_proc
def test_two_hosts_are_one_run(folder):
    port = free_port()
    more = {"MJX_REVOLVE_SECRET": SECRET}
    helper = start(folder, "toy.yaml", "--workers", 2, *on_hosts(port, 1), **more)
    head = start(folder, "toy.yaml", "--out", "run", "--workers", 1, *on_hosts(port, 0), **more)
    out, _ = head.communicate(timeout=60)
    told, _ = helper.communicate(timeout=10)
    assert (head.returncode, helper.returncode) == (0, 0), out + told
    assert f"host 1 of 2: 2 workers for the leader at localhost:{port}\n" == told
    assert " cores, 3 workers on 2 hosts | run\n" in out
    assert run_main("toy.yaml", "--out", "whole") == 0
    assert differences(folder / "run", folder / "whole") == []


@needs_proc
def test_a_host_that_is_lost_ends_the_run_everywhere(folder):
    port = free_port()
    more = {"MJX_REVOLVE_SECRET": SECRET}
    helper = start(folder, *LONG[:1], "--workers", 2, *on_hosts(port, 1), *LONG[-2:], **more)
    head = start(folder, *LONG, *on_hosts(port, 0), **more)
    read_until(head, "generation 1/")
    one, two = workers_of(helper.pid)
    os.kill(one, signal.SIGKILL)
    out, _ = head.communicate(timeout=30)
    told, _ = helper.communicate(timeout=30)
    assert (head.returncode, helper.returncode) == (1, 1), out + told
    assert re.search(
        r"error: worker [12] of 2 of host 1 \(.+\) died \(.*\); generation \d+ is saved\nresume: ",
        out,
    )
    assert re.search(r"error: worker [12] of 2 died \(killed by SIGKILL\)\n$", told)
    assert not is_alive(two)


@needs_proc
def test_a_lost_leader_is_noticed(folder):
    port = free_port()
    more = {"MJX_REVOLVE_SECRET": SECRET}
    helper = start(folder, *LONG[:1], "--workers", 1, *on_hosts(port, 1), *LONG[-2:], **more)
    head = start(folder, *LONG, *on_hosts(port, 0), **more)
    read_until(head, "generation 1/")
    head.kill()
    head.communicate(timeout=10)
    told, _ = helper.communicate(timeout=30)
    assert helper.returncode == 1
    assert re.search(rf"error: the leader at localhost:{port} is gone", told)


def test_a_host_with_another_configuration(folder, capsys, monkeypatch):
    """The leader lives here."""
    port = free_port()
    monkeypatch.setenv("MJX_REVOLVE_SECRET", SECRET)
    other = start(folder, "toy.yaml", "--workers", 1, "--seed", 9, *on_hosts(port, 1))
    assert run_main("toy.yaml", "--out", "run", "--workers", 1, *on_hosts(port, 0)) == 2
    error = capsys.readouterr().err
    assert re.fullmatch(r"error: host 1 \(.+\): expected the leader's configuration .+\n", error)
    told, _ = other.communicate(timeout=30)
    assert other.returncode == 2
    assert told.splitlines()[1:] == [error.strip()]
    assert not (folder / "run").exists()


def test_a_host_with_another_secret(folder, lead):
    one, address = lead()
    monkey = {"MJX_REVOLVE_SECRET": "another one"}
    liar = start(folder, "toy.yaml", "--workers", 2, *on_hosts(address[1], 1), **monkey)

    def refused():
        one._attend()
        return liar.poll() is not None

    wait_for(refused, 30.0)
    told, _ = liar.communicate()
    assert liar.returncode == 2
    assert told.splitlines()[1:] == [
        f"error: MJX_REVOLVE_SECRET: expected the secret of the leader at localhost:{address[1]}; "
        "found another"
    ]


def test_a_launcher_tells_the_index():
    for name in ("SLURM_PROCID", "OMPI_COMM_WORLD_RANK", "PMI_RANK"):
        place = read_place(3, "node1:7777", None, {name: "2", "MJX_REVOLVE_SECRET": SECRET})
        assert (place.hosts, place.index, place.address) == (3, 2, ("node1", 7777))
        assert SECRET not in repr(place)
    environment = {"SLURM_PROCID": "2", "MJX_REVOLVE_SECRET": SECRET}
    place = read_place(3, "[::1]:80", "1", environment)
    assert (place.index, place.address) == (1, ("::1", 80))


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--workers", "0"], "--workers: expected a whole number >= 1; found '0'"),
        (["--workers", "two"], "--workers: expected a whole number >= 1; found 'two'"),
        (["--workers", "1.5"], "--workers: expected a whole number >= 1; found '1.5'"),
        (["--hosts", "2"], "--hosts: expected --coordinator HOST:PORT beside it; found none"),
        (["--hosts", "0", "--coordinator", "a:1"], "--hosts: expected a whole number >= 1"),
        (["--coordinator", "a:1"], "--coordinator a:1: expected --hosts N beside it; found none"),
        (["--host-index", "1"], "--host-index 1: expected --hosts N beside it; found none"),
        (["--hosts", "2", "--coordinator", "node1"],
         "--coordinator: expected HOST:PORT; found 'node1'"),
        (["--hosts", "2", "--coordinator", "node1:70000"], "--coordinator: expected HOST:PORT"),
        (["--hosts", "2", "--coordinator", "node1:77"],
         "--host-index: expected a number from 0 to 1, or one of SLURM_PROCID, "
         "OMPI_COMM_WORLD_RANK, PMI_RANK in the environment; found none"),
        ([*on_hosts(77, 2)], "--host-index: expected a whole number from 0 to 1; found '2'"),
        (["--resume", "none", *on_hosts(77, 1)],
         "--resume none: expected the run folder, or CONFIG beside it, on each host; found nei"),
        (["none.yaml", *on_hosts(77, 1)], "none.yaml: expected a file; found none"),
        ([*on_hosts(77, 1)], "expected a CONFIG, or --resume DIR; found neither"),
    ],
)  # fmt: skip
def test_wrong_arguments_are_one_line(folder, argv, message, capsys, monkeypatch):
    monkeypatch.setenv("MJX_REVOLVE_SECRET", SECRET)
    for name in RANKS:
        monkeypatch.delenv(name, raising=False)
    config = (
        [] if {"none.yaml", "--resume"} & set(argv) or argv == [*on_hosts(77, 1)] else ["toy.yaml"]
    )
    assert run_main(*config, *argv) == 2
    err = capsys.readouterr().err
    assert err.startswith("error: " + message)
    assert err.count("\n") == 1
    assert not (folder / "runs").exists()


@pytest.mark.parametrize(("secret", "found"), [("", "none"), ("short", "a shorter one")])
def test_several_hosts_need_a_secret(folder, secret, found, capsys, monkeypatch):
    monkeypatch.setenv("MJX_REVOLVE_SECRET", secret)
    assert run_main("toy.yaml", *on_hosts(77, 0)) == 2
    err = capsys.readouterr().err
    assert err.startswith("error: MJX_REVOLVE_SECRET: expected a secret of 8 or more characters")
    assert err.endswith(f"found {found}\n")


def test_a_port_that_is_taken(folder, capsys, monkeypatch):
    monkeypatch.setenv("MJX_REVOLVE_SECRET", SECRET)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        argv = ("toy.yaml", "--workers", 1, *on_hosts(port, 0))
        assert run_main(*argv) == 2
    assert capsys.readouterr().err == (
        f"error: --coordinator localhost:{port}: expected a free port of this host; found: Address "
        "already in use\n"
    )


def test_a_leader_that_never_listens(monkeypatch):
    from mjx_revolve.evolution import worker

    with pytest.raises(InputError, match=r"--coordinator 127.0.0.1:\d+: expected the run's leader"):
        worker._connect(("127.0.0.1", free_port()), 0.3)


def test_an_accelerator_takes_the_whole_population(tmp_path, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert block_size(1) is None
    with pytest.raises(InputError, match="--workers: expected JAX to run on the CPU"):
        make_pool(toy_config(tmp_path), 2, toys.make_toy)


def test_workers_are_not_started_by_hand():
    done = subprocess.run(
        [sys.executable, "-m", "mjx_revolve.evolution.worker"], cwd=ROOT, stdin=subprocess.DEVNULL,
        capture_output=True, text=True, timeout=30,
    )  # fmt: skip
    assert done.returncode == 2
    assert done.stderr == "error: expected to be started by mjx_revolve.evolve\n"


# --- the real robot ---


@pytest.mark.slow
def test_the_spider_does_not_depend_on_its_workers(tmp_path):
    """70 individuals of 3 episodes: four blocks of 21, the last of which is padded."""
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path / "cache")}
    for name in ("JAX_COMPILATION_CACHE_DIR", *XLA_FLAGS):  # as users run it
        environment.pop(name)
    for count in (2, 1):
        settings = ("population_size=70", "generations=2")
        argv = [f"--set=evolution.{setting}" for setting in settings]
        argv += ["--set=task.trials=3", "--set=task.duration=1", f"--workers={count}"]
        done = subprocess.run(
            [sys.executable, "-m", "mjx_revolve.evolve", "configs/smoke.yaml", *argv,
             "--out", str(tmp_path / str(count))],
            cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert done.stderr == ""
    assert differences(tmp_path / "1", tmp_path / "2") == []
