"""A fit as a run: its folder, checkpoints after each step, and what is written at the end."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge

from mjx_revolve.body.catalogue import MODULES, load_modules
from mjx_revolve.body.coefficients import correct_modules, load_coefficients
from mjx_revolve.body.morphology import load_morphology, save_morphology, trim_neutral
from mjx_revolve.engine.robot import Robot, build_robot
from mjx_revolve.evolution.interrupts import Interrupts
from mjx_revolve.evolution.progress import Progress
from mjx_revolve.evolution.run import claim_folder, timestamp
from mjx_revolve.evolution.run_folder import RunFolder, begin_run_folder, open_run_folder
from mjx_revolve.fitting.estimate import FitState, Model, advance, begin, linearize
from mjx_revolve.fitting.problem import FitProblem, FitSettings, Point, make_problem
from mjx_revolve.fitting.recording import MarkedPoint, RobotRecording, TimeSeries
from mjx_revolve.fitting.result import Fit, conclude, is_done
from mjx_revolve.inputs.errors import InputError, reading, show
from mjx_revolve.inputs.files import read_file, write_atomic
from mjx_revolve.inputs.overrides import read_overrides
from mjx_revolve.inputs.schema import Integer, Text, TupleOf, checked, read
from mjx_revolve.inputs.shipped import find_shipped, list_shipped
from mjx_revolve.inputs.trust import audit
from mjx_revolve.inputs.yaml_reader import dump_yaml, load_yaml, parse_yaml
from mjx_revolve.numerics import runtime
from mjx_revolve.water.currents import find_field
from mjx_revolve.water.world import load_world, read_world_files

# Of a state, what a checkpoint has as plain values.
_PLAIN = ("noise", "common", "cost", "moved", "inflated")
# What checkpoints of older versions, or of the first state, lack.
_LATER = ("resets", "steps")


@checked
class _FitFile:
    """A fit's `config.yaml`; paths are relative to its folder."""

    robot: Text
    world: Text
    free: TupleOf[Text]
    seed: Annotated[Integer, Ge(0)]
    settings: dict[Text, Any]
    recordings: Text
    modules: Text | None = None
    world_fields: dict[Text, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Request:
    """A user's request of a fit.

    Attributes:
        robot: in its water.
        recordings: of it.
        free: names of what is free.
        settings: of the fit.
        seed: of the draws with which it begins.
        files: what the robot is made of, for the run folder: `config.yaml`'s entries, and copies.
    """

    robot: Robot
    recordings: tuple[RobotRecording, ...]
    free: tuple[str, ...]
    settings: FitSettings
    seed: int
    files: tuple[Mapping[str, Any], Mapping[str, bytes]]


def read_settings(texts: Sequence[str]) -> tuple[FitSettings, dict[str, Any], bool]:
    """Settings of a fit, fields of the world, and whether the robot is trimmed, from `--set`."""
    given, _ = read_overrides(list(texts))
    world = {k.removeprefix("world."): v for k, v in given.items() if k.startswith("world.")}
    own = {k: v for k, v in given.items() if not k.startswith("world.") and k != "trim"}
    trim = given.get("trim", "none")
    if trim not in ("neutral", "none"):
        raise InputError("--set trim", "neutral or none", show(trim))
    try:
        return read(FitSettings, own), world, trim == "neutral"
    except InputError as error:
        raise InputError(f"--set {error}") from None


def load_robot(
    name: str, world: str | None, modules: str | None, fields: Mapping[str, object], trim: bool
) -> tuple[Robot, dict[str, Any], dict[str, bytes]]:
    """The robot that a user names, in its water, and what it takes to load it again.

    Args:
        name: a morphology, a configuration, or a run folder of ours.
        world: a name or a YAML; by default the configuration's, or the lake.
        modules: types of modules of the user's own.
        fields: that replace those of the world.
        trim: whether it is made neutral.

    Returns:
        The robot, entries for `config.yaml`, and copies of files by their names in `inputs/`.

    Raises:
        InputError: there is none, or something of it is wrong.
    """
    path = Path(name)
    source = path / "config.yaml" if path.is_dir() else path
    if str(name) in list_shipped("configs"):
        source = find_shipped(name, "configs")
    data = load_yaml(source) if source.is_file() else None
    overrides: dict[str, Any] = {}
    if isinstance(data, dict) and "task" in data:
        from mjx_revolve.episodes.config import load_config

        config = load_config(source)
        if config.morphology is None:
            raise InputError(source, "one robot", "bodies that evolve")
        body = load_morphology(config.morphology, _types(config.modules), config.allow_overlap)
        if config.coefficients is not None:
            entries = load_coefficients(config.coefficients)
            body = replace(body, modules=correct_modules(body.modules, entries, "coefficients"))
        if modules is not None:
            raise InputError("--modules", f"none, as {source} names its own", show(str(modules)))
        modules, trim = config.modules, trim or config.trim == "neutral"
        if world is None:
            world, overrides = config.world_name, config.world_overrides
    else:
        body = load_morphology(name, _types(modules))
    world = world or "lake"
    water = load_world(world, **(overrides | dict(fields)))
    if trim:
        body = trim_neutral(body, water.density)
    copies: dict[str, bytes] = {}
    entry: dict[str, Any] = {"robot": "inputs/robot.yaml", "world": world}
    if Path(world).is_file():
        copies |= {f"world/{name}": content for name, content in read_world_files(world).items()}
        entry["world"] = f"inputs/world/{Path(world).name}"
    if modules is not None:
        copies["modules.yaml"] = read_file(modules)
        entry["modules"] = "inputs/modules.yaml"
    given = overrides | dict(fields)
    if isinstance(grid := given.get("current_field"), str):
        copies[f"field/{Path(grid).name}"] = read_file(find_field(grid, Path.cwd()))
        given["current_field"] = f"inputs/field/{Path(grid).name}"
    entry["world_fields"] = given
    return build_robot(body, water), entry, copies


def _types(modules: str | None) -> Mapping[str, Any]:
    return MODULES if modules is None else MODULES | load_modules(modules)


@dataclass
class FitRun:
    """A fit under way, in its folder.

    Attributes:
        folder: its folder, locked.
        request: the user's.
        problem: of it.
        state: of the search; None before its first step.
        model: the problem at the state.
    """

    folder: RunFolder
    request: Request
    problem: FitProblem
    state: FitState | None = None
    model: Model | None = None

    @classmethod
    def begin(cls, out: str | Path | None, request: Request) -> FitRun:
        """Begins one in a new folder; None: one below `runs/`, named after the time.

        Raises:
            InputError: the folder holds something, or the recordings do not suit the robot.
        """
        problem = _make(request)
        entry, copies = request.files
        config = {
            **entry, "free": list(request.free), "seed": request.seed,
            "settings": vars(request.settings), "recordings": "inputs/recordings.npz",
        }  # fmt: skip
        text = "# A fit; `python -m mjx_revolve.fit --resume` goes on with it.\n"
        files = {f"inputs/{name}": content for name, content in copies.items()}
        files["inputs/recordings.npz"] = _pack(request.recordings)
        folder = begin_run_folder(
            out or claim_folder("fit"), files,
            kind="fit", started=timestamp(), seed=request.seed, **runtime.describe_process(),
        )  # fmt: skip
        save_morphology(request.robot.morphology, folder.path / "inputs" / "robot.yaml")
        text += dump_yaml(config)
        write_atomic(folder.path / "config.yaml", text.encode())
        return cls(folder, request, problem)

    @classmethod
    def resume(cls, place: str | Path) -> FitRun:
        """Opens one that was stopped, at its newest checkpoint; bit for bit as without a stop.

        Raises:
            InputError: it is no folder of a fit, or damaged.
        """
        folder = open_run_folder(place)
        try:
            path = folder.path / "config.yaml"
            data = load_yaml(path)
            if not isinstance(data, dict) or "free" not in data or "recordings" not in data:
                raise InputError(path, "that of a fit", "another run's")
            with reading(path):
                own = read(_FitFile, data)
                own.settings.pop("draws", None)  # in folders of older versions
                settings = read(FitSettings, own.settings, "settings")
            types = _types(None if own.modules is None else str(folder.path / own.modules))
            body = load_morphology(folder.path / own.robot, types, allow_overlap=True)
            inside, fields = folder.path / own.world, dict(own.world_fields)
            grid = fields.get("current_field")
            if isinstance(grid, str) and (folder.path / grid).is_file():
                fields["current_field"] = str(folder.path / grid)
            water = load_world(inside if inside.is_file() else own.world, **fields)
            request = Request(
                build_robot(body, water), _unpack(folder.path / own.recordings), own.free,
                settings, own.seed, (data, {}),
            )  # fmt: skip
            run = cls(folder, request, _make(request))
            if folder.checkpoints():
                run._restore()
        except BaseException:
            folder.abandon()
            raise
        return run

    def _restore(self) -> None:
        checkpoint = self.folder.load_checkpoint()
        arrays, meta = checkpoint.arrays, checkpoint.meta
        roots, resets = self.problem.roots, self.problem.drive.resets
        origin = self.problem.origin()
        own = {**vars(origin), "roots": roots, "damping": resets, "resets": resets,
               "steps": origin.free}  # fmt: skip
        for name, like in own.items():
            shape = np.shape(arrays[name]) if name in arrays else None
            if shape != np.shape(like) and (shape is not None or name not in _LATER):
                found = f"{name} of shape {shape}"
                raise InputError(checkpoint.path, "a checkpoint of this fit", found)
        if missing := [name for name in _PLAIN if name not in meta]:
            raise InputError(checkpoint.path, "a checkpoint of a fit", f"no {missing[0]}")
        if not isinstance(meta["noise"], dict) or (
            missing := sorted({c.kind for c in self.problem.channels} - meta["noise"].keys())
        ):
            found = f"one without {', '.join(missing) or 'noise'}; begin it anew"
            raise InputError(checkpoint.path, "a checkpoint of this fit", found)
        self.folder.rewind(checkpoint)
        roots[:] = arrays["roots"]
        resets[:] = arrays.get("resets", resets)  # folders of older versions have no cut windows
        point = Point(arrays["free"], arrays["local"], arrays["starts"])
        self.state = FitState(
            point, damping=arrays["damping"], iteration=meta["generation"],
            steps=arrays.get("steps"), **{name: meta[name] for name in _PLAIN},
        )  # fmt: skip

    def save(self) -> None:
        """A checkpoint of the state."""
        state = self.state
        assert state is not None
        arrays = {**vars(state.point), "damping": state.damping, "roots": self.problem.roots,
                  "resets": self.problem.drive.resets}  # fmt: skip
        if state.steps is not None:
            arrays["steps"] = state.steps
        meta = {name: getattr(state, name) for name in _PLAIN} | {"moved": min(state.moved, 1e30)}
        self.folder.save_checkpoint(state.iteration, arrays, meta, 2)

    def run(self, interrupts: Interrupts) -> Fit | None:
        """Goes on to the end; None where a signal came before."""
        if self.state is None:
            self.state = begin(self.problem, self.request.seed)
            self.save()
        self.model = linearize(self.problem, self.state.point, self.state.steps)
        total = self.problem.settings.iterations
        progress = _Progress(self.state.iteration, total, unit="iteration")
        with contextlib.closing(progress):
            while not is_done(self.problem, self.state):
                if interrupts.signal:
                    return None
                self.state, self.model = advance(self.problem, self.state, self.model)
                row = {"generation": self.state.iteration, "best": self.state.cost,
                       "mean": self.state.moved, "evaluations_per_second": 0.0}  # fmt: skip
                named = zip(self.problem.parameters, self.state.point.free, strict=True)
                found = {p.name: p.value(float(x)) for p, x in named}
                with interrupts.writing:
                    self.folder.append_metrics({"iteration": self.state.iteration,
                                                "cost": self.state.cost, **found})  # fmt: skip
                    self.save()
                progress.show(row)
            progress.say("predicting, and looking for what would help most")
        return conclude(self.problem, self.state, self.model, self.request.free, advise=True)

    def write(self, fit: Fit, page: str) -> None:
        """Writes what was found: `coefficients.yaml`, `robot.yaml`, `fit.json`, `report.html`."""
        self.folder.write("coefficients.yaml", fit.to_yaml().encode())
        self.folder.write("robot.yaml", lambda path: save_morphology(fit.robot.morphology, path))
        self.folder.write("fit.json", fit.to_json().encode())
        self.folder.write("report.html", page.encode())
        self.folder.update_info(finished=timestamp())


class _Progress(Progress):
    """Of a search by least squares."""

    def _figures(self, row: Mapping[str, float]) -> list[str]:
        return [f"cost {row['best']:.6g}", f"last step {row['mean']:.2g} of the uncertainty"]


def _make(request: Request) -> FitProblem:
    return make_problem(request.robot, request.recordings, request.free, request.settings)


def _pack(recordings: Sequence[RobotRecording]) -> bytes:
    """Recordings as an NPZ file."""
    arrays: dict[str, np.ndarray] = {}
    about = []
    for r, recording in enumerate(recordings):
        for name, signal in recording.signals.items():
            arrays[f"{r}/{name}"] = np.stack(signal)
        marks = {name: [mark.module, *mark.place] for name, mark in recording.marks.items()}
        about.append({"name": recording.name, "marks": marks, "notes": list(recording.notes)})
    buffer = io.BytesIO()
    text = dump_yaml(about).encode()
    np.savez_compressed(buffer, about=np.frombuffer(text, np.uint8), **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


def _unpack(path: Path) -> tuple[RobotRecording, ...]:
    try:
        content = read_file(path)
        audit(path, "data", content)
        with np.load(io.BytesIO(content), allow_pickle=False) as data:
            about = parse_yaml(data["about"].tobytes(), path)
            found = []
            for r, one in enumerate(about):
                own = [key for key in data.files if key.startswith(f"{r}/")]
                signals = {key.partition("/")[2]: TimeSeries(*data[key]) for key in own}
                placed = one["marks"].items()
                marks = {name: MarkedPoint(int(k), (x, y, z)) for name, (k, x, y, z) in placed}
                found.append(RobotRecording(one["name"], signals, marks, tuple(one["notes"])))
    except InputError:
        raise
    except Exception as error:  # a damaged zip has many kinds
        raise InputError(f"{path}: expected the recordings of a fit; found: {error}") from None
    return tuple(found)
