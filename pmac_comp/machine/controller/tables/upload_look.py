"""Doing something to a controller and looking, in the same line, at what stands and who moves."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.motors.motors import (
    MotorReading,
    Rest,
    Standstill,
    look_again,
    parse_readings,
    reading_text,
)
from pmac_comp.machine.controller.tables.table_status import HEAD_LINES, Head, head_text, parse_head

LONGEST_LINE: Final = 250


@dataclass(frozen=True)
class Found:
    """What stood on the controller after something was done, and how motors were since.

    Parameters
    ----------
    head : Head
        Read after it was done.
    rest : Rest or None
        What the looks at the motors say; None without motors.
    behind : list of str
        Answer to the question put last.
    """

    head: Head
    rest: Rest | None
    behind: list[str]

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why motors are not at rest."""
        return () if self.rest is None else self.rest.reasons


def do_and_look(
    link: Link,
    context: Context,
    lines: Sequence[str],
    motors: Sequence[int],
    looks: Sequence[Standstill | None],
    *,
    spacing_s: float,
    behind: str = "",
) -> Found:
    """Do something, read the head and see that motors stood from an earlier look to now.

    One line holds all of it for a few motors.

    Parameters
    ----------
    link, context
        Conversation and block.
    lines : sequence of str
        Commands, sent once.
    motors : sequence of int
        Motors that have to stand.
    looks : sequence of Standstill or None
        Earlier looks at them.
    spacing_s : float
        Least time in s over which they are watched.
    behind : str
        A question put last.
    """
    question = head_text(context) + reading_text(motors) + behind
    whole = f"{' '.join(lines)} {question}"
    if not motors or len(whole) > LONGEST_LINE:
        return _do_then_look(link, context, lines, motors, looks, spacing_s, behind)
    answers: list[list[str]] = []
    n = HEAD_LINES + 4 * len(motors)

    def read(link: Link, motors: Sequence[int]) -> dict[int, MotorReading]:
        # A look after this one only looks.
        answers.append(link.query(question) if answers else link.command(whole))
        return parse_readings(motors, answers[-1][HEAD_LINES:n])

    rest = look_again(link, motors, *looks, spacing_s=spacing_s, reader=read)
    return Found(parse_head(answers[-1][:HEAD_LINES]), rest, answers[-1][n:])


def _do_then_look(
    link: Link,
    context: Context,
    lines: Sequence[str],
    motors: Sequence[int],
    looks: Sequence[Standstill | None],
    spacing_s: float,
    behind: str,
) -> Found:
    link.write_buffer(lines)
    rest = look_again(link, motors, *looks, spacing_s=spacing_s) if motors else None
    answer = link.query(head_text(context) + behind)
    return Found(parse_head(answer[:HEAD_LINES]), rest, answer[HEAD_LINES:])
