"""The open servo's source for a block of P-variables; the controller takes compiled code only.

What lives here: moving the file of ``firmware_plc`` to the block of a bench file. What may not:
running it (``simulator``), whether it runs (``law_checks``).
"""

import re
from typing import Final

from pmac_comp.files.resources import firmware_path
from pmac_comp.machine.controller.contents.law_bank import BLOCK_SIZE, DEFAULT_FIRST, LawBlock

FILE: Final = "feedforward_servo.txt"
_TITLE: Final = f"; {FILE} - "  # of the file as it comes, for P7000-P7199
# The file reads the banks by computed number, so its block stands in bare numbers as well: this
# file has none that mean anything else, other people's may.
_OF_BLOCK: Final = re.compile(r"(?<![A-OQ-Z$\d.])(P?)(7[01]\d\d)(?![\d.])")


def is_as_it_comes(text: str) -> bool:
    """Whether a source is our file, which is written for P7000-P7199 and not moved yet."""
    return text.startswith(_TITLE)


def servo_for(text: str, block: LawBlock) -> str:
    """Our file for a block; a source of somebody else, or one that was moved, as it is."""
    if not is_as_it_comes(text):
        return text
    apart = block.first - DEFAULT_FIRST
    moved = _OF_BLOCK.sub(lambda found: f"{found[1]}{int(found[2]) + apart}", text)
    last = block.first + BLOCK_SIZE - 1
    return moved.replace(_TITLE, f"; {FILE} for P{block.first}-P{last} - ", 1)


def servo_source(block: LawBlock) -> str:
    """Source for the vendor's compiler, for a block."""
    return servo_for(firmware_path(FILE).read_text(encoding="utf-8"), block)
