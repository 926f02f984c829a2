"""Identity, reset, flash, locks. Source: Software Reference Manual p. 295-402."""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta

from pmac_comp.machine.wire.identity import SIMULATED_ID
from pmac_comp.simulator.commands.line import LineContext, command
from pmac_comp.simulator.memory.errors import CardError

FIRMWARE = "1.947"
CARD_ID = "603382"  # 3U Turbo PMAC2 (UMAC), which clients know
_START = datetime(2000, 1, 1, tzinfo=UTC)  # clock option absent: time counts from here
_TIME = re.compile(r"(\d\d?):(\d\d):(\d\d)")
_DATE = re.compile(r"(\d\d?)/(\d\d?)/(\d{4})")


def _constant_answer(text: str, *keywords: str) -> None:
    @command(*keywords)
    def handler(context: LineContext) -> None:
        context.answer(text)


_constant_answer(FIRMWARE + "  ", "VERSION", "VER")
_constant_answer("1947001", "EAVERSION", "EAVER")
_constant_answer("TURBO2, X4", "TYPE")
_constant_answer("56303", "CPU")
_constant_answer(CARD_ID, "CID")
_constant_answer("1", "VID")
_constant_answer(SIMULATED_ID, "SID", "IDNUMBER", "IDNUM")
_constant_answer("02/24/2014", "DATE", "DAT")


@command("TODAY")
def _today(context: LineContext) -> None:
    now = _now(context)
    given = _setting(context, _DATE)
    if given is None:
        context.answer(now.strftime("%a %m/%d/%Y").upper())
        return
    month, day, year = given
    _set_clock(context, now, year=year, month=month, day=day)


@command("TIME")
def _time(context: LineContext) -> None:
    now = _now(context)
    given = _setting(context, _TIME)
    if given is None:
        context.answer(now.strftime("%H:%M:%S"))
        return
    hour, minute, second = given
    _set_clock(context, now, hour=hour, minute=minute, second=second)


def _now(context: LineContext) -> datetime:
    shift = timedelta(seconds=context.card.clock_shift_s)
    return _START + timedelta(seconds=context.card.time_s) + shift


def _setting(context: LineContext, form: re.Pattern[str]) -> list[int] | None:
    """Numbers behind ``TIME=`` or ``TODAY=``, None for a question."""
    scanner = context.scanner
    if not scanner.take("="):
        return None
    scanner.skip_blanks()
    match = form.match(scanner.text, scanner.position)
    if match is None:
        raise CardError(3)
    scanner.position = match.end()
    return [int(text) for text in match.groups()]


def _set_clock(context: LineContext, now: datetime, **parts: int) -> None:
    try:
        moved = now.replace(**parts)  # type: ignore[arg-type]
    except ValueError as error:
        raise CardError(3) from error
    context.card.clock_shift_s += (moved - now).total_seconds()


@command("CHECKSUM", "CHKS")
def _checksum(context: LineContext) -> None:
    context.answer(f"{context.card.programs.checksum():06X}")


@command("SIZE")
def _size(context: LineContext) -> None:
    programs = context.card.programs
    free = programs.free_words()
    context.answer(str(free if programs.open_program is None else -free))


@command("SAVE")
def _save(context: LineContext) -> None:
    context.card.save()


@command("PASSWORD=")
def _password(context: LineContext) -> None:
    text = context.scanner.raw[context.scanner.position :].strip()
    context.scanner.position = len(context.scanner.text)
    context.card.programs.set_password(text)


@command("LOCK")
def _lock(context: LineContext) -> None:
    number = context.scanner.need_integer(0, 7)
    context.scanner.expect(",")
    context.scanner.expect("P")
    context.card.interpreter.lock(number, context.scanner.need_integer(0, 8191))


@command("UNLOCK")
def _unlock(context: LineContext) -> None:
    context.card.interpreter.lock(context.scanner.need_integer(0, 7), None)


@command("FSAVE", "FSAV", "FREAD", "FSAVECLEAR", "FSAVCLR")
def _fast_save(_context: LineContext) -> None:
    # Bits 1 and 2 of I4904 are 0: this flash does not support it (p. 324).
    raise CardError(20)
