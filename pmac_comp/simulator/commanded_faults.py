"""Faults that a test may command, off unless the card was made for it.

The command ``FAULT"..."`` does not exist on a real card; without ``--faults`` it is refused as any
unknown word is. Link faults spoil the next answer of any conversation, whoever asked for it.

=====================  ======================================================================
``AMPLIFIER n``        amplifier fault of motor n, with the group action of Ixx24
``POWER``              power fails and comes back: everything as after ``$$$``
``FLASH``              one bit of the flash image turns over
``FLAG word``          sets bits of the global status word 1 (``$`` hexadecimal), e.g. a RAM error
``SILENT n``           the next n answers are a single null byte, as of a busy card
``CUT n``              the next answer stops after n bytes
``GARBLE n``           byte n of the next answer has a bit turned over
``DROP``               the next answer is not given, the connection is closed
``CLEAR``              forget link faults that wait
=====================  ======================================================================
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from pmac_comp.simulator import registers as r
from pmac_comp.simulator.errors import CardError

if TYPE_CHECKING:
    from pmac_comp.simulator.card import Card


class ConnectionDropped(Exception):
    """A commanded fault closes the connection."""


@dataclass
class LinkFaults:
    """Link faults that wait for the next answer."""

    silent: int = 0
    cut: int | None = None
    garble: int | None = None
    drop: bool = False

    def spoil(self, answer: bytes) -> bytes:
        """Answer as it goes out; ConnectionDropped if it does not."""
        if not answer:
            return answer
        if self.drop:
            self.drop = False
            raise ConnectionDropped("commanded fault")
        if self.silent:
            self.silent -= 1
            return b"\x00"
        if self.cut is not None:
            answer, self.cut = answer[: self.cut], None
        if self.garble is not None:
            place, self.garble = min(self.garble, len(answer) - 1), None
            if place >= 0:
                answer = answer[:place] + bytes([answer[place] ^ 0x10]) + answer[place + 1 :]
        return answer


def command_fault(card: Card, text: str) -> None:
    """Carry out ``FAULT"text"``; ERR003 for what is not in the list above."""
    words = text.upper().split()
    if not words:
        raise CardError(3)
    kind, number = words[0], _number(words)
    if kind == "AMPLIFIER" and 1 <= number <= r.MOTORS:
        card.servo.amplifier_fault(number)
    elif kind == "POWER":
        card.reset()
    elif kind == "FLASH":
        card.flash.spoil()
    elif kind == "FLAG":
        card.memory.x[r.GLOBAL_STATUS] |= number & 0xFFFFFF
    elif kind == "CLEAR":
        card.link_faults = LinkFaults()
    elif kind in ("SILENT", "CUT", "GARBLE", "DROP"):
        _arm(card.link_faults, kind, number)
    else:
        raise CardError(3, f"no fault '{text}'")


def _arm(faults: LinkFaults, kind: str, number: int) -> None:
    if kind == "SILENT":
        faults.silent = number
    elif kind == "CUT":
        faults.cut = number
    elif kind == "GARBLE":
        faults.garble = number
    else:
        faults.drop = True


def _number(words: list[str]) -> int:
    if len(words) < 2:
        return 0
    text = words[1]
    try:
        return int(text[1:], 16) if text.startswith("$") else int(text)
    except ValueError as error:
        raise CardError(3) from error
