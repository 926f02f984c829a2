"""Before and after, measured on fresh runs that alternate.

What lives here: which runs are made on a controller and in which order, and what is left of an
interrupted session. What may not: the statistics (``outcome``), what stored and fresh runs share
(``summing_up``), plots (``report``).
"""

import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from pmac_comp.base.errors import CaptureError, PmacCompError
from pmac_comp.base.progress import Progress
from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.files.resources import DEFAULT_JOURNAL
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.law.law_state import read_law_head
from pmac_comp.machine.controller.motors import motors
from pmac_comp.physics.compensate.exact import Aim
from pmac_comp.workflow.accuracy.outcome import outcome_of
from pmac_comp.workflow.accuracy.static_check import STATIC_RUNS
from pmac_comp.workflow.capture.at_work import measuring
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.capturing import borrowing_in, require_new
from pmac_comp.workflow.capture.context import context_to_look
from pmac_comp.workflow.capture.session import open_axis
from pmac_comp.workflow.capture.simulated import Truth
from pmac_comp.workflow.compensation.file import (
    Compensation,
    named_compensation,
    write_compensation,
)
from pmac_comp.workflow.compensation.program import motion_of
from pmac_comp.workflow.compensation.promises import Promiser, true_errors
from pmac_comp.workflow.controller.sign_test import check_law_sign
from pmac_comp.workflow.law.law_cost import require_time_left
from pmac_comp.workflow.law.routes import MOTION_ROUTES
from pmac_comp.workflow.model.identification import load_model
from pmac_comp.workflow.motion.campaigns import (
    positioning_motion,
    ringing_motion,
    verification_motions,
)
from pmac_comp.workflow.motion.motions import Motion, parse_motion
from pmac_comp.workflow.verification.kept_runs import RESULT, KeptRuns, earlier_runs
from pmac_comp.workflow.verification.learning import Refinement, refine_motion
from pmac_comp.workflow.verification.result import Verification
from pmac_comp.workflow.verification.runs import Runs, left_as_found, require_on_card, runs_of
from pmac_comp.workflow.verification.summing_up import (
    Pair,
    ringing_outcome,
    scale_age_of,
    static_outcome,
    summed_up,
)

if TYPE_CHECKING:
    from pmac_comp.physics.model.drive import DriveModel

_LEARNED = "learned.json"


def verify_on_controller(
    url: str,
    bench: str,
    *,
    model: Path | None = None,
    law: Path | None = None,
    motions: tuple[str, ...] = (),
    repeats: int = 2,
    static_runs: int = STATIC_RUNS,
    seed: int = 0,
    refine: int = 0,
    out: Path | None = None,
    journal: Path = DEFAULT_JOURNAL,
    progress: Progress | None = None,
) -> Verification:
    """Run motions with and without what is on the controller, and compare.

    Afterwards the compensation acts again if it acted before, and a motor that was killed is.

    Raises
    ------
    ConfigError
        No compensation file is named, so nobody knows what to switch; or the folder holds runs of
        an earlier verification.
    """
    compensation = named_compensation(law)
    if out is not None:
        require_new(earlier_runs(out), out)
    kept = KeptRuns(out)
    stated = load_bench(bench)
    chosen = [parse_motion(text, stated) for text in motions] or verification_motions(stated, seed)
    drive = None if model is None else load_model(model, stated)
    with open_axis(url, bench) as axis, measuring(borrowing_in(axis, journal), url):
        context = context_to_look(axis)
        require_on_card(axis, context, compensation)
        with (
            _told_what_is_left(kept, axis.motor, _compared(bench, law, model)),
            left_as_found(axis, context, compensation),
        ):
            measured = measured_before_arming(axis, context, compensation)
            verification = verify_axis(
                axis,
                context,
                compensation,
                chosen,
                repeats=repeats,
                static_runs=static_runs,
                drive=drive,
                keep=kept.keep,
                progress=progress,
            )
            remarks = (*verification.remarks, *measured)
            verification = replace(verification, remarks=remarks)
            if refine:
                kept.write_result(verification)  # learning takes minutes, and may be interrupted
                motion = chosen[0]
                if compensation.route in MOTION_ROUTES:
                    motion = motion_of(compensation, axis.bench)
                learned = refine_motion(axis, context, compensation, motion, refine, progress)
                kept_as = keep_learned(learned, compensation, out, url, bench)
                remarks = (*verification.remarks, *learned.lines(), kept_as)
                verification = replace(verification, remarks=remarks, learning=learned)
                if learned.learning.interrupted:
                    kept.write_result(verification)
                    raise _interruption(learned, kept_as, out)
    kept.write_result(verification)
    return verification


def _interruption(learned: Refinement, kept_as: str, out: Path | None) -> KeyboardInterrupt:
    """Ctrl-C with which learning has ended; it tells what was learned and where it is."""
    error = KeyboardInterrupt()
    for note in (*learned.lines(), kept_as):
        error.add_note(note)
    if out is not None:
        error.add_note(f"The result so far is in {out / RESULT}.")
    return error


def keep_learned(
    learned: Refinement, compensation: Compensation, out: Path | None, url: str, bench: str
) -> str:
    """Write what was learned as a compensation that can be uploaded, and say what became of it."""
    if compensation.route not in MOTION_ROUTES:
        return (
            f"what was learned is not kept: the route {compensation.route} has no place for a "
            "correction of one motion; the routes cam and program have"
        )
    found = learned.as_compensation(compensation)
    if found is None:
        better = f"with {learned.start}" if learned.is_worth_it else "without compensation"
        fresh = bool(learned.learning.confirmed_um)
        judged = "fresh runs were no better" if fresh else "none of its passes was better"
        return f"what was learned is not kept: {judged} than {better}"
    if out is None:
        return "what was learned is not kept: --out FOLDER writes it as a compensation to upload"
    path = out / _LEARNED
    stands = learned.start if learned.began_learned else "the model's own"
    write_compensation(path, found)
    lag = ""
    if compensation.aim is Aim.MECHANICAL:
        lag = " (it takes the lag of the loop away too: learning goes by the total error)"
    return (
        f"what was learned is in {path}{lag}; on the controller {stands} stands as before, and "
        f"`pmac-comp upload {shlex.quote(url)} {shlex.quote(str(path))} --bench "
        f"{shlex.quote(bench)}` puts what was learned in its place"
    )


@contextmanager
def _told_what_is_left(kept: KeptRuns, motor: int, compared: str) -> Iterator[None]:
    """Errors that say which runs were kept and that no compensation was put back."""
    try:
        yield
    except (PmacCompError, KeyboardInterrupt) as error:
        error.add_note(kept.left(motor, compared))
        raise


def _compared(bench: str, law: Path | None, model: Path | None) -> str:
    """Options with which stored runs are compared as they would have been on the controller."""
    named = {"--bench": bench, "--compensation": law, "--model": model}
    return " ".join(f"{k} {shlex.quote(str(v))}" for k, v in named.items() if v is not None)


def measured_before_arming(axis: Axis, context: Context, compensation: Compensation) -> list[str]:
    """Sign and load of a law that was loaded with the loop open, before it is armed."""
    if compensation.route != "law":
        return []
    if motors.read_motor(axis.link, axis.motor).status.is_killed:
        axis.enable()
    if read_law_head(axis.link, context.block).is_armed:
        return []
    return [*check_law_sign(axis, context), require_time_left(axis.link, axis.bench, "law")]


def verify_axis(
    axis: Axis,
    context: Context,
    compensation: Compensation,
    motions: Sequence[Motion],
    *,
    repeats: int = 1,
    static_runs: int = 0,
    drive: "DriveModel | None" = None,
    truth: Callable[[], Truth | None] | None = None,
    keep: Callable[[Capture], None] | None = None,
    progress: Progress | None = None,
) -> Verification:
    """Fresh runs before and after, alternating so that drift does not count as gain.

    Parameters
    ----------
    axis, context, compensation
        What is on the controller.
    motions : sequence of Motion
        What to run; ``cam`` and ``program`` know their own one motion only.
    repeats : int
        Pairs of runs of each motion.
    static_runs : int
        Runs of the positioning test on each side, 0 for none (ISO 230-2 wants 5).
    drive : DriveModel or None
        Model that promises.
    truth : callable or None
        True positions of a simulated plant.
    keep : callable, optional
        Called with each run when it is gathered.
    progress : callable, optional
        Called with a step and a fraction.
    """
    runs = runs_of(axis, context, compensation, motions)
    for motion in runs.motions:  # all of them before the first one moves the axis
        axis.require_room(motion)
    static = positioning_motion(axis.bench) if static_runs and runs.is_free else None
    rings = ringing_motion(axis.bench) if runs.is_free else None
    (static, rings), left_out = _with_room(axis, (static, rings))
    wanted = [(motion, repeats) for motion in runs.motions]
    wanted += [(rings, repeats)] if rings is not None else []
    wanted += [(static, static_runs)] if static is not None else []
    pairs = list(alternating(runs, wanted, compensation.marks, progress, keep))
    found = truth() if truth is not None else None
    outcomes, groups = [], pairs[: len(runs.motions)]
    correction = compensation.table_correction(axis.bench)
    promiser = Promiser.of(axis.bench, compensation, drive)
    for motion, (before, after) in zip(runs.motions, groups, strict=True):
        outcomes.append(
            outcome_of(
                motion.name,
                before,
                after,
                lead=compensation.lead,
                table_correction=correction,
                scale_age_s=scale_age_of(compensation),
                promise=None if promiser is None else promiser.of_run(after[0]),
                truth=true_errors(found, before, after, compensation, correction),
            )
        )
    rest = pairs[len(runs.motions) :]
    return summed_up(
        outcomes,
        groups,
        axis.bench,
        compensation,
        simulated=axis.simulated or truth is not None,
        ringing=None if rings is None else ringing_outcome(axis.bench, rest.pop(0)),
        static=None if static is None else static_outcome(rest.pop(0)),
        remarks=(*runs.remarks, *left_out),
    )


def _with_room(
    axis: Axis, own: Sequence[Motion | None]
) -> tuple[list[Motion | None], tuple[str, ...]]:
    """Motions of the verification's own that the controller can gather, and what is left out."""
    kept: list[Motion | None] = []
    remarks: list[str] = []
    for motion in own:
        try:
            if motion is not None:
                axis.require_room(motion)
            kept.append(motion)
        except CaptureError as error:
            kept.append(None)
            remarks.append(f"not measured: {error.message}")
    return kept, tuple(remarks)


def alternating(
    runs: Runs,
    wanted: Sequence[tuple[Motion, int]],
    marks: Mapping[str, str],
    progress: Progress | None,
    keep: Callable[[Capture], None] | None = None,
) -> Iterator[Pair]:
    """Captures without and with compensation of each motion, pair by pair; marks on the latter."""
    total, done = sum(2 * n for _, n in wanted), 0
    for motion, repeats in wanted:
        sides: Pair = ([], [])
        for pair in range(repeats):
            # The order changes from pair to pair: a drift over time falls on both alike.
            for on in (False, True) if pair % 2 == 0 else (True, False):
                done += 1
                if progress is not None:
                    side_text = "with" if on else "without"
                    progress(f"run {done} of {total}: {motion.name}, {side_text}", -1.0)
                capture = runs.run(motion, on=on)
                side = {"compensation": "on", **marks} if on else {"compensation": "off"}
                capture = capture.with_attributes(**side)
                if keep is not None:
                    keep(capture)
                sides[on].append(capture)
        yield sides
