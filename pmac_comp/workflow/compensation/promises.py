"""What the model promised for a run, and what the plant behind a simulated card really did."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.exact import Aim, faded
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.loop import LoopRunner, counted_loop, model_loop
from pmac_comp.physics.compensate.promise import Expected, Static, expect
from pmac_comp.physics.compensate.unmodelled import (
    model_law,
    noted_unmodelled,
    open_at_rest_um,
    widened,
)
from pmac_comp.physics.signals.metrics import rms_um
from pmac_comp.physics.signals.trajectory import Trajectory
from pmac_comp.workflow.accuracy.outcome import ROUNDING, WORSE, error_signals, grown_text
from pmac_comp.workflow.capture.run_cut import LEAD_IN_s, TAIL_s
from pmac_comp.workflow.capture.simulated import Truth
from pmac_comp.workflow.compensation.file import Compensation
from pmac_comp.workflow.law.backlash import backlash_side
from pmac_comp.workflow.law.beyond_model import made_with
from pmac_comp.workflow.law.dynamic_law import without_fed_forward, wobble_of
from pmac_comp.workflow.law.routes import LATENCY_CYCLES, MOTION_ROUTES, TORQUE_ROUTES
from pmac_comp.workflow.motion.approach import RELAXED, approach
from pmac_comp.workflow.motion.motions import Motion

if TYPE_CHECKING:
    from pmac_comp.physics.model.drive import DriveModel


@dataclass(frozen=True)
class Promiser:
    """What a compensation and its model promise for runs of one bench.

    The model promises for its own law: what captures corrected beside it is not its word, but what
    they showed beyond the model widens the promise. Runs begin as ``verify`` lets them begin.

    Parameters
    ----------
    bench, compensation
        The axis and what is on the controller.
    loop, exact : LoopRunner
        Closed loop of the model that the compensation was computed with, with its counts and
        without.
    """

    bench: Bench
    compensation: Compensation
    loop: LoopRunner
    exact: LoopRunner

    @classmethod
    def of(
        cls, bench: Bench, compensation: Compensation | None, drive: "DriveModel | None"
    ) -> "Promiser | None":
        """None without a model or a compensation: nothing is promised."""
        if compensation is None or drive is None:
            return None
        model = without_fed_forward(made_with(drive, compensation.law))
        drawn = compensation.route in MOTION_ROUTES  # with all of its correction in the command
        wave = None if drawn else wobble_of(bench, compensation.lead)
        return cls(bench, compensation, counted_loop(model, wave), model_loop(model, wave))

    def of_run(self, capture: Capture) -> Mapping[str, float]:
        """What is promised for the run that a capture holds, mean taken out, um.

        A motion with a known correction is promised with the command that was drawn.
        """
        motion = Trajectory(capture.time_s, capture.commanded_position_m)
        relaxed = capture.attributes.get("start") == RELAXED
        drawn = capture.desired_m if self.compensation.route in MOTION_ROUTES else None
        return self.of_motion(motion, relaxed=relaxed, drawn_m=drawn)

    def of_known(self) -> Mapping[str, float] | None:
        """The same of the motion of ``cam`` or ``program``, as `verify` runs and cuts it.

        None for a compensation without one.
        """
        known, offset_m = self.compensation.motion_position_m, self.compensation.motion_correction_m
        if known is None or offset_m is None:
            return None
        period_s = self.bench.servo_period_s
        rests = int(LEAD_IN_s / period_s), int(TAIL_s / period_s)
        r = np.pad(known, rests, mode="edge")
        drawn_m = r + np.pad(faded(offset_m), rests)
        along = static_of(self.compensation, self.bench)
        if along is not None:
            drawn_m = drawn_m + along(r).table_m
        time_s = period_s * np.arange(r.size, dtype=np.float64)
        return self.of_motion(Trajectory(time_s, r), drawn_m=drawn_m)

    def of_motion(
        self, motion: Trajectory, *, relaxed: bool = False, drawn_m: FloatArray | None = None
    ) -> Mapping[str, float]:
        """The same of a command; ``drawn_m`` is it with tables and the correction of the motion.

        Beside it stands what the encoder's steps make of e_r through the loop: the difference to
        what the same model does with exact positions.
        """
        start_m = float(motion.position_m[0])
        head = np.zeros(0) if relaxed else approach(self.bench, start_m)
        own, exact = (
            self._of_loop(loop, motion, head, drawn_m) for loop in (self.loop, self.exact)
        )
        law, at_rest_um = self.compensation.law, 0.0
        if self.compensation.route in TORQUE_ROUTES:
            at_rest_um = open_at_rest_um(law, motion.position_m)
        found = widened(own.errors, noted_unmodelled(law), at_rest_um)
        return {**found, ROUNDING: rms_um(own.residual_m - exact.residual_m)}

    def _of_loop(
        self,
        loop: LoopRunner,
        motion: Trajectory,
        head_m: FloatArray,
        drawn_m: FloatArray | None,
    ) -> Expected:
        compensation = self.compensation
        static = static_of(compensation, self.bench)
        if drawn_m is not None:
            return expect_drawn(loop, motion, drawn_m, head_m, static)
        law = CompensationLaw()
        if compensation.route in TORQUE_ROUTES:
            law = model_law(compensation.law)
        return expect(
            law,
            loop,
            motion,
            latency_cycles=LATENCY_CYCLES[compensation.route],
            lead_in_m=head_m,
            static=static,
        )


def worse_known_remarks(promiser: Promiser, aim: Aim) -> list[str]:
    """That the model expects the one motion of a compensation to get worse with it, for people."""
    said = promiser.of_known()
    if said is None:
        return []
    worse = [
        f"{what} {grown_text(before, after)}"
        for what, before, after, judged in (
            ("total error", said["total_before_um"], said["model_total_after_um"], True),
            ("e_r", said["e_before_um"], said["model_e_r_after_um"], aim is Aim.MECHANICAL),
        )
        if judged and after > WORSE * before
    ]
    if not worse:
        return []
    return [f"the model expects the motion to get worse, its rests included: {'; '.join(worse)}"]


def worse_remarks(promiser: Promiser, motions: Sequence[Motion]) -> list[str]:
    """Motions that the model expects to get worse with the compensation, for people."""
    worse: list[str] = []
    for motion in motions:
        said = promiser.of_motion(motion.trajectory)
        for what, before, after in (
            ("total error", said["total_before_um"], said["model_total_after_um"]),
            ("e_r", said["e_before_um"], said["model_e_r_after_um"]),
        ):
            if after > WORSE * before:
                worse.append(f"{motion.name}: {what} {grown_text(before, after)}")
    if not worse:
        return []
    return [
        "the model expects these motions to get worse: "
        + "; ".join(worse)
        + ". A static error that a table takes away may have hidden a part of the loop's lag"
    ]


def static_of(compensation: Compensation, bench: Bench) -> Callable[[FloatArray], Static] | None:
    """Lead error along a command, and what the tables add; None without a map."""
    lead, mean = compensation.lead, compensation.table_correction(bench)
    if lead is None or mean is None:
        return None
    back = compensation.backlash_table(bench)
    count_m = bench.motor_resolution_m

    def along(command_m: FloatArray) -> Static:
        centred = mean(command_m)
        added = centred
        if back is not None:
            side = backlash_side(command_m, bench)
            added = centred + 0.5 * side * back.table.backlash_ct(command_m / count_m) * count_m
        return Static(lead.at(command_m), added, centred)

    return along


def expect_drawn(
    loop: LoopRunner,
    motion: Trajectory,
    desired_m: FloatArray,
    head_m: FloatArray,
    static: Callable[[FloatArray], Static] | None = None,
) -> Expected:
    """What the model expects when a motion is drawn with its correction and its tables in it."""
    r = np.concatenate([head_m, motion.position_m])
    fixed = Static.nothing(r.size) if static is None else static(r)
    added = np.concatenate([fixed.table_m[: head_m.size], desired_m - motion.position_m])
    runs = loop(r, None, None), loop(r, r + added, None)
    return Expected(r, *runs, added, fixed, head_m.size)


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
