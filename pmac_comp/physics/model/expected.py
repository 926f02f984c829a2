"""What a drive does on average, given that its encoder rounds inside the loop.

What lives here: the mean of simulations that round as the sensors do. What may not: equations and
fitting. Imports ``drive`` and ``base``.

An encoder of 1 um makes the loop hunt by tenths of a um; how, depends on where positions lie
between two counts. That is known from the command as far as the model knows the motor's position,
some hundredths of a count: the mean over simulations with the motion moved by so little keeps what
can be foreseen and averages what cannot. A single rounding simulation errs by both, a smooth one
misses both.
"""

from concurrent.futures import Executor
from typing import Any

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.physics.model.drive import DriveModel, Response, simulate_many
from pmac_comp.physics.model.start import RELAXED, Start

# Eight equally likely places of a normal distribution, in standard deviations.
_PLACES = (-1.53, -0.89, -0.49, -0.157, 0.157, 0.49, 0.89, 1.53)
_KNOWN_TO = 0.05  # of a count


def expected_response(
    model: DriveModel,
    commanded_position_m: FloatArray,
    *,
    desired_position_m: FloatArray | None = None,
    torque_feedforward_Nm: FloatArray | None = None,
    external_force_N: FloatArray | None = None,
    start: Start = RELAXED,
    executor: Executor | None = None,
) -> Response:
    """Mean unrounded response of the closed loop whose sensors and output round.

    Parameters
    ----------
    model, commanded_position_m, desired_position_m, torque_feedforward_Nm, external_force_N
        As in ``simulate``, shape (n,) each. Position zero lies in the middle of a count.
    start : Start
        As in ``simulate``.
    executor : Executor or None
        Where simulations run; None uses threads.

    Returns
    -------
    Response
        Positions before rounding, torque with what rounding makes of it on average.

    Raises
    ------
    NonFinite, ModelError
        As ``simulate``.
    """
    shifts = _KNOWN_TO * model.bench.motor_resolution_m * np.array(_PLACES)
    given = {
        "torque_feedforward_Nm": torque_feedforward_Nm,
        "external_force_N": external_force_N,
        "start": start,
    }
    options: list[dict[str, Any]] = [
        {
            **given,
            "quantise": True,
            "desired_position_m": None if desired_position_m is None else desired_position_m + s,
        }
        for s in shifts
    ]
    commands = [commanded_position_m + s for s in shifts]
    runs = simulate_many([model] * shifts.size, commands, executor=executor, options=options)

    def mean(name: str) -> FloatArray:
        return np.asarray(np.mean([getattr(run, name) for run in runs], axis=0))

    motor, table = mean("true_motor_position_m"), mean("true_table_position_m")
    return Response(
        time_s=runs[0].time_s,
        commanded_position_m=mean("commanded_position_m"),
        desired_position_m=mean("desired_position_m"),
        motor_position_m=motor,
        table_position_m=table,
        torque_command_Nm=mean("torque_command_Nm"),
        motor_torque_Nm=mean("motor_torque_Nm"),
        joint_force_N=mean("joint_force_N"),
        true_motor_position_m=motor,
        true_table_position_m=table,
    )
