"""Motion programs and PLCs as a transaction: the old program, or the new one."""

from pmac_comp.machine.controller import programs
from pmac_comp.machine.controller.context import Context
from pmac_comp.machine.controller.link import Link
from pmac_comp.machine.controller.programs import Program, ProgramKind
from pmac_comp.machine.controller.settings import Settings
from pmac_comp.machine.controller.settings_upload import change_settings
from pmac_comp.machine.controller.transaction import UploadResult


def found_crc(link: Link, kind: ProgramKind, number: int) -> int:
    """Checksum of a program on the card, 0 for none or an empty one."""
    lines = programs.listing(link, kind, number)
    if not lines or not programs.canonical(lines):
        return 0
    return Program(kind, number, tuple(lines)).crc


def upload_program(link: Link, context: Context, program: Program) -> UploadResult:
    """Replace a motion program or PLC, with backup, read-back and journal.

    Raises
    ------
    MotorNotSafe
        A motion program runs; nothing was changed.
    CommandRefused, VerifyMismatch
        The old program was written back; if that failed the buffer is empty (DISABLED).
    """
    goal = Settings(programs={(program.kind, program.number): program.lines})
    return change_settings(link, context, goal, route="program")
