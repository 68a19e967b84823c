"""Figures of the pages: each is in a results file or a named constant, and shown as it is."""

import importlib.util
import re

import pytest
import yaml

from laboratory import ROOT

spec = importlib.util.spec_from_file_location("figures_of_docs", ROOT / "docs" / "figures.py")
figures = importlib.util.module_from_spec(spec)
spec.loader.exec_module(figures)

RESULTS = {
    "swim": {
        "date": "2026-11-23", "score": 0.15358, "seconds": 375.0, "none": None,
        "interval": {"mean": 0.4, "half": 0.1, "text": "0.40 ± 0.10"}, "words": ["- one", "- two"],
        "rows": [{"name": "spider", "speed": 1.5e6}, {"name": "snake", "speed": 2.25e6}],
    }
}  # fmt: skip


def fill(text):
    return figures._MARK.sub(lambda mark: figures.fill_mark(mark, RESULTS), text)


@pytest.mark.parametrize("page", figures.PAGES, ids=lambda page: page.name)
def test_every_figure_is_traced_and_as_its_results_file_has_it(page):
    filled, wrong = figures.check_page(page, figures.read_results())
    assert wrong == []
    assert filled == page.read_text(encoding="utf-8"), "run: make numbers"


@pytest.mark.parametrize(("template", "shown"), [
    ("{swim.score:.3f}", "0.154"),
    ("{swim.seconds/60:.1f} min on {swim.date}", "6.2 min on 2026-11-23"),
    ("{swim.interval}, {swim.interval.half:.2f}", "0.40 ± 0.10, 0.10"),
    ("{swim.rows.snake.speed:,.0f}", "2,250,000"),
    ("{swim.none:.2f}", "–"),
    ("{swim.none*100:.1f} %", "– %"),
    ("{swim.words}", "\n\n- one\n- two\n\n"),
])  # fmt: skip
def test_templates(template, shown):
    text = f"swims <!--n {template}-->12<!--/--> far"
    assert fill(text) == f"swims <!--n {template}-->{shown}<!--/--> far"
    assert fill(fill(text)) == fill(text)


def test_a_table_has_a_row_for_each_element():
    mark = "<!--rows swim.rows | `{name}` | {speed*1e-6:.2f} |-->"
    head = "| | million/s |\n|---|---|\n"
    filled = fill(f"{mark}\n\n{head}| old | 1 |\n\n<!--/-->\n")
    assert filled == f"{mark}\n\n{head}| `spider` | 1.50 |\n| `snake` | 2.25 |\n\n<!--/-->\n"
    assert fill(filled) == filled
    with pytest.raises(ValueError, match="without a heading"):
        fill(f"{mark}<!--/-->")


@pytest.mark.parametrize("field", ["lost.score", "swim.lost", "swim.rows.7", "swim.score.mean"])
def test_a_field_that_no_results_file_has_is_named(field):
    with pytest.raises(KeyError, match=re.escape(f"of {field!r} in docs/results")):
        fill(f"<!--n {{{field}}}-->1<!--/-->")


@pytest.mark.parametrize("text", [
    "It swims at .55 body lengths/s.",
    "It takes 81\nseconds.",
    "an error of 12 %",
    "**3×** faster",
    "| a step | 354 |\n",
    "```text\nchampion: 0.55\n```",
    "<!-- 0.5 --> 2.5 m",
    "x <!--n {swim.score:.1f} in 81 s-->0.2 in 81 s<!--/-->",
])  # fmt: skip
def test_figures_outside_marked_places_are_found(text):
    assert len(list(figures.find_figures(f"Before.\n\n{text}", []))) >= 1


@pytest.mark.parametrize("text", [
    "see <!--n {swim.score*100:.0f} % ± {swim.score}-->15 % ± 0.15<!--/-->",
    "with `--set task.duration=0.5` and `over\ntwo lines 0.5 s`",
    "JAX 0.10.2 and MuJoCo 4.0, version 1.2.3",
    "[a link](https://example.org/0.5%20s), 2 cores, seed 0, 16 starts, 3 m deep",
    "```\nsleep 10.5\n```\n\n```python\nx = 0.5\n```",
])  # fmt: skip
def test_what_is_no_measured_figure_is_left_alone(text):
    assert list(figures.find_figures(f"Before, {text}.", [])) == []


def test_constants_have_reasons_and_words_of_their_page():
    constants = yaml.safe_load((ROOT / "docs" / "constants.yaml").read_text(encoding="utf-8"))
    assert {*constants} <= {page.name for page in figures.PAGES}
    for page, reasons in constants.items():
        for reason, fragments in reasons.items():
            assert len(reason) > 5 and fragments, page
            for fragment in fragments:
                # A figure alone would allow it anywhere.
                assert re.search(r"[^\W\d_]{3}", fragment), f"{page}: {fragment}"
