"""A machine bed that swings on its foundation, where the captures show it.

What lives here: the frequency from which its fit begins, the fit beside the drive's other
parameters, and whether held-out samples bear it out. What may not: what a law makes of it
(``compensate``), names of other causes (``diagnose``). Imports this package and the model.

The force that accelerates the table shakes the bed, and on a bed that swings the table feels its
own mass: table minus motor and torque ring after each change of the acceleration, at 20 to 60 Hz on
feet, at 5 to 15 Hz on isolators or wheels. Positions are relative to the bed,
so no sensor shows it directly.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.identify.derivatives import bridged
from pmac_comp.physics.identify.result import Identification
from pmac_comp.physics.identify.trial import Trial, is_better, rms_um
from pmac_comp.physics.model.drive import DriveModel, simulate_many

BED = "base_mode"
# From isolators to stiff feet, 9 % apart: what is looked for.
_FREQUENCIES_Hz = tuple(np.geomspace(5.0, 80.0, 33).tolist())
_NEAR = np.linspace(0.92, 1.08, 9)  # of the one that fits best: where the fit begins
_PROBE_RATIO = 0.02
_MOST_RATIO = 1.0  # no bed is lighter than its table
_PROBE_DAMPING = 0.03
_SMOOTHED_s = 4e-3
_TINY_m2 = 1e-30
_PROBED_FRAC = 0.1  # of what the model leaves of table minus motor in motion, by the probe alone
_MOST_DAMPING = 0.2  # more is no swinging
_SIGNIFICANT = 5.0  # standard deviations
_HALF_SIGNIFICANT = 3.0  # the same of a fit to half the samples: those held out judge it too
_CLEARLY = 3.0  # standard errors of the mean over blocks


@dataclass(frozen=True)
class SwingingBed:
    """A bed that swings, and what the drive is beside it.

    Parameters
    ----------
    frequency_Hz, mass_ratio, damping_ratio : float
        Of the bed alone; table mass over the bed's.
    mass_ratio_std : float
        Standard deviation of the ratio.
    values : Mapping of str to float
        Parameters of the drive fitted beside it, full names, SI.
    without_um, with_um : float
        Rms of table minus motor on held-out samples, both fitted to the others.
    """

    frequency_Hz: float
    mass_ratio: float
    damping_ratio: float
    mass_ratio_std: float
    values: Mapping[str, float]
    without_um: float
    with_um: float


def measured_bed(
    captures: Sequence[Capture], bench: Bench, model: DriveModel
) -> SwingingBed | None:
    """Bed that runs show to swing beyond a model.

    Parameters
    ----------
    captures, bench
        As in ``identify``.
    model : DriveModel
        Identified from such runs; without ``base_mode``.

    Returns
    -------
    SwingingBed or None
        None where nothing of what the model leaves looks like it, where the fit ends in something
        that does not swing or is not significant, or where the samples that were not fitted are
        not predicted clearly better with it.
    """
    if model.is_rigid or bench.scale is None or not captures:
        return None
    trial = Trial(captures, bench)
    plain = trial.half(model, None)
    if plain is None:
        return None
    begun = _begun(trial, plain)
    swinging = None if begun is None else trial.half(begun, None)
    if swinging is None or not _swings(swinging, _HALF_SIGNIFICANT):
        return None
    before, after = trial.errors(plain), trial.errors(swinging)
    if not is_better(after, before, _CLEARLY):
        return None
    found = trial.settled(swinging.model)
    if found is None or not _swings(found, _SIGNIFICANT):
        return None
    own = found.model.values_of(BED)
    return SwingingBed(
        own["frequency_Hz"],
        own["mass_ratio"],
        own["damping_ratio"],
        found.parameters[f"{BED}.mass_ratio"].std,
        dict(found.model.without_effect(BED).parameters),
        rms_um(before),
        rms_um(after),
    )


def _swings(found: Identification, least_std: float) -> bool:
    ratio = found.parameters[f"{BED}.mass_ratio"]
    damping = found.parameters[f"{BED}.damping_ratio"]
    return ratio.value > least_std * ratio.std and damping.value < _MOST_DAMPING


def _begun(trial: Trial, plain: Identification) -> DriveModel | None:
    """Model with the bed that explains most of what a fit leaves; None where none explains much."""
    left = [_moving(c, r.table_m) for c, r in zip(trial.captures, plain.residuals, strict=True)]
    power = sum(float(np.sum(r**2)) for r in left)
    coarse = [_probe(plain.model, f, 2.0 * _PROBE_DAMPING) for f in _FREQUENCIES_Hz]
    best, explained, _ = _closest(trial, plain.model, left, coarse)
    if explained < _PROBED_FRAC * power:
        return None
    nearest, ratio = coarse[best], _PROBE_RATIO
    # What rings is the bed with the table on it, which a light probe does not show: once more with
    # as much mass as the first look gave.
    for _ in range(2):
        near_Hz = nearest.values_of(BED)["frequency_Hz"] * _NEAR
        fine = [_probe(plain.model, f, _PROBE_DAMPING, ratio) for f in near_Hz.tolist()]
        best, _, ratio = _closest(trial, plain.model, left, fine)
        nearest = fine[best]
    return nearest.with_parameters({f"{BED}.mass_ratio": ratio})


def _probe(
    model: DriveModel, frequency_Hz: float, damping: float, ratio: float = _PROBE_RATIO
) -> DriveModel:
    own = {"frequency_Hz": frequency_Hz, "mass_ratio": ratio, "damping_ratio": damping}
    return model.with_effect(BED, own)


def _closest(
    trial: Trial, model: DriveModel, left: Sequence[FloatArray], probes: Sequence[DriveModel]
) -> tuple[int, float, float]:
    """Probe most like what is left, the sum of squares that it explains, its mass ratio then."""
    shown, size = np.zeros(len(probes)), np.zeros(len(probes))
    for capture, rest in zip(trial.captures, left, strict=True):
        runs = simulate_many([model, *probes], [bridged(capture.desired_m, capture.mask)])
        errors = [_moving(capture, run.mechanical_error_m) for run in runs]
        for k, error in enumerate(errors[1:]):
            shown[k] += float(rest @ (error - errors[0]))
            size[k] += float(np.sum((error - errors[0]) ** 2))
    explained = np.where(shown > 0.0, shown**2 / np.maximum(size, _TINY_m2), 0.0)
    best = int(np.argmax(explained))
    ratio = probes[best].values_of(BED)["mass_ratio"]
    found = ratio * shown[best] / size[best]
    return best, float(explained[best]), float(np.clip(found, _PROBE_RATIO, _MOST_RATIO))


def _moving(capture: Capture, error_m: FloatArray | None) -> FloatArray:
    """Table minus motor where the command moves, about its mean there, 0 where nothing is known.

    Smoothed, so that steps of the sensors do not hide what swings.
    """
    moves = np.nan_to_num(np.gradient(capture.desired_m)) != 0.0
    error = np.zeros(capture.n) if error_m is None else error_m
    known = moves & np.isfinite(error)
    if not known.any():
        return np.zeros(capture.n)
    about = np.where(known, error - np.mean(error[known]), 0.0)
    size = max(1, round(_SMOOTHED_s / capture.sample_period_s))
    return np.where(known, uniform_filter1d(about, size), 0.0)
