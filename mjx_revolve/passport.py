"""Command line: the passport of a run's champion: what it was tried for, and what it fails.

``python -m mjx_revolve.passport RUN``
"""

from __future__ import annotations

import sys

from mjx_revolve.evolution.interrupts import Interrupts
from mjx_revolve.inputs.commands import Parser, check_place, program, read_path, run_command
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import short_path, write_atomic
from mjx_revolve.inputs.trust import add_trust_argument, opening
from mjx_revolve.numerics import runtime


def main(argv: list[str] | None = None) -> int:
    """Makes the passport anew, prints it, and writes it to the run folder.

    Args:
        argv: the arguments; None: those of the process.

    Returns:
        0, or 1 where the champion fails.

    Raises:
        InputError: an argument or a file is wrong.
    """
    parser = Parser(
        prog=program("passport"),
        description="Tries a run's champion as it was not selected: from other starts, for longer, "
        "in smaller steps, in other water, without its brain. The exit code is 1 where it fails.",
        examples=("passport runs/mine",),
    )
    parser.add_argument("run", type=read_path, metavar="RUN", help="a run folder")
    add_trust_argument(parser)
    arguments = parser.parse_args(argv)
    runtime.fix_environment()
    from mjx_revolve.episodes.run_reader import RunReader, find_run

    # While programs are compiled, only a thread of its own can end the process.
    with Interrupts("interrupted"), opening(arguments.run, trust=arguments.trust):
        folder = find_run(arguments.run)
        champion = RunReader(folder).load_champion()
        config = champion.load_config()  # before JAX is imported
        check_place(folder / "any", short_path(folder))
        runtime.prepare_process()
        from mjx_revolve.episodes.fitness import make_fitness
        from mjx_revolve.episodes.passport import PASSPORT, make_passport

        fitness = make_fitness(config)
        champion.check_genes(fitness.num_genes, "config.yaml")
        passport = make_passport(fitness, champion.genes, config.evolution.seed)
    widths = [max(len(row[k]) for row in passport.rows) for k in range(3)]
    for row in passport.rows:
        *cells, verdict = (*(x.ljust(w) for x, w in zip(row, widths, strict=False)), row[-1])
        print("  ".join((*cells, verdict)).rstrip())
    with opening(arguments.run, trust=arguments.trust):
        now = RunReader(folder).load_champion()  # that of a run under way may be another one
        if now.facts != champion.facts or list(now.genes) != list(champion.genes):
            tried = "the champion that was tried"
            raise InputError(folder / "champion", tried, "another one: the run goes on")
    write_atomic(folder / PASSPORT, passport.to_text().encode())
    print(f"\n{passport.mark or 'passes'}: {short_path(folder / PASSPORT)}")
    return 1 if passport.failed else 0


if __name__ == "__main__":
    sys.exit(run_command(main))
