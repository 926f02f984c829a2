"""Where and within which limits a change of a controller is made."""

import os
import socket
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from pmac_comp.base.progress import Steps
from pmac_comp.machine.controller.contents.law_bank import LawBlock
from pmac_comp.machine.controller.contents.safety import Limits

"""Called with a step, lines done and lines in all."""


UNKNOWN = (-1, 1)
"""Lines done and in all of a step of which nobody knows how far it came."""


def _no_progress(step: str, done: int, total: int) -> None:
    del step, done, total


def never() -> bool:
    """Nobody asks for an end."""
    return False


@dataclass(frozen=True)
class Context:
    """Where and within which limits a change is made.

    Parameters
    ----------
    block : LawBlock
        P-variables we may use.
    limits : Limits
        Limits in counts.
    store : Path
        Folder of journals and backups; one per bench.
    servo_period_s : float
        For the watch after enabling.
    controller : str
        Name of the controller for files of the folder (``alike``).
    alike : str
        Name that cards which answer alike share, for the lock; empty where no other name is used.
    progress : callable
        Told of every step and packet.
    stop_requested : callable
        Asked between packets; True ends the change at the next safe place.
    group : int
        Number of the upload of several parts that this change is one of, 0 for none.
    number_before : int
        Number of the last change that stood on the controller as that upload began.
    settling : bool
        Whether an interrupted or unwanted change is being settled: what is left open then is what
        it is about, and no reason to refuse.
    """

    block: LawBlock
    limits: Limits
    store: Path
    servo_period_s: float
    controller: str = "controller"
    alike: str = ""
    progress: Steps = _no_progress
    stop_requested: Callable[[], bool] = never
    group: int = 0
    number_before: int = 0
    settling: bool = False

    @cached_property
    def owner(self) -> int:
        """Number that stands for this host and folder in the lease, never 0."""
        text = f"{socket.gethostname()}:{self.store.resolve()}"
        # The bytes of the name: where the locale knows no umlauts, a folder may still have them.
        return (zlib.crc32(os.fsencode(text)) & 0x7FFFFFFF) or 1
