"""Rival models side by side: the same captures to fit, the same unseen captures to judge.

Imports this package and ``physics.model``.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pmac_comp.base.arrays import BoolArray, FloatArray
from pmac_comp.base.errors import ModelError
from pmac_comp.base.progress import Progress, untold
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import TRUE_POSITIONS, Capture
from pmac_comp.physics.identify.friction_form import identify_with_friction
from pmac_comp.physics.identify.records import prepare, simulated_full
from pmac_comp.physics.identify.result import Identification, StaticMap
from pmac_comp.physics.identify.rivals import fit_rival, rivals
from pmac_comp.physics.signals.metrics import rms_um

FULL_NAME = "full model, from the command alone"


@dataclass(frozen=True)
class ComparisonRow:
    """What one model leaves of the mechanical error, rms over the judged captures, um."""

    name: str
    source: str
    n_parameters: int
    left_rms_um: float
    error_rms_um: float
    left_per_capture_um: tuple[float, ...]


@dataclass(frozen=True)
class Comparison:
    """Rows of the table, with the traces behind it.

    Parameters
    ----------
    rows : tuple of ComparisonRow
        One per model, the project's own last.
    judged_on : str
        ``unquantised`` positions of a simulated plant, or ``measured`` ones.
    measured_m, predicted_m : per judged capture, and per model and judged capture
        Mechanical error, static error and offset removed.
    identification : Identification
        The full model's.
    elsewhere_share : float
        Share of the judged captures' samples at places that no fitted run went to, left out.
    """

    rows: tuple[ComparisonRow, ...]
    judged_on: str
    measured_m: tuple[FloatArray, ...]
    predicted_m: dict[str, tuple[FloatArray, ...]]
    identification: Identification
    elsewhere_share: float = 0.0


def compare_models(
    captures: Sequence[Capture],
    validate: Sequence[Capture],
    bench: Bench,
    *,
    progress: Progress | None = None,
) -> Comparison:
    """Fit every rival and the full model to ``captures``, judge them on ``validate``.

    Parameters
    ----------
    captures, validate : sequences of Capture
        To fit and to judge; without ``validate`` every third capture is held back for judging.
    bench : Bench
        The bench.
    progress : callable or None
        ``progress(text, fraction)``.

    Raises
    ------
    ModelError
        Too few captures, or none with a table position.
    """
    tell = progress or untold
    fit, judge = parted(captures, validate)
    tell("full model", 0.0)
    found = identify_with_friction(fit, bench, progress=lambda text, part: tell(text, 0.6 * part))
    measured = tuple(_error_m(capture, found.static_map) for capture in judge)
    masks = tuple(_judged(capture, found.static_map) for capture in judge)
    predicted: dict[str, tuple[FloatArray, ...]] = {}
    rows = []
    for i, rival in enumerate(rivals()):
        if rival.needs_torque and any(c.torque_command_Nm is None for c in (*fit, *judge)):
            continue
        tell(rival.name, 0.6 + 0.4 * i / len(rivals()))
        fitted = fit_rival(rival, fit, bench, found.static_map)
        predicted[rival.name] = tuple(fitted.predict(c, found.static_map) for c in judge)
        rows.append(
            _row(rival.name, rival.source, len(rival.parameters), masks, measured, predicted)
        )
    predicted[FULL_NAME] = tuple(_full_prediction_m(c, found, bench) for c in judge)
    rows.append(_row(FULL_NAME, "this project", len(found.parameters), masks, measured, predicted))
    tell("compared", 1.0)
    used, given = (sum(int(np.sum(m)) for m in each) for each in (masks, [c.mask for c in judge]))
    share = 1.0 - used / max(given, 1)
    return Comparison(tuple(rows), _judged_on(judge), measured, predicted, found, share)


def parted(
    captures: Sequence[Capture], validate: Sequence[Capture]
) -> tuple[list[Capture], list[Capture]]:
    """Captures to fit and captures to judge; raises ModelError if one would have to do both."""
    if validate:
        return list(captures), list(validate)
    judge = list(captures[2::3]) or list(captures[1:2])
    fit = [capture for capture in captures if not any(capture is other for other in judge)]
    if not judge or not fit:
        raise ModelError(
            "One capture cannot both fit and judge the models.",
            code="PC-CMP-003",
            hint="Give at least two captures, or others with --validate.",
        )
    return fit, judge


def _judged(capture: Capture, static_map: StaticMap | None) -> BoolArray:
    """Samples that models are judged on: those at places that the fitted runs went to.

    Elsewhere nobody knows the static error, and it would count as an error of every model; a run
    that was nowhere else is judged whole.
    """
    if static_map is None or capture.table_position_m is None:
        return capture.mask
    covered: BoolArray = capture.mask & static_map.covers(capture.table_position_m)
    return covered if covered.any() else capture.mask


def _error_m(capture: Capture, static_map: StaticMap | None) -> FloatArray:
    """Mechanical error of a capture, on unquantised positions where a simulation has them."""
    if capture.table_position_m is None:
        raise ModelError(
            "A capture for judging has no table position.", code="PC-CMP-001", hint="Use others."
        )
    table, motor = capture.table_position_m, capture.motor_position_m
    if all(name in capture.extra for name in TRUE_POSITIONS):
        table, motor = capture.extra[TRUE_POSITIONS[0]], capture.extra[TRUE_POSITIONS[1]]
    error = table - motor
    return error if static_map is None else error - static_map.error_m(table)


def _full_prediction_m(capture: Capture, found: Identification, bench: Bench) -> FloatArray:
    record = prepare(capture, bench)
    columns = simulated_full(record, found.model)
    return np.asarray(columns[:, record.channels.index("difference")])


def _judged_on(judge: Sequence[Capture]) -> str:
    true = all(name in capture.extra for capture in judge for name in TRUE_POSITIONS)
    return "unquantised" if true else "measured"


def _row(
    name: str,
    source: str,
    n_parameters: int,
    masks: Sequence[BoolArray],
    measured: Sequence[FloatArray],
    predicted: dict[str, tuple[FloatArray, ...]],
) -> ComparisonRow:
    left = [_centred(m - p, ok) for m, p, ok in zip(measured, predicted[name], masks, strict=True)]
    whole = [_centred(m, ok) for m, ok in zip(measured, masks, strict=True)]
    return ComparisonRow(
        name=name,
        source=source,
        n_parameters=n_parameters,
        left_rms_um=rms_um(np.concatenate(left)),
        error_rms_um=rms_um(np.concatenate(whole)),
        left_per_capture_um=tuple(rms_um(part) for part in left),
    )


def _centred(values: FloatArray, valid: BoolArray) -> FloatArray:
    kept = values[valid]
    return np.asarray(kept - kept.mean())
