"""Ctrl-C while something must not be left half done: the first is remembered, the second acts.

What lives here: signals of this process. What may not: what is to be done about them.
"""

import signal
import threading
from types import FrameType, TracebackType
from typing import Final, Self

_NAMES: Final = ("SIGINT", "SIGTERM", "SIGHUP")
_SIGNALS: Final = tuple(getattr(signal, name) for name in _NAMES if hasattr(signal, name))


class DeferredInterrupt:
    """Within ``with``, the first signal that would raise KeyboardInterrupt only sets ``pending``.

    A second one raises. Signals that somebody handles in another way are left alone, and so is
    everything outside the main thread, where Python delivers no signals.
    """

    def __init__(self) -> None:
        self.pending = False
        self._taken: list[int] = []

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for number in _SIGNALS:
                if signal.getsignal(number) is signal.default_int_handler:
                    signal.signal(number, self._note)
                    self._taken.append(number)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for number in self._taken:
            signal.signal(number, signal.default_int_handler)
        self._taken.clear()

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.pending:
            signal.default_int_handler(number, frame)
        self.pending = True
