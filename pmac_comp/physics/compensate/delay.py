"""Time from a torque command to the shaft: dead time, hold, and the lag of the current loop.

It is what a law has to look ahead by, beside the latency of its door.
"""

import math
from typing import TYPE_CHECKING

from pmac_comp.files.bench import Bench

if TYPE_CHECKING:
    from pmac_comp.physics.model.drive import DriveModel


def drive_delay_s(model: "DriveModel") -> float:
    """Delay in s from torque command to shaft of a model.

    A grown model states the totals, which stand in place of those of the chain.
    """
    own = model.parameters
    dead_s = own.get("actuator_delay.time_s", own.get("chain.actuator_delay_s"))
    lag = "current_bandwidth.bandwidth_Hz", "chain.current_bandwidth_Hz"
    bandwidth_Hz = own.get(lag[0], own.get(lag[1]))
    return nominal_delay_s(model.bench, dead_s, bandwidth_Hz)


def nominal_delay_s(
    bench: Bench, dead_s: float | None = None, bandwidth_Hz: float | None = None
) -> float:
    """The same by the bench file, where a model does not know better."""
    nominal = bench.nominal
    if dead_s is None:
        dead_s = (nominal.actuator_delay_us or 0.0) * 1e-6
    if bandwidth_Hz is None:
        bandwidth_Hz = nominal.current_bandwidth_Hz or math.inf
    return dead_s + 1.0 / (2.0 * math.pi * bandwidth_Hz) + 0.5 * bench.servo_period_s
