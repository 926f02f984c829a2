"""What the controller says of the law: which form runs, which bank, how far armed."""

from dataclasses import dataclass
from enum import Enum
from typing import Final

from pmac_comp.base.errors import SafetyRefusal, VerifyMismatch
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.variables import answers, read_one
from pmac_comp.machine.controller.change.card_time import CardDeadline
from pmac_comp.machine.controller.contents.law_bank import (
    BANK_VALUES,
    SIGNATURE_PLC,
    SIGNATURE_SERVO,
    Index,
    LawBlock,
    LawParameters,
    WorkIndex,
)
from pmac_comp.machine.wire.numbers import read_number

SIGN_OF_LIFE_CYCLES: Final = 400
GAIN_TOLERANCE: Final = 1e-6
_HEAD_LINES: Final = 10 + 14 + 14 + 4  # answers to the question for a head


class LawForm(Enum):
    """Which algorithm evaluates the law, valued by its signature."""

    NONE = 0
    PLC = SIGNATURE_PLC
    SERVO = SIGNATURE_SERVO


@dataclass(frozen=True)
class LawHead:
    """Head and working variables of the block.

    Parameters
    ----------
    signature : int
        Written by the running algorithm; may be stale.
    bank : int
        Index of the bank in use.
    target, gain : float
        Gain wanted and present.
    clamp_ct : float
        Amplitude limit in counts.
    heartbeat : float
        Servo cycles left, -1 off.
    slew : float
        Gain change per servo cycle.
    motor : int
        Motor of the law.
    correction_ct, torque_dac : float
        Present outputs of the form that runs.
    n_clamped : int
        Passes in which the clamp acted.
    bank_in_use : int or None
        What the algorithm says it uses; None while the loop is open.
    position_ct, friction_state, flank_state, bed_state : float
        r, s, g and b of the law as the algorithm has them now.
    """

    signature: int
    bank: int
    target: float
    gain: float
    clamp_ct: float
    heartbeat: float
    slew: float
    motor: int
    correction_ct: float
    torque_dac: float
    n_clamped: int
    bank_in_use: int | None
    position_ct: float
    friction_state: float
    flank_state: float = 0.0
    bed_state: float = 0.0

    @property
    def form(self) -> LawForm:
        """Algorithm that wrote the signature last."""
        known = {form.value for form in LawForm}
        return LawForm(self.signature) if self.signature in known else LawForm.NONE

    @property
    def is_armed(self) -> bool:
        """Whether the gain is or goes up."""
        return self.target != 0.0 or abs(self.gain) > GAIN_TOLERANCE


def read_law_head(link: Link, block: LawBlock) -> LawHead:
    """Head and outputs in one question."""
    first, work = block.p(0), block.p(Index.WORK_PLC)
    servo, bed = block.p(Index.WORK_SERVO), block.p(Index.BED_SERVO)
    more = (Index.IN_USE_PLC, Index.CORRECTION_PLC, Index.TORQUE_PLC)
    of_plc = "".join(f"P{block.p(offset)}" for offset in more)
    lines = answers(
        link,
        f"P{first}..{first + 9}P{work}..{work + 13}P{servo}..{servo + 13}{of_plc}P{bed}",
        _HEAD_LINES,
    )
    values = [float(read_number(v)) for v in lines]
    head, plc, own = values[:10], values[10:24], values[24:38]
    in_use, correction_ct, torque_dac, bed_ct = values[38:]
    in_servo = int(head[0]) == SIGNATURE_SERVO
    running = own if in_servo else plc
    forms = {SIGNATURE_SERVO: int(own[WorkIndex.LIVE]), SIGNATURE_PLC: int(in_use) + 1}
    live = forms.get(int(head[Index.SIGNATURE]), 0)
    return LawHead(
        signature=int(head[Index.SIGNATURE]),
        bank=int(head[Index.BANK]),
        target=head[Index.TARGET],
        gain=head[Index.GAIN],
        clamp_ct=head[Index.CLAMP],
        heartbeat=head[Index.HEARTBEAT],
        slew=head[Index.SLEW],
        motor=int(head[Index.MOTOR]),
        correction_ct=own[WorkIndex.CORRECTION] if in_servo else head[Index.GAIN] * correction_ct,
        torque_dac=own[WorkIndex.TORQUE] if in_servo else head[Index.GAIN] * torque_dac,
        n_clamped=int(running[WorkIndex.CLAMPED]),
        bank_in_use=live - 1 if live > 0 else None,
        position_ct=running[WorkIndex.POSITION],
        friction_state=running[WorkIndex.STATE],
        flank_state=running[WorkIndex.FLANK],
        bed_state=bed_ct if in_servo else own[Index.BED_PLC - Index.WORK_SERVO],
    )


def read_bank(link: Link, block: LawBlock, bank: int) -> LawParameters | None:
    """Parameters of a sealed bank, None if it is not sealed or its checksum does not fit."""
    try:
        return LawParameters.from_values(read_bank_values(link, block, bank))
    except VerifyMismatch:
        return None


def read_bank_values(link: Link, block: LawBlock, bank: int) -> list[float]:
    """All values of bank 0 or 1, in their order."""
    return [float(read_number(v)) for v in answers(link, block.bank_text(bank), BANK_VALUES)]


def is_running(link: Link, block: LawBlock, servo_period_s: float) -> LawForm:
    """Form that proves to run now: its signature comes back after it was cleared."""
    link.command(f"P{block.p(Index.SIGNATURE)}=0")
    pause_s = SIGN_OF_LIFE_CYCLES * servo_period_s
    link.clock.sleep_s(pause_s)
    form = read_law_head(link, block).form
    deadline = CardDeadline(link, pause_s) if form is LawForm.NONE else None
    while deadline is not None and form is LawForm.NONE and not deadline.expired():
        link.clock.sleep_s(pause_s)
        form = read_law_head(link, block).form
    return form


def degree_refusals(link: Link) -> list[SafetyRefusal]:
    """Refusal while I15 = 1: the law takes sines of degrees, in radians they would be others."""
    if int(read_one(link, "I15")) == 0:
        return []
    return [
        SafetyRefusal(
            "I15 = 1: sines are taken in radians on this card, the law is in degrees.",
            code="PC-LAW-041",
            hint="Ask who needs radians here; if nobody does, set I15 = 0.",
        )
    ]
