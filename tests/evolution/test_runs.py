"""The run folder: atomic files, metrics, checkpoints good and damaged, pictures."""

import csv
import errno
import io
import json
import os
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from laboratory import body, check_refused
from mjx_revolve.body.catalogue import load_modules
from mjx_revolve.body.morphology import load_morphology
from mjx_revolve.episodes.champion import load_genes
from mjx_revolve.episodes.config import OLDER_WORLD, load_config, make_config, override_config
from mjx_revolve.episodes.fitness import make_fitness
from mjx_revolve.evolution import run_folder as runs
from mjx_revolve.evolution.fingerprints import settings_hash
from mjx_revolve.evolution.run import _prepare, check_unchanged, claim_folder
from mjx_revolve.inputs.commands import check_place
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.yaml_reader import load_yaml
from mjx_revolve.water.world import load_world

ARRAYS = {
    "state['algorithm'].mean": np.arange(5, dtype=np.float32),
    "state['fresh']": np.asarray(False),
    "counter": np.asarray(7, np.int32),
    "wide": np.ones((2, 3), np.float64),
}


@pytest.fixture
def config(tmp_path):
    (tmp_path / "robot.yaml").write_text("id: robot\n")
    data = {"morphology": "robot.yaml", "world": "lake", "task": {"type": "speed"}}
    return make_config(data, tmp_path)


@pytest.fixture
def run(tmp_path, config):
    run, _ = runs.create_run_folder(tmp_path / "run", config, seed=3)
    yield run
    run.close()


def save(run, generation, keep=3):
    run.append_metrics({"generation": generation, "best": 0.1 * generation})
    return run.save_checkpoint(generation, ARRAYS, {"note": "x"}, keep)


@pytest.mark.parametrize("elsewhere", [False, True], ids=["beside", "elsewhere"])
def test_a_run_folder_is_whole(tmp_path, monkeypatch, elsewhere):
    monkeypatch.chdir(tmp_path)
    mine = tmp_path / "mine"
    for name in ("mine/fields", "mine/twin", "sea"):
        (tmp_path / name).mkdir(parents=True)
    field = "x,y,z,u,v,w\n0,0,0,1,0,0\n1,0,0,2,0,0\n"
    place = "sea" if elsewhere else "mine/fields"
    (tmp_path / place / "river.csv").write_text(field)
    named = tmp_path / "sea/river.csv" if elsewhere else "fields/river.csv"
    (mine / "sea.yaml").write_text(f"density: 1030.0\ncurrent_field: {named}\n")
    types = "modules: {M: {mount: null, parts: [{size: [.1, .1, .1], mass: .5}], slots: {1: +y}}}"
    (mine / "types.yaml").write_text(types)
    (mine / "own.py").write_text("def swim(track, settings): return 0.0\n")
    (mine / "grid.bin").write_bytes(b"\0\1")
    for name in ("robot.yaml", "twin/robot.yaml"):
        (mine / name).write_text(f"body: {{type: Core, id: {name[0]}}}\n")
    params = {"grid": str(mine / "grid.bin"), "words": "inputs", "list": [str(mine / "grid.bin")]}
    config = make_config(
        {"modules": "types.yaml", "world": "sea.yaml",
         "task": {"type": "own.py:swim", "params": params},
         "bodies": {"seeds": ["robot.yaml", "twin/robot.yaml"]}},
        mine,
    )  # fmt: skip
    world, began = load_world(config.world_name), settings_hash(config)
    run, own = runs.create_run_folder(tmp_path / "run", config)
    run.close()
    text = (run.path / "config.yaml").read_text()
    assert str(tmp_path) not in text
    check_unchanged(own, config, "--resume")
    os.rename(run.path, tmp_path / "moved")
    shutil.rmtree(mine)
    shutil.rmtree(tmp_path / "sea")
    moved = load_config(tmp_path / "moved" / "config.yaml")
    assert all(file.path.startswith(str(tmp_path / "moved" / "inputs")) for file in moved.files)
    assert len({file.path for file in moved.files}) == len(moved.files) - 1  # the grid, twice
    assert load_world(moved.world_name) == world and world.current_field is not None
    assert load_modules(moved.modules)
    assert [load_yaml(seed)["body"]["id"] for seed in moved.bodies.seeds] == ["r", "t"]
    assert Path(moved.task.params["grid"]).read_bytes() == b"\0\1"
    assert moved.task.params["words"] == "inputs"
    assert settings_hash(moved) == began
    # A copy that was edited is not taken for what the run began with.
    copy = tmp_path / "moved" / "inputs" / "sea.yaml"
    copy.write_text(copy.read_text().replace("1030", "1000"))
    with pytest.raises(InputError, match=r"sea.yaml: expected the file that the run began with"):
        load_config(tmp_path / "moved" / "config.yaml")


def test_a_world_mapping_keeps_its_field(tmp_path, config):
    (tmp_path / "river.csv").write_text("x,y,z,u,v,w\n0,0,0,1,0,0\n")
    river = {"world.current_field": str(tmp_path / "river.csv")}
    run, own = runs.create_run_folder(tmp_path / "run", override_config(config, river))
    run.close()
    assert own.world == {"name": "lake", "current_field": str(run.path / "inputs" / "river.csv")}
    assert settings_hash(own) == settings_hash(override_config(config, river))
    # Runs of older versions counted its path.
    by_path = settings_hash(own, by_path=True)
    assert by_path != settings_hash(override_config(config, river), by_path=True)


def test_older_run_folders_open(tmp_path, config):
    (tmp_path / "sea.yaml").write_text("density: 1030.0\n")
    run, _ = runs.create_run_folder(tmp_path / "run", config)
    run.save_config(override_config(run.load_config(), {"world": str(tmp_path / "sea.yaml")}))
    run.update_info(inputs=None)
    run.close()
    (run.path / "inputs" / "robot.yaml").write_text("id: edited\n")
    assert load_world(run.load_config().world_name).density == 1030.0


def test_older_runs_keep_the_values_of_their_time(tmp_path, config):
    changes = {"task.point": "core", "task.length": "rest"}
    older = override_config(
        config, changes | {"controller.rate": None, "controller.between": "hold"}
    )
    run, _ = runs.create_run_folder(tmp_path / "run", older)
    text = (run.path / "config.yaml").read_text()
    for line in ("point: core", "length: rest", "horizon: null", "rate: null", "between: hold"):
        assert f"\n  {line}\n" in text
        text = text.replace(f"  {line}\n", "")
    (run.path / "config.yaml").write_text(text)
    run.close()
    found = run.load_config()
    assert (found.task.point, found.task.length) == ("core", "rest")
    assert (found.controller.rate, found.controller.between) == (None, "hold")
    assert settings_hash(found) == settings_hash(older) != settings_hash(config)
    assert settings_hash(older) != settings_hash(override_config(older, {"controller.rate": 20.0}))
    assert config.task.point == "center_of_mass"  # a user's file without them is a new one


def test_older_runs_keep_the_drag_of_faces(tmp_path, config):
    pond = tmp_path / "pond.yaml"
    pond.write_text("drag: ellipsoid\n")
    for name, change, left_out, stated, law in (
        ("new", {}, (), "cross_flow", "cross_flow"),
        ("older", {"world.drag": "faces"}, ("drag",), None, "faces"),
        ("oldest", {"world": {"name": "lake"} | OLDER_WORLD}, tuple(OLDER_WORLD), None, "faces"),
        ("own", {"world": str(pond)}, (), None, "ellipsoid"),
    ):
        made = override_config(config, change)
        run, _ = runs.create_run_folder(tmp_path / name, made)
        began = settings_hash(made)
        text = yaml.safe_load((run.path / "config.yaml").read_text())
        for field in left_out:  # as it was written then
            assert text["world"].pop(field) == OLDER_WORLD[field]
            began = settings_hash(config)
        if stated:
            assert text["world"]["drag"] == stated
        (run.path / "config.yaml").write_text(yaml.safe_dump(text))
        run.close()
        found = run.load_config()
        assert load_world(found.world_name, **found.world_overrides).drag == law
        assert began == settings_hash(found, older_world=left_out)


def test_a_robot_that_nothing_moves_does_not_evolve():
    config = load_config("smoke", {"morphology": "core"})
    with pytest.raises(InputError, match=r"expected a robot with hinges or thrusters.*found none"):
        _prepare(config, lambda config: SimpleNamespace(fitness=make_fitness(config)))


def test_full_folder_is_refused(tmp_path, config):
    (tmp_path / "run").mkdir()
    run, _ = runs.create_run_folder(tmp_path / "run", config)  # empty is fine
    run.close()
    with pytest.raises(InputError, match="found files; continue it with --resume"):
        runs.create_run_folder(tmp_path / "run", config)
    with pytest.raises(InputError, match="expected a new or empty folder; found a file"):
        runs.check_new_folder(tmp_path / "robot.yaml")


def test_runs_that_lead_nowhere_are_no_place_for_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").symlink_to("scratch")
    check_refused("found a link that leads nowhere", check_place, "runs/a/b", "runs")
    with pytest.raises(FileExistsError):
        claim_folder("toy")


def test_a_folder_whose_making_was_cut_short_is_a_new_one(tmp_path, run, config):
    run.close()
    os.rename(run.path / "config.yaml", run.path / ".123-config.yaml")
    check_refused("one that was not begun; begin it with --out", runs.open_run_folder, run.path)
    again, _ = runs.create_run_folder(run.path, config)
    again.close()


def test_one_process_at_a_time(run):
    check_refused("a run that has stopped; found it running", runs.open_run_folder, run.path)
    run.close()
    runs.open_run_folder(run.path).close()


def test_a_failed_write_leaves_the_old_file(run):
    path = run.write("note.txt", b"old")

    def fail(path):
        path.write_bytes(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match="No space left") as caught:
        run.write("note.txt", fail)
    assert caught.value.filename == str(path)
    assert path.read_bytes() == b"old"
    assert not list(run.path.glob(".*note.txt"))


def test_metrics_are_rfc_4180_at_any_time(run):
    for generation in (1, 2):
        run.append_metrics({"generation": generation, "best, so far": np.float32(0.1) * generation})
        text = run.metrics_path.read_bytes().decode()
        assert text.endswith("\r\n")
        assert len(list(csv.reader(io.StringIO(text)))) == generation + 1
    read = run.load_metrics()
    assert list(read) == ["generation", "best, so far"]
    # Enough digits to get the same float32 back.
    assert np.array_equal(read["best, so far"].astype(np.float32), np.float32([0.1, 0.2]))


def test_metrics_keep_the_columns_that_a_run_began_with(run):
    run.append_metrics({"generation": 1, "best": 2.0, "old": 3.0})
    run.append_metrics({"new": 4.0, "best": 5.0, "generation": 2})
    read = run.load_metrics()
    assert list(read) == ["generation", "best", "old"]
    assert read["best"].tolist() == [2, 5] and np.isnan(read["old"][1])


@pytest.mark.parametrize("text", ["generation,b\r\n1,x\r\n", "generation,b\r\n1\r\n"])
def test_broken_metrics(tmp_path, text):
    (tmp_path / "metrics.csv").write_text(text)
    with pytest.raises(InputError, match=r"metrics.csv: expected a number in every cell"):
        runs.RunFolder(tmp_path).load_metrics()


def test_checkpoint_keeps_every_bit_and_dtype(run):
    save(run, 5)
    checkpoint = run.load_checkpoint()
    assert checkpoint.meta["generation"] == 5
    assert checkpoint.meta["note"] == "x"
    assert checkpoint.damaged == ()
    assert set(checkpoint.arrays) == set(ARRAYS)
    for name, value in ARRAYS.items():
        found = checkpoint.arrays[name]
        assert (found.dtype, found.shape) == (value.dtype, value.shape)
        assert found.tobytes() == value.tobytes()


def test_only_the_newest_stay(run):
    for generation in range(1, 6):
        save(run, generation, keep=2)
    names = [path.name for path in run.checkpoints()]
    assert names == ["generation_000005.npz", "generation_000004.npz"]


def flip(data, at):
    return data[:at] + bytes([data[at] ^ 0xFF]) + data[at + 1 :]


@pytest.mark.parametrize("damage", [
    lambda data: b"",
    lambda data: data[: len(data) // 2],
    lambda data: flip(data, data.index(ARRAYS["state['algorithm'].mean"].tobytes()) + 5),
    lambda data: flip(data, 200),
], ids=["empty", "half", "bit in an array", "bit in the meta"])  # fmt: skip
def test_a_damaged_checkpoint_is_passed_over(run, damage):
    save(run, 1)
    newest = save(run, 2)
    newest.write_bytes(damage(newest.read_bytes()))
    checkpoint = run.load_checkpoint()
    assert checkpoint.meta["generation"] == 1
    assert len(checkpoint.damaged) == 1
    assert checkpoint.damaged[0].startswith("generation_000002.npz (")


def test_pickles_are_not_read(run):
    save(run, 1)
    path = run.path / "checkpoints" / "generation_000002.npz"
    np.savez(path, meta=np.array([{"a": 1}], object))
    assert run.load_checkpoint().meta["generation"] == 1


def test_rewind_forgets_what_came_later(run):
    save(run, 1)
    text = run.metrics_path.read_bytes()
    newest = save(run, 2)
    newest.write_bytes(b"x")
    run.append_lines(runs.LOGS[0], ["{}"])
    (run.path / "checkpoints" / ".123-generation_000003.npz").touch()
    run.append_metrics({"generation": 3, "best": 1.0})
    run.rewind(run.load_checkpoint())
    assert run.metrics_path.read_bytes() == text
    assert (run.path / runs.LOGS[0]).read_bytes() == b""
    assert [path.name for path in run.checkpoints()] == ["generation_000001.npz"]
    assert not list((run.path / "checkpoints").glob(".*"))


def test_a_checkpoint_ahead_of_its_metrics_is_passed_over(run):
    save(run, 1)
    length = run.metrics_path.stat().st_size
    save(run, 2)
    os.truncate(run.metrics_path, length)
    checkpoint = run.load_checkpoint()
    assert checkpoint.meta["generation"] == 1
    assert "metrics.csv lacks lines" in checkpoint.damaged[0]
    run.metrics_path.write_bytes(b"\xef\xbb\xbf" + run.metrics_path.read_bytes())
    check_refused("has no line that ends at byte", run.load_checkpoint)


def test_a_checkpoint_ahead_of_its_logs_is_passed_over(run):
    run.append_lines(runs.LOGS[0], ["{}"])
    save(run, 1)
    os.truncate(run.path / runs.LOGS[0], 1)
    found = r"only damaged ones: generation_000001.npz \(individuals.jsonl lacks lines: 1 by"
    with pytest.raises(InputError, match=found):
        run.load_checkpoint()


@pytest.mark.parametrize(("key", "value"), [
    ("positions", {"../../thesis.tex": 0}), ("positions", [1]), ("generation", -1),
])  # fmt: skip
def test_a_checkpoint_cuts_no_other_files(run, key, value):
    path = save(run, 1)
    with np.load(path) as file:
        arrays = dict(file)
    meta = json.loads(arrays["meta"].tobytes()) | {key: value}
    np.savez(path, **arrays | {"meta": np.frombuffer(json.dumps(meta).encode(), np.uint8)})
    check_refused("only damaged ones: generation_000001.npz (meta: ", run.load_checkpoint)


@pytest.mark.parametrize("name", ["metrics.csv", "checkpoints"])
@pytest.mark.parametrize("what", ["link", "pipe"])
def test_a_run_writes_no_files_elsewhere_and_waits_for_none(run, tmp_path, name, what):
    run.save_config(load_config("smoke"))
    run.close()
    path = run.path / name
    if path.exists():
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    (tmp_path / "mine").mkdir()
    path.symlink_to(tmp_path / "mine") if what == "link" else os.mkfifo(path)
    found = "a link that leads out" if what == "link" else "something else"
    with pytest.raises(InputError, match=rf"{name}: expected a .+; found {found}$"):
        runs.open_run_folder(run.path)


def test_no_genes_stand_beside_another_body(run, monkeypatch):
    """Wherever it stops: where the disk is full after the body, there is no champion."""
    run.save_champion(np.zeros(2), body("spider"), score=0.1)
    write = run.write

    def fill(name, content):
        if name.endswith("genes.yaml"):
            raise OSError(errno.ENOSPC, "full")
        return write(name, content)

    monkeypatch.setattr(type(run), "write", staticmethod(fill))
    with pytest.raises(OSError, match="full"):
        run.save_champion(np.ones(2), body("gecko"), score=0.2)
    assert not (run.path / "champion" / "genes.yaml").exists()
    assert load_morphology(run.path / "champion" / "morphology.yaml") == body("gecko")


def test_champion_genes_come_back_bit_for_bit(run):
    genes = np.random.default_rng(0).normal(size=30).astype(np.float32)
    run.save_champion(genes, score=0.25, origin="test")
    for place in (run.path, run.path / "champion", run.path / "champion" / "genes.yaml"):
        assert load_genes(place).tobytes() == genes.tobytes()
    (run.path / "champion" / "genes.yaml").write_text("genes: [1, a]")
    check_refused("genes.yaml: genes.1: expected a number; found 'a'", load_genes, run.path)
    with pytest.raises(InputError, match=r"inputs: expected a run folder; found no config.yaml"):
        load_genes(run.path / "inputs")
    for huge in ("1" + 400 * "0", ".nan", "-.inf", "1e39", "true"):
        (run.path / "champion" / "genes.yaml").write_text(f"genes: [0.5, {huge}]")
        with pytest.raises(InputError, match=r"genes.1: expected a number.*; found .{1,60}$"):
            load_genes(run.path)
