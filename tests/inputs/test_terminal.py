"""Terminals that take ASCII only: nothing ends in a traceback."""

import ast
import os
import subprocess
import sys

import pytest

from laboratory import ROOT

CODE = (  # in ASCII itself
    "import sys; from mjx_revolve.inputs.commands import run_command\n"
    "def main(argv):\n"
    "    print('0.158 \\xb1 0.003 m/s\\xb2 \\xd7 2 \\u2026 gr\\xf6\\xdfer \\udcff')\n"
    "    print('note \\xb1', file=sys.stderr)\n"
    "    raise OSError(5, 'disk \\u2264 full')\n"
    "sys.exit(run_command(main))"
)


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
    assert out.startswith("0.158 \\xb1 0.003 m/s\\xb2")
    assert err.splitlines() == ["note \\xb1", "error: disk \\u2264 full"]


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
