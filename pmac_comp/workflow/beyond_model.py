"""What calibration runs show beyond the model: found in turn, kept with the law, and said.

What lives here: the order in which it is looked for, and the model with all of it, from the runs or
from a law's provenance. What may not: each of the findings (``late_scale``, ``swinging_bed``,
``loose_nut``).

A gap in the nut leaves more than the rest, and is looked for where readings belong together and
nothing swings. It hides both where it is large: with it in the model they are looked for again.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.clearance import Clearance, with_clearance
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.starts import with_starts
from pmac_comp.workflow.dynamic_law import without_turn
from pmac_comp.workflow.late_scale import (
    in_time,
    noted_age,
    read_together,
    scale_age_s,
    scale_remarks,
)
from pmac_comp.workflow.loose_nut import (
    clearance_note,
    clearance_remarks,
    found_clearance,
    loosened,
)
from pmac_comp.workflow.swinging_bed import bed_remarks, noted_bed, on_bed

if TYPE_CHECKING:
    from pmac_comp.physics.model.drive import DriveModel

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Shown:
    """What runs show beyond a model.

    Parameters
    ----------
    model : DriveModel
        With all of it but the scale's age, as it was fitted beside it.
    captures, slow : tuple of Capture
        The runs as a scale that is not late would have given them, and how they began.
    noted : dict
        What a law keeps of it in its provenance.
    """

    model: "DriveModel"
    captures: tuple[Capture, ...]
    slow: tuple[Capture, ...]
    noted: dict[str, Any]


def shown_by_runs(
    bench: Bench,
    model: "DriveModel",
    captures: Sequence[Capture],
    slow: Sequence[Capture],
    *,
    with_gap: bool = True,
    progress: Progress | None = None,
) -> Shown:
    """Look for a late scale, a bed that swings and, if asked, a gap in the nut.

    Parameters
    ----------
    bench, model
        What is known, and the identified drive.
    captures, slow : sequence of Capture
        Fast runs and slow runs in both directions, without compensation.
    with_gap : bool
        Whether a gap is looked for.
    progress : callable, optional
        Called with a step and a fraction.
    """
    age = noted_age(bench, model, captures, progress)
    captures, slow = (_together(runs, age) for runs in (captures, slow))
    shown = _begun(in_time(model, age), captures, slow, age)
    bed = noted_bed(bench, shown.model, shown.captures, progress)
    if bed:
        shown = _begun(on_bed(shown.model, bed), shown.captures, shown.slow, {**age, **bed})
    if not with_gap:  # the route takes the whole difference of the directions as it is
        return shown
    if progress is not None and captures:
        progress("looking for a gap in the nut", 0.0)
    gap = found_clearance(bench, shown.model, shown.slow, shown.captures)
    return shown if gap is None else _beside_gap(bench, shown, gap, progress)


def _together(runs: Sequence[Capture], noted: dict[str, Any]) -> tuple[Capture, ...]:
    return tuple(read_together(run, scale_age_s(noted)) for run in runs)


def _begun(
    model: "DriveModel", captures: Sequence[Capture], slow: Sequence[Capture], noted: dict[str, Any]
) -> Shown:
    runs = with_starts(without_turn(model), [*captures, *slow])
    return Shown(model, tuple(runs[: len(captures)]), tuple(runs[len(captures) :]), noted)


def _beside_gap(bench: Bench, shown: Shown, gap: Clearance, progress: Progress | None) -> Shown:
    """With the gap, and what it hid."""
    loose, hidden = with_clearance(shown.model, gap.values), dict[str, Any]()
    captures, slow = shown.captures, shown.slow
    if scale_age_s(shown.noted) == 0.0:
        hidden |= noted_age(bench, loose, captures, progress)
        loose = in_time(loose, hidden)
        captures, slow = (_together(runs, hidden) for runs in (captures, slow))
    hidden |= noted_bed(bench, loose, captures, progress)
    loose = on_bed(loose, hidden)
    # The last fit moved the gap's own parameters as well.
    gap = replace(gap, values={name: loose.parameters[name] for name in gap.values})
    noted = {**shown.noted, **hidden, **clearance_note(gap)}
    return _begun(loose, captures, slow, noted) if hidden else Shown(loose, captures, slow, noted)


def made_with(model: "DriveModel", law: CompensationLaw) -> "DriveModel":
    """The model that a law was made with, from the model that it was computed from."""
    return loosened(on_bed(in_time(model, law.provenance), law.provenance), law)


def shown_remarks(law: CompensationLaw) -> list[str]:
    """What was found beyond the model, for people."""
    return [*scale_remarks(law), *bed_remarks(law), *clearance_remarks(law)]
