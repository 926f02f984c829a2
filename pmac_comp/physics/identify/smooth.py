"""Friction that turns over with speed, seen at rests of the captures.

What lives here: whether a drive creeps while its command rests, and from where a fit of such
friction begins. What may not: the fits and the choice between forms (``friction_form``).
Imports ``signals`` and the model.

Friction F tanh(v / v_c) holds nothing: torque T that is left at rest moves the drive, with
v = v_c T / F while it is small. Coulomb friction, presliding, play and loads hold: over the runs of
a calibration a line through torque explains at most a third of what their motor still moves at
rest, of smooth friction's 0.95 and more (v_c from 0.2 to 5 mm/s).
"""

from collections.abc import Sequence

import numpy as np

from pmac_comp.files.capture import Capture
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.signals.rests import slow_motion_at_rest, speed_by_push

SMOOTH = "smooth_coulomb"
_LEAST_BINS = 12
_FITTED = 3  # the slope, and the two of the load
_SURE = 5.0  # standard deviations
_LEAST_EXPLAINED = 0.6  # of the speeds' scatter
# Less is as good as Coulomb friction here. The torque that a stop leaves moves a drive that holds
# by some micrometres before it stands, which a few short rests show as 0.07 mm/s.
_LEAST_m_per_s, _MOST_m_per_s = 0.1e-3, 20e-3
_LEAST_FITTED_m_per_s = 0.05e-3


def smooth_values(captures: Sequence[Capture], model: DriveModel) -> dict[str, float] | None:
    """Values of smooth friction from where its fit begins; None where the drive holds.

    Also where runs do not tell, and for a drive that is stated as one mass.

    Parameters
    ----------
    captures : sequence of Capture
        Runs with torque and rests.
    model : DriveModel
        Its Coulomb levels give the speed that the slope at rest stands for.
    """
    if model.is_rigid:
        return None
    parts = [np.zeros((3, 0)), *(slow_motion_at_rest(capture) for capture in captures)]
    torque_Nm, speed_m_per_s, place_m = np.concatenate(parts, axis=1)
    # A load, and one that changes along the travel, is no push.
    load = np.column_stack([np.ones(place_m.size), place_m])
    both = np.column_stack([torque_Nm, speed_m_per_s])
    told = np.linalg.matrix_rank(np.column_stack([torque_Nm, load])) == _FITTED
    if place_m.size < _LEAST_BINS or not told:
        return None
    by_load, *_ = np.linalg.lstsq(load, both, rcond=None)
    slope = speed_by_push(*(both - load @ by_load).T, fitted=_FITTED)
    if slope is None or slope.value < _SURE * slope.std or slope.explained < _LEAST_EXPLAINED:
        return None
    own, lead = model.parameters, model.bench.lead_m_per_rad
    level_Nm = own["coulomb.nut_Nm"] + own["coulomb.motor_Nm"] + lead * own["coulomb.guide_N"]
    turns_over = slope.value * level_Nm
    if not _LEAST_m_per_s < turns_over < _MOST_m_per_s:
        return None
    return dict.fromkeys(("speed_m_per_s", "rotary_m_per_s"), turns_over)


def turns_over_at_once(model: DriveModel) -> bool:
    """Whether the smooth friction of a fit is Coulomb's, by which no rest creeps."""
    return max(model.values_of(SMOOTH).values()) < _LEAST_FITTED_m_per_s
