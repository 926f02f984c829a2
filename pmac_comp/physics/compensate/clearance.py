"""Clearance of the nut that slow and fast runs show and the model does not hold.

What lives here: the fit of a gap beside what it hides behind, to the mechanical error of captures,
and the model that carries it. What may not: names of causes for people (``diagnose`` gives those),
controllers.

A model without a gap puts the lost motion of slow runs down to friction of the guide, which winds
the screw up. Both look the same at constant speed. Under acceleration they part: wind-up follows
the direction of motion, the flank follows the force in the nut. So gap, friction of guide and nut
and axial stiffness are fitted together to table minus motor alone, where torque, which shows no
gap, cannot pull. What the guide loses stays at nut and motor: the sum is what the torque measured.
The same goes for viscous friction, which a fit without the gap can have put at the nut altogether.

A nut without preload is soft around zero force instead of free: its lost motion grows with the
force up to the edge of the zone. Where that leaves clearly less than play does, it is taken.

A weight or a slanted axis presses the nut on one flank: it leaves that one late, or never. Where
the torque of the captures shows a constant load, its share at the table is fitted too; the rest of
it acts on the motor, where it moves no flank.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import least_squares

from pmac_comp.base.arrays import BoolArray, FloatArray
from pmac_comp.base.threads import working
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.constant import constant_torque
from pmac_comp.physics.compensate.lead import LeadMap
from pmac_comp.physics.compensate.loop import model_loop

if TYPE_CHECKING:
    from pmac_comp.physics.model.drive import DriveModel

_GAP, _GUIDE = "backlash.gap_m", "coulomb.guide_N"
_LOAD = "bias_force.force_N"
_ZONE, _RATIO = "preload_loss.half_width_m", "preload_loss.stiffness_ratio"
_MOTOR, _NUT = "coulomb.motor_Nm", "coulomb.nut_Nm"
_STIFFNESS = "chain.axial_stiffness_N_per_m"
_GUIDE_VISCOUS, _MOTOR_VISCOUS = "viscous.guide_Ns_per_m", "viscous.motor_Nms_per_rad"
_NUT_VISCOUS = "viscous.nut_Nms_per_rad"
_FITTED = {_GUIDE, _NUT, _MOTOR, _STIFFNESS, _GUIDE_VISCOUS, _MOTOR_VISCOUS, _NUT_VISCOUS}
_LEAST_GAP_um = 0.3
_LEAST_GAIN_FRAC = 0.05  # of the rms that stays without: plants without gap gain at most 0.01
_SOFT_GAIN_FRAC = 0.1  # of the rms that stays with play
_LOAD_GAIN_FRAC = 0.05  # of the rms that stays without a load on the nut
_LEAST_LOAD_FRAC = 0.2  # of what guide and constant load need together: less moves no flank far
_LEAST_ZONE_um, _WIDER = 1.5, 2.5  # where the fit of a soft zone begins at least, and again
_SETTLED_m = 0.2e-3  # a run starts on either flank, nobody knows which
_DECIMATION = 4
_MOST_STEPS = 15
# Factors of the guide's friction and of stiffness, shares of the guide in viscous friction and of
# the nut in the friction of what turns.
_BOUNDS = (0.05, 3.0), (0.3, 3.0), (0.0, 1.0), (0.0, 1.0)
_SCALES = 1.0, 1.0, 0.2, 1.0
_NUT_SHARE = 0.4
_N = len(_BOUNDS)
_TINY = 1e-12
_GUIDE_FRAC = 0.3  # of the lost motion of a model without a gap, where the fit of a gap begins
# What is fitted beside these: name, SI of a unit of it, bounds in that unit.
_Extra = tuple[tuple[str, float, tuple[float, float]], ...]
_NOTHING: _Extra = ()
_PLAY: _Extra = ((_GAP, 1.0 / UM_PER_M, (0.0, 100.0)),)
_SOFT: _Extra = ((_ZONE, 1.0 / UM_PER_M, (0.05, 50.0)), (_RATIO, 1.0, (0.05, 0.95)))
_LOAD_SHARE = (0.0, 1.5)  # of the load that the torque shows: the nut has losses


@dataclass(frozen=True)
class Clearance:
    """What captures show of a gap in the nut.

    Parameters
    ----------
    values : Mapping of str to float
        Gap or soft zone, the load on the nut where it has one, and what changes beside them, full
        names, SI.
    without_um, with_um : float
        Rms of the mechanical error that stays, with these parameters fitted without and with gap.
    """

    values: Mapping[str, float]
    without_um: float
    with_um: float

    @property
    def gap_m(self) -> float:
        """Full clearance in m; of a soft zone what it gives beyond the stiff spring."""
        if _GAP in self.values:
            return self.values[_GAP]
        return 2.0 * given_m(self.values[_ZONE], self.values[_RATIO])

    @property
    def load_N(self) -> float:
        """Constant load that presses the nut on one flank, N; positive resists positive motion."""
        return self.values.get(_LOAD, 0.0)

    @property
    def is_soft(self) -> bool:
        """Whether it is a soft zone and no play."""
        return _ZONE in self.values

    @property
    def effect(self) -> str:
        """The effect of a model that stands for it."""
        return _effect(self.values)


def given_m(half_width_m: float, stiffness_ratio: float) -> float:
    """What a soft zone of the nut gives at its edge beyond the stiff spring, m, on one flank."""
    return (1.0 - stiffness_ratio) * half_width_m


def _effect(values: Mapping[str, float]) -> str:
    return "backlash" if _GAP in values else "preload_loss"


def with_clearance(model: "DriveModel", values: Mapping[str, float]) -> "DriveModel":
    """Model with the gap of the nut and the parameters beside it (``Clearance.values``)."""
    own = {name: value for name, value in values.items() if name in {_GAP, _ZONE, _RATIO}}
    others = {name: value for name, value in values.items() if name not in {*own, _LOAD}}
    loose = model.with_parameters(others).with_effect(_effect(values), own)
    return loose.with_effect("bias_force", {_LOAD: values[_LOAD]}) if _LOAD in values else loose


def measured_clearance(
    model: "DriveModel", captures: Sequence[Capture], lead: LeadMap | None
) -> Clearance | None:
    """Gap that captures show beyond a model without one; None where there is none to speak of.

    Parameters
    ----------
    model : DriveModel
        Model whose dynamics fit otherwise, without torque per turn other than a ripple, which
        moves table and motor by more than a gap does.
    captures : sequence of Capture
        Runs without compensation, fast ones among them.
    lead : LeadMap or None
        Static error, mean of both directions.

    Returns
    -------
    Clearance or None
        None too for a model with a gap of its own or without the parameters that hide one.
    """
    runs = [_Run.of(c, lead) for c in captures if c.table_position_m is not None]
    runs = [run for run in runs if run.use.any()]
    if not runs or model.is_rigid or not _can_hide(model):
        return None
    start = 1.0, 1.0, _guide_share(model), _NUT_SHARE
    wound = _fit(model, runs, start, _NOTHING)
    best = _gap_fit(model, runs, wound, _NOTHING)
    load_N = _load_N(model, captures)
    if load_N != 0.0:
        loaded = _gap_fit(model, runs, wound, ((_LOAD, load_N, _LOAD_SHARE),))
        best = loaded if loaded.rms_um < (1.0 - _LOAD_GAIN_FRAC) * best.rms_um else best
    found = Clearance(_values(model, best.point, best.extra), wound.rms_um, best.rms_um)
    is_told = best.rms_um <= (1.0 - _LEAST_GAIN_FRAC) * wound.rms_um
    return found if is_told and found.gap_m * UM_PER_M >= _LEAST_GAP_um else None


def known_load_N(model: "DriveModel", captures: Sequence[Capture]) -> float:
    """Constant load as a force at the table that torque surely shows beyond the model; 0 for none.

    A load that the model has is not looked for again.
    """
    if "bias_force" in model.effects:
        return 0.0
    found = constant_torque(model_loop(model), captures)
    if found is None or abs(found.torque_Nm) <= found.two_std_Nm:
        return 0.0
    return found.torque_Nm / model.bench.lead_m_per_rad


def settled(capture: Capture) -> BoolArray:
    """Samples of a run after which it is known on which flank the nut is, shape (n,)."""
    steps = np.abs(np.diff(capture.commanded_position_m))
    return capture.mask & (np.concatenate([[0.0], np.cumsum(steps)]) > _SETTLED_m)


def _gap_fit(model: "DriveModel", runs: Sequence["_Run"], wound: "_Fit", load: _Extra) -> "_Fit":
    """Play, or a soft zone where that leaves clearly less."""
    pressed = [1.0] * len(load)
    guide, stiffness, viscous, _ = wound.point
    own = model.parameters
    lost_m = 2.0 * guide * own[_GUIDE] / (stiffness * own[_STIFFNESS])
    gap_um = (1.0 - _GUIDE_FRAC) * lost_m * UM_PER_M
    start = [_GUIDE_FRAC * guide, 1.2 * stiffness, viscous, _NUT_SHARE, gap_um, *pressed]
    loose = _fit(model, runs, start, _PLAY + load)
    # A wide zone is hardly play: it is looked for where no play is found, too.
    narrow_um = max(_LEAST_ZONE_um, 1.5 * loose.point[_N])
    zones_um = narrow_um, _WIDER * narrow_um  # each ends in a place of its own
    starts = ([*loose.point[:_N], zone_um, 0.5, *loose.point[_N + 1 :]] for zone_um in zones_um)
    tried = [_fit(model, runs, start, _SOFT + load) for start in starts]
    soft = min(tried, key=lambda fit: fit.rms_um)
    return soft if soft.rms_um < (1.0 - _SOFT_GAIN_FRAC) * loose.rms_um else loose


def _load_N(model: "DriveModel", captures: Sequence[Capture]) -> float:
    """Constant load that moves the flank far, as a force at the table; 0 for none."""
    force_N = known_load_N(model, captures)
    least_N = _LEAST_LOAD_FRAC * (abs(force_N) + model.parameters[_GUIDE])
    return force_N if abs(force_N) > least_N else 0.0


def _can_hide(model: "DriveModel") -> bool:
    from pmac_comp.physics.model.effect import split_name

    gaps = {"backlash", "preload_loss"} & {split_name(name)[0] for name in model.effects}
    return not gaps and _FITTED.issubset(model.parameters)


@dataclass(frozen=True)
class _Run:
    """Command, mechanical error and samples in use of a capture."""

    commanded_m: FloatArray
    error_m: FloatArray
    use: BoolArray

    @classmethod
    def of(cls, capture: Capture, lead: LeadMap | None) -> "_Run":
        r, table = capture.commanded_position_m, capture.table_position_m
        error = (r if table is None else table) - capture.motor_position_m
        return cls(r, error if lead is None else error - lead.at(r), settled(capture))


@dataclass(frozen=True)
class _Fit:
    """Factors and share of the drive's parameters, what is fitted beside them, and what stays."""

    point: FloatArray
    extra: _Extra
    rms_um: float


def _fit(model: "DriveModel", runs: Sequence[_Run], start: Sequence[float], extra: _Extra) -> _Fit:
    bounds = [*_BOUNDS, *(limits for _, _, limits in extra)]
    lower, upper = (np.array(side) for side in zip(*bounds, strict=True))

    def residual(point: FloatArray) -> FloatArray:
        return _rest_um(_moved(model, point, extra), runs)

    with working() as threads:
        solved = least_squares(
            residual,
            np.clip(start, lower + 1e-3, upper - 1e-3),
            bounds=(lower, upper),
            x_scale=[*_SCALES, *(1.0 for _ in extra)],
            diff_step=[1e-2],
            max_nfev=_MOST_STEPS,
            xtol=1e-3,
            ftol=1e-3,
            workers=threads.map,
        )
    return _Fit(solved.x, extra, math.sqrt(2.0 * solved.cost / len(runs)))


def _rest_um(model: "DriveModel", runs: Sequence[_Run]) -> FloatArray:
    """What a model leaves of the mechanical error, each run with the same weight."""
    loop = model_loop(model)
    parts = []
    for run in runs:
        signals = loop(run.commanded_m, None, None)
        simulated = signals.table_position_m - signals.motor_position_m
        rest = (run.error_m - simulated)[run.use]
        rest = (rest - rest.mean())[::_DECIMATION]
        parts.append(rest * UM_PER_M / math.sqrt(rest.size))
    return np.concatenate(parts)


def _moved(model: "DriveModel", point: FloatArray, extra: _Extra) -> "DriveModel":
    values = _values(model, point, extra)
    return with_clearance(model, values) if extra else model.with_parameters(values)


def _values(model: "DriveModel", point: FloatArray, extra: _Extra) -> dict[str, float]:
    own = model.parameters
    guide, stiffness, viscous, nut = point[:_N].tolist()
    guide_N = own[_GUIDE] * guide
    per_N = model.bench.lead_m_per_rad
    turning_Nm = max(0.0, own[_MOTOR] + own[_NUT] + (own[_GUIDE] - guide_N) * per_N)
    viscous_Ns_per_m = _viscous_Ns_per_m(model)
    left_Nms = (1.0 - viscous) * viscous_Ns_per_m * per_N * per_N
    of_nut = own[_NUT_VISCOUS] / max(own[_NUT_VISCOUS] + own[_MOTOR_VISCOUS], _TINY)
    beside = zip(extra, point[_N:].tolist(), strict=True)
    return {
        _GUIDE: guide_N,
        _NUT: turning_Nm * nut,
        _MOTOR: turning_Nm * (1.0 - nut),
        _STIFFNESS: own[_STIFFNESS] * stiffness,
        _GUIDE_VISCOUS: viscous * viscous_Ns_per_m,
        _NUT_VISCOUS: left_Nms * of_nut,
        _MOTOR_VISCOUS: left_Nms * (1.0 - of_nut),
    } | {name: value * unit for (name, unit, _), value in beside}


def _guide_share(model: "DriveModel") -> float:
    """Share of the guide in what viscous friction takes at the table."""
    return model.parameters[_GUIDE_VISCOUS] / max(_viscous_Ns_per_m(model), _TINY)


def _viscous_Ns_per_m(model: "DriveModel") -> float:
    """Viscous friction of guide, nut and motor together, at the table."""
    own, per_N = model.parameters, model.bench.lead_m_per_rad
    return own[_GUIDE_VISCOUS] + (own[_NUT_VISCOUS] + own[_MOTOR_VISCOUS]) / per_N**2
