"""What is shown of a colony: its history from logs, pictures, report, and the page of a replay."""

import json
import shutil

import numpy as np
import pytest
import yaml

from laboratory import check_refused
from mjx_revolve import report, viewer
from mjx_revolve.episodes.champion import load_episode
from mjx_revolve.episodes.individual_log import Event, read_events
from mjx_revolve.episodes.tasks import COLONY_FITNESS
from mjx_revolve.evolution.colony_observer import open_colony
from mjx_revolve.evolve import main
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.view.colony_history import make_history
from mjx_revolve.view.colony_pictures import plot_population
from mjx_revolve.view.population import trace_line
from mjx_revolve.view.report.data import read_run
from toys import COLONY

NOWHERE = np.zeros(3)
# Two founders; 2 and 3 are of the first one's family, 4 is a stranger. 0 and 3 die.
EVENTS = [
    Event(0.0, "birth", 0, np.array([1.0, 0, -1])), Event(0.0, "birth", 1, NOWHERE),
    Event(10.0, "mating", 0, NOWHERE, other=1), Event(20.0, "birth", 2, NOWHERE, parents=(0, 1)),
    Event(30.0, "death", 0, NOWHERE, cause="age"),
    Event(40.0, "birth", 3, NOWHERE, parents=(2, 1)), Event(40.0, "birth", 4, NOWHERE),
    Event(50.0, "death", 3, np.full(3, np.nan), cause="a new one"),
]  # fmt: skip


@pytest.fixture
def history():
    return make_history(EVENTS, {0: 0.1, 2: 0.3}, 60.0)


def test_events_are_read_back(tmp_path):
    base = {"id": 0, "place": [1, 2, -1]}
    born = {"time": 0.0, "event": "birth", "place": [1, 2, None], "parents": [], "origin": ""}
    good = [
        base | born, base | {"time": 2.0, "event": "mating", "other": 1},
        base | {"time": 1.0, "event": "death", "cause": "age", "age": 1.0},
    ]  # fmt: skip
    bad = [
        "{", json.dumps(good[0] | {"parents": [3]}), json.dumps(good[0] | {"place": [1, 2]}),
        json.dumps(good[0] | {"event": "feast"}), json.dumps(good[1] | {"other": "one"}),
    ]  # fmt: skip
    lines = [*map(json.dumps, good), *bad]
    (tmp_path / "events.jsonl").write_text("".join(f"{x}\n" for x in lines) + lines[0])
    events, problems = read_events(tmp_path)
    assert [(e.time, e.kind) for e in events] == [(0, "birth"), (1, "death"), (2, "mating")]
    assert events[1].cause == "age" and events[2].other == 1 and np.isnan(events[0].place[2])
    assert problems == [f"events.jsonl: {len(bad)} lines are damaged and left out"]
    assert read_events(tmp_path / "none") == ([], [])


def test_history_by_hand(history):
    ends = {n: (s.founder, s.born, s.end, s.cause) for n, s in history.spans.items()}
    assert ends == {
        0: (0, 0, 30, "age"), 1: (1, 0, 60, ""), 2: (0, 20, 60, ""), 3: (0, 40, 50, "a new one"),
        4: (4, 40, 60, ""),
    }  # fmt: skip
    # Whose birth and death it is at that moment: the one counts, the other no more.
    times = np.array([0.0, 20.0, 30.0, 40.0, 50.0, 60.0])
    assert history.count_living(times).tolist() == [2, 3, 2, 4, 3, 3]
    assert history.count_living(times, 0).tolist() == [1, 2, 1, 2, 1, 1]
    assert history.families == [0, 1, 4]  # 80, 60 and 20 s together
    line = [span.number for span in trace_line(history.spans, 3)]
    assert line == [0, 2, 3] and history.children[0] == [2]
    assert history.spans[2].score == 0.3 and np.isnan(history.spans[1].score)


def test_births_and_deaths_add_up(history):
    top, low = plot_population(history, 8).axes
    bars = np.array([patch.get_height() for patch in low.patches])
    assert bars[bars > 0].sum() == 5 and bars[bars < 0].sum() == -2
    labels = low.get_legend_handles_labels()[1]
    assert labels == ["children born", "founders born", "died of age", "died of something else"]
    assert top.lines[0].get_ydata().max() == 4


SETTINGS = COLONY | {
    "task": COLONY["task"] | {"duration": 0.5, "settle": 0.1},
    "bodies": {"max_modules": 4, "max_hinges": 2, "brains": {"inheritance": "darwinian"}},
    "colony": COLONY["colony"]
    | {
        "energy": None,
        "interval": 2.0,
        "look": 0.05,  # as often as pages have poses: one program serves both
        "birth": COLONY["colony"]["birth"] | {"radius": 0.9, "gestation": 2.0},
        "arena": {"size": 2.0, "depth": 3.0},
        "mating": {"distance": 1.0, "likeness": 0.0, "adult": 2.0, "children": 2},
        "life": {"window": 2.0, "max_age": 12.0, "childhood": 4.0, "full_fitness": 0.2},
    },
    "evolution": COLONY["evolution"] | {"generations": 8, "checkpoint_every": 4},
}


@pytest.fixture(scope="module")
def run(tmp_path_factory, quick_compiles):
    """A colony of eight places, from the command."""
    folder = tmp_path_factory.mktemp("colony")
    (folder / "colony.yaml").write_text(yaml.safe_dump(SETTINGS))
    assert main([str(folder / "colony.yaml"), "--out", str(folder / "run")]) == 0
    return folder / "run"


@pytest.mark.long
def test_the_report_of_a_colony(run, tmp_path):
    page = tmp_path / "page.html"
    assert run_command(report.main, [str(run), "--out", str(page)]) == 0
    text = page.read_text()
    assert "<h2>The colony</h2>" in text or ">The colony</a>" in text
    assert "own generation's starts" not in text and "After generation" not in text
    assert "intervals" in text and "fitness in the colony" in text
    assert read_run(run).history.spans.keys() == read_run(run).population.lives.keys()
    # Before its end the fittest is known by its life, and not by a task's score.
    shutil.copytree(run, tmp_path / "run")
    info = json.loads((tmp_path / "run" / "run.json").read_text())
    del info["finished"]
    (tmp_path / "run" / "run.json").write_text(json.dumps(info))
    best = tmp_path / "run" / "champion" / "genes.yaml"
    best.write_text(yaml.safe_dump(yaml.safe_load(best.read_text()) | {"final": False}))
    episode = load_episode(tmp_path / "run")
    assert (episode.starts, episode.score_unit) == ("its life", COLONY_FITNESS)


@pytest.mark.long
def test_the_page_of_a_run(run, capsys):
    argv = [str(run), "--colony", "--duration", "1"]  # half an interval
    assert run_command(viewer.main, argv) == 0
    assert "16 to 17 s" in capsys.readouterr().out
    text = (run / "colony.html").read_text()
    assert '"leap":1.0' in text and "clinic" in text
    for wrong in (["--individual", "1"], ["--seed", "1"]):
        assert run_command(viewer.main, [*argv, *wrong, "--out", str(run / "x.html")]) == 2
    assert run_command(viewer.main, [str(run), "--time", "3"]) == 2


def test_other_runs_have_no_colony(tmp_path):
    plain = {"morphology": "spider", "world": "lake", "task": {"type": "speed"}}
    (tmp_path / "config.yaml").write_text(json.dumps(plain))
    check_refused("expected the run of a colony", open_colony, tmp_path)
    check_refused("expected a run folder", open_colony, tmp_path / "none")
