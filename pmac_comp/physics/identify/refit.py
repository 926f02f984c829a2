"""All parameters of a drive anew, beside something that hid them.

What lives here: the fit of a grown model from where it stands, and forms of friction that held-out
samples ask for now. What may not: what was found beyond the model (``scale_age``, ``swinging_bed``,
the nut's gap in ``compensate``). Imports this package.

A gap in the nut leaves a micrometre of table minus motor, behind which Stribeck friction of thirty
newton does not show. With the gap in the model it is a tenth, and the fit of the drive ends where
the sensors' steps do.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.identify.trial import Trial, is_better, rms_um
from pmac_comp.physics.model.drive import DriveModel

_CLEARLY = 3.0  # standard errors of the mean over blocks
_FORMS = {
    "stribeck": {"excess_N": 10.0, "speed_m_per_s": 0.005},
    "presliding@all": {"distance_m": 10e-6, "rotary_m": 5e-6},
}


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
    best = trial.half(model, None, "all")  # not near yet: what hid the rest moved it as well
    if best is None:
        return None
    errors = trial.errors(best)
    for name, values in _FORMS.items():
        family = name.partition("@")[0]
        if any(effect.startswith(family) for effect in model.effects):
            continue
        other = trial.half(best.model.with_effect(name, values), None)
        if other is not None and is_better(trial.errors(other), errors, _CLEARLY):
            best, errors = other, trial.errors(other)
    final = trial.settled(best.model)
    if final is None:
        return None
    return Refit(final.model, rms_um(errors))
