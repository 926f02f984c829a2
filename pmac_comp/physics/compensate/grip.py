"""How far a drive moves after a reversal until its friction grips, found in captures.

What lives here: the break-away distance of the law's friction torque. What may not: the model's
fit, controllers.

A model with Coulomb friction turns its friction over at once. A drive whose bearings and nut slide
into it over some micrometres is pushed too hard at each reversal by a torque that does the same.
What friction of another break-away distance would have done to the motor in the captures is
simulated: the difference to the model's own is put on the model as a torque along the way that the
motor went.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.signal import butter, sosfiltfilt

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.evaluation import friction_levels, friction_state
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.loop import LoopRunner
from pmac_comp.physics.compensate.starts import held_at_start_Nm, state_at_start
from pmac_comp.physics.model.effect import split_name

if TYPE_CHECKING:
    from pmac_comp.physics.model.drive import DriveModel

DISTANCES_m = (1e-6, 2e-6, 3e-6, 4e-6, 6e-6, 8e-6, 12e-6, 16e-6, 24e-6, 32e-6, 48e-6, 64e-6, 96e-6)
GRIP = "grip_m"  # of a law's provenance: where captures showed a distance that the model lacks
_NAME = "torque_breakaway_m"
_AS_FAR_FRAC = 0.5
_LEAST_GAIN_FRAC = 0.1  # of the unexplained rms: less than this is not worth a change
_PATH_CUTOFF_Hz = 150.0  # a count that flickers at rest is no way


def gripping_law(
    law: CompensationLaw, loop: LoopRunner, captures: Sequence[Capture]
) -> tuple[CompensationLaw, float]:
    """Law whose torque grips as the drive's friction does, and the share of the rest it explains.

    Parameters
    ----------
    law : CompensationLaw
        Law of a model, with torque.
    loop : LoopRunner
        Closed loop of that model.
    captures : sequence of Capture
        Runs without compensation that start relaxed.

    Returns
    -------
    CompensationLaw, float
        The law itself and 0 where nothing is gained; the change is kept as ``trim``.
    """
    if not captures or law.torque_coulomb_Nm <= 0.0 or law.is_smooth:
        return law, 0.0
    longer = [b for b in DISTANCES_m if b > law.torque_breakaway_m]
    left_m = {b: _left_m(law, loop, captures, b) for b in (law.torque_breakaway_m, *longer)}
    best = min(left_m, key=lambda b: left_m[b])
    explained = 1.0 - left_m[best] / max(left_m[law.torque_breakaway_m], 1e-30)
    if explained < _LEAST_GAIN_FRAC:
        return law, 0.0
    moved = law.with_trim({_NAME: best - law.torque_breakaway_m})
    return moved.with_values(torque_breakaway_m=best), explained


def gripping_torque(law: CompensationLaw, capture: Capture) -> FloatArray:
    """Torque in N m, shape (n,), that gives the law's model the drive's friction in one run."""
    own_m = law.torque_breakaway_m - law.trim.get(_NAME, 0.0)
    return _missing_Nm(law, capture, own_m, law.torque_breakaway_m)


def gripping_model(model: "DriveModel", law: CompensationLaw) -> "DriveModel":
    """The model that a law was made with: its friction grips as the captures showed it to.

    A law without such a note, or a model whose friction slides as far on its own, leaves the model
    as it is.
    """
    distance_m = law.provenance.get(GRIP)
    if distance_m is None or slides(model, distance_m):
        return model
    for name in _sliding(model):
        model = model.without_effect(name)
    both = dict.fromkeys(("distance_m", "rotary_m"), distance_m)
    return model.with_effect("presliding@all", both)


def slides(model: "DriveModel", distance_m: float) -> bool:
    """Whether the friction of a model grips over about such a distance, not over much less.

    Friction that turns over with speed grips at no distance of its own.
    """
    if "smooth_coulomb" in model.effects:
        return True
    own_m = [
        value
        for name in _sliding(model)
        for key, value in model.values_of(name).items()
        if key.endswith("_m")
    ]
    return max(own_m, default=0.0) >= _AS_FAR_FRAC * distance_m


def _sliding(model: "DriveModel") -> list[str]:
    return [name for name in model.effects if split_name(name)[0].startswith("presliding")]


def _left_m(
    law: CompensationLaw, loop: LoopRunner, captures: Sequence[Capture], breakaway_m: float
) -> float:
    """Rms of what of the motor's position friction with a break-away distance does not explain."""
    squares, n = 0.0, 0
    for capture in captures:
        missing = _missing_Nm(law, capture, law.torque_breakaway_m, breakaway_m)
        signals = loop(capture.commanded_position_m, None, missing, held_at_start_Nm(capture))
        rest = (capture.motor_position_m - signals.motor_position_m)[capture.mask]
        squares += float(np.sum((rest - rest.mean()) ** 2))
        n += rest.size
    return float(np.sqrt(squares / n))


def _missing_Nm(
    law: CompensationLaw, capture: Capture, model_m: float, drive_m: float
) -> FloatArray:
    """Friction of the model less that of the drive along the way of the motor, as a torque."""
    if model_m == drive_m:
        return np.zeros(capture.n)
    period = capture.sample_period_s
    way = _speed(capture.motor_position_m, period)
    start = state_at_start(capture, law.breaks_loose_Nm)
    states = [friction_state(way, distance, period, start) for distance in (model_m, drive_m)]
    _, friction_Nm = friction_levels(law, way)
    return np.asarray(friction_Nm * (states[0] - states[1]))


def _speed(position_m: FloatArray, period_s: float) -> FloatArray:
    """Speed in m/s of a position that flickers between counts, without shift in time."""
    sos = butter(2, min(_PATH_CUTOFF_Hz, 0.45 / period_s), fs=1.0 / period_s, output="sos")
    return np.gradient(sosfiltfilt(sos, position_m), period_s)
