"""What calibration runs show beyond the model: found in turn, kept with the law, and said.

What lives here: the order in which it is looked for, and the model with all of it, from the runs or
from a law's provenance. What may not: each of the findings (``rippling``, ``drive_lag``,
``late_scale``, ``swinging_bed``, ``loose_nut``).

Torque that ripples and the drive's lag are the first: they move the motor, which all else is
measured against. The ripple is known only here: the law reads its own. A late scale
and a bed that swings hide each other, and a gap in the nut hides both, and friction.
The gap is looked for where readings belong together and nothing swings; with it in the model the
drive is fitted anew, and both are looked for again.

A fit without the gap may have made up for it: Stribeck friction beside 4 um of play let a fit end
at 0.6 of the table's mass and a fifteenth of the torsional stiffness, from where no fit comes back.
So the gap is looked for from the drive as the bench file states it too, friction without the forms
that may stand for play.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from pmac_comp.base.progress import Progress
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.clearance import Clearance, known_load_N, with_clearance
from pmac_comp.physics.compensate.grip import gripping_model
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.ripple import RIPPLE, TURNING, turning_model
from pmac_comp.physics.compensate.starts import with_starts
from pmac_comp.physics.model.effect import split_name
from pmac_comp.workflow.accuracy.late_scale import (
    in_time,
    noted_age,
    read_together,
    scale_age_s,
    scale_remarks,
)
from pmac_comp.workflow.law.drive_lag import found_drive_lag, lag_note, lag_remarks
from pmac_comp.workflow.law.dynamic_law import without_fed_forward
from pmac_comp.workflow.law.loose_nut import (
    clearance_note,
    clearance_remarks,
    found_clearance,
    loosened,
)
from pmac_comp.workflow.law.rippling import rippling
from pmac_comp.workflow.law.swinging_bed import bed_remarks, noted_bed, on_bed

if TYPE_CHECKING:
    from pmac_comp.physics.identify.refit import Refit
    from pmac_comp.physics.model.drive import DriveModel

_FRICTION = ("stribeck", "presliding", "presliding_gms")
_WHOLE = "whole_model"  # of a law: all that the last fit has
_LEAST_KEPT, _MOST_KEPT = 0.5, 2.0  # of the gap that slow and fast runs gave
_LEAST_LOAD_FRAC = 0.05  # of the guide's friction, of a load that counts beside it
_LESS_FRAC = 0.9  # of what a gap beside the identified drive leaves, to begin from the stated one


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
    """Look for the drive's lag, a late scale, a bed that swings and, if asked, a gap in the nut.

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
    known = rippling(bench, model, captures, progress)
    shown = _in_step(bench, Shown(known, tuple(captures), tuple(slow), {}), progress)
    shown = _timed_and_still(bench, shown, progress)
    if with_gap:  # else the route takes the whole difference of the directions as it is
        if progress is not None and captures:
            progress("looking for a gap in the nut", 0.0)
        gap = found_clearance(bench, shown.model, shown.slow, shown.captures)
        shown = shown if gap is None else _beside_gap(bench, *_nearer(bench, shown, gap), progress)
    if not shown.noted:
        return replace(shown, model=model)
    for name in (RIPPLE, *TURNING):  # the law reads them itself
        if name in shown.model.effects and name not in model.effects:
            shown = replace(shown, model=shown.model.without_effect(name))
    own = [name for name in shown.model.effects if name not in model.effects]
    given_up = [name for name in model.effects if name not in shown.model.effects]
    whole = {"effects": own, "without": given_up, "values": dict(shown.model.parameters)}
    return replace(shown, noted={**shown.noted, _WHOLE: whole})


def _in_step(bench: Bench, shown: Shown, progress: Progress | None) -> Shown:
    """With the lag of the drive, where runs contradict the bench file."""
    lag = found_drive_lag(bench, shown.model, shown.captures, progress)
    if lag is None:
        return shown
    return replace(shown, model=lag.model, noted={**shown.noted, **lag_note(lag)})


def _timed_and_still(bench: Bench, shown: Shown, progress: Progress | None) -> Shown:
    """With the scale's age and the bed, each beside the other, where they are not known yet."""
    found = _timed(bench, shown, progress)
    swung = _on_its_bed(bench, found, progress)
    if swung is not found:
        swung = _timed(bench, swung, progress)  # what the bed hid
    return _begun(swung)


def _timed(bench: Bench, shown: Shown, progress: Progress | None) -> Shown:
    if scale_age_s(shown.noted) != 0.0:
        return shown
    age = noted_age(bench, shown.model, shown.captures, progress)
    if not age:
        return shown
    captures, slow = (
        tuple(read_together(run, scale_age_s(age)) for run in runs)
        for runs in (shown.captures, shown.slow)
    )
    return Shown(in_time(shown.model, age), captures, slow, {**shown.noted, **age})


def _on_its_bed(bench: Bench, shown: Shown, progress: Progress | None) -> Shown:
    bed = noted_bed(bench, shown.model, shown.captures, progress)
    if not bed:
        return shown
    model = _with_hidden_friction(bench, on_bed(shown.model, bed), shown.captures, progress)
    return replace(shown, model=model, noted={**shown.noted, **bed})


def _with_hidden_friction(
    bench: Bench, model: "DriveModel", captures: Sequence[Capture], progress: Progress | None
) -> "DriveModel":
    """The model with a form of friction that its bed hid, where runs show one."""
    from pmac_comp.physics.identify.refit import fitted_anew

    if any(split_name(name)[0] in _FRICTION for name in model.effects):
        return model
    if progress is not None:
        progress("fitting friction beside the bed", 0.0)
    anew = fitted_anew(captures, bench, model)
    forms = anew is not None and len(anew.model.effects) > len(model.effects)
    return anew.model if anew is not None and forms else model


def _begun(shown: Shown) -> Shown:
    """With what friction held as the runs began."""
    n = len(shown.captures)
    runs = with_starts(without_fed_forward(shown.model), [*shown.captures, *shown.slow])
    return replace(shown, captures=tuple(runs[:n]), slow=tuple(runs[n:]))


def _nearer(bench: Bench, shown: Shown, gap: Clearance) -> tuple[Shown, Clearance]:
    """Where the gap explains more: beside the drive as identified or as the bench states it."""
    stated = replace(shown, model=_as_stated(bench, shown.model))
    other = found_clearance(bench, stated.model, shown.slow, shown.captures)
    if other is None or other.with_um >= _LESS_FRAC * gap.with_um:
        return shown, gap
    return stated, other


def _as_stated(bench: Bench, model: "DriveModel") -> "DriveModel":
    """The chain of the bench file, with the model's friction but for forms beside Coulomb's."""
    for name in model.effects:
        model = model if split_name(name)[0] not in _FRICTION else model.without_effect(name)
    base = type(model).base(bench).parameters
    chain = {name: value for name, value in base.items() if name.startswith("chain.")}
    return model.with_parameters(chain)


def _beside_gap(bench: Bench, shown: Shown, gap: Clearance, progress: Progress | None) -> Shown:
    """With the gap, the drive fitted anew beside it, and what it hid."""
    from pmac_comp.physics.identify.refit import fitted_anew

    loose = with_clearance(shown.model, gap.values)
    if progress is not None:
        progress("fitting the drive beside the gap", 0.0)
    anew = fitted_anew(shown.captures, bench, loose)
    if anew is not None:
        anew, told = _of_its_kind(bench, shown, anew, gap, progress)
        anew = _in_its_valley(bench, anew, shown.captures, progress)
        moved = _moved(told, anew.model, anew.left_um)
        if _LEAST_KEPT * told.gap_m < moved.gap_m < _MOST_KEPT * told.gap_m:
            loose, gap = anew.model, moved
    found = _timed_and_still(bench, replace(shown, model=loose), progress)
    gap = _moved(gap, found.model, gap.with_um)
    return replace(found, noted={**found.noted, **clearance_note(gap)})


def _of_its_kind(
    bench: Bench, shown: Shown, anew: "Refit", gap: Clearance, progress: Progress | None
) -> tuple["Refit", Clearance]:
    """The drive with play or a soft zone, looked for again beside all that the first fit found.

    Friction that is not known yet hides which of the two it is: half of what a soft nut gives was
    taken for play beside presliding and Stribeck friction, and 1.6 of the aim of slow sinusoids
    were left.
    """
    from pmac_comp.physics.identify.refit import NO_OTHER_um, fitted_anew

    if anew.left_um < NO_OTHER_um:
        return anew, gap
    tight = anew.model.without_effect(gap.effect)
    other = found_clearance(bench, tight, shown.slow, shown.captures)
    if other is None or other.is_soft == gap.is_soft:
        return anew, gap
    if progress is not None:
        progress("fitting the drive beside a gap of the other kind", 0.0)
    found = fitted_anew(shown.captures, bench, with_clearance(tight, other.values))
    if found is None or found.left_um >= _LESS_FRAC * anew.left_um:
        return anew, gap
    names = (name for name in (*other.values, *gap.values) if name in found.model.parameters)
    return found, replace(other, values={name: found.model.parameters[name] for name in names})


def _in_its_valley(
    bench: Bench, anew: "Refit", captures: Sequence[Capture], progress: Progress | None
) -> "Refit":
    """The fit of a drive with play with the load and the turn's waves that hide where it ends.

    When the nut crosses jumps with friction and load: cogging and friction by the turn leave
    0.2 um that are no other valley's, and let a fit end in a wrong one.
    """
    from pmac_comp.physics.identify.refit import NO_OTHER_um, fitted_in_valleys

    if anew.left_um < NO_OTHER_um:
        return anew
    if progress is not None:
        progress("fitting the drive beside the gap and the turn", 0.0)
    whole = turning_model(_loaded(anew.model, captures), captures)
    found = fitted_in_valleys(captures, bench, whole)
    return found if found is not None and found.left_um < anew.left_um else anew


def _loaded(model: "DriveModel", captures: Sequence[Capture]) -> "DriveModel":
    """The model with the load that the torque shows, where it moves when the nut crosses."""
    force_N = known_load_N(without_fed_forward(model), captures)
    if force_N == 0.0 or abs(force_N) < _LEAST_LOAD_FRAC * model.parameters["coulomb.guide_N"]:
        return model
    return model.with_effect("bias_force", {"force_N": force_N})


def _moved(gap: Clearance, model: "DriveModel", with_um: float) -> Clearance:
    """The gap as a later fit has it."""
    values = {name: model.parameters[name] for name in gap.values}
    return replace(gap, values=values, with_um=with_um)


def made_with(model: "DriveModel", law: CompensationLaw) -> "DriveModel":
    """The model that a law was made with, from the model that it was computed from."""
    model = on_bed(in_time(model, law.provenance), law.provenance)
    whole = law.provenance.get(_WHOLE)
    if whole is None:
        return loosened(model, law)
    for name in whole.get("without", ()):
        model = model.without_effect(name) if name in model.effects else model
    for name in whole["effects"]:
        model = model if name in model.effects else model.with_effect(name)
    known = {k: v for k, v in whole["values"].items() if k in model.parameters}
    return gripping_model(model.with_parameters(known), law)


def shown_remarks(law: CompensationLaw) -> list[str]:
    """What was found beyond the model, for people."""
    said = [*lag_remarks(law), *scale_remarks(law), *bed_remarks(law), *clearance_remarks(law)]
    return [*said, *_friction_remarks(law)]


def _is_friction_found(name: str, values: Mapping[str, float]) -> bool:
    """Whether an effect is friction, and not presliding so short that any drive has it."""
    from pmac_comp.physics.identify.friction_form import STICK_ZONE_m

    effect = split_name(name)[0]
    lengths_m = [values.get(f"{effect}.{length}", 0.0) for length in ("distance_m", "rotary_m")]
    is_sharp = effect.startswith("presliding") and max(lengths_m) <= STICK_ZONE_m
    return effect in (*_FRICTION, "smooth_coulomb") and not is_sharp


def _friction_remarks(law: CompensationLaw) -> list[str]:
    """Friction that showed, or was none, as soon as what hid it was in the model."""
    whole = law.provenance.get(_WHOLE, {"effects": [], "values": {}})
    forms = [name for name in whole["effects"] if _is_friction_found(name, whole["values"])]
    said = []
    if forms:
        said.append(
            f"beside that the runs show friction that it hid ({', '.join(forms)}): the law is "
            "computed with it, `pmac-comp diagnose` gives its figures"
        )
    if given_up := whole.get("without", ()):
        said.append(
            f"friction of the model that stood for it is left out ({', '.join(given_up)}), and "
            "the drive is fitted from the bench file's figures again"
        )
    return said
