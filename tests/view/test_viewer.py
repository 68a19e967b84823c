"""Replay pages of episodes and colonies: what they receive, and what a real browser makes of it."""

import base64
import json
import math
import re
import zlib
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from browser import Browser, needs_browser
from laboratory import ROOT, WATER, body, box_robot, world
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.episodes.champion import Episode
from mjx_revolve.episodes.simulate import Trajectory
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.view.episode_data import episode_data
from mjx_revolve.view.forces import module_forces, sum_modules
from mjx_revolve.view.page_data import RobotMeshes, pack_poses
from mjx_revolve.view.poses import pose_robot
from mjx_revolve.view.recording import Mark, ReplayRobot
from mjx_revolve.view.swim_picture import pose_scenes
from mjx_revolve.view.viewer import write_colony_page, write_viewer
from mjx_revolve.viewer import main
from mjx_revolve.water.flow import Water, surface, water_of
from mjx_revolve.water.world import load_world
from references import rotation

PAGE = ROOT / "mjx_revolve" / "view" / "viewer_page"
DT = 0.005
SPEED = 0.06


def made_up(robot, duration: float = 10.0) -> Trajectory:
    """A swim that nothing simulated: ahead along x at a constant speed, all hinges waving."""
    model = robot.mj_model
    time = DT * np.arange(1, round(duration / DT) + 1)
    qpos = np.repeat(robot.start_qpos(2.0)[None], len(time), 0)
    qvel = np.zeros((len(time), model.nv))
    qpos[:, 0], qvel[:, 0] = SPEED * time, SPEED
    turn = 0.3 * np.sin(time)
    qpos[:, 3], qpos[:, 6], qvel[:, 5] = np.cos(turn / 2), np.sin(turn / 2), 0.3 * np.cos(time)
    phase = 4 * time[:, None] + np.arange(model.nq - 7)
    qpos[:, 7:], qvel[:, 6:] = 0.6 * np.sin(phase), 2.4 * np.cos(phase)
    count = len(time)
    command = np.full((count, robot.num_thrusters), 0.6)
    return Trajectory(
        time, qpos, qvel, np.zeros((count, model.nbody, 3)), np.zeros((count, model.nu)),
        np.zeros(count), command,
    )  # fmt: skip


@pytest.fixture(scope="module")
def robots():
    world = load_world("lake")
    return {name: build_robot(body(name), world) for name in ("spider", "snake", "gecko")}


@pytest.fixture(scope="module")
def episode(robots):
    """Ten seconds of a spider in the lake."""
    robot = robots["spider"]
    return Episode("spider: made up", robot, made_up(robot), 0.15, "body lengths/s")


@pytest.fixture(scope="module")
def data(episode):
    return episode_data(episode)


def unpack(packed, *shape):
    if "f32" in packed:
        return np.frombuffer(base64.b64decode(packed["f32"]), "<f4").reshape(shape).astype(float)
    whole = np.frombuffer(base64.b64decode(packed["i16"]), "<i2").reshape(shape)
    return packed["scale"] * whole.astype(float)


def poses(robot, count, seed=0):
    """Any poses: turned anyhow, hinges anywhere."""
    random = np.random.default_rng(seed)
    qpos = random.normal(size=(count, 7 + robot.num_hinges))
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    return qpos


def swim(robot, name, begin, until, place=(0.0, 0.0), rate=20.0, **more):
    """Level, along x, hinges waving."""
    time = np.arange(begin, until, 1 / rate)
    qpos = np.zeros((len(time), 7 + robot.num_hinges))
    qpos[:, 0], qpos[:, 1] = place[0] + 0.1 * (time - begin), place[1]
    qpos[:, 2], qpos[:, 3] = -1.0, 1.0
    qpos[:, 7:] = 0.5 * np.sin(2 * np.pi * time[:, None] + np.arange(robot.num_hinges))
    return ReplayRobot(name, robot, time, qpos, **more)


def bend(tree, qpos):
    """Places and rotations of the bodies, as the page finds them from its tree."""
    found = []
    for k, (parent, *x) in enumerate(tree):
        if parent < 0:
            found.append((qpos[:3], rotation(qpos[3:7])))
            continue
        place, turn = found[parent]
        half, axis = qpos[6 + k] / 2, np.array(x[7:])
        hinge = rotation([np.cos(half), *np.sin(half) * axis])
        found.append((place + turn @ x[:3], turn @ rotation(x[3:7]) @ hinge))
    return found


@pytest.mark.parametrize("name", ["spider", "snake", "gecko"])
def test_bodies_are_where_mujoco_has_them(robots, name):
    robot = robots[name]
    tree = meshes_of(robot).bodies[0]["tree"]
    qpos = poses(robot, 5)
    expected = pose_robot(robot, qpos)
    for row, q in enumerate(qpos):
        places, found = map(np.array, zip(*bend(tree, q), strict=True))
        assert places == pytest.approx(expected.position[row, 1:], abs=1e-5)
        turns = np.array([rotation(quat) for quat in expected.quaternion[row, 1:]])
        assert found == pytest.approx(turns, abs=1e-5)


def meshes_of(*robots):
    meshes = RobotMeshes()
    for robot in robots:
        meshes.add(robot)
    return meshes


def test_pieces_put_together_are_the_robot(robots):
    robot = robots["spider"]
    meshes, [q] = meshes_of(robot), poses(robot, 1)
    frames, corners = bend(meshes.bodies[0]["tree"], q), []
    for number, shape, _, *x in meshes.bodies[0]["pieces"]:
        mesh = {key: unpack(x, -1, 3) for key, x in meshes.shapes[shape].items()}
        local = mesh["vertices"][mesh["faces"].astype(int).ravel()]
        place, turn = frames[number]
        corners.append((local @ rotation(x[3:]).T + x[:3]) @ turn.T + place)
    (scene,) = pose_scenes(robot, q[None])
    # The scene has rods along the hinges' axes besides, after each module's parts.
    rods = np.all(np.isclose(scene.color, (1.0, 0.47, 0.1)), axis=1)
    expected = scene.corners[~rods].reshape(-1, 3)
    found = np.concatenate(corners)  # in another order
    assert len(found) == len(expected)
    assert cKDTree(expected).query(found)[0].max() < 5e-5
    assert cKDTree(found).query(expected)[0].max() < 5e-5


def unpack_poses(packed, widths):
    raw = zlib.decompress(base64.b64decode(packed["poses"]))
    rows = packed["rows"]
    times = np.split(np.frombuffer(raw[: 4 * sum(rows)], "<f4"), np.cumsum(rows)[:-1])
    low, high = np.frombuffer(raw[4 * sum(rows) :], np.uint8).reshape(2, -1).astype(np.int64)
    steps = ((low | high << 8) + 2**15) % 2**16 - 2**15
    found, at = [], 0
    for k, (count, width) in enumerate(zip(rows, widths, strict=True)):
        whole = np.cumsum(steps[at : at + count * width].reshape(width, count), axis=1).T
        at += count * width
        place, quat, hinge = packed["steps"]
        size = np.r_[[place] * 3, [quat] * 4, [hinge] * (width - 7)]
        found.append((times[k], whole * size + np.r_[packed["origins"][k], np.zeros(width - 3)]))
    return found


@pytest.mark.parametrize("steps", [(1e-3, 5e-4, 2e-3), (2e-5, 5e-5, 1e-3)])
def test_poses_come_back(robots, steps):
    given, times = [], [np.linspace(5, 9, 400)] * 3
    for robot in robots.values():
        qpos = poses(robot, 400, seed=len(given))
        qpos[:, :3] = 0.1 * np.cumsum(qpos[:, :3], axis=0) + 200.0
        qpos[200:, 3:7] *= -1  # the same turns
        given.append(qpos)
    packed = pack_poses(times, given, steps)
    step = packed["steps"][0]
    assert packed["steps"][1:] == steps[1:] and step >= steps[0]
    for expected, (time, qpos) in zip(given, unpack_poses(packed, [15, 15, 13]), strict=True):
        assert time == pytest.approx(times[0], rel=1e-6)
        assert qpos[:, :3] == pytest.approx(expected[:, :3], abs=0.51 * step)
        assert qpos[:, 7:] == pytest.approx(expected[:, 7:], abs=0.51 * steps[2])
        assert np.abs((qpos[:, 3:7] * expected[:, 3:7]).sum(1)) == pytest.approx(1, abs=2e-3)


def data_of(path):
    text = path.read_text(encoding="utf-8")
    given = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)
    return text, json.loads(given.group(1))


def test_a_page_keeps_as_many_poses_as_fit(robots, tmp_path):
    random = np.random.default_rng(3)
    given = []
    for k, robot in enumerate(robots.values()):
        actor = swim(robot, f"robot {k}", 0, 100)
        noisy = actor.qpos + 0.2 * random.normal(size=actor.qpos.shape)
        given.append(ReplayRobot(actor.name, robot, actor.time, noisy))
    path = tmp_path / "colony.html"
    whole = write_colony_page(given, path, "all")
    assert (whole.poses, whole.gap) == (3 * 2000, 0.0)
    assert whole.bytes == path.stat().st_size
    bare = whole.bytes - len(data_of(path)[1]["poses"])
    most = bare + (whole.bytes - bare) // 3
    less = write_colony_page(given, path, "some", window=(50, 60), most=most)
    assert less.bytes <= most and 0.05 < less.gap < 4
    _, data = data_of(path)
    for one, (time, _) in zip(given, unpack_poses(data, [15, 15, 13]), strict=True):
        inside = (time >= 50) & (time <= 60)
        assert inside.sum() == 201
        outside = np.diff(time[time < 50])
        assert outside.min() > 0.5 * less.gap and outside.max() < 2 * less.gap + 0.05
        assert time[[0, -1]] == pytest.approx(one.time[[0, -1]])


def test_an_episode_is_a_colony_of_one(episode, data):
    q = np.asarray(episode.trajectory.qpos)
    assert (len(data["robots"]), data["many"], data["rows"]) == (1, False, [500])
    assert (data["begin"], data["last"]) == (DT, pytest.approx(9.985))
    [(time, found)] = unpack_poses(data, [15])
    assert np.diff(time) == pytest.approx(0.02, abs=1e-5)
    assert found[:, :3] == pytest.approx(q[::4, :3], abs=2e-5)
    assert found[:, 7:] == pytest.approx(q[::4, 7:], abs=6e-4)
    assert unpack(data["episode"]["speed"], -1) == pytest.approx(np.full(500, SPEED), rel=1e-4)
    assert data["episode"]["heading"] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.slow
def test_forces(episode, data):
    forces = module_forces(episode.robot, episode.trajectory, 4)
    for name in ("buoyancy", "drag"):
        expected = sum_modules(episode.robot, getattr(forces, name))
        given = data["episode"]["forces"][name]
        assert unpack(given["force"], *expected.shape) == pytest.approx(
            expected, abs=2e-5 * float(np.abs(expected).max())
        )
        size = given["scale"] * np.linalg.norm(expected, axis=-1)
        assert size.max() <= 0.6501 * data["size"]
        assert np.percentile(size, 75) <= 0.3001 * data["size"]
    assert data["episode"]["forces"]["thrust"]["scale"] == 0
    anchors = np.array([a["place"] for a in data["episode"]["anchors"]])
    assert anchors.shape == (episode.robot.morphology.num_modules, 3)


def small_episode(tank, **fields) -> Episode:
    robot = box_robot((0.1, 0.08, 0.06), 0.4, tank)
    return replace(Episode("box", robot, made_up(robot, 0.5)), **fields)


def test_waves():
    sea = world(**WATER, waves=[
        {"amplitude": 0.05, "wavelength": 2.0, "direction": 0.7, "phase": 1.0},
        {"amplitude": 0.0, "wavelength": 1.0},
        {"amplitude": 0.02, "period": 1.0},
    ], current=(0.1, 0.2, 0.0))  # fmt: skip
    episode = small_episode(sea)
    begun = water_of(sea)._replace(time=3.0)
    episode = replace(episode, water=begun)
    waves = episode_data(episode)["world"]["waves"]
    assert len(waves) == 2
    x, y, time = 0.4, -1.3, 0.37
    height = sum(
        w["amplitude"]
        * math.cos(w["k"] * (w["x"] * x + w["y"] * y) - w["omega"] * time + w["phase"])
        for w in waves
    )
    expected, _ = surface(sea, begun._replace(time=3.0 + time), x, y)
    assert height == pytest.approx(float(expected), abs=1e-6)


def test_stops_where_numbers_end():
    episode = small_episode(world())
    qvel = np.array(episode.trajectory.qvel)
    qvel[60:, 1] = np.nan
    lost = replace(episode, trajectory=replace(episode.trajectory, qvel=qvel))
    assert episode_data(lost)["rows"] == [15]
    # So do gusts, which have a row for each of the trajectory.
    gusty = replace(lost, water=Water(0.0, (0.0, np.full(100, 0.5), 0.0)))
    drift = unpack(episode_data(gusty)["episode"]["drift"], -1, 3)
    assert drift[-1] == pytest.approx([0, 0.14, 0], rel=1e-4)
    qvel[0] = np.inf
    with pytest.raises(InputError, match="qpos: expected finite numbers in its first row"):
        episode_data(replace(episode, trajectory=replace(episode.trajectory, qvel=qvel)))


@pytest.fixture(scope="module")
def page(episode, tmp_path_factory):
    path = tmp_path_factory.mktemp("viewer") / "new" / "spider.html"
    write_viewer(episode, path)
    return path


@pytest.fixture(scope="module")
def colony(robots, tmp_path_factory):
    """Three robots: one all the time, one that is born, one that dies."""
    path = tmp_path_factory.mktemp("colony") / "new" / "colony.html"
    given = [
        swim(robots["spider"], "first", 0, 20, info={"parents": "none", "energy": 1.23456}),
        swim(robots["gecko"], "later <b>", 8, 20, (0.2, 0.8)),
        swim(robots["snake"], "brief", 0, 5, (0.2, -0.8), end=5.0),
    ]
    marks = [Mark("clinic", (0.0, 0.0, -1.5), 1.0)]
    write_colony_page(given, path, "Three {{lives}}</title>", marks=marks)
    return path


def test_files(page, colony, data):
    assert page.stat().st_size < 1.5e6
    for path, title in ((page, "spider: made up"), (colony, "Three {{lives}}&lt;/title&gt;")):
        text, given = data_of(path)
        assert not re.search(r"\{\{[A-Z_]+\}\}", text)
        assert not re.search(r"""(src|href)=["'](?!data:)""", text)
        assert "three.js authors" in text and "MIT License" in text
        assert f"<title>{title}</title>" in text and "later <b>" not in text
    assert data_of(page)[1] == json.loads(json.dumps(data))
    assert "0.15 body lengths/s over fresh starts" in page.read_text()
    assert [one["name"] for one in given["robots"]] == ["first", "later <b>", "brief"]
    assert given["robots"][0]["info"] == {"parents": "none", "energy": "1.235"}
    assert [(x["start"], x["end"]) for x in given["robots"]] == [(0, None), (8, None), (0, 5)]
    assert (given["begin"], given["last"]) == (0, pytest.approx(19.95))
    assert given["marks"][0]["radius"] == 1.0


@pytest.mark.parametrize(
    "time, change, match",
    [
        (np.arange(3.0), lambda q: q[:, :-1], r"qpos: expected \[T, 15\].*found \[3, 14\]"),
        (np.arange(3.0), lambda q: q * np.nan, "expected finite times and poses"),
        (np.array([0.0, 2.0, 1.0]), lambda q: q, "time: expected rising times"),
    ],
)
def test_poses_are_checked(robots, tmp_path, time, change, match):
    one = ReplayRobot("one", robots["spider"], time, change(poses(robots["spider"], 3)))
    with pytest.raises(InputError, match=f"robot 'one': .*{match}|robot 'one': {match}"):
        write_colony_page([one], tmp_path / "page.html", "wrong")
    assert not list(tmp_path.iterdir())


SIZE = (480, 300)


@pytest.fixture(scope="module")
def browser():
    with Browser(*SIZE) as open_browser:
        yield open_browser


@pytest.mark.slow
@needs_browser
def test_page_opens_and_plays(browser, page):
    browser.open(page, "#plain")
    assert browser.fact("error") is None
    assert float(browser.fact("time")) >= DT - 1e-9
    browser.wait("document.documentElement.dataset.time > 0.3")
    first = float(browser.fact("time"))
    browser.wait(f"document.documentElement.dataset.time > {first + 0.1}")
    browser.press(" ")
    browser.wait("document.documentElement.dataset.playing === 'false'")
    assert browser.errors == []
    assert [address for address in browser.requests if not address.startswith("file:")] == []


@pytest.mark.slow
@needs_browser
def test_the_browser_poses_robots_as_mujoco_does(browser, colony, robots):
    browser.open(colony, "#plain&paused")
    [q] = poses(robots["snake"], 1, seed=4)
    source = "const PALETTE = {};" + (PAGE / "robots.js").read_text(encoding="utf-8")
    tree = json.dumps(meshes_of(robots["snake"]).bodies[0]["tree"])
    found = browser.evaluate(f"""(() => {{ {source}
        const tree = readTree({tree}), bones = new Float32Array(8 * tree.length);
        poseTree(tree, {json.dumps(q.tolist())}, bones);
        return [...bones]; }})()""")
    bones, expected = np.reshape(found, (-1, 8)), pose_robot(robots["snake"], q[None])
    assert bones[:, :3] == pytest.approx(expected.position[0, 1:], abs=2e-5)
    quat = expected.quaternion[0, 1:][:, [1, 2, 3, 0]]
    assert np.abs((bones[:, 4:] * quat).sum(1)) == pytest.approx(1, abs=1e-5)


CORE = str(ROOT / "morphologies" / "core.yaml")


@pytest.mark.slow
def test_command(tmp_path, monkeypatch, capsys, quick_compiles):
    monkeypatch.chdir(tmp_path)
    assert main([CORE, "--duration", "0.2", "--world", "lake", "--seed", "3"]) == 0
    assert re.match(r"core\.html: 0\.2 s, 0\.\d\d MB; open it", capsys.readouterr().out)
    # Once is enough to simulate.
    loader = "mjx_revolve.episodes.champion.load_episode"
    monkeypatch.setattr(loader, lambda *_: small_episode(world()))
    assert main([CORE]) == 0
    assert run_command(main, [CORE]) == 2
    assert capsys.readouterr().err.startswith("error: box.html: expected no such file yet; name")
    assert main([CORE, "--out", "box.html"]) == 0
