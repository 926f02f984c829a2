"""A compensation on a connected axis: put on part by part, switched for comparisons.

What lives here: what forbids a route, the order in which its parts go onto the card, with the
guarded sign tests (``sign_test``) between them, and the switch of what stands. What may not: the
transactions themselves (``machine.controller``), the computing (``computing``).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pmac_comp.base.errors import ControllerState, SafetyRefusal
from pmac_comp.files.bench import Bench
from pmac_comp.machine.controller.card.processor_load import read_load
from pmac_comp.machine.controller.card.variables import read_one
from pmac_comp.machine.controller.change.context import UNKNOWN, Context
from pmac_comp.machine.controller.change.transaction import UploadResult
from pmac_comp.machine.controller.change.verdict import untouched
from pmac_comp.machine.controller.contents import programs
from pmac_comp.machine.controller.contents.comp_table import (
    BacklashTable,
    CompTable,
    Table,
    TableKind,
)
from pmac_comp.machine.controller.contents.law_bank import LawParameters
from pmac_comp.machine.controller.contents.safety import raise_all
from pmac_comp.machine.controller.contents.settings import Settings
from pmac_comp.machine.controller.contents.table_set import read_table, read_tables
from pmac_comp.machine.controller.law import (
    law_arming,
    law_checks,
    law_goal,
    law_install,
    law_state,
    law_upload,
)
from pmac_comp.machine.controller.law.block_use import block_refusals
from pmac_comp.machine.controller.motors import motors, switching
from pmac_comp.machine.controller.motors.feed_override import jog_refusals
from pmac_comp.machine.controller.settings import guard_install
from pmac_comp.machine.controller.settings.settings_upload import change_settings, texts
from pmac_comp.machine.controller.tables import bumpless
from pmac_comp.machine.controller.tables.table_status import read_head
from pmac_comp.machine.controller.tables.upload import TableUpload
from pmac_comp.machine.controller.tables.upload_checks import buffer_refusals, flash_refusals
from pmac_comp.machine.controller.whole.grouping import grouped
from pmac_comp.workflow.capture.as_described import description_refusals
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.compensation.cam import (
    CAM_PROGRAM,
    deploy_program,
    in_use_refusals,
    render_cam,
)
from pmac_comp.workflow.compensation.file import Compensation
from pmac_comp.workflow.compensation.program import deploy_motion
from pmac_comp.workflow.compensation.tables import tables_of
from pmac_comp.workflow.controller.motion_owners import motion_refusals
from pmac_comp.workflow.controller.owners import time_motor_refusals
from pmac_comp.workflow.controller.sign_test import check_cam_sign, check_law_sign, check_table_sign
from pmac_comp.workflow.controller.standing import place_refusals, stand_to_switch, uploading
from pmac_comp.workflow.law.backlash import take_up_variables
from pmac_comp.workflow.law.law_cost import cost_refusals, require_time_left, servo_cost_refusals
from pmac_comp.workflow.law.rendering import law_parameters
from pmac_comp.workflow.law.routes import MOTION_ROUTES, TORQUE_ROUTES


@dataclass(frozen=True)
class Deployment:
    """What an upload of a compensation did, part by part.

    ``acts`` is False where a law was loaded for ``motor`` without being armed: its loop is open.
    """

    verdict: ControllerState
    parts: tuple[UploadResult, ...]
    notes: tuple[str, ...] = ()
    motor: int = 0
    acts: bool = True

    def as_result(self) -> dict[str, Any]:
        """Mapping for ``--json``."""
        route = self.parts[-1].route if self.parts else ""
        return {
            "verdict": self.verdict.value,
            "route": route,
            "parts": [part.as_dict() for part in self.parts],
            "notes": list(self.notes),
        }


def deploy(axis: Axis, compensation: Compensation, context: Context) -> Deployment:
    """Upload all parts of a compensation and switch it on.

    The lead table goes first, then the law into the idle bank; the gain ramps up at the end. What
    forbids the route is raised before the first of them.
    """
    with untouched():
        raise_all(route_refusals(axis, context, compensation), "The upload")
    with grouped(axis.link, context, compensation.route) as parts_context:
        return _deploy_parts(axis, compensation, parts_context)


def _deploy_parts(axis: Axis, compensation: Compensation, context: Context) -> Deployment:
    """Tables, then the law or the motion; each part is whole before the next one begins."""
    parts, notes = _put_tables(axis, compensation, context)
    acts = True
    if compensation.route in TORQUE_ROUTES:
        law, said, acts = _put_law(axis, compensation, context)
        parts.append(law)
        notes += said
    if compensation.route == "program":
        parts.append(deploy_motion(axis, compensation, context))
    return Deployment(ControllerState.NEW, tuple(parts), tuple(notes), axis.motor, acts)


def _put_tables(
    axis: Axis, compensation: Compensation, context: Context
) -> tuple[list[UploadResult], list[str]]:
    """Tables of a compensation, a cam's motion with them, and their signs measured; in words."""
    parts: list[UploadResult] = []
    notes: list[str] = []
    tables = tables_of(compensation, axis.bench)
    stale = stale_tables(axis, compensation, tables)
    if tables:
        notes += guard_install.install_guard(axis.link, context)
    _set_take_up(axis, context, tables)
    if compensation.route == "cam":
        place_ct = stand_to_switch(axis, uploading(tables, stale))
        parts.append(_deploy_cam(axis, compensation, context, tables, stale))
        notes.append(
            f"the motion is PROG {CAM_PROGRAM}; motor #{axis.bench.controller.cam_motor_number} "
            "counts its time"
        )
        notes += check_table_sign(axis, tables, context, back_to_ct=place_ct)
        notes += check_cam_sign(axis, render_cam(compensation, axis.bench).table.table, context)
    elif tables or stale:
        context.progress("standing where tables may be switched", *UNKNOWN)
        place_ct = stand_to_switch(axis, uploading(tables, stale))
        with TableUpload(axis.link, context, tables, without=stale) as upload:
            parts.append(upload.execute())
        notes += check_table_sign(axis, tables, context, back_to_ct=place_ct)
    return parts, notes


def _put_law(
    axis: Axis, compensation: Compensation, context: Context
) -> tuple[UploadResult, list[str], bool]:
    """Program and bank of a law, what was done in words, and whether it was armed."""
    notes: list[str] = []
    if compensation.route == "law":
        every = compensation.law.every_cycles
        notes += law_install.install_law(axis.link, context, axis.motor, every_cycles=every)
        notes += check_law_sign(axis, context)
    if compensation.route == "servo":
        law_install.require_open_servo(axis.link, context, axis.motor)
    parameters = law_parameters(compensation.law, axis.scales)
    clamp = _clamp_ct(axis, context, compensation)
    part = law_upload.upload_law(axis.link, context, parameters, clamp_ct=clamp)
    is_closed = motors.read_motor(axis.link, axis.motor).status.is_closed_loop
    if is_closed:
        notes.append(require_time_left(axis.link, axis.bench, compensation.route))
        context.progress("arming the law", *UNKNOWN)
        law_arming.arm(axis.link, context)
        notes.append("the law is armed; its gain ramped up")
    else:
        if law_state.read_law_head(axis.link, context.block).is_armed:
            law_arming.disarm(axis.link, context)  # it would act as soon as the loop is closed
        notes.append("the law is loaded and not armed: the motor's loop is open")
    return part, notes, is_closed


def _clamp_ct(axis: Axis, context: Context, compensation: Compensation) -> float:
    """Amplitude at which the running law clamps, counts."""
    # The same length through two roundings must not pass the limit by a bit.
    return min(
        compensation.law.amplitude_limit_m / axis.scales.motor_m_per_ct,
        context.limits.max_correction_ct,
    )


def route_refusals(axis: Axis, context: Context, compensation: Compensation) -> list[SafetyRefusal]:
    """What forbids a route beside its tables, all of it before anything is changed.

    A card that is not as the bench file says forbids them all.
    """
    link, route = axis.link, compensation.route
    refusals = description_refusals(axis)
    refusals += block_refusals(link, context.block)
    stands = read_head(link, context)
    refusals += [*flash_refusals(stands), *buffer_refusals(stands)]
    refusals += double_corrections(axis, context, compensation)
    refusals += _place_refusals(axis, compensation)
    if motors.read_motor(link, axis.motor).status.is_closed_loop:
        refusals += jog_refusals(link, axis.motor)
    if route == "law":
        every = compensation.law.every_cycles
        refusals += law_checks.law_refusals(link, context, axis.motor, every_cycles=every)
        load = read_load(link, axis.bench.servo_period_s)
        refusals += cost_refusals(axis.bench, compensation.law, load)
    if route == "servo":
        refusals += law_checks.servo_refusals(link, context, axis.motor)
        refusals += _busy_servo_refusals(axis, context, compensation)
    if route == "cam":
        refusals += [*in_use_refusals(axis), *time_motor_refusals(axis)]
    if route in MOTION_ROUTES:
        refusals += motion_refusals(axis)
    if route in TORQUE_ROUTES:
        refusals += _torque_refusals(axis.bench, compensation)
        parameters = law_parameters(compensation.law, axis.scales)
        clamp = _clamp_ct(axis, context, compensation)
        refusals += law_upload.standing_refusals(link, context, parameters, clamp)
    return refusals


def _place_refusals(axis: Axis, compensation: Compensation) -> list[SafetyRefusal]:
    """Refusal where the tables of a compensation could be switched nowhere without a step."""
    tables = tables_of(compensation, axis.bench)
    stale = stale_tables(axis, compensation, tables)
    return place_refusals(axis, uploading(tables, stale)) if tables or stale else []


def _torque_refusals(bench: Bench, compensation: Compensation) -> list[SafetyRefusal]:
    """Refusal of a law that may add more torque than the bench file allows the drive."""
    asked_Nm, most_Nm = compensation.law.torque_limit_Nm, bench.drive.torque_limit_Nm
    if asked_Nm <= most_Nm:
        return []
    return [
        SafetyRefusal(
            f"The law may add up to {asked_Nm:.4g} N m; torque_limit_Nm of the bench file is "
            f"{most_Nm:.4g}.",
            code="PC-DEP-062",
            hint="Run `pmac-comp compensate` again: somebody changed the compensation file.",
        )
    ]


def _busy_servo_refusals(
    axis: Axis, context: Context, compensation: Compensation
) -> list[SafetyRefusal]:
    """Refusal of a law for which the open servo has no time; where one is in it, it had."""
    if law_state.read_law_head(axis.link, context.block).motor == axis.motor:
        return []  # measured with the new one, before it is armed
    load = read_load(axis.link, axis.bench.servo_period_s)
    return servo_cost_refusals(axis.bench, compensation.law, load)


def guard_download(axis: Axis, context: Context) -> list[str]:
    """Guard PLC as an upload of tables would write it; nothing where it stands already."""
    _, guard = guard_install.guard_settings(axis.link, context)
    return _download_lines([programs.Program(*key, body) for key, body in guard.programs.items()])


def law_download(axis: Axis, context: Context) -> list[str]:
    """PLC 0 as an upload of a law would write it; nothing where it stands already."""
    law = law_goal.law_program(context.block, axis.motor)
    return [] if programs.is_present(axis.link, law) else _download_lines([law])


def _download_lines(missing: Sequence[programs.Program]) -> list[str]:
    """Lines that write programs onto a card."""
    return [
        line
        for program in missing
        for line in (f"OPEN {program.name} CLEAR", *program.lines, "CLOSE")
    ]


def stale_tables(
    axis: Axis, compensation: Compensation, tables: Sequence[Table]
) -> tuple[tuple[TableKind, int], ...]:
    """Backlash tables on the card that the new compensation must not stand beside.

    Law, cam and program carry friction themselves, whether or not a lead table comes with them.
    """
    key = (TableKind.BLCOMP, axis.motor)
    if any((table.kind, table.motor) == key for table in tables):
        return ()
    return () if read_table(axis.link, *key) is None else (key,)


def double_corrections(
    axis: Axis, context: Context, compensation: Compensation
) -> list[SafetyRefusal]:
    """What on the card corrects already what the new compensation corrects."""
    refusals: list[SafetyRefusal] = []
    carries = compensation.backlash or compensation.route in MOTION_ROUTES
    if compensation.route not in TORQUE_ROUTES and carries:
        head = law_state.read_law_head(axis.link, context.block)
        if head.is_armed:
            refusals.append(
                SafetyRefusal(
                    f"A law acts on the controller: the route {compensation.route} would correct "
                    "friction and elasticity a second time.",
                    code="PC-DEP-060",
                    hint="Take the law back first: `pmac-comp rollback`, or `pmac-comp remove` "
                    "where it was put on before the last upload.",
                )
            )
    number = axis.bench.controller.cam_motor_number
    cam = read_table(axis.link, TableKind.COMP, number) if number != axis.motor else None
    aims = isinstance(cam, CompTable) and cam.target == axis.motor
    if compensation.route != "cam" and aims:
        refusals.append(
            SafetyRefusal(
                f"Motor #{number} has a cam on this axis: its motion would be corrected twice.",
                code="PC-DEP-061",
                hint="Take the cam back first: `pmac-comp rollback`, or `pmac-comp remove` where "
                "it was put on before the last upload.",
            )
        )
    return refusals


def _set_take_up(axis: Axis, context: Context, tables: Sequence[Table]) -> None:
    """Backlash take-up before a backlash table comes: without a table it does nothing."""
    for table in tables:
        if isinstance(table, BacklashTable):
            goal = Settings(texts(take_up_variables(table, axis.bench)))
            change_settings(axis.link, context, goal, route="table", motors=[axis.motor])


def _deploy_cam(
    axis: Axis,
    compensation: Compensation,
    context: Context,
    tables: tuple[Table, ...],
    stale: tuple[tuple[TableKind, int], ...],
) -> UploadResult:
    """Program with the time axis, then its table."""
    deploy_program(axis, render_cam(compensation, axis.bench), context)
    with TableUpload(axis.link, context, tables, without=stale, route="cam") as upload:
        return upload.execute()


def switch(axis: Axis, context: Context, compensation: Compensation, *, on: bool) -> None:
    """Compensation on or off for a comparison, without a step: the law by its ramp.

    Raises
    ------
    VerifyMismatch
        The switch does not read back.
    """
    stand_to_switch(axis)
    if compensation.route in TORQUE_ROUTES:
        if on:
            law_arming.arm(axis.link, context)
        else:
            law_arming.disarm(axis.link, context)
    if tables_of(compensation, axis.bench):
        switch_tables(axis, on=on)


def switch_tables(axis: Axis, *, on: bool) -> None:
    """Tables on or off (I51) where those of the axis step least.

    I51 is of the whole card: other motors that have tables must stand, and where switching moves
    them little.

    Raises
    ------
    SafetyRefusal
        A motor moves, or would jump; tables are left as they were.
    VerifyMismatch
        I51 does not read back.
    """
    stand_to_switch(axis)
    if read_one(axis.link, "I51") == float(on):
        return
    tables = read_tables(axis.link)
    refusals = bumpless.switch_refusals(axis.link, axis.scales.limits(axis.bench), tables, on=on)
    try:
        raise_all(refusals, f"Switching the tables {'on' if on else 'off'}")
    except SafetyRefusal as error:
        error.left = ControllerState.DISABLED if on else ControllerState.NEW
        raise
    switching.switch_tables(axis.link, int(on), tables.motors)


def bank_in_use(axis: Axis, context: Context, compensation: Compensation) -> LawParameters | None:
    """Bank that the card uses; None where it holds another law than this compensation's."""
    head = law_state.read_law_head(axis.link, context.block)
    bank = law_state.read_bank(axis.link, context.block, head.bank)
    wanted = law_parameters(compensation.law, axis.scales)
    return bank if bank is not None and bank.digest == wanted.digest else None
