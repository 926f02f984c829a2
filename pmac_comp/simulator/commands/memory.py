"""Direct access to memory. Source: Software Reference Manual p. 391-392, 403."""

from __future__ import annotations

from pmac_comp.simulator.commands.line import LineContext, command
from pmac_comp.simulator.memory.errors import CardError
from pmac_comp.simulator.memory.memory import (
    LONG_MASK,
    WORDS,
    read_long,
    read_word_signed,
    write_long,
)

_MOST_PER_LINE = 16


def _address(context: LineContext) -> int:
    context.scanner.take(":")
    return context.scanner.need_integer(0, 0xFFFFFF)


def _reader(space: str, *, as_hex: bool) -> None:
    keyword = ("RH" if as_hex else "R") + space

    @command(keyword)
    def handler(context: LineContext) -> None:
        address = _address(context)
        count, per_line = 1, _MOST_PER_LINE
        if context.scanner.take(","):
            count = context.scanner.need_integer(1, 65535)
            if context.scanner.take(","):
                per_line = context.scanner.need_integer(1, _MOST_PER_LINE)
        texts = [_text(context, space, address + k, as_hex=as_hex) for k in range(count)]
        for start in range(0, count, per_line):
            context.answer(" ".join(texts[start : start + per_line]))


def _text(context: LineContext, space: str, address: int, *, as_hex: bool) -> str:
    memory = context.card.memory
    cell = address & (WORDS - 1)
    if space == "L":
        if as_hex:
            return f"{int(memory.x[cell]):06X}{int(memory.y[cell]):06X}"
        return str(int(read_long(memory.x, memory.y, cell)))
    if space == "P":
        word = memory.program.get(address, 0)
        return f"{word:06X}" if as_hex else str(word - 0x1000000 if word >= 0x800000 else word)
    words = memory.x if space == "X" else memory.y
    return f"{int(words[cell]):06X}" if as_hex else str(int(read_word_signed(words, cell)))


def _writer(space: str) -> None:
    @command(f"W{space}")
    def handler(context: LineContext) -> None:
        memory = context.card.memory
        address = _address(context)
        if not context.scanner.take(","):
            raise CardError(3)
        while True:
            value = context.scanner.signed_number()
            if value is None:
                raise CardError(3)
            cell = address & (WORDS - 1)
            if space == "L":
                write_long(memory.x, memory.y, cell, int(value) & LONG_MASK)
            elif space == "P":
                memory.program[address] = int(value) & 0xFFFFFF
            else:
                (memory.x if space == "X" else memory.y)[cell] = int(value) & 0xFFFFFF
            address += 1
            if not context.scanner.take(","):
                break
        memory.touch()


for _space in "XYLP":
    _reader(_space, as_hex=False)
    _reader(_space, as_hex=True)
    _writer(_space)
