"""Names of shipped files: where a path is taken, a name will do."""

import os
import re
import shutil

import pytest

from laboratory import refusal
from mjx_revolve import __main__, __version__
from mjx_revolve.body.catalogue import load_modules
from mjx_revolve.body.morphology import load_morphology
from mjx_revolve.episodes.champion import load_episode, load_genes
from mjx_revolve.episodes.config import load_config
from mjx_revolve.episodes.fitness import make_fitness
from mjx_revolve.episodes.run_reader import load_metrics
from mjx_revolve.evolution.run_folder import load_archive
from mjx_revolve.inputs.commands import check_episode_path, run_command
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.shipped import find_shipped, list_shipped
from mjx_revolve.view.report.data import read_run
from mjx_revolve.water.currents import load_current_field
from mjx_revolve.water.world import load_world


def test_names_and_paths_mean_the_same(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    configs = list_shipped("configs")
    assert list(configs) == sorted(configs) and {"lake_swim", "smoke"} <= configs.keys()
    assert load_config("lake_swim") == load_config(configs["lake_swim"])
    assert load_config("lake_swim").name == "lake_swim"
    assert load_morphology("spider").num_modules > 8
    assert load_config("smoke", ["morphology=snake"]).morphology.endswith("snake.yaml")
    check_episode_path("spider")


def test_help_lists_what_comes_with_the_package(capsys):
    for option in ("--help", "--version"):
        assert run_command(__main__._main, [option]) == 0
    out = capsys.readouterr().out
    assert "\n  lake_colony " in out and "auv, " in out
    assert out.endswith(f"mjx_revolve {__version__}\n")


def test_a_file_of_that_path_wins(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    shutil.copy(list_shipped("morphologies")["snake"], "spider")
    assert find_shipped("spider", "morphologies").read_text() == (tmp_path / "spider").read_text()
    assert (
        find_shipped("spider.yaml", "morphologies").name == "spider.yaml"
    )  # a path, and nothing there
    (tmp_path / "gecko").mkdir()  # a folder is no robot
    assert load_morphology("gecko").num_modules > 8


def test_wrong_names_list_the_shipped_ones(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for read, words in (
        (lambda: load_config("smoky"), r"^smoky: expected a file, or one of auv_.*smoke, .*none$"),
        (lambda: load_morphology("spidr"), r"^spidr: expected a file, or one of .*spider, .*none$"),
        (lambda: check_episode_path("spidr"), r"^spidr: expected a run folder, .*spider, .*"),
        (lambda: load_config("smoke", ["morphology=spidr"]),
         r"^--set morphology: expected a file, or one of .*; found 'spidr'$"),
        (lambda: load_config("configs/none.yaml"), r"none.yaml: expected a file; found none$"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=words):
            read()


LOADERS = (
    load_config, load_morphology, load_modules, load_world, load_current_field, make_fitness,
    load_archive, load_episode, load_genes, load_metrics, read_run,
)  # fmt: skip
STRANGE = {
    "none": None, "number": 5, "null byte": "a\0b.yaml", "no text": "\ud800.csv",
    "long": 5000 * "x" + ".yaml", "pipe": "pipe.yaml", "another pipe": "pipe.npz",
}  # fmt: skip


@pytest.mark.parametrize("load", LOADERS, ids=lambda load: load.__name__)
@pytest.mark.parametrize("path", STRANGE.values(), ids=STRANGE)
def test_what_is_no_path_and_no_file_is_refused_in_one_line(monkeypatch, tmp_path, load, path):
    monkeypatch.chdir(tmp_path)
    for name in ("pipe.yaml", "pipe.npz"):
        os.mkfifo(name)
    found = refusal(load, path)
    assert re.search("expected .*; found", found) and len(found) <= 400
