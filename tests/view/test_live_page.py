"""A running world in a browser: the simulation, its server, its page, and its catalogue."""

import _thread
import base64
import http.client
import json
import signal
import socket
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from test_bodies import make_run

from browser import Browser, needs_browser
from laboratory import body, check_error
from mjx_revolve import live
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.shipped import list_shipped
from mjx_revolve.view.live.commands import Current, Drop, Pause, Rate
from mjx_revolve.view.live.page import live_page
from mjx_revolve.view.live.robot_catalogue import load_catalogue
from mjx_revolve.view.live.server import LiveServer
from mjx_revolve.view.live.simulation import SLICE, CatalogueEntry, LiveSimulation
from mjx_revolve.water.world import load_world
from standin import SPEED, StandIn

PATIENCE = 60.0  # s, for a machine that does other things; nothing waits that long otherwise


@pytest.fixture(scope="module")
def entries():
    world = load_world("lake")
    robots = {name: build_robot(body(name), world) for name in ("spider", "snake")}
    swims = [
        CatalogueEntry(f"{n}, swims", n, "group", r, lambda: np.zeros(3)) for n, r in robots.items()
    ]
    return [*swims, CatalogueEntry("spider, still", "spider", "group", robots["spider"])]


class Running:
    """A simulation in a thread, and a listener."""

    def __init__(self, entries, lanes=4, **more):
        world = entries[0].robot.world
        self.tank = StandIn(world, lanes)
        self.simulation = LiveSimulation(self.tank, world, entries, **more)
        self.thread = threading.Thread(target=self.simulation.run, daemon=True)

    def __enter__(self):
        self.listener = self.simulation.listen()
        self.thread.start()
        return self

    def __exit__(self, *_):
        self.simulation.stop()
        self.thread.join(PATIENCE)
        assert not self.thread.is_alive()

    def ask(self, command):
        return self.simulation.ask(command).result(PATIENCE)

    def hear(self, wanted, check=lambda data: True):
        """The next event of a name that passes a check."""
        while True:
            name, data = read_event(self.listener.get(timeout=PATIENCE))
            if name == wanted and check(data):
                return data


def read_event(text):
    name, data = text.rstrip("\n").split("\n")
    return name.removeprefix("event: "), json.loads(data.removeprefix("data: "))


def poses_of(data):
    """Rows `[T, width]` by key."""
    numbers = np.frombuffer(base64.b64decode(data["q"]), "<f4")
    ends = np.cumsum([len(data["t"]) * width for width in data["widths"]])
    parts = np.split(numbers, ends[:-1])
    return {
        key: part.reshape(len(data["t"]), -1) for key, part in zip(data["keys"], parts, strict=True)
    }


def test_poses_are_those_of_the_tank(entries):
    first = (Drop(0, (1.0, 2.0), 1.5, 90.0), Drop(2, (-1.0, 0.0), 0.5, 0.0))
    with Running(entries, first=first) as running:
        cast = running.hear("cast", lambda data: len(data) == 2)
        assert [one["name"] for one in cast] == ["spider", "spider #2"]
        assert [one["body"] for one in cast] == [0, 0]
        data = running.hear("poses", lambda data: len(data["t"]) == 2)
        time_, poses = np.array(data["t"]), poses_of(data)
        assert np.diff(time_) == pytest.approx(0.05)
        assert poses[0].shape == poses[1].shape == (2, 15)
        expected = np.c_[np.full(2, 1.0), 2.0 + SPEED * time_, np.full(2, -1.5)]
        assert poses[0][:, :3] == pytest.approx(expected, abs=1e-5)
        assert poses[1][:, :3] == pytest.approx(np.tile([-1.0, 0.0, -0.5], (2, 1)), abs=1e-5)
        running.ask(Current((0.0, 0.0, 0.25)))
        assert running.hear("state", lambda data: data["current"][2])["current"] == [0, 0, 0.25]
        first, second = (poses_of(running.hear("poses"))[1] for _ in range(2))
        assert second[0, 2] - first[0, 2] == pytest.approx(0.25 * 0.1, abs=1e-5)


def test_time_stops_and_goes_on(entries):
    with Running(entries) as running:
        running.hear("poses")
        running.ask(Pause(True))
        stopped = running.tank.time
        assert running.hear("state", lambda data: data["paused"])["time"] == stopped
        running.ask(Rate(4.0))
        assert running.tank.time == stopped
        running.ask(Pause(False))
        assert running.hear("poses", lambda data: data["t"][0] > stopped)
        assert running.hear("state", lambda data: not data["paused"])["rate"] == 4


def test_a_world_slower_than_its_pace_listens(entries):
    with Running(entries) as running:
        running.hear("poses")
        advance = running.tank.advance

        def slowly(*given):
            time.sleep(1.5 * SLICE)
            return advance(*given)

        running.tank.advance = slowly
        running.ask(Pause(True))
        assert running.simulation.paused


def test_who_blows_up_is_taken_out(entries):
    with Running(entries, first=(Drop(0), Drop(1, (9.0, 0.0)))) as running:
        running.hear("poses")
        running.tank.lost.add(0)
        assert running.hear("note") == "spider has blown up, and was taken out"
        running.hear("poses", lambda data: data["keys"] == [1])
        assert running.tank.robots[0] is None


def test_a_sleeping_listener_is_given_up(entries):
    simulation = LiveSimulation(StandIn(entries[0].robot.world), entries[0].robot.world, entries)
    sleeping = simulation.listen()
    for _ in range(150):
        simulation.publish("event: note\ndata: 1\n\n")
    assert [*sleeping.queue][-1] is None and sleeping.qsize() == 100
    other = simulation.listen()
    simulation.publish("event: note\ndata: 2\n\n")
    assert [read_event(text) for text in other.queue][-1] == ("note", 2)


@pytest.fixture(scope="module")
def served(entries):
    """A server of a simulation that runs."""
    world = entries[0].robot.world
    setup = SimpleNamespace(controller=SimpleNamespace(type="cpg"))
    catalogue = SimpleNamespace(
        world=world, entries=entries, title="a </script> title", mixed=SimpleNamespace(config=setup)
    )
    with Running(entries) as running:
        server = LiveServer(running.simulation, live_page(catalogue, 4))
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield server
        server.closing.set()
        server.shutdown()
        server.server_close()
        thread.join(PATIENCE)


def request(server, method, place, content=None, token=None, **headers):
    """Status, headers and text of an answer."""
    connection = http.client.HTTPConnection("127.0.0.1", server.server_address[1], timeout=PATIENCE)
    path = f"/{server.token if token is None else token}/{place}"
    names = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request(method, path, content, names)
    answer = connection.getresponse()
    found = answer.status, answer.headers, answer.read().decode()
    connection.close()
    return found


def command(server, data, **more):
    """Status and answer of a command."""
    content = data if isinstance(data, str) else json.dumps(data)
    given = {"Content_Type": "application/json", "Origin": server.origins[0]} | more
    status, _, text = request(server, "POST", "command", content, **given)
    return status, json.loads(text)


def test_the_page(served):
    assert served.address.startswith("http://127.0.0.1:") and served.address.endswith("/")
    assert served.server_address[0] == "127.0.0.1"
    status, headers, text = request(served, "GET", "")
    assert status == 200 and headers["Content-Type"] == "text/html; charset=utf-8"
    assert headers["Referrer-Policy"] == "no-referrer" and headers["X-Frame-Options"] == "DENY"
    assert "connect-src 'self'" in text and "default-src 'none'" in text
    assert "<title>a &lt;/script&gt; title</title>" in text
    assert "spider, still" in text and 'id="compass"' in text and "three.js authors" in text
    assert served.token not in text


def test_strangers_are_refused(served):
    assert request(served, "GET", "", token="wrong")[0] == 404
    assert request(served, "GET", "events", token="")[0] == 404
    for place in ("body/0", "bodies", "../etc"):
        assert request(served, "GET", place)[0] == 404
    assert request(served, "GET", "", Host="evil.example")[0] == 404
    assert request(served, "POST", "command", "{}", token="wrong")[0] == 404
    stop = {"do": "pause", "on": True}
    status, answer = command(served, stop, Origin="http://evil.example")
    assert (status, answer["error"].partition(";")[0]) == (403, "Origin: expected our own page")
    assert command(served, stop, Origin="null")[0] == 403
    assert command(served, stop, Content_Type="text/plain")[0] == 415
    assert command(served, stop, Host="evil.example")[0] == 404
    assert not served.simulation.paused
    assert request(served, "PUT", "wish", "{}")[0] == 501


def test_silent_connections(served, monkeypatch):
    monkeypatch.setattr("mjx_revolve.view.live.server._Handler.timeout", 1.0)
    monkeypatch.setattr(served, "_room", threading.Semaphore(2))
    place = "127.0.0.1", served.server_address[1]
    made = [socket.create_connection(place, PATIENCE) for _ in range(6)]
    said = {one.recv(100).partition(b"\r\n")[0] for one in made}
    assert said == {b"", b"HTTP/1.1 503 Service Unavailable"}
    for one in made:
        one.close()
    assert request(served, "GET", "")[0] == 200


def test_malformed_commands(served):
    for data in ("", "{", "[" * 3000, "nan", '{"do": "rate", "factor": NaN}', "[]", '{"do": 1}'):
        status, answer = command(served, data)
        assert status == 400 and "\n" not in answer["error"], data
        assert "expected" in answer["error"]
    assert command(served, "x" * 5000)[0] == 400
    error = command(served, {"do": "drop", "entry": 99})[1]["error"]
    assert error.startswith("drop.entry: expected")


def test_commands_are_done(served):
    before = len(served.simulation.robots)
    status, answer = command(served, {"do": "drop", "entry": 1, "place": [4, 5], "depth": 2})
    assert status == 200 and answer["ok"]
    assert len(served.simulation.robots) == before + 1
    place = served.simulation.qpos[answer["key"]][:3]
    assert np.linalg.norm(place - [4, 5, -2]) < 1
    assert command(served, {"do": "remove", "key": answer["key"]})[0] == 200
    assert len(served.simulation.robots) == before
    other = served.origins[1]
    assert command(served, {"do": "current", "velocity": [0.1, 0, 0]}, Origin=other)[0] == 200
    assert served.simulation.current == (0.1, 0, 0)
    assert command(served, {"do": "reset"})[0] == 200
    assert [one.name for one in served.simulation.robots] == ["spider"]  # as at the beginning


def test_the_stream(served):
    command(served, {"do": "reset"})
    connection = http.client.HTTPConnection("127.0.0.1", served.server_address[1], timeout=PATIENCE)
    connection.request("GET", f"/{served.token}/events")
    answer = connection.getresponse()
    assert answer.headers["Content-Type"] == "text/event-stream"
    found = []
    while sum(name == "poses" for name, _ in found) < 4:
        lines = [answer.readline().decode() for _ in range(3)]
        assert lines[2] == "\n"
        found.append(read_event("".join(lines)))
    connection.close()
    names = [name for name, _ in found]
    assert names[:3] == ["state", "bodies", "cast"]
    [body] = found[1][1]
    assert body["number"] == 0 and len(body["tree"]) == 9
    assert {str(piece[1]) for piece in body["pieces"]} == {*body["shapes"]}
    moments = np.concatenate([data["t"] for name, data in found if name == "poses"][1:])
    assert np.diff(moments) == pytest.approx(0.05, abs=1e-3)
    for data in (data for name, data in found if name == "poses"):
        assert all(np.isfinite(rows).all() for rows in poses_of(data).values())
        assert all(rows[:, 2] == pytest.approx(-1, abs=1e-5) for rows in poses_of(data).values())


def test_the_stock_of_a_run(tmp_path):
    catalogue = load_catalogue([str(make_run(tmp_path / "run"))])
    names = [entry.name for entry in catalogue.entries]
    assert names[0] == "champion: 0.4 body lengths/s"
    assert names[1].startswith("individual 5: 0.5") and names[2].startswith("individual 3: 0.3")
    assert "individual 2" not in " ".join(names)  # every trial of its life failed
    assert "spider, a brain by chance" in names and "core, still" in names
    assert "core, a brain by chance" not in names  # it has nothing to move
    champion = catalogue.entries[0]
    assert champion.group == "run" and champion.robot.num_hinges == 3
    assert champion.genes() == pytest.approx(0.1 * np.arange(10))
    drawn = catalogue.entries[names.index("spider, a brain by chance")]
    assert drawn.genes().shape == (3 * 8 + 1,) and drawn.genes().std() > 0.1
    assert catalogue.entries[names.index("spider, still")].genes() is None
    assert catalogue.world.name == "empty_underwater" and catalogue.title == "run"
    assert catalogue.mixed.capacity.hinges >= 8


@pytest.fixture
def few_shipped(monkeypatch):
    """A stock of some shipped robots: all of them take seconds."""
    few = ("bluerov2", "fish", "snake", "spider")

    def listed(kind):
        return {n: p for n, p in list_shipped(kind).items() if kind == "configs" or n in few}

    monkeypatch.setattr("mjx_revolve.view.live.robot_catalogue.list_shipped", listed)


@pytest.mark.usefixtures("few_shipped")
def test_robots_that_float_or_are_too_light_do_not_hinder_others(tmp_path):
    (tmp_path / "sea.yaml").write_text("name: lake\ndensity: 1025\ntimestep: 0.0125\n"
                                       "drag: ellipsoid\n")  # fmt: skip
    names = {
        one.short for one in load_catalogue(["lake_colony"], str(tmp_path / "sea.yaml")).entries
    }
    assert "bluerov2" in names  # it floats
    assert "fish" not in names  # its tail is too light for the step


@pytest.mark.usefixtures("few_shipped")
def test_ctrl_c_ends_it(monkeypatch, capsys):
    # Tests in the background ignore it.
    heard = signal.signal(signal.SIGINT, signal.default_int_handler)
    made = []

    def stand_in(mixed, places, spheres):
        made.append(StandIn(mixed.world, places))
        threading.Timer(0.5, _thread.interrupt_main).start()
        return made[0]

    monkeypatch.setattr("mjx_revolve.episodes.tank.make_tank", stand_in)
    try:
        assert run_command(live.main, ["snake", "--robots", "3"]) == 0
    finally:
        signal.signal(signal.SIGINT, heard)
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("http://127.0.0.1:") and said[-1] == "ended"
    assert len(made[0].robots) == 3


@pytest.mark.parametrize(
    "argv, said",
    [
        (["nosuch"], "nosuch: expected a run folder, a configuration or a morphology"),
        (["--port", "70000"], "--port: expected a whole number from 0 to 65535; found '70000'"),
        (["--robots", "0"], "--robots: expected a whole number from 1 to 64; found '0'"),
    ],
)
def test_mistakes_end_in_one_line(capsys, argv, said):
    assert run_command(live.main, argv) == 2
    check_error(capsys.readouterr(), f"error: {said}")


FACTS = "(document.documentElement?.dataset ?? {})"


@pytest.mark.slow
@needs_browser
def test_a_user_plays(served):
    command(served, {"do": "reset"})
    with Browser(900, 600) as browser:
        browser.send("Page.navigate", url=f"{served.address}#plain")
        browser.wait(f"{FACTS}.poses && {FACTS}.busy === 'false' && {FACTS}.frames > 2")
        assert browser.evaluate(f"{FACTS}.robots") == "1"
        first = float(browser.evaluate(f"{FACTS}.time"))
        browser.wait(f"{FACTS}.time > {first + 0.2}")
        browser.press("d")
        browser.wait(f"{FACTS}.robots === '2'")
        browser.press(" ")
        browser.wait(f"{FACTS}.paused === 'true'")
        assert served.simulation.paused
        assert browser.errors == []
        ours = served.origins[0]
        assert all(url.startswith(ours) for url in browser.requests if "about:" not in url)
