"""Uploads as a person runs them: the plan, the upload itself, recovery and rollback.

What lives here: which parts are asked in which order, and the words for people. What may not: the
transactions (``machine.controller``), what is written (``deploy``).
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pmac_comp.base.errors import (
    ConfigError,
    ControllerState,
    ForeignChange,
)
from pmac_comp.base.units import UM_PER_M
from pmac_comp.machine.controller import law_upload, recovery
from pmac_comp.machine.controller.law_bank import LawParameters
from pmac_comp.machine.controller.program_upload import rollback_program
from pmac_comp.machine.controller.transaction import Context, UploadResult
from pmac_comp.machine.controller.upload import TableUpload, UploadPlan
from pmac_comp.workflow.axis import Axis
from pmac_comp.workflow.cam import (
    CAM_PROGRAM,
    release_time_motor,
    render_cam,
    rest_time_motor,
)
from pmac_comp.workflow.compensation_file import (
    Compensation,
    read_compensation,
)
from pmac_comp.workflow.computing import cost_remarks, largest_correction_um
from pmac_comp.workflow.deploy import LAST_UPLOAD, Progress, context_of, deploy, stand_at_zero
from pmac_comp.workflow.rendering import law_parameters
from pmac_comp.workflow.routes import TORQUE_ROUTES
from pmac_comp.workflow.session import open_axis
from pmac_comp.workflow.tables import tables_of


@contextmanager
def _ready(
    url: str, bench: str, journal: Path, progress: Progress | None
) -> Iterator[tuple[Axis, Context]]:
    with open_axis(url, bench) as axis:
        yield axis, context_of(axis, journal, progress)


def plan_upload(url: str, bench: str, new: Path) -> dict[str, Any]:
    """What an upload would do, for a person to look at; nothing is changed."""
    compensation = read_compensation(new)
    with open_axis(url, bench) as axis:
        context = context_of(axis)
        lines: list[str] = []
        text = [f"plan for {url}, route {compensation.route}:"]
        tables = tables_of(compensation, axis.bench)
        if tables:
            upload = TableUpload(axis.link, context, tables)
            plan = upload.prepare()
            lines += plan.lines
            text += _table_plan_lines(plan, axis)
        if compensation.route == "cam":
            text += _cam_plan_lines(axis, compensation)
        if compensation.route in TORQUE_ROUTES:
            parameters = law_parameters(compensation.law, axis.scales)
            text += _law_plan_lines(axis, context, compensation, parameters)
            first = context.block.bank(1)
            lines += [f"P{first + i}={v:.9g}" for i, v in enumerate(parameters.values())]
        text += [f"  {line}" for line in cost_remarks(axis.bench, compensation.route)]
        return {"url": url, "route": compensation.route, "plan": text, "lines": lines}


def _table_plan_lines(plan: UploadPlan, axis: Axis) -> list[str]:
    change_um = plan.largest_change_ct * axis.scales.motor_m_per_ct * UM_PER_M
    n = plan.new.n_entries
    out = [
        f"  tables: {n} entries, largest change {change_um:.2f} um",
        f"  all tables are off (I51 = 0) while {n} entries are written and read back, some "
        f"{0.5 + n / 400.0:.1f} s",
    ]
    return out + [f"  refused: {refusal.message}" for refusal in plan.refusals]


def _cam_plan_lines(axis: Axis, compensation: Compensation) -> list[str]:
    cam = render_cam(compensation, axis.bench)
    table = cam.table.table
    largest_um = max(map(abs, table.entries)) / 16.0 * axis.scales.motor_m_per_ct * UM_PER_M
    return [
        f"  cam: motor #{table.motor} counts time at {cam.shape.ct_per_cycle} counts per servo "
        f"cycle, {len(table.entries)} entries, largest {largest_um:.2f} um, rounding "
        f"{cam.table.quantisation_um:.3f} um",
        f"  motion: PROG {CAM_PROGRAM}, {cam.motion.duration_s:.2f} s; run this program, other "
        "motions stay uncompensated",
    ]


def _law_plan_lines(
    axis: Axis, context: Context, compensation: Compensation, parameters: LawParameters
) -> list[str]:
    head = law_upload.read_law_head(axis.link, context.block)
    state = "armed" if head.is_armed else "disarmed"
    return [
        f"  law: largest correction {largest_correction_um(compensation.law):.2f} um, clamp "
        f"{compensation.law.amplitude_limit_m * UM_PER_M:g} um, digest {parameters.digest:08x}",
        f"  the law on the card is {head.form.name.lower()}, {state}; nothing is off meanwhile: "
        "the idle bank is filled, read back and taken over by one write",
    ]


def upload_file(
    url: str,
    bench: str,
    new: Path,
    journal: Path,
    *,
    persist: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Upload a compensation file."""
    compensation = read_compensation(new)
    with _ready(url, bench, journal, progress) as (axis, context):
        deployment = deploy(axis, compensation, context)
        if persist:
            from pmac_comp.machine.controller.upload import save

            axis.kill()
            save(axis.link)
    return {
        **deployment.as_result(),
        "summary": "; ".join(deployment.notes) or "uploaded, read back and compared",
        "next": f"Check it: pmac-comp verify {url} --compensation {new}. "
        f"Take it back: pmac-comp rollback {url}.",
    }


def recover_upload(
    url: str, bench: str, journal: Path, *, progress: Progress | None = None
) -> dict[str, Any]:
    """Settle what an interrupted upload left."""
    with _ready(url, bench, journal, progress) as (axis, context):
        result = recovery.recover(axis.link, context)
    return {**result.as_dict(), "summary": "; ".join(result.notes) or "nothing was left open"}


def rollback_upload(
    url: str, bench: str, journal: Path, *, progress: Progress | None = None
) -> dict[str, Any]:
    """Bring back what the last upload replaced: law first, then program, then tables."""
    with _ready(url, bench, journal, progress) as (axis, context):
        done: list[UploadResult] = []
        backups = _last_backups(context)
        law = _of_kind(backups, "law")
        if law is not None:
            done.append(law_upload.rollback_law(axis.link, context, law))
        program = _of_kind(backups, "program")
        if program is not None:
            done.append(rollback_program(axis.link, context, program))
        tables = _of_kind(backups, "tables")
        if tables is not None:
            rest_time_motor(axis)
            stand_at_zero(axis)
            done.append(recovery.rollback(axis.link, context, tables))
            release_time_motor(axis)
    if not done:
        raise ConfigError(
            f"There is no backup in {journal}.",
            code="PC-DEP-020",
            hint="Name the folder of the upload with --journal.",
        )
    return {
        "verdict": ControllerState.OLD.value,
        "parts": [part.as_dict() for part in done],
        "summary": "; ".join(note for part in done for note in part.notes) or "the old law is back",
    }


def _last_backups(context: Context) -> list[Path]:
    """Backups of the last upload that the journal folder notes.

    Raises
    ------
    ForeignChange
        The last upload went to another controller.
    """
    note = context.store / LAST_UPLOAD
    if not note.is_file():
        return sorted(context.store.glob("*.json"), key=lambda path: path.stat().st_mtime_ns)
    last = json.loads(note.read_text(encoding="utf-8"))
    if last["controller"] != context.controller:
        raise ForeignChange(
            "The last upload in this journal went to another controller.",
            code="PC-DEP-021",
            hint="Name the journal folder of this controller's upload with --journal.",
            left=ControllerState.OLD,
        )
    return [context.store / Path(name).name for name in last["backups"]]


def _of_kind(backups: list[Path], kind: str) -> Path | None:
    found = [path for path in backups if path.name.endswith(f".{kind}.json")]
    return found[-1] if found else None
