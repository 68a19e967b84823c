"""Films: what they show and when, how they are drawn and written, and the command."""

import io
import math
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from PIL import Image

from laboratory import body, check_error
from mjx_revolve import replay
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.episodes.champion import Episode
from mjx_revolve.episodes.simulate import Trajectory
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import write_atomic
from mjx_revolve.view.film import opengl, overlay
from mjx_revolve.view.film.camera import FOVY, plan_circle, plan_shots
from mjx_revolve.view.film.draw import draw_frames, draw_shaded
from mjx_revolve.view.film.film import make_colony_film, make_film
from mjx_revolve.view.film.stage import BACKGROUND, build_stage
from mjx_revolve.view.film.video import gif_stride, make_gif, write_mp4
from mjx_revolve.view.film.waterlight import make_shader
from mjx_revolve.view.recording import Mark, Recording, ReplayRobot
from mjx_revolve.view.swim_picture import pose_scenes
from mjx_revolve.water.flow import Water, water_of
from mjx_revolve.water.world import load_world

STEP = 0.005
SIZE = (160, 120)


@pytest.fixture(scope="module")
def episode(spider):
    """A second in which it is carried along at a constant velocity, flapping."""
    time, model = STEP * np.arange(1, 201), spider.mj_model
    qpos = np.tile(spider.start_qpos(1.0), (200, 1))
    qpos[:, :3] += np.outer(time, [0.2, 0.1, 0.0])
    qpos[:, 7:] = 0.4 * np.sin(2 * np.pi * time)[:, None]
    qvel, xpos, ctrl = (np.zeros((200, *n)) for n in ((model.nv,), (model.nbody, 3), (model.nu,)))
    trajectory = Trajectory(time, qpos, qvel, xpos, ctrl, np.zeros(200))
    return Episode("spider: carried along", spider, trajectory)


@pytest.fixture(scope="module")
def way():
    """The OpenGL of this machine."""
    try:
        return opengl.find_opengl()
    except InputError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def frames(episode, way):
    """A drawn film, and what it was drawn from."""
    film = make_film(episode, SIZE, 10)
    return film, list(draw_frames(film, way))


def plan(path, radius=0.2, surface=0.0, bed=None, aspect=4 / 3, **kw):
    time = np.arange(len(path)) / 30
    size = np.full(len(path), radius)
    return plan_shots(time, np.asarray(path, float), size, aspect=aspect,
                      surface=surface, bed=bed, **kw)  # fmt: skip


def assert_in_frame(shots, path, radius, aspect=4 / 3):
    """The whole ball lies inside the four planes of every frame."""
    up, side = math.tan(FOVY / 2), math.tan(FOVY / 2) * aspect
    for frame, center in enumerate(path):
        x, y, z = shots.axes(frame) @ (np.asarray(center) - shots.position[frame])
        assert z > radius
        assert (z * side - abs(x)) / math.hypot(1, side) > radius
        assert (z * up - abs(y)) / math.hypot(1, up) > radius


@pytest.mark.parametrize("aspect", [4 / 3, 0.5])
@pytest.mark.parametrize("heading", [0.0, 2.0, 5.0])
def test_robot_stays_in_frame_and_swims_to_the_right(heading, aspect):
    time = np.arange(150)[:, None] / 30
    ahead = np.array([math.cos(heading), math.sin(heading), 0.0])
    path = [0, 0, -2.0] + 0.3 * time * ahead + 0.05 * np.sin(9 * time) * [0.3, 0.2, 1.0]
    shots = plan(path, aspect=aspect)
    assert_in_frame(shots, path, 0.2, aspect)
    assert (shots.axes(75)[0] @ ahead) > 0.8
    assert not shots.above
    assert (shots.position[:, 2] < 0.0).all()


@pytest.mark.parametrize(
    "velocity", [(0, 0, 0), (0, 0, -0.5), (0, 0, 0.18), (3.0, 0, 0), (0.2, -0.3, 0.15)]
)
def test_robot_stays_in_frame_whatever_it_does(velocity):
    time = np.arange(150)[:, None] / 30
    random = np.random.default_rng(0)
    path = [5.0, -3.0, -1.0] + time * np.array(velocity) + random.normal(0, 0.02, (150, 3))
    shots = plan(path, bed=lambda x, y: np.full(len(x), -4.0))
    assert_in_frame(shots, path, 0.2)


def test_camera_goes_round_a_dune_and_under_the_surface():
    def bed(x, y):
        return -1.0 + 0.8 * np.exp(-((x - 0.3) ** 2 + (y + 1.0) ** 2) / 0.1)

    time = np.arange(90)[:, None] / 30
    path = np.array([0, 0, -0.6]) + 0.1 * time * [1, 0, 0]
    shots = plan(path, radius=0.15, bed=bed, waves=0.05)
    assert (shots.position[:, 2] > bed(*shots.position[:, :2].T)).all()
    assert (shots.position[:, 2] < -0.05).all()
    assert_in_frame(shots, path, 0.15)


def test_what_floats_is_filmed_from_the_air():
    path = np.tile([0.0, 0.0, -0.05], (90, 1))
    path[:20, 2] = np.linspace(-1.0, -0.05, 20)
    shots = plan(path, waves=0.1)
    assert shots.above
    assert (shots.position[:, 2] > 0.1).all()
    assert_in_frame(shots, path, 0.2)


@pytest.mark.parametrize("name", ["spider", "auv", "fish"])
def test_stage_stands_as_the_robot_does(name):
    robot = build_robot(body(name), load_world("lake"))
    shapes = (robot.mj_model.ngeom, robot.mj_model.nmesh)
    model = build_stage({0: robot}, robot.world)
    assert (robot.mj_model.ngeom, robot.mj_model.nmesh) == shapes
    assert model.nq == robot.mj_model.nq
    random = np.random.default_rng(1)
    qpos = robot.start_qpos()
    qpos[:3] += random.normal(size=3)
    qpos[3:7] = random.normal(size=4)
    qpos[3:7] /= np.linalg.norm(qpos[3:7])
    qpos[7:] = random.uniform(-1, 1, len(qpos) - 7)
    drawn, weighed = mujoco.MjData(model), mujoco.MjData(robot.mj_model)
    for data, its in ((drawn, model), (weighed, robot.mj_model)):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(its, data)
    for body_id in range(robot.mj_model.nbody):
        name = robot.mj_model.body(body_id).name
        other = model.body(name if body_id == 0 else f"0/{name}").id
        assert drawn.xpos[other] == pytest.approx(weighed.xpos[body_id], abs=1e-12)
        assert drawn.xmat[other] == pytest.approx(weighed.xmat[body_id], abs=1e-12)
    # The meshes' corners are those of the pictures, axes and arrows apart.
    corners = []
    for geom in range(model.ngeom):
        if model.geom(geom).name.startswith("0/drawn"):
            mesh = model.geom_dataid[geom]
            first = model.mesh_vertadr[mesh]
            points = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
            frame = drawn.geom_xmat[geom].reshape(3, 3)
            corners.append(points @ frame.T + drawn.geom_xpos[geom])
    (scene,) = pose_scenes(robot, qpos[None])
    assert len(corners) == sum(len(m.kind.parts) for m in robot.morphology.modules)
    for points in corners:
        near = np.abs(scene.corners.reshape(-1, 3)[None] - points[:3, None]).max(-1).min(1)
        assert near.max() < 1e-5


def test_waves_move_the_surface_in_time():
    up, ahead = math.cos(0.6), math.sin(0.6)
    axes = np.float32([[1, 0, 0], [0, -ahead, up], [0, up, ahead]])
    picture = np.full((24, 32, 3), [round(255 * c) for c in BACKGROUND], np.uint8)
    far, place = np.full((24, 32), np.inf, np.float32), np.float32([0, 0, -0.3])
    waves = {"waves": [{"amplitude": 0.05, "wavelength": 1.0}]}
    calm, rough = (make_shader(load_world("lake", **w), (32, 24), 1.0, False) for w in ({}, waves))

    def shade(shader, time):
        water = Water(np.float32(0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), np.float32(time))
        return np.asarray(shader(picture, far, place, axes, water)).astype(int)

    first = shade(rough, 0.0)
    assert np.abs(first - shade(rough, 0.4)).max() > 20
    assert np.abs(first - shade(calm, 0.0)).max() > 20


def test_frames_are_evenly_spaced_and_between_the_rows(episode):
    film = make_film(episode, SIZE, 30)
    assert len(film.time) == 30
    assert np.diff(film.time) == pytest.approx(1 / 30)
    assert film.robots[0].qpos[15, 0] == pytest.approx(0.2 * film.time[15], abs=1e-9)
    assert film.notes.speed == pytest.approx(math.hypot(0.2, 0.1), rel=0.05)
    assert film.lost is None


@pytest.mark.parametrize("every", [1, 4])
def test_the_water_is_that_of_the_time_whatever_the_rows(episode, every):
    all_rows = list(vars(episode.trajectory).values())[:6]
    trajectory = Trajectory(*(x[every - 1 :: every] for x in all_rows))
    height = 0.1 * np.sin(7 * (trajectory.time - every * STEP))  # at each step's beginning
    water = water_of(episode.robot.world)._replace(surface_height=height)
    film = make_film(replace(episode, trajectory=trajectory, water=water), SIZE, 10)
    assert film.water.surface_height == pytest.approx(0.1 * np.sin(7 * film.time), abs=0.01)


def test_a_trajectory_that_fails_is_shown_up_to_there(episode):
    qpos = np.array(episode.trajectory.qpos)
    qpos[120:] = np.nan
    film = make_film(replace(episode, trajectory=replace(episode.trajectory, qpos=qpos)), SIZE, 30)
    assert film.lost == pytest.approx(121 * STEP)
    assert len(film.time) == 18
    assert np.isfinite(film.robots[0].qpos).all()


@pytest.mark.slow
def test_frames_show_the_robot_in_its_colours_in_blue_water(frames):
    film, drawn = frames
    assert len(drawn) == len(film.time) == 10
    for frame in drawn:
        assert frame.shape == (120, 160, 3) and frame.dtype == np.uint8
        red, _, blue = (frame[..., k].astype(int) for k in range(3))
        assert (blue > red + 20).mean() > 0.5  # water
        salmon = red > blue + 30  # the spider's feet
        assert 20 < salmon.sum() < 2000
        # All of them well inside the frame.
        rows, columns = np.nonzero(salmon[18:100])
        assert rows.min() > 3 and columns.min() > 5 and columns.max() < 155
    assert np.abs(drawn[0].astype(int) - drawn[9]).max() > 50


def moving_dot(count=30, size=SIZE):
    for k in range(count):
        frame = np.full((size[1], size[0], 3), (20, 90, 130), np.uint8)
        frame[50:70, 5 * k : 5 * k + 20] = (220, 60, 40)
        yield frame


@pytest.fixture
def av():
    return pytest.importorskip("av", reason="the extra [film] writes MP4")


def read_mp4(av, path):
    with av.open(str(path)) as file:
        stream = file.streams.video[0]
        pictures = [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]
        return stream, float(stream.average_rate), stream.codec_context, pictures


def test_mp4_reads_back(av, tmp_path):
    path = tmp_path / "dot.mp4"
    write_mp4(path, moving_dot(), SIZE, 25, "a dot")
    _, rate, codec, pictures = read_mp4(av, path)
    assert len(pictures) == 30 and rate == 25
    assert codec.name == "h264" and codec.pix_fmt == "yuv420p"
    for picture, frame in zip(pictures, moving_dot(), strict=True):
        assert np.abs(picture.astype(int) - frame).mean() < 6
    # The index stands before the pictures.
    content = path.read_bytes()
    assert content.find(b"moov") < content.find(b"mdat")


def test_gif_reads_back_with_the_film_s_time_and_colours():
    every = gif_stride(30, 30)
    shown = [Image.fromarray(frame) for frame in moving_dot()][::every]
    gif = Image.open(io.BytesIO(make_gif(shown, every / 30)))
    assert gif.size == SIZE and gif.n_frames == 15
    total = 0
    for k in range(gif.n_frames):
        gif.seek(k)
        total += gif.info["duration"]
        inside = np.asarray(gif.convert("RGB"), int)[60, 10 * k + 10]
        assert np.abs(inside - (220, 60, 40)).max() < 8
    assert total == 1000


@pytest.fixture(scope="module")
def colony(spider):
    """One stays; one is put to the other side at 1 s; one is born at 1 s and dies at 2 s."""

    def robot(name, begin, until, x, y, **more):
        time = np.arange(begin, until, 0.05)
        qpos = np.zeros((len(time), 7 + spider.num_hinges))
        qpos[:, 0], qpos[:, 1], qpos[:, 2], qpos[:, 3] = x, y, -0.5, 1.0
        return ReplayRobot(name, spider, time, qpos, **more)

    leaper = robot("leaps", 0.0, 3.0, 2.0, 0.0)
    leaper.qpos[leaper.time >= 1.0 - 1e-9, 0] = -2.0
    robots = [
        robot("stays", 0.0, 3.0, 0.0, 1.5, start=0.0),
        leaper,
        robot("lives", 1.05, 2.0, 0.0, -1.5, start=1.0, end=2.0),
    ]
    marks = [Mark("clinic", (0.0, 0.0, -1.0), 1.0)]
    return Recording("three", robots, 0.0, 3.0, marks, leap=2.5)


def test_robots_are_shown_while_they_are_alive(colony):
    film = make_colony_film(colony, SIZE, 30)
    assert len(film.time) == 90
    alive = [one.alive for one in film.robots]
    assert np.all(alive[:2]) and alive[2].tolist() == [30 <= k < 60 for k in range(90)]
    assert [x.tolist() for x in film.notes.births] == [[1.0], [2]]
    assert [x.tolist() for x in film.notes.deaths] == [[2.0], [2]]
    # Never between the two sides, though frames lie between poses.
    assert set(film.robots[1].qpos[:, 0].tolist()) == {2.0, -2.0}
    assert [overlay.count_words(film, film.notes, frame) for frame in (0, 30, 89)] == [
        "2 robots   0 births   0 deaths",
        "3 robots   1 birth   0 deaths",
        "2 robots   1 birth   1 death",
    ]


@pytest.mark.parametrize(("depth", "above"), [(0.2, True), (60.0, False)])
def test_the_camera_circles_and_sees_most(depth, above):
    random, time = np.random.default_rng(0), np.arange(60) / 2
    places = np.tile(random.uniform(-5, 5, (40, 1, 3)), (1, 60, 1)) * (1, 1, 0) - (0, 0, depth)
    alive = np.ones((40, 60), bool)
    shots = plan_circle(time, places, alive, reach=0.2, aspect=4 / 3, surface=0.0)
    assert shots.above is above
    middle = np.median(places[:, 0], axis=0)
    off = shots.position - middle
    assert np.arctan2(off[:, 2], np.hypot(off[:, 0], off[:, 1])) == pytest.approx(math.pi / 4)
    turned = np.unwrap(np.arctan2(off[:, 1], off[:, 0]))
    assert np.degrees(turned[-1] - turned[0]) == pytest.approx(3.0 * time[-1])
    for frame in range(0, 60, 10):
        flat, away = shots.project(frame, places[:, frame])
        inside = (np.abs(flat) < (4 / 3, 1)).all(1) & (away > 0)
        assert inside.mean() >= 0.75


@pytest.mark.slow
def test_the_dead_are_not_drawn(colony, way):
    film, seen = make_colony_film(colony, SIZE, 1), 0
    for picture, depth, frame in draw_shaded(film, way):
        assert picture.shape == (120, 160, 3)
        for one in film.robots:
            (flat,), (away,) = film.shots.project(frame, one.qpos[frame, None, :3])
            row, column = 60 - 60 * flat[1], 80 + 60 * flat[0]
            if not (2 < row < 118 and 2 < column < 158):
                continue
            near = depth[int(row) - 2 : int(row) + 3, int(column) - 2 : int(column) + 3]
            # Behind them is nothing but the bed, far below.
            drawn = abs(near.min() - away) < one.robot.morphology.length
            assert drawn == one.alive[frame]
            seen += 1
    assert seen >= 6
    assert film.robots[2].alive.tolist() == [False, True, False]


@pytest.mark.slow
def test_the_command_films_a_colony(av, colony, way, tmp_path, monkeypatch, capsys):
    asked = []
    monkeypatch.setattr(
        "mjx_revolve.view.colony.record_colony", lambda *given: asked.append(given) or colony
    )
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.yaml").touch()
    arguments = [str(run), "--colony", "--time", "1", "--duration", "3"]
    arguments += ["--size", "160x120", "--fps", "5"]
    assert replay.main(arguments) == 0
    assert asked == [(run, 1.0, 3.0)]
    assert "3 s, 3 robots, 160 x 120" in capsys.readouterr().out
    with av.open(str(run / "colony.mp4")) as file:
        stream = file.streams.video[0]
        assert sum(1 for _ in file.decode(stream)) == 15
        assert (stream.width, stream.height) == SIZE


@pytest.fixture
def command(episode, monkeypatch):
    """Runs the command on the made-up episode, of files that are made up, too."""
    for name, stand_in in (
        ("episodes.champion.load_episode", lambda *given, **more: episode),
        ("episodes.early_checks.check_episode_files", lambda _: None),
        ("view.viewer.write_viewer", lambda swim, path: write_atomic(path, swim.title.encode())),
    ):
        monkeypatch.setattr(f"mjx_revolve.{name}", stand_in)
    return lambda *words: run_command(replay.main, list(words))


@pytest.mark.slow
def test_command_writes_film_gif_and_page(av, command, way, tmp_path, capsys):
    (tmp_path / "config.yaml").write_text("")
    small = ("--size", f"{SIZE[0]}x{SIZE[1]}", "--fps", "10")
    assert command(str(tmp_path), *small) == 0
    _, rate, _, pictures = read_mp4(av, tmp_path / "swim.mp4")
    assert len(pictures) == 10 and rate == 10 and pictures[0].shape == (120, 160, 3)
    assert pictures[0].std() > 10
    with Image.open(tmp_path / "swim.gif") as gif:
        assert gif.size == SIZE and gif.n_frames == 10
    assert (tmp_path / "viewer.html").read_text() == "spider: carried along"
    out = capsys.readouterr().out
    assert "swim.mp4: 1 s, 160 x 120, 10 frames/s" in out and "viewer.html: open it" in out
    assert not list(tmp_path.glob(".*"))
    # All are made anew, as the champion may be another one.
    for name in ("swim.mp4", "swim.gif", "viewer.html"):
        (tmp_path / name).write_text("of the champion before")
    assert command(str(tmp_path), *small) == 0
    assert (tmp_path / "viewer.html").read_text() == "spider: carried along"
    assert min((tmp_path / name).stat().st_size for name in ("swim.mp4", "swim.gif")) > 100


def test_page_alone_needs_no_opengl(command, tmp_path, monkeypatch):
    monkeypatch.setattr(opengl, "_works", lambda way: False)
    source = tmp_path / "spider.yaml"
    source.touch()
    assert command(str(source), "--html", "--out", str(tmp_path / "new")) == 0
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["viewer.html"]
    assert command(str(source), "--out", str(tmp_path / "page.html")) == 0
    assert (tmp_path / "page.html").exists()


def test_a_shipped_robot_is_no_path_into_a_run(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("config.yaml").touch()
    assert command("spider", "--html") == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["config.yaml", "spider.html"]


@pytest.mark.parametrize(("words", "message"), [
    (("--size", "0x0"), "from 64x64 to 3840x2160; found '0x0'"),
    (("--html", "--out", "x.mp4"), "with --html"),
])  # fmt: skip
def test_wrong_options(words, message, tmp_path, capsys):
    (tmp_path / "spider.yaml").touch()
    assert run_command(replay.main, [str(tmp_path / "spider.yaml"), *words]) == 2
    check_error(capsys.readouterr(), message)
