"""A worker: scores blocks of individuals for the process that leads a run, one after the other.

Started by `crew`, not by hand. What to do comes as one line of JSON on standard input; scores go
back over a connection (see `messages`). Standard input stays open as long as the process that
started this one lives: when it ends, even by kill -9, the worker ends at once. It ends too when its
connection does.

Interrupts are the leader's affair: a worker ignores Ctrl-C and SIGTERM, so that the generation
under way can be finished when all processes of a job get the signal.

Heavy imports stand inside functions: thread settings must be made before NumPy and JAX are loaded.
"""

from __future__ import annotations

import json
import os
import pkgutil
import signal
import socket
import sys
import threading
import time
import traceback
from typing import Any, NoReturn

from mjx_revolve.evolution.messages import PROTOCOL, Channel, SecretError, format_address
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics import runtime

# How long a handshake's message may take: the leader may still be building its own robot [s].
_HANDSHAKE = 300.0
# Between attempts to reach a leader that is not there yet [s].
_RETRY = 0.2


def main() -> NoReturn:
    """Runs the command and ends the process.

    The exit code is 0 when the leader said to stop, 2 when it refused this worker or the input is
    wrong, 1 otherwise. The last line on standard error says why.
    """
    code = _run()
    # JAX's own farewell takes a tenth of a second, and there is nothing to bid farewell to.
    sys.stderr.flush()
    os._exit(code)


def _run() -> int:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    line = _read_line()
    if not line:
        print("error: expected to be started by mjx_revolve.evolve", file=sys.stderr)
        return 2
    job = json.loads(line)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    runtime.prepare_worker(job["core"], job["cache"])
    try:
        return _work(job)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except (EOFError, OSError) as error:
        reason = "" if isinstance(error, EOFError) else f" ({error})"
        address = format_address(job["address"])
        print(f"error: the leader at {address} is gone{reason}", file=sys.stderr)
        return 1


def _read_line() -> bytes:
    """Byte by byte, so that nothing but the line is read."""
    line = bytearray()
    while (byte := os.read(0, 1)) not in (b"", b"\n"):
        line += byte
    return bytes(line)


def _end_with_parent() -> NoReturn:
    while os.read(0, 1):
        pass
    os._exit(1)


def _work(job: dict[str, Any]) -> int:
    import jax
    import numpy as np

    from mjx_revolve.episodes.config import make_config
    from mjx_revolve.evolution.blocks import evaluate_block
    from mjx_revolve.evolution.fingerprints import identify

    config = make_config(job["config"], "/", source=job["source"])
    fitness = pkgutil.resolve_name(job["make"])(config)
    hello = identify(config, fitness) | {
        "type": "hello",
        "protocol": PROTOCOL,
        "node": socket.gethostname(),
        "cpu": runtime.cpu_model(),
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        "cached": bool(job["cache"]),
    }
    hello |= {name: job[name] for name in ("host", "hosts", "worker", "workers")}
    channel = _connect(tuple(job["address"]), job["patience"])
    try:
        channel.prove_secret(job["secret"].encode(), leads=False)
    except SecretError:
        raise InputError(
            f"MJX_REVOLVE_SECRET: expected the secret of the leader at "
            f"{format_address(job['address'])}; found another"
        ) from None
    channel.send_message(hello)
    channel.set_patience(None)  # between generations it may take any time
    warm = False
    while True:
        order, block = channel.receive_message()
        if order["type"] == "refused":
            raise InputError(order["reason"])
        if order["type"] == "stop":
            break
        try:
            assert block is not None
            data = jax.numpy.asarray(order["key"], np.uint32)
            key = jax.random.wrap_key_data(data, impl=order["kind"])
            scores, names = evaluate_block(fitness, block, key)
        except Exception as error:
            traceback.print_exc()
            lines = str(error).splitlines() or [""]
            reason = f"{type(error).__name__}: {lines[0]}"
            channel.send_message({"type": "failed", "reason": reason})
            return 1
        if not warm and job["core"] is not None:
            runtime.pin_process([job["core"]])
        warm = True
        channel.send_message({"type": "scores", "measures": names}, scores)
    channel.close()
    if order["reason"]:
        print(f"error: the leader ended the run: {order['reason']}", file=sys.stderr)
    return 1 if order["reason"] else 0


def _connect(address: tuple[str, int], patience: float) -> Channel:
    """Reaches the leader, who may start later."""
    deadline = time.monotonic() + patience
    while True:
        try:
            return Channel(socket.create_connection(address, timeout=5.0), _HANDSHAKE)
        except OSError as error:
            if time.monotonic() > deadline:
                raise InputError(
                    f"--coordinator {format_address(address)}: expected the run's leader to "
                    f"listen there within {patience:.0f} s; found: {error.strerror or error}"
                ) from None
        time.sleep(_RETRY)


if __name__ == "__main__":
    main()
