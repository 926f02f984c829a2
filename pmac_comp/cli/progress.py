"""Progress for people on standard error: what is being done, since when, and how much of it.

What lives here: when a line is written and what stands in it. What may not: results (``output``).
A step that reports once has no share to show; one that begins by being over is not shown at all.
"""

import os
import shutil
import sys
import threading
import time
from collections import Counter
from contextlib import suppress
from typing import ClassVar, Final

LOCK: Final = threading.RLock()
"""Held while something is written on standard error: progress comes from a thread of its own."""

_REWRITE_s: Final = 0.1  # a terminal's line
_TICK_s: Final = 1.0  # by itself, so that somebody sees that it goes on
_KEPT_s: Final = 3.0  # a step that lasted so long stays on the terminal
_NEXT_LINE_s: Final = 10.0  # between lines elsewhere
_SAME_LINE_s: Final = 30.0  # where nothing has changed
_OF_ELAPSED: Final = 0.05  # and no less than this share of the time so far


class ProgressLines:
    """Progress on standard error: one line that is rewritten on a terminal, few lines elsewhere.

    A line is written by the call, and again while nobody calls: long work in one piece shows how
    long it has taken. Shares of a step only grow; a step that comes again is numbered.
    """

    is_open: ClassVar[bool] = False  # a line stands on the terminal and waits to be rewritten
    _running: ClassVar["ProgressLines | None"] = None

    def __init__(self) -> None:
        self._terminal = sys.stderr.isatty() and os.environ.get("TERM") != "dumb"
        self._start_s = self._begun_s = time.monotonic()
        self._step = ""
        self._fraction, self._moves = -1.0, False
        self._times: Counter[str] = Counter()
        self._written, self._written_s = "", -_SAME_LINE_s
        self._ended = threading.Event()
        self._ticker: threading.Thread | None = None

    def __call__(self, step: str, fraction: float) -> None:
        """Show a step and its fraction done (0..1; negative means not known)."""
        with LOCK:
            if step == self._step:
                self._moves |= fraction > self._fraction
                self._fraction = max(self._fraction, fraction)
            elif fraction < 1.0:
                self._begin(step, fraction)
            if self._step:
                self._write_if_due()
        self._go_on()

    def close(self) -> None:
        """End the line that is being rewritten, and the thread that rewrites it."""
        with LOCK:
            self._ended.set()
            if ProgressLines.is_open:
                end_line()
            self._step = ""
        ProgressLines._running = None

    @classmethod
    def stop(cls) -> None:
        """End whatever progress is shown: something else is to be said, and last."""
        if cls._running is not None:
            cls._running.close()

    def _begin(self, step: str, fraction: float) -> None:
        now_s = time.monotonic()
        if ProgressLines.is_open and now_s - self._begun_s >= _KEPT_s:
            end_line()
        self._step, self._fraction, self._moves, self._begun_s = step, fraction, False, now_s
        self._times[step] += 1

    def _text(self) -> str:
        again = self._times[self._step]
        share = f" {100.0 * self._fraction:3.0f} %" if self._moves else ""
        return self._step + (f" ({again})" if again > 1 else "") + share

    def _write_if_due(self) -> None:
        text, now_s = self._text(), time.monotonic()
        pause_s = _REWRITE_s
        if not self._terminal:
            least_s = _SAME_LINE_s if text == self._written else _NEXT_LINE_s
            pause_s = max(least_s, _OF_ELAPSED * (now_s - self._start_s))
        if now_s - self._written_s < pause_s:
            return
        self._written, self._written_s = text, now_s
        line = f"[{now_s - self._start_s:4.0f} s] {printable(text)}"
        if self._terminal:  # a line that wraps would not be rewritten but repeated
            sys.stderr.write("\r\x1b[K" + line[: shutil.get_terminal_size().columns - 1])
        else:
            sys.stderr.write(line + "\n")
        ProgressLines.is_open = self._terminal
        sys.stderr.flush()

    def _go_on(self) -> None:
        """Begin to rewrite the line by itself, with the first step."""
        if self._ticker is None and not self._ended.is_set():
            ProgressLines._running = self
            self._ticker = threading.Thread(target=self._tick, name="progress", daemon=True)
            self._ticker.start()

    def _tick(self) -> None:
        with suppress(OSError, ValueError):  # nobody reads any more, which is said elsewhere
            while not self._ended.wait(_TICK_s):
                with LOCK:
                    if self._step and not self._ended.is_set():
                        self._write_if_due()


def end_line() -> None:
    """Begin a new line below progress that stands on a terminal."""
    sys.stderr.write("\n")
    ProgressLines.is_open = False


def printable(text: str) -> str:
    """Text with control characters made visible, so that a controller cannot drive a terminal."""
    return "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in text)
