"""Ringing after steps of the acceleration: how large it is before and after compensation.

What lives here: which part of a run rings, and its statistics. What may not: conversations.

A move without S-curve excites the first mode of the drive at every corner of its speed. What rings
is the part of the total error (table minus command) above half the resonance, in the windows after
the corners. A correction at servo rate neither damps nor excites that by intent; whether it does is
measured here.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import CaptureError
from pmac_comp.files.capture import Capture
from pmac_comp.workflow.accuracy.outcome import Spread

RINGING_NAME = "move with steps of the acceleration"
_WINDOW_s = 0.12  # after a corner: some fifteen periods of 130 Hz
_CORNER_FRAC = 0.5  # of the largest step of the acceleration
_LOWEST_Hz = 30.0


@dataclass(frozen=True)
class RingingOutcome:
    """Ringing of the table before and after.

    Parameters
    ----------
    frequency_Hz : float
        Where the ringing before compensation is strongest.
    before, after : Spread
        Rms in the windows after the corners with interval, and peak; um.
    lowest_Hz : float
        What is above counts as ringing.
    """

    frequency_Hz: float
    before: Spread
    after: Spread
    lowest_Hz: float = _LOWEST_Hz
    captures: tuple[Capture, ...] = field(default=(), repr=False)

    @property
    def says(self) -> str:
        """What the figures mean."""
        if self.after.upper95 < self.before.lower95:
            return "compensation lowers it"
        if self.after.lower95 > self.before.upper95:
            return "compensation raises it: use a motion with S-curve time"
        return "no difference beyond the intervals; S-curve time lowers it"

    def lines(self) -> list[str]:
        """Text for people."""
        b, a = self.before, self.after
        return [
            f"ringing at {self.frequency_Hz:.0f} Hz after steps of the acceleration, um rms "
            f"(95 %): {b.value:.3f} ({b.lower95:.3f} to {b.upper95:.3f}) > {a.value:.3f} "
            f"({a.lower95:.3f} to {a.upper95:.3f}), peak {b.peak:.2f} > {a.peak:.2f}; {self.says}"
        ]

    def as_result(self) -> dict[str, Any]:
        """Mapping for ``--json``."""
        return {
            "frequency_Hz": self.frequency_Hz,
            "before_um": asdict(self.before),
            "after_um": asdict(self.after),
            "says": self.says,
        }


def ringing_of(
    before: Sequence[Capture], after: Sequence[Capture], resonance_Hz: float | None
) -> RingingOutcome:
    """Ringing of runs without and with compensation; ``resonance_Hz`` of the bench file if known.

    Raises
    ------
    CaptureError
        No table position, or no corner of the speed in the runs.
    """
    lowest = max(_LOWEST_Hz, 0.5 * resonance_Hz if resonance_Hz else _LOWEST_Hz)
    first = [part for capture in before for part in ringing_windows(capture, lowest)]
    second = [part for capture in after for part in ringing_windows(capture, lowest)]
    if not first or not second:
        raise CaptureError(
            "The runs have no step of the acceleration.",
            code="PC-RNG-001",
            hint="Ringing is read from a trapezoid without s_curve_ms.",
        )
    period = before[0].sample_period_s
    return RingingOutcome(
        _strongest_Hz(first, period), Spread.of(first, period), Spread.of(second, period),
        lowest, (*before, *after),
    )  # fmt: skip


def ringing_signal(capture: Capture, lowest_Hz: float) -> FloatArray:
    """Total error above a frequency in m, shape (n,), without shift in time."""
    from scipy.signal import butter, sosfiltfilt

    if capture.table_position_m is None:
        raise CaptureError(
            "The capture has no table position.",
            code="PC-RNG-002",
            hint="Ringing at the table is seen by a scale only; state it in [scale].",
        )
    total = capture.table_position_m - capture.commanded_position_m
    sos = butter(4, lowest_Hz, btype="highpass", fs=1.0 / capture.sample_period_s, output="sos")
    return np.asarray(sosfiltfilt(sos, total - total[0]))


def ringing_windows(capture: Capture, lowest_Hz: float) -> list[FloatArray]:
    """Stretches of the ringing signal that follow a corner of the commanded speed."""
    signal = ringing_signal(capture, lowest_Hz)
    period = capture.sample_period_s
    length = round(_WINDOW_s / period)
    return [
        signal[start : start + length]
        for start in _corners(capture.commanded_position_m, length)
        if start + length <= signal.size
    ]


def _corners(command: FloatArray, length: int) -> list[int]:
    """Samples at which the commanded acceleration steps, at least a window apart."""
    acceleration = np.diff(command, 2)
    # A step over a few samples is one: PVT segments round a corner by their own length.
    wide = max(2, length // 8)
    step = np.abs(acceleration[wide:] - acceleration[:-wide])
    strong = np.flatnonzero(step > _CORNER_FRAC * float(np.max(step, initial=0.0)))
    found: list[int] = []
    for index in strong.tolist():
        if not found or index + wide - found[-1] > length:
            found.append(index + wide)
    return found


def _strongest_Hz(windows: Sequence[FloatArray], period_s: float) -> float:
    size = min(part.size for part in windows)
    shape = np.hanning(size)
    power = np.sum([np.abs(np.fft.rfft(part[:size] * shape, 8 * size)) ** 2 for part in windows],
                   axis=0)  # fmt: skip
    return float(np.fft.rfftfreq(8 * size, period_s)[int(np.argmax(power))])


def is_ringing(capture: Capture) -> bool:
    """Whether a capture is one of a move with steps of the acceleration."""
    return str(capture.attributes.get("motion", "")) == RINGING_NAME
