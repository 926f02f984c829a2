"""Guarded tests of the sign, on the connected controller, before a correction is trusted.

The manual's statements about the sign of the compensation register do not agree with one another
(Software Reference Manual p. 303, 382, 516; User Manual p. 189). So it is measured where the axis
stands in closed loop: for the law with a small slow offset, for tables where they correct most.
"""

from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from pmac_comp.base.errors import ControllerState, PmacCompError, SafetyRefusal
from pmac_comp.base.units import UM_PER_M, UM_PER_MM
from pmac_comp.machine.controller.card import registers as reg
from pmac_comp.machine.controller.card.numbers import parse_integer
from pmac_comp.machine.controller.change.context import UNKNOWN, Context
from pmac_comp.machine.controller.change.verdict import link_is_lost
from pmac_comp.machine.controller.contents.comp_table import BacklashTable, CompTable, Table
from pmac_comp.machine.controller.gather.gather import note_failure
from pmac_comp.machine.controller.law import law_state
from pmac_comp.machine.controller.law.law_aside import law_aside
from pmac_comp.machine.controller.motors import motors
from pmac_comp.machine.controller.motors.sign_check import SignResult, check_master_sign
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.compensation.cam import reset_time, run_time_to
from pmac_comp.workflow.controller.standing import stand_to_switch

SIGN_OFFSETS_um = (20.0, 50.0, 100.0)  # one after the other, until the motor moves
_NOT_MOVED = "PC-SGN-005"  # code of ``check_master_sign`` where friction held the motor
_LEAST_um = 2.0  # a smaller correction says nothing beside the following error
_CLEAR_FRAC = 0.5  # of the expected correction
_NEARLY_MOST_FRAC = 0.7  # of the largest correction: near enough to look at the sign there
_ENDS_FRAC = 0.02  # of the travel, at both ends: the axis is not sent there for a test
_LOOP_IS_OPEN = (
    "the sign of the {} was not measured, as the motor's loop is open: upload again with the motor "
    "enabled before {}"
)
_REPORT = "Upload no tables to this controller, and report its firmware."
_SETTLE_s = 0.6
_PLACES = 1201  # over the travel, among which the strongest is looked for


def check_law_sign(axis: Axis, context: Context) -> list[str]:
    """Guarded test before the law is armed: which way a positive correction moves the motor.

    Raises
    ------
    SafetyRefusal
        It moves the motor down: every correction would double the error.
    """
    head = law_state.read_law_head(axis.link, context.block)
    status = motors.read_motor(axis.link, axis.motor).status
    if head.is_armed or not status.is_closed_loop:
        return []
    context.progress("measuring the sign of the law: the motor moves", *UNKNOWN)
    with law_aside(axis.link, context):
        found = _sign_against_friction(axis)
    if found.sign < 0:
        raise SafetyRefusal(
            f"A correction of {found.offset_ct:+.0f} counts moved the motor by "
            f"{found.moved_ct:+.1f} counts: the sign of the door is reversed.",
            code="PC-DEP-040",
            hint="Check Ixx05-Ixx07; the law was loaded but is not armed.",
        )
    return [
        f"sign measured on this controller: {found.offset_ct:+.0f} counts move the motor by "
        f"{found.moved_ct:+.1f} counts"
    ]


def _sign_against_friction(axis: Axis) -> SignResult:
    """Sign test with an offset that grows until it moves the motor against its friction."""
    for offset_um in SIGN_OFFSETS_um[:-1]:
        try:
            return check_master_sign(axis.link, axis.motor, offset_ct=_offset_ct(axis, offset_um))
        except PmacCompError as error:
            if error.code != _NOT_MOVED:
                raise
    return check_master_sign(axis.link, axis.motor, offset_ct=_offset_ct(axis, SIGN_OFFSETS_um[-1]))


def _offset_ct(axis: Axis, offset_um: float) -> float:
    """A length in whole counts of the motor."""
    return float(round(offset_um / UM_PER_M / axis.scales.motor_m_per_ct))


def check_table_sign(
    axis: Axis, tables: Sequence[Table], context: Context, *, back_to_ct: float = 0.0
) -> list[str]:
    """Guarded test of tables that act: where they correct most the motor must stand so.

    The axis moves there and on to ``back_to_ct``, where it stood; the correction is within the
    safety limits already.

    Raises
    ------
    SafetyRefusal
        The motor stands on the other side: the axis goes where the tables step least, and they are
        switched off.
    """
    own = [t for t in tables if t.motor == axis.motor]
    table = next((t for t in own if isinstance(t, CompTable)), None)
    backlash = next((t for t in own if isinstance(t, BacklashTable)), None)
    closed = motors.read_motor(axis.link, axis.motor).status.is_closed_loop
    if table is None:
        return []
    if not closed:
        return [_LOOP_IS_OPEN.format("tables", "the axis is used")]
    place_ct, expected_ct = _strongest(axis, table, backlash)
    to_um = axis.scales.motor_m_per_ct * UM_PER_M
    place_mm = place_ct * to_um / UM_PER_MM
    if abs(expected_ct) * to_um < _LEAST_um:
        return [f"the tables correct less than {_LEAST_um:g} um: their sign was not measured"]
    context.progress(
        f"measuring the sign of the tables: the axis moves to {place_mm:.1f} mm",
        *UNKNOWN,
    )
    axis.move_to(place_ct)
    axis.link.clock.sleep_s(_SETTLE_s)
    found_ct = _beyond_command(axis)
    if found_ct * np.sign(expected_ct) < -_CLEAR_FRAC * abs(expected_ct):
        raise _tables_off(
            axis,
            f"At {place_mm:.1f} mm the table means {expected_ct * to_um:+.1f} um, "
            f"the motor stands {found_ct * to_um:+.1f} um beside its command",
            code="PC-DEP-041",
        )
    axis.move_to(back_to_ct)
    said = (
        f"at {place_mm:.1f} mm: {expected_ct * to_um:+.1f} um meant, "
        f"{found_ct * to_um:+.1f} um found"
    )
    if found_ct * np.sign(expected_ct) < _CLEAR_FRAC * abs(expected_ct):
        return [
            f"the motor hardly follows the tables {said}; their sign was not measured: friction "
            "holds it, or they do not act (I51 = 0)"
        ]
    return [f"sign of the tables measured {said}"]


def check_cam_sign(axis: Axis, table: CompTable, context: Context) -> list[str]:
    """Guarded test of a cam: time is run slowly to where it corrects clearly, and back.

    The axis stands where it is meanwhile and goes as far as the cam's correction there.

    Raises
    ------
    SafetyRefusal
        The motor stands on the other side: tables are switched off.
    """
    if not motors.read_motor(axis.link, axis.motor).status.is_closed_loop:
        return [_LOOP_IS_OPEN.format("cam", "it is run")]
    place_ct, expected_ct = _first_clear(axis, table)
    to_um = axis.scales.motor_m_per_ct * UM_PER_M
    if abs(expected_ct) * to_um < _LEAST_um:
        return [f"the cam corrects less than {_LEAST_um:g} um: its sign was not measured"]
    context.progress("measuring the sign of the cam: its time runs slowly", *UNKNOWN)
    found_ct = _beside_its_time(axis, place_ct)
    share = found_ct / expected_ct
    said = f"{expected_ct * to_um:+.1f} um meant, {found_ct * to_um:+.1f} um found"
    if share < -_CLEAR_FRAC:
        raise _tables_off(
            axis,
            f"Where the cam corrects first the motor stands on the other side ({said})",
            code="PC-DEP-042",
        )
    if share < _CLEAR_FRAC:
        return [f"friction holds the motor against the cam ({said}): its sign was not measured"]
    return [f"sign of the cam measured: {said}"]


def _tables_off(axis: Axis, seen: str, *, code: str) -> SafetyRefusal:
    """Error of tables that correct the wrong way, after they were switched off without a step.

    A compensation register keeps what it holds while tables are off: where they correct most the
    axis would go on standing wrong by all of it.
    """
    refusal = SafetyRefusal(
        f"{seen}: the sign of the tables is reversed.",
        code=code,
        hint=f"Tables were switched off (I51 = 0) where they step least. {_REPORT}",
        left=ControllerState.DISABLED,
    )
    try:
        stand_to_switch(axis)
        axis.link.command("I51=0")
    except KeyboardInterrupt:
        with suppress(PmacCompError):
            _off_with_a_kill(axis)
        raise
    except PmacCompError as error:
        if link_is_lost(error):
            error.add_note(refusal.message)
            raise
        refusal.hint = f"The motor was killed and tables were switched off (I51 = 0). {_REPORT}"
        refusal.add_note(f"The axis could not go where tables step least: {error.message}")
        note_failure(refusal, lambda: _off_with_a_kill(axis))
    return refusal


def _off_with_a_kill(axis: Axis) -> None:
    """Tables off where the axis is: a killed motor does not jump when its register is cleared."""
    axis.kill()
    axis.link.command("I51=0")
    axis.link.command(f"WL${reg.motor_register(axis.motor, reg.COMPENSATION):X},0")


def _beside_its_time(axis: Axis, place_ct: int) -> float:
    """Where the motor stands beside its command at a time of its cam, counts; time is put back."""
    try:
        run_time_to(axis, place_ct)
        axis.link.clock.sleep_s(_SETTLE_s)
        found_ct = _beyond_command(axis)
    except (PmacCompError, KeyboardInterrupt):
        with suppress(PmacCompError):
            axis.link.flush()
            reset_time(axis)
        raise
    reset_time(axis)
    return found_ct


def _first_clear(axis: Axis, table: CompTable) -> tuple[int, float]:
    """First time of a cam at which it moves the motor clearly, and by how much; counts."""
    places = np.rint(np.linspace(0.0, table.span_ct, len(table.entries) + 1))
    values = table.correction_ct(places)
    enough_ct = min(
        _offset_ct(axis, SIGN_OFFSETS_um[0]), _NEARLY_MOST_FRAC * float(np.max(np.abs(values)))
    )
    first = int(np.argmax(np.abs(values) >= enough_ct))
    return int(places[first]), float(values[first])


def _strongest(axis: Axis, table: CompTable, backlash: BacklashTable | None) -> tuple[float, float]:
    """Place nearest to zero at which tables nearly correct most, and their correction; counts.

    On the way down from zero backlash counts with it.
    """
    limits = axis.scales.limits(axis.bench)
    margin = _ENDS_FRAC * (limits.max_position_ct - limits.min_position_ct)
    places = np.linspace(limits.min_position_ct + margin, limits.max_position_ct - margin, _PLACES)
    values = table.correction_ct(places)
    if backlash is not None:
        values = values - np.where(places < 0.0, backlash.backlash_ct(places), 0.0)
    good = np.flatnonzero(np.abs(values) >= _NEARLY_MOST_FRAC * np.max(np.abs(values)))
    best = good[np.argmin(np.abs(places[good]))]
    return float(places[best]), float(values[best])


def _beyond_command(axis: Axis) -> float:
    """Where the motor stands beside its commanded position, counts."""
    scale = 32.0 * axis.scales.ixx08
    raw = [
        parse_integer(axis.link.query(f"RL${reg.motor_register(axis.motor, offset):X}")[0])
        for offset in (reg.ACTUAL, reg.COMMANDED)
    ]
    return (raw[0] - raw[1]) / scale
