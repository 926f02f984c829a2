"""Last correction of a law by the captures themselves, for drives that the model does not fit.

What lives here: the regression of what the model leaves of the measured mechanical error on the
terms that the law has anyway. What may not: the model's fit, controllers.

A model whose stiffness profile differs from the machine's leaves an error proportional to
acceleration, speed or direction, and to their products with position. The law has those terms, so
they are taken over; what they do not explain stays for ``diagnose``.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.design import LEAST_COULOMB_m, LoopRunner
from pmac_comp.physics.compensate.grip import gripping_torque
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.lead import LeadMap

_LEAST_GAIN_FRAC = 0.05  # of the unexplained rms: less than this is not worth a change
_TERMS = (
    "inertia_s2",
    "inertia_per_m_s2_per_m",
    "viscous_s",
    "viscous_per_m_s_per_m",
    "coulomb_m",
    "coulomb_per_m",
)


def trimmed_law(
    law: CompensationLaw,
    loop: LoopRunner,
    captures: Sequence[Capture],
    lead: LeadMap | None = None,
) -> tuple[CompensationLaw, float]:
    """Law with its offset terms corrected by captures, and the share of the rest they explain.

    Parameters
    ----------
    law : CompensationLaw
        Law of a model.
    loop : LoopRunner
        Closed loop of that model.
    captures : sequence of Capture
        Runs without compensation that start relaxed.
    lead : LeadMap or None
        Static error, taken out of the captures.

    Returns
    -------
    CompensationLaw, float
        The law itself and 0 where nothing is gained.
    """
    usable = [c for c in captures if c.table_position_m is not None]
    if not usable:
        return law, 0.0
    parts = [_rest(law, loop, capture, lead) for capture in usable]
    columns = np.concatenate([part[0] for part in parts])
    rest = np.concatenate([part[1] for part in parts])
    scale = np.maximum(np.sqrt(np.mean(columns**2, axis=0)), 1e-30)
    found, *_ = np.linalg.lstsq(columns / scale, rest, rcond=1e-6)
    explained = 1.0 - float(np.std(rest - columns / scale @ found) / max(np.std(rest), 1e-30))
    if explained < _LEAST_GAIN_FRAC:
        return law, 0.0
    # The error is what the law takes away: its terms grow by minus the error's.
    values = {
        name: getattr(law, name) - float(change)
        for name, change in zip(_TERMS, found / scale, strict=True)
    }
    if law.gap_half_m > 0.0:
        values["coulomb_m"] = max(values["coulomb_m"], LEAST_COULOMB_m)
    return replace(law, **values), explained


def _rest(
    law: CompensationLaw, loop: LoopRunner, capture: Capture, lead: LeadMap | None
) -> tuple[FloatArray, FloatArray]:
    """Terms and unexplained mechanical error of one run, both without their means."""
    r, table = capture.commanded_position_m, capture.table_position_m
    signals = loop(r, None, gripping_torque(law, capture))
    simulated = signals.table_position_m - signals.motor_position_m
    measured = (table if table is not None else r) - capture.motor_position_m
    rest = measured - simulated - (0.0 if lead is None else lead.at(r))
    columns = _terms(law, signals.motor_position_m, capture.sample_period_s)
    use = capture.mask
    columns, rest = columns[use], rest[use]
    return columns - columns.mean(axis=0), rest - rest.mean()


def _terms(law: CompensationLaw, motor_m: FloatArray, period_s: float) -> FloatArray:
    """Acceleration, speed and direction of the simulated motor, alone and times position."""
    v = np.gradient(motor_m, period_s)
    a = np.gradient(v, period_s)
    s = np.tanh(v / 2e-3)
    x = motor_m - law.origin_m
    return np.column_stack([a, a * x, v, v * x, s, s * x])
