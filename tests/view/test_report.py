"""Reports: what is read of whole and damaged runs, the statistics, the pictures and the page."""

import json
import shutil
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from laboratory import ELBOW, check_error
from mjx_revolve import evolve, inspect, passport, report
from mjx_revolve.episodes.config import load_config, make_config
from mjx_revolve.episodes.fitness import make_fitness
from mjx_revolve.episodes.passport import Check, Passport, load_passport
from mjx_revolve.episodes.scoring import replay_key
from mjx_revolve.evolution import run_folder as runs
from mjx_revolve.evolution.fingerprints import model_hash, settings_hash
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics import runtime
from mjx_revolve.view import convergence, motion_plots, plots
from mjx_revolve.view.report import page as report_page
from mjx_revolve.view.report import repeat as report_repeat
from mjx_revolve.view.report.champion import replay_champion
from mjx_revolve.view.report.data import read_run
from mjx_revolve.view.report.groups import differences, group_runs, setting_words
from mjx_revolve.view.statistics import interval

SETTINGS = {
    "morphology": "elbow.yaml",
    "trim": "none",
    "world": {"name": "lake", "bed": False},
    "controller": {"type": "cpg", "max_frequency": 1.0},
    "task": {"type": "speed", "duration": 1.0, "settle": 0.2, "trials": 1},
    "evolution": {"strategy": "SNES", "population_size": 8, "generations": 6},
}
GENES = np.float32([0.9, -0.6, 0.5])


def row(generation, seed=0):
    """A generation of a search that gets better, each seed in its own way."""
    best = float(0.1 * np.log1p(generation) + 0.01 * seed)
    return {
        "generation": generation, "evaluations": 8 * generation, "best": best, "mean": best / 2,
        "std": 0.02, "median": best / 2.2, "champion": best, "step_size": 0.5 / generation,
        "failed": 0, "restarts": 0, "speed_m_s": best / 3, "seconds": 0.5 * generation,
        "evaluations_per_second": 16.0,
    }  # fmt: skip


def make_run(folder, config, fitness, seed=0, generations=6, finished=True, score=None):
    """A run folder as evolution leaves it, without evolution."""
    evolution = config.evolution.model_copy(update={"seed": seed})
    config = config.model_copy(update={"evolution": evolution})
    settings = ["controller.max_frequency=1.0", f"evolution.seed={seed}"]
    run, config = runs.create_run_folder(
        folder, config, started="2026-01-02T03:04:05+00:00", seed=seed,
        config_file=config.source, settings=settings, model_hash=model_hash(fitness),
        **runtime.describe_process(),
    )  # fmt: skip
    for generation in range(1, generations + 1):
        run.append_metrics(row(generation, seed))
    arrays = {"elites": np.stack([GENES, 0 * GENES]), "elite_scores": np.float32([0.2, -np.inf])}
    for generation in (generations - 1, generations):
        run.save_checkpoint(generation, arrays, {}, 3)
    facts = {"score": score or row(generations, seed)["best"], "score_std": 0.004,
             "origin": "best of generation 5", "measures": {"speed_m_s": 0.02}}  # fmt: skip
    run.save_champion(GENES, final=finished, **facts)
    run.write("champion/morphology.yaml", fitness.robot.morphology.save)
    if finished:
        run.update_info(finished="2026-01-02T03:05:00+00:00", generations=generations,
                        champion=facts)  # fmt: skip
    run.close()


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """Three seeds of one configuration, and what their champion does."""
    folder = tmp_path_factory.mktemp("report")
    (folder / "elbow.yaml").write_text(ELBOW)
    (folder / "swim.yaml").write_text(json.dumps(SETTINGS))
    config = load_config(folder / "swim.yaml")
    fitness = make_fitness(config)
    trajectory = fitness.replay(GENES, replay_key(0))
    score, measures = fitness.judge(trajectory, replay_key(0))
    for seed in range(3):
        make_run(folder / f"s{seed}", config, fitness, seed, score=score)
    record = read_run(folder / "s0")
    assert record.problems == []
    return {"folder": folder, "config": config, "fitness": fitness, "score": score,
            "measures": measures, "trajectory": trajectory,
            "replay": replay_champion(record, fitness)}  # fmt: skip


@pytest.fixture
def copy(lab, tmp_path, monkeypatch):
    """A run of one's own to damage, current folder beside it."""
    shutil.copytree(lab["folder"] / "s0", tmp_path / "run")
    monkeypatch.chdir(tmp_path)
    return tmp_path / "run"


@pytest.fixture
def quick(lab, monkeypatch):
    """Reports that compile nothing: all runs have the same robot."""
    monkeypatch.setattr("mjx_revolve.view.report.page.make_fitness", lambda config: lab["fitness"])
    monkeypatch.setattr("mjx_revolve.view.swim_picture.show_scene", lambda *_: None)


def run_main(*argv):
    return run_command(report.main, [str(word) for word in argv])


@pytest.mark.slow
def test_seeds_are_grouped_and_configurations_told_apart(lab, tmp_path):
    config, fitness, folder = lab["config"], lab["fitness"], lab["folder"]
    longer = make_config(config.model_dump(), "/", ["evolution.generations=9"], config.source)
    make_run(tmp_path / "long", longer, fitness, 0, 9)
    other = make_config(config.model_dump(), "/", ["controller.max_frequency=2.0"], config.source)
    make_run(tmp_path / "other", other, fitness, 1)
    shutil.copytree(folder / "s1", tmp_path / "again")
    places = [*(folder / f"s{k}" for k in range(3)), *(tmp_path / n for n in ("long", "other"))]
    groups = group_runs([read_run(place) for place in (*places, tmp_path / "again")])
    assert [[r.seed for r in group.records] for group in groups] == [[0, 1, 2], [0], [1]]
    assert [group.name for group in groups] == [
        "6 generations, max frequency 1.0", "9 generations, max frequency 1.0",
        "6 generations, max frequency 2.0",
    ]  # fmt: skip
    assert differences(groups) == {
        "controller.max_frequency": [1.0, 1.0, 2.0], "evolution.generations": [6, 9, 6]
    }  # fmt: skip
    (again,) = groups[0].copies
    assert again.state == "a copy"
    assert "the same configuration and seed as" in again.warning
    assert len(groups[0].scores()) == 3
    (alone,) = group_runs([read_run(folder / "s0")])
    assert (alone.name, alone.task, alone.unit) == ("swim", "speed", "body lengths/s")


def test_seeds_with_the_same_files_are_one_group(lab, tmp_path):
    (tmp_path / "fit.yaml").write_text("modules: {all: {factors: {drag: 1.1}}}")
    overrides = [f"coefficients={tmp_path}/fit.yaml"]
    for seed in range(2):
        config = make_config(lab["config"].model_dump(), "/", overrides, "swim.yaml")
        overrides.append("evolution.passport=false")
        make_run(tmp_path / f"{seed}", config, lab["fitness"], seed, 6)
    (group,) = group_runs([read_run(tmp_path / f"{seed}") for seed in range(2)])
    assert len(group.records) == 2


@pytest.mark.parametrize(("made", "best", "scores"), [
    (((0.2, 6, True), (0.3, 6, True), (0.9, 6, False)), 1, [0.2, 0.3]),
    (((None, 6, False), (None, 2, False), (None, 4, False)), 0, []),  # the furthest
])  # fmt: skip
def test_the_best_run_is_the_best_judged_one(lab, tmp_path, made, best, scores):
    for seed, (score, count, finished) in enumerate(made):
        make_run(tmp_path / f"{seed}", lab["config"], lab["fitness"], seed, count, finished, score)
    (group,) = group_runs([read_run(tmp_path / f"{seed}") for seed in range(3)])
    assert group.best().seed == best and group.scores() == scores


def cut(path, share=0.5):
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])


def made_by(run, package, version):
    record = json.loads((run / "run.json").read_text())
    record["versions"][package] = version
    (run / "run.json").write_text(json.dumps(record))


def edit(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def break_cell(run):
    edit(run / "metrics.csv", "\n3,24,", "\n3,x,")


DAMAGES = [
(lambda run: cut(run / "metrics.csv"), "damaged", "metrics.csv ends at generation 2, but the "
     "run reached 6"),
    (break_cell, "damaged", "metrics.csv: 1 of 6 generations are not in it"),
    (lambda run: cut(run / "run.json"), "damaged", "run.json: expected JSON; found"),
    (lambda run: edit(run / "run.json", '"settings": ', '"resumed": 5, "settings": '), "damaged",
     "run.json: resumed: expected a list; found 5"),
    (lambda run: (run / "config.yaml").unlink(), "incomplete", "config.yaml is missing"),
    (lambda run: edit(run / "config.yaml", "trials: 1", "trials: 1\n  trails: 2"),
     "of another version", "task.trails: expected one of "),
    (lambda run: made_by(run, "mjx_revolve", "99.1"),
     "of another version", "made with newer mjx_revolve 99.1 (here "),
    (lambda run: (run / "inputs" / "elbow.yaml").unlink(), "incomplete",
     "morphology: expected a file; found none at inputs/elbow.yaml"),
    (lambda run: (run / "champion" / "genes.yaml").unlink(), "incomplete",
     "champion/genes.yaml is missing"),
    (lambda run: edit(run / "run.json", '"finished"', '"began"'), "not finished",
     "stopped or still running after 6 of 6 generations"),
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("damage", "state", "text"), DAMAGES)
def test_damages_are_named_and_the_rest_is_read(copy, damage, state, text):
    damage(copy)
    record = read_run(copy)
    assert state in record.state
    assert text in record.warning, record.warning
    assert str(copy) not in "; ".join(problem.text for problem in record.problems)
    assert record.info or record.settings
    assert record.genes is not None or "genes" in text
    if "metrics" in text and record.metrics:  # whatever is left makes pictures
        assert plots.figure_svg(convergence.plot_fitness(record.metrics)).startswith(b"<?xml")


@pytest.mark.parametrize("make", [lambda p: None, lambda p: p.mkdir(), lambda p: p.touch()])
def test_what_is_no_run_is_refused(tmp_path, make):
    make(tmp_path / "thing")
    with pytest.raises(InputError, match=r"thing: expected a run folder; found"):
        read_run(tmp_path / "thing")


def test_the_replay_scores_as_evolution_did(lab, copy):
    assert lab["replay"].score == lab["score"]
    for name in ("run.json", "champion/genes.yaml"):
        data = (copy / name).read_text()
        (copy / name).write_text(data.replace(str(lab["score"]), str(lab["score"] + 0.1)))
    record = read_run(copy)
    assert np.isnan(replay_champion(record, lab["fitness"]).score) == 0
    assert "changed" in record.state
    assert "the simulator has changed since, or files of the run have" in record.warning


def test_one_episode_may_differ_more_than_the_means_of_several(lab, copy):
    """What runs record is the deviation of means over `task.trials` episodes."""
    edit(copy / "config.yaml", "trials: 1", "trials: 16")
    record = read_run(copy)
    for std, changed in ((0.006, False), (0.004, True)):
        scores = {"score": lab["score"] + 0.1, "score_std": std}
        off = replace(record, champion=record.champion | scores, problems=[])
        replay_champion(off, lab["fitness"])
        assert ("changed" in off.state) == changed


def test_names_of_robots_may_hold_dots_and_blanks():
    assert setting_words("morphology", "spider_v0.1 abc123") == "spider_v0.1"
    assert setting_words("morphology", "big fish 00ff00") == "big fish"
    assert setting_words("morphology", "robots/big.fish.yaml") == "big.fish"


def axes_of(figure):
    """Rendered once, then its axes by what they are called."""
    assert plots.figure_svg(figure).startswith(b"<?xml")
    return figure.axes


def test_joint_angles_are_those_of_the_joints(lab):
    first, second = axes_of(motion_plots.plot_joints(lab["replay"].motion))
    trajectory = lab["trajectory"]
    assert first.get_title(loc="left") == "shoulder"
    assert np.allclose(first.lines[1].get_ydata(), np.degrees(trajectory.qpos[:, 7]))
    assert np.allclose(second.lines[0].get_ydata(), np.degrees(trajectory.ctrl[:, 1]))
    assert second.get_xlabel() == "time (s)"


def test_power_adds_up(lab):
    replay = lab["replay"]
    power, energy, cost = axes_of(motion_plots.plot_energy(replay.motion))
    assert [axes.get_ylabel() for axes in (power, energy, cost)] == [
        "power (W)", "energy so far (J)", "cost of transport (–)",
    ]  # fmt: skip
    trajectory = lab["trajectory"]
    total = float(np.mean(trajectory.power)) * float(trajectory.time[-1])
    assert energy.lines[0].get_ydata()[-1] == pytest.approx(total, rel=1e-4)
    final = float(cost.get_title(loc="left").split()[0])
    assert final == pytest.approx(replay.measures["cost_of_transport"], rel=0.01)


@pytest.mark.slow
def test_searches_in_which_everything_fails_make_pictures(lab, tmp_path):
    make_run(tmp_path / "0", lab["config"], lab["fitness"], 0, 1)
    make_run(tmp_path / "1", lab["config"], lab["fitness"], 1, 3)
    text = (tmp_path / "1" / "metrics.csv").read_text().splitlines()
    rows = [f"{g},{8 * g}," + ",".join(["nan"] * 4) + ",-inf,.5,8,0,nan,1,1" for g in (1, 2, 3)]
    (tmp_path / "1" / "metrics.csv").write_text("\n".join([text[0], *rows, ""]))
    one, other = (read_run(tmp_path / name) for name in "01")
    assert other.problems == []
    for records in ([one], [other], [one, other]):
        groups = group_runs(records)
        axes_of(convergence.plot_comparison(groups, {group.name: 0 for group in groups}))
        axes_of(convergence.plot_fitness(records[-1].metrics))


def test_pictures_are_the_same_bytes_twice():
    table = {"generation": np.arange(1.0, 4), "best": np.arange(3.0)}
    first, second = (plots.figure_svg(convergence.plot_fitness(table)) for _ in range(2))
    assert first == second
    assert b"<text" not in first  # no fonts needed


def test_the_command_gives_the_same_settings(copy):
    record = read_run(copy)
    command = report_repeat.repeat_command(record)
    assert command.startswith("python -m mjx_revolve.evolve ")
    arguments = evolve._parser().parse_args(command.split()[3:])
    assert settings_hash(load_config(arguments.config)) == settings_hash(record.config)
    runs.RunFolder(copy).update_info(xla_flags="--a --b", threads={"OPENBLAS_NUM_THREADS": "2"})
    command = report_repeat.repeat_command(read_run(copy))
    assert command.startswith("OPENBLAS_NUM_THREADS=2 XLA_FLAGS='--a --b' python -m ")
    runs.RunFolder(copy).update_info(xla_flags=None, threads={}, variables={"JAX_ENABLE_X64": "1"})
    record = read_run(copy)
    assert report_repeat.repeat_command(record).startswith("JAX_ENABLE_X64=1 python -m ")
    assert ("variables", "JAX_ENABLE_X64 1") in report_repeat.environment(record)


class Page(HTMLParser):
    """Words and images of a page, in which nothing comes from elsewhere."""

    def __init__(self, text):
        super().__init__()
        self.images, self.words = [], []
        self.feed(text)
        self.text = " ".join(self.words)

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        assert tag not in ("script", "link", "iframe")
        if tag == "img":
            assert values["src"].startswith("data:image/") and values["alt"]
            self.images.append(values["src"])
        assert tag != "a" or values["href"].startswith("#")

    def handle_data(self, data):
        self.words.append(data)


def test_text_is_escaped():
    from types import SimpleNamespace

    sections = report_page.sections
    inside = sections.table(["<a>\n<b>"], [["<script>"]]) + sections.listing('"<pre>&')
    problem = SimpleNamespace(text="<img>")
    run = SimpleNamespace(label="<run>", state="damaged", problems=[problem])
    box = sections.problems([run], ["<lost>"], True)
    content = [("x", "<h>", inside), ("y", "none", " ")]
    page = Page(report_page.make_page("<t>", "<w>", box, content))
    written = ("<script>", '"<pre>&', "<run>", "<img>", "<t>", "<h>", "<w>", "<a>", "<b>", "<lost>")
    assert all(text in page.words for text in written)
    assert not any(text.strip() == "none" for text in page.words)


@pytest.mark.slow
def test_a_page_about_one_run(copy, quick, capsys):
    earlier = f'<meta name="generator" content="{report_page.GENERATOR}">'
    (copy / "report.html").write_text(earlier)  # its own page is replaced
    assert run_main("run") == 0
    captured = capsys.readouterr()
    assert captured.out.startswith("report: run/report.html (")
    assert captured.err == ""
    text = (copy / "report.html").read_text()
    page = Page(text)
    assert "elbow: speed (run)" in page.words
    for words in ("Convergence", "Champion", "Robot", "Repeat it", "FixedBrick", "config.yaml"):
        assert words in page.words
    assert "python -m mjx_revolve.evolve run/config.yaml --out run-again" in page.text
    # One seed is one seed, and what is spread is said.
    assert "One seed: with another, evolution ends elsewhere" in text
    assert "mean ± standard deviation over 16 fresh starts" in text
    assert len(page.images) == 5  # fitness, swim, way, joints, energy
    assert "Not everything could be read" not in page.text
    assert len(text) < 2e6
    assert "✗" not in text  # there is no passport that it could fail


@pytest.mark.slow
def test_a_champion_that_fails_its_passport_is_marked(copy, quick, capsys):
    checks = {"kept_120_s": Check("share kept over 120 s", 0.3, least=0.8),
              "overlap": Check("deepest overlap", 1.0, "mm", most=3.0)}  # fmt: skip
    path = copy / "champion" / "passport.yaml"
    path.write_text(Passport(checks).to_text())
    assert run_main(copy) == 0
    page = (copy / "report.html").read_text()
    assert "✗ fails its passport: kept_120_s" in page and "Its passport" in page
    for cell in ("share kept over 120 s", "at least 0.8", "FAILS", "1 mm", "passes"):
        assert f">{cell}</td>" in page
    capsys.readouterr()
    assert run_command(inspect.main, [str(copy / "champion" / "morphology.yaml")]) == 0
    assert "champion of a run: fails its passport: kept_120_s" in capsys.readouterr().out
    path.write_text("checks: {a: 3}")
    assert "checks.a: expected a mapping; found 3" in read_run(copy).problems[0].text


def test_the_command_prints_and_writes_a_passport(copy, monkeypatch, capsys):
    given = []

    def make(fitness, genes, seed):
        given.append((fitness.robot.num_hinges, genes.tolist(), seed))
        return Passport({"drag": Check("share with drag x 1.3", value, least=0.5)})

    monkeypatch.setattr("mjx_revolve.episodes.passport.make_passport", make)
    for value, code, said in ((0.4, 1, "FAILS"), (0.9, 0, "passes")):
        assert run_command(passport.main, [str(copy)]) == code
        assert f"share with drag x 1.3  {value}  at least 0.5  {said}" in capsys.readouterr().out
        found = load_passport(copy / "champion" / "passport.yaml")
        assert found.checks["drag"].value == value
    assert given[0] == (2, GENES.tolist(), 0)

    def beaten(*_):
        """The run goes on meanwhile, and has another champion."""
        text = (copy / "champion" / "genes.yaml").read_text()
        (copy / "champion" / "genes.yaml").write_text(text.replace("score: ", "score: 1"))
        return found

    monkeypatch.setattr("mjx_revolve.episodes.passport.make_passport", beaten)
    assert run_command(passport.main, [str(copy)]) == 2
    assert "the champion that was tried; found another" in capsys.readouterr().err
    assert load_passport(copy / "champion" / "passport.yaml") == found


def test_a_page_about_several_runs(lab, copy, quick, capsys):
    runs_of = [lab["folder"] / f"s{seed}" for seed in range(3)]
    assert run_main(*runs_of, "run", "--out", "page.html") == 0
    assert "the same configuration and seed as" in capsys.readouterr().err
    page = Page((copy.parent / "page.html").read_text())
    assert "4 runs of swim" in page.words
    assert str(interval([lab["score"]] * 3)) in page.words
    assert "Champions side by side" in page.words
    assert any("95 % confidence" in words for words in page.words)
    assert len(page.images) == 2 + 4
    assert not any("One seed" in words for words in page.words)


def test_a_page_about_what_is_left(copy, quick, capsys):
    for name in ("a", "b", "c", "d"):
        shutil.copytree(copy, name)
    (copy.parent / "a" / "config.yaml").write_text("a: {")
    shutil.rmtree("b/champion")
    shutil.rmtree("b/checkpoints")
    (copy.parent / "c" / "metrics.csv").unlink()
    (copy.parent / "c" / "champion" / "genes.yaml").write_text("genes: [1.0]")
    for path in (copy.parent / "d").iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    assert run_main("a", "b", "c", "d") == 0
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 4
    assert lines[0] == (
        "warning: nothing could be read: d: expected a run folder; found nothing of a run"
    )
    assert all(line.startswith("warning: ") for line in lines)
    page = Page((copy.parent / "report.html").read_text())
    for words in ("Not everything could be read", "a", "b", "c", "Nothing could be read of"):
        assert words in page.words
    assert "found 1" in page.text  # c: one gene where three are expected


@pytest.mark.parametrize(("argv", "message"), [
    (["nowhere"], "nowhere: expected a run folder; found none"),
    (["run", "run/../run"], "run/../run: expected each run once; found it as run, too"),
    (["run", "--out", "no/page.html"], "--out no/page.html: expected the folder no; found"),
    (["run"], "run/report.html: expected no file or an earlier report; found another file"),
])  # fmt: skip
def test_wrong_commands(copy, argv, message, capsys):
    (copy / "report.html").write_text("mine")
    before = sorted(copy.parent.rglob("*"))
    assert run_main(*argv) == 2
    check_error(capsys.readouterr(), message)
    assert sorted(copy.parent.rglob("*")) == before
    assert (copy / "report.html").read_text() == "mine"
