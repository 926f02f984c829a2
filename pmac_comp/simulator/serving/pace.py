"""How simulated time passes beside the clients of a served card.

At real time or a multiple of it, as fast as a host that empties the gather ring can follow, or as
far as a host in the same process grants. Time runs in chunks short enough that no client waits
long; where the machine cannot keep up, time slips rather than clients starve.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable
from typing import Final

from pmac_comp.simulator.card.card import Card

AS_FAST_AS_FOLLOWED: Final = float("inf")
_TICK_s = 0.005
_MAX_CHUNK_CYCLES = 300
_LONGEST_CHUNK_s = 0.005  # of wall time between two looks at the clients
_LONGEST_LAG_s = 0.25
_IDLE_s = 0.0002  # between two looks at what the host grants
_TOLD_LAG_s = 1.0  # time that slipped before a person is told


class HostPace:
    """Servo cycles that the host in the same process has granted; the card never runs ahead.

    A host that shares its interpreter with the card could otherwise be starved by it for longer
    than the gather ring holds.
    """

    def __init__(self) -> None:
        self._granted = 0
        self._lock = threading.Lock()

    def grant(self, cycles: int) -> None:
        """Let the card run so many cycles more."""
        with self._lock:
            self._granted += cycles

    def take(self, most: int) -> int:
        """Cycles to run now, at most ``most``."""
        with self._lock:
            taken = min(self._granted, most)
            self._granted -= taken
            return taken


class Pace:
    """Lets the servo cycles of a card pass.

    Parameters
    ----------
    card : Card
        The card.
    factor : float
        Multiple of real time, infinite for as fast as a host can follow.
    host : HostPace or None
        Grants of a host in this process; then ``factor`` has no meaning.
    after_chunk : callable
        Called whenever some cycles have passed.
    tell : callable
        Receives what a person at the server should know.
    """

    def __init__(
        self,
        card: Card,
        factor: float,
        host: HostPace | None,
        *,
        after_chunk: Callable[[], None],
        tell: Callable[[str], None],
    ) -> None:
        self._card = card
        self._factor = factor
        self._host = host
        self._after_chunk = after_chunk
        self._tell = tell
        self._chunk_cycles = _MAX_CHUNK_CYCLES

    async def run(self) -> None:
        """Let time pass until cancelled."""
        if self._host is not None:
            await self._follow(self._host.take)
        elif self._factor == AS_FAST_AS_FOLLOWED:
            await self._follow(lambda most: min(most, self._allowed()))
        else:
            await self._keep_up()

    async def _follow(self, take: Callable[[int], int]) -> None:
        """Run the cycles that ``take`` gives, of those that a chunk holds at most."""
        while True:
            cycles = take(self._chunk_cycles)
            if cycles:
                self._run_chunk(cycles)
            self._after_chunk()
            await asyncio.sleep(0 if cycles else _IDLE_s)

    async def _keep_up(self) -> None:
        """Run at a multiple of real time."""
        loop = asyncio.get_running_loop()
        period_s = self._card.bench.servo_period_s / self._factor
        start_s, start_cycles = loop.time(), self._card.cycles
        lost = 0
        while True:
            due = int((loop.time() - start_s) / period_s)
            behind = due - (self._card.cycles - start_cycles)
            if behind * period_s > _LONGEST_LAG_s:
                slipped = behind - int(_LONGEST_LAG_s / period_s)
                start_cycles -= slipped
                behind -= slipped
                if lost * period_s < _TOLD_LAG_s <= (lost + slipped) * period_s:
                    done = self._card.cycles - start_cycles - (lost + slipped)
                    self._tell(_too_slow(self._factor, done, lost + slipped))
                lost += slipped
            if self._factor > 1.0 and behind > (allowed := self._allowed()):
                start_cycles -= behind - allowed
                behind = allowed
            if behind > 0:
                self._run_chunk(behind)
            self._after_chunk()
            await asyncio.sleep(0 if behind > self._chunk_cycles else _TICK_s)

    def _allowed(self) -> int:
        """Cycles that a host which empties the gather ring can follow."""
        return self._card.ring_hold.allowance(self._card.cycles, time.perf_counter())

    def _run_chunk(self, wanted: int) -> None:
        """Run at most as many cycles as keep clients waiting for ``_LONGEST_CHUNK_s``.

        A plant written in Python may take 0.1 ms a cycle, the compiled one 1 us: the number of
        cycles in a chunk follows what the last one took.
        """
        cycles = min(wanted, self._chunk_cycles)
        start_s = time.perf_counter()
        self._card.run_cycles(cycles)
        per_cycle_s = (time.perf_counter() - start_s) / cycles
        affordable = int(_LONGEST_CHUNK_s / per_cycle_s)
        self._chunk_cycles = max(1, min(_MAX_CHUNK_CYCLES, affordable, 2 * self._chunk_cycles))


def _too_slow(factor: float, done: int, lost: int) -> str:
    """What is said when time falls behind: cycles done and cycles lost so far."""
    share = done / (done + lost)
    return (
        f"simulated time falls behind: {share * factor:.3g} of real time instead of {factor:g}. "
        "The machine is busy, or a plant written in Python takes longer than a servo period; see "
        "tools/bench simulator."
    )
