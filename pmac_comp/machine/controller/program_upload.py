"""Motion programs and PLCs as a transaction: the old program, the new one, or none that runs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from pmac_comp.base.errors import (
    CommandRefused,
    ConfigError,
    ControllerState,
    LinkError,
    MotorNotSafe,
    PmacCompError,
    ProtocolError,
    VerifyMismatch,
)
from pmac_comp.machine.controller import programs
from pmac_comp.machine.controller.link import Link
from pmac_comp.machine.controller.programs import Program, ProgramKind
from pmac_comp.machine.controller.transaction import (
    Context,
    UploadResult,
    host_lock,
    mark_left,
    new_transaction_id,
    open_journal,
    read_sealed_json,
    write_sealed_json,
)

RUNNING_PROGRAM: Final = 1 << 0  # first word of ??, bit 0 (p. 287)


@dataclass(frozen=True)
class ProgramDecision:
    """What a program buffer holds: a pure function of three checksums."""

    state: ControllerState
    reason: str


def decide_program(crc_found: int, crc_old: int, crc_new: int) -> ProgramDecision:
    """State of a program buffer; checksum 0 stands for an empty buffer."""
    if crc_found == crc_new:
        return ProgramDecision(ControllerState.NEW, "the new program stands whole")
    if crc_found == crc_old:
        return ProgramDecision(ControllerState.OLD, "the old program stands whole")
    return ProgramDecision(ControllerState.DISABLED, "the program is incomplete and must not run")


def found_crc(link: Link, kind: ProgramKind, number: int) -> int:
    """Checksum of a program on the card, 0 for none or an empty one."""
    lines = programs.listing(link, kind, number)
    if not lines or not programs.canonical(lines):
        return 0
    return Program(kind, number, tuple(lines)).crc


def upload_program(link: Link, context: Context, program: Program) -> UploadResult:
    """Replace a motion program (or PLC other than 0 and 1), with backup and read-back.

    Raises
    ------
    MotorNotSafe
        A motion program runs; nothing was changed.
    CommandRefused, VerifyMismatch
        The buffer was emptied again, so that nothing half-written can run.
    """
    with host_lock(context):
        _refuse_running(link)
        old_lines = programs.listing(link, program.kind, program.number) or []
        crc_old = found_crc(link, program.kind, program.number)
        transaction = new_transaction_id()
        journal = open_journal(context, transaction)
        backup = context.store / f"{context.controller}-{transaction:010d}.program.json"
        write_sealed_json(
            backup,
            {
                "kind": "program",
                "buffer": program.kind.value,
                "number": program.number,
                "lines": list(programs.canonical(old_lines)),
            },
        )
        journal.write(
            "write program",
            {"name": program.name, "crc_old": crc_old, "crc_new": program.crc},
        )
        try:
            programs.download(link, program)
        except (CommandRefused, VerifyMismatch) as error:
            _empty(link, program, error)
            raise
        except (LinkError, ProtocolError) as error:
            mark_left(error, ControllerState.DISABLED, confirmed=False)
            raise
        journal.write("done", {"verdict": "NEW"})
    return UploadResult(
        ControllerState.NEW, "program", crc_old, program.crc, 0.0, backup, journal.path
    )


def _empty(link: Link, program: Program, error: PmacCompError) -> None:
    try:
        programs.delete(link, program.kind, program.number)
        mark_left(error, ControllerState.DISABLED, confirmed=True)
    except PmacCompError as second:
        error.add_note(f"The buffer could not be emptied: {second.message}")
        mark_left(error, ControllerState.DISABLED, confirmed=False)


def _refuse_running(link: Link) -> None:
    words = link.query("".join(f"&{n}??" for n in range(1, 5)))
    busy = [n for n, w in enumerate(words, start=1) if int(w.strip()[:6], 16) & RUNNING_PROGRAM]
    if busy:
        raise MotorNotSafe(
            f"A motion program runs in coordinate system {busy[0]}.",
            code="PC-PRG-020",
            hint="Abort it or wait for its end.",
            left=ControllerState.OLD,
        )


def rollback_program(link: Link, context: Context, backup: Path) -> UploadResult:
    """Put the program of a backup back; an empty backup empties the buffer."""
    data = read_sealed_json(backup)
    lines = data.get("lines")
    if data.get("kind") != "program" or not isinstance(lines, list):
        raise ConfigError(f"{backup} is no backup of a program.", code="PC-PRG-021")
    kind, number = ProgramKind(str(data["buffer"])), int(str(data["number"]))
    if not lines:
        before = found_crc(link, kind, number)
        programs.delete(link, kind, number)
        return UploadResult(ControllerState.OLD, "program", before, 0)
    result = upload_program(link, context, Program(kind, number, tuple(map(str, lines))))
    return UploadResult(
        ControllerState.OLD, "program", result.crc_old, result.crc_new, 0.0, result.backup
    )
