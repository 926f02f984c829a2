"""Motion programs and PLCs as a transaction: the old program, or the new one."""

from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.transaction import UploadResult
from pmac_comp.machine.controller.contents.programs import Program
from pmac_comp.machine.controller.contents.settings import Settings
from pmac_comp.machine.controller.settings.settings_upload import change_settings


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
