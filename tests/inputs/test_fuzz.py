"""Malformed files (`malformed.py`, `make fuzz`): read as something valid, or refused in a line."""

import dataclasses
import json
import math
import os
import re
import shutil

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

import malformed
import toys
from laboratory import ARM, ELBOW, ROOT
from malformed import (
    VALUES,
    Mutant,
    check_finite,
    check_message,
    fuzz,
    mutants,
    read_file,
    run_main,
    watching,
    wrecks,
)
from mjx_revolve import evolve, inspect, viewer
from mjx_revolve.body.catalogue import load_modules
from mjx_revolve.body.morphology import load_morphology
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.episodes import champion
from mjx_revolve.episodes.config import dump_config, load_config
from mjx_revolve.evolution import run as runs
from mjx_revolve.evolution.run_folder import load_archive
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.view import results
from mjx_revolve.view.report.data import read_run
from mjx_revolve.water.world import load_world


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """An own folder, current, with a robot in it."""
    path = tmp_path_factory.mktemp("fuzz")
    (path / "elbow.yaml").write_text(ELBOW)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(path)
        yield path
    assert not list(path.rglob(malformed.SENTINEL))


def keep(folder, name, mutant):
    (folder / name).write_bytes(mutant.content)
    return folder / name


def refused(found):
    return isinstance(found, InputError)


ROBOT = """
id: mixed
body:
  id: core
  type: Core
  params: {red: 0.3, green: 0.5, blue: 0.2, ballast: 0.01, ballast_position: [0, 0, -0.01]}
  children:
    0: {id: push, type: Thruster, params: {thrust: 0.8, thruster: {torque_ratio: -0.002}}}
    1: {id: hip, type: ActiveHinge, orientation: 90, children: {1: {type: FixedBrick, id: foot}}}
    2: {type: Fin, orientation: -90, params: {lift_drag: {cla: 2.0}, drag: lift_drag}}
    3: {type: FixedBrick, params: {mass: "0.02;", volume: 1e-5, buoyancy: mask, added_mass: off}}
brain: {type: cpg, period: [1, 2.5, null]}
"""
ROBOTS = (ARM, ELBOW, ROBOT)
# What a brain is, others know; so do those who write into `params` what we do not.
FREE = re.compile(r"^brain\b|\bparams\.foo$")


@pytest.mark.slow
@fuzz(80)
@given(mutants(*ROBOTS) | wrecks(*(text.encode() for text in ROBOTS)))
@example(Mutant(b"{body: {type: Core}, brain: &a !!omap [b: *a]}"))
@example(Mutant(b"{body: {type: Core, params: {mas: 0.2}}}", "body.params.mas"))
@example(Mutant(b'{id: "a\\0", body: {type: Core}}'))
def test_morphologies(folder, mutant):
    path = keep(folder, "robot.yaml", mutant)
    body = read_file(lambda: load_morphology("robot.yaml"), folder, "robot.yaml")
    assert (run_main(inspect.main, ["robot.yaml"], folder, "robot.yaml") == 2) == refused(body)
    if refused(body):
        return
    assert not mutant.strange or FREE.search(mutant.strange), mutant.strange
    check_finite([body.mass, body.volume, *body.extent.tolist(), *body.descriptors.values()])
    assert body.mass > 0
    body.save(path)
    assert load_morphology(path) == body


CATALOGUE = """
modules:
  Flipper:
    mount: -x
    hinge: {axis: [0, 1, 0], anchor: [0.00465, 0, 0], range: [-0.6, 0.6], effort: 0.2, speed: 5}
    parts:
      - {name: holder, size: [0.022, 0.036, 0.010], mass: 0.002}
      - name: blade
        position: [0.04, 0, 0]
        boxes: [{size: [0.06, 0.04, 0.002]}, {size: [0.002, 0.04, 0.01], position: [0.03, 0, 0]}]
        mass: 0.006
        volume: 4.0e-6
        ballast_mass: 0.001
        drag: ellipsoid
        entrained_water: 0.5
    slots: {1: +x}
    sensor: false
    aliases: [Paddle]
  Tail:
    mount: {position: [-0.03, 0, 0], outward: [1, 0, 0]}
    parts:
      - size: [0.06, 0.04, 0.002]
        mass: 0.005
        lift_drag: {cla: 2.0, cda: 0.3, alpha_stall: 0.5, forward: [-1, 0, 0], upward: [0, 0, 1]}
  Jet:
    mount: -x
    parts: [{size: [0.04, 0.03, 0.03], mass: 0.02, thruster: {axis: [1, 0, 0], gain: 0.5}}]
  Heart:
    mount: null
    parts: [{size: [0.09, 0.09, 0.045], mass: 0.09}]
    slots: {1: {position: [0, 0.045, 0], direction: [0, 1, 0], up: [0, 0, 1]}}
"""
OWN = "body: {type: Heart, children: {1: {type: Flipper, children: {1: {type: Tail}}}}}"


@fuzz(50)
@given(mutants(CATALOGUE) | wrecks(CATALOGUE.encode()))
def test_catalogues(folder, mutant):
    keep(folder, "modules.yaml", mutant)
    (folder / "own.yaml").write_text(OWN)
    kinds = read_file(lambda: load_modules("modules.yaml"), folder, "modules.yaml")
    argv = ["own.yaml", "--modules", "modules.yaml"]
    code = run_main(inspect.main, argv, folder, "modules.yaml", "own.yaml")
    if refused(kinds):
        assert code == 2
        return
    # Names of types and numbers of slots are the user's own.
    known = not mutant.strange or re.fullmatch(r"modules\.[^.]+|.*slots\.[^.]+", mutant.strange)
    assert known, mutant.strange
    check_finite([dataclasses.asdict(kind) for kind in kinds.values()])
    assert all(kind.mass >= 0 for kind in kinds.values())


WORLDS = (
    """
name: bay
density: 1025
viscosity: 1.1e-3
gravity: 9.81
surface_height: 0.0
current: [0.1, 0, 0]
bed: {kind: lake, height: -20, highest: 5, extent: 500, stiffness: 2000, friction: 0.5}
buoyancy: partial
drag: faces
added_mass: true
lift_drag: {cla: 2.0, cda: 0.3, alpha_stall: 0.5}
shear: {velocity: [0.1, 0, 0], depth: 10, profile: power, exponent: 0.2}
gust: {std: 0.05, time: 8}
waves: [{amplitude: 0.1, wavelength: 5, direction: 0.3}, {amplitude: 0.05, period: 2, phase: 1}]
water_depth: 20
surface_tension: {gamma: 0.07, contact_angle: 0.5}
timestep: 0.005
""",
    "{current_field: field.csv, bed: -3, waves: off, gravity: [0, 0, -9.81], drag: off}",
)


@pytest.mark.slow
@fuzz(50)
@given(mutants(*WORLDS))
@example(Mutant(b"{density: !!int ''}"))
@example(Mutant(b"{gust: {std: !!timestamp x}}"))
@example(Mutant(b"{bed: 7.1e+286}"))
@example(Mutant(b"{name: !!set {a}}"))
def test_worlds(folder, mutant):
    assume(b"/etc/passwd" not in mutant.content)  # a field's absolute path is read, whatever it is
    keep(folder, "world.yaml", mutant)
    (folder / "field.csv").write_text("x,y,z,u,v,w\n0,0,0,.1,0,0\n1,0,0,.2,0,0\n")

    def read():
        world = load_world("world.yaml")
        build_robot(load_morphology("core"), world).assembly  # noqa: B018
        return world

    places = ("world.yaml", "timestep:", "robot", "core")
    world = read_file(read, folder, *places)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(champion, "simulate", malformed.stop)
        argv = ["core", "--world", "world.yaml", "--out", "page.html"]
        code = run_main(viewer.main, argv, folder, *places)
    assert (code == 2) == refused(world)
    if refused(world):
        return
    assert not mutant.strange, mutant.strange
    plain = {f.name: getattr(world, f.name) for f in dataclasses.fields(world)}
    del plain["current_field"]
    check_finite(json.loads(json.dumps(plain, default=dataclasses.asdict)))


CONFIGS = tuple((ROOT / "configs" / f"{name}.yaml").read_text().replace("../morphologies/", "")
                for name in ("lake_swim", "auv_hold_depth", "lake_map_elites"))  # fmt: skip
# What only a strategy, a genotype or a user's own function knows.
OPEN = re.compile(r"(^|\.)(strategy_params|params|axes)\.[^.]+$")


def make_toy(config):
    return toys.make_toy_bodies(config) if config.bodies else toys.Quadratic()


@pytest.mark.slow
@fuzz(50)
@given(mutants(*CONFIGS) | wrecks(*(text.encode() for text in CONFIGS)))
@example(Mutant(b"[" * 5000 + b"}"))
@example(Mutant(b"- " * 5000))
@example(Mutant(b"{morphology: auv.yaml, world: [1], task: {type: speed}}"))
@example(Mutant(b"{morphology: auv.yaml, world: {name: lake, 1: 2}, task: {type: speed}}"))
@example(
    Mutant(
        b"{morphology: auv.yaml, world: lake, task: {type: speed}, "
        b"evolution: {strategy_params: {1: 2, a: 3}}}"
    )
)
def test_configurations(folder, mutant):
    keep(folder, "config.yaml", mutant)
    for name in ("spider", "auv"):
        (folder / f"{name}.yaml").write_bytes((ROOT / "morphologies" / f"{name}.yaml").read_bytes())

    def read():
        config = load_config("config.yaml")
        load_world(config.world_name, **config.world_overrides)
        return config

    places = ("config.yaml", "world")
    config = read_file(read, folder, *places)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runs, "create_run_folder", malformed.stop)
        argv = ["config.yaml", "--out", "out", "--workers", "1"]
        code = run_main(lambda argv: evolve.main(argv, make_toy), argv, folder, *places)
    if refused(config):
        assert code == 2 or str(config).startswith("world")  # which the toys have none of
        return
    assert not mutant.strange or OPEN.search(mutant.strange), mutant.strange
    check_finite({k: v for k, v in config.model_dump().items() if k != "world"})
    (folder / "again.yaml").write_text(dump_config(config, folder))
    assert load_config(folder / "again.yaml").model_dump() == config.model_dump()


GENES = """
score: 0.5
score_std: 0.1
origin: best of generation 7
controller: sine
measures: {distance_m: 3.5}
final: true
config: plain.yaml
genes: [0.5, -1.25, 3.0e-05, 1, -2]
"""


class Brainless:
    """A fitness of five genes that has nothing to show."""

    num_genes = 5
    robot = property(malformed.stop)


@fuzz(40)
@given(mutants(GENES) | wrecks(GENES.encode()))
@example(Mutant(b"{config: plain.yaml, genes: [0, 0, 0, 0, .nan]}"))
@example(Mutant(b"{config: plain.yaml, genes: [0, 0, 0, 0, 1e39]}"))
@example(Mutant(b"{config: plain.yaml, genes: [0, 0, 0, 0, 0x%s]}" % (b"f" * 5000)))
def test_brains(folder, mutant):
    keep(folder, "genes.yaml", mutant)
    (folder / "plain.yaml").write_text(CONFIGS[0])
    genes = read_file(lambda: champion.load_genes("genes.yaml"), folder, "genes.yaml")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(champion, "make_fitness", lambda config: Brainless())
        patch.setattr(champion, "build_robot", malformed.stop)  # a morphology, for all we know
        argv = ["genes.yaml", "--out", "page.html"]
        code = run_main(viewer.main, argv, folder, "genes.yaml", "plain.yaml", *NAMED)
    if refused(genes):
        assert code == 2
    else:
        check_finite(genes.tolist())


# Files that genes may name as their configuration.
NAMED = ("own.py", ".", "/", "elbow.yaml")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Two runs of toys: of genes, and of bodies."""
    path = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(path)
        (path / "elbow.yaml").write_text(ELBOW)
        config = {
            "morphology": "elbow.yaml", "world": "lake", "task": {"type": "speed"},
            "evolution": {"strategy": "SNES", "generations": 3, "checkpoint_every": 1,
                          "population_size": 6},
        }  # fmt: skip
        (path / "genes.yaml").write_text(json.dumps(config))
        archive = {"axes": {"num_hinges": {"low": 0, "high": 4, "cells": 4},
                            "proportion": {"low": 0, "high": 1, "cells": 2}}}  # fmt: skip
        bodies = {"selection": {"type": "map_elites"}, "archive": archive}
        toys.write_bodies_config(path / "bodies.yaml", bodies, generations=3)
        for name in ("genes", "bodies"):
            argv = [f"{name}.yaml", "--out", name, "--workers", "1"]
            with patch.context() as inner:
                inner.setattr(results, "save_pictures", lambda *_: None)
                assert evolve.main(argv, make_toy) == 0
    return path


RUNS = st.sampled_from(["genes", "bodies"])
FILES = ("config.yaml", "run.json", "metrics.csv", "individuals.jsonl", "generations.jsonl",
         "champion/genes.yaml", "champion/morphology.yaml", "inputs/elbow.yaml", ".lock",
         "checkpoints/generation_000003.npz", "checkpoints", "champion")  # fmt: skip
KINDS = st.sampled_from(["bytes", "bytes", "values", "values", "folder", "pipe", "loop", "endless",
                         "elsewhere"])  # fmt: skip


def damage(path, kind, data):
    content = b"" if path.is_dir() else path.read_bytes()
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "loop":
        path.symlink_to(path.name)
    elif kind == "endless":
        path.symlink_to("/dev/zero")
    elif kind == "elsewhere":
        path.symlink_to("/nobody/has/this")
    elif kind == "bytes" or not content:
        path.write_bytes(data.draw(wrecks(content)).content)
    else:
        path.write_bytes(revalue(path.suffix, content, data))


def revalue(suffix, content, data):
    """A file's content with another value in it."""
    if suffix in (".yaml", ".json"):
        return data.draw(mutants(content.decode())).content
    if suffix == ".jsonl":
        first, *rest = content.splitlines()
        return b"\n".join([data.draw(mutants(first.decode())).content, *rest, b""])
    cells = content.decode().split(",")
    cells[data.draw(st.integers(0, len(cells) - 1))] = malformed.emit(data.draw(VALUES))
    return ",".join(cells).encode(errors="surrogatepass")


def look_around(folder, *places):
    """All that one can do with a run, up to where it takes long."""
    run = folder / "run"
    with watching(folder):
        for read in (read_run, load_archive):
            try:
                read("run")
            except InputError as error:
                check_message(str(error), "run", *places)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evolve, "_evolve", malformed.stop)
        argv = ["--resume", "run", "--workers", "1"]
        places = ("--resume run", run, "run", *places)
        run_main(lambda argv: evolve.main(argv, make_toy), argv, folder, *places)
        patch.setattr(champion, "make_fitness", malformed.stop)
        patch.setattr(champion, "fit_body", malformed.stop)
        run_main(viewer.main, ["run", "--out", "page.html"], folder, *places)
        argv = ["run", "--individual", "1", "--out", "page.html"]
        run_main(viewer.main, argv, folder, *places, "individual 1")


def copy_run(whole, folder, name):
    shutil.rmtree(folder / "run", ignore_errors=True)
    shutil.copytree(whole / name, folder / "run")
    return folder / "run"


@pytest.mark.slow
@fuzz(20)
@given(RUNS, KINDS, st.data())
def test_run_folders(folder, whole, name, kind, data):
    run = copy_run(whole, folder, name)
    there = [
        file for file in FILES if (run / file).exists() and (kind != "values" or ".npz" not in file)
    ]
    damage(run / data.draw(st.sampled_from(there)), kind, data)
    look_around(folder)


@pytest.mark.slow
@fuzz(12)
@given(RUNS, st.data())
def test_checkpoints_that_hold_something_else(folder, whole, name, data):
    run = copy_run(whole, folder, name)
    path = run / "checkpoints" / "generation_000003.npz"
    with np.load(path) as file:
        arrays = dict(file)
    name = data.draw(st.sampled_from(sorted(arrays)))
    how = data.draw(st.sampled_from(["remove", "shape", "type", "value", "meta", "meta"]))
    if how == "meta" or name == "meta":
        text = arrays["meta"].tobytes().decode()
        arrays["meta"] = np.frombuffer(data.draw(mutants(text)).content, np.uint8)
    elif how == "remove":
        del arrays[name]
    elif how == "shape":
        shape = data.draw(st.lists(st.integers(0, 9), max_size=3))
        arrays[name] = np.zeros(shape, arrays[name].dtype)
    else:
        kind = data.draw(st.sampled_from(["U9", "c16", "i8", "?", "f2"]))
        value = data.draw(st.sampled_from([0, 1, 99, -1, 2**31, math.nan, math.inf]))
        with np.errstate(all="ignore"):
            if how == "type":
                arrays[name] = arrays[name].astype(kind)
            else:
                arrays[name] = np.full_like(arrays[name], np.float64(value))
    np.savez(path, **arrays)
    look_around(folder)
