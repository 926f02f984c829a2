"""Faults that a test may command, off unless the card was made for it.

The command ``FAULT"..."`` does not exist on a real card; without ``--faults`` it is refused as any
unknown word is. Link faults spoil the next answer of any conversation, whoever asked for it.

=====================  ======================================================================
``AMPLIFIER n``        amplifier fault of motor n, with the group action of Ixx24
``POWER``              power fails and comes back: everything as after ``$$$``
``FLASH``              one bit of the flash image turns over
``FLAG word``          sets bits of the global status word 1 (``$`` hexadecimal), e.g. a RAM error
``ENCODER``            the encoder is lost: its counter stands still
``SCALE``              the scale is stuck: it keeps its value
``NOISE um``           the scale is noisy: standard deviation in um, the same noise in every run
``LIMIT side``         the end switch of a side (1 or -1) is on whatever the table does
``HEAL``               encoder, scale and switches are sound again
``DELAY ms``           from now on every answer of the served ports comes so many ms late
``SILENT n``           the next n answers are a single null byte, as of a busy card
``CUT n``              the next answer stops after n bytes
``GARBLE n``           byte n of the next answer has a bit turned over
``DROP``               the next answer is not given, the connection is closed
``CLEAR``              forget link faults that wait
=====================  ======================================================================
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from pmac_comp.base.units import MS_PER_S, UM_PER_M
from pmac_comp.simulator.memory import registers as r
from pmac_comp.simulator.memory.errors import CardError
from pmac_comp.simulator.servo import sensors

if TYPE_CHECKING:
    from pmac_comp.simulator.card.card import Card


LONGEST_DELAY_ms: Final = 60_000.0
LARGEST_NOISE_um: Final = 1000.0
_FAULT_PLACES = (
    sensors.W_ENCODER_LOST,
    sensors.W_SCALE_STUCK,
    sensors.W_SCALE_NOISE,
    sensors.W_FORCED_FLAGS,
)


class ConnectionDropped(Exception):
    """A commanded fault closes the connection."""


@dataclass
class LinkFaults:
    """Link faults that wait for the next answer."""

    silent: int = 0
    cut: int | None = None
    garble: int | None = None
    drop: bool = False
    delay_s: float = 0.0

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
    kind, value = words[0], _number(words)
    number = int(value)
    if _sensor_fault(card, kind, value):
        return
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
    elif kind == "DELAY" and 0.0 <= value <= LONGEST_DELAY_ms:
        card.link_faults.delay_s = value / MS_PER_S
    elif kind in ("SILENT", "CUT", "GARBLE", "DROP"):
        _arm(card.link_faults, kind, number)
    else:
        raise CardError(3, f"no fault '{text}'")


def _sensor_fault(card: Card, kind: str, value: float) -> bool:
    """Carry out a fault of encoder, scale or switches; False if it is none of them."""
    world = card.servo.world
    if kind == "ENCODER":
        world[sensors.W_ENCODER_LOST] = 1.0
    elif kind == "SCALE":
        world[sensors.W_SCALE_STUCK] = 1.0
    elif kind == "NOISE" and 0.0 <= value <= LARGEST_NOISE_um:
        world[sensors.W_SCALE_NOISE] = value / UM_PER_M
    elif kind == "LIMIT" and value in (1.0, -1.0):
        flag = sensors.POSITIVE_FLAG if value > 0.0 else sensors.NEGATIVE_FLAG
        world[sensors.W_FORCED_FLAGS] = float(int(world[sensors.W_FORCED_FLAGS]) | flag)
    elif kind == "HEAL":
        for place in _FAULT_PLACES:
            world[place] = 0.0
    else:
        return False
    return True


def _arm(faults: LinkFaults, kind: str, number: int) -> None:
    if kind == "SILENT":
        faults.silent = number
    elif kind == "CUT":
        faults.cut = number
    elif kind == "GARBLE":
        faults.garble = number
    else:
        faults.drop = True


def _number(words: list[str]) -> float:
    if len(words) < 2:
        return 0.0
    text = words[1]
    try:
        value = float(int(text[1:], 16)) if text.startswith("$") else float(text)
    except ValueError as error:
        raise CardError(3) from error
    if not math.isfinite(value):
        raise CardError(3)
    return value
