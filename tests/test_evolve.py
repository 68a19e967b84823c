"""The command line, on fitnesses that cost nothing: runs, stops, resumes, mistakes, TensorBoard."""

import errno
import json
import re
import shutil
import struct

import numpy as np
import pytest

import toys
from laboratory import check_error
from mjx_revolve import evolve as command
from mjx_revolve.episodes.champion import load_genes
from mjx_revolve.evolution import run as beginning
from mjx_revolve.evolution import run_folder as runs
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.view import results
from toys import DroppedError, Quadratic, contents, dropping

save_pictures = results.save_pictures


@pytest.fixture
def folder(tmp_path, monkeypatch, no_pictures):
    return toys.enter_folder(tmp_path, monkeypatch)


def toy(config):
    return Quadratic(noise=0.1)


def run_main(*argv, make_fitness=toy):
    return run_command(lambda argv: command.main(argv, make_fitness), [str(a) for a in argv])


def test_a_run_documents_itself(folder, monkeypatch, capsys):
    monkeypatch.setattr(results, "save_pictures", save_pictures)
    assert run_main("toy.yaml", "--out", "run", "--seed", 5, "--set", "task.duration=4") == 0
    out = capsys.readouterr().out
    assert out.startswith("loading toy.yaml\n")
    lines = out.splitlines()[1:]
    assert lines[0].startswith("5 genes | speed in lake | SNES 8 x 7, seed 5 | cpu with ")
    assert [line.split("  ")[0] for line in lines[1:9]] == [f"generation {i}/7" for i in range(8)]
    assert re.search(r"  best -?[\d.]+  mean -?[\d.]+  evaluations/s [\d.]+", lines[2])
    assert lines[9:11] == ["judging the champion on fresh starts", "drawing pictures"]
    words = "body lengths/s, mean ± SD over 16 fresh starts"
    assert re.match(rf"champion: -?\S+ ± \S+ {words} \(", lines[11])
    assert lines[-1] == "run folder: run"
    run = folder / "run"
    names = {str(path.relative_to(run)) for path in run.rglob("*") if path.is_file()}
    assert names >= {
        "config.yaml", "run.json", "metrics.csv", "fitness.png", "champion/genes.yaml",
        "inputs/robot.yaml", "checkpoints/generation_000007.npz",
    }  # fmt: skip
    info = json.loads((run / "run.json").read_text())
    assert info["versions"].keys() >= {"python", "jax", "jaxlib", "mujoco", "evosax", "numpy"}
    assert info["seed"] == 5
    assert info.keys() >= {"argv", "platform", "cpu_count", "device", "threads", "started",
                           "model_hash", "finished", "champion"}  # fmt: skip
    assert runs.RunFolder(run).load_config().task.duration == 4
    assert load_genes(run).shape == (5,)
    assert len(runs.RunFolder(run).load_metrics()["best"]) == 7


@pytest.mark.slow
@pytest.mark.parametrize("drop", [2, 6])
def test_a_dropped_run_continues_bit_for_bit(folder, drop, capsys):
    assert run_main("toy.yaml", "--out", "whole") == 0
    with pytest.raises(DroppedError):
        run_main("toy.yaml", "--out", "part", make_fitness=dropping(drop))
    assert run_main("--resume", "part") == 0
    before = f"after generation {(drop - 1) // 2 * 2}" if drop > 2 else "from the start: it has no"
    assert f"resuming {before}" in capsys.readouterr().out
    assert contents(folder / "part") == contents(folder / "whole")
    assert len(json.loads((folder / "part" / "run.json").read_text())["resumed"]) == 1


def test_what_died_before_its_first_checkpoint_stays_the_same_run(folder, capsys):
    with pytest.raises(DroppedError):
        run_main("toy.yaml", "--out", "run", make_fitness=dropping(2))
    path = folder / "run" / "config.yaml"
    text = path.read_text()
    path.write_text(text.replace("duration: 10.0", "duration: 9.0"))
    assert run_main("--resume", "run") == 2
    assert "expected the config.yaml that it began with" in capsys.readouterr().err
    path.unlink()  # as if it had died even before that was written
    shutil.rmtree(folder / "run" / "champion", ignore_errors=True)
    (folder / "run" / "metrics.csv").unlink()
    assert run_main("toy.yaml", "--out", "run") == 0
    assert path.read_text() == text


@pytest.mark.slow
def test_a_damaged_checkpoint_costs_only_time(folder, capsys):
    assert run_main("toy.yaml", "--out", "whole") == 0
    with pytest.raises(DroppedError):
        run_main("toy.yaml", "--out", "part", make_fitness=dropping(6))
    newest = folder / "part" / "checkpoints" / "generation_000004.npz"
    newest.write_bytes(newest.read_bytes()[:1000])
    assert run_main("toy.yaml", "--resume", "part") == 0
    out, err = capsys.readouterr()
    assert "passed over a damaged checkpoint: generation_000004.npz" in err
    assert "resuming after generation 2" in out
    assert contents(folder / "part") == contents(folder / "whole")


@pytest.mark.slow
def test_a_finished_run(folder, capsys):
    own = ("--seed", 3, "--set", "task.trials=3")
    assert run_main("toy.yaml", "--out", "run", *own, "--set", "evolution.generations=4") == 0
    before = contents(folder / "run")
    capsys.readouterr()
    assert run_main("--resume", "run") == 0
    assert capsys.readouterr().out == (
        "loading run\nrun: finished after 4 generations; to go on: --set evolution.generations=8\n"
    )
    assert contents(folder / "run") == before
    # Going on gives what a longer run would have given, by the settings that it had.
    assert run_main("toy.yaml", "--out", "long", *own) == 0
    assert run_main("toy.yaml", "--resume", "run", "--set", "evolution.generations=7") == 0
    assert contents(folder / "run") == contents(folder / "long")
    config = runs.RunFolder(folder / "run").load_config()
    assert (config.evolution.seed, config.task.trials, config.evolution.generations) == (3, 3, 7)


def test_a_run_that_lacks_only_its_champion(folder):
    assert run_main("toy.yaml", "--out", "run") == 0
    before = contents(folder / "run")
    shutil.rmtree(folder / "run" / "champion")
    runs.RunFolder(folder / "run").update_info(finished=None)
    assert run_main("--resume", "run") == 0
    assert contents(folder / "run") == before


def test_a_run_that_has_lost_its_checkpoints_does_not_begin_anew(folder, capsys):
    assert run_main("toy.yaml", "--out", "run") == 0
    before = (folder / "run" / "metrics.csv").read_text()
    shutil.rmtree(folder / "run" / "checkpoints")
    assert run_main("--resume", "run", "--set", "evolution.generations=9") == 2
    error = capsys.readouterr().err
    assert "checkpoints: expected a checkpoint to resume from; found none" in error
    assert (folder / "run" / "metrics.csv").read_text() == before


@pytest.fixture
def stopped(folder):
    """A run that was dropped after its first checkpoint."""
    with pytest.raises(DroppedError):
        run_main("toy.yaml", "--out", "run", make_fitness=dropping(4))
    return folder


@pytest.mark.parametrize(
    ("argv", "message"),
    [
(["--set", "task.duration=4"], "--resume run: task.duration: expected 10.0 as in the run; "
         "found 4.0; only evolution.generations, checkpoint_every, keep_checkpoints, "
         "tensorboard, passport may change"),
(["--seed", "9"], "--resume run: evolution.seed: expected 0 as in the run; found 9"),
(["changed.yaml"], "run: task.type: expected 'speed' as in the run; found 'crawl'"),
(["--out", "there"], "--resume run: expected no --out beside it; found there"),
(["--set", "evolution.generations=1"], "--resume run: evolution.generations: expected at least 2, "
         "which are done; found 1")
],
)  # fmt: skip
def test_a_run_stays_the_same_run(stopped, argv, message, capsys):
    changed = (stopped / "toy.yaml").read_text().replace("speed", "crawl")
    (stopped / "changed.yaml").write_text(changed)
    (stopped / "run" / ".lock").unlink()  # as where the folder was copied
    assert run_main("--resume", "run", *argv) == 2
    assert not (stopped / "run" / ".lock").exists()
    check_error(capsys.readouterr(), message)


def test_a_changed_robot_or_config_is_noticed(stopped, capsys, monkeypatch):
    monkeypatch.setattr(beginning, "model_hash", lambda fitness: "another")
    assert run_main("--resume", "run") == 2
    error = capsys.readouterr().err
    assert "expected the robot and the world that it began with; found them changed" in error
    monkeypatch.undo()
    monkeypatch.chdir(stopped)
    path = stopped / "run" / "config.yaml"
    path.write_text(path.read_text().replace("duration: 10.0", "duration: 9.0"))
    assert run_main("--resume", "run") == 2
    error = capsys.readouterr().err
    assert "expected the config.yaml that it began with; found it changed" in error


@pytest.mark.parametrize(
    ("argv", "message"),
    [
([], "expected a CONFIG, or --resume DIR; found neither"),
(["toy.yaml", "--fast"], "unrecognized arguments: --fast (see --help)"),
(["toy.yaml", "--out", "full/file/run"], "expected the folder full/file; found a file"),
(["toy.yaml", "--set", "evolution.strategy=PGPE", "--set", "evolution.population_size=9"],
         "--set evolution.population_size: expected an even number for PGPE; found 9"),
(["toy.yaml", "--out", "full"], "--out full: expected a new or empty folder; found files")
],
)  # fmt: skip
def test_wrong_commands_leave_nothing_behind(folder, argv, message, capsys):
    (folder / "full").mkdir()
    (folder / "full" / "file").touch()
    before = sorted(folder.rglob("*"))
    assert run_main(*argv) == 2
    check_error(capsys.readouterr(), message)
    assert sorted(folder.rglob("*")) == before


@pytest.mark.slow
def test_a_full_disk_costs_one_generation(folder, capsys, monkeypatch):
    assert run_main("toy.yaml", "--out", "whole") == 0
    write = runs.write_atomic

    def full(path, content):
        if path.name == "generation_000004.npz":
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        write(path, content)

    monkeypatch.setattr(runs, "write_atomic", full)
    capsys.readouterr()
    assert run_main("toy.yaml", "--out", "part") == 1
    err = capsys.readouterr().err.splitlines()
    assert err[0].endswith("part/checkpoints/generation_000004.npz: No space left on device")
    last = "part/checkpoints/generation_000002.npz"
    assert err[1] == f"the last checkpoint, {last}, is intact"
    assert err[2].endswith("-m mjx_revolve.evolve --resume part")
    monkeypatch.setattr(runs, "write_atomic", write)
    assert run_main("--resume", "part") == 0
    assert contents(folder / "part") == contents(folder / "whole")


def events(folder):
    """The scalars that a reader of the event files keeps: by tag, (step, value)."""
    from tensorboardX.proto.event_pb2 import Event

    found = []
    for path in sorted((folder / "tensorboard").iterdir()):
        data, at = path.read_bytes(), 0
        while at < len(data):
            (size,) = struct.unpack("<Q", data[at : at + 8])
            found.append(Event.FromString(data[at + 12 : at + 12 + size]))
            at += 12 + size + 4
    scalars = {}
    for event in found:
        if event.HasField("session_log"):  # what TensorBoard does: later steps are purged
            scalars = {tag: [x for x in xs if x[0] < event.step] for tag, xs in scalars.items()}
        for value in event.summary.value:
            scalars.setdefault(value.tag, []).append((event.step, value.simple_value))
    return scalars


@pytest.mark.slow
def test_tensorboard_has_what_the_metrics_have(folder):
    pytest.importorskip("tensorboardX")
    board = ("--set", "evolution.tensorboard=true")
    assert run_main("toy.yaml", "--out", "whole", *board) == 0
    with pytest.raises(DroppedError):
        run_main("toy.yaml", "--out", "part", *board, make_fitness=dropping(6))
    assert [step for step, _ in events(folder / "part")["fitness/best"]] == [1, 2, 3, 4, 5]
    assert run_main("--resume", "part") == 0
    assert len(list((folder / "part" / "tensorboard").iterdir())) == 2
    for name in ("whole", "part"):
        table = runs.RunFolder(folder / name).load_metrics()
        scalars = events(folder / name)
        assert len(scalars) == len(table) - 1  # the generation is the step
        assert {tag.split("/")[0] for tag in scalars} == {"fitness", "search", "measures", "time"}
        for tag, points in scalars.items():
            column = table[tag.split("/")[1]]
            assert [step for step, _ in points] == list(range(1, 8))
            assert np.allclose([value for _, value in points], column, rtol=1e-6)
    assert contents(folder / "part") == contents(folder / "whole")
