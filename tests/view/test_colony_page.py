"""The page of a colony: what it is given, how poses are packed, what a browser makes of it."""

from __future__ import annotations

import base64
import json
import re
import zlib

import numpy as np
import pytest

from browser import Browser, find_browser
from laboratory import ROOT, body
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.view.colony import Actor, Mark, pack_poses, write_colony_page
from mjx_revolve.view.course import pose_robot
from mjx_revolve.view.shoal_data import MOST_BODIES, Bodies, Shapes, body_data
from mjx_revolve.view.swim_picture import pose_scene
from mjx_revolve.water.world import load_world

PAGE = ROOT / "mjx_revolve" / "view" / "viewer_page"


@pytest.fixture(scope="module")
def robots():
    world = load_world("lake")
    return {name: build_robot(body(name), world) for name in ("spider", "snake", "gecko")}


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
    return Actor(name, robot, time, qpos, **more)


def rotation(q):
    w, x, y, z = q
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


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


# --------------------------------------------------------------------- bodies


@pytest.mark.parametrize("name", ["spider", "snake", "gecko"])
def test_bodies_are_where_mujoco_has_them(robots, name):
    """The tree holds six decimals, along chains of up to 8 hinges: 1e-5 m and 1e-5."""
    robot = robots[name]
    tree = body_data(robot, Shapes())["tree"]
    qpos = poses(robot, 5)
    expected = pose_robot(robot, qpos)
    for row, q in enumerate(qpos):
        found = bend(tree, q)
        assert np.array([p for p, _ in found]) == pytest.approx(
            expected.position[row, 1:], abs=1e-5
        )
        turns = np.array([rotation(quat) for quat in expected.quaternion[row, 1:]])
        assert np.array([r for _, r in found]) == pytest.approx(turns, abs=1e-5)


def test_pieces_put_together_are_the_robot(robots):
    """As pictures have it, up to the 16 bits of the meshes."""
    robot, shapes = robots["spider"], Shapes()
    data, [q] = body_data(robot, shapes), poses(robots["spider"], 1)
    frames, corners = bend(data["tree"], q), []
    for number, shape, _, *x in data["pieces"]:
        packed = shapes.packed[shape]
        whole = np.frombuffer(base64.b64decode(packed["i16"]), "<i2").astype(float)
        local = (packed["scale"] * whole).reshape(-1, 3)
        place, turn = frames[number]
        corners.append((local @ rotation(x[3:]).T + x[:3]) @ turn.T + place)
    scene = pose_scene(robot, q)
    rods = np.all(np.isclose(scene.color, (1.0, 0.47, 0.1)), axis=1)
    expected = scene.corners[~rods].reshape(-1, 3)
    assert np.concatenate(corners) == pytest.approx(expected, abs=5e-5)


def test_robots_that_look_alike_share_their_meshes(robots):
    bodies = Bodies()
    other = build_robot(body("spider"), robots["spider"].world)
    assert [bodies.number(robot) for robot in (*robots.values(), other)] == [0, 1, 2, 0]
    assert len(bodies.data) == 3
    # Core, brick, and a hinge's two parts.
    assert len(bodies.shapes.packed) == 4


def test_too_many_bodies_are_refused(robots, monkeypatch):
    monkeypatch.setattr("mjx_revolve.view.shoal_data.MOST_BODIES", 8)
    assert MOST_BODIES == 96
    with pytest.raises(InputError, match=r"spider: expected at most 8 moving bodies, .*; found 9"):
        body_data(robots["spider"], Shapes())


# --------------------------------------------------------------------- poses


def unpack(packed, widths):
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


def test_poses_come_back(robots):
    """Within half of what they are counted in; rounding does not add up."""
    actors = []
    for name, robot in robots.items():
        qpos = poses(robot, 400, seed=len(actors))
        qpos[:, :3] = np.cumsum(qpos[:, :3], axis=0) + 200.0
        qpos[200:, 3:7] *= -1  # the same turns
        actors.append(Actor(name, robot, np.sort(np.linspace(5, 9, 400)), qpos))
    packed = pack_poses(actors, [np.arange(400)] * 3)
    assert packed["steps"] == (1e-3, 5e-4, 2e-3)
    for actor, (time, qpos) in zip(actors, unpack(packed, [15, 15, 13]), strict=True):
        assert time == pytest.approx(actor.time, rel=1e-6)
        assert qpos[:, :3] == pytest.approx(actor.qpos[:, :3], abs=0.51e-3)
        assert qpos[:, 7:] == pytest.approx(actor.qpos[:, 7:], abs=1.01e-3)
        turned = np.abs((qpos[:, 3:7] * actor.qpos[:, 3:7]).sum(1))
        assert turned == pytest.approx(1, abs=2e-3)


def test_jumps_are_kept_more_coarsely(robots):
    """A robot may be put elsewhere: two bytes hold that, too."""
    robot = robots["snake"]
    qpos = poses(robot, 3)
    qpos[:, :3] = [[0, 0, 0], [100.0, 0, 0], [-100.0, 0, 0]]
    packed = pack_poses([Actor("snake", robot, np.arange(3.0), qpos)], [np.arange(3)])
    step = packed["steps"][0]
    assert step == pytest.approx(200 / 32000)
    [(_, found)] = unpack(packed, [15])
    assert found[:, :3] == pytest.approx(qpos[:, :3], abs=0.51 * step)


def data_of(path):
    text = path.read_text(encoding="utf-8")
    given = re.search(r'<script type="application/json" id="episode">(.*?)</script>', text, re.S)
    return text, json.loads(given.group(1))


def test_a_page_keeps_as_many_poses_as_fit(robots, tmp_path):
    """Those of a window all; of the rest such that are some time apart; always first and last."""
    random = np.random.default_rng(3)
    actors = []
    for k, robot in enumerate(robots.values()):
        actor = swim(robot, f"robot {k}", 0, 100)
        noisy = actor.qpos + 0.2 * random.normal(size=actor.qpos.shape)
        actors.append(Actor(actor.name, robot, actor.time, noisy))
    path = tmp_path / "colony.html"
    whole = write_colony_page(actors, path, "all")
    assert (whole.poses, whole.gap) == (3 * 2000, 0.0)
    assert whole.bytes == path.stat().st_size
    bare = whole.bytes - len(data_of(path)[1]["poses"])
    most = bare + (whole.bytes - bare) // 3
    less = write_colony_page(actors, path, "some", window=(50, 60), most=most)
    assert less.bytes <= most and 0.05 < less.gap < 4
    _, data = data_of(path)
    for actor, (time, _) in zip(actors, unpack(data, [15, 15, 13]), strict=True):
        inside = (time >= 50) & (time <= 60)
        assert inside.sum() == 201
        outside = np.diff(time[time < 50])
        assert outside.min() > 0.5 * less.gap and outside.max() < 2 * less.gap + 0.05
        assert time[[0, -1]] == pytest.approx(actor.time[[0, -1]])


# --------------------------------------------------------------------- the file


@pytest.fixture(scope="module")
def page(robots, tmp_path_factory):
    """Three robots: one all the time, one that is born, one that dies."""
    path = tmp_path_factory.mktemp("colony") / "new" / "colony.html"
    actors = [
        swim(robots["spider"], "first", 0, 20, info={"parents": "none", "energy": 1.23456}),
        swim(robots["gecko"], "later <b>", 8, 20, (0.2, 0.8)),
        swim(robots["snake"], "brief", 0, 5, (0.2, -0.8), end=5.0),
    ]
    marks = [Mark("clinic", (0.0, 0.0, -1.5), 1.0)]
    write_colony_page(actors, path, "Three {{lives}}</title>", marks=marks)
    return path


def test_file(page):
    """Whole, its own; names are text."""
    text, data = data_of(page)
    assert not re.search(r"""(src|href)=["'](?!data:)""", text)
    assert "<title>Three {{lives}}&lt;/title&gt;</title>" in text
    assert "three.js authors" in text and "MIT License" in text
    assert "later <b>" not in text
    assert [actor["name"] for actor in data["actors"]] == ["first", "later <b>", "brief"]
    assert data["actors"][0]["info"] == {"parents": "none", "energy": "1.235"}
    assert [(a["start"], a["end"]) for a in data["actors"]] == [(0, None), (8, None), (0, 5)]
    assert (data["begin"], data["last"]) == (0, pytest.approx(19.95))
    assert data["marks"][0]["radius"] == 1.0


@pytest.mark.parametrize(
    "time, change, match",
    [
        (np.arange(3.0), lambda q: q[:, :-1], r"qpos: expected \[T, 15\].*found \[3, 14\]"),
        (np.arange(3.0), lambda q: q * np.nan, "expected finite times and poses"),
        (np.array([0.0, 2.0, 1.0]), lambda q: q, "time: expected rising times"),
        (np.zeros(0), lambda q: q[:0], r"found \[0, 15\] for times \[0\]"),
    ],
)
def test_poses_are_checked(robots, tmp_path, time, change, match):
    actor = Actor("one", robots["spider"], time, change(poses(robots["spider"], 3)))
    with pytest.raises(InputError, match=f"actor 'one': .*{match}|actor 'one': {match}"):
        write_colony_page([actor], tmp_path / "page.html", "wrong")
    assert not list(tmp_path.iterdir())


def test_nobody_and_wrong_names(robots, tmp_path):
    with pytest.raises(InputError, match="actors: expected at least one robot"):
        write_colony_page([], tmp_path / "page.html", "empty")
    with pytest.raises(InputError, match=r"expected a name that ends in \.html"):
        write_colony_page([swim(robots["spider"], "a", 0, 1)], tmp_path / "page.txt", "text")


# --------------------------------------------------------------------- in a browser

needs_browser = pytest.mark.skipif(
    find_browser() is None, reason="no chromium or chrome on the path to open the page with"
)


@pytest.fixture(scope="module")
def browser():
    with Browser(600, 400) as open_browser:
        yield open_browser


def read(browser, name):
    return browser.evaluate(f"document.documentElement.dataset.{name}")


@pytest.mark.slow
@needs_browser
def test_robots_appear_and_vanish(browser, page):
    browser.open(page, "#plain&paused&t=1")
    assert browser.evaluate("document.title") == "Three {{lives}}</title>"
    for time, alive in ((1, "2"), (6, "1"), (9, "2")):
        scrub = f"const s = document.getElementById('scrub'); s.value = {time};"
        browser.evaluate(f"{{ {scrub} s.dispatchEvent(new Event('input')); }}")
        assert read(browser, "alive") == alive
    names = "[...document.querySelectorAll('#list b')].map((x) => x.textContent).join('|')"
    assert browser.evaluate(names) == "first|later <b>"
    browser.press(" ")
    frames = int(read(browser, "frames"))
    browser.wait(f"document.documentElement.dataset.frames > {frames + 2}")
    assert browser.errors == []
    assert [address for address in browser.requests if not address.startswith("file:")] == []


@pytest.mark.slow
@needs_browser
def test_a_robot_is_followed(browser, page):
    """The spider's coral and indigo in the middle, and what is known of it on the page."""
    browser.open(page, "#plain&paused&t=2&follow=0&hide=trail")
    assert browser.evaluate("document.querySelector('#who').hidden") is False
    assert browser.evaluate("document.querySelector('[data-fact=energy]').textContent") == "1.235"
    speed = browser.evaluate("document.querySelector('[data-fact=speed]').textContent")
    assert speed == "0.100 m/s"
    r, g, b = np.moveaxis(browser.picture()[80:320, 150:450], -1, 0)
    assert ((r > g + 40) & (r > b + 20)).sum() > 300 and ((b > g + 20) & (b > r + 30)).sum() > 300
    browser.press("Escape")
    assert read(browser, "followed") == ""
    assert browser.errors == []


@pytest.mark.slow
@needs_browser
def test_the_browser_bends_robots_as_mujoco_does(browser, page, robots):
    """The page's own script, given qpos: single precision on a chain of 8 hinges."""
    browser.open(page, "#plain&paused")
    robot = robots["snake"]
    [q] = poses(robot, 1, seed=4)
    names = ("shaders.js", "things.js", "stage.js", "shoal.js")
    source = "\n".join((PAGE / name).read_text(encoding="utf-8") for name in names)
    tree = json.dumps(body_data(robot, Shapes())["tree"])
    found = browser.evaluate(f"""(() => {{ {source}
        const body = {{ tree: {tree}.map(([parent, ...x]) => ({{
          parent, place: x.slice(0, 3), turn: [x[4], x[5], x[6], x[3]], axis: x.slice(7, 10),
        }})) }};
        const one = Object.create(Swimmer.prototype);
        Object.assign(one, {{ body, bones: new Float32Array(8 * 16), place: new THREE.Vector3() }});
        one.pose({json.dumps(q.tolist())});
        return [...one.bones]; }})()""")
    bones = np.reshape(found, (-1, 8))[: robot.num_hinges + 1]
    expected = pose_robot(robot, q[None])
    assert bones[:, :3] == pytest.approx(expected.position[0, 1:], abs=2e-5)
    quat = expected.quaternion[0, 1:][:, [1, 2, 3, 0]]
    assert np.abs((bones[:, 4:] * quat).sum(1)) == pytest.approx(1, abs=1e-5)


@pytest.mark.slow
@needs_browser
def test_panels_of_the_colony_do_not_overlap(browser, page):
    browser.open(page, "#plain&paused")
    boxes = (
        "[...document.querySelectorAll('.glass')].map((e) => e.getBoundingClientRect())"
        ".filter((b) => b.width > 0).map((b) => [b.left, b.top, b.right, b.bottom])"
    )
    try:
        for size in ((600, 400), (390, 700), (800, 480), (1100, 680)):
            browser.resize(*size)
            panels = np.array(browser.evaluate(boxes))
            low = np.maximum(panels[:, None, :2], panels[:, :2])
            high = np.minimum(panels[:, None, 2:], panels[:, 2:])
            assert ((low < high).all(-1) == np.eye(len(panels), dtype=bool)).all(), size
            assert panels.min() >= 0 and (panels[:, 2:] <= size).all()
    finally:
        browser.resize(600, 400)
