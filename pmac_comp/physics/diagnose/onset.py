"""How sharply friction sets in, where that is finer than a sensor resolves.

What lives here: the last refinement of a grown model. No decisions about effects. May import
``refit`` and ``workbench``.

No friction changes its sign at once. Over how many hundredths of a micrometre it does so no sensor
sees, yet it decides when the torque of every reversal comes, and a loop whose error jumps by tens
of micrometres there answers a delay of 50 us with some tenths of one. It is no finding, since every
drive has it, and no drive's is known beforehand.
"""

from collections.abc import Collection
from dataclasses import replace

from pmac_comp.base.errors import ModelError
from pmac_comp.base.units import UM_PER_M
from pmac_comp.physics.diagnose.records import gap
from pmac_comp.physics.diagnose.refit import Fitted, evaluate, refit, settled
from pmac_comp.physics.diagnose.workbench import Workbench
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.effect import split_name

_GRIP = frozenset({"presliding", "presliding_gms"})
_FRICTION = frozenset({"coulomb", "stribeck"})
_DISTANCES = ("presliding.distance_m", "presliding.rotary_m")
_FIRST_m = (0.02e-6, 0.1e-6)
_ROUNDS = 5
_NARROW = 0.004  # differences, as a share: the onset is short beside what others move
_COUNTS = 1.0  # of the motor's encoder: what is longer is presliding and has a name
_WORTH = 0.002  # drop of chi-square per sample
_CLOSED = 0.995  # of the gap on judging runs


def with_onset(workbench: Workbench, point: Fitted) -> Fitted:
    """The model with the distance over which its friction sets in, where the data shows one.

    Parameters
    ----------
    workbench : Workbench
        All records.
    point : Fitted
        The grown model on them.

    Returns
    -------
    Fitted
        The model as it was where it has presliding or no friction, where the distance would be one
        that an encoder resolves, or where judging runs are not closer to it.
    """
    present = {split_name(name)[0] for name in point.model.effects}
    if present & _GRIP or not present & _FRICTION:
        return point
    part = _outspoken(workbench.fitting_bench())
    begun = evaluate(part, point.model)
    tried = [f for f in (_begun(part, point.model, first) for first in _FIRST_m) if f is not None]
    if not tried:
        return point
    fitted = refit(part, min(tried, key=lambda f: f.chi2), rounds=_ROUNDS, step_frac=_NARROW)
    rows = sum(int(mask.sum()) for mask in part.fitting) * part.channels
    if begun.chi2 - fitted.chi2 < _WORTH * rows or _resolved(fitted.model):
        return point
    before, after = (
        gap(workbench.calm_records, m, workbench.executor) for m in (point.model, fitted.model)
    )
    if after.position_um > _CLOSED * before.position_um:
        return point
    return evaluate(workbench, fitted.model)


def freed(workbench: Workbench, point: Fitted) -> Fitted:
    """The model with an onset, and what had stood for it gone back to where it belongs.

    Before the onset was in the model, others were bent to stand for it, a delay above all.
    """
    part = _outspoken(workbench.fitting_bench())
    free, _ = settled(part, evaluate(part, point.model))
    return evaluate(workbench, point.model if _resolved(free.model) else free.model)


def not_outgrown(workbench: Workbench, point: Fitted) -> Fitted:
    """The model without an onset that grew beyond what an encoder resolves in a refit.

    Friction that grips over such a distance is an effect, found by name or left unknown.
    """
    if not _resolved(point.model):
        return point
    part = workbench.fitting_bench()
    bare = evaluate(part, point.model.without_effect("presliding"))
    return evaluate(workbench, refit(part, bare, rounds=_ROUNDS).model)


def without_onset(model: DriveModel) -> DriveModel:
    """The model with Coulomb friction that sets in at once, where it did so unseen.

    What a drive has since then of presliding is a finding, not another value of that distance.
    """
    if _resolved(model) or not any(name in model.parameters for name in _DISTANCES):
        return model
    return model.without_effect("presliding")


def holds_onset(model: DriveModel) -> bool:
    """Whether friction of a model sets in over a distance, whichever it is."""
    return any(name in model.parameters for name in _DISTANCES)


def told(model: DriveModel, claimed: Collection[str]) -> tuple[str, ...]:
    """A sentence on an onset that is part of a model and no finding; none where there is none."""
    names = [name for name in _DISTANCES if name in model.parameters]
    if not names or _GRIP & set(claimed) or _resolved(model):
        return ()
    longest_um = UM_PER_M * max(model.parameters[name] for name in names)
    return (
        f"In the model friction sets in over up to {longest_um:.2g} um, which is less than the "
        "motor's encoder resolves: every drive has that, it is no finding.",
    )


def _outspoken(part: Workbench) -> Workbench:
    """The bench without what is set aside for an onset that is not in the model."""
    return part.with_noise(replace(part.known_noise, doubtful=None))


def _begun(part: Workbench, model: DriveModel, first_m: float) -> Fitted | None:
    key = "presliding" if model.is_rigid else "presliding@all"
    names = ("distance_m",) if model.is_rigid else ("distance_m", "rotary_m")
    try:
        return evaluate(part, model.with_effect(key, dict.fromkeys(names, first_m)))
    except ModelError:
        return None


def _resolved(model: DriveModel) -> bool:
    """Whether a distance is one that the encoder shows."""
    longest_m = max(model.parameters.get(name, 0.0) for name in _DISTANCES)
    return longest_m > _COUNTS * model.bench.motor_resolution_m
