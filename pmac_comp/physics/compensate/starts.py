"""How the runs of a calibration began: what friction held, as their torque at rest tells.

What lives here: that torque beside each capture. What may not: its arithmetic (``physics.model``).

A run follows an earlier move, and at rest the integrator winds against friction. A model that
begins relaxed misses its motor by micrometres until the integrator has unwound, and what it misses
so would be taken for something that the drive has and the model lacks.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.constant import constant_torque
from pmac_comp.physics.compensate.loop import load_torque_Nm, model_loop
from pmac_comp.physics.model.resting import start_of

if TYPE_CHECKING:
    from pmac_comp.physics.model.drive import DriveModel

_RESTING = "resting_torque_Nm"  # attribute of a capture in memory, not of its file


def with_starts(model: "DriveModel", captures: Sequence[Capture]) -> list[Capture]:
    """Captures that know with what torque of friction the loop of a model has to begin them.

    Parameters
    ----------
    model : DriveModel
        Its control law tells what of the torque the integrator holds; a load, constant or by place,
        its own or one that it lacks, is no friction.
    captures : sequence of Capture
        Runs without compensation.
    """
    own_Nm, beyond = load_torque_Nm(model), constant_torque(model_loop(model), captures)
    starts = [c.commanded_position_m[0] for c in captures]
    loads = [own_Nm + (0.0 if beyond is None else beyond.at(start)) for start in starts]
    return [
        c.with_attributes(**{_RESTING: _held_Nm(model.bench, c, load_Nm)})
        for c, load_Nm in zip(captures, loads, strict=True)
    ]


def _held_Nm(bench: Bench, capture: Capture, constant_Nm: float) -> float:
    start = start_of(
        bench,
        capture.desired_m,
        capture.motor_position_m,
        capture.torque_command_Nm,
        capture.sample_period_s,
    )
    # In motion friction holds nothing: the loops here begin at rest.
    rests = start.speed_m_per_s == 0.0 and start.torque_Nm != 0.0
    return start.torque_Nm - constant_Nm if rests else 0.0


def held_at_start_Nm(capture: Capture) -> float:
    """Torque in N m that friction held as a run began; 0 where nobody has looked."""
    return float(capture.attributes.get(_RESTING, 0.0))


def state_at_start(capture: Capture, friction_Nm: float) -> float:
    """The same as a friction state, -1 to 1, of a drive with this friction."""
    if friction_Nm <= 0.0:
        return 0.0
    return float(np.clip(held_at_start_Nm(capture) / friction_Nm, -1.0, 1.0))
