"""What an upload would do, for a person to look at before it is done; nothing is changed.

What changes and by how much at most, what is off meanwhile and for how long, what the axis does,
and everything that forbids it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pmac_comp.base.errors import PmacCompError, SafetyRefusal
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.resources import DEFAULT_JOURNAL
from pmac_comp.machine.controller.card.processor_load import read_load
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.contents.comp_table import CompTable, Table
from pmac_comp.machine.controller.contents.safety import raise_all
from pmac_comp.machine.controller.contents.settings import plain_axes, read_axes
from pmac_comp.machine.controller.contents.table_set import Key
from pmac_comp.machine.controller.law.law_state import LawHead, read_law_head
from pmac_comp.machine.controller.motors import motors
from pmac_comp.machine.controller.motors.open_servos import scratch_remarks
from pmac_comp.machine.controller.settings import guard_install
from pmac_comp.machine.controller.settings.saved_plcs import power_up_remarks
from pmac_comp.machine.controller.tables.upload import TableUpload
from pmac_comp.machine.controller.tables.upload_plan import UploadPlan
from pmac_comp.machine.controller.whole.waiting import waiting_refusals
from pmac_comp.machine.transport.url import parse_url
from pmac_comp.workflow.capture.as_described import place_remarks
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import context_to_look
from pmac_comp.workflow.capture.session import open_axis
from pmac_comp.workflow.compensation.cam import CAM_PROGRAM, axis_settings, render_cam
from pmac_comp.workflow.compensation.file import Compensation, edited_remarks, read_compensation
from pmac_comp.workflow.compensation.program import draw_motion
from pmac_comp.workflow.compensation.tables import tables_of
from pmac_comp.workflow.controller.deploy import (
    guard_download,
    law_download,
    route_refusals,
    stale_tables,
)
from pmac_comp.workflow.controller.difference import Difference, difference_on
from pmac_comp.workflow.controller.sign_test import SIGN_OFFSETS_um
from pmac_comp.workflow.controller.standing import standing_lines, uploading
from pmac_comp.workflow.law.law_cost import cost_remarks, load_text
from pmac_comp.workflow.law.rendering import law_parameters
from pmac_comp.workflow.law.routes import TORQUE_ROUTES

_ENABLE_STEPS = {"PC-SAF-004", "PC-SAF-041"}
_SERIAL_CHARACTERS_PER_s = 0.1  # of the baud rate: ten bits each
_PACKETS_CHARACTERS_PER_s = 1e5
_STEPS_s = 0.5  # questions, seal and switch
_NOT_SAVED = "  nothing is saved to flash: after a reset the controller comes up as before"
_SAVED = (
    "  then the motor is killed and everything on the controller is saved to flash (SAVE), which "
    "takes seconds without any limit checks, and is read again"
)
_BOTH_WAYS = 2.0  # written and read back
_DEFAULT_BAUD = 38400.0


@dataclass(frozen=True)
class UploadPreview:
    """A plan in words, the lines that would be sent, and what forbids it."""

    url: str
    route: str
    text: tuple[str, ...]
    lines: tuple[str, ...]
    refusals: tuple[SafetyRefusal, ...]
    change: Difference

    def require_allowed(self) -> None:
        """Raise all refusals together, if there are any; nothing was changed."""
        raise_all(self.refusals, "The upload")

    def as_result(self) -> dict[str, Any]:
        """Mapping for ``--json``."""
        return {
            "url": self.url,
            "route": self.route,
            "plan": list(self.text),
            "lines": list(self.lines),
            "largest_change_um": self.change.largest_change_um,
            "refusals": [refusal.message for refusal in self.refusals],
        }


def plan_upload(
    url: str, bench: str, new: Path, *, journal: Path = DEFAULT_JOURNAL, persist: bool = False
) -> UploadPreview:
    """Preview of an upload; ``persist`` says that it will be saved to flash afterwards."""
    compensation = read_compensation(new)
    with open_axis(url, bench) as axis:
        context = context_to_look(axis, journal)
        return preview(axis, context, compensation, url, persist=persist)


def preview(
    axis: Axis, context: Context, compensation: Compensation, url: str, *, persist: bool = False
) -> UploadPreview:
    """Preview on a connected axis."""
    lines: list[str] = []
    refusals = waiting_refusals(axis.link, context)
    refusals += route_refusals(axis, context, compensation)
    change = difference_on(axis, context, compensation)
    text = [f"plan for {url}, route {compensation.route}:"]
    text += [f"  {line}" for line in (*edited_remarks(compensation), *change.lines())]
    tables = tables_of(compensation, axis.bench)
    stale = stale_tables(axis, compensation, tables)
    if tables or stale:
        upload = TableUpload(axis.link, context, tables, without=stale)
        plan = upload.prepare()
        lines += plan.lines
        refusals += [r for r in plan.refusals if not _settled_by_moving(r, axis)]
        text += _table_lines(axis, plan, url)
        if tables:
            lines += guard_download(axis, context)
            text += _guard_lines(axis, context)
        text += _motion_lines(axis, tables, stale)
    if compensation.route == "cam":
        text += _cam_lines(axis, compensation)
        lines += render_cam(compensation, axis.bench).program.lines
    if compensation.route == "program":
        text += _program_lines(axis, compensation)
        lines += draw_motion(compensation, axis.bench).program.lines
    if compensation.route in TORQUE_ROUTES:
        parameters = law_parameters(compensation.law, axis.scales)
        head = read_law_head(axis.link, context.block)
        text += _law_lines(axis, compensation, head)
        if compensation.route == "law":
            text += [f"  {r}" for r in scratch_remarks(axis.link, context.block, axis.motor)]
            lines += law_download(axis, context)
        idle = int(head.bank == 0)
        bank = [context.block.bank(idle, k) for k in range(len(parameters.values()))]
        lines += [f"P{n}={v:.9g}" for n, v in zip(bank, parameters.values(), strict=True)]
    cost = cost_remarks(axis.bench, compensation.route, compensation.law)
    text += [f"  {line}" for line in cost]
    if compensation.route in TORQUE_ROUTES:
        text.append(f"  now {load_text(read_load(axis.link, axis.bench.servo_period_s))}")
    text += [f"  {remark}" for remark in place_remarks(axis.link, axis.bench)]
    text += _flash_lines(axis, context) if persist else [_NOT_SAVED]
    refusals = list({refusal.message: refusal for refusal in refusals}.values())
    return UploadPreview(
        url, compensation.route, tuple(text), tuple(lines), tuple(refusals), change
    )


def _flash_lines(axis: Axis, context: Context) -> list[str]:
    kept = power_up_remarks(axis.link, context.block, axis.motor)
    return [_SAVED, *(f"  {remark}" for remark in kept)]


def _settled_by_moving(refusal: PmacCompError, axis: Axis) -> bool:
    """Whether a step on enabling goes away because the axis first moves to where there is none."""
    return refusal.code in _ENABLE_STEPS and refusal.context.get("motor") == axis.motor


def _table_lines(axis: Axis, plan: UploadPlan, url: str) -> list[str]:
    names = ", ".join(f"{t.kind.value} of motor #{t.motor} ({len(t.entries)})" for t in plan.new)
    off_s = _off_s(url, sum(len(line) + 1 for line in plan.lines))
    targets = [t.target if isinstance(t, CompTable) else t.motor for t in plan.old]
    others = [f"#{m}" for m in dict.fromkeys(targets) if m != axis.motor]
    was = "act now" if plan.enabled_old else "are off now"
    meanwhile = "written and read back" if plan.lines else "looked at: none of them changes"
    return [
        f"  tables afterwards (entries): {names or 'none'}; tables {was}",
        f"  all tables of the controller are off (I51 = 0) for about {off_s:.1f} s while they are "
        f"{meanwhile}" + (f"; that concerns {', '.join(others)} as well" if others else ""),
        *(f"  {remark}" for remark in plan.remarks),
    ]


def _guard_lines(axis: Axis, context: Context) -> list[str]:
    refusal, goal = guard_install.guard_settings(axis.link, context)
    if refusal:
        return [f"  {refusal}"]
    if goal.is_empty:
        return []
    return ["  guard: PLC 1 comes onto the controller; it keeps half-written tables off"]


def _off_s(url: str, characters: int) -> float:
    endpoint = parse_url(url)
    rate = _PACKETS_CHARACTERS_PER_s
    if endpoint.scheme == "serial":
        baud = float(dict(endpoint.options).get("baud", _DEFAULT_BAUD))
        rate = baud * _SERIAL_CHARACTERS_PER_s
    return _STEPS_s + _BOTH_WAYS * characters / rate


def _motion_lines(axis: Axis, tables: Sequence[Table], stale: Sequence[Key]) -> list[str]:
    if not motors.read_motor(axis.link, axis.motor).status.is_closed_loop:
        return ["  the motor's loop is open: nothing moves, and no sign is measured"]
    try:
        there = standing_lines(axis, uploading(tables, stale))
    except SafetyRefusal:
        return []  # one of the refusals
    tested = any(isinstance(table, CompTable) and table.motor == axis.motor for table in tables)
    most = "  then it moves to where the table corrects most, to measure its sign, and back"
    return [*(f"  {line}" for line in there), *([most] if tested else [])]


def _cam_lines(axis: Axis, compensation: Compensation) -> list[str]:
    cam = render_cam(compensation, axis.bench)
    table = cam.table.table
    largest_um = table.largest_correction_ct * axis.scales.motor_m_per_ct * UM_PER_M
    closed = motors.read_motor(axis.link, axis.motor).status.is_closed_loop
    tested = "its time is then run slowly to where it corrects clearly, to measure its sign"
    return [
        *([f"  cam: {tested}"] if closed else []),
        f"  cam: motor #{table.motor} counts time at {cam.shape.ct_per_cycle} counts per servo "
        f"cycle, {len(table.entries)} entries, largest {largest_um:.2f} um, rounding "
        f"{cam.table.quantisation_um:.3f} um",
        f"  motion: PROG {CAM_PROGRAM}, {cam.motion.duration_s:.2f} s; run this program, "
        f"{_elsewhere(compensation)}",
        *_axes_lines(axis),
    ]


def _axes_lines(axis: Axis) -> list[str]:
    """Axis definitions that those of a cam put aside, as a person may have programs for them."""
    present = read_axes(axis.link)
    gone = plain_axes(present) - plain_axes(axis_settings(axis.bench, present).axes or ())
    told = ", ".join(f"&{system}#{motor}->{text}" for system, motor, text in sorted(gone))
    return [f"  motion: takes the place of the axis definitions {told}"] if gone else []


def _program_lines(axis: Axis, compensation: Compensation) -> list[str]:
    drawn = draw_motion(compensation, axis.bench)
    return [
        f"  motion: {drawn.program.name}, {drawn.motion.duration_s:.2f} s, "
        f"{len(drawn.program.lines)} lines, largest correction {drawn.largest_um:.2f} um, shape "
        f"error {drawn.shape_error_um:.3f} um, rounding {drawn.rounding_um:.4f} um",
        f"  run this program, {_elsewhere(compensation)}",
    ]


def _elsewhere(compensation: Compensation) -> str:
    """What of the route of one known motion reaches the others."""
    if compensation.lead is None:
        return "other motions stay uncompensated"
    return "other motions have the tables only"


def _law_lines(axis: Axis, compensation: Compensation, head: LawHead) -> list[str]:
    law = compensation.law
    out = [
        f"  the law goes into the idle bank, is read back and taken over by one write: nothing is "
        f"off meanwhile; its correction is clamped to {law.amplitude_limit_m * UM_PER_M:g} um"
    ]
    if not motors.read_motor(axis.link, axis.motor).status.is_closed_loop:
        return [*out, "  the motor's loop is open: the law is loaded and not armed"]
    if head.is_armed:
        return [*out, "  a law is armed already: the new one takes its place at the same gain"]
    if compensation.route == "law":
        out.append(
            f"  before it is armed a guarded test moves the motor by {SIGN_OFFSETS_um[0]:g} to "
            f"{SIGN_OFFSETS_um[-1]:g} um to measure the sign of the correction"
        )
    return [*out, "  its gain then ramps up from 0 to 1"]
