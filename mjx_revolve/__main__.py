"""All commands under one name: `mjx-revolve evolve lake_swim`, or `python -m mjx_revolve ...`."""

from __future__ import annotations

import importlib
import sys

from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.errors import InputError

_COMMANDS = ("evolve", "sweep", "inspect", "viewer", "replay", "live", "report", "export")
_USAGE = f"usage: mjx-revolve {{{','.join(_COMMANDS)}}} ... (each explains itself with --help)"


def main() -> int:
    """Runs the command that the first argument names.

    Returns:
        The exit code.
    """
    return run_command(_main, sys.argv[1:])


def _main(argv: list[str] | None) -> int:
    name, *rest = argv or ["--help"]
    if name in ("-h", "--help"):
        print(_USAGE)
        return 0
    if name not in _COMMANDS:
        raise InputError(f"expected one of {', '.join(_COMMANDS)}; found {name!r}")
    return importlib.import_module(f"mjx_revolve.{name}").main(rest)


if __name__ == "__main__":
    sys.exit(main())
