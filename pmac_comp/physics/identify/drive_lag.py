"""How late the drive makes its torque, where the captures contradict the bench file.

What lives here: the fit of dead time and bandwidth without what the bench file says of them, and
whether held-out samples bear it out. What may not: a law's look-ahead (``compensate``), names of
causes (``diagnose``). Imports this package.

A bench file states dead time and bandwidth to a fifth. But a current loop with an integrator, of
300 Hz, hardly lags where an axis moves, as a first-order lag of 300 Hz does by half a millisecond.
Next to friction that no model holds whole, the statement of the file then outweighs the samples:
the drive is fitted later than it is, and a law looks too far ahead.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.identify.result import Identification
from pmac_comp.physics.identify.trial import FEW_BLOCKS, USEFUL_GAIN, Trial, channel_sizes
from pmac_comp.physics.model.drive import DriveModel

DELAY, BANDWIDTH = "actuator_delay", "current_bandwidth"
_TIME, _FREQUENCY = f"{DELAY}.time_s", f"{BANDWIDTH}.bandwidth_Hz"
_LEAST_s = 50e-6  # nearer to what the fit has anyway is no finding: a law loses nothing by it
_CLEARLY = 3.0  # standard errors of the mean over blocks
_SIGNIFICANT = 1.0  # standard deviations, which count what the model leaves as noise


@dataclass(frozen=True)
class DriveLag:
    """A drive whose torque comes earlier or later than its bench file says.

    Parameters
    ----------
    model : DriveModel
        All of it fitted anew, with ``actuator_delay`` and ``current_bandwidth`` of its own.
    lag_s, std_s : float
        Dead time and lag of the current loop together.
    held_s : float
        The same as the bench file holds it.
    without_um, with_um : float
        Rms of the motor's position about the model's on held-out samples, both fitted to the
        others.
    """

    model: DriveModel
    lag_s: float
    std_s: float
    held_s: float
    without_um: float
    with_um: float


def measured_drive_lag(
    captures: Sequence[Capture], bench: Bench, model: DriveModel
) -> DriveLag | None:
    """Lag of the drive that runs show against what the bench file says.

    Parameters
    ----------
    captures, bench
        As in ``identify``.
    model : DriveModel
        Identified from such runs.

    Returns
    -------
    DriveLag or None
        None where the model has a lag of its own, where the runs do not tell, or where the samples
        that were not fitted are not predicted clearly better with it.
    """
    known = DELAY in model.effects or BANDWIDTH in model.effects
    if known or model.is_rigid or bench.scale is None or not captures:
        return None
    trial = Trial(captures, bench)
    held, freed = trial.half(model, None), trial.half(_freed(model), None)
    if held is None or freed is None:
        return None
    before, after = trial.errors_with_motor(held), trial.errors_with_motor(freed)
    found = trial.settled(freed.model) if _follows_better(after, before) else None
    if found is None:
        return None
    held_s, (lag_s, std_s) = _lag_s(model), _lag_of(found)
    if abs(lag_s - held_s) < max(_LEAST_s, _SIGNIFICANT * std_s):
        return None
    left_um = [UM_PER_M * float(np.sqrt(np.mean(e[:, 2]))) for e in (before, after)]
    return DriveLag(found.model, lag_s, std_s, held_s, *left_um)


def _freed(model: DriveModel) -> DriveModel:
    """The model with a dead time and a bandwidth that no bench file holds, from where they are."""
    own = model.parameters
    model = model.with_effect(DELAY, {"time_s": own["chain.actuator_delay_s"]})
    if "chain.current_bandwidth_Hz" not in own:
        return model
    return model.with_effect(BANDWIDTH, {"bandwidth_Hz": own["chain.current_bandwidth_Hz"]})


def _lag_s(model: DriveModel) -> float:
    own = model.parameters
    bandwidth_Hz = own.get("chain.current_bandwidth_Hz", math.inf)
    return own["chain.actuator_delay_s"] + 1.0 / (2.0 * math.pi * bandwidth_Hz)


def _lag_of(found: Identification) -> tuple[float, float]:
    """Lag and its standard deviation; dead time and bandwidth make up for each other."""
    names = [name for name in (_TIME, _FREQUENCY) if name in found.parameters]
    own = [found.parameters[name] for name in names]
    parts_s = [own[0].value, *(1.0 / (2.0 * math.pi * p.value) for p in own[1:])]
    slopes = np.array(
        [1.0, *(-part / p.value for part, p in zip(parts_s[1:], own[1:], strict=True))]
    )
    rows = [found.correlation_names.index(name) for name in names]
    scaled = slopes * np.array([p.std for p in own])
    variance = scaled @ found.correlation[np.ix_(rows, rows)] @ scaled
    return sum(parts_s), math.sqrt(max(float(variance), 0.0))


def _follows_better(new: FloatArray, old: FloatArray) -> bool:
    """Whether the motor is clearly better predicted, and all channels together are.

    What a drive's lag moves most is the motor about its command.
    """
    if new.shape[0] < FEW_BLOCKS:
        return False
    gain = (old - new) / channel_sizes(old)
    motor = gain[:, 2]
    clear = motor.mean() > _CLEARLY * np.std(motor) / math.sqrt(motor.size)
    return bool(clear and gain.sum(axis=1).mean() > USEFUL_GAIN)
