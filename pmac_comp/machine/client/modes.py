"""Communication modes: found whatever they are, set for the session, put back at its end.

I3, I4, I6 and I9 belong to the whole card, and other clients set them too. They are read before
anything is written: what cannot be read as a PMAC's answer is not a PMAC.
"""

import re
from dataclasses import dataclass

from pmac_comp.base.clock import Deadline
from pmac_comp.base.errors import ConnectFailed, LinkError
from pmac_comp.machine.client.link import Link
from pmac_comp.machine.wire.dialog import visible
from pmac_comp.machine.wire.replies import read_settled

_QUESTION = b"I3I4I6I9"
_NAMES = ("I3", "I4", "I6", "I9")
_TRIES = 2
# A bare acknowledgement or an error, in whatever mode; behind it the sum of the line with I4 = 1.
_IN_BUFFER = re.compile(rb"[\r\n]*(\x06|\x07([\r\n]*ERR003[\r\n]*)?).?", re.DOTALL)


@dataclass(frozen=True)
class Modes:
    """Values of I3, I4, I6 and I9."""

    i3: int = 2
    i4: int = 0
    i6: int = 1
    i9: int = 2

    @property
    def command(self) -> bytes:
        """The line that sets them."""
        return f"I3={self.i3}I4={self.i4}I6={self.i6}I9={self.i9}".encode()


def read_modes(data: bytes) -> Modes | None:
    """The modes told by the answer to ``I3I4I6I9``, which is itself written in these modes.

    Each way of reading it is tried; it holds if the answer names that very way.
    """
    for i3 in (2, 3, 1, 0):
        for i4 in (0, 1):
            reply = read_settled(data, i3=i3, i4=i4)
            values = _values(reply.lines) if reply is not None else None
            if values is not None and values[0] == i3 and values[1] & 1 == i4:
                return Modes(*values)
    return None


def _values(lines: tuple[str, ...]) -> tuple[int, int, int, int] | None:
    if len(lines) != len(_NAMES):
        return None
    texts = [
        line.removeprefix(f"{name}=").strip()  # I9 bit 0: the long form
        for name, line in zip(_NAMES, lines, strict=True)
    ]
    if not all(text.isdecimal() and int(text) <= 3 for text in texts):
        return None
    i3, i4, i6, i9 = (int(text) for text in texts)
    return i3, i4, i6, i9


def establish(link: Link, wanted: Modes, deadline: Deadline) -> Modes:
    """Set the modes of the session and give back those that were found.

    Raises
    ------
    ConnectFailed
        If what answers is not a PMAC. Nothing was written then.
    """
    found = _find_modes(link, deadline)
    if found != wanted:
        link.collect(wanted.command, deadline)
        now = _find_modes(link, deadline)
        if now != wanted:
            raise ConnectFailed(
                f"{link.transport.name}: the communication modes could not be set: {now}",
                hint="Another program may be setting I3, I4, I6 or I9. Close it and try again.",
            )
    return found


def _find_modes(link: Link, deadline: Deadline) -> Modes:
    """The modes as the card tells them; asked once more where what came cannot be read.

    What was under way when the line opened, or an answer to FLUSH that came after its time, can
    stand before the first answer. The question only reads, so that asking it anew harms nothing.
    A program that was cut on its way leaves its buffer open on this port, for which the question
    is program text: refused, or taken without an answer. CLOSE ends that, and nothing otherwise.
    """
    for _ in range(_TRIES):
        data = _collected(link, deadline)
        modes = read_modes(data)
        if modes is not None:
            return modes
        if _IN_BUFFER.fullmatch(data):
            link.collect(b"CLOSE", deadline)
            modes = read_modes(_collected(link, deadline))
            if modes is not None:
                return modes
    raise ConnectFailed(
        f"{link.transport.name} answered '{visible(data[:60])}', which no PMAC says",
        hint="Check address and port. Nothing was written.",
    )


def _collected(link: Link, deadline: Deadline) -> bytes:
    try:
        return link.collect(_QUESTION, deadline)
    except LinkError as error:
        raise ConnectFailed(
            f"{link.transport.name} is connected, but does not answer as a PMAC does",
            hint="Check the port: 1025 speaks packets; an ASCII port needs ?dialog=ascii.",
        ) from error


def restore(link: Link, found: Modes, current: Modes, deadline: Deadline) -> bool:
    """Put back the modes found at the start; False if the link no longer allows it."""
    if found == current:
        return True
    try:
        link.collect(found.command, deadline)
    except LinkError:
        return False
    return True
