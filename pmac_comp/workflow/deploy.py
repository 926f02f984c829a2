"""From a compensation file to the controller and back: compute, compare, upload, take away.

What lives here: the order in which the parts of a route go onto the card, and the words for
people. What may not: the transactions themselves (``machine.controller``), the fit (``physics``).
"""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.atomic import atomic_write_text
from pmac_comp.base.errors import (
    ConfigError,
    ControllerState,
    ForeignChange,
    PmacCompError,
    SafetyRefusal,
    VerifyMismatch,
)
from pmac_comp.base.units import MM_PER_M, UM_PER_M, US_PER_S
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import read_capture
from pmac_comp.machine.controller import law_upload, motors, recovery
from pmac_comp.machine.controller.comp_table import CompTable, TableKind
from pmac_comp.machine.controller.law_bank import LawBlock, LawParameters
from pmac_comp.machine.controller.program_upload import rollback_program
from pmac_comp.machine.controller.sign_check import SignResult, check_master_sign
from pmac_comp.machine.controller.table_set import read_tables
from pmac_comp.machine.controller.transaction import Context, UploadResult
from pmac_comp.machine.controller.upload import TableUpload, UploadPlan
from pmac_comp.machine.controller.variables import verify_many
from pmac_comp.physics.compensate.design import design_law, model_loop
from pmac_comp.physics.compensate.exact import Learning, exact_correction
from pmac_comp.physics.compensate.law import CompensationLaw, coefficient_names, evaluate_law
from pmac_comp.physics.compensate.lead import LeadMap, lead_map
from pmac_comp.physics.compensate.trim import trimmed_law
from pmac_comp.workflow.axis import Axis
from pmac_comp.workflow.cam import (
    CAM_PROGRAM,
    deploy_program,
    release_time_motor,
    render_cam,
    rest_time_motor,
    tables_of,
)
from pmac_comp.workflow.compensation_file import (
    Compensation,
    check_route,
    read_compensation,
    write_compensation,
)
from pmac_comp.workflow.motions import Motion
from pmac_comp.workflow.rendering import law_parameters
from pmac_comp.workflow.session import open_axis

Progress = Callable[[str, float], None]
DEFAULT_JOURNAL = "pmac-comp-journal"
_LAST_UPLOAD = "last_upload.json"
LATENCY_CYCLES = {"law": 1, "servo": 0, "table": 0, "cam": 0, "program": 0}
_TORQUE_ROUTES = ("law", "servo")
_CHEAP_SHARE = 0.25
_SIGN_OFFSETS_um = (20.0, 50.0, 100.0)
_NOT_MOVED = "PC-SGN-005"


# Computing ----------------------------------------------------------------------------------------


def compute_compensation(
    bench: Bench,
    model: Any,
    *,
    route: str,
    slow: tuple[Any, ...] = (),
    captures: tuple[Any, ...] = (),
    motion: Motion | None = None,
    provenance: dict[str, Any] | None = None,
    progress: Progress | None = None,
) -> Compensation:
    """Law and lead map of a model and slow runs for a route.

    ``cam`` is for one ``motion``. With ``captures`` (relaxed runs without
    compensation) the law's offset terms are corrected by what the model leaves of them.
    """
    check_route(route)
    law = design_law(
        bench,
        model_loop(model),
        latency_cycles=LATENCY_CYCLES[route],
        with_torque=route in _TORQUE_ROUTES,
        provenance=provenance,
        progress=progress,
    )
    # The lead runs are read without torque and without lead time: only the static part counts.
    lead = lead_map(slow, law.with_values(lead_s=0.0, lead2_s2=0.0)) if slow else None
    if motion is not None and route == "cam":
        exact = _exact(bench, model, motion.position_m)
        return Compensation(
            route,
            law,
            lead,
            motion_time_s=motion.trajectory.time_s,
            motion_position_m=motion.position_m,
            motion_correction_m=exact.correction_m,
        )
    if captures:
        trimmed, explained = trimmed_law(law, model_loop(model), captures, lead)
        trim = {
            name: getattr(trimmed, name) - getattr(law, name)
            for name in coefficient_names()
            if getattr(trimmed, name) != getattr(law, name)
        }
        provenance = {**law.provenance, "trim": trim, "trim_explained": explained}
        law = replace(trimmed, provenance=provenance)
    return Compensation(route, law, lead)


def compensate_files(
    bench: str,
    model: Path,
    out: Path,
    *,
    route: str,
    slow: tuple[Path, ...] = (),
    command: Path | None = None,
    clip: bool = False,
    effects: Path | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Compute a compensation from files and describe it."""
    from pmac_comp.workflow.identification import load_model

    loaded = load_bench(bench)
    drive = load_model(model, loaded, effects=effects)
    if route in {"cam", "program"}:
        return _compensate_motion(loaded, drive, out, route, command)
    captures = tuple(read_capture(path) for path in slow)
    provenance = {
        "bench_digest": loaded.digest,
        "model": model.name,
        "effects": list(drive.effects),
    }
    compensation = compute_compensation(
        loaded, drive, route=route, slow=captures, provenance=provenance, progress=progress
    )
    cuts = _limits_report(loaded, compensation.law)
    if cuts and not clip:
        from pmac_comp.base.errors import AmplitudeExceeded

        raise AmplitudeExceeded(
            "The correction passes the limits: " + "; ".join(cuts) + ".",
            code="PC-DEP-010",
            hint="Check the model, raise [safety] max_correction_um, or use --limit to clip.",
        )
    write_compensation(out, compensation)
    return {
        "route": route,
        "file": out,
        "summary": describe(loaded, compensation),
        "remarks": [*cuts, *cost_remarks(loaded, route)],
        "law": compensation.law.as_mapping(),
    }


def _exact(bench: Bench, model: Any, position_m: FloatArray) -> Learning:
    limit = bench.safety.max_correction_um / UM_PER_M
    return exact_correction(model_loop(model), position_m, bench.servo_period_s, limit_m=limit)


def _compensate_motion(
    bench: Bench, drive: Any, out: Path, route: str, command: Path | None
) -> dict[str, Any]:
    from pmac_comp.workflow.commands import read_command

    if command is None:
        raise ConfigError(
            f"The route {route} needs the motion it is for.",
            code="PC-DEP-011",
            hint="Give it with --command FILE (CSV with time_s,commanded_position_mm).",
        )
    time_s, position = read_command(command)
    exact = _exact(bench, drive, position)
    law = design_law(bench, model_loop(drive), latency_cycles=0, with_torque=False)
    compensation = Compensation(
        route,
        law,
        None,
        motion_time_s=time_s,
        motion_position_m=position,
        motion_correction_m=exact.correction_m,
    )
    write_compensation(out, compensation)
    summary = {
        "route": route,
        "motion": f"{time_s[-1] - time_s[0]:.3f} s, {position.size} samples",
        "largest correction um": float(np.max(np.abs(exact.correction_m)) * UM_PER_M),
        "total error before um rms": exact.history_um[0],
        "total error after um rms (model)": exact.history_um[-1],
        "passes": len(exact.history_um) - 1,
    }
    limit_um = bench.safety.max_correction_um
    cut = float(np.mean(np.abs(exact.correction_m) * UM_PER_M > 0.999 * limit_um))
    remarks = [f"{100.0 * cut:.1f} % of the motion is cut at max_correction_um = {limit_um:g} um"]
    return {
        "route": route,
        "file": out,
        "summary": summary,
        "remarks": remarks if cut else [],
        "law": None,
    }


def describe(bench: Bench, compensation: Compensation) -> dict[str, Any]:
    """Figures of a compensation for people."""
    law = compensation.law
    out: dict[str, Any] = {
        "route": compensation.route,
        "per acceleration um/(m/s2)": law.inertia_s2 * UM_PER_M,
        "per speed um/(m/s)": law.viscous_s * UM_PER_M,
        "friction um (each side)": law.coulomb_m * UM_PER_M,
        "change along the travel %/m": 100.0
        * law.inertia_per_m_s2_per_m
        / max(abs(law.inertia_s2), 1e-12),
        "largest correction um": largest_correction_um(law),
        "clamp um": law.amplitude_limit_m * UM_PER_M,
        "valid to m/s": law.valid_speed_m_per_s,
        "valid to m/s2": law.valid_acceleration_m_per_s2,
    }
    explained = law.provenance.get("trim_explained", 0.0)
    if explained:
        out["corrected by the captures, share of the rest explained %"] = 100.0 * explained
    if compensation.route in _TORQUE_ROUTES:
        out["friction torque Nm"] = law.torque_coulomb_Nm
        out["torque lead ms"] = law.torque_lead_s * 1e3
    rendered = compensation.table(bench)
    if compensation.lead is not None and rendered is not None:
        out |= {k.replace("_", " "): v for k, v in compensation.lead.summary().items()}
        out["table entries"] = len(rendered.table.entries)
        out["table rounding um"] = rendered.quantisation_um
    return out


def largest_correction_um(law: CompensationLaw) -> float:
    """Largest correction within the law's range of speeds and accelerations, um."""
    a, v = law.valid_acceleration_m_per_s2, law.valid_speed_m_per_s
    return UM_PER_M * (abs(law.inertia_s2) * a + abs(law.viscous_s) * v + abs(law.coulomb_m))


def _limits_report(bench: Bench, law: CompensationLaw) -> list[str]:
    limit = bench.safety.max_correction_um
    largest = largest_correction_um(law)
    if largest <= limit:
        return []
    return [
        f"at {law.valid_acceleration_m_per_s2:.3g} m/s2 the correction would be {largest:.1f} um, "
        f"the limit is {limit:g} um; it is clipped there"
    ]


def cost_remarks(bench: Bench, route: str) -> list[str]:
    """What the route costs on the card's processor, and the way out where that is much."""
    if route != "law":
        return []
    cost = law_upload.law_cost_us(bench.controller.cpu_clock_MHz)
    period = bench.servo_period_s * US_PER_S
    share = cost / period
    text = (
        f"PLC 0 takes about {cost:.0f} us of each {period:.0f} us servo period "
        f"({100 * share:.0f} %) at {bench.controller.cpu_clock_MHz:g} MHz"
    )
    if share <= _CHEAP_SHARE:
        return [text]
    return [
        text + ": more than a quarter. Run it every second cycle (I8 = 1; the law allows for "
        "it), or use --route servo, whose compiled form costs about a tenth"
    ]


# On the controller --------------------------------------------------------------------------------


def context_of(axis: Axis, store: Path | None = None, progress: Progress | None = None) -> Context:
    """Limits, folder and names for changes of an axis; without a folder only for looking."""
    if store is not None:
        store.mkdir(parents=True, exist_ok=True)

    def told(step: str, done: int, total: int) -> None:
        if progress is not None:
            progress(step, done / max(total, 1))

    return Context(
        block=LawBlock.from_p_block(axis.bench.controller.p_block),
        limits=axis.scales.limits(axis.bench),
        store=store or Path(DEFAULT_JOURNAL),
        servo_period_s=axis.scales.period_s,
        controller=axis.identity or "controller",
        progress=told,
    )


@dataclass(frozen=True)
class Deployment:
    """What an upload of a compensation did, part by part."""

    verdict: ControllerState
    parts: tuple[UploadResult, ...]
    notes: tuple[str, ...] = ()

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

    The lead table goes first, then the law into the idle bank; the gain ramps up at the end.
    """
    with _one_upload(context):
        return _deploy_parts(axis, compensation, context)


@contextmanager
def _one_upload(context: Context) -> Iterator[None]:
    """Note which backups belong to this upload, so that ``rollback`` takes back it alone."""
    before = set(context.store.glob("*.json"))
    try:
        yield
    finally:
        made = sorted(path.name for path in set(context.store.glob("*.json")) - before)
        if made:
            last = {"controller": context.controller, "backups": made}
            atomic_write_text(context.store / _LAST_UPLOAD, json.dumps(last, indent=2) + "\n")


def _deploy_parts(axis: Axis, compensation: Compensation, context: Context) -> Deployment:
    parts: list[UploadResult] = []
    notes: list[str] = []
    tables = tables_of(compensation, axis.bench)
    if compensation.route == "cam":
        parts.append(_deploy_cam(axis, compensation, context, tables))
        notes.append(
            f"the motion is PROG {CAM_PROGRAM}; motor #{axis.bench.controller.cam_motor_number} "
            "counts its time"
        )
    elif tables:
        stand_at_zero(axis)
        with TableUpload(axis.link, context, tables) as upload:
            upload.prepare()
            parts.append(upload.execute())
    if compensation.route == "law":
        notes += law_upload.install_law(axis.link, context, axis.motor)
        notes += _checked_sign(axis, context)
    if compensation.route == "servo":
        law_upload.require_open_servo(axis.link, context, axis.motor)
    if compensation.route in _TORQUE_ROUTES:
        parameters = law_parameters(compensation.law, axis.scales)
        # The same length through two roundings must not pass the limit by a bit.
        clamp = min(
            compensation.law.amplitude_limit_m / axis.scales.motor_m_per_ct,
            context.limits.max_correction_ct,
        )
        parts.append(law_upload.upload_law(axis.link, context, parameters, clamp_ct=clamp))
        if motors.read_motor(axis.link, axis.motor).status.is_closed_loop:
            law_upload.arm(axis.link, context)
            notes.append("the law is armed; its gain ramped up")
        else:
            notes.append("the law is loaded and disarmed: the loop is open")
    if compensation.route == "program":
        from pmac_comp.workflow.repeated import deploy_motion

        parts.append(deploy_motion(axis, compensation, context))
    return Deployment(ControllerState.NEW, tuple(parts), tuple(notes))


def _deploy_cam(
    axis: Axis, compensation: Compensation, context: Context, tables: tuple[CompTable, ...]
) -> UploadResult:
    """Program with the time axis, then its table; the program goes if the table does not come."""
    stand_at_zero(axis)
    program = deploy_program(axis, render_cam(compensation, axis.bench), context)
    try:
        with TableUpload(axis.link, context, tables, route="cam") as upload:
            upload.prepare()
            return upload.execute()
    except PmacCompError as error:
        try:
            _undo_program(axis, context, program.backup)
        except PmacCompError as second:
            error.add_note(f"PROG {CAM_PROGRAM} could not be taken back: {second.message}")
        raise


def _undo_program(axis: Axis, context: Context, backup: Path | None) -> None:
    if backup is not None:
        rollback_program(axis.link, context, backup)


def _checked_sign(axis: Axis, context: Context) -> list[str]:
    """Guarded test before the law is armed: which way a positive correction moves the motor.

    Raises
    ------
    SafetyRefusal
        It moves the motor down: every correction would double the error.
    """
    head = law_upload.read_law_head(axis.link, context.block)
    status = motors.read_motor(axis.link, axis.motor).status
    if head.is_armed or not status.is_closed_loop:
        return []
    # The law writes the master word every cycle: it must stand aside while the test does.
    axis.link.command("DISABLE PLC 0")
    try:
        axis.link.clock.sleep_s(0.01)
        found = _sign_against_friction(axis)
    finally:
        axis.link.command("ENABLE PLC 0")
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
    for offset_um in _SIGN_OFFSETS_um[:-1]:
        try:
            return check_master_sign(axis.link, axis.motor, offset_ct=_offset_ct(axis, offset_um))
        except PmacCompError as error:
            if error.code != _NOT_MOVED:
                raise
    return check_master_sign(
        axis.link, axis.motor, offset_ct=_offset_ct(axis, _SIGN_OFFSETS_um[-1])
    )


def _offset_ct(axis: Axis, offset_um: float) -> float:
    return float(round(offset_um / UM_PER_M / axis.scales.motor_m_per_ct))


def stand_at_zero(axis: Axis) -> None:
    """Move a closed loop to the motor's zero, where every table corrects nothing: no step."""
    reading = motors.read_motor(axis.link, axis.motor)
    if reading.status.is_closed_loop and abs(reading.position_ct) > 1.0:
        motors.move_to(axis.link, axis.motor, 0.0)
        axis.link.clock.sleep_s(0.3)


def switch(axis: Axis, context: Context, compensation: Compensation, *, on: bool) -> None:
    """Compensation on or off for a comparison, without a step: at zero, the law by its ramp.

    Raises
    ------
    VerifyMismatch
        The switch does not read back.
    """
    stand_at_zero(axis)
    if compensation.route in _TORQUE_ROUTES:
        if on:
            law_upload.arm(axis.link, context)
        else:
            law_upload.disarm(axis.link, context)
    if compensation.lead is not None or compensation.route == "cam":
        axis.link.command(f"I51={int(on)}")
        verify_many(axis.link, {"I51": int(on)})


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
        if compensation.route in _TORQUE_ROUTES:
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
    note = context.store / _LAST_UPLOAD
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


def difference(url: str, bench: str, new: Path) -> dict[str, Any]:
    """Old against new on the controller, as rows and as curves over position."""
    compensation = read_compensation(new)
    with open_axis(url, bench) as axis:
        context = context_of(axis)
        tables = read_tables(axis.link, [(TableKind.COMP, axis.motor)])
        head = law_upload.read_law_head(axis.link, context.block)
        bank = law_upload.read_bank(axis.link, context.block, head.bank)
        position, old_um, new_um = _table_curves(axis, compensation, list(tables))
        rows: list[tuple[Any, ...]] = [
            ("table entries", sum(len(t.entries) for t in tables), _entries(compensation, axis), "")
        ]
        if compensation.route in _TORQUE_ROUTES:
            rows += _law_rows(bank, law_parameters(compensation.law, axis.scales))
    return {
        "rows": rows,
        "position_mm": position * MM_PER_M,
        "old_um": old_um,
        "new_um": new_um,
        "largest_change_um": float(np.max(np.abs(new_um - old_um))) if position.size else 0.0,
    }


def _entries(compensation: Compensation, axis: Axis) -> int:
    rendered = compensation.table(axis.bench)
    return 0 if rendered is None else len(rendered.table.entries)


def _table_curves(
    axis: Axis, compensation: Compensation, tables: list[Any]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    travel = axis.bench.travel
    position = np.linspace(travel.min_mm, travel.max_mm, 1201) / MM_PER_M
    counts = position / axis.scales.motor_m_per_ct
    to_um = axis.scales.motor_m_per_ct * UM_PER_M
    old = np.zeros(position.size)
    for table in tables:
        if hasattr(table, "correction_ct"):
            old += table.correction_ct(counts) * to_um
    correction = compensation.table_correction(axis.bench)
    new = np.zeros(position.size) if correction is None else correction(position) * UM_PER_M
    return position, old, new


def _law_rows(old: LawParameters | None, new: LawParameters) -> list[tuple[Any, ...]]:
    units = {
        "A0": "ct/(ct/SC2)", "V0": "ct/(ct/SC)", "S0": "ct", "D1": "SC",
        "TC": "DAC units", "TK": "DAC/(ct/SC3)", "TL": "SC",
    }  # fmt: skip
    return [
        (name, None if old is None else getattr(old, name), getattr(new, name), unit)
        for name, unit in units.items()
    ]


def check_law_on_card(
    axis: Axis, context: Context, compensation: Compensation, position_m: FloatArray
) -> float:
    """Largest difference in um between the law on the host and a card's own arithmetic.

    Raises
    ------
    VerifyMismatch
        The card holds another law.
    """
    from pmac_comp.machine.controller.law_bank import evaluate

    head = law_upload.read_law_head(axis.link, context.block)
    bank = law_upload.read_bank(axis.link, context.block, head.bank)
    wanted = law_parameters(compensation.law, axis.scales)
    if bank is None or bank.digest != wanted.digest:
        raise VerifyMismatch("The card holds another law.", code="PC-DEP-030")
    clamp = compensation.law.amplitude_limit_m / axis.scales.motor_m_per_ct
    there = evaluate(bank, position_m / axis.scales.motor_m_per_ct, clamp_ct=clamp)
    here = evaluate_law(compensation.law, position_m, axis.scales.period_s)
    gap = there.correction_ct * axis.scales.motor_m_per_ct - here.correction_m
    return float(np.max(np.abs(gap)) * UM_PER_M)


def lead_only(lead: LeadMap, law: CompensationLaw) -> Compensation:
    """Compensation of the route ``table``."""
    return Compensation("table", law, lead)
