"""Many questions or lines put into few requests, in their order.

What lives here: grouping only; nothing is sent here.
"""

import re
from collections.abc import Iterable, Iterator, Sequence

from pmac_comp.machine.wire import ethernet

BULK_LINE = 250
"""Longest line that bulk reads put together; the card's queue takes 255 characters."""
LONGEST_RUN = 512
"""Most values asked for in one line, so that its answer stays within some kilobytes."""
_VARIABLE = re.compile(r"([IPQM])(\d+)")


def merged_runs(questions: Iterable[str]) -> Iterator[tuple[str, int]]:
    """Questions with the number of lines each gives; runs of variables become ranges.

    ``P1 P2 P3`` is asked as ``P1..3``: the card reads one name instead of three.
    """
    kind, first, last = "", 0, 0
    for question in questions:
        match = _VARIABLE.fullmatch(question)
        number = int(match[2]) if match else 0
        if match and match[1] == kind and number == last + 1 and number - first < LONGEST_RUN:
            last = number
            continue
        if kind:
            yield _run(kind, first, last)
        kind, first, last = (match[1], number, number) if match else ("", 0, 0)
        if not match:
            yield question, 1
    if kind:
        yield _run(kind, first, last)


def _run(kind: str, first: int, last: int) -> tuple[str, int]:
    text = f"{kind}{first}" if first == last else f"{kind}{first}..{last}"
    return text, last - first + 1


def line_batches(questions: Iterable[tuple[str, int]]) -> Iterator[list[tuple[str, int]]]:
    """Questions grouped so that each group fits one line and one answer of moderate size."""
    batch: list[tuple[str, int]] = []
    size = answers = 0
    for question, count in questions:
        if batch and (size + len(question) > BULK_LINE or answers + count > LONGEST_RUN):
            yield batch
            batch, size, answers = [], 0, 0
        batch.append((question, count))
        size += len(question)
        answers += count
    if batch:
        yield batch


def buffer_batches(lines: Sequence[bytes], *, single: bool) -> Iterator[Sequence[bytes]]:
    """Lines grouped so that each group fits one WRITEBUFFER request (null bytes included)."""
    limit = 0 if single else ethernet.MAX_WRITE_BUFFER
    start = size = 0
    for index, line in enumerate(lines):
        if index > start and size + len(line) + 1 > limit:
            yield lines[start:index]
            start, size = index, 0
        size += len(line) + 1
    if start < len(lines):
        yield lines[start:]
