"""Lead-error map from slow bidirectional runs, with the dynamic part removed first.

What lives here: the binned map of both directions, its mean (lead table) and its difference (the
direction-dependent remainder), and ISO 230-2 style figures of the map. What may not: counts.

The lead error is taken from the mean of both directions, so that the elastic lost motion of the
friction is not swallowed by the table. The dynamic law, evaluated on the
motion, is subtracted before, because even a slow run carries its Coulomb term.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pmac_comp.base.arrays import BoolArray, FloatArray
from pmac_comp.base.errors import NotIdentifiable
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.evaluation import evaluate_law
from pmac_comp.physics.compensate.law import CompensationLaw

_REVERSAL_CLEARANCE_m = 0.2e-3  # samples closer than this to a reversal carry the friction step
_LEAST_SPEED_m_per_s = 1e-3
_HIGHEST_ORDER = 3.5  # per turn that is taken for the screw's: beyond, it is noise and rounding
_MOST_PASSED = 0.7  # of what the knots resolve, where they are few to the turn
_KERNEL_TURNS = 3
_FEWEST = 8  # knots of a map that can be smoothed
_WOBBLE_m = 0.25e-6  # beyond that order: what is smaller may be cogging's at the run's speed
_STANDS_OUT = 6.0  # times its neighbours
_COVERED = 0.9  # share of the knots that both directions must have seen


@dataclass(frozen=True)
class LeadWave:
    """Wobble of the lead: ``amplitude cos(order angle + phase)`` over the turn of the screw."""

    amplitude_m: float
    order: int
    phase_rad: float
    turn_m: float

    def at(self, position_m: FloatArray) -> FloatArray:
        """Lead error in m at positions in m; of the shape of ``position_m``."""
        angle = 2.0 * math.pi * self.order * position_m / self.turn_m
        return np.asarray(self.amplitude_m * np.cos(angle + self.phase_rad))


@dataclass(frozen=True)
class LeadMap:
    """Static error of the table against the motor.

    Parameters
    ----------
    position_m : ndarray, shape (n,)
        Equidistant commanded positions.
    error_m : ndarray, shape (n,)
        Mean of both directions, zero where the map crosses position zero (or at its middle).
    reversal_m : ndarray, shape (n,)
        Forward minus backward after the dynamic part was removed, its mean over a turn.
    noise_m : float
        Standard deviation of a knot from the scatter of the samples in it.
    """

    position_m: FloatArray
    error_m: FloatArray
    reversal_m: FloatArray
    noise_m: float

    @property
    def spacing_m(self) -> float:
        """Distance between knots in m."""
        return float((self.position_m[-1] - self.position_m[0]) / (self.position_m.size - 1))

    def at(self, position_m: FloatArray) -> FloatArray:
        """Lead error in m at positions in m; of the shape of ``position_m``.

        It is linear between knots and held beyond the ends.
        """
        return np.asarray(np.interp(position_m, self.position_m, self.error_m))

    def wave(self, turn_m: float) -> LeadWave | None:
        """The wobble that shakes a table the most: its acceleration goes by the order's square.

        None where all that the knots resolve are small.
        """
        if np.ptp(self.position_m) < _KERNEL_TURNS * turn_m:
            return None
        orders = range(1, math.ceil(0.5 * turn_m / self.spacing_m))
        _, found = _fitted(self.error_m, 2.0 * np.pi * self.position_m / turn_m, orders)
        waves = found[2 : 2 + len(orders)] - 1j * found[2 + len(orders) :]
        best = int(np.argmax(np.abs(waves) * np.square(orders)))
        if abs(waves[best]) < _WOBBLE_m:
            return None
        return LeadWave(float(abs(waves[best])), orders[best], float(np.angle(waves[best])), turn_m)

    def summary(self) -> dict[str, float]:
        """Figures for people: peak to peak and slope of the lead, mean reversal error, um."""
        slope = np.polyfit(self.position_m, self.error_m, 1)[0]
        return {
            "lead_peak_to_peak_um": float(np.ptp(self.error_m) * UM_PER_M),
            "lead_slope_um_per_m": float(slope * UM_PER_M),
            "mean_reversal_um": float(np.mean(self.reversal_m) * UM_PER_M),
            "knot_noise_um": self.noise_m * UM_PER_M,
        }


def lead_map(
    captures: Sequence[Capture],
    law: CompensationLaw | None,
    *,
    spacing_m: float = 0.5e-3,
    turn_m: float = 10e-3,
    per_turn_m: Sequence[FloatArray] = (),
) -> LeadMap:
    """Lead-error map of slow bidirectional runs.

    Parameters
    ----------
    captures : sequence of Capture
        Runs over the travel in both directions, with a table position, compensation off.
    law : CompensationLaw or None
        Dynamic law that is removed first.
    spacing_m : float
        Distance between knots: a twentieth of the screw pitch follows its wobble; with a tenth the
        kinks of a 3 um wobble ring the first mode where they pass at its frequency.
    turn_m : float
        Pitch of the screw.
    per_turn_m : sequence of ndarray, shapes (n,), optional
        What cogging and friction per turn make of table minus motor in each run, in m. It is of
        the run's speed: 40 nm of it left in the table become 400 nm where they pass the first mode.

    Raises
    ------
    NotIdentifiable
        No table position, or a direction does not cover the range.
    """
    moved = per_turn_m or [np.zeros(capture.n) for capture in captures]
    parts = [_samples(capture, law, own) for capture, own in zip(captures, moved, strict=True)]
    position = np.concatenate([p for p, _, _ in parts])
    error = np.concatenate([e for _, e, _ in parts])
    forward = np.concatenate([f for _, _, f in parts])
    if position.size == 0:
        raise _uncovered("no sample moves")
    low = np.ceil(position.min() / spacing_m) * spacing_m
    high = np.floor(position.max() / spacing_m) * spacing_m
    knots = low + spacing_m * np.arange(max(2, round((high - low) / spacing_m) + 1))
    up, n_up, noise = _knot_means(position[forward], error[forward], knots)
    down, n_down, _ = _knot_means(position[~forward], error[~forward], knots)
    seen = (n_up > 0) & (n_down > 0)
    if np.mean(seen) < _COVERED:
        raise _uncovered(f"both directions cover only {100 * np.mean(seen):.0f} % of the range")
    up = np.interp(knots, knots[seen], up[seen])
    down = np.interp(knots, knots[seen], down[seen])
    knots_per_turn = turn_m / spacing_m
    mean = _smooth(0.5 * (up + down), knots_per_turn)
    zero = 0.0 if knots[0] <= 0.0 <= knots[-1] else float(np.median(knots))
    mean -= np.interp(zero, knots, mean)
    return LeadMap(knots, mean, _over_a_turn(up - down, knots_per_turn), noise)


def _smooth(values: FloatArray, knots_per_turn: float) -> FloatArray:
    """What of a map is the screw's: all that is slower than its wobble, and wobbles that stand out.

    The rest is the encoder's rounding and what rings at the speed of the run. Where it passes the
    first mode at another speed, 10 nm of it ring the table by 0.2 um.
    """
    from scipy.signal import firwin

    if values.size < _FEWEST:
        return values
    longest = 2 * ((values.size - 2) // 2) + 1
    size = min(2 * round(0.5 * _KERNEL_TURNS * knots_per_turn) + 1, longest)
    angle = (2.0 * np.pi / knots_per_turn) * np.arange(values.size, dtype=np.float64)
    most = 0.5 * knots_per_turn
    orders = range(1, math.ceil(most)) if values.size > _KERNEL_TURNS * knots_per_turn else ()
    low = [order for order in orders if order < _HIGHEST_ORDER]
    rest = values - _waves(values, angle, low)
    high = [order for order in orders[len(low) :] if _stands_out(rest, angle, order)]
    waves = _waves(values, angle, [*low, *high])
    # What is left hardly knows where the map ends: so it is padded by its mirror image.
    padded = np.pad(values - waves, size // 2, mode="reflect", reflect_type="odd")
    cutoff = min(_HIGHEST_ORDER / most, _MOST_PASSED)
    return np.asarray(waves + np.convolve(padded, firwin(size, cutoff), mode="valid"))


def _waves(values: FloatArray, angle: FloatArray, orders: Sequence[int]) -> FloatArray:
    """Straight line and harmonics of the turn that a map has over all its length."""
    shapes, found = _fitted(values, angle, orders)
    return np.asarray(shapes @ found)


def _fitted(
    values: FloatArray, angle: FloatArray, orders: Sequence[int]
) -> tuple[FloatArray, FloatArray]:
    """Shapes of a straight line, cosines and sines of the turn, in columns, and their sizes."""
    phases = np.outer(angle, orders)
    shapes = np.column_stack([np.ones_like(angle), angle, np.cos(phases), np.sin(phases)])
    found, *_ = np.linalg.lstsq(shapes, values, rcond=None)
    return shapes, found


def _stands_out(rest: FloatArray, angle: FloatArray, order: int) -> bool:
    """Whether a harmonic of the turn is larger than those beside it, and than cogging leaves."""
    near = order + np.arange(-0.4, 0.41, 0.1)
    size = np.abs(np.exp(-1j * np.outer(near, angle)) @ rest) * (2.0 / rest.size)
    middle = near.size // 2
    beside = float(np.median(np.delete(size, middle)))
    return bool(size[middle] > max(_WOBBLE_m, _STANDS_OUT * beside))


def _over_a_turn(values: FloatArray, knots_per_turn: float) -> FloatArray:
    """Mean over the knots of a turn: lost motion changes along the travel, not from knot to knot.

    What does change there is rounding, of a scale of 1 um up to 0.8 um of difference.
    """
    from scipy.ndimage import uniform_filter1d

    size = min(max(1, round(knots_per_turn)), values.size)
    return np.asarray(uniform_filter1d(values, size, mode="nearest"))


def _samples(
    capture: Capture, law: CompensationLaw | None, per_turn_m: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Position, error without its dynamic part, and direction of the samples that count."""
    if capture.table_position_m is None:
        raise _uncovered("the capture has no table position")
    period = capture.sample_period_s
    r = capture.commanded_position_m
    error = capture.table_position_m - capture.motor_position_m - per_turn_m
    if law is not None:
        error = error + evaluate_law(law, r, period).correction_m
    speed = np.gradient(r, period)
    moving = np.abs(speed) > _LEAST_SPEED_m_per_s
    use = moving & capture.mask & (_since_reversal(r, speed) > _REVERSAL_CLEARANCE_m)
    return capture.motor_position_m[use], error[use], (speed > 0.0)[use]


def _since_reversal(position: FloatArray, speed: FloatArray) -> FloatArray:
    """Distance in m travelled since the direction last changed."""
    direction = np.sign(speed)
    travel = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(position)))])
    turned = np.concatenate([[True], np.diff(direction) != 0.0])
    start = np.maximum.accumulate(np.where(turned, np.arange(position.size), 0))
    return np.asarray(travel - travel[start])


def _knot_means(
    position: FloatArray, error: FloatArray, knots: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    """Local linear means around the knots, numbers of samples, scatter of a mean."""
    spacing = knots[1] - knots[0]
    index = np.round((position - knots[0]) / spacing).astype(np.int64)
    inside = (index >= 0) & (index < knots.size)
    index, error, offset = index[inside], error[inside], (position - knots[0])[inside]
    offset = offset - index * spacing
    count = np.bincount(index, minlength=knots.size).astype(np.float64)
    safe = np.maximum(count, 1.0)
    mean = np.bincount(index, error, knots.size) / safe
    square = np.bincount(index, error**2, knots.size) / safe - mean**2
    # A straight line through the samples of a knot removes what their uneven places would add.
    o = np.bincount(index, offset, knots.size) / safe
    oo = np.bincount(index, offset**2, knots.size) / safe - o**2
    oe = np.bincount(index, offset * error, knots.size) / safe - o * mean
    slope = np.where(oo > (0.05 * spacing) ** 2, oe / np.maximum(oo, 1e-30), 0.0)
    scatter = np.sqrt(np.maximum(square - slope * oe, 0.0) / safe)
    good = count > 1.0
    return mean - slope * o, count, float(np.median(scatter[good])) if good.any() else 0.0


def _uncovered(reason: str) -> NotIdentifiable:
    return NotIdentifiable(
        f"The lead error cannot be mapped: {reason}.",
        code="PC-LEAD-001",
        hint="Capture slow runs over the travel in both directions: "
        "`pmac-comp capture URL --bench FILE --campaign lead --out FOLDER`.",
    )
