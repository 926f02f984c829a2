"""Before and after, read from stored captures.

What lives here: what of them belongs together, and what they must not be. What may not: fresh runs
(``verify``), the statistics (``outcome``).
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from pmac_comp.base.errors import ConfigError
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import PREDICTED, Capture, predicted_remarks
from pmac_comp.physics.identify.plausibility import require_positions
from pmac_comp.workflow.compensation_file import check_acted, read_compensation
from pmac_comp.workflow.identification import load_model
from pmac_comp.workflow.outcome import outcome_of
from pmac_comp.workflow.promises import Promiser
from pmac_comp.workflow.ringing import RingingOutcome, is_ringing
from pmac_comp.workflow.routes import MOTION_ROUTES
from pmac_comp.workflow.same_axis import (
    captures_of,
    check_one_motion,
    check_side_marks,
    check_two_sides,
)
from pmac_comp.workflow.static_check import StaticOutcome, is_static
from pmac_comp.workflow.summing_up import (
    Pair,
    ringing_outcome,
    scale_age_of,
    static_outcome,
    summed_up,
)
from pmac_comp.workflow.verification import Verification

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
    told = check_acted(runs, compensation, str(law), loaded)
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
