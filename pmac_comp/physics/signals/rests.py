"""Rests of a command, and what torque and motor do over them.

What lives here: where a command stands, and slow motion of the motor there. What may not: models.
Imports ``base`` and ``files``.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pmac_comp.base.arrays import BoolArray, FloatArray, stretches
from pmac_comp.files.capture import Capture

_LEAST_REST_s = 0.02  # a shorter stop is a reversal
_REST_STEP_m = 1e-10  # commands nearer than this are one place
_BIN_s = 0.02  # over which positions are averaged: a count that flickers is no speed


def rests_of(position_m: FloatArray, period_s: float) -> tuple[slice, ...]:
    """Stretches of a command, shape (n,) in m, over which it stands for 20 ms or longer."""
    still = np.abs(np.diff(position_m, prepend=position_m[0])) < _REST_STEP_m
    least = _LEAST_REST_s / period_s
    return tuple(rest for rest in stretches(still) if rest.stop - rest.start > least)


def moving_of(n: int, rests: Sequence[slice]) -> BoolArray:
    """Samples outside rests, shape (n,)."""
    moving = np.ones(n, dtype=np.bool_)
    for rest in rests:
        moving[rest] = False
    return moving


def slow_motion_at_rest(capture: Capture) -> FloatArray:
    """Torque in N m, speed in m/s and place in m of the motor over rests of a run, shape (3, n).

    Means over 20 ms; none of the first 20 ms of a rest, where the loop's lag goes. A run without
    torque, or without rests, has none.
    """
    found = [np.zeros((3, 0))]
    period, torque_Nm = capture.sample_period_s, capture.torque_command_Nm
    if torque_Nm is None:
        return found[0]
    size = max(round(_BIN_s / period), 1)
    for rest in rests_of(capture.commanded_position_m, period):
        begins = rest.start + (size if rest.start > 0 else 0)
        n = (rest.stop - begins) // size
        if n < 2:
            continue
        bins = slice(begins, begins + n * size)
        place_m, mean_Nm = (
            values[bins].reshape(n, size).mean(axis=1)
            for values in (capture.motor_position_m, torque_Nm)
        )
        speed_m_per_s = np.diff(place_m) / (size * period)
        found.append(np.stack([_middles(mean_Nm), speed_m_per_s, _middles(place_m)]))
    return np.concatenate(found, axis=1)


@dataclass(frozen=True)
class Slope:
    """Speed by push at rests, its standard deviation, and the share of speed that it explains."""

    value: float
    std: float
    explained: float


def speed_by_push(push: FloatArray, speed: FloatArray, *, fitted: int = 1) -> Slope | None:
    """Slope through zero of speeds by pushes, shape (n,) each; None where nothing pushes.

    ``fitted`` numbers were taken from these samples, the slope among them.
    """
    square = float(push @ push)
    if push.size <= fitted or square == 0.0:
        return None
    slope = float(push @ speed) / square
    left = speed - slope * push
    std = float(np.sqrt(left @ left / (push.size - fitted) / square))
    return Slope(slope, std, 1.0 - float(left @ left) / max(float(speed @ speed), 1e-30))


def _middles(values: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (values[1:] + values[:-1]))
