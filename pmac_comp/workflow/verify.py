"""Before and after: measured on fresh runs, alternating, or read from stored captures.

What lives here: which runs are made, in which order, and what belongs together. What may not: the
statistics (``outcome``), plots (``report``).
"""

import math
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from pmac_comp.base.atomic import atomic_write_text
from pmac_comp.base.documents import document
from pmac_comp.base.errors import ConfigError, PmacCompError
from pmac_comp.base.progress import Progress
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import PREDICTED, Capture, predicted_remarks, write_capture
from pmac_comp.files.resources import DEFAULT_JOURNAL
from pmac_comp.machine.controller import motors
from pmac_comp.machine.controller.context import Context
from pmac_comp.machine.controller.law_state import read_law_head
from pmac_comp.physics.compensate.exact import Aim
from pmac_comp.physics.identify.plausibility import require_positions
from pmac_comp.workflow.at_work import measuring
from pmac_comp.workflow.axis import Axis
from pmac_comp.workflow.calibrate import borrowing_in, require_new
from pmac_comp.workflow.campaigns import positioning_motion, ringing_motion, verification_motions
from pmac_comp.workflow.compensation_file import (
    Compensation,
    check_acted,
    edited_remarks,
    named_compensation,
    read_compensation,
    write_compensation,
)
from pmac_comp.workflow.deploy import context_to_look
from pmac_comp.workflow.identification import load_model
from pmac_comp.workflow.late_scale import scale_age_s, scale_remarks
from pmac_comp.workflow.law_cost import require_time_left
from pmac_comp.workflow.motions import Motion, parse_motion
from pmac_comp.workflow.outcome import (
    MotionOutcome,
    Ratio,
    error_signals,
    outcome_of,
    sensor_floor_um,
)
from pmac_comp.workflow.own_ringing import own_ringing_remarks
from pmac_comp.workflow.program import motion_of
from pmac_comp.workflow.promises import Promiser, true_errors
from pmac_comp.workflow.repeated import Refinement, learned_remarks, refine_motion
from pmac_comp.workflow.ringing import RingingOutcome, is_ringing, ringing_of
from pmac_comp.workflow.routes import MOTION_ROUTES
from pmac_comp.workflow.runs import Runs, left_as_found, require_on_card, runs_of
from pmac_comp.workflow.same_axis import (
    captures_of,
    check_one_motion,
    check_side_marks,
    check_two_sides,
)
from pmac_comp.workflow.session import open_axis
from pmac_comp.workflow.sign_test import check_law_sign
from pmac_comp.workflow.simulated import Truth
from pmac_comp.workflow.static_check import STATIC_RUNS, StaticOutcome, approaches, is_static
from pmac_comp.workflow.verification import Verification, static_remarks, verdict_remarks

_RESULT = "verification.json"
_LEARNED = "learned.json"
_NO_FILE = (
    "no compensation file was named: the lead error is still in the mechanical error before, and "
    "nothing is promised; --compensation FILE takes it out, --model FILE beside it promises"
)
Pair = tuple[list[Capture], list[Capture]]


def verify_files(
    bench: str,
    before: Sequence[Path],
    after: Sequence[Path],
    *,
    model: Path | None = None,
    law: Path | None = None,
) -> Verification:
    """Verification of stored captures; pairs are formed by motion, else by order.

    Raises
    ------
    ConfigError
        Captures are of another axis or had another compensation or none, cannot be paired, are on
        both sides, or a pair is of two motions.
    CaptureError
        Command, motor and table of a capture are no positions of one axis.
    """
    loaded = load_bench(bench)
    check_two_sides(before, after)
    sides = [captures_of(before, loaded), captures_of(after, loaded)]
    for path, capture in zip([*before, *after], [*sides[0], *sides[1]], strict=True):
        require_positions(capture, loaded, path.name)
    check_side_marks(*(_by_name(*side) for side in zip((before, after), sides, strict=True)))
    sides[1] = [capture.with_attributes(compensation="on") for capture in sides[1]]
    compensation = None if law is None else read_compensation(law)
    runs = _by_name(after, sides[1])
    told = check_acted(runs, compensation, str(law), loaded)
    remarks = (
        *predicted_remarks([*sides[0], *sides[1]]),
        *told,
        *_unknown_remarks(runs),
        *([_NO_FILE] if law is None else []),
    )
    static, ringing = _special(loaded, sides)
    first, second = ([c for c in side if not _is_special(c)] for side in sides)
    if not first and not second and (static is not None or ringing is not None):
        groups: dict[str, Pair] = {}
    else:
        groups = _paired(first, second)
        for name, pair in groups.items():
            check_one_motion(name, [*pair[0], *pair[1]])
    drive = None if model is None else load_model(model, loaded)
    promiser = Promiser.of(loaded, compensation, drive)
    outcomes = [
        outcome_of(
            name,
            a,
            b,
            lead=compensation.lead if compensation else None,
            table_correction=compensation.table_correction(loaded) if compensation else None,
            scale_age_s=_age_s(compensation),
            promise=_promise_of(promiser, b[0]),
        )
        for name, (a, b) in groups.items()
    ]
    return summed_up(
        outcomes,
        list(groups.values()),
        loaded,
        compensation,
        simulated=any(_is_simulated(capture) for side in sides for capture in side),
        ringing=ringing,
        static=static,
        remarks=remarks,
    )


def _by_name(paths: Sequence[Path], captures: Sequence[Capture]) -> dict[str, Capture]:
    return {str(path): capture for path, capture in zip(paths, captures, strict=True)}


def _promise_of(promiser: Promiser | None, after: Capture) -> Mapping[str, float] | None:
    """Promise for a stored run; one of a known motion goes by the command that was drawn."""
    drawn = promiser is not None and promiser.compensation.route in MOTION_ROUTES
    if promiser is None or (drawn and not after.tells_desired):
        return None
    return promiser.of_run(after)


def _unknown_remarks(runs: Mapping[str, Capture]) -> tuple[str, ...]:
    """That runs with compensation do not tell what it added."""
    silent = [Path(name).name for name, run in runs.items() if not run.tells_desired]
    if not silent:
        return ()
    return (
        f"{len(silent)} of {len(runs)} runs with it have no column desired_position_mm "
        f"({', '.join(silent[:3])}{', ...' if silent[3:] else ''}), so what the compensation added "
        "is not known: of their motions e_r and e_c cannot be told, only the total error is judged",
    )


def _is_special(capture: Capture) -> bool:
    return is_static(capture) or is_ringing(capture)


def _is_simulated(capture: Capture) -> bool:
    source = str(capture.attributes.get("source", ""))
    return "simulated" in source or source == PREDICTED


def _special(
    bench: Bench, sides: Sequence[Sequence[Capture]]
) -> tuple[StaticOutcome | None, RingingOutcome | None]:
    """Positioning and ringing where the stored captures hold their motions."""
    static = _static(([c for c in sides[0] if is_static(c)], [c for c in sides[1] if is_static(c)]))
    rings = [[c for c in side if is_ringing(c)] for side in sides]
    ringing = _ringing(bench, (rings[0], rings[1])) if all(rings) else None
    return static, ringing


def _paired(before: Sequence[Capture], after: Sequence[Capture]) -> dict[str, Pair]:
    groups: dict[str, Pair] = {}
    names = [str(c.attributes.get("motion", "")) for c in [*before, *after]]
    if all(names):
        for side, captures in enumerate((before, after)):
            for capture in captures:
                name = str(capture.attributes["motion"])
                groups.setdefault(name, ([], []))[side].append(capture)
        whole = {name: pair for name, pair in groups.items() if pair[0] and pair[1]}
        if whole:
            return whole
    if len(before) != len(after) or not before:
        raise ConfigError(
            f"{len(before)} captures before and {len(after)} after cannot be paired.",
            code="PC-VER-002",
            hint="Give the same motions on both sides, in the same order.",
        )
    return {f"run {i + 1}": ([a], [b]) for i, (a, b) in enumerate(zip(before, after, strict=True))}


class KeptRuns:
    """Runs of a verification in a folder, each written when it is gathered.

    Parameters
    ----------
    folder : Path or None
        Made if it is missing; None keeps nothing.
    """

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder
        self.names: dict[str, list[str]] = {"before": [], "after": []}
        self._counts: dict[str, int] = {}

    def keep(self, capture: Capture) -> None:
        """Write one run under its kind, side and number."""
        if self.folder is None:
            return
        side = "after" if capture.attributes.get("compensation") == "on" else "before"
        kind = "static_" if is_static(capture) else "ringing_" if is_ringing(capture) else ""
        number = self._counts.get(kind + side, 0) + 1
        self._counts[kind + side] = number
        self.folder.mkdir(parents=True, exist_ok=True)
        name = f"{kind}{side}_{number:02d}.h5"
        write_capture(self.folder / name, capture)
        self.names[side].append(name)

    def write_result(self, verification: Verification) -> None:
        """Write the result of the runs beside them; a later one takes its place."""
        if self.folder is not None:
            result = {**verification.as_result(), "files": self.names}
            atomic_write_text(self.folder / _RESULT, document(result))

    def left(self, motor: int, compared: str) -> str:
        """What an interrupted verification leaves, for people; ``compared`` are more options."""
        stands = (
            f"Tables and law are as the last run had them: `pmac-comp status` shows whether they "
            f"act and whether motor #{motor} is enabled."
        )
        n = sum(len(names) for names in self.names.values())
        if self.folder is None or n == 0:
            return f"{stands} No run was kept (--out DIR keeps each one as it is made)."
        folder = shlex.quote(str(self.folder))
        return (
            f"{stands} {n} runs are kept: `pmac-comp verify --before {folder} --after {folder} "
            f"{compared}` compares the motions that were run on both sides."
        )


# On a controller ----------------------------------------------------------------------------------


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
        require_new(_earlier_runs(out), out)
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
        error.add_note(f"The result so far is in {out / _RESULT}.")
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


def _earlier_runs(folder: Path) -> list[Path]:
    """What an earlier verification left in a folder: runs of two sessions are never mixed."""
    found = (folder.glob(pattern) for pattern in ("*before_*.h5", "*after_*.h5", _RESULT))
    return sorted(path for paths in found for path in paths)


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
    drive: Any = None,
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
    static = positioning_motion(axis.bench) if static_runs and runs.is_free else None
    rings = ringing_motion(axis.bench) if runs.is_free else None
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
                scale_age_s=_age_s(compensation),
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
        ringing=None if rings is None else _ringing(axis.bench, rest.pop(0)),
        static=None if static is None else _static(rest.pop(0)),
        remarks=runs.remarks,
    )


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


def _age_s(compensation: Compensation | None) -> float:
    """Time by which the scale is read after the encoder, as the compensation file says."""
    return 0.0 if compensation is None else scale_age_s(compensation.law.provenance)


def _ringing(bench: Bench, pair: Pair) -> RingingOutcome:
    return ringing_of(*pair, bench.known.resonance_Hz)


def _static(pair: Pair) -> StaticOutcome | None:
    before, after = (None if len(side) < 2 else approaches(side) for side in pair)
    if before is None and after is None:
        return None
    return StaticOutcome(before, after, (*pair[0], *pair[1]))


def summed_up(
    outcomes: Sequence[MotionOutcome],
    groups: Sequence[Pair],
    bench: Bench,
    compensation: Compensation | None,
    *,
    simulated: bool,
    ringing: RingingOutcome | None = None,
    static: StaticOutcome | None = None,
    remarks: Sequence[str] = (),
) -> Verification:
    """Verification of outcomes and their runs; all motions together beside each one."""
    lead = None if compensation is None else compensation.lead
    table = None if compensation is None else compensation.table_correction(bench)
    age_s = _age_s(compensation)
    first = [[error_signals(c, lead, None, age_s) for c in pair[0]] for pair in groups]
    second = [[error_signals(c, lead, table, age_s) for c in pair[1]] for pair in groups]
    told: list[str] = []
    if compensation is not None:
        told = [*scale_remarks(compensation.law), *edited_remarks(compensation)]
        told += learned_remarks(compensation)

    def together(which: str) -> Ratio | None:
        if not first or not second:
            return None
        sides = [[getattr(s, which) for run in runs for s in run] for runs in (first, second)]
        found = Ratio.of(sides[0], sides[1], bench.servo_period_s)
        return found if math.isfinite(found.value) else None

    floor = sensor_floor_um(bench)
    own = own_ringing_remarks(outcomes, first, second, floor, bench.servo_period_s)
    found = Verification(
        tuple(outcomes),
        floor,
        simulated,
        tuple(c for pair in groups for c in pair[0]),
        tuple(c for pair in groups for c in pair[1]),
        lead,
        table,
        age_s,
        route="" if compensation is None else compensation.route,
        aim=Aim.TOTAL if compensation is None else compensation.aim,
        mechanical=together("mechanical_m"),
        total=together("total_m"),
        static=static,
        ringing=ringing,
    )
    verdict = verdict_remarks(outcomes, floor, holds_lag=found.holds_lag)
    return replace(found, remarks=(*verdict, *own, *told, *static_remarks(static), *remarks))
