"""Bodies that evolved, in run folders made by hand: who lived, and what is shown of them."""

import json
import math
import re

import numpy as np
import pytest

from mjx_revolve.body.catalogue import MODULES
from mjx_revolve.body.morphology import make_morphology
from mjx_revolve.episodes import champion as champions
from mjx_revolve.episodes.individual_log import read_generations, read_individuals
from mjx_revolve.view.body_pictures import SIZE, draw_bodies
from mjx_revolve.view.population import pick_ancestors, read_population, trace_lineage
from mjx_revolve.view.report import bodies as report_bodies
from mjx_revolve.view.report import page as report_page
from mjx_revolve.view.report.data import read_run

SETTINGS = {
    "world": "empty_underwater",
    "controller": {"type": "sine"},
    "task": {"type": "speed", "duration": 0.5, "settle": 0.1, "trials": 1, "horizon": 1.0},
    "bodies": {"max_modules": 8, "max_hinges": 4},
    "evolution": {"population_size": 4, "generations": 3},
}
# number, parents, generation, origin, score, hinges
BORN = [
    (0, [], 1, "random", -1.0, 1), (1, [], 1, "seed <b>$x$</b>", 0.1, 2),
    (2, [], 1, "random", None, 3), (3, [1], 2, "mutation", 0.3, 2),
    (4, [0, 3], 2, "crossover", 0.2, 1), (5, [3, 4], 3, "crossover, mutation", 0.5, 3),
]  # fmt: skip
LIVING = {1: [0, 1, 2], 2: [1, 3, 4], 3: [5, 3, 4]}


def body(hinges):
    """A chain of hinges in front of a core."""
    chain = None
    for k in range(hinges, 0, -1):
        hinge = {"id": f"h{k}", "type": "ActiveHinge", "orientation": 0}
        chain = hinge | ({"children": {1: chain}} if chain else {})
    return {"id": "robot", "body": {"id": "core", "type": "Core", "children": {0: chain}}}


def line_of(number, parents, born, origin, score, hinges):
    grown = make_morphology(body(hinges), MODULES)
    # A sine has an amplitude, a phase and an offset for each joint, and one frequency.
    genes = None if score is None else [0.1 * k for k in range(3 * hinges + 1)]
    return {
        "id": number, "parents": parents, "born": born, "origin": origin, "score": score,
        "trials": 1, "measures": {"speed_m_s": 0.5}, "descriptors": dict(grown.descriptors),
        "brain": {}, "learnt": None, "genes": genes, "genome": None, "body": grown.to_mapping(),
    }  # fmt: skip


def make_run(folder, bodies=(), born=BORN, living=LIVING):
    """A run folder as evolution leaves it, without evolution."""
    settings = SETTINGS | {"bodies": SETTINGS["bodies"] | dict(bodies)}
    (folder / "champion").mkdir(parents=True)
    (folder / "config.yaml").write_text(json.dumps(settings))
    lines = [json.dumps(line_of(*one)) for one in born]
    (folder / "individuals.jsonl").write_text("".join(f"{line}\n" for line in lines))
    lines = [json.dumps({"generation": g, "living": who}) for g, who in living.items()]
    (folder / "generations.jsonl").write_text("".join(f"{line}\n" for line in lines))
    rows = ["generation,best,mean,champion", "1,0.1,-0.4,0.1", "2,0.3,0.2,0.3", "3,0.5,0.3,0.5"]
    (folder / "metrics.csv").write_text("".join(f"{row}\n" for row in rows))
    facts = {"score": 0.4, "score_std": 0.1, "individual": 5, "measures": {"speed_m_s": 0.5}}
    info = {"finished": "2026-01-02T03:05:00+00:00", "generations": 3, "champion": facts}
    (folder / "run.json").write_text(json.dumps(info))
    last = line_of(*born[-1])
    (folder / "champion/morphology.yaml").write_text(json.dumps(last["body"]))
    champion = {**facts, "config": "../config.yaml", "morphology": "morphology.yaml"}
    (folder / "champion/genes.yaml").write_text(json.dumps(champion | {"genes": last["genes"]}))
    return folder


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return make_run(tmp_path / "run")


@pytest.fixture
def still(monkeypatch):
    """Reports in which nobody swims: nothing is compiled."""
    monkeypatch.setattr(report_page, "_replay", lambda groups: ({}, []))


def show(*folders):
    return report_page.make_report([read_run(folder) for folder in folders])


def test_lives_are_read_back(run):
    lives, problems = read_individuals(run)
    assert problems == [] and list(lives) == [0, 1, 2, 3, 4, 5]
    assert (lives[5].parents, lives[5].born, lives[5].origin) == ((3, 4), 3, "crossover, mutation")
    assert (lives[5].features["score"], lives[5].features["num_hinges"]) == (0.5, 3.0)
    assert lives[5].features["speed_m_s"] == 0.5
    assert lives[5].genes.tolist() == np.float32([0.1 * k for k in range(10)]).tolist()
    assert math.isnan(lives[2].score) and lives[2].genes is None
    assert lives[1].grow(MODULES) == make_morphology(body(2), MODULES)
    assert read_generations(run) == ({g: tuple(who) for g, who in LIVING.items()}, [])


@pytest.mark.parametrize(
    "line",
    ["{", json.dumps(line_of(*BORN[0]) | {"parents": [7]}),  # no child is older than a parent
     json.dumps(line_of(*BORN[0]) | {"score": "good"})],
)  # fmt: skip
def test_damaged_lines_are_left_out(run, line):
    path = run / "individuals.jsonl"
    lines = path.read_text().splitlines(True)
    # One amidst the others, and one that is still being written.
    path.write_text("".join([*lines[:3], f"{line}\n", *lines[3:], lines[0][:50]]))
    lives, problems = read_individuals(run)
    assert list(lives) == [0, 1, 2, 3, 4, 5]
    assert problems == ["individuals.jsonl: 1 line is damaged and left out"]


def test_who_was_best_and_who_came_of_whom(run):
    population, problems = read_population(run)
    assert problems == []
    assert [life.number for life in population.alive(3)] == [5, 3, 4]
    assert [life.number for life in population.alive(1)] == [1, 0, 2]  # failures come last
    assert population.alive(9) == [] and population.last == 3
    assert population.best().number == 5
    assert population.figures(2, "num_hinges").tolist() == [2.0, 1.0, 2.0]  # best first
    assert [life.number for life in population.line(5)] == [1, 3, 5]
    family = trace_lineage(population, 5)
    assert [(kin.life.number, kin.mate and kin.mate.number, kin.skipped) for kin in family] == [
        (1, None, 0), (3, None, 0), (5, 4, 0)
    ]  # fmt: skip
    assert [life.number for life in pick_ancestors(population, 5, 1)] == [1, 5]
    assert [life.number for life in pick_ancestors(population, 5, 9)] == [1, 3, 5]
    assert pick_ancestors(population, 77, 3) == []


def test_pictures_have_one_scale_and_fit():
    small, large = (make_morphology(body(hinges), MODULES) for hinges in (1, 4))
    together = draw_bodies([small, large])
    assert [picture.shape for picture in together] == [(SIZE[1], SIZE[0], 3)] * 2
    drawn = [(picture < 250).any(axis=-1) for picture in together]
    assert 0.2 < drawn[0].sum() / drawn[1].sum() < 0.8
    for mask in drawn:  # whole, and in the middle
        rows, columns = np.nonzero(mask)
        assert rows.min() > 2 and columns.min() > 2
        assert abs(rows.min() + rows.max() + 1 - SIZE[1]) <= 4
        assert abs(columns.min() + columns.max() + 1 - SIZE[0]) <= 4
    alone = (draw_bodies([small])[0] < 250).any(axis=-1)
    assert alone.sum() > 1.2 * drawn[0].sum()
    assert draw_bodies([]) == []


@pytest.mark.slow
def test_the_page_shows_who_lived(run, still):
    page = show(run)
    order = [int(n) for n in re.findall(r"<b>#(\d+)</b>", page)]
    # Generations 3, 2 and 1, the best first; then the line 1, 3, (4 above) 5.
    assert order == [5, 3, 4, 3, 4, 1, 1, 0, 2, 1, 3, 4, 5]
    assert page.count('alt="Body of individual') == len(order)
    # Its configuration names neither point nor length, as those of older versions.
    assert "evolved bodies: speed (core, rest) (run)" in page
    assert "seed &lt;b&gt;$x$&lt;/b&gt;" in page and "<b>$x$" not in page
    assert "The archive" not in page and "more</p>" not in page
    assert [problem.kind for problem in read_run(run).problems] == ["missing", "version"]


ARCHIVE = {"archive": {"axes": {
    "num_hinges": {"low": 0.5, "high": 3.5, "cells": 3},
    "speed_m_s": {"low": 0, "high": 1, "cells": 2},
}}}  # fmt: skip


@pytest.mark.slow
def test_cells_of_the_archive_are_links(tmp_path, still):
    run = make_run(tmp_path / "a b", ARCHIVE)
    record = read_run(run)
    archive = report_bodies.fill_archive(record)
    # Cells of one, two and three hinges, speeds in the upper half; the best of each.
    assert archive.ids.tolist() == [-1, 4, -1, 3, -1, 5]
    (run / "individuals").mkdir()
    (run / "individuals" / "3.html").write_text("")
    page = report_page.make_report([record], at=tmp_path / "elsewhere")
    assert set(re.findall(r'xlink:href="([^"]*html|#individual[^"]*)"', page)) == {
        "../a%20b/individuals/3.html", f"#{report_bodies.anchor(record, 4)}",
        f"#{report_bodies.anchor(record, 5)}",
    }  # fmt: skip
    for number in (3, 4, 5):
        assert f'id="{report_bodies.anchor(record, number)}"' in page
    assert "--individual 4" in page and "&#39;" in page  # a name with a blank is quoted
    assert '<a href="../a%20b/individuals/3.html">#3</a>' in page
    assert "<?xml" not in page and page.count("<svg") == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda run: (run / "individuals.jsonl").unlink(), "individuals.jsonl is empty"),
        (lambda run: (run / "config.yaml").write_text("a: {"), "config.yaml: line"),
        (lambda run: (run / "generations.jsonl").write_text('{"generation":1,"living":[0]}\n'),
         "generations.jsonl ends at generation 1, but the run reached 3"),
    ],
)  # fmt: skip
def test_what_is_left_is_shown(run, still, damage, message):
    damage(run)
    record = read_run(run)
    assert message in record.warning
    page = report_page.make_report([record])
    assert ("Body of individual" in page) == (run / "individuals.jsonl").is_file()


def test_an_individual_is_shown_for_longer_than_its_horizon(run):
    config, (one,) = champions.read_individuals(run, [5], duration=3.0)
    assert config.task.duration == 3.0 and one.number == 5
