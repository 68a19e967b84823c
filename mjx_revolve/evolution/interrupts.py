"""Ctrl-C and SIGTERM as requests: the first is noted, the second ends the process at once."""

from __future__ import annotations

import os
import signal
from typing import Any


class Interrupts:
    """Takes the signals while it is entered.

    Attributes:
        signal: the number of the one that came; None so far.
    """

    def __init__(self, answer: str) -> None:
        """Says nothing yet.

        Args:
            answer: what the first signal is answered by; how to quit at once is added.
        """
        self.signal: int | None = None
        self._answer = answer
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> Interrupts:
        for number in (signal.SIGINT, signal.SIGTERM):
            try:
                self._previous[number] = signal.signal(number, self._note)
            except ValueError:  # not in the main thread: whoever owns that decides
                break
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _note(self, number: int, _: object) -> None:
        self.signal = number
        # The next one ends the process at once, even inside a compiled program.
        for other in self._previous:
            signal.signal(other, signal.SIG_DFL)
        # No print: the signal may have come in the middle of one.
        os.write(2, f"\n{self._answer}; press Ctrl-C again to quit at once\n".encode())

    @property
    def exit_code(self) -> int:
        """What a shell expects of a process that was interrupted; 0 if it was not."""
        return 128 + self.signal if self.signal else 0
