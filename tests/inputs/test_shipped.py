"""Names of shipped files: where a path is taken, a name will do."""

from __future__ import annotations

import shutil

import pytest

from mjx_revolve.body.morphology import load_morphology
from mjx_revolve.episodes.config import load_config
from mjx_revolve.inputs.commands import check_episode_path
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.shipped import find_shipped, list_shipped


def test_names_and_paths_mean_the_same(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    configs = list_shipped("configs")
    assert list(configs) == sorted(configs) and {"lake_swim", "smoke"} <= configs.keys()
    assert load_config("lake_swim") == load_config(configs["lake_swim"])
    assert load_config("lake_swim").name == "lake_swim"
    assert load_morphology("spider").num_modules > 8
    assert load_config("smoke", ["morphology=snake"]).morphology.endswith("snake.yaml")
    check_episode_path("spider")


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
        (lambda: check_episode_path("spidr"), r"^spidr: expected a run folder, .*snake, spider\)$"),
        (lambda: load_config("smoke", ["morphology=spidr"]),
         r"^--set morphology: expected a file, or one of .*; found 'spidr'$"),
        (lambda: load_config("configs/none.yaml"), r"none.yaml: expected a file; found none$"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=words):
            read()
