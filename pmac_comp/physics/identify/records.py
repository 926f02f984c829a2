"""Captures made ready for comparison with the simulated closed loop.

What lives here: which channels are compared, which samples count, the linear nuisances (scale
offset per capture, static lead map), and the simulation of one capture. What may not: fitting.
Imports ``physics.model``, ``files`` and ``base``.

Comparison is made below about 150 Hz: above it encoder rounding and the stick zone speak.
The channels are torque and table minus motor: a disturbance that the model does not know moves
motor and table together by tens of um and leaves their difference alone, while motor position and
torque are one signal seen through the control law. Without torque or without a scale, the motor
position is used.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import numpy as np
from scipy.signal import firwin, resample_poly

from pmac_comp.base.arrays import BoolArray, FloatArray
from pmac_comp.base.errors import CaptureError
from pmac_comp.base.units import US_PER_S
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import EXTERNAL_FORCE, TORQUE_FEEDFORWARD, Capture
from pmac_comp.physics.identify.derivatives import bridged, usable_rows
from pmac_comp.physics.identify.result import StaticMap
from pmac_comp.physics.model.drive import DriveModel, Response, simulate
from pmac_comp.physics.model.resting import first_under_way, start_of
from pmac_comp.physics.model.start import RELAXED, Start
from pmac_comp.physics.signals.grid import onto_servo_grid

LeaveOut = Literal["nothing", "rest", "reversals"]
_KNOT_SPACING_m = 0.05
_MAX_KNOTS = 12
_HARMONICS = (1.0, 2.0)
_SKEW_STD_s = 0.05e-6
_RATE_Hz = 320.0  # of the compared rows
_HALF_TAPS = 4  # half length of the low pass in thinned rows
_REST_m_per_s = 2e-4
_STILL_m = 1e-6
_STANDS_m = 1e-9  # what a standing command moves by, round-off of the file included
_RING_s = 0.1  # a stop rings out and friction relaxes within this
# The 28 Hz loop needs about 12 ms to rise and twice that to settle after the friction step.
_AFTER_s, _BEFORE_s = 0.045, 0.010


@dataclass(frozen=True)
class Record:
    """One capture prepared.

    Parameters
    ----------
    capture : Capture
        The capture, n samples.
    channels : tuple of str
        Names of the c channels.
    full : ndarray, shape (n, c)
        Measured channels.
    measured, valid : ndarray, shapes (m, c) and (m,)
        Channels as compared (low-passed and thinned by ``factor``), and which rows count.
    stride : int
        Servo periods per sample of the capture.
    commanded_m, desired_m, feedforward_Nm, force_N : ndarray
        Inputs at the servo rate.
    start : Start
        What integrator and friction hold when the run begins.
    """

    capture: Capture
    channels: tuple[str, ...]
    full: FloatArray
    measured: FloatArray
    valid: BoolArray
    factor: int
    stride: int
    commanded_m: FloatArray
    desired_m: FloatArray | None
    feedforward_Nm: FloatArray | None
    force_N: FloatArray | None
    start: Start = RELAXED

    @property
    def period_s(self) -> float:
        """Period of the compared rows."""
        return self.factor * self.capture.sample_period_s


def prepare(
    capture: Capture,
    bench: Bench,
    *,
    leave_out: Literal["nothing", "rest", "reversals"] = "nothing",
) -> Record:
    """Record of a capture, ready for comparison.

    Parameters
    ----------
    capture : Capture
        One run.
    bench : Bench
        Its bench.
    leave_out : "nothing", "rest" or "reversals"
        Rows that do not count. ``rest``: longer standstill, where the integrator hunts between two
        counts of the encoder in a way that no model can foresee. ``reversals``: any standstill and
        the first moments after each reversal as well; what friction does there in detail
        (presliding, Stribeck) is not in a Coulomb model and would bend its parameters.

    Raises
    ------
    CaptureError
        The sample period is not a multiple of the servo period.
    """
    stride = _stride(capture, bench)
    factor = max(round(1.0 / (_RATE_Hz * capture.sample_period_s)), 1)
    mask = capture.mask
    named = _channels(capture)
    extra = capture.extra

    def fine(values: FloatArray | None) -> FloatArray | None:
        return None if values is None else onto_servo_grid(bridged(values, mask), stride)

    start = _start(capture, bench)
    full = np.column_stack([bridged(column, mask) for column in named.values()])
    return Record(
        capture=capture,
        channels=tuple(named),
        full=full,
        measured=thinned(full, factor),
        valid=_rows_that_count(capture, bench, factor, leave_out, start),
        factor=factor,
        stride=stride,
        commanded_m=onto_servo_grid(bridged(capture.commanded_position_m, mask), stride),
        desired_m=fine(capture.desired_position_m),
        feedforward_Nm=fine(extra.get(TORQUE_FEEDFORWARD)),
        force_N=fine(extra.get(EXTERNAL_FORCE)),
        start=start,
    )


def _start(capture: Capture, bench: Bench) -> Start:
    if capture.torque_command_Nm is None or EXTERNAL_FORCE in capture.extra:
        return RELAXED
    columns = (capture.desired_m, capture.motor_position_m, capture.torque_command_Nm)
    desired_m, motor_m, torque_Nm = (bridged(c, capture.mask) for c in columns)
    added = capture.extra.get(TORQUE_FEEDFORWARD)
    added_Nm = None if added is None else bridged(added, capture.mask)
    return start_of(
        bench, desired_m, motor_m, torque_Nm, capture.sample_period_s, added_Nm=added_Nm
    )


def response_of(
    record: Record,
    model: DriveModel,
    *,
    shift_m: float = 0.0,
    quantise: bool = False,
    substeps: int | None = None,
) -> Response:
    """Simulated closed loop under the inputs of a record, at the servo rate.

    ``shift_m`` moves the motion on the lattice of the sensors; ``quantise`` rounds in the loop.
    """
    desired = record.desired_m
    return simulate(
        model,
        record.commanded_m + shift_m,
        desired_position_m=None if desired is None else desired + shift_m,
        torque_feedforward_Nm=record.feedforward_Nm,
        external_force_N=record.force_N,
        time_origin_s=float(record.capture.time_s[0]),
        quantise=quantise,
        substeps=substeps,
        start=record.start,
    )


def simulated(
    record: Record,
    model: DriveModel,
    *,
    shift_m: float = 0.0,
    quantise: bool = False,
    substeps: int | None = None,
) -> FloatArray:
    """Simulated channels of a record as compared, shape (m, c)."""
    full = simulated_full(record, model, shift_m=shift_m, quantise=quantise, substeps=substeps)
    return thinned(full, record.factor)


def simulated_full(
    record: Record,
    model: DriveModel,
    *,
    shift_m: float = 0.0,
    quantise: bool = False,
    substeps: int | None = None,
) -> FloatArray:
    """Simulated channels at the samples of the capture, shape (n, c)."""
    response = response_of(record, model, shift_m=shift_m, quantise=quantise, substeps=substeps)
    columns = [_channel(name, response)[:: record.stride] for name in record.channels]
    stack = np.column_stack(columns)[: record.capture.n]
    if shift_m and "motor" in record.channels:
        stack[:, record.channels.index("motor")] -= shift_m
    return stack


def thinned(columns: FloatArray, factor: int) -> FloatArray:
    """Columns low-passed without delay and thinned by a factor, shape (ceil(n / factor), c)."""
    if factor == 1:
        return columns
    taps = _low_pass(factor)
    resample: Any = resample_poly  # its stubs know windows by name only
    return np.asarray(resample(columns, 1, factor, axis=0, window=taps, padtype="line"))


@cache
def _low_pass(factor: int) -> FloatArray:
    return np.asarray(firwin(2 * _HALF_TAPS * factor + 1, 1.0 / factor), dtype=np.float64)


def nuisances(
    records: Sequence[Record], bench: Bench, *, static_map: bool
) -> tuple[list[FloatArray], StaticMap | None]:
    """Regressors of the table channel without drive parameters, full rate, shape (n, q) each.

    The first columns are the scale offsets of the captures, then the channel skew
    (see ``nuisance_prior``); then, with ``static_map``, the lead error as hat functions of the
    table position (the first knot is fixed by the offsets) and screw harmonics. The returned map
    holds the knots and zero values.
    """
    n_records = len(records)
    shape = _map_shape(records, bench) if static_map else None
    columns = []
    for i, record in enumerate(records):
        offset = np.zeros((record.capture.n, n_records))
        if "difference" in record.channels:
            offset[:, i] = 1.0
        parts = [offset, _speed_column(record)]
        if shape is not None:
            parts.append(_map_columns(record, shape))
        columns.append(np.concatenate(parts, axis=1))
    return columns, shape


def n_leading(n_records: int) -> int:
    """Nuisance columns before those of the static map."""
    return n_records + 1


def nuisance_prior(n_records: int, n_columns: int) -> FloatArray:
    """Prior information of the nuisances, 1/SI^2, shape (q,): zero where nothing is known.

    Encoder and scale are latched together only to some 0.05 us: a skew this small is not told from
    viscous friction, so the intervals of viscous friction must allow for it.
    """
    prior = np.zeros(n_columns)
    prior[n_records] = _SKEW_STD_s**-2
    return prior


def map_from(shape: StaticMap, coefficients: FloatArray) -> StaticMap:
    """Static map of the coefficients of ``nuisances`` without the offsets, shape (q,)."""
    k = shape.knots_m.size - 1
    h = shape.orders_per_rev.size
    values = np.concatenate(([0.0], coefficients[:k]))
    return StaticMap(
        shape.knots_m,
        values,
        shape.orders_per_rev,
        coefficients[k : k + h],
        coefficients[k + h : k + 2 * h],
        shape.pitch_m,
    )


def _speed_column(record: Record) -> FloatArray:
    """Speed in m/s, the regressor of a channel skew, shape (n, 1)."""
    capture = record.capture
    if "difference" not in record.channels:
        return np.zeros((capture.n, 1))
    speed = np.gradient(bridged(capture.commanded_position_m, capture.mask))
    return np.asarray(speed / capture.sample_period_s)[:, np.newaxis]


def _stride(capture: Capture, bench: Bench) -> int:
    ratio = capture.sample_period_s / bench.servo_period_s
    stride = max(round(ratio), 1)
    # 0.2 % of drift would be 20 ms after 10 s: a capture of another controller.
    if abs(ratio - stride) > 2e-3 * stride:
        raise CaptureError(
            f"The capture's sample period {capture.sample_period_s * US_PER_S:.3f} us is not a "
            f"multiple of the bench's servo period {bench.servo_period_s * US_PER_S:.3f} us.",
            code="PC-IDN-010",
            hint="Use the bench file of the controller that made the capture (servo_period_us, "
            "or I10 for kind = 'pmac').",
        )
    return stride


def _rows_that_count(
    capture: Capture, bench: Bench, factor: int, leave_out: LeaveOut, start: Start
) -> BoolArray:
    clean = _clean(capture, factor)
    if EXTERNAL_FORCE in capture.extra:
        return clean[::factor]
    if leave_out == "reversals":
        clean = clean & _steady_direction(capture)
    elif leave_out == "rest":
        clean = clean & _moving_lately(capture)
    if leave_out == "rest" or start.speed_m_per_s != 0.0:
        desired_m = bridged(capture.desired_m, capture.mask)
        first = first_under_way(bench, desired_m, start, capture.sample_period_s)
        clean = clean & (np.arange(clean.size) >= first)
    return clean[::factor]


def _clean(capture: Capture, factor: int) -> BoolArray:
    return usable_rows(capture.mask, _HALF_TAPS * factor) if factor > 1 else capture.mask


def steady_rows(record: Record) -> BoolArray:
    """Compared rows away from rest and from the moments after a reversal, shape (m,)."""
    if EXTERNAL_FORCE in record.capture.extra:
        return record.valid
    return record.valid & _steady_direction(record.capture)[:: record.factor]


def clean_rows(record: Record) -> BoolArray:
    """Compared rows that no lost or clipped sample reaches, shape (m,)."""
    return _clean(record.capture, record.factor)[:: record.factor]


def moving_rows(record: Record) -> BoolArray:
    """Compared rows whose command moves or moved within the last moments, shape (m,)."""
    return _moving_lately(record.capture)[:: record.factor]


def _moving_lately(capture: Capture) -> BoolArray:
    """Samples whose command moved within the last moments, shape (n,)."""
    steps = np.abs(np.diff(bridged(capture.commanded_position_m, capture.mask), prepend=np.nan))
    moves = np.concatenate(([0], np.cumsum(np.nan_to_num(steps) > _STANDS_m)))
    index = np.arange(capture.n)
    low = np.maximum(index - round(_RING_s / capture.sample_period_s), 0)
    return np.asarray(moves[index + 1] > moves[low])


def _steady_direction(capture: Capture) -> BoolArray:
    """Samples that are not at rest and not within the moments around a reversal, shape (n,)."""
    period = capture.sample_period_s
    speed = np.gradient(bridged(capture.commanded_position_m, capture.mask), period)
    direction = np.where(np.abs(speed) < _REST_m_per_s, 0, np.sign(speed))
    changed = np.concatenate(([True], direction[1:] != direction[:-1])) | (direction == 0)
    count = np.concatenate(([0], np.cumsum(changed)))
    index = np.arange(direction.size)
    low = np.maximum(index - round(_AFTER_s / period), 0)
    high = np.minimum(index + round(_BEFORE_s / period) + 1, direction.size)
    return np.asarray(count[high] == count[low])


def _channels(capture: Capture) -> dict[str, FloatArray]:
    named: dict[str, FloatArray] = {}
    if _is_load_step(capture) and capture.table_position_m is not None:
        # A stuck motor holds any torque: at standstill only the table answers to the load.
        return {"difference": capture.table_position_m - capture.motor_position_m}
    if capture.torque_command_Nm is not None and capture.table_position_m is not None:
        named["torque"] = capture.torque_command_Nm
    else:
        named["motor"] = capture.motor_position_m
    if capture.table_position_m is not None:
        named["difference"] = capture.table_position_m - capture.motor_position_m
    return named


def _is_load_step(capture: Capture) -> bool:
    still = float(np.ptp(bridged(capture.commanded_position_m, capture.mask))) < _STILL_m
    return still and EXTERNAL_FORCE in capture.extra


def _channel(name: str, response: Response) -> FloatArray:
    if name == "torque":
        return response.torque_command_Nm
    if name == "motor":
        return response.motor_position_m
    return response.table_position_m - response.motor_position_m


def _map_shape(records: Sequence[Record], bench: Bench) -> StaticMap | None:
    tables = [_table_m(record) for record in records if "difference" in record.channels]
    if not tables:
        return None
    low = min(float(table.min()) for table in tables)
    high = max(float(table.max()) for table in tables)
    n_knots = int(np.clip(np.ceil((high - low) / _KNOT_SPACING_m) + 1, 2, _MAX_KNOTS))
    orders = np.array(_HARMONICS) if high - low > 2.0 * bench.pitch_m else np.empty(0)
    zero = np.zeros(orders.size)
    knots = np.linspace(low, max(high, low + 1e-6), n_knots)
    return StaticMap(knots, np.zeros(n_knots), orders, zero, zero, bench.pitch_m)


def _table_m(record: Record) -> FloatArray:
    table = record.capture.table_position_m
    if table is None:
        return bridged(record.capture.motor_position_m, record.capture.mask)
    return bridged(table, record.capture.mask)


def _map_columns(record: Record, shape: StaticMap) -> FloatArray:
    k, h = shape.knots_m.size, shape.orders_per_rev.size
    if "difference" not in record.channels:
        return np.zeros((record.capture.n, k - 1 + 2 * h))
    table = _table_m(record)
    hats = [np.interp(table, shape.knots_m, row) for row in np.eye(k)[1:]]
    phase = 2.0 * np.pi / shape.pitch_m * np.multiply.outer(table, shape.orders_per_rev)
    return np.column_stack([*hats, np.cos(phase), np.sin(phase)])
