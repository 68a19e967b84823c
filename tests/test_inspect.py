"""The command line that shows a morphology, and its picture."""

import os
from pathlib import Path

import pytest

from laboratory import ROOT
from mjx_revolve import inspect
from mjx_revolve.body.morphology import load_morphology
from mjx_revolve.body.table import thruster_table
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.errors import InputError

SPIDER = ROOT / "morphologies" / "spider.yaml"


def run(*arguments: object) -> int:
    """The command line in this process."""
    return run_command(inspect.main, [str(argument) for argument in arguments])


def _value(text: str, name: str) -> float:
    """The number in the line of the output that starts with `name`."""
    (line,) = (line for line in text.splitlines() if line.startswith(name))
    return float(line.removeprefix(name).split()[0])


def _is_png(path: Path) -> bool:
    data = path.read_bytes()
    return data.startswith(b"\x89PNG\r\n\x1a\n") and data.endswith(b"IEND\xaeB`\x82")


def test_the_spider_weighs_what_the_thesis_says(capsys):
    assert run(SPIDER) == 0
    out = capsys.readouterr().out
    assert _value(out, "modules") == 17
    assert _value(out, "hinges") == 8
    assert _value(out, "mass") == pytest.approx(0.2572)
    assert _value(out, "volume (displaced)") == pytest.approx(241.516, abs=1e-3)
    assert _value(out, "weight in air") == pytest.approx(2.5231, abs=1e-4)
    assert _value(out, "buoyancy in water of 999.103 kg/m³") == pytest.approx(2.3671, abs=1e-4)
    assert _value(out, "net weight in water") == pytest.approx(0.156, abs=1e-3)
    assert _value(out, "relative density") == pytest.approx(1 / 0.93818, rel=1e-5)
    assert "(sinks)" in out and "centre of mass at rest" in out
    for key, value in load_morphology(SPIDER).descriptors.items():
        assert _value(out, f"  {key} ") == pytest.approx(float(value), rel=1e-5)
    assert thruster_table(load_morphology(SPIDER)) == []


def test_thrusters_are_listed_with_what_they_do(capsys):
    assert run(ROOT / "morphologies" / "auv.yaml") == 0
    out = capsys.readouterr().out
    assert (_value(out, "thrusters"), _value(out, "fins"), _value(out, "hinges")) == (4, 0, 0)
    assert "(neutral)" in out
    lines = thruster_table(load_morphology(ROOT / "morphologies" / "auv.yaml"))
    assert len(lines) == 2 + 4 and all(line in out for line in lines)
    assert [line.split()[1:] for line in lines[2:]] == [
        ["bow", "0.00000", "0.05950", "0.00000", "0", "0", "1", "-0.5", "0.5", "0.1", "0.0035"],
        ["stern", "0.00000", "-0.05950", "0.00000", "0", "0", "1", "-0.5", "0.5", "0.1", "-0.0035"],
        ["starboard", "0.05950", "0.00000", "0.00000", "0", "1", "0", "-0.5", "0.5", "0.1",
         "0.0035"],
        ["port", "-0.05950", "0.00000", "0.00000", "0", "1", "0", "-0.5", "0.5", "0.1", "-0.0035"],
    ]  # fmt: skip


def test_centres_of_mass_and_volume_are_shown(capsys):
    assert run(ROOT / "morphologies" / "fish.yaml") == 0
    out = capsys.readouterr().out
    (mass,), (volume,) = (
        [line.split()[-4:-1] for line in out.splitlines() if line.startswith(f"centre of {what}")]
        for what in ("mass", "volume")
    )
    assert mass[:2] == volume[:2]  # level at rest
    assert float(volume[2]) > float(mass[2]) + 0.004  # and upright
    assert (_value(out, "thrusters"), _value(out, "fins"), _value(out, "hinges")) == (0, 3, 3)


@pytest.mark.slow
def test_the_picture_is_a_whole_png_in_the_robots_colours(tmp_path):
    from matplotlib.image import imread

    folder = tmp_path / "pictures"
    folder.mkdir()
    picture = folder / "spider.png"
    picture.write_text("old")
    assert run(SPIDER, "--picture", picture) == 0
    assert _is_png(picture)
    assert os.listdir(folder) == ["spider.png"]
    pixels = imread(picture)[..., :3]
    assert pixels.shape[0] > 700 and pixels.shape[1] > 1200
    blue = (pixels[..., 2] > 0.3) & (pixels[..., 2] > 2 * pixels[..., 0])
    white = (pixels > 0.99).all(axis=-1)
    assert 0.01 < blue.mean() < 0.3  # core and bricks
    assert 0.3 < white.mean() < 0.9


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
(("--density", "heavy"),
         "--density: expected a number > 0 [kg/m3]; found 'heavy' (see --help)"),
(("--picture", "{tmp}/none/a.png"),
         "{tmp}/none/a.png: expected the folder {tmp}/none to exist; found none"),
(("--picture", "{tmp}/a.jpg"), "{tmp}/a.jpg: expected a name that ends in .png; found "
         "'.jpg'")
],
)  # fmt: skip
def test_bad_arguments_are_one_line_and_code_2(tmp_path, capsys, arguments, message):
    before = sorted(os.listdir(tmp_path))
    assert run(SPIDER, *(argument.format(tmp=tmp_path) for argument in arguments)) == 2
    captured = capsys.readouterr()
    assert captured.err == f"error: {message.format(tmp=tmp_path)}\n"
    assert captured.out == ""
    assert sorted(os.listdir(tmp_path)) == before


def test_a_picture_that_cannot_be_written_leaves_nothing(tmp_path, monkeypatch):
    from matplotlib.figure import Figure

    from mjx_revolve.view import pictures

    def full(self, file, **options):
        file.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Figure, "savefig", full)
    monkeypatch.setattr(pictures, "_compose", lambda morphology: Figure())
    picture = tmp_path / "spider.png"
    with pytest.raises(InputError, match="expected a writable file; found No space left on device"):
        pictures.draw_morphology(load_morphology(SPIDER), picture)
    assert os.listdir(tmp_path) == []
