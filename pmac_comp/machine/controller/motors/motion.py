"""Running motion programs: start, status, abort, and waiting for their end."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from pmac_comp.base.clock import Deadline
from pmac_comp.base.errors import MotorNotSafe, ReplyTimeout
from pmac_comp.machine.controller.card.link import Link

RUNNING: Final = 1 << 0  # first word of ??
RUN_TIME_ERROR: Final = 1 << 22  # second word of ??
AMPLIFIER_FAULT: Final = 1 << 20
FATAL_FOLLOWING_ERROR: Final = 1 << 19
POLL_s: Final = 0.02


@dataclass(frozen=True)
class ProgramStatus:
    """What ``??`` says about a coordinate system."""

    running: bool
    run_time_error: bool
    faults: tuple[str, ...]


def program_status(link: Link, cs: int = 1) -> ProgramStatus:
    """Status of a coordinate system."""
    digits = link.query(f"&{cs}??")[0].strip()
    word1, word2 = int(digits[:6], 16), int(digits[6:12], 16)
    faults = [
        text
        for bit, text in (
            (AMPLIFIER_FAULT, "amplifier fault"),
            (FATAL_FOLLOWING_ERROR, "fatal following error"),
        )
        if word2 & bit
    ]
    return ProgramStatus(bool(word1 & RUNNING), bool(word2 & RUN_TIME_ERROR), tuple(faults))


def start(link: Link, number: int, *, cs: int = 1) -> None:
    """Point to a program and run it; refusals ERR010 to ERR017 say why not (p. 391)."""
    link.command(f"&{cs}B{number}R")


def abort(link: Link, *, cs: int = 1) -> None:
    """Abort a program; its motors decelerate with Ixx15."""
    link.command(f"&{cs}A")


def wait_for_end(
    link: Link,
    *,
    cs: int = 1,
    timeout_s: float,
    on_poll: Callable[[], None] | None = None,
) -> None:
    """Wait until a program has ended.

    Raises
    ------
    MotorNotSafe
        Run-time error or fault: the program has stopped.
    ReplyTimeout
        Still running after the time; it was aborted.
    """
    deadline = Deadline.after(link.clock, timeout_s)
    while True:
        status = program_status(link, cs)
        if status.run_time_error or status.faults:
            why = ", ".join(status.faults) or "run-time error"
            raise MotorNotSafe(
                f"The motion program stopped: {why}.",
                code="PC-RUN-002",
                hint="`pmac-comp status` shows the motors; clear the fault and run it again.",
            )
        if not status.running:
            return
        if deadline.expired():
            abort(link, cs=cs)
            raise ReplyTimeout(
                f"The motion program still ran after {timeout_s:g} s and was aborted.",
                code="PC-RUN-003",
                hint="Look at the feed rate override: `pmac-comp terminal URL -c '&1%'` should "
                "say 100.",
            )
        if on_poll is not None:
            on_poll()
        link.clock.sleep_s(POLL_s)
