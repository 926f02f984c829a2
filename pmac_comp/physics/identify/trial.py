"""Fits to every second stretch of the captures, judged on the stretches between.

What lives here: how captures are parted, what is left on the held-out part, when one model predicts
it better than another. What may not: what is tried (``friction_form``, ``scale_age``). Imports this
package.
"""

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pmac_comp.base.arrays import BoolArray, FloatArray
from pmac_comp.base.errors import DidNotConverge, ModelError
from pmac_comp.base.progress import Progress
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.identify import records as rec
from pmac_comp.physics.identify.joint import identify
from pmac_comp.physics.identify.output_error import Stages
from pmac_comp.physics.identify.result import Identification
from pmac_comp.physics.model.drive import DriveModel

_SEGMENT_s = 0.8  # held out and fitted by turns
_BLOCK_s = 0.4
USEFUL_GAIN = 0.05  # of the mean squares of both channels: less is not worth more parameters
FEW_BLOCKS = 8
_ALONE = 1.0  # standard errors more where table minus motor alone is to be clear
_AT_ONCE, _HALF = 1.0, 1.0  # standard errors less where half of two channels' mean squares goes


@dataclass(frozen=True)
class Trial:
    """Fits to one half of the captures, judged on the other.

    Parameters
    ----------
    captures, bench
        As in ``identify``.
    progress, executor
        As in ``identify``.
    """

    captures: Sequence[Capture]
    bench: Bench
    progress: Progress | None = None
    executor: Executor | None = None

    @cached_property
    def held_out(self) -> list[BoolArray]:
        """Samples of each capture that judge and are not fitted, shape (n,) each."""
        return [_alternate(capture) for capture in self.captures]

    def half(
        self, start: DriveModel, names: list[str] | None, stages: Stages = "fine"
    ) -> Identification | None:
        """What one half gives from a start; None where the captures do not carry it."""
        return self.tried(start, names, self.held_out, stages)

    def settled(self, start: DriveModel) -> Identification | None:
        """Everything fitted to all of the captures from a start."""
        return self.tried(start, None, None, "fine")

    def tried(
        self,
        start: DriveModel,
        names: list[str] | None,
        held_out: Sequence[BoolArray] | None,
        stages: Stages,
    ) -> Identification | None:
        """A fit without the samples ``held_out``, shape (n,) per capture.

        None where the captures do not carry it.

        Where a start for all parameters turns out too far off for the last stage, it goes through
        the earlier ones.
        """
        try:
            return self.fit(start, names, held_out, stages)
        except DidNotConverge:
            is_far = stages == "fine" and names is None
            return self.tried(start, names, held_out, "all") if is_far else None
        except ModelError:
            return None

    def fit(
        self,
        start: DriveModel | None,
        names: list[str] | None,
        held_out: Sequence[BoolArray] | None,
        stages: Stages,
        *,
        warm: bool = True,
    ) -> Identification:
        """A fit with the captures and the tools of this trial; raises as ``identify`` does.

        ``held_out`` has shape (n,) per capture.
        """
        return identify(
            self.captures,
            self.bench,
            model=start,
            names=names,
            warm=warm and start is not None,
            held_out=held_out,
            stages=stages,
            progress=self.progress,
            executor=self.executor,
        )

    def errors(self, found: Identification) -> FloatArray:
        """Mean squares left per held-out block in motion: table - motor, torque, shape (b, 2)."""
        return self.errors_with_motor(found)[:, :2]

    def errors_with_motor(self, found: Identification) -> FloatArray:
        """The same, and of the motor's position, shape (b, 3)."""
        blocks = []
        for capture, out, left in zip(self.captures, self.held_out, found.residuals, strict=True):
            if left.table_m is None:
                continue
            torque = np.zeros(capture.n) if left.torque_Nm is None else left.torque_Nm
            record = rec.prepare(capture, self.bench)
            motor = np.zeros(capture.n) if left.motor_m is None else left.motor_m
            channels = np.nan_to_num(np.column_stack([left.table_m, torque, motor]))
            smooth = rec.thinned(channels, record.factor)
            counts = rec.clean_rows(record) & out[:: record.factor] & rec.moving_rows(record)
            size = max(round(_BLOCK_s / record.period_s), 1)
            for low in range(0, counts.size, size):
                rows = counts[low : low + size]
                if rows.any():
                    blocks.append(np.mean(smooth[low : low + size][rows] ** 2, axis=0))
        return np.array(blocks).reshape(-1, 3)


def _alternate(capture: Capture) -> BoolArray:
    """Every second stretch of a capture, shape (n,)."""
    return np.asarray((capture.time_s - capture.time_s[0]) // _SEGMENT_s % 2 == 1)


def is_better(new: FloatArray, old: FloatArray, errors: float) -> bool:
    """Whether blocks are better by so many standard errors of the mean, and by a useful amount.

    ``new`` and ``old`` are mean squares of table minus motor and of torque, shape (b, 2).

    Either in what they gain, or in the share of its own that each block gains: where a few blocks
    hold most of the misfit, as those with a reversal do, they also make most of the scatter, and
    the first alone would call a misfit that falls to a fifth in nearly every block unclear. Or in
    table minus motor alone, by ``_ALONE`` more, where torque ripple makes most of the scatter.
    Where more than half of both channels' misfit goes at once, one standard error less does: a bed
    of 7 Hz left a tenth in the eight blocks that held nearly all of it, and a little more in the
    others.
    """
    if new.shape[0] < FEW_BLOCKS:
        return False
    gain = ((old - new) / channel_sizes(old)).sum(axis=1)
    both = old + new
    both[both == 0.0] = 1.0
    share = ((old - new) / both).sum(axis=1)
    half = np.mean(gain) > _HALF
    looks = (
        (gain, errors - _AT_ONCE if half else errors),
        (share, errors),
        (old[:, 0] - new[:, 0], errors + _ALONE),
    )
    clear = any(
        np.mean(found) > least * np.std(found) / np.sqrt(found.size) for found, least in looks
    )
    return bool(clear and np.mean(gain) > USEFUL_GAIN)


def channel_sizes(mean_squares: FloatArray) -> FloatArray:
    """Mean over blocks of each channel, 1 where it is nothing, shape (2,): what to measure by."""
    size = np.asarray(np.mean(mean_squares, axis=0))
    return np.where(size == 0.0, 1.0, size)


def rms_um(mean_squares: FloatArray) -> float:
    """Rms of table minus motor in um, of mean squares of shape (b, c); 0 without blocks."""
    return UM_PER_M * float(np.sqrt(np.mean(mean_squares[:, 0]))) if mean_squares.size else 0.0
