"""How much later the scale is read than the encoder, where the captures show it.

What lives here: the fit of that time beside everything that it hides behind, and whether held-out
samples bear it out. What may not: correcting captures by it (``workflow``), names of other causes
(``diagnose``). Imports this package.

The electronics of a scale take some microseconds to interpolate its signal. Table minus motor then
lags by speed times that time, which is no error of the table. Viscous friction of the guide looks
alike; but it costs torque, and what it makes grows along the screw.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.identify.linear_start import SKEW_TIME
from pmac_comp.physics.identify.result import Identification
from pmac_comp.physics.identify.trial import Trial, is_better, rms_um
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.quasi_static import compliance_m_per_N

SKEW = "channel_skew"
_GUIDE, _MOTOR = "viscous.guide_Ns_per_m", "viscous.motor_Nms_per_rad"
_LEAST_s = 0.4e-6
_MUCH_s = 4e-6
_SIGNIFICANT, _PROBABLE = 5.0, 2.0  # standard deviations
_CLEARLY = 3.0  # standard errors of the mean over blocks
# Of the rms that stays: what else the model lacks widens the deviation, not what a late scale takes
# away.
_HALVED = 0.5


@dataclass(frozen=True)
class ScaleAge:
    """Age of the scale's samples against the encoder's.

    Parameters
    ----------
    time_s, std_s : float
        Positive: the table is read late.
    values : Mapping of str to float
        Parameters of the drive fitted beside it, full names, SI.
    without_um, with_um : float
        Rms of table minus motor on held-out samples, both fitted to the others.
    """

    time_s: float
    std_s: float
    values: Mapping[str, float]
    without_um: float
    with_um: float


def measured_scale_age(
    captures: Sequence[Capture], bench: Bench, model: DriveModel
) -> ScaleAge | None:
    """Age of the scale's samples that runs show beyond a model.

    Parameters
    ----------
    captures, bench
        As in ``identify``.
    model : DriveModel
        Identified from such runs; without ``channel_skew``.

    Returns
    -------
    ScaleAge or None
        None where the runs do not tell, or where it is not significant, or where the samples that
        were not fitted are not predicted clearly better with it. An age that only probably is one
        counts where it halves what stays there.
    """
    if model.is_rigid or bench.scale is None or not captures:
        return None
    trial = Trial(captures, bench)
    plain: Identification | None = None
    for start in _starts(model):
        found = _settled(trial, start)
        if found is None or not _stands_out(found, _PROBABLE):
            continue
        plain, late = plain or trial.half(model, None), trial.half(found.model, None)
        if plain is None or late is None:
            continue
        before, after = trial.errors(plain), trial.errors(late)
        known = _stands_out(found, _SIGNIFICANT) or rms_um(after) < _HALVED * rms_um(before)
        if known and is_better(after, before, _CLEARLY):
            age = found.parameters[SKEW_TIME]
            values = dict(found.model.without_effect(SKEW).parameters)
            return ScaleAge(age.value, age.std, values, rms_um(before), rms_um(after))
    return None


def _stands_out(found: Identification, deviations: float) -> bool:
    age = found.parameters[SKEW_TIME]
    return abs(age.value) >= max(_LEAST_s, deviations * age.std)


def _starts(model: DriveModel) -> tuple[DriveModel, ...]:
    """Models with an age of zero, and with that of the lag that much viscous friction makes.

    A fit without it puts all of the lag into viscous friction of the guide and takes its torque
    from nut and motor. Where that is much, nothing leads back along that valley step by step: it is
    begun at its other end, too.
    """
    none = model.with_effect(SKEW, {"time_s": 0.0})
    other = _with_usual_guide(none)
    return (none, other) if other.parameters[SKEW_TIME] >= _MUCH_s else (none,)


def _settled(trial: Trial, start: DriveModel) -> Identification | None:
    """A fit from a start, and where it shows an age again from the usual friction of the guide.

    A fit that creeps along that valley ends where its steps are small beside deviations which count
    the lag itself as noise: of a scale that is read 4 us early beside a gap it showed 2.8.
    """
    found = trial.settled(start)
    if found is None or not _stands_out(found, _PROBABLE):
        return found
    again = trial.settled(_with_usual_guide(found.model))
    return found if again is None else min(found, again, key=_left_m)


def _left_m(found: Identification) -> float:
    """Rms that stays of table minus motor, m."""
    left_m = found.noise.table_m
    return math.inf if left_m is None else left_m


def _with_usual_guide(model: DriveModel) -> DriveModel:
    """A model with the age beside the usual friction of the guide: same lag, same torque."""
    own, usual = model.parameters, model.spec(_GUIDE).nominal
    beyond = own[_GUIDE] - usual
    age_s = own[SKEW_TIME] + beyond * float(np.mean(compliance_m_per_N(model, 0.0)))
    turning = max(0.0, own[_MOTOR] + beyond * model.bench.lead_m_per_rad**2)
    return model.with_parameters({_GUIDE: usual, _MOTOR: turning, SKEW_TIME: age_s})
