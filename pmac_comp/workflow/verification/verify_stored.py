"""Before and after, read from stored captures.

What lives here: what of them belongs together, and what they must not be. What may not: fresh runs
(``verify``), the statistics (``outcome``).
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from pmac_comp.base.errors import ConfigError
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import PREDICTED, Capture, predicted_remarks
from pmac_comp.physics.compensate.evaluation import evaluate_law
from pmac_comp.physics.identify.plausibility import require_positions
from pmac_comp.workflow.accuracy.outcome import outcome_of
from pmac_comp.workflow.accuracy.ringing import RingingOutcome, is_ringing
from pmac_comp.workflow.accuracy.static_check import StaticOutcome, is_static
from pmac_comp.workflow.bench.same_axis import (
    captures_of,
    check_one_motion,
    check_side_marks,
    check_two_sides,
)
from pmac_comp.workflow.compensation.file import (
    DIGEST_MARK,
    ROUTE_MARK,
    Compensation,
    read_compensation,
)
from pmac_comp.workflow.compensation.promises import Promiser
from pmac_comp.workflow.law.routes import MOTION_ROUTES, TORQUE_ROUTES
from pmac_comp.workflow.model.identification import load_model
from pmac_comp.workflow.verification.result import Verification
from pmac_comp.workflow.verification.summing_up import (
    Pair,
    ringing_outcome,
    scale_age_of,
    static_outcome,
    summed_up,
)

_NOTHING_m = 1e-8  # desired and commanded position are the same: far below a count
_CLEAR_um = 1.0  # a correction that a run shows
_NO_FILE = (
    "no compensation file was named: the lead error is still in the mechanical error before, and "
    "nothing is promised; --compensation FILE takes it out, --model FILE beside it promises"
)


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
    told = _check_acted(runs, compensation, str(law), loaded)
    remarks = (
        *predicted_remarks([*sides[0], *sides[1]]),
        *told,
        *_unknown_remarks(runs),
        *([_NO_FILE] if law is None else []),
    )
    static, ringing = _special(loaded, sides)
    first, second = _of_kind(sides, lambda c: not (is_static(c) or is_ringing(c)))
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
            scale_age_s=scale_age_of(compensation),
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
    """Captures by the paths they were read from."""
    return {str(path): capture for path, capture in zip(paths, captures, strict=True)}


def _check_acted(
    runs: Mapping[str, Capture], expected: Compensation | None, file: str, bench: Bench
) -> tuple[str, ...]:
    """Refuse stored runs with another compensation than the one that is named.

    Parameters
    ----------
    runs : Mapping of str to Capture
        The runs with it, by their names; those that `verify` made tell what acted.
    expected : Compensation or None
        Whose promise they are held against; None for none.
    file : str
        Where it was read from.
    bench : Bench
        Counts of its tables, servo period of its law.

    Returns
    -------
    tuple of str
        What a person should know: runs that do not tell, or that had several without a file.

    Raises
    ------
    ConfigError
        A run tells of another compensation, or shows that none acted.
    """
    acted = {name: str(run.attributes.get(DIGEST_MARK, "")) for name, run in runs.items()}
    if expected is None:
        several = len(set(filter(None, acted.values())))
        told = f"the runs with compensation were made with {several} different ones"
        return (told,) * (several > 1)
    other = [name for name, digest in acted.items() if digest not in {"", expected.digest}]
    if other:
        routes = sorted({str(runs[name].attributes.get(ROUTE_MARK, "")) for name in other})
        raise ConfigError(
            f"{', '.join(other)}: made with another compensation (route {', '.join(routes)}) than "
            f"that of {file} (route {expected.route}).",
            code="PC-VER-007",
            hint="Name with --compensation the file that stood on the controller, or leave it out: "
            "the errors are compared then without its promise and lead.",
        )
    silent = [name for name, digest in acted.items() if not digest]
    if not silent:
        return ()
    for name in silent:
        _require_corrected(name, runs[name], expected, file, bench)
    return (
        f"{len(silent)} of {len(runs)} runs with it do not tell which compensation acted: that it "
        f"was {file} is taken as said",
    )


def _require_corrected(
    name: str, run: Capture, expected: Compensation, file: str, bench: Bench
) -> None:
    """Refuse a run whose desired position is its command though a compensation corrects there."""
    r_m, desired_m = run.commanded_position_m, run.desired_position_m
    if desired_m is None or expected.route in MOTION_ROUTES:
        return  # such a one corrects its own motion only, a program in the command itself
    if float(np.max(np.abs((desired_m - r_m)[run.mask]), initial=0.0)) > _NOTHING_m:
        return
    table, meant_m = expected.table_correction(bench), np.zeros(r_m.size)
    if expected.route in TORQUE_ROUTES:
        meant_m = evaluate_law(expected.law, r_m, run.sample_period_s).correction_m
    if table is not None:
        meant_m = meant_m + table(r_m)
    most_um = float(np.max(np.abs(meant_m[run.mask]), initial=0.0)) * UM_PER_M
    if most_um > _CLEAR_um:
        raise ConfigError(
            f"{name}: no compensation acted in it, its desired position is the commanded one; "
            f"{file} corrects by up to {most_um:.1f} um there.",
            code="PC-WRK-007",
            hint="Give runs that were made with it under --after; `pmac-comp verify URL "
            "--compensation FILE` makes both sides.",
        )


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


def _is_simulated(capture: Capture) -> bool:
    source = str(capture.attributes.get("source", ""))
    return "simulated" in source or source == PREDICTED


def _special(
    bench: Bench, sides: Sequence[Sequence[Capture]]
) -> tuple[StaticOutcome | None, RingingOutcome | None]:
    """Positioning and ringing where the stored captures hold their motions."""
    rings = _of_kind(sides, is_ringing)
    ringing = ringing_outcome(bench, rings) if all(rings) else None
    return static_outcome(_of_kind(sides, is_static)), ringing


def _of_kind(sides: Sequence[Sequence[Capture]], is_kind: Callable[[Capture], bool]) -> Pair:
    """Captures of a kind on each side."""
    before, after = ([capture for capture in side if is_kind(capture)] for side in sides)
    return before, after


def _paired(before: Sequence[Capture], after: Sequence[Capture]) -> dict[str, Pair]:
    """Runs of the motions that are on both sides; by their order where no motion is named so."""
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
