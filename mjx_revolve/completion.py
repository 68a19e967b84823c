"""Command line: a script by which a shell completes commands, and names of what is shipped.

``eval "$(mjx-revolve completion bash)"`` in `~/.bashrc`, the same with `zsh` in `~/.zshrc`.
The names are those of the package as it was when the script was printed. Files and folders stand
beside them: a path does wherever a name does, and `report` takes nothing else.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable

from mjx_revolve.inputs.commands import Parser, program, run_command
from mjx_revolve.inputs.shipped import list_shipped

_SCRIPT = """_mjx_revolve() {
  local words current="${COMP_WORDS[COMP_CWORD]}"
  case "$COMP_CWORD:${COMP_WORDS[1]}" in
    1:*) words="%(commands)s" ;;
    *:evolve|*:sweep) words="%(configs)s" ;;
    *:live|*:fit) words="%(configs)s %(morphologies)s" ;;
    *:schema) words="%(kinds)s" ;;
    *:completion) words="bash zsh" ;;
    *:report|*:passport|*:import) words="" ;;
    *) words="%(morphologies)s" ;;
  esac
  case "${COMP_WORDS[COMP_CWORD-1]}" in
    --world) words="%(worlds)s" ;;
    --out|--resume|--picture|--modules) words="" ;;
  esac
  COMPREPLY=($(compgen -W "$words" -- "$current"))
  case "$COMP_CWORD:${COMP_WORDS[1]}" in
    1:*|*:schema|*:completion) ;;
    *) local IFS=$'\\n'; COMPREPLY+=($(compgen -f -- "$current")) ;;
  esac
}
complete -o filenames -F _mjx_revolve mjx-revolve
"""
_ZSH = """(( $+functions[compdef] )) || { autoload -Uz compinit && compinit; }
autoload -U +X bashcompinit && bashcompinit
"""


def make_script(shell: str) -> str:
    """The script for "bash" or "zsh"."""
    from mjx_revolve.__main__ import COMMANDS
    from mjx_revolve.schema import KINDS

    names: dict[str, Iterable[str]] = {
        "commands": COMMANDS,
        "configs": list_shipped("configs"),
        "kinds": KINDS,
        "morphologies": list_shipped("morphologies"),
        "worlds": list_shipped("worlds"),
    }
    plain = {key: [n for n in found if re.fullmatch(r"[\w.-]+", n)] for key, found in names.items()}
    script = _SCRIPT % {key: " ".join(found) for key, found in plain.items()}
    return _ZSH + script if shell == "zsh" else script


def main(argv: list[str] | None = None) -> int:
    """Prints the script."""
    parser = Parser(
        prog=program("completion"),
        description="Print a script by which a shell completes commands and shipped names.",
        epilog='example: eval "$(mjx-revolve completion bash)" in ~/.bashrc, or zsh in ~/.zshrc',
    )
    parser.add_argument("shell", choices=("bash", "zsh"), help="the shell of the script")
    print(make_script(parser.parse_args(argv).shell), end="")
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
