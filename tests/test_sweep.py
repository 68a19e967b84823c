"""Sweeps, on fitnesses that cost nothing: what is run, stopped, killed, continued and reported."""

import csv
import os
import re
import shutil
import signal

import numpy as np
import pytest

import toys
from mjx_revolve import evolve, report, sweep
from mjx_revolve.evolution.run_folder import RunFolder
from mjx_revolve.evolution.sweeps import Plan, next_step
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.view.statistics import interval
from toys import DroppedError, contents, dropping, make_toy

GRID = ("toy.yaml", "--seeds", "2", "--set", "evolution.strategy=SNES,CMA_ES", "--out", "out")
CASES = ("strategy=SNES", "strategy=CMA_ES")
RUNS = [f"{case}/seed_{seed}" for case in CASES for seed in (0, 1)]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    return toys.enter_folder(tmp_path, monkeypatch, generations=5)


def run_sweep(*argv, make_fitness=make_toy):
    return run_command(lambda argv: sweep.main(argv, make_fitness), [str(a) for a in argv])


@pytest.mark.slow
def test_a_sweep_is_a_grid_of_ordinary_runs_with_one_report(folder, no_pictures, capsys):
    made = []

    def make(config):
        made.append(config.evolution.strategy)
        return make_toy(config)

    assert run_sweep(*GRID, make_fitness=make) == 0
    # Once for the checks and once for all runs: neither seed nor strategy makes another fitness.
    assert made == ["SNES", "SNES"]
    out = capsys.readouterr().out.splitlines()
    assert out[:2] == ["loading toy.yaml", "2 cases, 2 seeds each | out"]
    assert [re.match(r"\[\d/4\] (\S+): running ... -", line)[1] for line in out[2:6]] == RUNS
    assert out[6:] == ["writing the report", "report: out/report.html; out/sweep.csv"]

    alone = ["toy.yaml", "--seed", "1", "--out", "alone", "--set", "evolution.strategy=CMA_ES"]
    assert run_command(lambda argv: evolve.main(argv, make_toy), alone) == 0
    assert contents(folder / "alone") == contents(folder / "out" / RUNS[-1])
    log = (folder / "out" / f"{RUNS[-1]}.log").read_text()
    assert log.startswith("beginning strategy=CMA_ES/seed_1\ngeneration 0/5  compiling\n")

    with (folder / "out" / "sweep.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(r["evolution.strategy"], r["seed"]) for r in rows] == [
        ("SNES", "0"), ("SNES", "1"), ("CMA_ES", "0"), ("CMA_ES", "1")
    ]  # fmt: skip
    info = RunFolder(folder / "alone").info["champion"]
    assert float(rows[3]["score"]) == info["score"]
    assert float(rows[3]["distance_m"]) == info["measures"]["distance_m"]
    assert (rows[3]["generations"], rows[3]["evaluations"]) == ("5", "40")

    page = (folder / "out" / "report.html").read_text()
    scores = [float(row["score"]) for row in rows]
    mean = str(interval(scores[2:]))
    assert f"CMA_ES</td><td>2</td><td>{mean}</td>" in page
    # A report of the runs alone says the same of the same numbers.
    alone = [f"out/{name}" for name in RUNS]
    assert run_command(report.main, [*alone, "--out", "runs.html"]) == 0
    assert f"<td>2</td><td>{mean}</td>" in (folder / "runs.html").read_text()
    # Of two and two values, the rank test gives a third at the least.
    assert "2 seeds each: p = " in page
    assert "it is 0.33 at the" in page
    shutil.copytree(folder / "out", "part")
    shutil.rmtree("part/strategy=SNES/seed_1")
    assert run_command(report.main, ["part"]) == 0
    assert "Nothing is tested" in (folder / "part" / "report.html").read_text()
    assert '<a href="strategy=CMA_ES/seed_1/">seed_1</a>' in page

    # Again: nothing to do. More seeds: only those.
    assert run_sweep(*GRID) == 0
    assert capsys.readouterr().out.count("finished before") == 4
    kept = contents(folder / "out" / RUNS[0])
    assert run_sweep(*GRID, "--seeds", "3", "--set", "evolution.checkpoint_every=1") == 0
    assert re.findall(r"\[\d/6\] (\S+): running", capsys.readouterr().out) == [
        f"{case}/seed_2" for case in CASES
    ]
    assert contents(folder / "out" / RUNS[0]) == kept

    # The report command makes the same page.
    (folder / "out" / "report.html").unlink()
    assert run_command(report.main, ["out"]) == 0
    assert "6 of 6</b>runs finished" in (folder / "out" / "report.html").read_text()
    assert run_command(report.main, ["out", "alone"]) == 2
    # Of a sweep that was made longer, runs that have not gone on are not finished.
    longer = ["--resume", f"out/{RUNS[0]}", "--set", "evolution.generations=6"]
    assert run_command(lambda argv: evolve.main(argv, make_toy), longer) == 0
    sweep = folder / "out" / "sweep.yaml"
    for wanted, finished in (("checkpoint_every=1", 6), ("generations=6", 1)):
        sweep.write_text(sweep.read_text().replace("checkpoint_every=1", wanted))
        assert run_command(report.main, ["out"]) == 0
        assert f"{finished} of 6</b>runs finished" in (folder / "out" / "report.html").read_text()


@pytest.mark.slow
def test_wherever_a_sweep_is_dropped_it_ends_in_the_same_bits(folder, no_pictures, capsys):
    assert run_sweep(*GRID, "--out", "whole") == 0
    # A run takes 10 blocks and some for its champion: in its first generation, between two
    # checkpoints, in the second run, in the second case.
    for evaluation in (1, 6, 21, 60):
        with pytest.raises(DroppedError):
            run_sweep(*GRID, make_fitness=dropping(evaluation, make_toy))
    assert run_sweep(*GRID) == 0
    assert "finished before" in capsys.readouterr().out
    for name in RUNS:
        assert contents(folder / "out" / name) == contents(folder / "whole" / name)
    # A line that a power cut has damaged does no harm; what is judged otherwise is judged anew.
    with (folder / "out" / RUNS[0] / "metrics.csv").open("a") as file:
        file.write("\0\0\n")
    for kind, step in (("true", "finished"), ("false", "continue")):
        more = ("evolution.strategy=SNES", f"evolution.passport={kind}")
        assert next_step(Plan("a", 0, folder / "out" / RUNS[0], "toy.yaml", more)) == step


@pytest.mark.slow
def test_a_run_of_which_every_episode_fails_does_not_stop_the_others(folder, no_pictures, capsys):
    class Lost(toys.Toy):
        def evaluate(self, population, key):
            scores, measures = super().evaluate(population, key)
            first = not (folder / "out" / "toy" / "seed_1").exists()
            return np.full_like(scores, -np.inf) if first else scores, measures

    assert run_sweep(*GRID[:3], *GRID[-2:], make_fitness=lambda config: Lost()) == 2
    printed = capsys.readouterr()
    assert "error: toy/seed_0: " in printed.err and "report: out/report.html" in printed.out
    assert "finished" in RunFolder(folder / "out" / "toy" / "seed_1").info


@pytest.mark.slow
def test_a_robot_that_is_edited_meanwhile_is_in_no_run(folder, no_pictures, capsys):
    class Edited(toys.Toy):
        def evaluate(self, population, key):
            (folder / "robot.yaml").write_text("id: another\n")
            return super().evaluate(population, key)

    assert run_sweep(*GRID[:3], *GRID[-2:], make_fitness=lambda config: Edited()) == 2
    assert "seed_1: toy.yaml: expected configuration and files as" in capsys.readouterr().err
    assert "finished" in RunFolder(folder / "out" / "toy" / "seed_0").info


@pytest.mark.slow
def test_ctrl_c_stops_after_the_generation_under_way(folder, capsys):
    class Pressed(toys.Toy):
        def evaluate(self, population, key):
            if (folder / "out" / RUNS[1]).exists():
                os.kill(os.getpid(), signal.SIGINT)
            return super().evaluate(population, key)

    # The second evaluation of that generation would end the process at once.
    Pressed.block_size = 8
    assert run_sweep(*GRID, make_fitness=lambda config: Pressed()) == 130
    printed = capsys.readouterr().out
    assert printed.endswith(
        f"{RUNS[1]}: running ... stopped\ngo on: python -m mjx_revolve.sweep {' '.join(GRID)}\n"
    )
    assert len(RunFolder(folder / "out" / RUNS[1]).load_metrics()["generation"]) == 1
    assert (folder / "out" / RUNS[0] / "fitness.png").read_bytes().startswith(b"\x89PNG")
    # What there is can be reported meanwhile.
    assert run_command(report.main, ["out"]) == 0
    page = (folder / "out" / "report.html").read_text()
    assert "1 of 4</b>runs finished" in page
    assert (page.count("not finished</td>"), page.count("not begun</td>")) == (1, 2)


@pytest.mark.parametrize(("arguments", "message"), [
    (["--set", "evolution={seed: 9}"], "--set evolution.seed: expected --seeds N instead"),
    (["--set", "task.duration=5,-6"], "duration=-6: --set task.duration: expected a number >"),
    (
        ["--set", "evolution.population_size=8,16", "--set", "task.settle=1,11"],
        "population_size=8+settle=11: --set task.settle: expected a time below task.duration",
    ),
    (["--workers", "2", "--cluster", "x"], "--cluster: expected no --workers beside it"),
])  # fmt: skip
def test_what_is_wrong_is_said_in_one_line_before_anything_is_written(
    arguments, message, folder, capsys
):
    (folder / "out").mkdir()
    assert run_sweep("toy.yaml", "--out", "out", *arguments) == 2
    err = capsys.readouterr().err.replace(f"{folder}/", "")
    assert err.startswith("error: ") and message in err and err.count("\n") == 1
    assert not [*folder.glob("out/*/*/run.json")]
