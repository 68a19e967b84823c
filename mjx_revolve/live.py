"""Command line: a running world in a browser, to play with.

``python -m mjx_revolve.live runs/mine``
"""

from __future__ import annotations

import os
import sys
import threading
import time
from typing import TYPE_CHECKING

from mjx_revolve.inputs.commands import Parser, program, read_path, run_command, whole
from mjx_revolve.inputs.errors import InputError, plain
from mjx_revolve.inputs.trust import add_trust_argument, opening

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
        InputError: an argument or a file is wrong, or there is no screen for `--mujoco`.
        OSError: the port is taken.
    """
    parser = Parser(
        prog=program("live"),
        description="Run a world in real time and show it in a browser: drop robots, change the "
        "current, watch. Only this machine can open the page.",
        examples=(
            "live runs/mine",
            "live spider gecko --world lake --robots 4",
        ),
    )
    parser.add_argument(
        "paths", nargs="*", type=read_path, metavar="RUN|CONFIG|MORPHOLOGY",
        help="robots that may be dropped, the first of them at once: run folders, configurations, "
        "morphologies, or shipped ones' names; the first run or configuration says how robots are "
        "controlled, and where (default: lake_swim's)",
    )  # fmt: skip
    parser.add_argument("--world", help="another world: a name or a YAML")
    parser.add_argument(
        "--port", type=whole(0, 65535), default=0, metavar="N",
        help="of the page on 127.0.0.1 (default: any that is free)",
    )  # fmt: skip
    parser.add_argument(
        "--robots", type=whole(1, 64), default=_MAX_ROBOTS, metavar="N",
        help="for how many there is room; more are slower (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--mujoco", action="store_true", help="MuJoCo's viewer besides the page; needs a screen"
    )
    add_trust_argument(parser)
    arguments = parser.parse_args(argv)
    if arguments.mujoco:
        from mjx_revolve.view.film.opengl import check_screen

        check_screen("--mujoco", "without it there is a page for a browser, which needs none")
    from mjx_revolve.numerics.runtime import prepare_process

    prepare_process()
    from mjx_revolve.episodes.tank import make_tank
    from mjx_revolve.view.live.page import live_page
    from mjx_revolve.view.live.robot_catalogue import load_catalogue
    from mjx_revolve.view.live.server import LiveServer
    from mjx_revolve.view.live.simulation import LiveSimulation

    named = [*arguments.paths, *([arguments.world] if arguments.world else [])]
    with opening(*named, trust=arguments.trust):
        catalogue = load_catalogue(arguments.paths, arguments.world)
        room = arguments.robots
        simulation = LiveSimulation(
            make_tank(catalogue.mixed, room, spheres=catalogue.spheres),
            catalogue.world,
            catalogue.entries,
            waits=not arguments.mujoco,
        )
        try:
            server = LiveServer(simulation, live_page(catalogue, room), arguments.port)
        except OSError as error:
            raise OSError(error.errno, f"port {arguments.port}: {error.strerror}") from None
        serving = threading.Thread(target=server.serve_forever, daemon=True)
        serving.start()
        print(plain(server.address))
        print("open it in a browser on this machine; Ctrl-C ends it", flush=True)
        try:
            _watch(simulation, arguments.mujoco)
        finally:
            simulation.stop()
            server.closing.set()
            server.shutdown()
            server.server_close()
    print("ended")
    return 0


def _watch(simulation: LiveSimulation, window: bool) -> None:
    """Runs the world in a thread of its own, until it ends or is interrupted."""
    wrong: list[BaseException] = []

    def run() -> None:
        try:
            simulation.run()
        except BaseException as error:
            wrong.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        if window:
            from mjx_revolve.view.live.window import show_window

            show_window(simulation)
            simulation.stop()
        while thread.is_alive():
            time.sleep(0.1)
    except KeyboardInterrupt:
        pass
    except InputError as error:  # no screen, after all
        wrong.append(error)
    simulation.stop()
    thread.join(_STOP_TIMEOUT)
    if thread.is_alive():
        # XLA compiles, and cannot be stopped; nothing is left that would be lost.
        said, code = (f"error: {wrong[0]}", 2) if wrong else ("ended", 0)
        print(said, file=sys.stderr if wrong else sys.stdout, flush=True)
        sys.stderr.flush()
        os._exit(code)
    if wrong:
        raise wrong[0]


if __name__ == "__main__":
    sys.exit(run_command(main))
