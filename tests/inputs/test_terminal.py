"""Terminals that take ASCII only: results are spelled out, and nothing ends in a traceback."""

import ast
import os
import subprocess
import sys

import pytest

from laboratory import ROOT
from mjx_revolve.inputs.terminal import spell

CODE = (  # in ASCII itself
    "import sys; from mjx_revolve.inputs.commands import run_command\n"
    "def main(argv):\n"
    "    print('0.158 \\xb1 0.003 m/s\\xb2 \\xd7 2 \\u2026 gr\\xf6\\xdfer \\udcff')\n"
    "    print('note \\xb1', file=sys.stderr)\n"
    "    raise OSError(5, 'disk \\u2264 full')\n"
    "sys.exit(run_command(main))"
)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0.158 ± 0.003 body lengths/s", "0.158 +/- 0.003 body lengths/s"),
        ("m/s², 3×4 · π…", "m/s^2, 3x4 - pi..."),
        ("größer, naïve", "gro\\xdfer, naive"),
        ("魚", "\\u9b5a"),
    ],
)
def test_what_ascii_lacks_is_spelled(text, expected):
    assert spell(text) == expected


@pytest.mark.parametrize(
    "place", [{"PYTHONIOENCODING": "ascii"}, {"LC_ALL": "C", "PYTHONUTF8": "0"}], ids=str
)
def test_commands_print_on_ascii_terminals(place):
    clean = {k: v for k, v in os.environ.items() if k not in ("PYTHONIOENCODING", "PYTHONUTF8")}
    done = subprocess.run(
        [sys.executable, "-c", CODE], cwd=ROOT, env={**clean, **place}, capture_output=True
    )
    assert done.returncode == 1
    out, err = done.stdout.decode("ascii"), done.stderr.decode("ascii")
    assert out.startswith("0.158 +/- 0.003 m/s^2 x 2 ... gro")
    assert err.splitlines() == ["note +/-", "error: disk <= full"]


def test_every_program_prints_so():
    """Whatever has a `main` of its own runs it by `run_command`, or prints ASCII only."""
    found = [*(ROOT / "mjx_revolve").rglob("*.py"), *(ROOT / "experiments").glob("*.py")]
    programs = [path for path in found if '__name__ == "__main__"' in path.read_text("utf-8")]
    assert len(programs) > 12
    for path in programs:
        text = path.read_text("utf-8")
        printed = [
            ast.unparse(node)
            for node in ast.walk(ast.parse(text))
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "print"
        ]
        assert "run_command(" in text or all(p.isascii() for p in printed), path


@pytest.mark.slow
def test_files_are_read_and_written_as_utf8():
    """No file of ours is opened in the encoding of the terminal."""
    opens = ("open", "read_text", "write_text")
    for path in [*(ROOT / "mjx_revolve").rglob("*.py"), *(ROOT / "experiments").glob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if not isinstance(node, ast.Call):
                continue
            name = getattr(node.func, "id", getattr(node.func, "attr", ""))
            said = ast.unparse(node)
            if name in opens and not any(x in said for x in ("encoding", "utf-8", "b'", "b+'")):
                assert any(x in said for x in ("os.open", "os.fdopen", "av.open")), (path, said)
