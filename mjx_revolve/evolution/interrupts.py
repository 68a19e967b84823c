"""Ctrl-C, SIGTERM and SIGHUP as requests to end: finished work is saved before the process ends.

Python runs signal handlers between two instructions of the main thread, and so not while that is
inside a compiled program, perhaps for minutes. A separate thread receives signals at once.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import stat
import sys
import threading
from collections.abc import Callable
from typing import NoReturn

# Requests to end a process; SIGHUP is a lost terminal.
_SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)


class Interrupts:
    """Takes the signals while it is entered, in the main thread.

    At first a signal ends the process at once, with one line. From `finish_first` on, the first is
    noted, and the generation in progress can be finished; the second ends the process after saving.

    Attributes:
        signal: the number of the first signal; None so far.
        writing: a lock, held while files are written: the process does not end meanwhile.
        rescue: saves unsaved work before the process ends. Called in another thread, while
            `writing` is held.
    """

    def __init__(self, early: str = "interrupted before the run began") -> None:
        """No signal so far; `early`: the line before `finish_first`."""
        self._early = early
        self.signal: int | None = None
        self.writing = threading.Lock()
        self.rescue: Callable[[], None] = lambda: None
        self._answer: str | None = None
        self._answering = threading.RLock()  # the handler may come in the middle of itself
        self._numbers: set[int] = set()
        self._undo = contextlib.ExitStack()

    def finish_first(self, answer: str) -> None:
        """From now on the first signal is only noted, and answered by a line."""
        self._answer = answer

    def __enter__(self) -> Interrupts:
        if threading.current_thread() is not threading.main_thread():
            return self  # its owner handles signals
        ears, mouth = socket.socketpair()
        mouth.setblocking(False)
        thread = threading.Thread(target=self._listen, args=(ears,), daemon=True)
        # What ends it, in reverse: `mouth.close` is the end, for the thread.
        for end in (ears.close, thread.join, mouth.close):
            self._undo.callback(end)
        former = signal.set_wakeup_fd(mouth.fileno(), warn_on_full_buffer=False)
        self._undo.callback(signal.set_wakeup_fd, former)
        for number in _SIGNALS:
            # Under nohup, SIGHUP is ignored; it stays so.
            if number != signal.SIGINT and signal.getsignal(number) is signal.SIG_IGN:
                continue
            self._numbers.add(number)
            self._undo.callback(signal.signal, number, signal.signal(number, self._note))
        thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._undo.close()

    def _note(self, number: int, _: object) -> None:
        """Python's own handler; it may come later than `_listen`, or earlier."""
        if self._answer is not None:
            self._ask(number)

    def _ask(self, number: int) -> None:
        """Notes the first signal, and prints the answer once."""
        with self._answering:
            if self.signal is None:
                self.signal = number
                _say(f"{self._answer}; press Ctrl-C again to quit at once")

    def _listen(self, ears: socket.socket) -> None:
        """Receives each signal at once, in a thread of its own."""
        count = 0
        while came := ears.recv(1):
            number = came[0]
            if number not in self._numbers:  # all signals arrive here, other handlers' included
                continue
            count += 1
            _leave_lost_terminal()
            if self._answer is None:
                self._end(number, self._early)
            elif count > 1:
                self._end(number, "ended at once; what was finished is saved")
            self._ask(number)

    def _end(self, number: int, words: str) -> NoReturn:
        """Ends the process at once, without unwinding the main thread."""
        with self.writing:
            try:
                self.rescue()
            except Exception as error:  # a full disk, say: the checkpoint before stays whole
                words = f"not saved: {' '.join(str(error).split())}"
            _say(words)
            os._exit(128 + number)

    @property
    def exit_code(self) -> int:
        """The exit code, 128 plus the signal's number as in shells; 0 without a signal."""
        return 128 + self.signal if self.signal else 0


def _say(words: str) -> None:
    """A line on stderr; no print, as the main thread may be in the middle of one."""
    with contextlib.suppress(OSError):
        os.write(2, f"{chr(10) if sys.stderr.isatty() else ''}{words}\n".encode())


def _leave_lost_terminal() -> None:
    """Redirects output to /dev/null: an error on a lost terminal must not prevent saving."""
    for descriptor in (1, 2):
        with contextlib.suppress(OSError):
            if stat.S_ISCHR(os.fstat(descriptor).st_mode) and not os.isatty(descriptor):
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, descriptor)
                os.close(nowhere)
