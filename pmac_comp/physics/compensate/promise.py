"""What a model promises of a law on one motion, begun as the measured run begins.

What lives here: the simulated runs without and with a law, and their errors. What may not: how a
controller reaches a start (``workflow``), what captures show beyond the model (``unmodelled``).

A run begins with the friction that its approach left and with what the integrator wound against it
at rest, and counts of the encoder feed the loop: a simulation that starts relaxed and knows
positions exactly expects less than the same model does of the same run. So the motion is simulated
with the command that leads to it, in a loop that rounds as the sensors do; errors are those of the
unrounded positions. The law on a controller looks at its output at rest, which depends on the law:
runs are repeated until the law agrees with the output. What a rest hands over depends on what was
before it only, so that takes one run more than there are rests.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.physics.compensate.evaluation import LawSignals, evaluate_law
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.loop import LoopRunner, LoopSignals
from pmac_comp.physics.signals.metrics import centred_rms_um
from pmac_comp.physics.signals.trajectory import Trajectory

_MOST_RUNS = 12
_AGREED_FRAC = 1e-3  # of the friction torque


@dataclass(frozen=True)
class MotionPromise:
    """What a model promises for one motion, rms in um.

    Parameters
    ----------
    e_before_um, e_r_after_um : float
        Mechanical error without, residual mechanical error with compensation.
    e_c_before_um, e_c_after_um, total_before_um, total_after_um : float
        Control tracking error and total error.
    """

    e_before_um: float
    e_r_after_um: float
    e_c_before_um: float
    e_c_after_um: float
    total_before_um: float
    total_after_um: float


@dataclass(frozen=True)
class Static:
    """Static errors along a motion and what tables add against them, m, shape (n,) each.

    Parameters
    ----------
    lead_m : ndarray
        Error of the screw, mean of both directions.
    table_m : ndarray
        What the tables add, in the direction of the motion.
    mean_m : ndarray
        The same as the mean of both directions, which takes the place of the lead error.
    """

    lead_m: FloatArray
    table_m: FloatArray
    mean_m: FloatArray

    @classmethod
    def nothing(cls, n: int) -> "Static":
        """No lead error and no tables."""
        return cls(*(np.zeros(n) for _ in range(3)))


@dataclass(frozen=True)
class Expected:
    """Simulated runs of one motion without and with a compensation; shapes (n,), m.

    Parameters
    ----------
    commanded_m : ndarray
        Command, with what leads to the motion before it.
    before, after : LoopSignals
        The loop without and with the compensation.
    added_m : ndarray
        All that the compensation added to the command.
    static : Static
        Lead error and tables.
    begins : int
        Sample at which the motion begins.
    """

    commanded_m: FloatArray
    before: LoopSignals
    after: LoopSignals
    added_m: FloatArray
    static: Static
    begins: int

    @property
    def residual_m(self) -> FloatArray:
        """e_r of the motion in m, mean taken out, shape (n,) from where the run counts."""
        after = self.after
        found = after.table_position_m - after.motor_position_m + self.added_m - self.static.mean_m
        return np.asarray(found[self.begins :] - np.mean(found[self.begins :]))

    @property
    def errors(self) -> MotionPromise:
        """All errors in um rms, mean taken out."""
        r, before, after = self.commanded_m, self.before, self.after

        def um(values: FloatArray) -> float:
            return centred_rms_um(values[self.begins :])

        return MotionPromise(
            e_before_um=um(before.table_position_m - before.motor_position_m),
            e_r_after_um=centred_rms_um(self.residual_m),
            e_c_before_um=um(before.motor_position_m - r),
            e_c_after_um=um(after.motor_position_m - r - self.added_m),
            total_before_um=um(before.table_position_m + self.static.lead_m - r),
            total_after_um=um(after.table_position_m + self.static.lead_m - r),
        )


def promise(
    law: CompensationLaw, loop: LoopRunner, motion: Trajectory, *, latency_cycles: int = 1
) -> MotionPromise:
    """What the model expects of a law on one motion that starts relaxed, on the spot."""
    return expect(law, loop, motion, latency_cycles=latency_cycles).errors


def expect(
    law: CompensationLaw,
    loop: LoopRunner,
    motion: Trajectory,
    *,
    latency_cycles: int = 1,
    lead_in_m: FloatArray | None = None,
    static: Callable[[FloatArray], Static] | None = None,
) -> Expected:
    """Runs that the model expects of one motion.

    Parameters
    ----------
    law, loop, motion
        The law, the closed loop of the model, and the commanded motion.
    latency_cycles : int
        Servo cycles by which the door delivers late.
    lead_in_m : ndarray, shape (k,), or None
        Command before the motion, which ends where the motion begins; None: relaxed, on the spot.
    static : callable, optional
        Lead error and tables along a command; none if not given.
    """
    head = np.zeros(0) if lead_in_m is None else lead_in_m
    r = np.concatenate([head, motion.position_m])
    fixed = Static.nothing(r.size) if static is None else static(r)
    before = loop(r, None, None)
    sent, after = run_with_law(
        law, loop, r, motion.sample_period_s, latency_cycles=latency_cycles, table_m=fixed.table_m
    )
    return Expected(r, before, after, sent.correction_m + fixed.table_m, fixed, head.size)


def run_with_law(
    law: CompensationLaw,
    loop: LoopRunner,
    commanded_m: FloatArray,
    period_s: float,
    *,
    latency_cycles: int = 1,
    table_m: FloatArray | None = None,
) -> tuple[LawSignals, LoopSignals]:
    """What a law sends along a command and the loop with it, once both agree about the rests.

    ``commanded_m`` and the tables' correction ``table_m``, both in m, have shape (n,).
    """
    table = 0.0 if table_m is None else table_m

    def run(output_Nm: FloatArray | None) -> tuple[LawSignals, LoopSignals]:
        sent = evaluate_law(
            law, commanded_m, period_s, latency_cycles=latency_cycles, output_Nm=output_Nm
        )
        desired = commanded_m + sent.correction_m + table
        return sent, loop(commanded_m, desired, sent.torque_Nm)

    sent, signals = run(None)
    for _ in range(_MOST_RUNS if law.torque_coulomb_Nm > 0.0 else 0):
        last = sent.torque_Nm
        sent, signals = run(signals.torque_Nm)
        if np.max(np.abs(sent.torque_Nm - last)) <= _AGREED_FRAC * law.torque_coulomb_Nm:
            break
    return sent, signals
