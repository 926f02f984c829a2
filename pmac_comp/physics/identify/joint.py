"""``identify``: friction and stiffness together, from captures and a bench file.

What lives here: the choice of the path (elastic drive with a scale, or rigid drive) and the
assembly of the result. What may not: numerics of either path. Imports this package.
"""

from collections.abc import Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from typing import Literal

import numpy as np
from scipy.stats import t as student

from pmac_comp.base.arrays import BoolArray, FloatArray
from pmac_comp.base.errors import ModelError
from pmac_comp.base.progress import Progress, untold
from pmac_comp.base.threads import working
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.identify import records as rec
from pmac_comp.physics.identify.derivatives import BORDER_SAMPLES
from pmac_comp.physics.identify.identifiability import (
    informed_frac,
    require_identifiable,
    require_long_enough,
    require_table,
    resonance_statement,
    statements,
)
from pmac_comp.physics.identify.linear_start import starting_model
from pmac_comp.physics.identify.output_error import Fit, Stages, refine, require_converged
from pmac_comp.physics.identify.plausibility import require_plausible
from pmac_comp.physics.identify.problem import BEYOND_STEPS, step_floors
from pmac_comp.physics.identify.regression import Regression
from pmac_comp.physics.identify.result import (
    CaptureResiduals,
    Identification,
    NoiseLevels,
    ParameterEstimate,
    correlation_of,
    estimate,
)
from pmac_comp.physics.identify.rigid import (
    IN_MODEL,
    force_of,
    in_model,
    rigid_regression,
    rigid_start,
)
from pmac_comp.physics.model.drive import DriveModel, Response

_STATIC_EFFECTS = ("lead_linear", "lead_cyclic", "encoder_eccentricity", "scale_slope")
# With these effects only, the moments after a reversal are left out: see ``records.prepare``.
_NO_DETAIL_AT_REST = {
    "coulomb",
    "viscous",
    "bias_force",
    "payload",
    "lead_linear",
    "lead_cyclic",
    "friction_asymmetry",
    "viscous_nonlinear",
}
_WORSE = 2.2  # around reversals over elsewhere; plain Coulomb friction gives 1.5 to 1.8
_FEW_ROWS = 50


def identify(
    captures: Sequence[Capture],
    bench: Bench,
    *,
    model: DriveModel | None = None,
    progress: Progress | None = None,
    names: Iterable[str] | None = None,
    static_map: Literal["auto", "free", "none"] = "auto",
    warm: bool = False,
    held_out: Sequence[BoolArray] | None = None,
    stages: Stages = "all",
    executor: Executor | None = None,
) -> Identification:
    """Friction and stiffness of a drive, identified together, with intervals.

    Parameters
    ----------
    captures : sequence of Capture
        Runs, from rest or cut out of a motion. ``extra["external_force_N"]`` holds the load of the
        side screws where there was one; invalid samples are left out.
    bench : Bench
        What is known, with tolerances.
    model : DriveModel or None
        Start with other effects; None means the base model of the bench.
    progress : callable or None
        ``progress(text, fraction)``.
    names : iterable of str or None
        Estimate only these parameters; None means all.
    static_map : "auto", "free" or "none"
        Whether a static lead map is estimated beside the dynamics; ``auto`` does so unless the
        model has lead or sensor errors of its own.
    warm : bool
        Start from ``model``, found from the same captures, instead of the linear regressions.
    held_out : sequence of ndarray of bool, or None
        Samples of each capture, shape (n,), that are simulated but not fitted; residuals hold them.
    stages : "all", "outline", "rough" or "fine"
        See ``output_error.refine``.
    executor : Executor or None
        Where simulations run; None uses threads.

    Returns
    -------
    Identification
        Fitted model, parameters in SI with 95 % intervals, residuals, statements.

    Raises
    ------
    NotIdentifiable
        Something that compensation needs is not determined; the hint names the run to make.
    DidNotConverge
        The refinement did not settle.
    CaptureError
        A capture contradicts the bench file grossly (signs, units, channels, samples).
    """
    if not captures:
        raise ModelError(
            "No capture was given.", code="PC-IDN-011", hint="Give at least one capture."
        )
    if not warm:  # else they have been through it
        require_plausible(captures, bench)
    start = DriveModel.base(bench) if model is None else model
    if start.is_rigid and model is None:
        return _identify_rigid(captures, bench, start, progress)
    if model is None:
        require_table(captures)
    if not warm:
        start = rigid_start(captures, bench, start)
    return _identify_elastic(
        captures,
        bench,
        start,
        progress,
        names,
        static_map,
        executor,
        warm=warm,
        held_out=held_out,
        stages=stages,
    )


def _identify_elastic(
    captures: Sequence[Capture],
    bench: Bench,
    start: DriveModel,
    progress: Progress | None,
    names: Iterable[str] | None,
    static_map: str,
    executor: Executor | None,
    *,
    warm: bool,
    held_out: Sequence[BoolArray] | None,
    stages: Stages,
) -> Identification:
    tell = progress or untold
    has_scale = any(c.table_position_m is not None for c in captures) and not start.is_rigid
    if has_scale and not warm:
        tell("linear start from the two regressions", 0.0)
        start = starting_model(captures, bench, start)
    plain = has_scale and set(start.effects) <= _NO_DETAIL_AT_REST
    leave_out: rec.LeaveOut = "nothing"
    if has_scale:
        leave_out = "reversals" if plain else "rest"
    records = [rec.prepare(capture, bench, leave_out=leave_out) for capture in captures]
    if held_out is not None:
        records = [
            replace(r, valid=r.valid & ~out[:: r.factor])
            for r, out in zip(records, held_out, strict=True)
        ]
    own = any(name.partition("@")[0] in _STATIC_EFFECTS for name in start.effects)
    free_map = static_map == "free" or (static_map == "auto" and not own)
    if names is None and has_scale:
        require_long_enough(records)
    columns, shape = rec.nuisances(records, bench, static_map=free_map)
    with working(executor) as workers:
        fit = refine(
            records,
            columns,
            start,
            bench,
            names=names,
            weights="white" if start.is_rigid else "coloured",
            rounding=held_out is None,
            stages=stages,
            steady=[rec.steady_rows(r) for r in records] if leave_out == "rest" else None,
            progress=tell,
            executor=workers,
        )
        jobs = [(record, fit.model) for record in records]
        responses = list(workers.map(_response_of_pair, jobs))
    if stages in {"all", "fine"}:
        require_converged(fit)
    undetermined: tuple[str, ...] = ()
    if names is None and has_scale:
        has_torque = any(capture.torque_command_Nm is not None for capture in captures)
        undetermined = require_identifiable(
            fit, has_torque=has_torque, speed_m_per_s=max(map(_top_speed_m_per_s, captures))
        )
    residuals = tuple(
        _residuals_of(record, response, fit, column, i)
        for i, (record, response, column) in enumerate(
            zip(records, responses, columns, strict=True)
        )
    )
    noise = _noise(residuals)
    return Identification(
        model=fit.model,
        parameters=_estimates(fit),
        correlation_names=fit.names,
        correlation=correlation_of(fit.covariance),
        noise=noise,
        residuals=residuals,
        statements=(
            *undetermined,
            *statements(fit),
            *resonance_statement(fit.model, bench),
            *(_after_reversals(records, residuals) if has_scale else ()),
            *(_beyond_steps(bench, noise) if has_scale else ()),
        ),
        method="two linear regressions, then output error through the closed loop",
        figures={"rounds": float(fit.rounds), "last_step_std": fit.step},
        static_map=None
        if shape is None
        else rec.map_from(shape, fit.nuisance[rec.n_leading(len(records)) :]),
    )


def _top_speed_m_per_s(capture: Capture) -> float:
    step_m = np.abs(np.diff(capture.commanded_position_m))
    return float(np.nanquantile(step_m, 0.999)) / capture.sample_period_s


def _estimates(fit: Fit) -> dict[str, ParameterEstimate]:
    share = informed_frac(fit)
    widths = np.asarray(student.ppf(0.975, fit.freedom))
    found = {}
    for i, name in enumerate(fit.names):
        spec = fit.model.spec(name)
        value, std = fit.model.parameters[name], float(np.sqrt(fit.covariance[i, i]))
        known, width = spec.kind == "known", float(widths[i])
        found[name] = ParameterEstimate(
            name=name,
            value=value,
            std=std,
            lower95=max(value - width * std, spec.lower),
            upper95=min(value + width * std, spec.upper),
            unit=spec.unit,
            nominal=spec.nominal if known else None,
            tolerance_frac=spec.tolerance_frac if known else None,
            informed_frac=float(share[i]),
        )
    return found


def _response_of_pair(job: tuple[rec.Record, DriveModel]) -> Response:
    return rec.response_of(*job)


def _residuals_of(
    record: rec.Record, response: Response, fit: Fit, nuisance: FloatArray, i: int
) -> CaptureResiduals:
    capture, cut = record.capture, slice(None, None, record.stride)

    def left(measured: FloatArray | None, simulated: FloatArray) -> FloatArray | None:
        if measured is None:
            return None
        return np.where(capture.mask, measured - simulated[cut][: capture.n], np.nan)

    motor = left(capture.motor_position_m, response.motor_position_m)
    table = None
    if capture.table_position_m is not None:
        difference = capture.table_position_m - capture.motor_position_m
        table = left(difference, response.mechanical_error_m)
        table = None if table is None else table - nuisance @ fit.nuisance
    return CaptureResiduals(
        motor_m=motor,
        table_m=table,
        torque_Nm=left(capture.torque_command_Nm, response.torque_command_Nm),
        scale_offset_m=float(fit.nuisance[i]) if table is not None else 0.0,
    )


def share_after_reversals(
    records: Sequence[rec.Record], residuals: Sequence[CaptureResiduals]
) -> tuple[float, float] | None:
    """Rms in m of what is left of table minus motor in steady motion and around reversals.

    None where either is too short to say.
    """
    steady, turning = [], []
    for record, left in zip(records, residuals, strict=True):
        if left.table_m is None:
            continue
        thin = rec.thinned(np.nan_to_num(left.table_m)[:, np.newaxis], record.factor)[:, 0]
        calm = rec.steady_rows(record)
        steady.append(thin[calm])
        turning.append(thin[rec.moving_rows(record) & rec.clean_rows(record) & ~calm])
    if not steady or min(np.concatenate(steady).size, np.concatenate(turning).size) < _FEW_ROWS:
        return None
    return float(np.std(np.concatenate(steady))), float(np.std(np.concatenate(turning)))


def _after_reversals(
    records: Sequence[rec.Record], residuals: Sequence[CaptureResiduals]
) -> tuple[str, ...]:
    """Says so where friction in detail, which a Coulomb model leaves out, shows in the error."""
    levels = share_after_reversals(records, residuals)
    if levels is None or levels[1] < _WORSE * levels[0]:
        return ()
    calm_um, turning_um = (UM_PER_M * level for level in levels)
    return (
        f"Around reversals the model leaves {turning_um:.2f} um rms of table minus motor, "
        f"elsewhere {calm_um:.2f} um: friction there is not what the model holds. "
        "`pmac-comp diagnose` finds out what is missing.",
    )


def _beyond_steps(bench: Bench, noise: NoiseLevels) -> tuple[str, ...]:
    """Says so where the model leaves clearly more than the steps of the sensors make."""
    steps_m = step_floors(bench)
    left = [
        f"{UM_PER_M * level:.2f} um rms of {what} ({UM_PER_M * steps_m[channel]:.2f})"
        for what, channel, level in (
            ("the motor's position", "motor", noise.motor_m),
            ("table minus motor", "difference", noise.table_m),
        )
        if level is not None and level > BEYOND_STEPS * steps_m[channel]
    ]
    if not left:
        return ()
    return (
        f"The model leaves {' and '.join(left)}; in brackets what the steps of the sensors alone "
        "make. Sensors that are noisy, or something that the model lacks: `pmac-comp diagnose` "
        "tells which. Intervals hold for a model that is whole.",
    )


def _noise(residuals: Sequence[CaptureResiduals]) -> NoiseLevels:
    def level(columns: list[FloatArray | None]) -> float | None:
        given = [column[np.isfinite(column)] for column in columns if column is not None]
        return float(np.std(np.concatenate(given))) if given else None

    return NoiseLevels(
        motor_m=level([r.motor_m for r in residuals]),
        table_m=level([r.table_m for r in residuals]),
        torque_Nm=level([r.torque_Nm for r in residuals]),
    )


def _identify_rigid(
    captures: Sequence[Capture], bench: Bench, start: DriveModel, progress: Progress | None
) -> Identification:
    if progress is not None:
        progress("inverse dynamics by least squares", 0.0)
    fit = rigid_regression(captures, bench)
    model = start.with_effect("bias_force") if "bias_force" not in start.effects else start
    model = model.with_parameters(in_model(fit))
    records = [rec.prepare(capture, bench) for capture in captures]
    residuals, figures = _rigid_residuals(records, bench, model)
    if progress is not None:
        progress("done", 1.0)
    return Identification(
        model=model,
        parameters=_rigid_estimates(fit, model),
        correlation_names=tuple(IN_MODEL.values()),
        correlation=correlation_of(fit.covariance),
        noise=_noise(residuals),
        residuals=residuals,
        statements=(
            "Without a scale at the table the drive is one mass: friction of guide, nut and "
            "bearings is their sum at the table, and stiffness does not show.",
        ),
        method="inverse dynamics, least squares on decimated zero-phase filtered signals",
        figures={"relative_force_error_percent": 100.0 * fit.relative_error, **figures},
    )


def _rigid_estimates(fit: Regression, model: DriveModel) -> dict[str, ParameterEstimate]:
    return {
        name: estimate(name, fit.value(own), fit.std(own), model.spec(name).unit)
        for own, name in IN_MODEL.items()
    }


def _rigid_residuals(
    records: Sequence[rec.Record], bench: Bench, model: DriveModel
) -> tuple[tuple[CaptureResiduals, ...], dict[str, float]]:
    """Closed-loop residuals and their figures: position rms and relative force error."""
    inner = slice(BORDER_SAMPLES, -BORDER_SAMPLES)
    found, position, force, measured_force = [], [], [], []
    for record in records:
        response = rec.response_of(record, model)
        cut = slice(None, None, record.stride)
        n = record.capture.n
        motor = record.capture.motor_position_m - response.motor_position_m[cut][:n]
        measured = force_of(record.capture, bench) * bench.lead_m_per_rad
        torque = measured - response.torque_command_Nm[cut][:n]
        ok = record.capture.mask
        found.append(
            CaptureResiduals(np.where(ok, motor, np.nan), None, np.where(ok, torque, np.nan))
        )
        position.append(motor[ok][inner])
        force.append(torque[ok][inner])
        measured_force.append(measured[ok][inner])
    left = np.concatenate(position)
    force_error = np.linalg.norm(np.concatenate(force))
    return tuple(found), {
        "closed_loop_position_rms_um": UM_PER_M * float(np.sqrt(np.mean(left**2))),
        "closed_loop_position_peak_um": UM_PER_M * float(np.max(np.abs(left))),
        "closed_loop_force_error_percent": 100.0
        * float(force_error / np.linalg.norm(np.concatenate(measured_force))),
    }
