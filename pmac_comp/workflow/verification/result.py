"""A verification: all motions before and after, the static part, the ringing, and the verdict."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.exact import Aim
from pmac_comp.physics.compensate.lead import LeadMap
from pmac_comp.workflow.accuracy.outcome import WORSE, MotionOutcome, Ratio, Spread, grown_text
from pmac_comp.workflow.accuracy.ringing import RingingOutcome
from pmac_comp.workflow.accuracy.static_check import Approaches, StaticOutcome
from pmac_comp.workflow.law.routes import MOTION_ROUTES, TORQUE_ROUTES
from pmac_comp.workflow.verification.learning import Refinement

# What a law is meant to leave at the table: this share of the mechanical error, or so little.
_MEANT_FRAC: Final = 0.10
_MEANT_um: Final = 0.15
_MEANT_OF_TOTAL: Final = 0.2
_WHERE_LESS: Final = (
    "Where the model expects less, `pmac-comp diagnose` on the runs before tells what it lacks"
)

_MOSTLY = 0.7  # share of the repeatability that is the motor's own
_GREW = 1.2  # the reversal value of so few targets scatters


@dataclass(frozen=True)
class Verification:
    """All motions of a verification, with the runs they came from.

    Parameters
    ----------
    motions : tuple of MotionOutcome
        Motion by motion.
    floor_um : float
        Rms that the quantisation of the sensors alone makes.
    simulated : bool
        Whether the controller and its drive were simulated.
    before, after : tuple of Capture
        Runs without and with compensation.
    lead, table_correction : LeadMap, callable or None
        Static part of the compensation and what its table gives (m at m).
    scale_age_s : float
        Time by which the scale is read after the encoder; it is taken out of the figures.
    remarks : tuple of str
        What a person should know beside the figures.
    route : str
        How the compensation reached the servo; empty for stored captures without a file.
    aim : Aim
        Which error the offset of a known motion takes away.
    mechanical, total : Ratio or None
        After over before, all motions together.
    static : StaticOutcome or None
        Positioning after ISO 230-2.
    ringing : RingingOutcome or None
        What rings after steps of the acceleration.
    learning : Refinement or None
        What stood before on a repeated motion, and what learning added.
    """

    motions: tuple[MotionOutcome, ...]
    floor_um: float
    simulated: bool
    before: tuple[Capture, ...] = field(default=(), repr=False)
    after: tuple[Capture, ...] = field(default=(), repr=False)
    lead: LeadMap | None = field(default=None, repr=False)
    table_correction: Callable[[FloatArray], FloatArray] | None = field(default=None, repr=False)
    scale_age_s: float = 0.0
    remarks: tuple[str, ...] = ()
    route: str = ""
    aim: Aim = Aim.TOTAL
    mechanical: Ratio | None = None
    total: Ratio | None = None
    static: StaticOutcome | None = None
    ringing: RingingOutcome | None = None
    learning: Refinement | None = None

    def as_result(self, folder: Path | None = None) -> dict[str, Any]:
        """Mapping for ``--json``, with the folder that keeps the runs where there is one."""
        kept = {} if folder is None else {"folder": folder}
        return {
            "kind": "verification",
            "simulated": self.simulated,
            "sensor_floor_um": self.floor_um,
            "motions": [m.as_result() for m in self.motions],
            "route": self.route,
            "reached": {
                "mechanical": None if self.mechanical is None else asdict(self.mechanical),
                "total": None if self.total is None else asdict(self.total),
            },
            "static": None if self.static is None else self.static.as_result(),
            "ringing": None if self.ringing is None else self.ringing.as_result(),
            "learning": None if self.learning is None else self.learning.as_result(),
            "remarks": list(self.remarks),
            **kept,
        }

    def reached(self) -> list[str]:
        """What the route reached on all motions together, for people."""
        if self.total is None:
            return []
        name = f"route {self.route}" if self.route else "compensation"
        shown = self.mechanical is not None and not self.holds_lag
        both = f"mechanical error {self.mechanical}, " if shown else ""
        return [
            f"{name} reached, all motions together, after over before (95 %): {both}total error "
            f"{self.total}"
        ]

    @property
    def holds_lag(self) -> bool:
        """Whether the offset of a known motion also cancels the lag of the loop.

        Then e_r contains that lag by its definition, and says nothing about the mechanics: with
        such an aim the total error is judged, also where it grew.
        """
        return self.route in MOTION_ROUTES and self.aim is Aim.TOTAL

    @property
    def tells_mechanics(self) -> bool:
        """Whether e_r is known on all motions: their runs say what the compensation added."""
        return all(m.e_r_after.is_known for m in self.motions)

    def judged(self) -> list[str]:
        """What of the figures is the sensors' own, and whether the promise was kept, for people."""
        out: list[str] = []
        shows_e_r = self.tells_mechanics and not self.holds_lag
        if self.motions and self.floor_um > 0.0 and shows_e_r:
            beyond = sorted(
                {f"{m.e_r_beyond_um(self.floor_um):.2f}" for m in self.motions}, key=float
            )
            span = beyond[0] if len(beyond) == 1 else f"{beyond[0]} to {beyond[-1]}"
            out.append(
                f"the steps of encoder and scale alone make {self.floor_um:.3f} um rms of every e "
                f"and e_r; beyond them e_r is {span} um"
            )
        rounding = [m.rounding_um for m in self.motions if m.rounding_um > 0.0]
        if rounding and shows_e_r:
            out.append(
                f"the encoder's steps also move the drive, as the loop feeds them back: by the "
                f"model they make up to {max(rounding):.2f} um rms of e_r, which no law takes away"
            )
        judged = [m.promise_kept(self.floor_um) for m in self.motions if m.promise is not None]
        kept = [one for one in judged if one is not None]
        if judged and not kept:
            out.append(
                "the promise is the model's alone and has no interval: compute the compensation "
                "with the runs of the identification (`pmac-comp compensate --captures`)"
            )
        if kept:
            out.append(
                f"the model's promise (with its interval and these steps) was kept on "
                f"{kept.count(True)} of {len(kept)} motions"
            )
        return [*out, *self._left()]

    def _left(self) -> list[str]:
        """On which motions a route with torque leaves more than it is meant to, for people."""
        if self.route not in TORQUE_ROUTES:
            return []
        of_e = [text for m in self.motions if (text := _left_text(m, self.floor_um))]
        of_total = [text for m in self.motions if (text := _left_of_total_text(m, self.floor_um))]
        n = len(self.motions)
        out: list[str] = []
        if of_e:
            out.append(
                f"more than a tenth of e stays on {len(of_e)} of {n} motions, the sensors' steps "
                f"taken out: {'; '.join(of_e)}. {_WHERE_LESS}"
            )
        if of_total:
            out.append(
                f"more than a fifth of the total error stays on {len(of_total)} of {n} motions: "
                f"{'; '.join(of_total)}. {_WHERE_LESS}"
            )
        return out

    def _shows_ratio(self, outcome: MotionOutcome) -> bool:
        """Whether the ratio of the mechanical error of a motion is known and says something."""
        return outcome.e_r_after.is_known and not self.holds_lag

    def lines(self) -> list[str]:
        """Table and remarks for people."""
        head = f"  {'motion':44s} {'e -> e_r um':>17s} {'e_c um':>17s} {'total um':>17s}  ratio"
        out = ["measured rms before -> after (mean of a run taken out)", head]
        for m in self.motions:
            out.append(
                f"  {m.name[:44]:44s} {_pair(m.e_before, m.e_r_after)} "
                f"{_pair(m.e_c_before, m.e_c_after)} {_pair(m.total_before, m.total_after)}  "
                + (f"{m.mechanical.value:.2f} mech, " if self._shows_ratio(m) else "")
                + f"{m.total.value:.2f} total"
            )
            if m.promise is not None:
                out.append(
                    f"  {'  promised by the model':44s} "
                    f"{m.promise['e_before_um']:8.2f}>{m.promise['e_r_after_um']:8.3f} "
                    f"{m.promise['e_c_before_um']:8.2f}>{m.promise['e_c_after_um']:8.2f} "
                    f"{m.promise['total_before_um']:8.2f}>{m.promise['total_after_um']:8.2f}"
                )
                out += [f"      {text}" for text in interval_texts(m, self.floor_um)]
            if m.truth is not None:
                out.append(
                    f"  {'  on the true positions of the plant':44s} "
                    f"{m.truth['e_before_um']:8.2f}>{m.truth['e_r_after_um']:8.3f} "
                    f"{m.truth['e_c_before_um']:8.2f}>{m.truth['e_c_after_um']:8.2f} "
                    f"{m.truth['total_before_um']:8.2f}>{m.truth['total_after_um']:8.2f}"
                )
        out += self.reached() + self.judged()
        out += [] if self.static is None else self.static.lines()
        out += [] if self.ringing is None else self.ringing.lines()
        return [*out, *(f"  note: {line}" for line in self.remarks)]


def _pair(before: Spread, after: Spread) -> str:
    last = f"{after.value:8.3f}" if after.is_known else f"{'-':>8s}"
    return f"{before.value:8.2f}>{last}"


def interval_texts(outcome: MotionOutcome, floor_um: float) -> list[str]:
    """Intervals of a promise, whether each was kept, and the rounding's part of e_r, for people."""
    parts = [
        f"{j.quantity} {j.lower_um:.2f} to {j.upper_um:.2f} um, with the sensors' steps up to "
        f"{j.most_um:.2f}: {'kept' if j.is_kept else 'MISSED'}"
        for j in outcome.judged(floor_um)
    ]
    texts = ["interval promised: " + "; ".join(parts)] if parts else []
    if outcome.rounding_um > 0.0:
        texts.append(f"of e_r {outcome.rounding_um:.2f} um are rounding that the loop feeds back")
    return texts


def _left_text(outcome: MotionOutcome, floor_um: float) -> str:
    """Share of e that stays, measured and by the model; empty where it is as little as meant."""
    if not outcome.e_r_after.is_known:
        return ""
    e_um, left_um = outcome.e_before.value, outcome.e_r_beyond_um(floor_um)
    if left_um <= max(_MEANT_FRAC * e_um, _MEANT_um, floor_um):
        return ""
    expected = _expected_text(outcome.promise, "e_before_um", "e_r_after_um")
    return f"{outcome.name} {_share_text(left_um, e_um)}{expected}"


def _left_of_total_text(outcome: MotionOutcome, floor_um: float) -> str:
    """Share of the total error that stays, measured and by the model; empty where it is little."""
    before_um, left_um = outcome.total_before.value, outcome.total_after.value
    if left_um <= max(_MEANT_OF_TOTAL * before_um, floor_um):
        return ""
    expected = _expected_text(outcome.promise, "total_before_um", "total_after_um")
    return f"{outcome.name} {_share_text(left_um, before_um)}{expected}"


def _expected_text(promise: Mapping[str, float] | None, before: str, after: str) -> str:
    """Share of an error that stays by the model, as an aside; nothing without a promise."""
    return "" if promise is None else f", {_share_text(promise[after], promise[before])} expected"


def _share_text(left_um: float, e_um: float) -> str:
    """Share of an error that stays; a rigid model expects none of which there could be one."""
    return f"{left_um / e_um:.2f}" if e_um > 0.0 else f"{left_um:.2f} um of none"


def verdict_remarks(
    outcomes: Sequence[MotionOutcome], floor_um: float, *, holds_lag: bool = False
) -> tuple[str, ...]:
    """What a person should know beside the figures; ``holds_lag`` as `Verification` tells it."""
    remarks: list[str] = []
    missed = [text for m in outcomes if (text := _missed_text(m, floor_um))]
    if missed:
        remarks.append(
            f"the promise was missed on {len(missed)} motion(s) ({'; '.join(missed)}): "
            "run `pmac-comp diagnose` on the captures"
        )
    larger = [
        f"{m.name} {grown_text(m.total_before.value, m.total_after.value)}"
        for m in outcomes
        if m.total_after.value > WORSE * m.total_before.value
    ]
    if larger:
        remarks.append(f"the total error grew on: {'; '.join(larger)}")
    grew = [m for m in outcomes if m.e_r_after.lower95 > m.e_before.upper95]
    fell = {m.name for m in grew if holds_lag or m.total_after.upper95 < m.total_before.lower95}
    if fell:
        remarks.append(
            f"the offset also cancels the lag of the loop on: {'; '.join(sorted(fell))}; there "
            "e_r contains that part by its definition, and the total error is what counts"
        )
    worse = [m.name for m in grew if m.name not in fell]
    if worse:
        remarks.append(f"the mechanical error grew on: {'; '.join(worse)}")
    return tuple(remarks)


def _missed_text(outcome: MotionOutcome, floor_um: float) -> str:
    """Motion and quantities that were missed with figures; empty for none."""
    parts = [
        f"{j.quantity} {j.measured_um:.2f} um, at most {j.most_um:.2f} promised"
        for j in outcome.judged(floor_um)
        if not j.is_kept
    ]
    return f"{outcome.name}: {', '.join(parts)}" if parts else ""


def static_remarks(static: StaticOutcome | None) -> tuple[str, ...]:
    """What the positioning test shows beside its figures."""
    if static is None or static.before is None or static.after is None:
        return ()
    out: list[str] = []
    before, after = static.before.figures(), static.after.figures()
    grew = after.reversal_value_m > _GREW * before.reversal_value_m
    sent_um = _sent_at_rest_um(static.before, static.after) if grew else None
    if grew:
        said = (
            f"the reversal value at rest grew from {before.reversal_value_m * UM_PER_M:.2f} to "
            f"{after.reversal_value_m * UM_PER_M:.2f} um: "
        )
        why = (
            "the correction holds the screw's wind-up, which rest does not relieve; what is left "
            "is the motor's own stop within its friction, which had cancelled the wind-up before"
        )
        out.append(said + (why if sent_um is None else _sent_text(*sent_um)))
    servo, mechanical = static.after.of_motor(), static.after.of_mechanics()
    if servo.repeatability_m > _MOSTLY * after.repeatability_m and sent_um is None:
        out.append(
            f"repeatability R with compensation: {after.repeatability_m * UM_PER_M:.2f} um at the "
            f"table, {servo.repeatability_m * UM_PER_M:.2f} um of the motor itself, "
            f"{mechanical.repeatability_m * UM_PER_M:.2f} um of motor to table (they need not add "
            "up): the axis stops within its friction where the last of its motion and the "
            "integrator leave it; no offset or table reaches that, the servo's gains and the "
            "encoder's steps decide it"
        )
    return tuple(out)


def _sent_at_rest_um(before: Approaches, after: Approaches) -> tuple[float, float] | None:
    """Mean reversal of the motor's own stops before and after, um, where the law moved them.

    None where they part no farther than before, or by no more than the mechanics' part changed by.
    """
    was, now = (abs(side.of_motor().mean_reversal_m) for side in (before, after))
    held = after.of_mechanics().mean_reversal_m - before.of_mechanics().mean_reversal_m
    if now - was <= max(abs(held), (_GREW - 1.0) * was):
        return None
    return UM_PER_M * was, UM_PER_M * now


def _sent_text(was_um: float, now_um: float) -> str:
    return (
        f"the motor's own stops from both sides are {now_um:.2f} um apart, {was_um:.2f} before: "
        "the torque that the law holds at rest and begins the next motion with is not what this "
        "axis needs there. A load that has changed since the calibration runs is held by a law of "
        "new ones; one that differs by place in any other way than a spring has no term in its "
        "torque (`pmac-comp diagnose` tells which it is)"
    )
