"""Time as an argument: clocks and deadlines. Nothing below ``cli`` reads the wall clock itself."""

import time
from dataclasses import dataclass
from typing import Protocol


class Clock(Protocol):
    """Source of monotonic time."""

    def now_s(self) -> float:
        """Monotonic time in s."""
        ...

    def sleep_s(self, duration_s: float) -> None:
        """Wait for a duration in s."""
        ...


class SystemClock:
    """The machine's monotonic clock; wall-clock jumps do not move it."""

    def now_s(self) -> float:
        """Monotonic time in s."""
        return time.monotonic()

    def sleep_s(self, duration_s: float) -> None:
        """Wait for a duration in s; none or negative returns at once."""
        if duration_s > 0.0:
            time.sleep(duration_s)


class VirtualClock:
    """A clock that only moves when somebody sleeps on it, for tests and ``sim://``."""

    def __init__(self, start_s: float = 0.0) -> None:
        self._now_s = start_s

    def now_s(self) -> float:
        """Virtual time in s."""
        return self._now_s

    def sleep_s(self, duration_s: float) -> None:
        """Advance virtual time by a duration in s."""
        self._now_s += max(0.0, duration_s)


@dataclass(frozen=True)
class Deadline:
    """A point in time that is passed down, so that a total time-out holds whatever is split below.

    Parameters
    ----------
    clock : Clock
        Clock that the deadline is measured on.
    at_s : float
        Time in s on that clock.
    """

    clock: Clock
    at_s: float

    @classmethod
    def after(cls, clock: Clock, duration_s: float) -> "Deadline":
        """Deadline a duration in s from now."""
        return cls(clock, clock.now_s() + duration_s)

    def remaining_s(self) -> float:
        """Time left in s, never negative."""
        return max(0.0, self.at_s - self.clock.now_s())

    def expired(self) -> bool:
        """Whether the deadline has passed."""
        return self.clock.now_s() >= self.at_s
