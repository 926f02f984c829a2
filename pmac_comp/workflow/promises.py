"""What the model promised for a run, and what the plant behind a simulated card really did."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.design import MotionPromise, promise
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.unmodelled import Unmodelled, model_law, widened
from pmac_comp.physics.signals.metrics import centred_rms_um, rms_um
from pmac_comp.physics.signals.trajectory import Trajectory
from pmac_comp.workflow.compensation_file import Compensation
from pmac_comp.workflow.outcome import error_signals
from pmac_comp.workflow.routes import LATENCY_CYCLES, MOTION_ROUTES, TORQUE_ROUTES
from pmac_comp.workflow.simulated import Truth


def promised(
    compensation: Compensation | None, loop: Any, capture: Capture
) -> Mapping[str, float] | None:
    """What the model promises for the commanded motion of a capture, mean taken out, um.

    None without a model or a compensation. The model promises for its own law: what captures
    corrected beside it is not its word, but what they showed beyond the model widens the promise.
    A table promises nothing beyond the static part; a motion with a known correction is promised
    with the command that was drawn.
    """
    if compensation is None or loop is None:
        return None
    motion = Trajectory(capture.time_s, capture.commanded_position_m)
    if compensation.route in MOTION_ROUTES:
        drawn = promise_drawn(loop, motion, capture.desired_m)
        return widened(drawn, _rest_of(compensation.law))
    on_card = compensation.route in TORQUE_ROUTES
    law = model_law(compensation.law) if on_card else CompensationLaw()
    latency = LATENCY_CYCLES[compensation.route]
    own = promise(law, loop, motion, latency_cycles=latency)
    return widened(own, _rest_of(compensation.law))


def _rest_of(law: CompensationLaw) -> Unmodelled | None:
    """What the captures showed beyond the model, as the compensation file keeps it."""
    found = law.provenance.get("unmodelled")
    return None if found is None else Unmodelled.from_mapping(found)


def promise_drawn(loop: Any, motion: Trajectory, desired_m: FloatArray) -> MotionPromise:
    """What the model expects when a motion is drawn with its correction in it."""
    r = motion.position_m
    before, after = loop(r, None, None), loop(r, desired_m, None)
    correction = desired_m - r
    return MotionPromise(
        e_before_um=centred_rms_um(before.table_position_m - before.motor_position_m),
        e_r_after_um=centred_rms_um(after.table_position_m - after.motor_position_m + correction),
        e_c_before_um=centred_rms_um(before.motor_position_m - r),
        e_c_after_um=centred_rms_um(after.motor_position_m - desired_m),
        total_before_um=centred_rms_um(before.table_position_m - r),
        total_after_um=centred_rms_um(after.table_position_m - r),
    )


def true_errors(
    truth: Truth | None,
    before: Sequence[Capture],
    after: Sequence[Capture],
    compensation: Compensation,
    correction: Callable[[FloatArray], FloatArray] | None,
) -> Mapping[str, float] | None:
    """The same errors on the plant's unquantised positions, um rms; simulated cards only."""
    if truth is None:
        return None
    values: dict[str, list[FloatArray]] = {}
    for side, captures in (("before", before), ("after", after)):
        for capture in captures:
            found = truth.of(capture)
            if found is None:
                return None
            true = replace(capture, motor_position_m=found[0], table_position_m=found[1])
            signals = error_signals(
                true, compensation.lead, correction if side == "after" else None
            )
            names = (
                "e_before" if side == "before" else "e_r_after",
                f"e_c_{side}",
                f"total_{side}",
            )
            parts = (signals.mechanical_m, signals.control_m, signals.total_m)
            for name, part in zip(names, parts, strict=True):
                values.setdefault(f"{name}_um", []).append(part)
    return {name: rms_um(np.concatenate(parts)) for name, parts in values.items()}
