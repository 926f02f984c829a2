"""What the simulated card supports and what it refuses, read from the tables that decide it.

Everything outside the supported lists is answered as a real card answers an unknown word (ERR003).
A request of the packet port that is not supported closes the connection: its length is not known,
so nothing behind it could be read; the server tells the reason. The same holds for a window that
reaches beyond the dual-ported RAM, whose end the manual gives and whose answer it does not.
"""

from __future__ import annotations

from typing import Final

from pmac_comp.machine.wire.ethernet import NAMED_ONLY, RequestCode
from pmac_comp.simulator.dialog import manual
from pmac_comp.simulator.memory.ivariables import TABLE

_REFUSED_REQUESTS = (RequestCode.FWDOWNLOAD,)
KEPT: Final = {
    "I2": "no control panel",
    "I7": "no commutation",
    "I37": "no wait states",
    "I40": "no watchdog",
    "I52..54": "no clock rates of processor and serial ports",
    "I59": "group of motors of old firmware; ## selects it",
    "I65": "tag of the user, no function on the card either",
    "Isx13": "moves are not cut into segments",
    "Ixx41": "band of the desired position limit, used in lookahead only",
    "Ixx66": "no PWM",
    "I7mn1, I7mn6..8": "no compare and output circuits",
}
"""Variables that keep what is written and report it, and why nothing depends on them."""
LIMITS: Final = (
    "Reading a captured position through an M-variable does not make ready for the next capture; "
    "homing, jogging until trigger and a frozen time base do.",
    "Sine encoders, resolvers and parallel inputs are what is written into their registers; the "
    "drive behind the card has an incremental encoder and an incremental scale.",
    "WX/WY/WL/WP reach every word; compiled PLCs and servo code that WP loads are kept, not run. "
    "The open servo is given as source (sim --servo).",
    "A program is calculated one move ahead and never late: run-time error 1 does not occur.",
)
"""What else differs from a card."""


def supported() -> dict[str, list[str]]:
    """Supported keywords, forms of the manual, requests and variables."""
    import pmac_comp.simulator.card.card  # noqa: F401  registers the commands
    from pmac_comp.simulator.commands.line import KEYWORDS
    from pmac_comp.simulator.language.keywords import words_of
    from pmac_comp.simulator.language.statements import MOTION, PLC

    return {
        "commands": sorted(KEYWORDS),
        "motion": words_of(MOTION),
        "plc": words_of(PLC),
        "command_forms": list(manual.ON_LINE),
        "motion_forms": list(manual.MOTION),
        "plc_forms": list(manual.PLC),
        "requests": [c.name for c in RequestCode if c not in _REFUSED_REQUESTS],
        "variables": _ranges([n for n, v in sorted(TABLE.items()) if not v.fixed]),
    }


def refused() -> dict[str, list[str]]:
    """What is refused: forms of the manual, ``requests``, ``variables`` that keep their value."""
    return {
        "command_forms": list(manual.ON_LINE_REFUSED),
        "motion_forms": list(manual.MOTION_REFUSED),
        "plc_forms": list(manual.PLC_REFUSED),
        "requests": [*(c.name for c in _REFUSED_REQUESTS), *NAMED_ONLY.values()],
        "variables": _ranges([n for n, v in sorted(TABLE.items()) if v.fixed]),
    }


def report() -> dict[str, object]:
    """Everything above as one document, for ``--json``."""
    return {
        "supported": supported(),
        "refused": refused(),
        "kept_without_effect": dict(KEPT),
        "differences": list(LIMITS),
    }


def report_lines() -> list[str]:
    """The same for a reader; one example stands for each form of the manual's summary."""
    yes, no = supported(), refused()
    lines = ["The simulated Turbo PMAC: what it supports, and what it refuses as a card refuses"]
    lines.append("an unknown word (ERR003; the packet port closes the connection).")
    for name, title in _TITLES.items():
        lines += ["", f"{title}, supported:", *_wrapped(yes[name])]
        lines += [f"{title}, refused:", *_wrapped(no[name])]
    lines += ["", "Kept and reported, but nothing depends on them:"]
    lines += [f"  {name}: {why}" for name, why in KEPT.items()]
    lines += ["", "Other differences from a card:", *(f"  {text}" for text in LIMITS)]
    return lines


_TITLES = {
    "command_forms": "On-line commands",
    "motion_forms": "Motion program statements",
    "plc_forms": "PLC statements",
    "requests": "Requests of the packet port",
    "variables": "I-variables",
}
_WIDTH = 98


def _wrapped(words: list[str]) -> list[str]:
    """Words in lines of `_WIDTH` characters, two blanks between them."""
    lines = [" "]
    for word in words:
        if len(lines[-1]) + len(word) + 2 > _WIDTH:
            lines.append(" ")
        lines[-1] += f" {word} "
    return [line.rstrip() for line in lines]


def _ranges(numbers: list[int]) -> list[str]:
    """I-variable numbers as ``I5`` and ``I10..13``."""
    found: list[list[int]] = []
    for number in numbers:
        if found and number == found[-1][-1] + 1:
            found[-1][-1] = number
        else:
            found.append([number, number])
    return [f"I{a}" if a == b else f"I{a}..{b}" for a, b in found]
