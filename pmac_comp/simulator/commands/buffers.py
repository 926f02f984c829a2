"""OPEN, CLEAR, CLOSE, LIST, DEFINE, DELETE, gathering and PLC switches.

Source: Turbo PMAC Software Reference Manual p. 296-324, 341-350, 378-392.
"""

from __future__ import annotations

import re

from pmac_comp.simulator.commands.line import LineContext, command
from pmac_comp.simulator.language.statements import MOTION, PLC
from pmac_comp.simulator.memory.errors import CardError
from pmac_comp.simulator.memory.user_memory import define_user_buffer
from pmac_comp.simulator.programs.programs import Program, listing
from pmac_comp.simulator.servo.compensation import TableKind

_KINDS = {"COMP": TableKind.COMP, "TCOMP": TableKind.TCOMP, "BLCOMP": TableKind.BLCOMP}
_GATHER_RANGE = re.compile(r"\s*(\d*)\s*(?:,\s*(\d+))?")


# --- program buffers -----------------------------------------------------------------------------


@command("OPENPROGRAM", "OPENPROG")
def _open_program(context: LineContext) -> None:
    number = context.scanner.need_integer(1, 32767)
    if context.card.any_program_runs():
        raise CardError(1)
    context.card.programs.open(MOTION, number, context.owner)
    context.card.programs_changed()


@command("OPENPLC")
def _open_plc(context: LineContext) -> None:
    number = context.scanner.need_integer(0, 31)
    context.card.programs.open(PLC, number, context.owner)
    context.card.plcs.opened(number)


@command("OPENROTARY", "OPENROT")
def _open_rotary(context: LineContext) -> None:
    context.card.rotary.open(context.owner)


@command("CLEARALLPLCS", "CLRALLPLCS")
def _clear_all_plcs(context: LineContext) -> None:
    context.card.programs.clear_all(plcs_only=True)
    context.card.programs_changed()


@command("CLEARALL", "CLRALL")
def _clear_all(context: LineContext) -> None:
    context.card.programs.clear_all()
    context.card.programs_changed()


@command("CLEAR", "CLR")
def _clear(context: LineContext) -> None:
    if context.card.rotary.is_open_on(context.owner):
        context.card.rotary.clear(context.modal.cs)
        return
    context.card.programs.clear(context.owner)


@command("CLOSEALL", "CLSALL")
def _close_all(context: LineContext) -> None:
    context.card.close(context.owner, force=True)


@command("CLOSE", "CLS")
def _close(context: LineContext) -> None:
    context.card.close(context.owner)


# --- listings ------------------------------------------------------------------------------------


@command("LISTPROGRAM", "LISTPROG", "LISPROGRAM", "LISPROG")
def _list_program(context: LineContext) -> None:
    program = context.card.programs.find(MOTION, context.scanner.need_integer(1, 32767))
    start = length = None
    if context.scanner.take(","):
        start = context.scanner.integer() or 0
        if context.scanner.take(","):
            length = context.scanner.integer()
    _answer_program(context, program, start, length)


@command("LISTPLC", "LISPLC")
def _list_plc(context: LineContext) -> None:
    number = context.scanner.need_integer(0, 31)
    program = context.card.programs.find(PLC, number)
    start = length = None
    if context.scanner.take(","):
        start = context.scanner.integer()
        if start is None:
            start = context.card.plcs.next_offset(number)
        if context.scanner.take(","):
            length = context.scanner.integer()
    _answer_program(context, program, start, length)


def _long(context: LineContext) -> bool:
    return bool(context.card.variables.int_i(9) & 1)


def _answer_program(
    context: LineContext, program: Program, start: int | None = None, length: int | None = None
) -> None:
    is_open = program is context.card.programs.open_program
    lines = listing(program, long=_long(context), is_open=is_open, start=start, length=length)
    _answer_listing(context, lines)


def _answer_listing(context: LineContext, lines: list[str]) -> None:
    for line in lines:
        context.answer(line)


@command("LISTPC", "LISPC")
def _list_counter(context: LineContext) -> None:
    _list_from_counter(context, executing=False)


@command("LISTPE", "LISPE")
def _list_executing(context: LineContext) -> None:
    _list_from_counter(context, executing=True)


def _list_from_counter(context: LineContext, *, executing: bool) -> None:
    count: int | None = 1
    if context.scanner.take(","):
        context.scanner.take(",")
        count = context.scanner.integer()
    number, offset = (executing and context.system.executing) or context.system.counter()
    program = context.card.programs.find(MOTION, number)
    lines = program.lines(long=_long(context))
    containing = max((at for at, _ in lines if at <= offset), default=0)
    lines = [(at, text) for at, text in lines if at >= containing]
    chosen = lines if count is None else lines[:count]
    for k, (at, text) in enumerate(chosen):
        context.answer(f"P{number}:{at}:{text}" if k == 0 else f"{at}:{text}")


@command("LISTGATHER", "LISTGAT", "LISGATHER", "LISGAT")
def _list_gather(context: LineContext) -> None:
    scanner = context.scanner
    match = _GATHER_RANGE.match(scanner.text, scanner.position)
    start, length = 0, None
    if match is not None:
        scanner.position = match.end()
        start = int(match.group(1) or 0)
        length = int(match.group(2)) if match.group(2) else None
    lines = context.card.gathering.list_lines(start, length)
    if lines is None:
        raise CardError(3)
    _answer_listing(context, lines)


@command("LIST", "LIS")
def _list(context: LineContext) -> None:
    scanner = context.scanner
    kind = scanner.take("BLCOMP", "TCOMP", "COMP")
    if kind is not None:
        _list_table(context, _KINDS[kind])
        return
    store = context.card.programs
    if scanner.peek().isalpha() or not store.is_open_on(context.owner):
        raise CardError(3)
    program = store.open_program
    if program is None:
        raise CardError(3)
    _answer_program(context, program)


def _list_table(context: LineContext, kind: TableKind) -> None:
    tables, motor = context.card.tables, context.modal.motor
    if context.scanner.take("DEF"):
        context.scanner.take("INE")
        text = tables.list_definition(kind, motor)
        if text is None:
            raise CardError(3)
        context.answer(text)
        return
    lines = tables.list_values(kind, motor)
    if lines is None:
        raise CardError(3)
    _answer_listing(context, lines)


# --- DEFINE and DELETE ---------------------------------------------------------------------------


@command("DEFINE", "DEF")
def _define(context: LineContext) -> None:
    scanner = context.scanner
    kind = scanner.take("BLCOMP", "TCOMP", "COMP")
    if kind is not None:
        _refuse_open_buffer(context)
        arguments = _take_arguments(context)
        context.check(context.card.tables.define(_KINDS[kind], context.modal.motor, arguments))
        return
    if scanner.take("GATHER", "GAT"):
        size = scanner.number()
        context.check(context.card.gathering.define(None if size is None else int(size)))
        return
    if scanner.take("ROTARY", "ROT"):
        context.card.rotary.define(context.modal.cs, scanner.need_integer(1, 100000))
        return
    if scanner.take("UBUFFER", "UBUF"):
        define_user_buffer(context.card.memory, scanner.need_integer(0, 0x30000))
        return
    raise CardError(3)


def _refuse_open_buffer(context: LineContext) -> None:
    if context.card.programs.is_open_on(context.owner):
        raise CardError(7)


def _take_arguments(context: LineContext) -> str:
    """What belongs to DEFINE: numbers, commas, points, # and D, up to a second number."""
    scanner = context.scanner
    scanner.skip_blanks()
    match = re.compile(r"\d+(?:\.\d+)?\s*(?:,\s*#\s*\d+\s*D?\s*|,\s*\d+\s*|,\s*(?=,))*").match(
        scanner.text, scanner.position
    )
    if match is None:
        raise CardError(3)
    scanner.position = match.end()
    return match.group()


@command("DELETE", "DEL")
def _delete(context: LineContext) -> None:
    scanner, card = context.scanner, context.card
    kind = scanner.take("BLCOMP", "TCOMP", "COMP")
    if kind is not None:
        context.check(card.tables.delete(_KINDS[kind], context.modal.motor))
    elif scanner.take("GATHER", "GAT"):
        context.check(card.gathering.delete())
    elif scanner.take("ROTARY", "ROT"):
        card.rotary.delete(context.modal.cs)
    elif scanner.take("ALLTEMPS", "ALLTEMP"):
        context.check(card.gathering.delete())
        card.rotary.delete_all()
    elif scanner.take("ALL"):
        context.check(card.gathering.delete())
        card.rotary.delete_all()
        card.tables.delete_all()
    elif scanner.take("LOOKAHEAD", "CCBUFFER", "CCBUF", "TBUF"):
        # None of these can exist here; deleting what is not there changes nothing.
        return
    else:
        raise CardError(3)


# --- gathering and PLC switches ------------------------------------------------------------------


@command("GATHER", "GAT")
def _gather(context: LineContext) -> None:
    on_trigger = context.scanner.take("TRIGGER", "TRIG") is not None
    context.check(context.card.gathering.start(on_trigger=on_trigger))


@command("ENDGATHER", "ENDG")
def _end_gather(context: LineContext) -> None:
    context.check(context.card.gathering.stop())


def _plc_command(long: str, short: str) -> None:
    @command(f"{long}PLC", f"{short}PLC")
    def handler(context: LineContext) -> None:
        for number in _numbers(context):
            context.card.plcs.switch(long, number)


@command("DISABLEPLCC", "DISPLCC")
def _disable_compiled(context: LineContext) -> None:
    # Compiled PLCs cannot exist here, so none runs after this; enabling one is refused.
    _numbers(context)


def _numbers(context: LineContext) -> list[int]:
    numbers: list[int] = []
    while True:
        first = context.scanner.need_integer(0, 31)
        last = context.scanner.need_integer(first, 31) if context.scanner.take("..") else first
        numbers.extend(range(first, last + 1))
        if not context.scanner.take(","):
            return numbers


for _long_name, _short_name in (
    ("ENABLE", "ENA"),
    ("DISABLE", "DIS"),
    ("PAUSE", "PAU"),
    ("RESUME", "RES"),
):
    _plc_command(_long_name, _short_name)
