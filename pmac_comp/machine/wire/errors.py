"""Error numbers of the controller's command interpreter and what they mean.

Source: Turbo PMAC Software Reference Manual, I6 (p. 40) and pp. 324, 394.
"""

ERROR_MEANINGS = {
    1: "command not allowed while a program is executing",
    2: "password error",
    3: "data error or unrecognised command",
    4: "illegal character, or a serial parity or framing error",
    5: "command only allowed with a buffer open",
    6: "no room in the buffer",
    7: "buffer already in use",
    8: "MACRO auxiliary communication error",
    9: "program structure error",
    10: "both overtravel limits are set for a motor of the coordinate system",
    11: "previous move not completed",
    12: "a motor of the coordinate system is open loop",
    13: "a motor of the coordinate system is not activated",
    14: "no motors in the coordinate system",
    15: "not pointing to a valid program buffer, or a motion buffer is open",
    16: "running an improperly structured program",
    17: "resuming with motors out of the stopped position",
    18: "phase reference during a move, move during a phase reference, or phase clock error",
    19: "position change while moves are stored in the buffer",
    20: "the flash circuit does not support FSAVE",
    21: "FSAVE while a flash sector is being cleared",
    22: "bad flash sector",
}


def error_meaning(number: int) -> str:
    """What error ``number`` means, in words."""
    return ERROR_MEANINGS.get(number, "error number without a published meaning")


def error_text(number: int) -> str:
    """The text the controller sends for an error, e.g. ``ERR003``."""
    return f"ERR{number:03d}"
