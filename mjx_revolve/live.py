"""Command line: a running world in a browser, to play with.

``python -m mjx_revolve.live runs/mine``
"""

from __future__ import annotations

import os
import sys
import threading
import time
from contextlib import suppress
from typing import TYPE_CHECKING

from mjx_revolve.inputs.commands import Parser, program, read_path, read_world, run_command, whole
from mjx_revolve.inputs.errors import plain
from mjx_revolve.inputs.trust import add_trust_argument, opening
from mjx_revolve.numerics.runtime import fix_environment, prepare_process

if TYPE_CHECKING:
    from mjx_revolve.view.live.simulation import LiveSimulation

_MAX_ROBOTS = 8  # robots in the water at once: two cores keep them in real time
_STOP_TIMEOUT = 3.0  # for the slice that is being stepped, at the end [s]


def main(argv: list[str] | None = None) -> int:
    """Runs a world until Ctrl-C, and shows it.

    Args:
        argv: the arguments; None: those of the process.

    Returns:
        0.

    Raises:
        InputError: an argument or a file is wrong.
        OSError: the port is taken.
    """
    parser = Parser(
        prog=program("live"),
        description="Run a world in real time and show it in a browser: drop robots, change the "
        "current, watch. Only this machine can open the page.",
        examples=("live runs/mine", "live spider gecko --world lake --robots 4"),
    )
    add = parser.add_argument
    add("paths", nargs="*", type=read_path, metavar="RUN|CONFIG|MORPHOLOGY",
        help="robots that may be dropped, the first of them at once: run folders, configurations, "
        "morphologies, or shipped ones' names; the first run or configuration says how robots are "
        "controlled, and where (default: lake_swim's)")  # fmt: skip
    add("--world", type=read_world, help="another world: a name or a YAML")
    add("--port", type=whole(0, 65535), default=0, metavar="N",
        help="of the page on 127.0.0.1 (default: any that is free)")  # fmt: skip
    add("--robots", type=whole(1, 64), default=_MAX_ROBOTS, metavar="N",
        help="for how many there is room; more are slower (default: %(default)s)")  # fmt: skip
    add_trust_argument(parser)
    arguments = parser.parse_args(argv)
    named = [*arguments.paths, *([arguments.world] if arguments.world else [])]
    fix_environment()
    from mjx_revolve.episodes.early_checks import check_live_files

    with opening(*named, trust=arguments.trust):
        check_live_files(arguments.paths, arguments.world)
    prepare_process()
    from mjx_revolve.episodes.tank import make_tank
    from mjx_revolve.view.live.page import live_page
    from mjx_revolve.view.live.robot_catalogue import load_catalogue
    from mjx_revolve.view.live.server import LiveServer
    from mjx_revolve.view.live.simulation import LiveSimulation

    with opening(*named, trust=arguments.trust):
        catalogue = load_catalogue(arguments.paths, arguments.world)
        room = arguments.robots
        tank = make_tank(catalogue.mixed, room, spheres=catalogue.spheres)
        simulation = LiveSimulation(tank, catalogue.world, catalogue.entries)
        try:
            server = LiveServer(simulation, live_page(catalogue, room), arguments.port)
        except OSError as error:
            raise OSError(error.errno, f"port {arguments.port}: {error.strerror}") from None
        serving = threading.Thread(target=server.serve_forever, daemon=True)
        serving.start()
        print(plain(server.address))
        print("open it in a browser on this machine; Ctrl-C ends it", flush=True)
        try:
            _watch(simulation)
        finally:
            simulation.stop()
            server.closing.set()
            server.shutdown()
            server.server_close()
    print("ended")
    return 0


def _watch(simulation: LiveSimulation) -> None:
    """Runs the world in a thread of its own, until it ends or is interrupted."""
    wrong: list[BaseException] = []

    def run() -> None:
        try:
            simulation.run()
        except BaseException as error:
            wrong.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    with suppress(KeyboardInterrupt):
        while thread.is_alive():
            time.sleep(0.1)
    simulation.stop()
    thread.join(_STOP_TIMEOUT)
    if thread.is_alive():
        # XLA compiles, and cannot be stopped; nothing is left that would be lost.
        print("ended", flush=True)
        os._exit(0)
    if wrong:
        raise wrong[0]


if __name__ == "__main__":
    sys.exit(run_command(main))
