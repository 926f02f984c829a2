"""What a command would do on a controller, told without doing it (``--dry-run``).

What lives here: the motions that would run, and what stands or was left open. What may not:
anything that writes to a controller or a journal.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pmac_comp.base.errors import ConfigError
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.machine.controller.change.alike import left_open_alike
from pmac_comp.machine.controller.change.manifest import Action
from pmac_comp.machine.controller.tables.table_recovery import last_upload
from pmac_comp.machine.controller.tables.table_status import table_status
from pmac_comp.machine.controller.whole import recovery, rollback, waiting
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import context_to_look
from pmac_comp.workflow.capture.session import open_axis
from pmac_comp.workflow.compensation.file import Compensation
from pmac_comp.workflow.compensation.program import motion_of
from pmac_comp.workflow.controller.standing import standing_lines
from pmac_comp.workflow.controller.upload_flow import tables_coming_back
from pmac_comp.workflow.improve import require_many_motions
from pmac_comp.workflow.law.routes import MOTION_ROUTES
from pmac_comp.workflow.motion.campaigns import (
    calibration_motions,
    lead_motions,
    positioning_motion,
    require_scale,
    ringing_motion,
    verification_motions,
)
from pmac_comp.workflow.motion.motions import Motion, parse_motion, time_needed
from pmac_comp.workflow.verification.runs import require_on_card

MOTION_COLUMNS = ("what for", "runs", "name", "duration s", "from mm", "to mm", "peak mm/s", "m/s2")


@dataclass(frozen=True)
class RunsPreview:
    """Motions that a command would run.

    Parameters
    ----------
    runs : tuple of (str, int, Motion)
        What for, how many runs, and the motion.
    remarks : tuple of str
        What happens around them.
    """

    runs: tuple[tuple[str, int, Motion], ...]
    remarks: tuple[str, ...]

    def rows(self) -> list[tuple[Any, ...]]:
        """Rows under ``MOTION_COLUMNS``."""
        return [(what, n, *motion.row()) for what, n, motion in self.runs]

    def lines(self) -> list[str]:
        """Time that the session takes, and the remarks."""
        return [time_needed([(n, motion) for _, n, motion in self.runs]), *self.remarks]

    def as_result(self) -> dict[str, Any]:
        """Mapping for ``--json``."""
        names = ("for", "runs", "name", "duration_s", "from_mm", "to_mm", "peak_mm_per_s",
                 "peak_m_per_s2")  # fmt: skip
        motions = [dict(zip(names, row, strict=True)) for row in self.rows()]
        return {"would_run": motions, "remarks": list(self.remarks)}


def preview_verification(
    bench: str,
    compensation: Compensation,
    *,
    motions: Sequence[str] = (),
    repeats: int,
    static_runs: int,
    seed: int,
    refine: int = 0,
) -> RunsPreview:
    """What ``verify`` would run on a controller with these options.

    Raises
    ------
    ConfigError
        A motion is asked of a compensation that is for its own one only.
    """
    if motions and compensation.route in MOTION_ROUTES:
        raise ConfigError(
            f"The route {compensation.route} is for one known motion: --motion has no other to "
            "run.",
            code="PC-VER-006",
            hint="Leave --motion out, or compute a compensation for this motion: "
            f"`pmac-comp compensate --bench FILE --model FILE --route {compensation.route} "
            "--command MOTION`.",
        )
    loaded = load_bench(bench)
    chosen = [parse_motion(text, loaded) for text in motions]
    chosen = chosen or verification_motions(loaded, seed)
    runs = _verification(loaded, compensation, chosen, repeats, static_runs)
    remarks = ["runs without and with the compensation take turns; afterwards it is as it was"]
    if refine:
        remarks.append(f"then {refine} learning pass(es) on the repeated motion")
    return RunsPreview(tuple(runs), tuple(remarks))


def require_standing(url: str, bench: str, compensation: Compensation) -> None:
    """Refuse a rehearsal of a verification that would be refused; the controller is only read.

    Raises
    ------
    VerifyMismatch
        The controller does not hold the compensation.
    """
    with open_axis(url, bench) as axis:
        require_on_card(axis, context_to_look(axis), compensation)


def _verification(
    bench: Bench,
    compensation: Compensation,
    motions: Sequence[Motion],
    repeats: int,
    static_runs: int,
) -> list[tuple[str, int, Motion]]:
    if compensation.route in MOTION_ROUTES:
        return [("verification", 2 * repeats, motion_of(compensation, bench))]
    runs = [("verification", 2 * repeats, motion) for motion in motions]
    runs.append(("ringing", 2 * repeats, ringing_motion(bench)))
    if static_runs:
        runs.append(("ISO 230-2", 2 * static_runs, positioning_motion(bench)))
    return runs


def preview_improvement(bench: str, *, route: str, seed: int) -> RunsPreview:
    """What ``improve`` would run: calibration, then a verification for each of two models."""
    require_many_motions(route)
    loaded = load_bench(bench)
    require_scale(loaded, "an improvement")
    runs = [("calibration", 1, motion) for motion in calibration_motions(loaded)]
    runs += [("lead error", 1, motion) for motion in lead_motions(loaded)]
    verified = [*verification_motions(loaded, seed), ringing_motion(loaded)]
    runs += [("verification of both models", 4, motion) for motion in verified]
    remarks = (
        f"the first model's compensation is computed, uploaded (route {route}) and verified",
        "what diagnose names is added; the grown model's takes its place and is verified",
        "where it is no better, the first one is put back",
    )
    return RunsPreview(tuple(runs), remarks)


def preview_recovery(url: str, bench: str, journal: Path) -> dict[str, Any]:
    """What ``recover`` would settle; the controller and the journal are only read."""
    with open_axis(url, bench) as axis:
        return what_is_open(axis, journal)


def what_is_open(axis: Axis, journal: Path) -> dict[str, Any]:
    """Changes of a folder that were left open, and how the tables stand."""
    context = context_to_look(axis, journal)
    decision = table_status(axis.link, context).decision
    found = waiting.left_open(context)
    off = ""
    ours = not found and last_upload(context) and not waiting.number_since_ours(axis.link, context)
    if ours and decision.action is Action.RESUME:
        off = "its tables are switched off and would act again"
    nothing = "; ".join(filter(None, ("nothing was left open", off, left_open_alike(context))))
    refusals = recovery.recovery_refusals(axis.link, context)
    return {
        "would_settle": list(found),
        "refusals": [refusal.message for refusal in refusals],
        "tables": f"{decision.state.value}: {decision.reason}",
        "summary": "; ".join(found) or nothing,
    }


def preview_rollback(url: str, bench: str, journal: Path) -> dict[str, Any]:
    """What ``rollback`` would take back; the controller and the journal are only read."""
    with open_axis(url, bench) as axis:
        return what_was_uploaded(axis, journal)


def what_was_uploaded(axis: Axis, journal: Path) -> dict[str, Any]:
    """The last upload of a folder and its parts that still stand, and what moves for it.

    Raises
    ------
    ConfigError
        There is no upload to take back.
    MotorNotSafe
        There is no place where its tables could be switched without a step.
    """
    context = context_to_look(axis, journal)
    group, parts = rollback.upload_to_take_back(context)
    refusals = rollback.rollback_refusals(axis.link, context, group)
    begin = group.first()
    name = "" if begin is None else str(begin.data.get("name", ""))
    kinds = [part.kind.value for part in parts]
    return {
        "would_take_back": kinds,
        "refusals": [refusal.message for refusal in refusals],
        "motion": standing_lines(axis, tables_coming_back(axis, context)),
        "journal": str(group.path),
        "summary": f"the upload ({name}) in {group.path.name}: "
        + (", ".join(dict.fromkeys(kinds)) or "none of its parts was begun"),
    }
