"""What makes the card answer BEL and an error number."""

from __future__ import annotations

from typing import Final

ERR_ORDER: Final = 3  # not in this form, or not now
ERR_MEMORY: Final = 6  # what it would need is taken


class CardError(Exception):
    """A command line is refused with ERRnnn (Software Reference Manual p. 40).

    Parameters
    ----------
    code : int
        Number nnn.
    reason : str
        For the server's log; the card itself only says the number.
    """

    def __init__(self, code: int, reason: str = "") -> None:
        super().__init__(reason or f"ERR{code:03d}")
        self.code = code
        self.reason = reason
