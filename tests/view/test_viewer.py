"""The replay page: what it is given, and what a real browser makes of it."""

from __future__ import annotations

import base64
import json
import math
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from browser import Browser, find_browser
from laboratory import QUICK, ROOT, WATER, body, box_robot, world
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.episodes import champion
from mjx_revolve.episodes.champion import Episode
from mjx_revolve.episodes.simulate import Trajectory
from mjx_revolve.inputs.commands import Parser, add_episode_arguments, run_command
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.view import page_data as page_data_module
from mjx_revolve.view.forces import module_forces, sum_modules
from mjx_revolve.view.motion import speed_over
from mjx_revolve.view.page_data import page_data
from mjx_revolve.view.swim_picture import pose_scene
from mjx_revolve.view.viewer import make_page, write_viewer
from mjx_revolve.viewer import main
from mjx_revolve.water.flow import Water, surface, water_of
from mjx_revolve.water.world import load_world

DT = 0.005
SPEED = 0.06


def made_up(robot, duration: float = 10.0) -> Trajectory:
    """A swim that nothing simulated: ahead along x at a constant speed, all hinges waving."""
    model = robot.mj_model
    time = DT * np.arange(1, round(duration / DT) + 1)
    qpos, qvel = (
        np.repeat(robot.start_qpos(2.0)[None], len(time), 0),
        np.zeros((len(time), model.nv)),
    )
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
def episode():
    """Ten seconds of a spider in the lake."""
    robot = build_robot(body("spider"), load_world("lake"))
    return Episode("spider: made up", robot, made_up(robot), 0.15, "body lengths/s")


@pytest.fixture(scope="module")
def data(episode):
    return page_data(episode)


def unpack(packed, *shape):
    if "f32" in packed:
        return np.frombuffer(base64.b64decode(packed["f32"]), "<f4").reshape(shape).astype(float)
    whole = np.frombuffer(base64.b64decode(packed["i16"]), "<i2").reshape(shape)
    return packed["scale"] * whole.astype(float)


# --------------------------------------------------------------------- what the page is given


@pytest.mark.slow
def test_poses(episode, data):
    """Fifty rows a second; meshes on bodies, put together, are the robot as pictures have it."""
    robot, q = episode.robot, np.asarray(episode.trajectory.qpos)
    assert (data["count"], data["start"]) == (500, DT)
    assert data["step"] == pytest.approx(0.02)
    assert unpack(data["core"], -1, 3) == pytest.approx(q[::4, :3], abs=1e-6)
    given = data["robot"]
    place = unpack(given["position"], 500, -1, 3)
    quat = unpack(given["quaternion"], 500, -1, 4)
    assert np.all((quat[1:] * quat[:-1]).sum(-1) > 0)
    shapes = [unpack(shape, -1, 3) for shape in given["shapes"]]
    row, corners = 371, []
    for piece in given["pieces"]:
        matrix = np.reshape(piece["matrix"], (4, 4)).T
        local = shapes[piece["shape"]] @ matrix[:3, :3].T + matrix[:3, 3]
        w, x, y, z = quat[row, piece["body"]]
        turn = np.array([
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ])  # fmt: skip
        corners.append(local @ turn.T + place[row, piece["body"]])
    scene = pose_scene(robot, q[4 * row])
    # The scene has rods along the hinges' axes besides, after each module's parts.
    rods = np.all(np.isclose(scene.color, (1.0, 0.47, 0.1)), axis=1)
    expected = scene.corners[~rods].reshape(-1, 3)
    assert np.concatenate(corners) == pytest.approx(expected, abs=5e-5)


@pytest.mark.slow
def test_forces(episode, data):
    """Arrows are the forces on modules; their usual length is a share of the body's."""
    forces = module_forces(episode.robot, episode.trajectory, 4)
    for name in ("buoyancy", "drag"):
        expected = sum_modules(episode.robot, getattr(forces, name))
        given = data["forces"][name]
        assert unpack(given["force"], *expected.shape) == pytest.approx(
            expected, abs=2e-5 * float(np.abs(expected).max())
        )
        size = given["scale"] * np.linalg.norm(expected, axis=-1)
        assert size.max() <= 0.6501 * data["length"]
        assert np.percentile(size, 75) <= 0.3001 * data["length"]
    assert data["forces"]["thrust"]["scale"] == 0
    anchors = np.array([a["place"] for a in data["anchors"]])
    assert anchors.shape == (episode.robot.morphology.num_modules, 3)


def test_speed(data):
    """Of a steady swim the same everywhere, at both ends too; and the heading is its way's."""
    assert unpack(data["speed"], -1) == pytest.approx(np.full(500, SPEED), rel=1e-4)
    assert data["heading"] == pytest.approx(0.0, abs=1e-9)


def test_speed_leaves_the_stroke_out():
    """To and fro within a stroke is no speed."""
    time = 0.02 * np.arange(500)
    path = np.zeros((500, 3))
    path[:, 1] = 0.2 * time + 0.05 * np.sin(2 * np.pi * time / 0.5)
    assert speed_over(time, path, 0.5) == pytest.approx(np.full(500, 0.2), rel=1e-3)
    assert speed_over(time[:1], path[:1], 0.5).tolist() == [0]


@pytest.mark.parametrize("rows, every", [(2000, 4), (50, 4), (1, 1), (30000, 10)])
def test_stride(rows, every):
    """Fifty rows a second, fewer of what lasts."""
    assert page_data_module._stride(DT * np.arange(1, rows + 1)) == every


def small_episode(tank, **fields) -> Episode:
    robot = box_robot((0.1, 0.08, 0.06), 0.4, tank)
    return replace(Episode("box", robot, made_up(robot, 0.5)), **fields)


def test_waves():
    """The page's waves are the world's, from when the episode began."""
    sea = world(**WATER, waves=[
        {"amplitude": 0.05, "wavelength": 2.0, "direction": 0.7, "phase": 1.0},
        {"amplitude": 0.0, "wavelength": 1.0},
        {"amplitude": 0.02, "period": 1.0},
    ], current=(0.1, 0.2, 0.0))  # fmt: skip
    episode = small_episode(sea)
    begun = water_of(sea)._replace(time=3.0)
    episode = replace(episode, water=begun)
    waves = page_data(episode)["world"]["waves"]
    assert len(waves) == 2
    x, y, time = 0.4, -1.3, 0.37
    height = sum(
        w["amplitude"]
        * math.cos(w["k"] * (w["x"] * x + w["y"] * y) - w["omega"] * time + w["phase"])
        for w in waves
    )
    expected, _ = surface(sea, begun._replace(time=3.0 + time), x, y)
    assert height == pytest.approx(float(expected), abs=1e-6)


def test_dust_goes_with_the_water():
    """With the world's current, or with that of the episode."""
    episode = small_episode(world(current=(0.2, 0.0, -0.1)))
    drift = unpack(page_data(episode)["drift"], -1, 3)
    assert drift[-1] == pytest.approx(np.array([0.2, 0, -0.1]) * 0.48, rel=1e-4)
    gust = np.linspace(0.0, 1.0, 100)
    episode = replace(episode, water=Water(0.0, (0.0, gust, 0.0)))
    drift = unpack(page_data(episode)["drift"], -1, 3)
    assert drift[-1] == pytest.approx([0, 0.02 * gust[1:97:4].sum(), 0], rel=1e-4)


def test_current_and_target(episode, data):
    """The water's velocity along the way, where it moves, and where the task sends the robot."""
    assert data["current"] is None and data["target"] is None
    moving = small_episode(world(current=(0.2, 0.0, -0.1)))
    task = SimpleNamespace(target=(1.0, 2.0, -1.5))
    sent = replace(moving, fitness=SimpleNamespace(config=SimpleNamespace(task=task)))
    given = page_data(sent, forces=False)
    velocity = unpack(given["current"]["velocity"], -1, 3)
    assert velocity == pytest.approx(np.tile([0.2, 0, -0.1], (given["count"], 1)), rel=1e-5)
    assert given["current"]["fastest"] == pytest.approx(math.hypot(0.2, 0.1), rel=1e-5)
    target = unpack(given["target"], -1, 3)
    assert target == pytest.approx(np.tile([1.0, 2.0, -1.5], (given["count"], 1)))
    # One that moves is shown where the trajectory has it.
    rows = moving.trajectory
    way = np.linspace([0, 0, 0], [1, 2, -1], len(rows.time))
    fled = page_data(replace(moving, trajectory=replace(rows, target=way)), forces=False)
    assert unpack(fled["target"], -1, 3) == pytest.approx(
        way[:: len(way) // fled["count"]], rel=1e-6
    )
    text = make_page(sent, forces=False)
    assert 'id="current"' in text and 'id="target"' in text
    assert 'id="current"' not in make_page(small_episode(world()), forces=False)


def test_bed():
    """Where it is in sight: the world's heights on rings around the way."""
    assert page_data(small_episode(world()))["world"]["bed"] is None
    assert page_data(small_episode(world(bed=-80.0)))["world"]["bed"] is None
    bed = page_data(small_episode(world(bed=-4.0)))["world"]["bed"]
    height = unpack(bed["height"], bed["rings"], bed["sectors"])
    assert height == pytest.approx(-4.0)
    lake = load_world("lake", bed={"kind": "lake", "height": -3.0, "highest": 5.0, "extent": 60.0})
    bed = page_data(small_episode(lake))["world"]["bed"]
    height = unpack(bed["height"], bed["rings"], bed["sectors"])
    assert height[0] == pytest.approx(-3.0)
    assert height.max() == pytest.approx(5.0)


def test_stops_where_numbers_end():
    episode = small_episode(world())
    qvel = np.array(episode.trajectory.qvel)
    qvel[60:, 1] = np.nan
    lost = replace(episode, trajectory=replace(episode.trajectory, qvel=qvel))
    assert page_data(lost)["count"] == 15
    # So do gusts, which have a row for each of the trajectory.
    gusty = replace(lost, water=Water(0.0, (0.0, np.full(100, 0.5), 0.0)))
    assert unpack(page_data(gusty)["drift"], -1, 3)[-1] == pytest.approx([0, 0.14, 0], rel=1e-4)
    qvel[0] = np.inf
    with pytest.raises(InputError, match="expected finite numbers in its first row; found none"):
        page_data(replace(episode, trajectory=replace(episode.trajectory, qvel=qvel)))


# --------------------------------------------------------------------- the file


@pytest.fixture(scope="module")
def page(episode, tmp_path_factory):
    path = tmp_path_factory.mktemp("viewer") / "new" / "spider.html"
    write_viewer(episode, path)
    return path


def test_file(page, data):
    """Whole, small, its own; its data can be read back."""
    text = page.read_text(encoding="utf-8")
    assert page.stat().st_size < 1.5e6
    assert not re.search(r"\{\{[A-Z_]+\}\}", text)
    assert not re.search(r"""(src|href)=["'](?!data:)""", text)
    assert "three.js authors" in text and "MIT License" in text
    given = re.search(r'<script type="application/json" id="episode">(.*?)</script>', text, re.S)
    assert json.loads(given.group(1)) == json.loads(json.dumps(data))
    assert "0.15 body lengths/s over fresh starts" in text


def test_titles_cannot_break_the_page():
    """What a user wrote is text, and never a mark of the template."""
    text = make_page(small_episode(world(), title="</title><script>{{THREE}}"))
    assert "<title>&lt;/title&gt;&lt;script&gt;{{THREE}}</title>" in text


@pytest.mark.parametrize("name", ["page.txt", "page", "folder.html"])
def test_paths_are_checked(tmp_path, name):
    (tmp_path / "folder.html").mkdir()
    with pytest.raises(
        InputError, match=r"expected a (name that ends in .html or .htm|file); found"
    ):
        write_viewer(small_episode(world()), tmp_path / name)


# --------------------------------------------------------------------- in a browser

needs_browser = pytest.mark.skipif(
    find_browser() is None, reason="no chromium or chrome on the path to open the page with"
)
SIZE = (480, 300)


@pytest.fixture(scope="module")
def browser():
    with Browser(*SIZE) as open_browser:
        yield open_browser


def read(browser, name: str) -> str:
    return browser.evaluate(f"document.documentElement.dataset.{name}")


def drawn(browser) -> np.ndarray:
    """The picture after whatever was asked for has been drawn."""
    browser.evaluate(
        "window.done = false;"
        "requestAnimationFrame(() => requestAnimationFrame(() => window.done = true))"
    )
    browser.wait("window.done")
    return browser.picture()


def changed(one: np.ndarray, two: np.ndarray) -> int:
    """How many pixels differ."""
    return int((np.abs(one - two).max(-1) > 12).sum())


@pytest.mark.slow
@needs_browser
def test_page_opens_and_plays(browser, page):
    """No error, nothing asked for over the network, and time goes on; the space bar stops it."""
    browser.open(page, "#plain")
    assert read(browser, "error") is None
    assert float(read(browser, "time")) >= DT - 1e-9
    browser.wait("document.documentElement.dataset.time > 0.3")
    first = float(read(browser, "time"))
    browser.wait(f"document.documentElement.dataset.time > {first + 0.1}")
    browser.press(" ")
    browser.wait("document.documentElement.dataset.playing === 'false'")
    stopped = float(read(browser, "time"))
    one = drawn(browser)
    assert changed(one, drawn(browser)) == 0
    assert float(read(browser, "time")) == stopped
    browser.press("ArrowRight")
    drawn(browser)
    assert float(read(browser, "time")) == pytest.approx(stopped + 0.1, abs=1e-3)
    browser.press("Home")
    drawn(browser)
    assert float(read(browser, "time")) == pytest.approx(DT)
    browser.press("ArrowUp")
    assert browser.evaluate("document.getElementById('rate').value") == "2"
    browser.click("#play")
    browser.wait("document.documentElement.dataset.time > 0.3")
    assert browser.errors == []
    assert [address for address in browser.requests if not address.startswith("file:")] == []


@pytest.mark.slow
@needs_browser
def test_robot_is_in_the_picture(browser, page):
    """The spider's coral and indigo near the middle, and it moves."""
    browser.open(page, "#plain&paused&t=2&hide=trail")
    picture = drawn(browser)
    r, g, b = np.moveaxis(picture[60:240, 120:360], -1, 0)
    coral, indigo = (r > g + 40) & (r > b + 20), (b > g + 30) & (b > r + 40)
    assert coral.sum() > 500 and indigo.sum() > 500
    low, high = np.argwhere(coral).min(0), np.argwhere(coral).max(0)
    assert np.all(high - low > 60)  # four limbs all around the core
    for _ in range(4):
        browser.press("ArrowRight")
    later = drawn(browser)
    assert float(read(browser, "time")) == pytest.approx(2.4)
    assert changed(picture, later) > 2000
    assert browser.errors == []


@pytest.mark.slow
@needs_browser
def test_switches_change_the_picture(browser, page):
    browser.open(page, "#plain&paused&t=3&view=below")
    for name, most in (("buoyancy", 300), ("drag", 100), ("trail", 100), ("grid", 100),
                       ("water", 3000)):  # fmt: skip
        before = drawn(browser)
        was = browser.evaluate(f"document.getElementById('{name}').ariaPressed")
        browser.click(f"#{name}")
        assert browser.evaluate(f"document.getElementById('{name}').ariaPressed") != was
        assert changed(before, drawn(browser)) > most, name
    scale = browser.evaluate("document.querySelector('#drag .unit').textContent")
    assert re.fullmatch(r"[0-9.e-]+ N", scale)
    assert browser.evaluate("document.getElementById('thrust').disabled") is True
    assert browser.errors == []


@pytest.mark.slow
@needs_browser
def test_panels_do_not_overlap(browser, page):
    browser.open(page, "#plain&paused")
    boxes = (
        "[...document.querySelectorAll('.glass')].map((e) => e.getBoundingClientRect())"
        ".filter((b) => b.width > 0).map((b) => [b.left, b.top, b.right, b.bottom])"
    )
    try:
        for size in ((480, 300), (600, 400), (390, 700), (800, 480), (1100, 680)):
            browser.resize(*size)
            panels = np.array(browser.evaluate(boxes))
            low = np.maximum(panels[:, None, :2], panels[:, :2])
            high = np.minimum(panels[:, None, 2:], panels[:, 2:])
            assert ((low < high).all(-1) == np.eye(len(panels), dtype=bool)).all(), size
            assert panels.min() >= 0 and (panels[:, 2:] <= size).all()
    finally:
        browser.resize(*SIZE)


@pytest.mark.slow
@needs_browser
def test_scrub_orbit_and_zoom(browser, page):
    browser.open(page, "#plain&paused&t=1")
    box = browser.evaluate(
        "(b => [b.x, b.y, b.width, b.height])("
        "document.getElementById('scrub').getBoundingClientRect())"
    )
    middle = (box[0] + box[2] / 2, box[1] + box[3] / 2)
    browser.mouse("mousePressed", *middle, button="left", clickCount=1)
    browser.mouse("mouseReleased", *middle, button="left", clickCount=1)
    before = drawn(browser)
    assert float(read(browser, "time")) == pytest.approx(5.0, abs=0.3)
    browser.drag((240, 150), (310, 180))
    turned = drawn(browser)
    assert changed(before, turned) > 5000
    browser.mouse("mouseWheel", 240, 150, deltaX=0, deltaY=-400)
    assert changed(turned, drawn(browser)) > 5000
    assert browser.errors == []


@needs_browser
@pytest.mark.slow
def test_follow(browser, page):
    """A camera that does not follow loses the robot; one that does keeps it in the middle."""
    browser.open(page, "#plain&paused&t=0.5&hide=trail,water,grid")
    browser.press("f")
    browser.press("End")
    left = drawn(browser)
    browser.open(page, "#plain&paused&t=0.5&hide=trail,water,grid")
    browser.press("End")
    assert changed(left, drawn(browser)) > 5000
    assert browser.errors == []


@needs_browser
@pytest.mark.slow
def test_other_worlds_draw(browser, tmp_path):
    """Waves from above, a bed and thrusters: every shader compiles, every arrow is there."""
    waves = [{"amplitude": 0.05, "wavelength": 1.5}]
    sea = load_world("lake", waves=waves, bed=-2.3, current=(0.1, 0, 0))
    robot = build_robot(body("auv"), sea)
    path = tmp_path / "auv.html"
    config = SimpleNamespace(task=SimpleNamespace(target=(0.5, 0.0, -1.5)))
    fitness = SimpleNamespace(config=config)
    write_viewer(Episode("auv", robot, made_up(robot, 1.0), fitness=fitness), path)
    browser.open(path, "#plain&paused&t=0.5&elevation=40&distance=12")
    assert changed(drawn(browser), np.zeros(3)) > 0.9 * SIZE[0] * SIZE[1]
    browser.open(path, "#plain&paused&t=0.5")
    before = drawn(browser)
    browser.press("h")
    assert changed(before, drawn(browser)) > 100
    assert browser.errors == []


# --------------------------------------------------------------------- the command line


@pytest.fixture
def quick_compiles(monkeypatch):
    monkeypatch.setattr("mjx_revolve.episodes.simulate.compiler_options", lambda: QUICK)


CORE = str(ROOT / "morphologies" / "core.yaml")


@pytest.mark.slow
def test_command(tmp_path, monkeypatch, capsys, quick_compiles):
    """Without a name the page goes beside the caller, and over no file that is there."""
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


FLOAT = """
modules:
  Float:
    mount: -x
    parts:
      - {name: foam, size: [0.04, 0.04, 0.04], mass: 0.01}
"""
BUOY = "id: buoy\nbody: {type: Core, children: {1: {id: float, type: Float}}}\n"


def test_robots_of_modules_of_ones_own(tmp_path, monkeypatch):
    """Named by `--modules`, for viewer, replay and export alike; a run has its own."""
    (tmp_path / "mine.yaml").write_text(FLOAT)
    (tmp_path / "buoy.yaml").write_text(BUOY)
    (tmp_path / "genes.yaml").write_text("genes: [0.1]\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(champion, "simulate", lambda robot, *_, **__: made_up(robot, 0.5))
    parser = Parser()
    add_episode_arguments(parser)
    arguments = parser.parse_args(["buoy.yaml", "--modules", "mine.yaml"])
    body = champion.load_asked(arguments).robot.morphology
    assert [module.type for module in body.modules] == ["Core", "Float"]
    with pytest.raises(InputError, match=r"buoy.yaml: .*Float"):
        champion.load_episode("buoy.yaml")
    with pytest.raises(InputError, match="modules: expected none: a run's configuration names"):
        champion.load_episode("genes.yaml", modules="mine.yaml")


@pytest.mark.parametrize(
    "arguments, message",
    [
        ([], r"the following arguments are required: path \(see --help\)"),
        (
            [CORE, "--out", "page.png"],
            r"page.png: expected a name that ends in .html or .htm; found",
        ),
        ([CORE, "--duration", "0"], r"--duration: expected seconds > 0; found '0'"),
        ([CORE, "--duration", "nan"], r"--duration: expected seconds > 0; found 'nan'"),
        ([CORE, "--duration", "soon"], r"--duration: expected seconds > 0; found 'soon'"),
        ([CORE, "--duration", "1e9"], r"--duration: expected at most 86400 s; found '1e9'"),
        ([CORE, "--out", "/dev/null/a.html"], r"/dev/null/a.html: expected the folder /dev/null;"),
        ([CORE, "--seed", "-1"], r"--seed: expected a whole number from 0 to \d+; found '-1'"),
        ([CORE, "--world", "pond"], r"world: expected one of .*lake.*; found 'pond'"),
        (["none.yaml"], r"none.yaml: expected a run folder, a genes.yaml or a morphology; found"),
        (["."], r"\.: expected a run folder; found no config.yaml in it"),
    ],
)
def test_command_refuses(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run_command(main, arguments) == 2
    error = capsys.readouterr().err
    assert re.match("error: " + message, error) and error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
