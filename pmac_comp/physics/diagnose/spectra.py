"""Orders per revolution and frequencies worth trying, from periodograms of the residual.

What lives here: least-squares periodograms over screw angle and over time. No decisions. May
import ``records`` only.

Below the loop's bandwidth the torque residual mirrors a disturbance torque, and table minus motor
shows an error of lead or encoder, whatever the loop does.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.physics.diagnose.clocks import SLOW, WAVES
from pmac_comp.physics.diagnose.records import DATED, Record
from pmac_comp.physics.model import slots
from pmac_comp.physics.model.drive import DriveModel, Response

_BLOCK_s = 0.01
_FASTEST_Hz = 14.0
_ORDERS = np.arange(0.4, 64.0, 0.05)
_GRID_Hz = 0.02
_FREQUENCIES_Hz = np.arange(0.4, 45.0, _GRID_Hz)
_PEAKS = 2


@dataclass(frozen=True)
class Peaks:
    """Orders and frequencies worth trying, by the kind of trace they leave.

    Parameters
    ----------
    torque, friction, ripple, reading : tuple of float
        Orders per revolution in the torque residual as it is, with the sign of the motion, in
        proportion to the torque, and in table minus motor.
    frequencies_Hz : tuple of float
        Frequencies in the torque residual.
    largest_torque_Nm : float
        Largest torque that the model asks for: a limit above it leaves no trace.
    in_phase : Mapping of float to (Mapping of int to float)
        Per frequency, times in s at which the runs began if one wave goes through all of them.
    in_sequence : tuple of (Mapping of int to float)
        The same by the files' dates, and if the runs follow each other without a pause, where their
        clocks say that each began anew; if their clocks go on, as if each had begun anew.
    """

    torque: tuple[float, ...] = ()
    friction: tuple[float, ...] = ()
    ripple: tuple[float, ...] = ()
    reading: tuple[float, ...] = ()
    frequencies_Hz: tuple[float, ...] = ()
    largest_torque_Nm: float = 0.0
    in_phase: Mapping[float, Mapping[int, float]] = field(default_factory=dict)
    in_sequence: tuple[Mapping[int, float], ...] = ()

    def clocks_for(
        self, effect: str, values: Mapping[str, float]
    ) -> tuple[Mapping[int, float], ...]:
        """When runs may have begun for an effect: at their own time, or as the data says."""
        if effect in WAVES:
            return (self.in_phase.get(values["frequency_Hz"], {}),)
        return ({}, *self.in_sequence) if effect in SLOW else ({},)


def peaks_of(records: Sequence[Record], responses: Sequence[Response], model: DriveModel) -> Peaks:
    """Orders per revolution and frequencies at which the residuals peak.

    Parameters
    ----------
    records : sequence of Record
        Measured.
    responses : sequence of Response
        Simulated on the same grids.
    model : DriveModel
        Gives the control law, which is the torque of captures that hold none, and the lead.

    Returns
    -------
    Peaks
    """
    pairs = list(zip(records, responses, strict=True))
    lead_m_per_rev, law = model.bench.pitch_m, model.kernel_vector()
    torque = [_torque_residual(r, p, law) for r, p in pairs]
    stretch = [_mechanical_residual(r, p) for r, p in pairs]

    def orders(residuals: Sequence[FloatArray | None], kind: str) -> tuple[float, ...]:
        series = [
            _angle_series(r, p, d, kind, lead_m_per_rev)
            for (r, p), d in zip(pairs, residuals, strict=True)
            if d is not None
        ]
        if not series:
            return ()
        found = _peaks(_ORDERS, _order_power(series), width=0.3)
        return tuple(dict.fromkeys(_rounded(order) for order in found))

    frequencies = frequency_peaks(records, torque)
    return Peaks(
        orders(torque, "one"),
        orders(torque, "direction"),
        orders(torque, "load"),
        orders(stretch, "one"),
        tuple(frequencies),
        max(float(np.max(np.abs(p.torque_command_Nm))) for p in responses),
        {f: _in_phase(records, torque, f) for f in frequencies},
        _in_sequence(records),
    )


def _in_phase(
    records: Sequence[Record], torque_Nm: Sequence[FloatArray], frequency_Hz: float
) -> dict[int, float]:
    """When runs began for a wave that goes on between them: a pump knows of no capture."""
    turn = 2.0 * np.pi * frequency_Hz
    phases = []
    for record, residual in zip(records, torque_Nm, strict=True):
        time, values = _blocks(record, residual)
        wave = np.exp(-1j * turn * (time - record.begun_s))
        phases.append(float(np.angle(wave @ (values - values.mean()))))
    first = records[0].begun_s
    return {
        r.number: first + math.remainder(p - phases[0], 2.0 * np.pi) / turn
        for r, p in zip(records, phases, strict=True)
    }


def _in_sequence(records: Sequence[Record]) -> tuple[Mapping[int, float], ...]:
    """Other readings of the runs' clocks: going on where they restart, and the reverse."""
    if len(records) < 2:
        return ()
    if np.ptp([r.begun_s for r in records]) > 0.0:
        return ({r.number: 0.0 for r in records},)
    following = {r.number: r.following_s for r in records}
    return (DATED,) if records[0].dated_s is not None else (following,)


def frequency_peaks(records: Sequence[Record], torque_Nm: Sequence[FloatArray]) -> list[float]:
    """Frequencies in Hz at which the torque residual, shape (n,) per record, peaks.

    Phases are counted from time zero.
    """
    power = np.zeros(_FREQUENCIES_Hz.size)
    for record, residual in zip(records, torque_Nm, strict=True):
        time, values = _blocks(record, residual)
        centred = values - values.mean()
        # Zeros behind the record put the grid's frequencies on the transform's.
        block_s = float(time[1] - time[0])
        length = max(centred.size, round(1.0 / (_GRID_Hz * block_s)))
        spectrum = np.abs(np.fft.rfft(centred, length)) ** 2
        grid = np.fft.rfftfreq(length, block_s)
        power += np.interp(_FREQUENCIES_Hz, grid, spectrum) / max(1, centred.size)
    return _peaks(_FREQUENCIES_Hz, power, width=0.4)


def _torque_residual(record: Record, response: Response, law: FloatArray) -> FloatArray:
    """Measured less simulated torque command, or what the law makes of the motor's residual."""
    if record.torque_Nm is not None:
        return _about_zero(record, record.torque_Nm - response.torque_command_Nm)
    ahead = _about_zero(record, record.measured_m[:, 0] - response.motor_position_m)
    rate = np.gradient(ahead, record.period_s)
    if law[slots.LAW] > 0.5:
        return np.asarray(-law[slots.CASCADE_GAIN] * (law[slots.CASCADE_KP] * ahead + rate))
    held = np.cumsum(ahead - ahead.mean()) * record.period_s
    return np.asarray(-(law[slots.KP] * ahead + law[slots.KI] * held + law[slots.KD] * rate))


def _mechanical_residual(record: Record, response: Response) -> FloatArray | None:
    if record.channels == 1:
        return None
    measured = record.measured_m[:, 1] - record.measured_m[:, 0]
    return _about_zero(record, measured - response.mechanical_error_m)


def _about_zero(record: Record, residual: FloatArray) -> FloatArray:
    """A residual about its median, zero where it is no evidence.

    A scale's zero is tens of micrometres from the encoder's and a bias shifts all torques: zeros
    beside such an offset are a step, and a step has power at every order.
    """
    if not record.valid.any():
        return np.zeros(residual.size)
    return np.where(record.valid, residual - np.median(residual[record.valid]), 0.0)


def _blocks(record: Record, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Time and means over short blocks."""
    size = max(1, round(_BLOCK_s / record.period_s))
    count = values.size // size
    time = record.capture.time_s[0] + record.period_s * size * (np.arange(count) + 0.5)
    return time, np.asarray(values[: count * size].reshape(count, size).mean(axis=1))


def _angle_series(
    record: Record, response: Response, residual: FloatArray, kind: str, lead_m_per_rev: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Angle in rev, residual and speed in rev/s of blocks; friction changes sign with direction."""
    _, turns = _blocks(record, response.motor_position_m / lead_m_per_rev)
    _, values = _blocks(record, residual)
    speed = np.gradient(turns, max(1, round(_BLOCK_s / record.period_s)) * record.period_s)
    values = values - values.mean()
    if kind != "one":
        _, load = _blocks(record, response.torque_command_Nm)
        values = values * (np.sign(speed) if kind == "direction" else load / load.std())
        values = values - values.mean()
    return turns, values, np.abs(speed)


def _order_power(series: Sequence[tuple[FloatArray, FloatArray, FloatArray]]) -> FloatArray:
    """Power explained by a wave of every order, over samples slow enough to show it."""
    turns, values, speed = (np.concatenate(parts) for parts in zip(*series, strict=True))
    power = np.zeros(_ORDERS.size)
    for i, order in enumerate(_ORDERS):
        slow = (speed * order < _FASTEST_Hz) & (speed > 0.02)
        count = int(np.count_nonzero(slow))
        if count > 50:
            wave = np.exp(-2j * np.pi * order * turns[slow])
            power[i] = abs(wave @ values[slow]) ** 2 / count
    return power


def _peaks(grid: FloatArray, power: FloatArray, *, width: float) -> list[float]:
    """Strongest peaks that are apart by more than ``width``."""
    left = power.copy()
    found = []
    for _ in range(_PEAKS):
        top = int(np.argmax(left))
        if left[top] <= 0.0:
            break
        found.append(float(grid[top]))
        left[np.abs(grid - grid[top]) < width] = 0.0
    return found


def _rounded(order: float) -> float:
    """Orders of machines are whole or nearly so; a grid point next to a whole number is it."""
    nearest = round(order)
    return float(nearest) if nearest > 0 and abs(order - nearest) < 0.08 else round(order, 2)
