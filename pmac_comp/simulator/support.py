"""What the simulated card supports, read from the tables that decide it.

Everything that is not in these lists is answered as a real card answers an unknown word (ERR003),
or, for requests of the packet port, by closing the connection.
"""

from __future__ import annotations

from pmac_comp.machine.wire.ethernet import NAMED_ONLY, RequestCode
from pmac_comp.simulator.ivariables import TABLE

_REFUSED_REQUESTS = (RequestCode.FWDOWNLOAD,)


def supported() -> dict[str, list[str]]:
    """Supported ``commands``, ``motion`` and ``plc`` words, ``requests`` and ``variables``."""
    import pmac_comp.simulator.card  # noqa: F401  registers the commands
    from pmac_comp.simulator.commands.line import KEYWORDS
    from pmac_comp.simulator.language.statements import MOTION, PLC, words_of

    return {
        "commands": sorted(KEYWORDS),
        "motion": words_of(MOTION),
        "plc": words_of(PLC),
        "requests": [c.name for c in RequestCode if c not in _REFUSED_REQUESTS],
        "variables": _ranges([n for n, v in sorted(TABLE.items()) if not v.fixed]),
    }


def refused() -> dict[str, list[str]]:
    """Names of what is refused: ``requests``; ``variables`` that keep their factory value."""
    return {
        "requests": [*(c.name for c in _REFUSED_REQUESTS), *NAMED_ONLY.values()],
        "variables": _ranges([n for n, v in sorted(TABLE.items()) if v.fixed]),
    }


def _ranges(numbers: list[int]) -> list[str]:
    """I-variable numbers as ``I5`` and ``I10..13``."""
    found: list[list[int]] = []
    for number in numbers:
        if found and number == found[-1][-1] + 1:
            found[-1][-1] = number
        else:
            found.append([number, number])
    return [f"I{a}" if a == b else f"I{a}..{b}" for a, b in found]
