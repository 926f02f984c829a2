"""Does the loop ring by itself: a narrow band of the mechanical error that no command explains.

What lives here: how much of e and e_r lies around the strongest frequency, and what is said of it.
What may not: conversations. Ringing after steps of the acceleration is ``ringing``.

A loop with little damping at the first mode is kept ringing by the encoder's steps, cogging and
friction. A correction that goes by the command takes none of it away, and the model of friction
cannot be blamed for it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.units import UM_PER_M
from pmac_comp.workflow.accuracy.outcome import ErrorSignals, MotionOutcome

_LOWEST_Hz = 40.0  # below, motions and friction have their own part
_HIGHEST_FRAC = 0.4  # of the sampling rate
_HALF_BAND = 0.1  # of the frequency, to both sides
_SEGMENT = 2048  # samples: a hertz at the servo rate
_MOST_OF_IT = 0.5  # of the square of e_r beyond the sensors' steps
_NOTABLE = 0.1  # of e: below, it does not keep the error from a tenth


@dataclass(frozen=True)
class OwnRinging:
    """The strongest narrow band of e_r in the runs of a motion, and the same band of e.

    Parameters
    ----------
    frequency_Hz : float
        Where it is strongest.
    before_um, after_um : float
        Rms without and with compensation, um, what the noise beside it would make taken out.
    """

    frequency_Hz: float
    before_um: float
    after_um: float


def own_ringing(
    before: Sequence[ErrorSignals], after: Sequence[ErrorSignals], period_s: float
) -> OwnRinging:
    """Strongest narrow band of the mechanical error with compensation, and the same without."""
    size = min(_SEGMENT, *(run.mechanical_m.size for run in (*before, *after)))
    frequency, density = _density(after, period_s, size)
    use = (frequency > _LOWEST_Hz) & (frequency < _HIGHEST_FRAC / period_s)
    peak_Hz = float(frequency[use][int(np.argmax(density[use]))])
    half_Hz = _HALF_BAND * peak_Hz

    def rms_um(runs: Sequence[ErrorSignals]) -> float:
        noise_m2 = 2.0 * half_Hz * float(np.median(_density(runs, period_s, size)[1][use]))
        within_m2 = [_band_m2(run.mechanical_m, period_s, peak_Hz, half_Hz) for run in runs]
        return math.sqrt(max(0.0, float(np.mean(within_m2)) - noise_m2)) * UM_PER_M

    return OwnRinging(peak_Hz, rms_um(before), rms_um(after))


def _density(
    runs: Sequence[ErrorSignals], period_s: float, size: int
) -> tuple[FloatArray, FloatArray]:
    """Frequencies in Hz and mean power spectral density of the mechanical error in m^2/Hz."""
    from scipy.signal import welch

    found = [welch(run.mechanical_m, 1.0 / period_s, nperseg=size) for run in runs]
    return found[0][0], np.mean([density for _, density in found], axis=0)


def _band_m2(run: FloatArray, period_s: float, centre_Hz: float, half_Hz: float) -> float:
    """Mean square in m^2 of what a run has in a band (Parseval)."""
    spectrum = np.fft.rfft(run)
    frequency = np.fft.rfftfreq(run.size, period_s)
    inside = np.abs(frequency - centre_Hz) < half_Hz
    return 2.0 * float(np.sum(np.abs(spectrum[inside]) ** 2)) / run.size**2


def own_ringing_remarks(
    outcomes: Sequence[MotionOutcome],
    before: Sequence[Sequence[ErrorSignals]],
    after: Sequence[Sequence[ErrorSignals]],
    floor_um: float,
    period_s: float,
) -> tuple[str, ...]:
    """That most of e_r is the loop's own ringing, on motions where it is more than a tenth of e."""
    told: list[str] = []
    for outcome, first, second in zip(outcomes, before, after, strict=True):
        if not outcome.e_r_after.is_known:
            continue
        found = own_ringing(first, second, period_s)
        if found.after_um**2 < _MOST_OF_IT * outcome.e_r_beyond_um(floor_um) ** 2:
            continue
        if found.after_um > _NOTABLE * outcome.e_before.value:
            told.append(
                f"{outcome.name}: {found.after_um:.2f} um at {found.frequency_Hz:.0f} Hz "
                f"({found.before_um:.2f} um without compensation)"
            )
    if not told:
        return ()
    return (
        f"most of e_r is ringing of the loop itself on {len(told)} motion(s): {'; '.join(told)}. "
        "Compensation goes by the command and adds no damping: lower the gains, or damp that "
        "frequency (notch, Ixx36-39), state them in the bench file, capture and compute again",
    )
