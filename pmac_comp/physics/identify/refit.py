"""All parameters of a drive anew, beside something that hid them.

What lives here: the fit of a grown model from where it stands, and forms of friction that held-out
samples ask for now. What may not: what was found beyond the model (``scale_age``, ``swinging_bed``,
the nut's gap in ``compensate``). Imports this package.

A gap in the nut leaves a micrometre of table minus motor, behind which Stribeck friction of thirty
newton does not show. With the gap in the model it is a tenth, and the fit of the drive ends where
the sensors' steps do.

Forms are tried alone and two at a time: beside 4 um of play and presliding over 10 um Stribeck
friction alone comes out as nothing, and with it the worst moves of that drive's law leave 0.8 of
their aim instead of 2.5. Friction that turns over with speed is tried where rests show it: without
it the law of two masses with 4 um of play left up to 2.0 of its aim, with it 0.9.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.identify.result import Identification
from pmac_comp.physics.identify.smooth import SMOOTH, smooth_values, turns_over_at_once
from pmac_comp.physics.identify.trial import Trial, channel_sizes, is_better, rms_um
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.effect import split_name

# Standard errors of the mean over blocks: than no form, and than another form, of which those with
# fewer parts come first.
_CLEARLY, _RATHER = 3.0, 1.0
_PARTS = {
    "stribeck": {"excess_N": 10.0, "speed_m_per_s": 0.005},
    "presliding": {"distance_m": 10e-6},
    "presliding@all": {"distance_m": 10e-6, "rotary_m": 5e-6},
}
_GAP, _GUIDE, _MOTOR = "backlash.gap_m", "coulomb.guide_N", "coulomb.motor_Nm"
_STIFFNESS = "chain.axial_stiffness_N_per_m"
# Valleys lie within the steps of the first: from 4 % beside one a fit went 3 % on in friction over
# mass, from 0.049 um to 0.047.
_GUIDE_FACTORS, _NEARER_FACTORS = (1.0, 0.85, 0.92, 1.08), (0.96, 1.03)
# Where a fit is right, 0.04 to 0.05 um are left with 40 000 counts: there no form of friction can
# show, and below the second no other valley.
_NOTHING_LEFT_um, NO_OTHER_um = 0.055, 0.1
_FORMS = (
    (SMOOTH,),  # of a drive that creeps at rest
    ("stribeck",),
    ("presliding",),
    ("presliding@all",),
    ("presliding", "stribeck"),
    ("presliding@all", "stribeck"),
)


@dataclass(frozen=True)
class Refit:
    """A drive fitted anew.

    Parameters
    ----------
    model : DriveModel
        With the forms of friction that were asked for.
    left_um : float
        Rms of table minus motor on held-out samples, fitted to the others.
    """

    model: DriveModel
    left_um: float


def fitted_beside(
    captures: Sequence[Capture], bench: Bench, model: DriveModel, grown: DriveModel
) -> DriveModel | None:
    """A model that an effect was added to, fitted; None where the effect is not borne out.

    Parameters
    ----------
    captures, bench
        As in ``identify``.
    model, grown : DriveModel
        Without and with the effect.
    """
    trial = Trial(captures, bench)
    plain, beside = trial.half(model, None), trial.half(grown, None, "all")
    if plain is None or beside is None:
        return None
    if not is_better(trial.errors(beside), trial.errors(plain), _CLEARLY):
        return None
    final = trial.settled(beside.model)
    return None if final is None else final.model


def fitted_anew(captures: Sequence[Capture], bench: Bench, model: DriveModel) -> Refit | None:
    """A model with all of its parameters fitted to runs, and with the friction they ask for.

    Parameters
    ----------
    captures, bench
        As in ``identify``.
    model : DriveModel
        Where the fit begins; its effects are kept.

    Returns
    -------
    Refit or None
        None where the runs do not carry it.
    """
    trial = Trial(captures, bench)
    plain = trial.half(model, None, "all")  # not near yet: what hid the rest moved it as well
    if plain is None:
        return None
    best, errors = plain.model, trial.errors(plain)
    without = errors
    parts = _PARTS | _smooth_part(captures, model)
    forms = [form for form in _FORMS if set(form) <= set(parts)]
    for form in forms if rms_um(errors) > _NOTHING_LEFT_um else ():
        if any(_family(part) in map(_family, model.effects) for part in form):
            continue
        other = trial.half(_with_form(plain.model, form, parts), None)
        if other is None or (SMOOTH in form and turns_over_at_once(other.model)):
            continue
        left = trial.errors(other)
        is_first = best is plain.model
        if is_better(left, without, _CLEARLY) and (is_first or is_better(left, errors, _RATHER)):
            best, errors = other.model, left
    final = trial.settled(best)
    if final is None:
        return None
    return Refit(final.model, rms_um(errors))


def fitted_in_valleys(captures: Sequence[Capture], bench: Bench, model: DriveModel) -> Refit | None:
    """A model of a nut with play, fitted from several splits of the lost motion: the best of them.

    Wind-up by the guide's friction and play give the lost motion together, and when the nut crosses
    jumps with the friction: a fit ends beside where it began. Beside 4 um of play it left friction
    over mass 7 % high, which moved a crossing of a slow sinusoid by 9 ms, and 0.26 um where another
    start left 0.21.

    Parameters
    ----------
    captures, bench
        As in ``identify``.
    model : DriveModel
        With play and all that runs showed of it.

    Returns
    -------
    Refit or None
        None without play, or where the runs do not carry it.
    """
    if _GAP not in model.parameters:
        return None
    trial = Trial(captures, bench)
    first = _fits_of_splits(trial, model, _GUIDE_FACTORS)
    if not first:
        return None
    near = _deepest(first)
    nearer = _fits_of_splits(trial, near[0].model, _NEARER_FACTORS)
    best, errors = _deepest([near, *nearer])
    final = trial.settled(best.model)
    return None if final is None else Refit(final.model, rms_um(errors))


def _deepest(
    tried: Sequence[tuple[Identification, FloatArray]],
) -> tuple[Identification, FloatArray]:
    """The fit that leaves least of both channels, measured by what the first leaves."""
    sizes = channel_sizes(tried[0][1])
    return min(tried, key=lambda one: float(np.sum(np.mean(one[1], axis=0) / sizes)))


def _fits_of_splits(
    trial: Trial, model: DriveModel, factors: Sequence[float]
) -> list[tuple[Identification, FloatArray]]:
    """Fits to one half from other splits of a model's lost motion, and what they leave."""
    fits = [trial.half(_split_anew(model, factor), None) for factor in factors]
    return [(fit, trial.errors(fit)) for fit in fits if fit is not None]


def _split_anew(model: DriveModel, factor: float) -> DriveModel:
    """The model with another guide friction: the motor's and the play make up for it."""
    own = model.parameters
    more_N = (factor - 1.0) * own[_GUIDE]
    motor_Nm = own[_MOTOR] - more_N * model.bench.lead_m_per_rad
    gap_m = own[_GAP] - 2.0 * more_N / own[_STIFFNESS]
    return model.with_parameters(
        {_GUIDE: own[_GUIDE] + more_N, _MOTOR: max(motor_Nm, 0.0), _GAP: max(gap_m, 0.0)}
    )


def _smooth_part(captures: Sequence[Capture], model: DriveModel) -> dict[str, dict[str, float]]:
    """Friction that turns over with speed, from where its fit begins, where rests show it."""
    values = smooth_values(captures, model)
    return {} if values is None else {SMOOTH: values}


def _with_form(
    model: DriveModel, form: Sequence[str], parts: Mapping[str, Mapping[str, float]]
) -> DriveModel:
    """The model with the parts of a form of friction, from where their fit begins."""
    for part in form:
        model = model.with_effect(part, parts[part])
    return model


def _family(effect: str) -> str:
    """What of the same kind a model has once: presliding, with memory or not, at any place.

    Friction that turns over with speed has no presliding.
    """
    bare = split_name(effect)[0]
    return "presliding" if bare == SMOOTH else bare.partition("_")[0]
