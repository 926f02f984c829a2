"""SAVE, on demand only, with all motors killed, and everything read again afterwards."""

from dataclasses import dataclass
from typing import Final

from pmac_comp.base.errors import (
    ControllerState,
    FlashSuspect,
    MotorNotSafe,
    VerifyMismatch,
)
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.journals import ChangeKind
from pmac_comp.machine.controller.change.transaction import Change
from pmac_comp.machine.controller.contents.law_bank import LawBlock
from pmac_comp.machine.controller.contents.settings import Buffer, Settings, read_settings
from pmac_comp.machine.controller.contents.table_set import read_tables
from pmac_comp.machine.controller.law.law_goal import LAW
from pmac_comp.machine.controller.law.law_state import read_bank, read_law_head
from pmac_comp.machine.controller.motors.motors import read_motors
from pmac_comp.machine.controller.settings.guard_install import GUARD
from pmac_comp.machine.controller.tables.table_status import FLASH_FAULTS
from pmac_comp.machine.wire.numbers import read_number

SAVE_TIMEOUT_s: Final = 15.0


@dataclass(frozen=True)
class Saved:
    """What of ours is in memory, as checksums.

    Parameters
    ----------
    tables, law, programs : int
        CRC-32 of all tables, of the bank in use and of the programs; 0 for none.
    enabled : int
        I51.
    """

    tables: int
    law: int
    programs: int
    enabled: int


def read_saved(link: Link, block: LawBlock, buffers: tuple[Buffer, ...] = ()) -> Saved:
    """Checksums of what a SAVE takes into the flash; law and guard PLC always count."""
    head = read_law_head(link, block)
    law = read_bank(link, block, head.bank)
    wanted = Settings(programs=dict.fromkeys((LAW, GUARD, *buffers), ()))
    return Saved(
        tables=read_tables(link).crc,
        law=0 if law is None else law.digest,
        programs=read_settings(link, wanted).crc,
        enabled=int(read_number(link.query("I51")[0])),
    )


def persist(link: Link, context: Context, buffers: tuple[Buffer, ...] = ()) -> Saved:
    """SAVE everything and see that it is still there and that the flash reports no error.

    It takes its place among the writers as an upload does: the flash would keep what somebody else
    has half-written. Only a reset proves what the flash holds; that is left to a person.

    Parameters
    ----------
    link, context
        Conversation, folder and block.
    buffers : tuple of (ProgramKind, int), optional
        Programs to compare besides the law and the guard.

    Raises
    ------
    SafetyRefusal
        A change of this folder was interrupted, or a motor is enabled; nothing was saved.
    LeaseHeld, ForeignChange
        Somebody else changes the controller; if that began while it saved, the error says so.
    VerifyMismatch
        Something else stands in memory after SAVE.
    FlashSuspect
        The card reports a flash or checksum error.
    """
    with Change(link, context, ChangeKind.SAVE) as change, change.explained():
        change.begin()
        before = read_saved(link, context.block, buffers)
        _require_killed(link)
        # The answer takes seconds, and may be a NUL over Ethernet.
        change.do_without_lease("SAVE", timeout_s=SAVE_TIMEOUT_s)
        if int(link.query("???")[0].strip()[:6], 16) & FLASH_FAULTS:
            raise FlashSuspect(
                "The controller reports a flash error after SAVE.",
                code="PC-UPL-015",
                hint="Save again; if it stays, the flash is worn: keep a backup at hand.",
            )
        after = read_saved(link, context.block, buffers)
        if before != after:
            raise VerifyMismatch(
                f"After SAVE the controller holds something else: {after} instead of {before}.",
                code="PC-UPL-009",
                hint="Find out who writes to this controller, upload again and save again.",
            )
        change.finish(ControllerState.NEW)
    return after


def _require_killed(link: Link) -> None:
    """Refuse SAVE while a motor is enabled: nothing else runs then, not even limit checks (p. 394).

    Raises
    ------
    MotorNotSafe
        One is.
    """
    active = [k + 1 for k, v in enumerate(link.query("I100,32,100")) if int(read_number(v))]
    alive = [m for m, r in read_motors(link, active).items() if not r.status.is_killed]
    if alive:
        raise MotorNotSafe(
            f"SAVE needs all motors killed; enabled: {', '.join(f'#{m}' for m in alive)}.",
            code="PC-UPL-010",
            hint="Kill them (`pmac-comp terminal URL -c '#1K'`) and run the command again.",
        )
