"""What all command lines share: quick help, complaints in one line, exit codes, ASCII terminals."""

import ast
import errno
import logging
import os
import subprocess
import sys
from importlib import metadata

import pytest

from laboratory import ROOT, check_error, refusal
from mjx_revolve.inputs import packages
from mjx_revolve.inputs.commands import (
    Parser,
    check_place,
    program,
    read_path,
    read_seconds,
    run_command,
    whole,
)
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.packages import REQUIREMENTS, check_mujoco, check_package


@pytest.mark.parametrize(
    ("name", "words"), [("evolve", "--resume DIR"), ("viewer", "--out FILE.html")]
)
def test_help_loads_nothing_heavy(name, words):
    heavy = {"jax", "mujoco", "matplotlib", "scipy"}
    # BLAS's threads are set before NumPy is loaded, where results depend on them.
    heavy |= set() if name in ("inspect", "viewer") else {"numpy"}
    code = (
        f"import sys; from mjx_revolve import {name}\n"
        f"try: {name}.main(['--help'])\n"
        "except SystemExit: pass\n"
        f"assert not {heavy} & set(sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    assert words in done.stdout


@pytest.mark.parametrize(("called", "words"), [
    ("/venv/bin/mjx-revolve", "mjx-revolve viewer"),
    ("/lib/mjx_revolve/__main__.py", "python -m mjx_revolve viewer"),
    ("/lib/mjx_revolve/viewer.py", "python -m mjx_revolve.viewer"),
    ("/lib/mjx_revolve/importer.py", "python -m mjx_revolve import"),
])  # fmt: skip
def test_commands_name_themselves_as_they_were_called(called, words, monkeypatch):
    monkeypatch.setattr(sys, "argv", [called])
    assert program(words.split("revolve")[-1].strip(" .")) == words


@pytest.mark.parametrize(("argv", "message"), [
    (["a", "--fast"], "unrecognized arguments: --fast (see --help)"),
    ([], "the following arguments are required: path (see --help)"),
    (["a", "--duration", "-1"], "--duration: expected a number > 0 and <= 86400 [s]; found"),
    (["a", "--rate", "²"], "--rate: expected a whole number from 1 to 9; found '²' (see"),
    (["a", "--count", "9" * 5000], "--count: expected a whole number >= 1; found '999"),
])  # fmt: skip
def test_wrong_arguments_are_one_line_and_code_2(argv, message, capsys):
    parser = Parser()
    parser.add_argument("path", type=read_path)
    parser.add_argument("--duration", type=read_seconds)
    parser.add_argument("--rate", type=whole(1, 9))
    parser.add_argument("--count", type=whole(1))
    assert run_command(lambda argv: parser.parse_args(argv) and 0, argv) == 2
    captured = capsys.readouterr()
    check_error(captured, f"error: {message}")
    assert captured.out == ""


FULL = OSError(errno.ENOSPC, "No space left on device", "a.xml")
LARGE = RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 64 bytes.\nmore")


@pytest.mark.parametrize(("error", "code", "line"), [
    (InputError("a.yaml: expected a file; found none"), 2, "error: a.yaml: expected a file; "),
    (FULL, 1, "error: a.xml: No space left on device\n"),
    (LARGE, 1, "error: too little memory: Out of memory allocating 64 bytes.\n"),
    (KeyboardInterrupt(), 130, "interrupted\n"),
])  # fmt: skip
def test_what_is_no_fault_of_ours_is_one_line(error, code, line, capsys):
    def main(argv):
        raise error

    assert run_command(main, []) == code
    written = capsys.readouterr().err
    assert written.startswith(line) and written.count("\n") == 1


def test_notes_of_the_package_are_shown_by_commands_alone(capsys):
    def note(argv):
        logging.getLogger("mjx_revolve.body").warning("%s has %d legs", "it", 8)
        logging.getLogger("another").warning("no affair of ours")
        return 0

    for _ in range(2):  # once each, however often a command runs
        assert run_command(note, []) == 0
        assert capsys.readouterr().err == "note: it has 8 legs\n"
    assert not logging.getLogger("mjx_revolve").handlers


def test_our_own_faults_keep_their_traceback():
    with pytest.raises(ZeroDivisionError):
        run_command(lambda argv: 1 // 0, [])


def test_places_that_cannot_be_written(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    check_place(tmp_path / "new" / "deep" / "a.xml", "--out")
    for place in ("file/a.xml", "file/new/a.xml"):
        with pytest.raises(InputError, match=r"^--out: expected the folder .*file; found a file$"):
            check_place(tmp_path / place, "--out")
    monkeypatch.setattr("os.access", lambda *_: False)
    with pytest.raises(InputError, match=r"^--out: expected a folder to write into; found .* read"):
        check_place(tmp_path / "a.xml", "--out")


@pytest.mark.parametrize("module", REQUIREMENTS)
def test_a_missing_package_is_named_with_its_remedy(module, monkeypatch):
    check_package("here", "json")
    monkeypatch.setitem(sys.modules, module, None)
    remedy = f"(pip install '{REQUIREMENTS[module]}')"
    expected = f"here: expected the package {module}; found none {remedy}"
    assert refusal(check_package, "here", module) == expected


def test_a_package_that_is_too_old_is_named(monkeypatch):
    of_mujoco(monkeypatch, json="1.2.9")
    monkeypatch.setitem(REQUIREMENTS, "json", "json>=1.10,<2")
    expected = "here: expected json 1.10 or newer; found 1.2.9 (pip install 'json>=1.10,<2')"
    assert refusal(check_package, "here", "json") == expected
    of_mujoco(monkeypatch, json="1.10.0")
    check_package("here", "json")


def of_mujoco(monkeypatch, **found):
    def version(name):
        if name not in found:
            raise metadata.PackageNotFoundError(name)
        return found[name]

    monkeypatch.setattr(packages, "version", version)


def test_mixed_installations_of_mujoco_are_refused_at_start(monkeypatch, capsys):
    of_mujoco(monkeypatch, mujoco="3.17.0")
    check_mujoco()
    of_mujoco(monkeypatch, **{"mujoco": "4.0.0", "mujoco-core": "4.0.0"})
    check_mujoco()
    of_mujoco(monkeypatch, **{"mujoco": "3.17.0", "mujoco-core": "4.0.0"})
    assert run_command(lambda argv: 0, []) == 2
    message = "error: mujoco: expected one version; found 3.17.0 with a mujoco-core"
    check_error(capsys.readouterr(), message)


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
