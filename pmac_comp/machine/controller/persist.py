"""SAVE, on demand only, with all motors killed, and everything read again afterwards."""

from typing import Final

from pmac_comp.base.errors import MotorNotSafe
from pmac_comp.machine.controller.link import Link
from pmac_comp.machine.controller.motors import read_motors
from pmac_comp.machine.wire.numbers import read_number

SAVE_TIMEOUT_s: Final = 15.0


def save(link: Link) -> None:
    """SAVE with all motors killed; the answer takes seconds and may be a NUL over Ethernet.

    Raises
    ------
    MotorNotSafe
        A motor is enabled: nothing else runs during SAVE, not even limit checks (p. 394).
    """
    active = [k + 1 for k, v in enumerate(link.query("I100,32,100")) if int(read_number(v))]
    alive = [m for m, r in read_motors(link, active).items() if not r.status.is_killed]
    if alive:
        raise MotorNotSafe(
            f"SAVE needs all motors killed; enabled: {', '.join(f'#{m}' for m in alive)}.",
            code="PC-UPL-010",
        )
    link.command("SAVE", timeout_s=SAVE_TIMEOUT_s)
