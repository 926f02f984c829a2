"""The dynamic compensation law: one set of coefficients and the equations that they stand in.

What lives here: the law as data in SI with its validity and provenance, and what its coefficients
mean. What may not: its arithmetic (``evaluation``), counts and registers (``workflow`` renders the
law for a controller), the fit of the coefficients (``design``). Imports ``base`` only.

With ``r`` the commanded position, ``v a j`` its backward differences at the servo period (a step of
less than ``rest_step_m`` is a rest) and ``x`` the distance from the law's origin::

    j  = limit((v' - a) / T, J)      a' = j              acceleration with its jerk limited
    p' = v + L a + L (L + T)/2 j                        speed of the place expected L seconds later
    s' = (|p'| (sgn p' - s)) / break-away distance      friction state, follows that place's way
    z' = (s - z) / MS                                   the same, as the drive follows it
    k  = j, 0 where |v' - a| > 2 J T                     a step of it: no jerk of the motion's
    y" = -M a - D y' - O y                              acceleration of the bed that swings
    b' = |v| (y" - b) / break-away distance             what the table feels of it
    w  = 1 / (1 + q + q^2/2),  q = (p' / VS)^2           what speed leaves of Stribeck friction
    d' = (|p'| (sgn p' - d)) / DD                       drag state, in place of the bed
    e  = A0 (a + b) + V0 v + VU |v| + (S0 + SS w) z + DX d       elastic, as the force in the nut
    f  = B + e + L A0 j                                 with a constant load, L seconds later
    g  = f / max(|f|, W), at rest as it was             flank of the nut by the force in it
    h' = (g - h) / M                                    flank of the nut as the motor changes it
    correction = (1 + K x) e + G (h - h0) + J0 j        added to the command
    q  = 2 pi (r + L v) / turn                          angle of the screw, looking ahead
    sent = TJ a + TK k + TI (j1 - j2) + TB v + (TC + TS w + TE |a| + TR sin(m q + PR)) t
           + (TF (t - t1) + TL (t1 - t2)) / T + T0 + TP x + TY b + TD d
    torque = sent + (sent + RT a + RV v) RS sin(m q + PR)
             + TW v^3 sin(m 2 pi r' / turn + PR + t pi/4)
             + TH sin(n q + PH) + TU |v| + TG (g - h)      added to the output

With an m below zero the wave TR is a second cogging, added without ``t``.

A table that takes the lead's wobble away asks the motor to swing m times per turn, which its loop
follows late: TW sends what that lacks (``wobble``), with r' the place that the axis has where the
servo receives the value, a cycle before. A law has one of TR, RS and TW.

A motor whose torque constant ripples makes a share RS more or less of the torque that it is sent,
also of RT a and RV v, which the loop sends by itself, but not of what stands against its integrator
and pushes nothing. To first order: of a tenth half a hundredth is left. In simulation 9 % of ripple
left twice the aim of e_r, and of the total error 0.17 in place of 0.09.

Friction that differs between the directions is the mean of both, a constant (T0), and what grows
with the speed either way: VU and TU. A controller has their places, and those of RS and RT, where a
law without a gap would have G's, so a law has one of the two; beside a gap RS and RT take the
places of a bed.

The elastic error is the force in the nut times the compliance of screw, nut and bearings, and what
the screw adds to that grows with the distance from its fixed bearing: one slope K for all three
terms (``model.quasi_static``).

``t`` is a second friction state with the break-away distance of the motor's friction. The
look-ahead L covers the delay of door and drive: at a reversal the friction's step must meet
the axis on time, and a lead by derivatives makes a spike of a step that rings the first mode
instead. The extrapolation is Newton's by backward differences, exact for constant jerk: a move that
ends is not taken for one that turns, and at rest the place expected is the place, so what was
foreseen and did not come is taken back. Steps of the acceleration the law follows no faster than J,
which motions with limited jerk never meet, and answers that jerk with no torque: torque for it made
the first mode ring 1.1 to 1.3 times as much as without compensation, without it 0.7 to 1.05 times
(model, steps of 1 to 5 m/s2, seven drives).

A step of the jerk, which no command foretells, meets the drive late by L and rings its first mode.
An impulse of torque one pass after it takes a part of that away: j1 and j2 are the jerk one and two
passes ago, TI is fitted in the loop. In simulation it takes 0.4 off e_r of moves on the paper's
bench, and as much where the current loop is late.

Friction that turns over rings that mode too, and is what slow motions have most of. TF and TL send
torque while ``t`` does so and a pass later (t1 and t2 are those of the last passes): a start, a
stop or a shift in time of its step, as the drive needs, and nothing else of a motion. What a rest
or the output moves ``t`` by is no part of it. Fitted in the loop they take 0.07 to 0.5 off the
worst e_r of slow sinusoids in models of five drives (0.14 where the current loop is late).

The drive needs time for that step too: however soon it is asked for, the nut is loaded the other
way by no more torque than is sent, and the table is stuck until it is. A correction that turns over
with the command is there a few milliseconds before the error that it undoes, and rings the mode
more. So its friction ``z`` follows ``s`` with a lag MS of one to seven milliseconds, fitted in the
loop. In models it takes 0.01 to 0.18 off the worst share of the aim that slow sinusoids leave (none
where the nut slides before it grips), with 2 to 4 um of play 0.12 to 0.25.

Friction may also set in with speed, as grease and seals shear: with SS = -S0 and TS = -TC, 1 - w
stands for tanh(p' / v_c), at most 0.16 off where VS is 0.8 v_c. Such friction holds nothing.

Over the first 100 cycles of a rest ``t`` fades, to 0.37 where nothing else is known. All of it is
just what breaks the motor loose: with what the integrator holds beside it, and where counts of the
encoder keep the drive ringing, a motor whose bearings slide into their friction creeps on by
micrometres (10 um of 20 mm pitch). Were nothing left, it would creep back by its presliding
distance, and leave the table behind; so how fast it fades (RF) is fitted. A card starts ``t`` at
zero when the law is armed.

Where a motion ends hard, the force of its inertia leaves the nut at once, the drive rings, and the
table comes along as the screw unwinds: ``s`` fades too (UF, of the model: ``resting``), to 0.67
where nothing else is known. Where it ends softly nothing shakes it, and all of the lag stays. With
h how hard the command accelerated as it ended (in motion each pass goes a tenth of the way to |a|)
``s`` loses UF h / (h + R), with R = 0.3 (S0 + SS) / A0, three tenths of the acceleration that loads
the nut as friction does. In closed-loop simulation of five drives, with Coulomb friction and
presliding at guide, nut or both, 0.2 to 0.9 of the lag are left after moves of 1.5 to 5 m/s2 and
0.85 to 1 after slow sinusoids, which this tells within 0.02 to 0.15; with one mean for all the
sinusoids were missed by 0.2 to 0.4. With play it is chance. Beside a bed, whose places on a
controller this has, h counts as hard.

At rest nothing accelerates: what the output holds beside bias and cogging is friction. The card
therefore looks at its own output while the command rests. What that has beyond the law's torque, of
the integrator and of the position error, tells where friction stands; a motion begins with ``t``
there, no further than friction reaches, and the difference stays in the torque and fades over the
motion, so that nothing jumps. Here that needs the output of a run (``evaluate_law``); without one
no rest winds anything.

Over a long rest a loop hunts: its integrator takes the output from the friction that ``t`` holds to
anywhere within friction, on average to none. After moves that all go one way that is the same
torque each time, which the law has to undo each time: without more it grew to nine times the
friction, and a longer move after such steps of 5 mm began 25 um off (simulated, a heavy table on a
noisy encoder, rests of 20 s). So what stands against the integrator gives way in a rest, by as much
as ``t`` holds and only where it pushes the way that ``t`` does: the output goes to about zero,
which friction holds, and the motor stands where it stood. It does so when a rest is so long that
the next motion begins by the output: between short moves the loop, which knows nothing of it, would
stop beside its goal, its integrator break the motor loose there, and the screw stand wound the
other way (1.6 um of the table, simulated with sharp friction). With play in the nut only what is
more than friction does: less, let go, left the motor of a hanging axis at rest on the other flank.

What stands against the integrator pushes nothing together with it, and as it fades the loop sheds
as much by a steady error: that torque over the proportional gain, times the integrator's time over
that of the fading. The sum over time is the same however fast it fades. In 1.5 s it was 2 um for
each friction torque on that drive, and the first targets of a positioning run lay 4 um off, more
than without a law; in 4.4 s it is a third of that. Slower still, more of it would be left for the
moment in which a law is switched off, and the integrator moves the motor (7 um per N m there).

With backlash the nut changes its flank with the force it transmits, not with the velocity. The
elastic correction is that force over the stiffness, so ``e`` tells the flank: half the gap G is
taken up as ``e`` passes zero, from -W to W, foreseen by the look-ahead as the motor takes its
time. A weight or a slanted axis loads the nut at rest already: B, the elastic correction of that
load, shifts where the flank changes, and h0 = B / max(|B|, W) is the flank that the load holds,
where ``g`` and ``h`` begin; a load that nothing overcomes leaves no gap to take up. A nut that is
only soft around zero force, as one without preload, takes its G up just so:
in proportion to the force, until W is reached. While the command rests the flank stays: the guide
holds the table wherever the nut is. It follows the force at once, not over a way as friction does:
on a way that suits friction's presliding (10 um) a nut crosses too late, and on one that suits the
nut friction turns over too soon (small slow sinusoids of drives with play and presliding were left
1.7 of their aim).

A machine bed on its foundation swings as the table pushes it off, and the table feels the bed's
acceleration as its own: positions are relative to the bed. The bed is one mass
on a spring, driven by the commanded acceleration; M is its share of that, TY the torque of the
table's mass. As the command comes to rest the guide holds the table against the bed, as far as its
friction reaches: ``b`` follows the way of the command as the friction states do, and where that is
not enough stays between ``y" - (1 + s) R`` and ``y" + (1 - s) R``, with R = (S0 + SS)/A0.

A cable chain, a cover or a wiper drags at the table with a force that turns over within millimetres
of a reversal, not micrometres: ``d`` is a friction state of that distance DD. It has the places of
the bed on a controller, so a law has one of the two. It does not fade at rest: nothing unwinds it.

The motor needs time for the crossing: the correction takes the gap up with a lag M, as the drive
does. While it crosses, nut and table have parted, and the torque that is meant to accelerate both
would throw the motor against the other flank: ``TG (g - h)`` holds it back. In simulation with 2
and 4 um of play both together leave six tenths of e_r in sinusoids and three quarters in moves.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

from pmac_comp.base.arrays import finite_array
from pmac_comp.base.errors import ModelError

REST_FADE_per_s = 22.6  # of the torque's, where no model tells: 0.37 is left
# Of a count, in a pass: a card's register of the commanded position has steps of 1/3072 count, by
# single ones of which it creeps as a move ends. The look-ahead makes several times as much of them
# and would take the friction states away.
REST_STEPS = 6.0 / 3072
REST_UNWIND_per_s = 9.05  # of the table's, where no model tells: 0.67 is left
_MOST_CYCLES = 4  # beyond that the steps of the held torque are worse than no torque
_POSITIVE = (
    "breakaway_m",
    "torque_breakaway_m",
    "turn_m",
    "stribeck_speed_m_per_s",
    "jerk_limit_m_per_s3",
    "drag_distance_m",
    "rest_step_m",
)
_NOT_NEGATIVE = (
    "rest_fade_per_s",
    "rest_unwind_per_s",
    "bed_share",
    "bed_damping_per_s",
    "bed_stiffness_per_s2",
    "turn_friction_Nm",
    "torque_wobble_Nm_s3_per_m3",
    "drag_m",
    "coulomb_lag_s",
)
TORQUE_TERMS = (
    "torque_inertia_Nm_s2_per_m",
    "torque_jerk_Nm_s3_per_m",
    "torque_impulse_Nm_s3_per_m",
    "torque_viscous_Nm_s_per_m",
    "torque_coulomb_Nm",
    "torque_load_Nm_s2_per_m",
    "torque_constant_Nm",
    "torque_place_Nm_per_m",
    "torque_stribeck_Nm",
    "torque_uneven_Nm_s_per_m",
    "torque_drag_Nm",
    "torque_turning_Nm_s",
    "torque_turned_Nm_s",
)
# All that is zero where the output gets no torque; what only shapes these terms stays.
_WITHOUT_TORQUE = (
    *TORQUE_TERMS,
    "turn_friction_Nm",
    "ripple_Nm",
    "turn_share",
    "torque_wobble_Nm_s3_per_m3",
    "gap_torque_Nm",
    "torque_bed_Nm_s2_per_m",
)
_TRIM = "trim"  # in the provenance
_COMPUTE_AGAIN = "Compute the compensation again from a model."


@dataclass(frozen=True)
class CompensationLaw:
    """Coefficients of the law in SI; zero means that the term is absent.

    Parameters
    ----------
    inertia_s2, viscous_s, coulomb_m : float
        A0 (m per m/s2), V0 (m per m/s) and S0 (m), at the origin.
    compliance_slope_per_m : float
        K, change of these along the travel, relative to the origin, 1/m.
    jerk_s3 : float
        J0 (m per m/s3), damping of the chain.
    breakaway_m, torque_breakaway_m : float
        Distances over which the friction states follow a reversal.
    coulomb_lag_s : float
        MS; not beside a bed.
    jerk_limit_m_per_s3 : float
        J, above what the motions the law was fitted on have.
    lookahead_s : float
        L, from the pass of the law to the shaft: latency, dead time and current loop.
    torque_inertia_Nm_s2_per_m, torque_jerk_Nm_s3_per_m, torque_viscous_Nm_s_per_m : float
        TJ, TK, TB.
    torque_impulse_Nm_s3_per_m : float
        TI.
    torque_turning_Nm_s, torque_turned_Nm_s : float
        TF and TL.
    torque_coulomb_Nm, torque_load_Nm_s2_per_m, torque_constant_Nm : float
        TC, TE, T0.
    torque_place_Nm_per_m : float
        TP, load that changes along the travel: a spring, a cable.
    rest_fade_per_s, rest_unwind_per_s : float
        RF and UF, how fast the friction torque and the table's friction state fade over the first
        100 servo cycles of a rest.
    rest_step_m : float
        Step of the command in a pass that is still a rest.
    turn_m : float
        Travel of one screw turn.
    turn_friction_Nm, turn_order, turn_phase_rad : float
        TR, m and PR: friction that changes m times per turn. With a negative m it is no friction
        but a second order of cogging, which pushes whichever way the screw turns.
    ripple_Nm, ripple_order, ripple_phase_rad : float
        TH, n, PH: cogging.
    stribeck_m, torque_stribeck_Nm, stribeck_speed_m_per_s : float
        SS, TS and VS: friction at rest beyond that in motion, and the speed that takes it away.
        Negative, they are S0 and TC with the other sign: friction that sets in with speed.
    bed_share, bed_damping_per_s, bed_stiffness_per_s2 : float
        M, D and O of a bed that swings; without a share there is none.
    torque_bed_Nm_s2_per_m : float
        TY.
    drag_m, torque_drag_Nm, drag_distance_m : float
        DX, TD and DD: what drags at the table and turns over within millimetres; not beside a bed.
    viscous_uneven_s, torque_uneven_Nm_s_per_m : float
        VU and TU, by which viscous friction is more in positive direction and less in negative; not
        beside a gap.
    turn_share, torque_loop_Nm_s2_per_m, torque_loop_Nm_s_per_m : float
        RS, share of the torque that ripples m times per turn, in place of TR and not beside a gap
        with bed or drag, and RT and RV, torque per acceleration and per speed that the loop sends
        beside the law.
    torque_wobble_Nm_s3_per_m3 : float
        TW, in place of TR and RS: torque that lets the motor follow what a table makes of the
        wobble of the lead, m times per turn.
    origin_m : float
        Table position at which ``x`` is zero.
    amplitude_limit_m, torque_limit_Nm : float
        Clamps that the running law applies.
    valid_speed_m_per_s, valid_acceleration_m_per_s2 : float
        Range of motions that the coefficients were fitted on.
    gap_half_m, gap_width_m : float
        G, half the clearance of the nut, and W, the elastic correction at which all of it is taken
        up; needs positive ``coulomb_m``, which tells the flank, and W.
    gap_lag_s, gap_torque_Nm : float
        M and TG: with which lag it is taken up, and the torque meanwhile.
    gap_load_m : float
        B, elastic correction of the constant load that the nut carries.
    every_cycles : int
        Servo cycles between two passes of the law; 2 halves what PLC 0 costs.
    provenance : dict
        Where it comes from, what captures showed beyond the model and moved (``trim``): file and
        digests, effects, and notes under the keys of the modules that look for it.
    """

    inertia_s2: float = 0.0
    viscous_s: float = 0.0
    coulomb_m: float = 0.0
    compliance_slope_per_m: float = 0.0
    jerk_s3: float = 0.0
    breakaway_m: float = 10e-6
    coulomb_lag_s: float = 0.0
    lookahead_s: float = 0.0
    torque_inertia_Nm_s2_per_m: float = 0.0
    torque_jerk_Nm_s3_per_m: float = 0.0
    torque_impulse_Nm_s3_per_m: float = 0.0
    torque_turning_Nm_s: float = 0.0
    torque_turned_Nm_s: float = 0.0
    torque_viscous_Nm_s_per_m: float = 0.0
    torque_coulomb_Nm: float = 0.0
    torque_load_Nm_s2_per_m: float = 0.0
    torque_constant_Nm: float = 0.0
    torque_place_Nm_per_m: float = 0.0
    torque_breakaway_m: float = 10e-6
    rest_fade_per_s: float = REST_FADE_per_s
    rest_unwind_per_s: float = REST_UNWIND_per_s
    rest_step_m: float = REST_STEPS * 1e-6
    turn_m: float = 10e-3
    turn_friction_Nm: float = 0.0
    turn_order: float = 1.0
    turn_phase_rad: float = 0.0
    ripple_Nm: float = 0.0
    ripple_order: float = 0.0
    ripple_phase_rad: float = 0.0
    gap_half_m: float = 0.0
    gap_width_m: float = 0.0
    gap_lag_s: float = 0.0
    gap_torque_Nm: float = 0.0
    gap_load_m: float = 0.0
    stribeck_m: float = 0.0
    torque_stribeck_Nm: float = 0.0
    stribeck_speed_m_per_s: float = 0.01
    bed_share: float = 0.0
    bed_damping_per_s: float = 0.0
    bed_stiffness_per_s2: float = 0.0
    torque_bed_Nm_s2_per_m: float = 0.0
    drag_m: float = 0.0
    torque_drag_Nm: float = 0.0
    drag_distance_m: float = 4e-3
    viscous_uneven_s: float = 0.0
    torque_uneven_Nm_s_per_m: float = 0.0
    turn_share: float = 0.0
    torque_loop_Nm_s2_per_m: float = 0.0
    torque_loop_Nm_s_per_m: float = 0.0
    torque_wobble_Nm_s3_per_m3: float = 0.0
    origin_m: float = 0.0
    amplitude_limit_m: float = 60e-6
    torque_limit_Nm: float = 0.0
    valid_speed_m_per_s: float = 0.0
    valid_acceleration_m_per_s2: float = 0.0
    jerk_limit_m_per_s3: float = 1e6
    every_cycles: int = 1
    provenance: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        finite_array("law coefficients", [getattr(self, name) for name in coefficient_names()])
        self._check_period()
        self._check_gap()
        self._check_places()
        self._check_waves()
        self._check_signs()

    def _check_period(self) -> None:
        if not 1 <= self.every_cycles <= _MOST_CYCLES:
            raise ModelError(
                f"A law cannot run every {self.every_cycles} servo cycles.",
                code="PC-DYN-021",
                hint=f"Choose 1 to {_MOST_CYCLES}.",
            )

    def _check_gap(self) -> None:
        flank = min(self.coulomb_m, self.gap_width_m)
        if min(self.gap_half_m, self.gap_lag_s) < 0.0 or (self.gap_half_m > 0.0 and flank <= 0.0):
            raise ModelError(
                "A law takes up a gap only with a positive friction term, which tells the flank, "
                "and a width over which it does.",
                code="PC-DYN-022",
                hint=_COMPUTE_AGAIN,
            )

    def _check_places(self) -> None:
        """Terms that a controller has one place for exclude each other."""
        uneven = self.viscous_uneven_s != 0.0 or self.torque_uneven_Nm_s_per_m != 0.0
        beside = self.bed_share > 0.0 or self.drag_m > 0.0
        ripples = self.turn_share != 0.0 and beside
        if self.gap_half_m > 0.0 and (uneven or ripples):
            raise ModelError(
                "A law takes up a gap, or has viscous friction that differs by direction; beside a "
                "gap it has a bed that swings, what drags or torque that ripples in proportion.",
                code="PC-DYN-024",
                hint=_COMPUTE_AGAIN,
            )
        if self.bed_share > 0.0 and self.drag_m > 0.0:
            raise ModelError(
                "A law has a bed that swings or what drags over millimetres, not both.",
                code="PC-DYN-026",
                hint=_COMPUTE_AGAIN,
            )

        if self.bed_share > 0.0 and self.coulomb_lag_s > 0.0:
            raise ModelError(
                "Beside a bed that swings a law's friction has no lag.",
                code="PC-DYN-027",
                hint=_COMPUTE_AGAIN,
            )

    def _check_waves(self) -> None:
        waves = (self.turn_share, self.turn_friction_Nm, self.torque_wobble_Nm_s3_per_m3)
        if sum(wave != 0.0 for wave in waves) > 1:
            raise ModelError(
                "A law has one wave of order turn_order: turn_share, turn_friction_Nm or "
                "torque_wobble_Nm_s3_per_m3.",
                code="PC-DYN-025",
                hint=_COMPUTE_AGAIN,
            )

    def _check_signs(self) -> None:
        small = [name for name in _POSITIVE if getattr(self, name) <= 0.0]
        small += [name for name in _NOT_NEGATIVE if getattr(self, name) < 0.0]
        most = {"stribeck_m": self.coulomb_m, "torque_stribeck_Nm": self.torque_coulomb_Nm}
        small += [n for n, own in most.items() if getattr(self, n) < min(-own, 0.0)]
        if small or self.amplitude_limit_m < 0.0 or self.torque_limit_Nm < 0.0:
            raise ModelError(
                f"{', '.join(small) or 'a limit'} of the compensation law is not positive.",
                code="PC-DYN-020",
                hint=_COMPUTE_AGAIN,
            )

    def as_mapping(self) -> dict[str, Any]:
        """All fields, for a file."""
        return asdict(self)

    def with_values(self, **values: float) -> "CompensationLaw":
        """Copy with some coefficients replaced; smooth friction stays without any at rest."""
        if self.is_smooth:
            values = {**values, **_smooth({**self.as_mapping(), **values})}
        return replace(self, **values)  # type: ignore[arg-type]

    def as_smooth(self, speed_m_per_s: float) -> "CompensationLaw":
        """The same law with friction that sets in with speed, over about ``speed_m_per_s``."""
        return replace(self, stribeck_speed_m_per_s=speed_m_per_s, **_smooth(self.as_mapping()))

    def noting(self, said: Mapping[str, Any]) -> "CompensationLaw":
        """The same law with more in its provenance."""
        return replace(self, provenance={**self.provenance, **said})

    @property
    def trim(self) -> Mapping[str, float]:
        """By how much captures moved coefficients, by name: the rest of each is the model's."""
        moved: Mapping[str, float] = self.provenance.get(_TRIM, {})
        return moved

    def with_trim(self, changes: Mapping[str, float]) -> "CompensationLaw":
        """The same law with a note that captures moved it by these changes, beside earlier ones."""
        trim = dict(self.trim)
        trim |= {name: trim.get(name, 0.0) + change for name, change in changes.items()}
        return self.noting({_TRIM: trim})

    @property
    def largest_correction_m(self) -> float:
        """Largest correction within the law's range of speeds and accelerations, m."""
        # A bed that an acceleration began to swing meets the next one with twice its share.
        swung = 1.0 + 2.0 * self.bed_share
        fast = swung * abs(self.inertia_s2) * self.valid_acceleration_m_per_s2
        viscous_s = abs(self.viscous_s) + abs(self.viscous_uneven_s)
        fast += viscous_s * self.valid_speed_m_per_s
        still = abs(self.coulomb_m) + max(self.stribeck_m, 0.0) + self.drag_m
        return fast + still + self.gap_half_m

    @property
    def breaks_loose_Nm(self) -> float:
        """Torque that friction holds at rest."""
        return self.torque_coulomb_Nm + self.torque_stribeck_Nm

    @property
    def has_stribeck(self) -> bool:
        """Whether friction near standstill is another than in motion."""
        return self.stribeck_m != 0.0 or self.torque_stribeck_Nm != 0.0

    @property
    def is_smooth(self) -> bool:
        """Whether friction sets in with speed, and there is none at rest."""
        return min(self.stribeck_m, self.torque_stribeck_Nm) < 0.0

    @property
    def is_second_cogging(self) -> bool:
        """Whether the wave TR is no friction: it pushes whichever way the screw turns."""
        return self.turn_order < 0.0

    @property
    def is_wobble(self) -> bool:
        """Whether the wave of the turn lets the motor follow the wobble of the lead."""
        return self.torque_wobble_Nm_s3_per_m3 != 0.0

    def without_turn(self) -> "CompensationLaw":
        """The same law without torque by the turn."""
        return replace(self, turn_friction_Nm=0.0, turn_share=0.0, ripple_Nm=0.0)

    def without_torque(self) -> "CompensationLaw":
        """The same command offset with no torque feed-forward."""
        zero = dict.fromkeys(_WITHOUT_TORQUE, 0.0)
        return replace(self, **zero, torque_limit_Nm=0.0)  # type: ignore[arg-type]


def _smooth(values: Mapping[str, Any]) -> dict[str, Any]:
    """Stribeck terms that leave nothing of a law's friction at rest."""
    return {
        "stribeck_m": -max(values["coulomb_m"], 0.0),
        "torque_stribeck_Nm": -max(values["torque_coulomb_Nm"], 0.0),
    }


def coefficient_names() -> tuple[str, ...]:
    """Names of all coefficients in order."""
    others = {"provenance", "every_cycles"}
    return tuple(f.name for f in fields(CompensationLaw) if f.name not in others)
