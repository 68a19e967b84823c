"""What all command lines share: quick help, complaints in one line, exit codes."""

import errno
import logging
import subprocess
import sys

import pytest

from laboratory import ROOT, check_error
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


@pytest.mark.parametrize(
    ("name", "words"),
    [("evolve", "--resume DIR"), ("viewer", "--out FILE.html")],
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


@pytest.mark.parametrize(
    ("called", "words"),
    [
        ("/venv/bin/mjx-revolve", "mjx-revolve viewer"),
        ("/lib/mjx_revolve/__main__.py", "python -m mjx_revolve viewer"),
        ("/lib/mjx_revolve/viewer.py", "python -m mjx_revolve.viewer"),
        ("/lib/mjx_revolve/importer.py", "python -m mjx_revolve import"),
    ],
)
def test_commands_name_themselves_as_they_were_called(called, words, monkeypatch):
    monkeypatch.setattr(sys, "argv", [called])
    assert program(words.split("revolve")[-1].strip(" .")) == words


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["a", "--fast"], "unrecognized arguments: --fast (see --help)"),
        ([], "the following arguments are required: path (see --help)"),
        (["a", "--duration", "-1"], "--duration: expected a number > 0 and <= 86400 [s]; found"),
        (["a", "--rate", "²"], "--rate: expected a whole number from 1 to 9; found '²' (see"),
        (["a", "--count", "9" * 5000], "--count: expected a whole number >= 1; found '999"),
    ],
)
def test_wrong_arguments_are_one_line_and_code_2(argv, message, capsys):
    parser = Parser()
    parser.add_argument("path", type=read_path)
    parser.add_argument("--duration", type=read_seconds)
    parser.add_argument("--rate", type=whole(1, 9))
    parser.add_argument("--count", type=whole(1))
    assert run_command(lambda argv: parser.parse_args(argv) and 0, argv) == 2
    check_error(capsys.readouterr(), f"error: {message}")


FULL = OSError(errno.ENOSPC, "No space left on device", "a.xml")
LARGE = RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 64 bytes.\nmore")


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (InputError("a.yaml: expected a file; found none"), 2, "error: a.yaml: expected a file; "),
        (FULL, 1, "error: a.xml: No space left on device\n"),
        (LARGE, 1, "error: too little memory: Out of memory allocating 64 bytes.\n"),
        (KeyboardInterrupt(), 130, "interrupted\n"),
    ],
)
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
