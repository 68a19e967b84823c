"""Fits of robots whose coefficients are known, what is unknown, and recordings that are wrong."""

import json
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from experiments.fit_coverage import commands
from experiments.fit_measured import GLIDE, fit_glide, fit_lamprey, glide_errors, lamprey_ratios
from laboratory import check_refused
from mjx_revolve import fit as command
from mjx_revolve import report, viewer
from mjx_revolve.body.coefficients import correct_modules
from mjx_revolve.body.morphology import load_morphology, make_morphology, save_morphology
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.engine.variants import course_targets
from mjx_revolve.episodes.config import load_config
from mjx_revolve.episodes.named_files import read_modules
from mjx_revolve.episodes.simulate import simulate
from mjx_revolve.evolution.interrupts import Interrupts
from mjx_revolve.fitting import (
    FitSettings,
    Prediction,
    RobotRecording,
    TimeSeries,
    fit_robot,
    load_recording,
    make_noisy,
)
from mjx_revolve.fitting.estimate import correlation, costs_of, linearize, middles, normal_equations
from mjx_revolve.fitting.identify import find_unknown, plan_motions
from mjx_revolve.fitting.parameters import entries_of, read_free, with_values
from mjx_revolve.fitting.poses import fit_rigid
from mjx_revolve.fitting.problem import NOISE, make_problem
from mjx_revolve.fitting.recording import MarkedPoint, read_map
from mjx_revolve.fitting.run import FitRun, Request, load_robot
from mjx_revolve.fitting.synthetic import simulate_signals
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.water.world import load_world

FREE = ["drag", "added_mass", "thrust", "current"]
TRUE = np.log([1.3, 0.8, 0.9])
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def auv():
    return build_robot(load_morphology("auv"), load_world("lake", bed="off"))


def steps(robot, duration=10.0):
    """Thrusters on and off, at levels that differ."""
    time = np.arange(0, duration, robot.world.timestep)
    draw = np.random.default_rng(3)
    levels = draw.uniform(-0.8, 0.8, (10, robot.mj_model.nu))
    return levels[(time // 1.5).astype(int)]


@pytest.fixture(scope="module")
def signals(auv):
    return simulate_signals(auv, FREE[:3], TRUE, steps(auv), (0.02, -0.01, 0))


@pytest.fixture(scope="module")
def fitted(auv, signals):
    return fit_robot(auv, [make_noisy(signals, rate=30, lost=0.05, seed=1, name="pool")], FREE)


def test_what_is_simulated_for_a_fit_is_what_simulate_does(auv, signals):
    """Variants in lanes, windows and records change nothing."""
    robot = with_values(auv, read_free(FREE[:3], auv), TRUE)
    with jax.enable_x64(True):
        from mjx_revolve.water.flow import Water

        alone = simulate(robot, steps(auv), water=Water(0.0, (0.02, -0.01, 0.0)))
        found = np.asarray(alone.qpos)
    time, x = signals["x"]
    at = np.round(time[1:] / auv.world.timestep).astype(int) - 1
    np.testing.assert_allclose(x[1:], found[at, 0], atol=1e-9)


def test_known_coefficients_are_found_within_their_intervals(fitted):
    for value, truth in zip(fitted.values, np.exp(TRUE), strict=True):
        assert value.found
        assert value.value == pytest.approx(truth, rel=0.03)
        # The intervals, half as wide again: one case of three numbers is no coverage.
        middle = (value.low + value.high) / 2
        assert abs(truth - middle) < 1.5 * (value.high - middle)
        assert value.high / value.low < 1.1
    current = {n: (x, s) for _, n, x, s in fitted.local}
    assert current["current_x"][0] == pytest.approx(0.02, abs=4 * current["current_x"][1] + 1e-3)
    assert fitted.estimate.noise["position"] == pytest.approx(0.005, rel=0.15)
    assert fitted.estimate.noise["attitude"] == pytest.approx(np.pi / 180, rel=0.15)
    assert not fitted.unknown


def test_at_an_end_of_an_interval_the_recordings_fit_worse_by_what_95_percent_allow(auv, fitted):
    """Whatever the other numbers are: those of another fit, in which the drag is held there."""
    problem, best = fitted.problem, fitted.state.point
    end = fitted.estimate.ends[0, 0]
    held = with_values(auv, read_free(["drag"], auv), np.array([end]))
    other = fit_robot(held, problem.recordings, FREE[1:])
    cost = []
    for p, point in ((problem, best), (other.problem, other.state.point)):
        windows, rest = costs_of(p, point, linearize(p, point).values, fitted.state.noise)
        cost.append(windows.sum() + rest)
    prior = problem.parameters[0].spread ** -2 * (end**2 - best.free[0] ** 2) / 2
    assert cost[1] + prior - cost[0] == pytest.approx(1.96**2 / 2, rel=0.15)


def test_numbers_of_one_thruster_and_of_one_ballast_act_together(auv):
    """And what the robot states of them stays; in any order, and as the file has it."""
    names = ["thruster.gain", "thruster_lag", "ballast@core", "ballast_position.x@core",
             "ballast_position.z@core"]  # fmt: skip
    offsets = np.array([0.3, 0.2, 0.1, 0.004, 0.005])
    jets = [auv.morphology.modules[k].kind.parts for k, _ in auv.morphology.thrusters]
    for order in (slice(None), slice(None, None, -1)):
        parameters = read_free(names[order], auv)
        robot = with_values(auv, parameters, offsets[order])
        core = robot.morphology.modules[0].kind.parts[0]
        assert core.ballast_mass == pytest.approx(0.03 * np.exp(0.1))
        assert core.ballast_position == pytest.approx((0.004, 0.0, -0.013))
        for old, (k, _) in zip(jets, robot.morphology.thrusters, strict=True):
            now = robot.morphology.modules[k].kind.parts
            before, after = (next(p.thruster for p in x if p.thruster) for x in (old, now))
            assert after.gain == pytest.approx(before.gain * np.exp(0.3))
            assert after.time_constant == pytest.approx(before.time_constant * np.exp(0.2))
            assert after.torque_ratio == before.torque_ratio != 0
    entries = entries_of(auv, parameters, offsets[order])
    assert correct_modules(auv.morphology.modules, entries, "file") == robot.morphology.modules


def test_what_changes_nothing_is_refused(auv):
    recording = RobotRecording("a", {n: TimeSeries(np.arange(3.0), np.zeros(3)) for n in "xyz"})
    with pytest.raises(InputError, match=r"--free nose_suction: .* changes nothing"):
        make_problem(auv, [recording], ["nose_suction"], FitSettings())


def lying(start, z=-1.0):
    """A second of a robot that does not move."""
    time = np.arange(0, 1, 0.05)
    pose = dict(x=0.0, y=0.0, z=z, qw=1.0, qx=0.0, qy=0.0, qz=0.0)
    signals = {name: TimeSeries(time + start, x + 0 * time) for name, x in pose.items()}
    return RobotRecording(str(start), signals)


@pytest.mark.parametrize("factor", [2.0, 20.0])
def test_a_robot_among_variants_moves_as_alone(factor):
    """Also where the drag is so large that the step's bounds grow."""
    robot = build_robot(load_morphology("core"), load_world("empty_underwater", timestep=0.02))
    given = [lying(0.0)]

    def track(robot, offset):
        problem = make_problem(robot, given, ["drag"], FitSettings(window=1.0, held_out=0.0))
        problem.roots[:, 7:] = np.array([1.0, 0.3, 0.0, 0.0, 0.0, 3.0])[:, None]
        return problem.simulate([replace(problem.origin(), free=np.array([offset]))])

    offset = np.log(factor)
    alone = with_values(robot, read_free(["drag"], robot), np.array([offset]))
    np.testing.assert_allclose(track(robot, offset), track(alone, 0.0), atol=1e-12)


def test_waves_are_where_they_were_when_the_recording_began():
    """Two that begin half a period apart are moved by opposite waves."""
    sea = load_world("empty_underwater", timestep=0.01, waves=[{"amplitude": 0.02, "period": 1.0}])
    robot = build_robot(load_morphology("core"), sea)
    given = [lying(start, z=-0.5) for start in (0.0, 0.5, 1.0)]
    problem = make_problem(robot, given, ["drag"], FitSettings(window=1.0, held_out=0.0))
    rising = problem.simulate([problem.origin()])[0, :, 0, -1, 9]
    assert abs(rising[0] - rising[1]) > 0.01
    assert rising[2] == pytest.approx(rising[0], rel=1e-6)


def test_windows_are_cut_in_their_middles_and_never_where_nothing_is_fitted():
    resets = np.array([1, 0, 0, 0, 1, 0, 0, 0, 0, 0], bool)[:, None]
    short = np.array([1, 1, 1, 1, 1, 1, 1, 0, 0, 0], bool)[:, None]
    found = middles(resets, np.ones((10, 1), bool), short)
    assert np.flatnonzero(found).tolist() == [2, 5]
    assert not middles(resets, np.zeros((10, 1), bool), short).any()
    assert not middles(short, np.ones((10, 1), bool), short).any()


def test_few_recordings_of_a_mean_speed_count_in_whole(auv):
    """Of each there is one number, at its end: a share of it cannot be held out."""
    time = np.arange(60) / 20
    commands = {f"command.{n}": TimeSeries(time, 0 * time + 0.4) for n in ("port", "starboard")}
    speed = TimeSeries(time[[0, -1]], np.array([0.2, 0.2]))
    given = [RobotRecording(name, commands | {"mean_speed": speed}) for name in "ab"]
    found = make_problem(auv, given, ["drag"], FitSettings())
    assert [c.fitted.tolist() for c in found.channels] == [[True, True]] * 2
    assert correlation(found, linearize(found, found.origin()).values) == {"speed": 1.0}


def test_a_sensor_of_what_is_held_out_alone_inflates_nothing(auv, signals):
    short = {name: TimeSeries(*(x[:120] for x in one)) for name, one in signals.items()}
    filmed = make_noisy(short, seed=1).signals
    seen = {n: one for n, one in filmed.items() if n != "z"}
    deep = seen | {"depth": TimeSeries(filmed["z"].time, -filmed["z"].value)}
    given = [RobotRecording(name, deep if name == "d" else seen) for name in "abcd"]
    problem = make_problem(auv, given, ["drag"], FitSettings())
    assert correlation(problem, linearize(problem, problem.origin()).values)["depth"] == 1.0
    # Rows of another sensor between them take nothing from what errs together in time.
    late = {n: TimeSeries(x.time + 1e-3 * (n[0] == "q"), x.value) for n, x in seen.items()}
    pair = [
        make_problem(auv, [RobotRecording("a", x)], ["drag"], FitSettings()) for x in (seen, late)
    ]
    one, other = (correlation(x, linearize(x, x.origin()).values)["position"] for x in pair)
    assert other == pytest.approx(one, rel=0.05) and one > 3


def test_an_attitude_beside_one_mark_counts(auv):
    time = np.arange(80) / 20
    spots = {f"mark.light.{x}": TimeSeries(time, v * time) for x, v in (("x", 0.1), ("y", 0.0))}
    late, late_time = np.cos(0.15 + 0 * time), time + 0.01
    turns = {"qw": late, "qx": 0 * late, "qy": 0 * late, "qz": np.sqrt(1 - late**2)}
    for own in ({"yaw": TimeSeries(time - 1, 0.3 + 0 * time)},
                {n: TimeSeries(late_time, x) for n, x in turns.items()}):  # fmt: skip
        light = {"light": MarkedPoint(0, (0.0, 0.1, 0.0))}
        given = RobotRecording("tracked", spots | own, light)
        problem = make_problem(auv, [given], ["drag"], FitSettings())
        assert [c.kind for c in problem.channels] == ["marks", "attitude"]
        yaw = Rotation.from_quat(problem.roots[:, 3:7, 0], scalar_first=True).as_rotvec()[:, 2]
        assert yaw == pytest.approx(0.3, abs=1e-6)
        assert problem.roots[:, 1, 0] == pytest.approx(-0.1 * np.cos(0.3), abs=1e-6)


def test_what_is_held_out_is_foretold_better_than_before(fitted):
    [prediction] = fitted.predictions
    assert 0.2 < prediction.held.mean() < 0.3
    off = [prediction.error(x, True) for x in (prediction.fitted, prediction.before)]
    assert off[0] < 0.03 and off[0] < off[1] / 5


def felt(signals, rate=50.0):
    """What an IMU in the core and a depth gauge say of poses, of unit quaternions and metres."""
    draw = np.random.default_rng(0)
    time = signals["x"].time
    dt = time[1] - time[0]
    position = np.stack([signals[axis].value for axis in "xyz"], -1)
    quaternion = np.stack([signals[f"q{axis}"].value for axis in "wxyz"], -1)
    attitude = Rotation.from_quat(quaternion, scalar_first=True)
    turning = (attitude[:-1].inv() * attitude[1:]).as_rotvec() / dt
    acceleration = np.diff(position, 2, axis=0) / dt**2
    pushing = attitude[1:-1].inv().apply(acceleration + np.array([0, 0, 9.81]))
    at = np.arange(time[2], time[-3], 1 / rate)
    found = {}
    for k, axis in enumerate("xyz"):
        gyro = np.interp(at, time[:-1] + dt / 2, turning[:, k])
        accelerometer = np.interp(at, time[1:-1], pushing[:, k])
        found[f"gyro.{axis}"] = TimeSeries(at, gyro + 0.01 * draw.normal(size=len(at)))
        found[f"accel.{axis}"] = TimeSeries(at, accelerometer + 0.1 * draw.normal(size=len(at)))
    depth = -np.interp(at, time, position[:, 2])
    return found | {"depth": TimeSeries(at, depth + 0.005 * draw.normal(size=len(at)))}


def test_an_imu_and_a_depth_gauge_stand_for_attitude_and_height(auv, signals):
    """And commands whose clock is late; the coefficients and the delay are found all the same."""
    late = {
        name: TimeSeries(one.time + 0.08, one.value) if name.startswith("command") else one
        for name, one in signals.items()
    }
    filmed = make_noisy(late, seed=1).signals
    seen = {n: one for n, one in filmed.items() if n not in ("z", "qw", "qx", "qy", "qz")}
    recording = RobotRecording("imu", seen | felt(signals))
    fit = fit_robot(auv, [recording], [*FREE, "clock"], FitSettings(held_out=0.0))
    found = [value.value for value in fit.values]
    np.testing.assert_allclose(found, np.exp(TRUE), rtol=0.01)
    # Half a step of the integrator lies between a pose and the velocity that leads to it.
    (clock,) = (value for _, name, value, _ in fit.local if name == "clock")
    assert abs(clock - 0.08) < 0.005
    for kind, noise in {"gyro": 0.01, "accelerometer": 0.1, "depth": 0.005}.items():
        assert fit.estimate.noise[kind] == pytest.approx(noise, rel=0.15)


def test_a_wild_frame_does_no_harm(auv, signals, fitted):
    recording = make_noisy(signals, rate=30, lost=0.05, seed=1)
    time, x = recording.signals["x"]
    bad = x.copy()
    bad[[40, 90]] += 0.5
    wild = replace(recording, signals={**recording.signals, "x": TimeSeries(time, bad)})
    found = fit_robot(auv, [wild], FREE)
    for a, b in zip(found.values, fitted.values, strict=True):
        assert a.value == pytest.approx(b.value, rel=0.02)


def test_a_search_that_begins_far_away_arrives(auv):
    """Where a robot tumbles, windows of 4 s alone led the search to numbers half as wrong again."""
    true = np.log([0.36, 2.1, 1.9])
    ctrl = commands(auv, np.random.default_rng(7), 12.0)
    found = simulate_signals(auv, FREE[:3], true, ctrl, (0.01, -0.01, 0))
    fit = fit_robot(auv, [make_noisy(found, seed=1)], FREE, FitSettings(held_out=0.0))
    np.testing.assert_allclose([v.value for v in fit.values], np.exp(true), rtol=0.02)


@pytest.mark.long
def test_the_interval_of_a_servos_limit_is_no_narrower_where_the_motion_jumps():
    """Over a step of 1e-4 the jump at 0.0835 passes for a slope a third too steep."""
    world = load_world("lake", bed="off", drag="faces", self_contact=False, timestep=0.01)
    robot = build_robot(load_morphology("spider"), world)
    ctrl = commands(robot, np.random.default_rng(7), 6.0)
    found = simulate_signals(robot, ["drag", "servo_speed"], [0.36, 0.08], ctrl)
    settings = FitSettings(held_out=0.0)
    problem = make_problem(robot, [make_noisy(found, rate=60)], ["servo_speed"], settings)
    spread = []
    for offset in (0.083, 0.0835, 0.084):
        point = replace(problem.origin(), free=np.array([offset]))
        system = normal_equations(problem, linearize(problem, point), point, NOISE)
        spread.append(system.matrix[0, 0] ** -0.5)
    assert max(spread) < 1.1 * min(spread)


def test_a_common_scale_is_named_and_not_found():
    """Surge alone: force, drag and carried water may all be twice as large, if mass may."""
    free = read_free(["drag", "thrust", "added_mass"], build_robot(
        load_morphology("auv"), load_world("lake")))  # fmt: skip
    both = np.array([1.0, -1.0, 0.0])
    information = 1e4 * np.outer(both, both) + 1e4 * np.diag([0, 0, 1.0])
    [unknown] = find_unknown(free[:2], information[:2, :2])
    assert unknown.words == "only the ratio of drag and thrust is known"
    [unknown] = find_unknown(free[:2], 1e4 * np.ones((2, 2)))
    assert unknown.words == "only the product of drag and thrust is known"
    three = np.eye(3) - np.ones((3, 3)) / 3
    spread = np.array([p.spread for p in free])
    [unknown] = find_unknown(free, 1e4 * three / np.outer(spread, spread))
    assert "up to a common factor" in unknown.words


@pytest.mark.long
def test_a_robot_that_only_coasts_does_not_tell_its_thrust(auv):
    found = simulate_signals(auv, ["drag"], [0.2], velocity=(0, 0.3, 0, 0, 0, 0.5), duration=6.0)
    fit = fit_robot(auv, [make_noisy(found)], ["drag", "thrust"], FitSettings(held_out=0.0))
    drag, thrust = fit.values
    assert drag.found and drag.value == pytest.approx(np.exp(0.2), rel=0.05)
    assert not thrust.found
    assert [u.words for u in fit.unknown] == ["thrust is not known from this"]
    assert "# thrust 1 : NOT FOUND" in fit.to_yaml().replace("# thrust 1.0", "# thrust 1")


def test_a_plan_knows_more_with_each_motion(auv):
    settings = FitSettings(duration=3.0, motions=2)
    plan = plan_motions(auv, ["drag", "thrust"], settings)
    assert len({m.words for m in plan.motions}) == 2
    assert (plan.spreads[1] < plan.spreads[0]).all()
    assert all((m.recording.signals["z"].value == -1).all() for m in plan.motions)  # under water
    assert not plan.unknown


def test_morphologies_and_configurations_name_what_was_fitted(fitted, tmp_path):
    (tmp_path / "water.yaml").write_text(fitted.to_yaml())
    tree = {"id": "core", "type": "Core", "children": {1: {"id": "leg", "type": "ActiveHinge"}}}
    path = tmp_path / "robot.yaml"
    path.write_text(yaml.safe_dump({"body": tree, "coefficients": "water.yaml"}))
    robot = load_morphology(path)
    factor = dict(robot.modules[1].kind.parts[0].factors)["drag"]
    assert factor == pytest.approx(fitted.values[0].value, rel=1e-6)
    (tmp_path / "again").mkdir()
    save_morphology(robot, tmp_path / "again" / "robot.yaml")
    again = load_morphology(tmp_path / "again" / "robot.yaml")
    assert again.modules[1].kind == robot.modules[1].kind
    config = load_config("lake_swim", overrides={"coefficients": str(tmp_path / "water.yaml")})
    assert read_modules(config)["Core"].parts[0].factors == robot.modules[0].kind.parts[0].factors
    water = load_world("lake")
    plain = build_robot(make_morphology(tree), water).fluid.carried_mass
    mine = build_robot(robot, water).fluid.carried_mass
    np.testing.assert_allclose(mine, fitted.values[1].value * plain, rtol=1e-6)


def write_csv(path, columns):
    names = list(columns)
    rows = [",".join(names)]
    rows += [",".join(map(str, row)) for row in zip(*columns.values(), strict=True)]
    path.write_text("\n".join(rows) + "\n")


def swim(count=60):
    time = np.arange(count) / 20
    return {"time": time, "x": 0.2 * time, "y": 0.05 * np.sin(time), "z": 0 * time - 1,
            "yaw": 0.1 * time, "command.port": 0 * time + 0.4}  # fmt: skip


def changed(**more):
    return {k: v for k, v in (swim() | more).items() if v is not None}


def backwards():
    time = swim()["time"].copy()
    time[30] = time[28]
    return time


BAD = {
"words": ("time,x,y\n0,1,2\n1,oops,2\n", "row 3, column x: expected a number; found 'oops'"),
"blank": ("time,x,y\n\n\n0,1,2\n1,oops,2\n", "row 5, column x: expected a number; found"),
"back": (changed(time=backwards()), "row 32: expected a time later than 1.45 s; found 1.4 s"),
"millimetres": (changed(x=200 * np.arange(60.0)), "millimetres or pixels"),
"other robot": (changed(**{"command.left_hip": np.zeros(60)}), "another robot"),
"still": (changed(x=np.ones(60), y=np.ones(60), yaw=np.zeros(60)), "a robot that moves"),
"no place": (changed(x=None, y=None), "expected x and y of the core, marks, or mean_speed"),
"no yaw": (changed(yaw=None, roll=np.zeros(60)), "roll: expected yaw beside it; found none"),
"half a tilt": (changed(roll=np.zeros(60)), "roll: expected pitch beside it; found none"),
"half a turn": (changed(qw=np.ones(60)), "qw: expected qx, qy, qz beside it; found none"),
"semicolons": ("time;x;y\n0;1;2\n1;2;2\n", "commas between them; found semicolons"),
"degrees": (changed(yaw=25 * np.arange(60.0)), "yaw: expected radians; found steps of 500 a"),
"a jump": (changed(x=0.2 * np.arange(60) / 20 + 5.0 * (np.arange(60) > 30)),
           "x: expected a way without jumps; found one of 5.01 m at 1.55 s"),
"in the air": (changed(z=np.full(60, 1.5)), "does z point down (--map z=COLUMN*-1)"),
}  # fmt: skip


@pytest.mark.parametrize("kind", BAD)
def test_a_bad_recording_is_one_line(kind, tmp_path, capsys):
    content, words = BAD[kind]
    path = tmp_path / "swim.csv"
    path.write_text(content) if isinstance(content, str) else write_csv(path, content)
    assert run_command(command.main, ["auv", str(path), "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and words in error and "swim" in error
    assert not (tmp_path / "out").exists()


def test_recordings_count_once_and_are_with_own_names(auv, tmp_path, capsys):
    paths = [str(tmp_path / trial / "swim.csv") for trial in ("one", "two")]
    for path in paths:
        Path(path).parent.mkdir()
        write_csv(Path(path), changed())
    again = str(tmp_path / "one" / ".." / "one" / "swim.csv")
    assert run_command(command.main, ["auv", *paths, again]) == 2
    assert f"{again}: expected each recording once; found it twice" in capsys.readouterr().err
    read = [load_recording(path, auv, {}) for path in paths]
    assert [one.name for one in command._with_own_names(read, paths)] == paths
    assert command._with_own_names(read[:1], paths[:1])[0].name == "swim"


MARKS = {"a": (0.0, 0.1, 0.0), "b": (0.0, -0.1, 0.0), "c": (0.05, 0.03, 0.0)}


def marks(order="abc", mirror=1.0, scale=1.0):
    """A robot that swims ahead and turns, as a camera from above sees three points on it."""
    time = np.arange(60) / 20
    yaw, found = 0.3 * time, {"time": time}
    for name, real in zip("abc", order, strict=True):
        x, y, _ = MARKS[real]
        found[f"mark.{name}.x"] = scale * (0.2 * time + np.cos(yaw) * x - np.sin(yaw) * y)
        found[f"mark.{name}.y"] = mirror * scale * (np.sin(yaw) * x + np.cos(yaw) * y)
    return found


@pytest.mark.parametrize(("columns", "words"), [
    (marks("bac"), "marks a and b: expected them as on the robot; found them swapped"),
    (marks(mirror=-1.0), "found them mirrored"),
    (marks(scale=2.0), "another scale"),
], ids=["swapped", "mirrored", "scale"])  # fmt: skip
def test_marks_that_are_not_on_the_robot_are_refused(auv, tmp_path, columns, words):
    write_csv(tmp_path / "swim.csv", columns)
    where = [f"mark.{k}=core:{','.join(map(str, v))}" for k, v in MARKS.items()]
    recording = load_recording(tmp_path / "swim.csv", auv, read_map(where))
    with pytest.raises(InputError, match=words):
        make_problem(auv, [recording], ["drag"], FitSettings())


def test_marks_on_a_line_in_space_keep_the_robot_level():
    line = np.array([[[0.1, 0, 0], [0, 0, 0], [-0.1, 0, 0]]])
    turn = Rotation.from_euler("ZYX", [[2.0, 0.05, 0.08]])
    quat = fit_rigid(line, turn.apply(line[0])[None], planar=False)[1]
    found = Rotation.from_quat(quat, scalar_first=True).as_euler("ZYX")[0]
    assert found == pytest.approx([2.0, 0.05, 0.0], abs=2e-3)


def test_what_has_no_heading_is_held_out_at_its_end(auv):
    time = np.arange(0, 8, 0.05)
    spot = {f"mark.a.{x}": TimeSeries(time, v * time) for x, v in (("x", 0.1), ("y", 0), ("z", 0))}
    given = [RobotRecording(n, spot, {"a": MarkedPoint(0, (0.0, 0.0, 0.0))}) for n in "abcd"]
    problem = make_problem(auv, given, ["drag"], FitSettings())
    assert np.isfinite(problem.fitted_until).all() and (problem.fitted_until < problem.end).all()


def test_factors_of_modules_count_once():
    """What nothing is changed of is the robot as it is, and a thrust that is given stays."""
    own = {"thrust": 2.0, "mass": 1.2}
    bow, stern = [{"factors": own}, {"thrust": 3.0, "factors": own}]
    low = {"ballast": 0.03, "ballast_position": [0.0, 0.0, -0.01], "factors": own}
    body = {"type": "Core", "id": "core", "params": low, "children": {
        0: {"type": "Thruster", "id": "bow", "params": bow},
        1: {"type": "Thruster", "id": "stern", "params": stern}}}  # fmt: skip
    robot = build_robot(make_morphology({"body": body}), load_world("lake", bed="off"))
    names = ["thruster.gain", "thruster.time_constant", "ballast@core"]
    same = with_values(robot, free := read_free(names, robot), np.zeros(3))
    more = with_values(robot, free, np.array([0.5, 0.0, 0.0]))
    kinds = ([m.kind for m in x.morphology.modules[1:]] for x in (robot, same, more))
    gains = np.array([[kind.parts[-1].thruster.gain for kind in own] for own in kinds])
    assert gains == pytest.approx(gains[:1] * [[1, 1], [1, 1], [np.exp(0.5), 1]])
    assert same.morphology.mass == pytest.approx(robot.morphology.mass)


def test_recordings_made_in_code_are_checked(auv, signals):
    for name, time, words in (("command.prot", [0.0, 1.0], "^mine: command.prot: expected"),
                              ("x", [1.0, 0.0], "^mine: x: time: expected rising")):  # fmt: skip
        wrong = RobotRecording("mine", signals | {name: TimeSeries(np.array(time), np.zeros(2))})
        with pytest.raises(InputError, match=words):
            fit_robot(auv, [wrong], ["drag"])


def test_marks_may_be_seen_one_at_a_time(auv, tmp_path):
    """By two cameras in turn; what is too far from others of its own is not known."""
    columns, where = marks(), read_map([f"mark.{k}=core:0,{MARKS[k][1]},0" for k in "ab"])
    columns = {name: x for name, x in columns.items() if ".c." not in name}
    for name, x in columns.items():
        if name != "time":
            x["b" in name :: 2] = np.nan
    write_csv(tmp_path / "swim.csv", columns)
    recording = load_recording(tmp_path / "swim.csv", auv, where)
    problem = make_problem(auv, [recording], ["drag"], FitSettings(window=1.0))
    begin = problem.begin + problem.piece * np.arange(len(problem.roots))
    np.testing.assert_allclose(problem.roots[:, 0, 0], 0.2 * begin, atol=0.02)
    for name, x in columns.items():
        if name != "time":
            x[30 * ("b" in name) :][:30] = np.nan
    write_csv(tmp_path / "swim.csv", columns)
    recording = load_recording(tmp_path / "swim.csv", auv, where)
    with pytest.raises(InputError, match="expected two or more of them at a time; found never"):
        make_problem(auv, [recording], ["drag"], FitSettings())


@pytest.mark.parametrize("angle", ["yaw", "roll"])
def test_a_gap_of_the_attitude_is_none_of_it(auv, angle):
    """Nothing is interpolated in it, and no window begins there."""
    time = np.sort(np.r_[np.arange(150) / 15, np.arange(150) / 15 + 0.001])  # in bursts of two
    lost = (time > 2) & (time < 6)
    given = {"x": 0.2 * time, "y": 0 * time, "z": 0 * time - 1}
    given = {n: TimeSeries(time, x) for n, x in given.items()}
    cut = TimeSeries(time[~lost], 0.1 * time[~lost])
    given |= {"yaw": TimeSeries(time, 0.1 * time), angle: cut}
    settings = FitSettings(window=1.0, held_out=0.0)
    problem = make_problem(auv, [RobotRecording("swim", given)], ["drag"], settings)
    begun = problem.begin[0] + problem.piece * np.flatnonzero(problem.drive.resets[:, 0])
    assert len(begun) > 4 and not ((begun > 2.2) & (begun < 5.8)).any()
    [turned] = [channel for channel in problem.channels if channel.kind == "attitude"]
    found = turned.residual(np.tile(np.eye(1, 13, 3), (1, len(turned.time), 1)))
    known = np.isfinite(found).any((0, 2))
    assert known[(turned.time < 2) | (turned.time > 6)].all()
    assert not known[(turned.time > 2.2) & (turned.time < 5.8)].any()


def test_errors_are_of_what_was_recorded():
    found, none = np.full((3, 3), np.nan), np.zeros(3, bool)
    found[1] = 0.2, 0.0, 0.0
    fit = Prediction("swim", np.arange(3.0), none, found, found + 0.1, found)
    assert fit.error(fit.fitted, False) == pytest.approx(0.1 * np.sqrt(3))
    assert fit.error(fit.before, False) == 0 and np.isnan(fit.error(fit.fitted, True))


def test_names_of_modules_may_end_like_units(tmp_path):
    arm = {"id": "arm", "body": {"id": "core", "type": "Core", "children": {
        0: {"id": "leg_m", "type": "ActiveHinge", "children": {
            1: {"id": "foot", "type": "FixedBrick"}}}}}}  # fmt: skip
    robot = build_robot(make_morphology(arm), load_world("lake", bed="off"))
    columns = {"command.leg_m": np.full(60, 0.3), "angle.leg_m_deg": np.full(60, 90.0)}
    write_csv(tmp_path / "swim.csv", changed(**columns | {"command.port": None}))
    for mapped in ([], ["command.leg_m=command.leg_m"]):
        found = load_recording(tmp_path / "swim.csv", robot, read_map(mapped)).signals
        assert found["command.leg_m"].value == pytest.approx(0.3)
        assert found["angle.leg_m"].value == pytest.approx(np.pi / 2)


def test_units_gaps_and_factors_of_columns(auv, tmp_path):
    columns = swim()
    columns = {"frame": 20 * columns["time"], "px": 500 * columns["x"], "y_mm": 1e3 * columns["y"],
               "z": columns["z"], "yaw_deg": np.degrees(columns["yaw"])}  # fmt: skip
    kept = np.r_[0:20, 30:60]
    columns["prot"] = columns["z"]  # meant to be that of a thruster, perhaps
    write_csv(tmp_path / "swim.csv", {k: v[kept] for k, v in columns.items()})
    with pytest.raises(InputError, match=r"--map x: expected a number after \*; found '1e'"):
        load_recording(tmp_path / "swim.csv", auv, read_map(["time=frame*0.05", "x=px*1e"]))
    with pytest.raises(InputError, match=r"--map x: expected one of the columns .*found 'p\\nx'"):
        load_recording(tmp_path / "swim.csv", auv, read_map(["time=frame*0.05", "x=p\nx"]))
    with pytest.raises(InputError, match="--map dpeth: expected the name of a signal"):
        load_recording(tmp_path / "swim.csv", auv, read_map(["time=frame*0.05", "dpeth=z"]))
    other = read_map(["time=frame*0.05", "x=px*0.002", "yaw=yaw_deg*-1"])  # a sign has no unit
    found = load_recording(tmp_path / "swim.csv", auv, other).signals["yaw"].value
    np.testing.assert_allclose(found, -swim()["yaw"][kept], atol=1e-9)
    given = read_map(["time=frame*0.05", "x=px*0.002"])
    found = load_recording(tmp_path / "swim.csv", auv, given)
    for name in ("x", "y", "yaw"):
        np.testing.assert_allclose(found.signals[name].value, swim()[name][kept], atol=1e-9)
    assert found.notes == (
        "frames at 20 Hz: 0 dropped, 1 gaps of up to 0.55 s",
        "no commands of bow, stern, starboard, port: taken to be 0",
        "columns of no known name, not read: prot (--map NAME=COLUMN)",
    )


@pytest.mark.parametrize(
    ("wave", "rate", "noted"),
    [(np.sin, 30, True), (np.sin, 200, False), (lambda t: np.floor(t / 2) % 2, 30, False)],
    ids=["sampled", "as sent", "steps"],
)
def test_commands_that_are_known_at_the_frames_only_are_noted(tmp_path, wave, rate, noted):
    robot = build_robot(load_morphology("spider"), load_world("lake", bed="off"))
    time = np.arange(6 * rate) / rate
    seen = {"x": 0.2 * time, "y": 0.1 * np.sin(time), "z": 0 * time - 1, "yaw": 0.1 * time}
    seen["command.left_hip"] = 0.5 * wave(5 * time)
    write_csv(tmp_path / "swim.csv", {"time": time} | seen)
    notes = load_recording(tmp_path / "swim.csv", robot, {}).notes
    assert any(f"at {rate} Hz" in note and "held until" in note for note in notes) == noted


def test_prescribed_hinges_follow_what_was_measured():
    robot = build_robot(load_morphology("spider"), load_world("lake", bed="off"))
    time = np.arange(0, 2, 0.02)
    hip = 0.5 * np.sin(4 * time)
    still = {n: TimeSeries(time, 0.1 * time) for n in ("x", "y", "z", "yaw")}
    recording = RobotRecording("legs", still | {"angle.left_hip": TimeSeries(time, hip)})
    problem = make_problem(robot, [recording], ["drag"], FitSettings(held_out=0.0))
    track = problem.simulate([problem.origin()])[:, 0]
    names = [robot.morphology.modules[k].name for k in robot.morphology.hinges]
    angle = problem.states(track, 0, time)[0, :, 13 + names.index("left_hip")]
    np.testing.assert_allclose(angle, hip, atol=2e-3)
    with pytest.raises(InputError, match=r"commands .* as they are free; found none of left_hip"):
        make_problem(robot, [recording], ["servo_speed"], FitSettings())
    assert course_targets(np.random.default_rng(0).normal(size=20), 0.01).shape == (18,)
    # What swims on while a hinge is not known is not fitted.
    late = TimeSeries(time[40:], hip[40:])
    partly = replace(recording, signals=recording.signals | {"angle.left_hip": late})
    position = make_problem(robot, [partly], ["drag"], FitSettings(held_out=0.0)).channels[0].seen
    assert np.isnan(position[1:40]).all() and np.isfinite(position[60:]).any()


class Stop(Interrupts):
    """A signal that comes after so many looks."""

    def __init__(self, looks):
        super().__init__()
        self.looks = looks

    @property
    def signal(self):
        self.looks -= 1
        return 2 if self.looks < 0 else None

    @signal.setter
    def signal(self, value):
        pass


def test_what_a_fit_goes_on_with_is_its_folder_alone(capsys):
    for more in (["--set", "iterations=9"], ["--plan"], ["--free", "drag"], ["--seed", "3"]):
        assert run_command(command.main, ["--resume", "fit", *more]) == 2
        assert f"as the folder has all else; found {more[0][2:]}" in capsys.readouterr().err


def test_a_fit_goes_on_in_the_water_that_it_had(signals, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    ends, velocity = [-9.0, 9.0], np.full((2, 2, 2, 3), 0.1)
    np.savez("field.npz", x=ends, y=ends, z=ends, velocity=velocity)
    fields = {"bed": "off", "current_field": "field.npz"}
    robot, *files = load_robot("auv", None, None, fields, False)
    recording = make_noisy(signals, seed=2, name="pool")
    request = Request(robot, (recording,), ("drag",), FitSettings(), 0, tuple(files))
    FitRun.begin("fit", request).folder.close()
    Path("field.npz").unlink()
    again = FitRun.resume("fit")
    assert (again.problem.robot.world.current_field.velocity == 0.1).all()
    again.folder.close()
    path = Path("fit/config.yaml")
    path.write_text(path.read_text().replace("seed: 0", "seed: x"))
    check_refused("seed: expected a whole number >= 0; found 'x'", FitRun.resume, "fit")
    for main in (report.main, viewer.main):
        assert run_command(main, ["fit"]) == 2
        assert "expected a run of evolve; found a fit" in capsys.readouterr().err


def test_a_fit_that_was_stopped_goes_on_bit_for_bit(signals, tmp_path):
    robot, entry, copies = load_robot("auv", None, None, {"bed": "off"}, False)
    recording = make_noisy(signals, seed=2, name="pool")
    settings = FitSettings(iterations=4, duration=2.0)  # the latter of motions that it advises
    request = Request(robot, (recording,), tuple(FREE), settings, 0, (entry, copies))
    whole = FitRun.begin(tmp_path / "whole", request)
    found = whole.run(Stop(10**6))
    whole.write(found, "page")
    whole.folder.close()
    part = FitRun.begin(tmp_path / "part", request)
    assert part.run(Stop(2)) is None
    part.folder.close()
    again = FitRun.resume(tmp_path / "part")
    assert again.state.iteration == 2
    again.problem.drive.resets[2] = True  # a window that was cut stays so
    again.save()
    again.folder.close()
    again = FitRun.resume(tmp_path / "part")
    assert again.problem.drive.resets[2].all()
    again.problem.drive.resets[2] = False
    rest = again.run(Stop(10**6))
    again.folder.close()
    assert rest.to_json() == found.to_json()
    assert rest.advice
    names = ("coefficients.yaml", "fit.json", "robot.yaml", "report.html", "metrics.csv")
    assert all((tmp_path / "whole" / name).is_file() for name in names)
    assert json.loads((tmp_path / "whole" / "fit.json").read_text())["values"][0]["found"]
    corrected = load_morphology(tmp_path / "whole" / "robot.yaml")
    assert dict(corrected.modules[0].kind.parts[0].factors)["drag"] == found.values[0].value


@pytest.mark.long
@pytest.mark.skipif(not GLIDE.is_file(), reason=f"EPFL's glide is not there: {GLIDE}")
def test_two_seconds_of_a_glide_predict_the_rest_of_its_way():
    """AmphiBot's marks: drag and friction from 2 s of them, the way of the others within 3 %."""
    fit = fit_glide()
    [p] = fit.predictions
    assert (p.time[~p.held] < 991.1).all() and p.held.sum() == 5
    assert np.abs(glide_errors(fit)[0]).max() < 0.03


@pytest.mark.long
def test_half_of_the_lampreys_gaits_predict_the_others_with_less_scatter():
    found = lamprey_ratios(fit_lamprey())
    assert found["gaits"] == 4
    assert found["scatter"] < found["scatter_before"]
