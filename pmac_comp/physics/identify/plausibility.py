"""Captures that cannot be what the bench file says: refused before anything is fitted to them.

What lives here: rough checks of signs, units, channels and samples, each with what to look at. What
may not: statistics of a fit. Imports ``files``, ``base``, ``physics.model`` and this package's
derivatives.

Every bound here is far outside what friction, elasticity and tolerances can do.
"""

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from scipy.ndimage import uniform_filter1d

from pmac_comp.base.arrays import BoolArray, FloatArray
from pmac_comp.base.errors import CaptureError, SampleGap
from pmac_comp.base.units import MM_PER_M, UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.identify.derivatives import Motion, bridged, motion_of
from pmac_comp.physics.model.chain import is_rigid
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.quasi_static import compliance_m_per_N

_FEWEST = 100  # valid samples that say anything
_MOVES_m = 2e-4  # less motion than this says nothing about ratios
_FOLLOWS = (0.7, 1.4)  # motor over command
_STANDS = 0.1  # of what is asked: a motor that moves by less has not followed at all
_SLOW_s = 0.2  # what lasts as long every position loop follows
_SCALE = 0.01  # table over motor less one: lead error and growth are below 1e-4
_SOFTER = 2.0  # than stated, at most: a slender screw lets a fast sine grow by some per cent
_LAGS_m = 5e-5  # more than friction and a worn nut hold back
_REPEATED = 0.02  # share of moving samples
_FLAT = 0.02  # share of samples at the very top of the torque
_BEYOND, _FULL_DAC = 1.5, 32768.0  # times the full output: no card sends that
_INERTIA = (0.7, 1.6)  # torque per acceleration over what the bench file says
_FINER = (1.02, 16.0)  # count of the bench file over that of the readings
_ROUND_OFF_m = 2e-10
_FEW_STEPS = 200
_FAR_COUNTS = 50  # steps longer than this say little about the count
_OFF_LATTICE = 0.05
_DIFFERENT, _OFTEN = 5, 10  # so many multiples, each so often
_STUCK_SAMPLES, _STUCK_COUNTS = 20, 20
_NO_LAG_m_per_m_per_s2 = 0.2e-6
_STRETCHES = 12  # of a run, for the error of a slope


def require_plausible(captures: Sequence[Capture], bench: Bench) -> None:
    """Raise CaptureError where a capture contradicts the bench file grossly.

    Parameters
    ----------
    captures : sequence of Capture
        Runs to identify from.
    bench : Bench
        Their bench.

    Raises
    ------
    CaptureError
        Channel swapped, reversed, in other units or clipped; motor without power.
    SampleGap
        Samples that repeat the ones before.
    """
    for i, capture in enumerate(captures):
        name = str(capture.attributes.get("motion") or f"capture {i + 1}")
        if int(capture.mask.sum()) < _FEWEST:
            continue
        _require_one_axis(capture, bench, name)
        _require_whole_torque(capture, bench, name)
        _require_signs(capture, bench, name)
        _require_counts(capture, bench, name)


def require_positions(capture: Capture, bench: Bench, name: str) -> None:
    """Raise CaptureError where command, motor and table are not positions of one axis.

    Nothing here depends on masses, torque or friction, which a diagnosis may find to be others.

    Parameters
    ----------
    capture : Capture
        Run, of any length; one with few valid samples passes.
    bench : Bench
        Its bench.
    name : str
        What to call the run.

    Raises
    ------
    CaptureError
        Channel reversed, in other units or counts, or standing still.
    SampleGap
        Samples that repeat the ones before.
    """
    if int(capture.mask.sum()) >= _FEWEST:
        _require_one_axis(capture, bench, name)
        _require_counts(capture, bench, name)


def _require_one_axis(capture: Capture, bench: Bench, name: str) -> None:
    _require_fresh_samples(capture, name)
    _require_motor_follows(capture, bench, name)
    _require_live_scale(capture, bench, name)
    _require_table_follows(capture, bench, name)


def _require_fresh_samples(capture: Capture, name: str) -> None:
    columns = [
        column
        for column in (
            capture.commanded_position_m,
            capture.motor_position_m,
            capture.torque_command_Nm,
        )
        if column is not None
    ]
    same = np.all([np.diff(column) == 0.0 for column in columns], axis=0)
    moving = np.abs(np.diff(_smooth_command(capture))) > 1e-8
    ok = capture.mask[1:] & capture.mask[:-1] & moving
    share = float(np.mean(same[ok])) if ok.sum() > 100 else 0.0
    if share > _REPEATED:
        raise SampleGap(
            f"{name}: {100 * share:.0f} % of the samples in motion repeat the one before in every "
            "channel.",
            code="PC-IDN-041",
            hint="Gather fewer channels or at a lower rate, and state the true sample period.",
        )


def _require_counts(capture: Capture, bench: Bench, name: str) -> None:
    """No reading between two counts: pitch, counts per revolution or resolution are others."""
    readings = [("motor", capture.motor_position_m, bench.motor_resolution_m, "counts_per_rev")]
    if capture.table_position_m is not None and bench.scale_resolution_m is not None:
        scale = capture.table_position_m
        readings.append(("table", scale, bench.scale_resolution_m, "resolution_um of the scale"))
    for which, values, stated, key in readings:
        found = _count_m(values[capture.mask])
        # Finer still is an interpolation that the bench file need not state.
        if found is not None and _FINER[0] < stated / found < _FINER[1]:
            raise CaptureError(
                f"{name}: the {which} readings are whole multiples of {found * UM_PER_M:.4g} um; "
                f"by the bench file a count is {stated * UM_PER_M:.4g} um.",
                code="PC-IDN-047",
                hint=f"Check pitch_mm and {key}." if which == "motor" else f"Check {key}.",
            )


def _count_m(values: FloatArray) -> float | None:
    """Step that all readings are whole multiples of; None where they are not on such a lattice."""
    steps = np.abs(np.diff(values))
    steps = steps[steps > _ROUND_OFF_m]
    if steps.size < _FEW_STEPS or not bool(np.all(np.isfinite(steps))):
        return None
    count = float(np.quantile(steps, 0.01))
    for _ in range(3):
        whole = np.round(steps / count)
        near = (whole > 0) & (whole <= _FAR_COUNTS)
        if near.sum() < _FEW_STEPS:
            return None
        count = float(steps[near] @ whole[near] / (whole[near] @ whole[near]))
    _, times = np.unique(whole[near], return_counts=True)
    if np.sum(times >= _OFTEN) < _DIFFERENT:
        return None  # one constant speed is no lattice
    off = np.abs(steps[near] / count - np.round(steps[near] / count))
    return count if float(np.quantile(off, 0.99)) < _OFF_LATTICE else None


def _smooth_command(capture: Capture) -> FloatArray:
    """Command averaged over five samples, so that a repeated one still counts as motion."""
    command = bridged(capture.commanded_position_m, capture.mask)
    return np.convolve(np.pad(command, 2, mode="edge"), np.full(5, 0.2), mode="valid")


def _require_motor_follows(capture: Capture, bench: Bench, name: str) -> None:
    ratio = _ratio(capture.motor_position_m, capture.desired_m, capture)
    if ratio is None or _FOLLOWS[0] < ratio < _FOLLOWS[1]:
        return
    moved, asked = (
        float(np.ptp(v[capture.mask])) for v in (capture.motor_position_m, capture.desired_m)
    )
    stands = moved < min(_MOVES_m, _STANDS * asked)
    if not stands:
        # Beyond its bandwidth a loop follows late and by less, in the end against the command.
        motor_m, desired_m = capture.motor_position_m, capture.desired_m
        ratio = _ratio(_slowly(motor_m, capture), _slowly(desired_m, capture), capture)
        if ratio is None or _FOLLOWS[0] < ratio < _FOLLOWS[1]:
            return
        if _share_at(capture, _least_limit_Nm(bench)) > _FLAT:
            return  # a saturated drive may do anything
    if stands:
        what = "the motor did not move with the command"
        hint = "Was the motor powered and the loop closed? Check the channel of the motor."
    elif ratio < 0.0:
        what = "the motor moved against the command"
        hint = "Check the sign of the motor channel."
    else:
        what = f"the motor moved {ratio:.4g} times what was commanded"
        hint = "Check units, pitch_mm and counts_per_rev of the motor channel."
    raise CaptureError(f"{name}: {what}.", code="PC-IDN-042", hint=hint)


def _require_live_scale(capture: Capture, bench: Bench, name: str) -> None:
    """No stretch in which the scale's reading stands still and the motor moves on."""
    table, motor = capture.table_position_m, capture.motor_position_m
    if table is None or float(np.ptp(table[capture.mask])) == 0.0:
        return
    far_m = max(_MOVES_m, _STUCK_COUNTS * (bench.scale_resolution_m or 0.0))
    changes = np.flatnonzero((np.diff(table) != 0.0) | ~capture.mask[1:] | ~capture.mask[:-1])
    edges = np.concatenate(([0], changes + 1, [capture.n]))
    for first, end in pairwise(edges):
        if end - first < _STUCK_SAMPLES or float(np.ptp(motor[first:end])) < far_m:
            continue
        begin_s = capture.time_s[first] - capture.time_s[0]
        raise CaptureError(
            f"{name}: from {begin_s:.3f} s the reading of the scale stands still for "
            f"{(end - first) * capture.sample_period_s:.2g} s, while the motor moves "
            f"{MM_PER_M * float(np.ptp(motor[first:end])):.2g} mm.",
            code="PC-IDN-048",
            hint="Look at cable, supply and reading head of the scale and repeat the run, or leave "
            "those samples out (mark them invalid).",
        )


def _require_table_follows(capture: Capture, bench: Bench, name: str) -> None:
    if capture.table_position_m is None:
        return
    ratio = _ratio(capture.table_position_m, capture.motor_position_m, capture)
    if ratio is None or abs(ratio - 1.0) < _SCALE:
        return
    if abs(ratio - 1.0) < _SCALE + _SOFTER * _stretch_share(capture, bench):
        return
    way_m = float(np.ptp(capture.motor_position_m[capture.mask]))
    if abs(ratio - 1.0) * way_m < _LAGS_m:
        return  # on a short way backlash and windup are more than a share of it
    if abs(ratio) < 0.05:
        what, hint = "the table does not move with the motor", "Is the scale connected?"
    elif ratio < 0.0:
        what, hint = "the scale counts against the motor", "Reverse the sign of the table channel."
    else:
        what = f"the table moved {ratio:.5g} times what the motor did"
        hint = "Check units and resolution_um of the scale, and pitch_mm and counts_per_rev."
    raise CaptureError(f"{name}: {what}.", code="PC-IDN-043", hint=hint)


def _stretch_share(capture: Capture, bench: Bench) -> float:
    """Size of the slope, on the motor's position, of what inertia stretches a drive as stated."""
    mass_kg = bench.nominal.table_mass_kg
    if mass_kg is None or is_rigid(bench):
        return 0.0
    motion = motion_of(capture.motor_position_m, capture.sample_period_s, capture.mask)
    compliance = compliance_m_per_N(DriveModel.base(bench), motion.position_m)
    stretch_m = compliance * mass_kg * motion.acceleration_m_per_s2
    return abs(_ratio(stretch_m, capture.motor_position_m, capture) or 0.0)


def _require_whole_torque(capture: Capture, bench: Bench, name: str) -> None:
    if capture.torque_command_Nm is None:
        return
    top = float(np.abs(capture.torque_command_Nm[capture.mask]).max())
    full_Nm = _FULL_DAC * bench.drive.torque_per_dac_Nm
    if bench.controller.kind == "pmac" and top > _BEYOND * full_Nm:
        raise CaptureError(
            f"{name}: the torque reaches {top:.4g} N m, the full output of the card is "
            f"{full_Nm:.4g} N m.",
            code="PC-IDN-049",
            hint="Is the torque channel in N m? Else check torque_per_dac_Nm.",
        )
    share = _share_at(capture, top)
    if top > 0.0 and share > _FLAT and top < 0.98 * _least_limit_Nm(bench):
        raise CaptureError(
            f"{name}: the torque stands at {top:.4g} N m in {100 * share:.0f} % of the samples, "
            f"below the limit of the bench file ({_least_limit_Nm(bench):.4g} N m): the channel "
            "was clipped.",
            code="PC-IDN-044",
            hint="Capture it with more range, mark those samples invalid, or state the true "
            "torque_limit_Nm.",
        )


def _share_at(capture: Capture, level_Nm: float) -> float:
    """Share of the samples whose torque is at a level or above."""
    if capture.torque_command_Nm is None:
        return 0.0
    size = np.abs(capture.torque_command_Nm[capture.mask])
    return float(np.mean(size > level_Nm * (1.0 - 1e-3)))


def _least_limit_Nm(bench: Bench) -> float:
    motor = bench.encoder.motor_number
    dac = float(bench.controller.ivariables.get(f"I{motor}69", 32767.0))
    law = dac * bench.drive.torque_per_dac_Nm if bench.controller.kind == "pmac" else np.inf
    return float(min(bench.drive.torque_limit_Nm, law))


def _require_signs(capture: Capture, bench: Bench, name: str) -> None:
    """Table lags where it is accelerated, torque grows with it, both by about what is stated."""
    meant = motion_of(capture.commanded_position_m, capture.sample_period_s, capture.mask)
    done = motion_of(capture.motor_position_m, capture.sample_period_s, capture.mask)
    keep = done.usable & (np.abs(done.velocity_m_per_s) > 2e-3)
    if keep.sum() < 500 or float(np.std(meant.acceleration_m_per_s2[keep])) < 0.3:
        return
    if capture.table_position_m is not None:
        error = bridged(capture.table_position_m - capture.motor_position_m, capture.mask)
        if _per_acceleration(error, meant, done, keep)[0] > _NO_LAG_m_per_m_per_s2:
            raise CaptureError(
                f"{name}: the table runs ahead of the motor where it is accelerated; a drive lags.",
                code="PC-IDN-045",
                hint="Are the channels of motor and table swapped?",
            )
    if capture.torque_command_Nm is None or float(np.ptp(capture.torque_command_Nm)) == 0.0:
        return
    expected = _inertia_kgm2(bench)
    if expected is None or _share_at(capture, _least_limit_Nm(bench)) > _FLAT:
        return  # a saturated drive does not get what was commanded
    per_unit = bench.lead_m_per_rad / expected
    low, ratio, high = (
        per_unit * x for x in _per_acceleration(capture.torque_command_Nm, meant, done, keep)
    )
    if high < _INERTIA[0] or low > _INERTIA[1]:
        raise CaptureError(
            f"{name}: the torque per acceleration is {ratio:.3g} times what inertias, mass and "
            "pitch of the bench file make it.",
            code="PC-IDN-046",
            hint="Check pitch_mm, torque_per_dac_Nm, table_mass_kg and the sign and unit of the "
            "torque channel.",
        )


def _per_acceleration(
    values: FloatArray, meant: Motion, done: Motion, keep: BoolArray
) -> tuple[float, float, float]:
    """Slope on acceleration beside speed, direction and place: low end, itself, high end.

    Torque ripple shakes the motor, the torque of the loop answers it, and counts make noise: none
    of it goes with the commanded motion, which is the instrument. The ends are three
    standard errors away, from the slopes without a stretch of the run each (delete-a-group
    jackknife).

    Source
    ------
    Janot, Vandanjon and Gautier, IEEE Trans. Control Systems Technology 22 (2014): instrumental
    variables from the command. Efron and Tibshirani, An Introduction to the Bootstrap, ch. 11.
    """
    instruments, columns = (_columns(motion, keep) for motion in (meant, done))
    scale = np.abs(columns).max(axis=0)
    scale[scale == 0.0] = 1.0
    instruments, columns, wanted = instruments / scale, columns / scale, values[keep]
    groups = np.arange(wanted.size) * _STRETCHES // wanted.size
    parts = [groups == g for g in range(_STRETCHES)]
    gram = np.array([instruments[g].T @ columns[g] for g in parts])
    moment = np.array([instruments[g].T @ wanted[g] for g in parts])

    def slope(normal: FloatArray, right: FloatArray) -> float:
        found, *_ = np.linalg.lstsq(normal, right, rcond=None)
        return float(found[0] / scale[0])

    whole = slope(gram.sum(axis=0), moment.sum(axis=0))
    without = np.array(
        [
            slope(gram.sum(axis=0) - g, moment.sum(axis=0) - m)
            for g, m in zip(gram, moment, strict=True)
        ]
    )
    share = (_STRETCHES - 1) / _STRETCHES
    error = math.sqrt(share * float(np.sum((without - without.mean()) ** 2)))
    return whole - 3.0 * error, whole, whole + 3.0 * error


def _columns(motion: Motion, keep: BoolArray) -> FloatArray:
    v = motion.velocity_m_per_s
    terms = (motion.acceleration_m_per_s2, v, np.sign(v), np.ones_like(v), motion.position_m)
    return np.column_stack([term[keep] for term in terms])


def _inertia_kgm2(bench: Bench) -> float | None:
    nominal = bench.nominal
    if nominal.table_mass_kg is None or nominal.motor_inertia_kgm2 is None:
        return None
    rotary = nominal.motor_inertia_kgm2 + (nominal.screw_inertia_kgm2 or 0.0)
    return rotary + nominal.table_mass_kg * bench.lead_m_per_rad**2


def _slowly(values: FloatArray, capture: Capture) -> FloatArray:
    """A position without what is faster than ``_SLOW_s``, shape (n,)."""
    width = max(1, round(_SLOW_s / capture.sample_period_s))
    once = uniform_filter1d(bridged(values, capture.mask), width, mode="nearest")
    return np.asarray(uniform_filter1d(once, width, mode="nearest"))


def _ratio(values: FloatArray, against: FloatArray, capture: Capture) -> float | None:
    """Slope of one position on another; None without enough motion."""
    x, y = against[capture.mask], values[capture.mask]
    if not bool(np.all(np.isfinite(x)) and np.all(np.isfinite(y))) or float(np.ptp(x)) < _MOVES_m:
        return None
    x = (x - x.mean()) * MM_PER_M
    return float(x @ (y - y.mean()) * MM_PER_M / (x @ x))
