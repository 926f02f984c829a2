"""Last correction of a law by the captures themselves, for drives that the model does not fit.

What lives here: the regression of what the model leaves of the measured mechanical error on the
terms that the law has anyway, and on what drags over millimetres, which no model holds. What may
not: the model's fit, controllers.

A model whose stiffness profile differs from the machine's leaves an error proportional to
acceleration, speed or direction, and to their sum times position. The law has those terms, so they
are taken over; what they do not explain stays for ``diagnose``.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pmac_comp.base.arrays import BoolArray, FloatArray
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.clearance import settled
from pmac_comp.physics.compensate.evaluation import friction_levels, friction_state
from pmac_comp.physics.compensate.free import LEAST_COULOMB_m
from pmac_comp.physics.compensate.grip import DISTANCES_m, gripping_torque
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.lead import LeadMap
from pmac_comp.physics.compensate.loop import LoopRunner
from pmac_comp.physics.compensate.starts import held_at_start_Nm, state_at_start

_LEAST_GAIN_FRAC = 0.05  # of the unexplained rms: less than this is not worth a change
_LEAST_GRIP_FRAC = 0.01  # the same of another break-away distance: it acts at reversals only
_DRAGS_OVER_m = (1e-3, 2e-3, 4e-3, 8e-3, 16e-3)  # within which a cable chain or a cover turns over
# Of the unexplained rms. On seven simulated drives without drag (10 000 to 40 000 counts; play,
# cover, soft bearing, warming friction) chance explained up to 0.9 %; on three with 12 and 15 N of
# it 2.4 (with 10 000 counts), 6 and 17 %.
_LEAST_DRAG_FRAC = 0.015
_UNEVEN = "viscous_uneven_s"
# Of a law's provenance: share of the rest that the captures' corrections and a drag explain.
TRIM_EXPLAINED, DRAG = "trim_explained", "drag_explained"
_SAME_FORCE = {"torque_viscous_Nm_s_per_m": "viscous_s", "torque_coulomb_Nm": "coulomb_m"}
_SLOPE = "compliance_slope_per_m"
_TERMS = ("inertia_s2", "viscous_s", "coulomb_m", _SLOPE)


def trimmed_law(
    law: CompensationLaw,
    loop: LoopRunner,
    captures: Sequence[Capture],
    lead: LeadMap | None = None,
) -> tuple[CompensationLaw, float]:
    """Law with its offset terms corrected by captures, and the share of the rest they explain.

    Parameters
    ----------
    law : CompensationLaw
        Law of a model.
    loop : LoopRunner
        Closed loop of that model.
    captures : sequence of Capture
        Runs without compensation that start relaxed.
    lead : LeadMap or None
        Static error, taken out of the captures.

    Returns
    -------
    CompensationLaw, float
        The law itself and 0 where nothing is gained; the change is kept as ``trim``.
    """
    usable = [c for c in captures if c.table_position_m is not None]
    if not usable:
        return law, 0.0
    runs = [_run(law, loop, capture, lead) for capture in usable]
    whole = float(np.std(np.concatenate([run.rest_m for run in runs])))
    longer = [b for b in DISTANCES_m if b > law.breakaway_m]
    fits = [_fit(law, runs, breakaway_m) for breakaway_m in (law.breakaway_m, *longer)]
    best = min(fits, key=lambda fit: fit.left_m)
    if best.left_m > (1.0 - _LEAST_GRIP_FRAC) * fits[0].left_m:
        best = fits[0]
    explained = 1.0 - best.left_m / max(whole, 1e-30)
    if best is fits[0] and explained < _LEAST_GAIN_FRAC:
        return law, 0.0
    values = _less(law, best.changes, {}) | {"breakaway_m": best.breakaway_m}
    moved = {name: value - getattr(law, name) for name, value in values.items()}
    trim = {name: change for name, change in moved.items() if change != 0.0}
    return law.with_values(**values).with_trim(trim), explained


def with_drag(
    law: CompensationLaw,
    loop: LoopRunner,
    captures: Sequence[Capture],
    lead: LeadMap | None,
    *,
    torque_Nm_s2_per_m: float,
) -> CompensationLaw:
    """Law with a drag at the table that turns over within millimetres, where captures show it.

    A cable chain, a cover or a wiper: over a small motion less of it turns over than over a large
    one, which friction of one break-away distance cannot say. What the table drags lies in the
    offset of friction and speed else: they are fitted anew beside it, and as all of it acts at the
    table, the torque by the same force.

    Parameters
    ----------
    law : CompensationLaw
        With its ``trim`` where captures moved it.
    loop : LoopRunner
        Closed loop of the model.
    captures : sequence of Capture
        Runs without compensation that start relaxed.
    lead : LeadMap or None
        Static error, taken out of the captures.
    torque_Nm_s2_per_m : float
        Torque that accelerates the table's mass, N m per m/s2: over ``inertia_s2`` the torque of a
        force at the table by the elastic error that it makes.

    Returns
    -------
    CompensationLaw
        The law itself where nothing drags, or where its place on the controller is taken.
    """
    usable = [c for c in captures if c.table_position_m is not None]
    rippling = law.gap_half_m > 0.0 and law.turn_share != 0.0
    if len(usable) < 2 or law.bed_share > 0.0 or law.inertia_s2 <= 0.0 or rippling:
        return law
    own_m = _own_breakaway_m(law)
    runs = [_run(law, loop, capture, lead) for capture in usable]
    without = _Columns.of(law, runs, own_m)
    fits = [_Columns.of(law, runs, own_m, distance_m) for distance_m in _DRAGS_OVER_m]
    left_m, best = min(((fit.left_m(), fit) for fit in fits), key=lambda pair: pair[0])
    *changes, drag = best.changes()
    explained = 1.0 - left_m / max(without.left_m(), 1e-30)
    if drag >= 0.0 or explained < _LEAST_DRAG_FRAC or not best.holds_across(without):
        return law
    values = _less(law, changes, law.trim)
    values |= {"drag_m": -float(drag), "drag_distance_m": best.distance_m}
    if law.torque_limit_Nm > 0.0:
        Nm_per_m = torque_Nm_s2_per_m / law.inertia_s2
        values["torque_drag_Nm"] = Nm_per_m * values["drag_m"]
        for torque, offset in _SAME_FORCE.items():
            moved_m = values[offset] - getattr(law, offset)
            values[torque] = getattr(law, torque) + Nm_per_m * moved_m
    moved = {name: value - getattr(law, name) for name, value in values.items()}
    return law.with_values(**values).with_trim(moved).noting({DRAG: explained})


def _own_breakaway_m(law: CompensationLaw) -> float:
    """Break-away distance of the model, before captures moved it."""
    return law.breakaway_m - law.trim.get("breakaway_m", 0.0)


def _less(
    law: CompensationLaw, changes: Iterable[float], trim: Mapping[str, float]
) -> dict[str, float]:
    """Terms of a law without its trim, less those of an error: it is what the law takes away.

    The change along the travel is fitted to the elastic error of the law as it was and goes with
    that of the law as it comes: (I - c0) (1 + s x) - I c3 x = (I - c0) (1 + (s - c3 I/(I - c0)) x).
    """
    values = {
        name: getattr(law, name) - trim.get(name, 0.0) - float(change)
        for name, change in zip(_names(law), changes, strict=True)
    }
    own, left = law.inertia_s2, values["inertia_s2"]
    if min(own, left) > 0.0:
        slope = law.compliance_slope_per_m - trim.get(_SLOPE, 0.0)
        values[_SLOPE] = slope + (values[_SLOPE] - slope) * own / left
    if law.gap_half_m > 0.0:
        values["coulomb_m"] = max(values["coulomb_m"], LEAST_COULOMB_m)
    return values


@dataclass(frozen=True)
class _Run:
    """A run without compensation: where its motor went, what the model leaves, what counts."""

    motor_m: FloatArray
    rest_m: FloatArray  # of the samples in use, without its mean
    use: BoolArray
    period_s: float
    start: float  # of its friction state


@dataclass(frozen=True)
class _Columns:
    """Terms of all runs as columns of a regression, what a model leaves beside them, run by run."""

    terms: tuple[FloatArray, ...]
    rests_m: tuple[FloatArray, ...]
    distance_m: float

    @classmethod
    def of(
        cls,
        law: CompensationLaw,
        runs: Sequence[_Run],
        own_m: float,
        distance_m: float | None = None,
        breakaway_m: float | None = None,
    ) -> "_Columns":
        """Columns of the law's terms, own break-away distance or another, and of a drag."""
        terms, rests = [], []
        for run in runs:
            matrix, rest = _terms(law, run, breakaway_m or law.breakaway_m, own_m)
            if distance_m is not None:
                v = np.gradient(run.motor_m, run.period_s)
                along = 1.0 + law.compliance_slope_per_m * (run.motor_m - law.origin_m)
                drag = along * friction_state(v, distance_m, run.period_s)
                matrix = np.column_stack([matrix, drag[run.use]])
            terms.append(matrix - matrix.mean(axis=0))
            rests.append(rest - rest.mean())
        return cls(tuple(terms), tuple(rests), distance_m or 0.0)

    def changes(self, runs: slice = slice(None)) -> FloatArray:
        """Coefficients fitted to some of the runs."""
        matrix, rest = np.concatenate(self.terms[runs]), np.concatenate(self.rests_m[runs])
        scale = np.maximum(np.sqrt(np.mean(matrix**2, axis=0)), 1e-30)
        found, *_ = np.linalg.lstsq(matrix / scale, rest, rcond=1e-6)
        return np.asarray(found / scale)

    def left_m(self, fitted: slice = slice(None), judged: slice = slice(None)) -> float:
        """Rms that coefficients fitted to some runs leave of some."""
        found = self.changes(fitted)
        pairs = zip(self.terms[judged], self.rests_m[judged], strict=True)
        return float(np.std(np.concatenate([rest - matrix @ found for matrix, rest in pairs])))

    def holds_across(self, without: "_Columns") -> bool:
        """Whether what one half of the runs says makes the other better by as much."""
        halves = slice(0, None, 2), slice(1, None, 2)
        most = 1.0 - _LEAST_DRAG_FRAC
        return all(
            self.left_m(fitted, judged) < most * without.left_m(fitted, judged)
            for fitted, judged in (halves, halves[::-1])
        )


@dataclass(frozen=True)
class _Fit:
    """Changes of the terms with a break-away distance, and the rms that they leave."""

    breakaway_m: float
    changes: FloatArray
    left_m: float


def _run(law: CompensationLaw, loop: LoopRunner, capture: Capture, lead: LeadMap | None) -> _Run:
    r, table = capture.commanded_position_m, capture.table_position_m
    signals = loop(r, None, gripping_torque(law, capture), held_at_start_Nm(capture))
    simulated = signals.table_position_m - signals.motor_position_m
    measured = (table if table is not None else r) - capture.motor_position_m
    rest = measured - simulated - (0.0 if lead is None else lead.at(r))
    use = settled(capture) if law.gap_half_m > 0.0 else capture.mask
    motor = signals.motor_position_m
    start = state_at_start(capture, law.breaks_loose_Nm)
    return _Run(motor, rest[use] - rest[use].mean(), use, capture.sample_period_s, start)


def _fit(law: CompensationLaw, runs: Sequence[_Run], breakaway_m: float) -> _Fit:
    """Regression on acceleration, speed, friction, and on the law's elastic error times position.

    Friction of another break-away distance than the model's leaves the difference of the two
    states, besides what changes of the terms' sizes explain.
    """
    columns = _Columns.of(law, runs, law.breakaway_m, breakaway_m=breakaway_m)
    return _Fit(breakaway_m, columns.changes(), columns.left_m())


def _terms(
    law: CompensationLaw, run: _Run, breakaway_m: float, own_m: float
) -> tuple[FloatArray, FloatArray]:
    """Error per unit of each term, and what a model leaves whose friction breaks away over own."""
    v = np.gradient(run.motor_m, run.period_s)
    a = np.gradient(v, run.period_s)
    x = run.motor_m - law.origin_m
    s = friction_state(v, breakaway_m, run.period_s, run.start)
    own = friction_state(v, own_m, run.period_s, run.start)
    along = 1.0 + law.compliance_slope_per_m * x
    friction_m, _ = friction_levels(law, v)
    elastic = law.inertia_s2 * a + law.viscous_s * v + friction_m * s
    slow = friction_m / law.coulomb_m if law.is_smooth and law.coulomb_m > 0.0 else 1.0
    columns = [along * a, along * v, along * s * slow, x * elastic]
    if _UNEVEN in _names(law):
        columns.append(along * np.abs(v))
    terms = np.column_stack(columns)[run.use]
    return terms, run.rest_m - (along * friction_m * (own - s))[run.use]


def _names(law: CompensationLaw) -> tuple[str, ...]:
    """Terms that are corrected: friction that differs by direction where the torque shows it."""
    return (*_TERMS, _UNEVEN) if law.torque_uneven_Nm_s_per_m != 0.0 else _TERMS


def shows_reversal(
    law: CompensationLaw, loop: LoopRunner, captures: Sequence[Capture], lead: LeadMap
) -> bool:
    """Whether runs that accelerate bear out the difference of the directions that slow runs left.

    Where a load presses a nut with play to one side, a few newtons decide on which flank it runs
    one way at steady speed: what a model has wrong there is as large as the play, and a table that
    took it for a property of the place would put it on every motion.

    Parameters
    ----------
    law : CompensationLaw
        With its ``trim`` where captures moved it.
    loop : LoopRunner
        Closed loop of the model.
    captures : sequence of Capture
        Runs without compensation.
    lead : LeadMap
        Static error with the difference that slow runs left.
    """
    usable = [c for c in captures if c.table_position_m is not None]
    if not usable:
        return True  # nothing speaks against it
    own_m = _own_breakaway_m(law)
    changes = np.array([law.trim.get(name, 0.0) for name in _names(law)])
    without, beside = [], []
    for run in (_run(law, loop, capture, lead) for capture in usable):
        terms, rest = _terms(law, run, law.breakaway_m, own_m)
        rest = rest + terms @ changes
        v = np.gradient(run.motor_m, run.period_s)
        side = friction_state(v, law.breakaway_m, run.period_s, run.start)
        way = 0.5 * side * np.interp(run.motor_m, lead.position_m, lead.reversal_m)
        without.append(rest - rest.mean())
        left = rest - way[run.use]
        beside.append(left - left.mean())
    rms_m, with_m = (float(np.std(np.concatenate(rests))) for rests in (without, beside))
    return with_m < (1.0 - _LEAST_GAIN_FRAC) * rms_m
