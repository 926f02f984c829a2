"""The best wrong model: smooth functions of machine coordinates that have no name.

What lives here: probes (bases of position, speed, angle, distance since reversal, acceleration and
time, acting as torque, as table force or as a reading) and their simulated columns. A named effect
is believed only if it does about as well as these; what they explain beyond all named effects is
what "unknown" means. May import ``records`` and ``localise``.
"""

from collections.abc import Sequence
from concurrent.futures import Executor

import numpy as np
from numpy.typing import NDArray

from pmac_comp.base.arrays import FloatArray
from pmac_comp.physics.diagnose.localise import distance_since_reversal_m
from pmac_comp.physics.diagnose.records import Record
from pmac_comp.physics.model.drive import DriveModel

_KNOTS = 6
_LENGTHS_m = (20e-6, 200e-6, 2e-3)
_TORQUE_SHARE = 0.02
_STILL_m_per_s = 2e-4


def bases(
    record: Record, position_m: FloatArray, spans: dict[str, tuple[float, float]], lead_m: float
) -> FloatArray:
    """Functions of the machine coordinates on the servo grid, shape (n, k).

    Parameters
    ----------
    record : Record
        Gives the sample period.
    position_m : ndarray, shape (n,)
        Smooth motor position.
    spans : dict
        Range of position, speed, acceleration and time over all records, so that the functions
        are the same in each.
    lead_m : float
        Travel per revolution.

    Returns
    -------
    ndarray, shape (n, k)
        Values of size 1.
    """
    ts = record.period_s
    velocity = np.gradient(position_m, ts)
    window = max(3, round(5e-3 / ts))
    acceleration = np.convolve(np.gradient(velocity, ts), np.ones(window) / window, "same")
    direction = np.clip(velocity / _STILL_m_per_s, -1.0, 1.0)
    since = np.abs(distance_since_reversal_m(position_m))
    angle = 2 * np.pi * position_m / lead_m
    time = record.capture.time_s[0] + ts * np.arange(position_m.size)
    parts = [
        _hats(position_m, spans["position"]),
        _hats(position_m, spans["position"])[:, ::2] * direction[:, None],
        _hats(velocity, spans["speed"]),
        _hats(acceleration, spans["acceleration"])[:, 1:],
        np.column_stack([np.cos(angle), np.sin(angle), np.cos(2 * angle), np.sin(2 * angle)]),
        np.column_stack([np.cos(angle), np.sin(angle)]) * direction[:, None],
        np.column_stack([np.exp(-since / length) for length in _LENGTHS_m]) * direction[:, None],
        _hats(time, spans["time"])[:, 1::2],
        _hats(time, spans["time"])[:, 1::2] * direction[:, None],
    ]
    return np.hstack(parts)


def _hats(values: FloatArray, span: tuple[float, float]) -> FloatArray:
    """Piecewise linear functions that sum to one."""
    knots = np.linspace(span[0], span[1] + 1e-12, _KNOTS)
    place = (np.clip(values, knots[0], knots[-1]) - knots[0]) / (knots[1] - knots[0])
    return np.asarray(np.maximum(0.0, 1.0 - np.abs(place[:, None] - np.arange(_KNOTS)[None, :])))


def spans_of(
    records: Sequence[Record], positions_m: Sequence[FloatArray]
) -> dict[str, tuple[float, float]]:
    """Range of every coordinate over all records; ``positions_m`` of shape (n,) per record."""
    ranges: dict[str, list[FloatArray]] = {
        k: [] for k in ("position", "speed", "acceleration", "time")
    }
    for record, x in zip(records, positions_m, strict=True):
        v = np.gradient(x, record.period_s)
        ranges["position"].append(x)
        ranges["speed"].append(v)
        ranges["acceleration"].append(np.quantile(np.gradient(v, record.period_s), [0.01, 0.99]))
        ends = record.capture.time_s[0] + np.array([0.0, record.period_s * x.size])
        ranges["time"].append(ends)
    return {
        key: (float(min(p.min() for p in parts)), float(max(p.max() for p in parts)))
        for key, parts in ranges.items()
    }


def flexible_columns(
    records: Sequence[Record], model: DriveModel, lead_m: float, executor: Executor, *, room: int
) -> list[NDArray[np.float32]]:
    """Columns of all probes per record, shape (m, channels, room + k).

    Parameters
    ----------
    records : sequence of Record
        Fitting and judging.
    model : DriveModel
        Working point.
    lead_m : float
        Travel per revolution.
    executor : Executor
        Runs the torque probes.
    room : int
        Columns left free in front of the probes for others; they hold nothing yet.

    Returns
    -------
    list of ndarray
        Behind the room, readings first, then torques.
    """
    substeps = max(2, model.substeps // 2)  # both ends of a difference alike
    responses = list(executor.map(lambda r: r.response(model, substeps=substeps), records))
    base = [r.coarsen(r.channels_of(p)) for r, p in zip(records, responses, strict=True)]
    positions = [np.asarray(r.motor_position_m) for r in responses]
    spans = spans_of(records, positions)
    size_Nm = _TORQUE_SHARE * max(float(np.abs(r.torque_command_Nm).max()) for r in responses)
    del responses

    def probed(i: int) -> NDArray[np.float32]:
        record = records[i]
        table = bases(record, positions[i], spans, lead_m)
        count = table.shape[1]
        out = np.empty((*base[i].shape, room + 2 * count), dtype=np.float32)
        out[:, :, room : room + count] = _readings(record, table)

        def write(j: int) -> None:
            torque = size_Nm * np.ascontiguousarray(table[:, j])
            moved = record.response(model, probe_torque_Nm=torque, substeps=substeps)
            difference = record.coarsen(record.channels_of(moved)) - base[i]
            out[:, :, room + count + j] = difference / size_Nm

        for _ in executor.map(write, range(count)):
            pass  # raises what a simulation raised
        return out

    return [probed(i) for i in range(len(records))]


def _readings(record: Record, functions: FloatArray) -> FloatArray:
    """Probes that add to the last channel's reading: table, or motor where there is no table."""
    coarse = record.coarsen(functions)
    out = np.zeros((coarse.shape[0], record.channels, coarse.shape[1]))
    if record.channels > 1:
        out[:, -1, :] = 1e-6 * coarse
    return out
