"""What the loop lacks to follow a table that takes the wobble of the lead away.

What lives here: the wave of torque against it, fitted in the model's loop, and whether it is worth
the place that it takes. What may not: captures, the table itself.

A table moves the motor against the wobble, n times per turn, so that the axis stays. Nothing is
fed forward for that: the position loop alone swings the motor, late, and what it lacks shakes the
table through the spring of the nut, the more the nearer n times the turns per second come to the
first mode. Of 3 um twice per turn the paper's bench (model) has 3.0 um rms of ``e_r`` left at
93 Hz, 1.7 um at 80 Hz and 0.2 um at 40 Hz.

What is lacking grows with the cube of the speed or little less: the loop's lag with the speed, the
inertia's torque with its square. Its phase in time hardly changes: in the model, with the paper's
loop, with a current loop of 150 Hz, a dead time of 1.1 ms, tables of 15 and of 80 kg, once to three
times per turn and from 0.2 to 0.47 m/s, the torque that is missing leads the wobble by 122 to 145
degrees wherever the wobble leaves more than 0.1 um. So one wave of torque,
``v^3 sin(n angle + phase + 45 degrees in the way it goes)``, takes 0.8 to 0.9 of it, also where n
times the turns per second pass the first mode, as more than twice per turn do; its size is fitted.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.compensate.evaluation import evaluate_law
from pmac_comp.physics.compensate.judgement import aims
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.lead import LeadWave
from pmac_comp.physics.compensate.loop import LoopRunner
from pmac_comp.physics.compensate.motions import design_motions, fastest_move
from pmac_comp.physics.signals.trajectory import Trajectory

_PROBE_Nm = 0.1  # at the highest speed
WORTH = 0.2  # of an aim: a wobble that makes less is left
_IN_ITS_PLACE = (
    "turn_friction_Nm",
    "turn_share",
    "torque_loop_Nm_s2_per_m",
    "torque_loop_Nm_s_per_m",
)
_KEPT_FRAC = 0.7  # of it must not stay


def with_wobble(
    law: CompensationLaw,
    bench: Bench,
    wave: LeadWave,
    loop: LoopRunner,
    wobbling: LoopRunner,
    *,
    latency_cycles: int,
    worth: float = WORTH,
) -> CompensationLaw:
    """Law with the wave of torque, where that takes away more than the wave that has its place.

    Parameters
    ----------
    law : CompensationLaw
        Of a route with torque.
    bench : Bench
        Travel and limits.
    wave : LeadWave
        What the table takes away.
    loop, wobbling : LoopRunner
        Closed loop of the model without and with it.
    latency_cycles : int
        Servo cycles by which the door delivers late.
    worth : float
        Share of an aim: a wobble that makes less in the worst move is left.

    Returns
    -------
    CompensationLaw
        The law itself where it would gain little.
    """
    # A wobble shakes fast moves, friction by the turn and torque that ripples slow ones as well.
    motions = (*design_motions(bench), fastest_move(bench))
    asked = [aims(loop, motion) for motion in motions]

    def errors(law: CompensationLaw, loop: LoopRunner, wave: LeadWave | None) -> list[FloatArray]:
        runs = (_Run(law, loop, wave, motion, latency_cycles) for motion in motions)
        return [run.errors(aim) for run, aim in zip(runs, asked, strict=True)]

    none = dict.fromkeys(_IN_ITS_PLACE, 0.0)
    bare = law.with_values(**none)
    phase_rad = wave.phase_rad + math.pi  # the motor swings against the wobble
    probe = bare.with_values(
        torque_wobble_Nm_s3_per_m3=_PROBE_Nm / bench.usable_speed_m_per_s**3,
        turn_order=float(wave.order),
        turn_phase_rad=phase_rad,
    )
    without = errors(bare, wobbling, wave)
    lacking = _less(without, errors(bare, loop, None))
    made = _less(errors(probe, wobbling, wave), without)
    gain = -float(_joined(made) @ _joined(lacking) / (_joined(made) @ _joined(made)))
    left = [one + gain * other for one, other in zip(lacking, made, strict=True)]
    in_place = _less(errors(law, loop, None), errors(bare, loop, None))
    before, after = _typical(lacking), _typical(left)
    little = _worst(lacking) < worth or after > _KEPT_FRAC * before
    if little or before - after < _typical(in_place):
        return law
    return probe.with_values(
        torque_wobble_Nm_s3_per_m3=abs(gain) * probe.torque_wobble_Nm_s3_per_m3,
        turn_phase_rad=phase_rad if gain > 0.0 else phase_rad + math.pi,
    )


@dataclass(frozen=True)
class _Run:
    """A motion with a law and with the table against a wobble."""

    law: CompensationLaw
    loop: LoopRunner
    wave: LeadWave | None
    motion: Trajectory
    latency_cycles: int

    def errors(self, aim: tuple[float, float]) -> FloatArray:
        """e_r and total error as shares of their aims, one after the other."""
        r = self.motion.position_m
        sent = evaluate_law(
            self.law, r, self.motion.sample_period_s, latency_cycles=self.latency_cycles
        )
        wobble = np.zeros(r.size) if self.wave is None else self.wave.at(r)
        signals = self.loop(r, r + sent.correction_m - (wobble - wobble[0]), sent.torque_Nm)
        # The loop's table is that beside the place that the wobble gives it.
        e_r = signals.table_position_m - signals.motor_position_m + sent.correction_m
        total = signals.table_position_m + wobble - r
        return np.concatenate([(e_r - e_r.mean()) / aim[0], (total - total.mean()) / aim[1]])


def _less(those: Sequence[FloatArray], others: Sequence[FloatArray]) -> list[FloatArray]:
    return [one - other for one, other in zip(those, others, strict=True)]


def _joined(errors: Sequence[FloatArray]) -> FloatArray:
    """All motions with the same weight."""
    return np.concatenate([one / math.sqrt(one.size) for one in errors])


def _worst(errors: Sequence[FloatArray]) -> float:
    """Largest rms of a motion, of e_r or of the total error, as a share of its aim."""
    halves = [half for one in errors for half in np.split(one, 2)]
    return max(float(np.sqrt(np.mean(half**2))) for half in halves)


def _typical(errors: Sequence[FloatArray]) -> float:
    """Rms over all motions."""
    joined = _joined(errors)
    return math.sqrt(float(joined @ joined) / (2.0 * len(errors)))
