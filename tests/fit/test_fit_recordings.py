"""Fits from each kind of recording, by the command: what is read is what was there."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_fit import felt, write_csv

from mjx_revolve import fit as command
from mjx_revolve.body.morphology import load_morphology, make_morphology
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.engine.variation import Variation
from mjx_revolve.episodes.simulate import Trajectory
from mjx_revolve.fitting import TimeSeries, load_recording, make_noisy, run, simulate_signals
from mjx_revolve.fitting.axes import find_other_axes
from mjx_revolve.fitting.problem import FitSettings, make_problem
from mjx_revolve.fitting.recording import read_map
from mjx_revolve.formats.ros_bag import write_bag as write_ros_bag
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.water.flow import water_of
from mjx_revolve.water.world import load_world

FREE = ["drag", "thrust"]
TRUE = [1.3, 0.8]
POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
SETTINGS = [
    "--free", "drag,thrust", "--set", "window=3", "--set", "held_out=0", "--set", "duration=2",
]  # fmt: skip
MARKS = {"bow": np.array([0.0, 0.1, 0.0]), "stern": np.array([0.0, -0.1, 0.0]),
         "top": np.array([0.03, 0.0, 0.05])}  # fmt: skip
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def auv():
    """One robot for all, so that one compiled program serves all of them."""
    world = load_world("lake", bed="off", drag="faces", self_contact=False)
    return build_robot(load_morphology("auv"), world)


@pytest.fixture(scope="module")
def signals(auv):
    ctrl = np.zeros((1200, 4))
    names = [auv.mj_model.actuator(k).name for k in range(4)]
    ctrl[40:800, names.index("port")], ctrl[40:500, names.index("starboard")] = 0.6, 0.5
    return simulate_signals(auv, FREE, np.log(TRUE), ctrl)


@pytest.fixture
def fit(auv, tmp_path, monkeypatch):
    """Runs the command on a recording; returns what `fit.json` and the lines say."""
    monkeypatch.setattr(run, "load_robot", lambda *_: (auv, {"robot": "inputs/robot.yaml",
                        "world": "lake", "world_fields": {"bed": "off", "drag": "faces",
                        "self_contact": False}}, {}))  # fmt: skip

    def go(*recordings, more=()):
        arguments = ["auv", *map(str, recordings), *SETTINGS, "--out", str(tmp_path / "out")]
        assert run_command(command.main, [*arguments, *more]) == 0
        return json.loads((tmp_path / "out" / "fit.json").read_text())

    return go


@pytest.mark.long
def test_a_quaternion_of_another_order_is_named(auv, signals):
    recording = make_noisy(signals, rate=40)
    order = {"qw": "qx", "qx": "qy", "qy": "qz", "qz": "qw"}
    other = {name: recording.signals[source] for name, source in order.items()}
    shuffled = replace(recording, signals={**recording.signals, **other})
    settings = FitSettings(held_out=0.0)
    for known, words in ((recording, []), (shuffled, [recording.name])):
        lines = find_other_axes(make_problem(auv, [known], FREE, settings))
        assert [line.partition(":")[0] for line in lines] == words
        assert all("qw, qx, qy, qz hold x, y, z, w" in line for line in lines)


def check(found, within=0.03):
    for value, truth in zip(found["values"], TRUE, strict=True):
        assert value["found"]
        assert value["value"] == pytest.approx(truth, rel=within)
        assert value["low"] / 1.02 < truth < value["high"] * 1.02


def at_frames(recording):
    """Columns of a table, commands at frames' times."""
    time = recording.signals["x"].time
    columns = {"time": time} | {name: recording.signals[name].value for name in POSE}
    for name, one in recording.signals.items():
        if name.startswith("command."):
            rows = np.searchsorted(one.time, time, side="right") - 1
            columns[name] = one.value[rows]
    return columns


def seen_marks(recording):
    """`mark.NAME.AXIS` of three points on the core, each with 3 mm of noise."""
    signals = recording.signals
    position = np.stack([signals[axis].value for axis in "xyz"], -1)
    turn = Rotation.from_quat(np.stack([signals[n].value for n in POSE[3:]], -1), scalar_first=True)
    draw, found = np.random.default_rng(4), {}
    for name, place in MARKS.items():
        seen = position + turn.apply(place) + 0.003 * draw.normal(size=position.shape)
        found |= {f"mark.{name}.{axis}": seen[:, k] for k, axis in enumerate("xyz")}
    return found


def as_map(names):
    return [f"--map=mark.{n}=core:{','.join(map(str, MARKS[n]))}" for n in names]


@pytest.mark.long
def test_a_table_of_poses_with_a_gap_and_lost_frames(fit, signals, tmp_path, capsys):
    columns = at_frames(make_noisy(signals, lost=0.05, seed=1))
    kept = (columns["time"] < 3.0) | (columns["time"] > 3.6)  # no command changes then
    write_csv(tmp_path / "swim.csv", {name: x[kept] for name, x in columns.items()})
    check(fit(tmp_path / "swim.csv"))
    assert "1 gaps of up to 0.6" in capsys.readouterr().out


def test_two_marks_from_above_in_units_of_their_own(fit, signals, tmp_path):
    recording = make_noisy(signals, position=1e-4, attitude=1e-4, seed=1)
    columns, seen = at_frames(recording), seen_marks(recording)
    table = {"t_ms": 1e3 * columns["time"]}
    for name, head in (("bow", ""), ("stern", "mark.stern.")):
        table |= {f"{head}{a}_mm": 1e3 * seen[f"mark.{name}.{a}"] for a in "xy"}
    table |= {name: x for name, x in columns.items() if name.startswith("command.")}
    write_csv(tmp_path / "swim.csv", table)
    bow = ["--map=mark.bow.x=x_mm", "--map=mark.bow.y=y_mm"]  # and not the core's x and y
    check(fit(tmp_path / "swim.csv", more=[*as_map(("bow", "stern")), *bow]), 0.05)


def write_bag(path, series, plugin, arrays=None):
    """A ROS 2 bag with poses as odometry or marks, commands, an IMU and depth; times from 100 s.

    `arrays` of numbers without names are by their topic.
    """
    rosbag2 = pytest.importorskip("rosbags.rosbag2", reason="the package rosbags writes bags")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    make = lambda kind, *values: types[kind](*values)  # noqa: E731
    rows = []
    point = lambda xyz, kind="Point": make(f"geometry_msgs/msg/{kind}", *map(float, xyz))  # noqa: E731

    def header(t):
        stamp = make("builtin_interfaces/msg/Time", int(t), 0)
        return make("std_msgs/msg/Header", stamp, "world")

    none = np.zeros(36)
    marks = sorted({name.split(".")[1] for name in series if name.startswith("mark.")})
    if "x" in series:
        time = series["x"].time
        table = np.stack([series[name].value for name in POSE], -1)
        for t, row in zip(time, table, strict=True):
            turn = make("geometry_msgs/msg/Quaternion", *map(float, [*row[4:], row[3]]))
            pose = make("geometry_msgs/msg/Pose", point(row[:3]), turn)
            still = make("geometry_msgs/msg/Twist", *[point((0, 0, 0), "Vector3")] * 2)
            message = make("nav_msgs/msg/Odometry", header(t), "base_link",
                           make("geometry_msgs/msg/PoseWithCovariance", pose, none),
                           make("geometry_msgs/msg/TwistWithCovariance", still, none))  # fmt: skip
            rows.append((t, "/odom", message))
    for name in marks:
        both = [series[f"mark.{name}.{axis}"] for axis in "xyz"]
        for t, *place in zip(both[0].time, *(x.value for x in both), strict=True):
            message = make("geometry_msgs/msg/PointStamped", header(t), point(place))
            rows.append((t, f"/tracker/{name}", message))
    if "gyro.x" in series:
        turn = make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
        felt_ = [[series[f"{kind}.{a}"].value for a in "xyz"] for kind in ("gyro", "accel")]
        for k, t in enumerate(series["gyro.x"].time):
            gyro, push = (point([x[k] for x in kind], "Vector3") for kind in felt_)
            values = header(t), turn, none[:9], gyro, none[:9], push, none[:9]
            rows.append((t, "/imu", make("sensor_msgs/msg/Imu", *values)))
    if "depth" in series:
        for t, value in zip(*series["depth"], strict=True):
            rows.append((t, "/depth", make("std_msgs/msg/Float64", float(value))))
    for name in (n for n in series if n.startswith("command.")):
        for t, value in zip(series[name].time[::5], series[name].value[::5], strict=True):
            topic = f"/thrusters/{name.partition('.')[2]}"
            rows.append((t, topic, make("std_msgs/msg/Float64", 100 * float(value))))
    for topic, values in (arrays or {}).items():
        layout = make("std_msgs/msg/MultiArrayLayout", [], 0)
        rows.append((0.0, topic, make("std_msgs/msg/Float64MultiArray", layout, values)))
    with rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin[plugin]) as writer:
        topics = {}
        for t, topic, message in sorted(rows, key=lambda row: row[0]):
            kind = message.__msgtype__
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind, typestore=store)
            stamp = round(1e9 * (100 + t))
            writer.write(topics[topic], stamp, store.serialize_cdr(message, kind))


def test_joints_of_a_bag_of_ours_are_the_modules(tmp_path):
    pytest.importorskip("rosbags", reason="the package rosbags writes bags")
    robot = build_robot(make_morphology({"type": "Core", "children": {1: {
        "id": "Hinge-1-1", "type": "ActiveHinge"}}}), load_world("lake", bed="off"))  # fmt: skip
    time = 0.05 * np.arange(1, 61)
    qpos = np.c_[0.1 * time, np.zeros((60, 2)), np.ones(60), np.zeros((60, 3)), np.sin(time)]
    none = [np.zeros((60, *n)) for n in ((7,), (3, 3), (1,), ())]
    write_ros_bag(robot, Trajectory(time, qpos, *none), tmp_path / "swim.mcap")
    found = load_recording(tmp_path / "swim.mcap", robot, {}).signals
    assert found["angle.Hinge-1-1"].value == pytest.approx(np.sin(time)[1::2], abs=1e-6)


def test_thrusters_of_a_bag_have_the_commands_before_their_lag(auv, tmp_path):
    pytest.importorskip("rosbags", reason="the package rosbags writes bags")
    time, count = 0.05 * np.arange(1, 41), auv.mj_model.nu
    qpos = np.c_[np.zeros((40, 2)), -0.1 * time, np.tile([1.0, 0, 0, 0], (40, 1))]  # heave
    ctrl = np.linspace(0.1, 0.4, count) * np.ones((40, 1))
    none = np.zeros((40, 6)), np.zeros((40, 3, 3))
    swum = Trajectory(time, qpos, *none, ctrl, np.zeros(40), command=0.5 * ctrl)
    write_ros_bag(auv, swum, tmp_path / "swim.mcap")
    found = load_recording(tmp_path / "swim.mcap", auv, {}).signals
    for k, name in enumerate(auv.morphology.thruster_names):
        np.testing.assert_allclose(found[f"command.{name}"].value, ctrl[0, k])


def test_a_run_folder_has_the_sea_and_the_factors_of_its_episode(auv, tmp_path, monkeypatch):
    """Waves began at time 0, and `task.robust` was not mentioned: fits found either as drag."""
    time, count = auv.world.timestep * np.arange(1, 81), auv.mj_model.nu
    qpos = np.c_[0.1 * time, np.zeros((80, 2)), np.tile([1.0, 0, 0, 0], (80, 1))]
    none = np.zeros((80, 6)), np.zeros((80, 3, 3)), np.zeros((80, count)), np.zeros(80)
    factors = Variation(drag=1.25, motor=0.8)
    swum = Trajectory(time, qpos, *none, variation=factors)
    (tmp_path / "run.json").write_text("{}")
    world = load_world("lake", waves=[{"amplitude": 0.05, "wavelength": 2.0}])
    sea = build_robot(auv.morphology, world)
    for robot, first in ((auv, 0.0), (sea, 946.5)):
        water = water_of(robot.world)._replace(time=946.5)
        episode = SimpleNamespace(robot=robot, trajectory=swum, water=water)
        monkeypatch.setattr("mjx_revolve.episodes.champion.load_episode", lambda _, e=episode: e)
        found = load_recording(tmp_path, robot, {})
        assert found.signals["command.bow"].time[0] == first
        np.testing.assert_allclose(found.signals["x"].time, first + time[3::4])
        assert "drag 1.25, added_mass 1, density 1, motor 0.8" in found.notes[0]


def test_an_exported_brains_node_needs_no_labels(auv, signals, tmp_path):
    """Its commands are in the thrusters' order; other numbers without names are none of theirs."""
    arrays = {"/sensors/target": np.ones(3), "/thruster_commands": np.arange(auv.mj_model.nu) / 9}
    some = {name: series for name, series in signals.items() if not name.startswith("command.")}
    write_bag(tmp_path / "swim", some, "MCAP", arrays)
    found = load_recording(tmp_path / "swim", auv, {}).signals
    for k, name in enumerate(auv.morphology.thruster_names):
        np.testing.assert_allclose(found[f"command.{name}"].value, k / 9)


def commands_of(auv):
    names = [auv.mj_model.actuator(k).name for k in range(auv.mj_model.nu)]
    return [f"--map=command.{name}=/thrusters/{name}*0.01" for name in names]


def test_a_bag_of_either_kind_as_a_folder_and_as_a_file(fit, auv, signals, tmp_path):
    """One is fitted; the others hold the same."""
    recording = make_noisy(signals, seed=1)
    for plugin in ("MCAP", "SQLITE3"):
        write_bag(tmp_path / plugin, recording.signals, plugin)
    [file], more = (tmp_path / "MCAP").glob("*.mcap"), commands_of(auv)
    check(fit(file, more=more))
    columns = read_map([word.removeprefix("--map=") for word in more])
    paths = file, tmp_path / "MCAP", tmp_path / "SQLITE3"
    known, *others = (load_recording(path, auv, columns).signals for path in paths)
    upside = load_recording(file, auv, columns | {"y": "y*-1"}).signals["y"]
    np.testing.assert_array_equal(upside.value, -known["y"].value)
    shared = {"depth": "1.5", "mark.bow.x": "px*0.002"}  # the latter is for another recording
    found = load_recording(file, auv, columns | shared)
    assert (found.signals["depth"].value == 1.5).all() and "mark.bow.x" not in found.signals
    assert found.notes[0].startswith("--map mark.bow.x: there is no 'px*0.002', but ")
    for other in others:
        assert known.keys() == other.keys()
        for name, one in known.items():
            np.testing.assert_array_equal(one, other[name])


def test_a_bag_with_marks_an_imu_and_depth(fit, auv, signals, tmp_path):
    recording = make_noisy(signals, position=1e-4, attitude=1e-4, seed=1)
    time = recording.signals["x"].time
    series = {n: TimeSeries(time, x) for n, x in seen_marks(recording).items()}
    series |= {n: s for n, s in signals.items() if n.startswith("command.")} | felt(signals)
    write_bag(tmp_path / "swim", series, "SQLITE3")
    found = fit(tmp_path / "swim", more=[*commands_of(auv), *as_map(MARKS)])
    check(found, 0.01)
    assert {"marks", "gyro", "accelerometer", "depth"} == set(found["noise"])
    assert found["noise"]["marks"] == pytest.approx(0.003, rel=0.2)
