"""Records, noise and processors together: simulates columns and weighs them.

What lives here: the numerical work that every stage of the diagnosis shares. No decisions. May
import ``records``, ``gram``, ``statistics`` and ``physics.model``.
"""

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from pmac_comp.base.arrays import BoolArray, FloatArray, IntArray
from pmac_comp.base.errors import NonFinite
from pmac_comp.files.bench import Bench
from pmac_comp.physics.diagnose.gram import Gram, Prior, Solution, gram_of_record
from pmac_comp.physics.diagnose.records import Record, simulate_all
from pmac_comp.physics.diagnose.statistics import (
    Whitener,
    fit_whitener,
    huber_weights,
    rows_with_past,
)
from pmac_comp.physics.model.drive import DriveModel

Columns = list[NDArray[np.float32]]
_ORDER = 6
_BLOCK_s = 0.5
_SHORTEST_BLOCK_s = 0.1
_LEAST_BLOCKS = 24
_PIECE = 512
# Rounding that moves the axis by so many counts, and so many times more than usual, decides its
# motion; at most so much of the time, and with a margin, as what it has moved takes time to settle.
_COUNTS = 2.0
_UNRULY = 8.0
_MOST_UNRULY = 0.4
_BEFORE_AND_AFTER_s = 0.1
_ONSET_m = 1e-7
_ONSET_PLACES = ("guide", "nut", "motor")


@dataclass(frozen=True)
class Direction:
    """A way in which a model may be changed, as one column of the joint refit.

    Parameters
    ----------
    owner : str
        Effect, or empty for the model's own parameters.
    label : str
        Parameter, and what else tells this column from others of its owner.
    model : DriveModel
        The model moved by one finite step.
    step : float
        Size of that step in units of the column.
    lower, upper : float
        Bounds of the move in units of the column.
    centre, sigma : float
        Prior of the move.
    unit : float
        Parameter change in SI that one unit of the column stands for; 1 for an effect.
    run : int or None
        Number of the only run that it changes.
    """

    owner: str
    label: str
    model: DriveModel
    step: float
    lower: float = -np.inf
    upper: float = np.inf
    centre: float = 0.0
    sigma: float = np.inf
    unit: float = 1.0
    run: int | None = None


def half_substeps(model: DriveModel) -> int:
    """Substeps that are enough for a difference of two simulations."""
    return max(2, model.substeps // 2)


def prior_of(directions: Sequence[Direction]) -> Prior:
    """Bounds and priors of directions as arrays."""

    def column(name: str) -> FloatArray:
        return np.array([getattr(d, name) for d in directions], dtype=np.float64)

    return Prior(column("lower"), column("upper"), column("centre"), column("sigma"))


@dataclass(frozen=True)
class Noise:
    """What is taken for noise.

    Parameters
    ----------
    whitener : Whitener
        Whitening filter.
    robust : tuple of ndarray, shape (m, channels), or None
        Weights of single samples per record.
    doubtful : tuple of ndarray, shape (m, channels, q), or None
        Per record, shapes of what the model is known not to get right.
    unruly : tuple of ndarray of bool, shape (m,), or None
        Per record, where the sensors' rounding in the loop decides the motion.
    """

    whitener: Whitener
    robust: tuple[FloatArray, ...] | None = None
    doubtful: tuple[FloatArray, ...] | None = None
    unruly: tuple[BoolArray, ...] | None = None

    def of(self, keep: Sequence[int]) -> "Noise":
        """Noise of some of the records."""
        return Noise(
            self.whitener,
            None if self.robust is None else tuple(self.robust[i] for i in keep),
            None if self.doubtful is None else tuple(self.doubtful[i] for i in keep),
            None if self.unruly is None else tuple(self.unruly[i] for i in keep),
        )


@dataclass(frozen=True)
class Workbench:
    """Records for fitting and judging with the processors that simulate them.

    Parameters
    ----------
    records : tuple of Record
        All records, fitting ones first.
    fitting : tuple of ndarray of bool
        For every record, which coarse samples are fitted; the others judge.
    executor : Executor
        Runs simulations; the kernel releases the lock, so threads use all cores.
    noise : Noise or None
        Weighting; None until it has been estimated.
    """

    records: tuple[Record, ...]
    fitting: tuple[BoolArray, ...]
    executor: Executor
    noise: Noise | None = None

    @property
    def known_noise(self) -> Noise:
        """The noise, which must have been estimated."""
        if self.noise is None:
            raise ValueError("the noise has not been estimated")
        return self.noise

    @property
    def channels(self) -> int:
        """Channels of every record."""
        return self.records[0].channels

    @property
    def block_s(self) -> float:
        """Length of a block: long against the memory of the data, but many must judge."""
        judging = [float((~f).sum()) for f in self.fitting]
        each = sum(judging) * self.records[0].coarse_period_s / _LEAST_BLOCKS
        return float(np.clip(each, _SHORTEST_BLOCK_s, _BLOCK_s))

    @property
    def judging_records(self) -> tuple[Record, ...]:
        """Records with samples that judge, cut to the samples that do."""
        return tuple(
            r.masked(r.valid & _fine(~f, r))
            for r, f in zip(self.records, self.fitting, strict=True)
            if not f.all()
        )

    @property
    def counted(self) -> tuple[BoolArray, ...]:
        """Coarse samples that evidence may come from, shape (m,) per record."""
        unruly = None if self.noise is None else self.noise.unruly
        usable = tuple(r.usable for r in self.records)
        if unruly is None:
            return usable
        return tuple(u & ~x for u, x in zip(usable, unruly, strict=True))

    @property
    def calm_records(self) -> tuple[Record, ...]:
        """The judging records without the samples that no evidence comes from, if any are left."""
        return tuple(
            r.masked(r.valid & _fine(c & ~f, r))
            for r, f, c in zip(self.records, self.fitting, self.counted, strict=True)
            if np.any(c & ~f)
        )

    def whole_records(self, *, calm: bool) -> tuple[Record, ...]:
        """Records with judging samples, uncut; ``calm`` leaves out what is no evidence."""
        return tuple(
            r.masked(r.valid & _fine(c, r)) if calm else r
            for r, f, c in zip(self.records, self.fitting, self.counted, strict=True)
            if (np.any(c & ~f) if calm else not f.all())
        )

    def concerned(self, directions: Sequence[Direction]) -> list[Direction]:
        """Directions that change one of the records."""
        numbers = {None, *(r.number for r in self.records)}
        return [d for d in directions if d.run in numbers]

    def judges(self) -> tuple["Workbench", ...]:
        """Every record that has no fitting samples, alone, all its samples fitted."""
        return tuple(
            Workbench(
                (record,),
                (np.ones_like(mask),),
                self.executor,
                None if self.noise is None else self.noise.of([i]),
            )
            for i, (record, mask) in enumerate(zip(self.records, self.fitting, strict=True))
            if not mask.any()
        )

    def of(self, keep: Sequence[int]) -> "Workbench":
        """Some of the records."""
        noise = None if self.noise is None else self.noise.of(keep)
        records = tuple(self.records[i] for i in keep)
        return Workbench(records, tuple(self.fitting[i] for i in keep), self.executor, noise)

    def fitting_bench(self) -> "Workbench":
        """The records that have fitting samples alone: what judges need not be simulated."""
        keep = [i for i, mask in enumerate(self.fitting) if mask.any()]
        if len(keep) == len(self.records):
            return self
        return self.of(keep)

    def with_noise(self, noise: Noise) -> "Workbench":
        """The same bench with other weights."""
        return replace(self, noise=noise)

    def simulate(self, models: Sequence[DriveModel]) -> list[list[FloatArray]]:
        """Coarse channels of every model and record, shape (m, channels) each."""
        return simulate_all(self.records, models, self.executor)

    def residuals(self, simulated: Sequence[FloatArray]) -> list[FloatArray]:
        """Measured minus simulated on the coarse grid, shape (m, channels) per record."""
        return [r.coarse_measured_m - s for r, s in zip(self.records, simulated, strict=True)]

    def columns(
        self,
        model: DriveModel,
        directions: Sequence[Direction],
        *,
        into: Columns | None = None,
        at: Sequence[int] | None = None,
    ) -> Columns:
        """Finite-difference columns per record, shape (m, channels, k) each.

        Both ends of a difference are simulated with half the substeps: what a substep costs in
        accuracy is common to both (columns differ by less than 1 % from those of fine steps).
        ``into`` and ``at`` say into which columns of which arrays they are written instead of new
        ones: the columns of all candidates are the largest arrays of a diagnosis. A direction in
        which the loop becomes unstable gets a column of zeros.
        """
        count = len(directions)
        shapes = [(*r.coarse_measured_m.shape, count) for r in self.records]
        out = [np.empty(shape, dtype=np.float32) for shape in shapes] if into is None else into
        places = range(count) if at is None else at
        needed = [half_substeps(d.model) for d in directions]
        ends = [(i, n) for i in range(len(self.records)) for n in sorted(set(needed))]
        simulated = self.executor.map(
            lambda end: self.records[end[0]].simulated_m(model, substeps=end[1]), ends
        )
        base = dict(zip(ends, simulated, strict=True))

        def write(job: tuple[int, int]) -> None:
            i, j = job
            if directions[j].run not in (None, self.records[i].number):
                out[i][:, :, places[j]] = 0.0
                return
            try:
                moved = self.records[i].simulated_m(directions[j].model, substeps=needed[j])
            except NonFinite:
                # What makes the loop unstable is not in the drive that ran.
                out[i][:, :, places[j]] = 0.0
                return
            out[i][:, :, places[j]] = (moved - base[i, needed[j]]) / directions[j].step

        jobs = [(i, j) for i in range(len(self.records)) for j in range(count)]
        for _ in self.executor.map(write, jobs):
            pass  # raises what a simulation raised
        return out

    def gram(
        self,
        residuals: Sequence[FloatArray],
        columns: Columns,
        prior: Prior,
        *,
        longest_s: float | None = None,
    ) -> Gram:
        """Scalar products per block; blocks never mix fitted and judging samples.

        Blocks are ``block_s`` long unless told otherwise: products of the columns of all
        candidates are large and serve as sums over whole stretches. Of each record ``residuals``
        has shape (m, channels) and ``columns`` (m, channels, k).
        """
        noise = self.known_noise
        jobs = [
            (record, first, last, fits, i)
            for i, (record, mask) in enumerate(zip(self.records, self.fitting, strict=True))
            for first, last, fits in _stretches(mask)
            if last - first > 2 * _ORDER
        ]
        length_s = self.block_s if longest_s is None else longest_s
        block = max(4 * _ORDER, round(length_s / self.records[0].coarse_period_s))
        counted = self.counted

        def work(job: tuple[Record, int, int, bool, int]) -> tuple[FloatArray, FloatArray]:
            _, first, last, _, i = job
            return gram_of_record(
                residuals[i][first:last],
                columns[i][first:last],
                counted[i][first:last],
                noise.whitener,
                block=block,
                offset_channels=[1] if self.channels > 1 else [],
                robust=None if noise.robust is None else noise.robust[i][first:last],
                doubtful=None if noise.doubtful is None else noise.doubtful[i][first:last],
            )

        parts = list(self.executor.map(work, jobs))
        return Gram(
            np.concatenate([p[0] for p in parts]),
            np.concatenate([np.full(len(p[1]), j[3]) for p, j in zip(parts, jobs, strict=True)]),
            np.concatenate([p[1] for p in parts]),
            prior,
            np.concatenate([np.full(len(p[1]), j[4]) for p, j in zip(parts, jobs, strict=True)]),
        )

    def noise_from(
        self, noise_like: Sequence[FloatArray], floor_m: FloatArray, *, foretold: bool = True
    ) -> Noise:
        """Whitener and robust weights from what a flexible refit leaves, shape (m, channels) each.

        Unless ``foretold``, only of the samples that were fitted: many columns may leave anything
        on others.
        """
        usable = self.counted
        if not foretold:
            fitted = (u & f for u, f in zip(usable, self.fitting, strict=True))
            usable = tuple(f if f.any() else u for u, f in zip(usable, fitted, strict=True))
        # Where a scale has its zero is no noise, least of all an infinitely slow one.
        pairs = zip(noise_like, usable, strict=True)
        level = [n - n[u].mean(axis=0) if u.any() else np.zeros_like(n) for n, u in pairs]
        whitener = fit_whitener(level, usable, order=_ORDER, floor=floor_m)
        weights = tuple(huber_weights(whitener.apply(n)) for n in level)
        if not foretold:
            both = zip(weights, self.fitting, strict=True)
            weights = tuple(np.where(f[:, None], w, 1.0) for w, f in both)
        if self.noise is None:
            return Noise(whitener, weights)
        return replace(self.noise, whitener=whitener, robust=weights)

    def floor_m(self, description: Bench) -> FloatArray:
        """Least innovation in m, shape (channels,): a tenth of what one coarse sample resolves."""
        steps = [description.motor_resolution_m, description.scale_resolution_m or 0.0]
        coarse = 0.1 / np.sqrt(12.0 * self.records[0].factor)
        return np.asarray(np.maximum(coarse * np.array(steps[: self.channels]), 1e-10))

    def rounded(self, model: DriveModel) -> list[FloatArray]:
        """What the sensors' steps do inside the loop, shape (m, channels) per record."""
        sharp = self.simulate([model])[0]

        def work(i: int) -> FloatArray:
            record = self.records[i]
            response = record.response(model, quantise=True)
            return record.coarsen(record.channels_of(response)) - sharp[i]

        return list(self.executor.map(work, range(len(self.records))))

    def unruly(self, model: DriveModel, rounded: Sequence[FloatArray]) -> tuple[BoolArray, ...]:
        """Where rounding moves the axis by counts, far more than elsewhere; shape (m,) per record.

        An axis at rest within its friction creeps as its integrator counts one fraction of a step
        or another, and leaves late or early: micrometres that no effect explains and that the true
        model, simulated without rounding, does not show. Nothing is left out where that is common.
        """
        usable = [r.usable for r in self.records]
        moved = [np.abs(r - np.median(r, axis=0)).max(axis=1) for r in rounded]
        calm = np.median(np.concatenate([m[u] for m, u in zip(moved, usable, strict=True)]))
        limit = max(_UNRULY * float(calm), _COUNTS * model.bench.motor_resolution_m)
        near = round(_BEFORE_AND_AFTER_s / self.records[0].coarse_period_s)
        found = tuple(maximum_filter1d(m > limit, 2 * near + 1) for m in moved)
        some, every = (np.concatenate(c) for c in (found, usable))
        left_out = np.count_nonzero(some & every) > _MOST_UNRULY * np.count_nonzero(every)
        # Nor where no evidence would be left to fit or to judge by.
        calm_rows = self.telling([u & ~f for u, f in zip(usable, found, strict=True)])
        if left_out or min(calm_rows) == 0:
            return tuple(np.zeros_like(u) for u in usable)
        return found

    def telling(self, usable: Sequence[BoolArray]) -> tuple[int, int]:
        """Samples that fit and that judge, of the usable ones of each record, shape (m,).

        A sample tells something only with those before it that its whitening takes in.
        """
        told = {True: 0, False: 0}
        for mask, good in zip(self.fitting, usable, strict=True):
            for first, last, fits in _stretches(mask):
                if last - first > 2 * _ORDER:
                    rows = rows_with_past(good[first:last], _ORDER)
                    told[fits] += int(np.count_nonzero(rows))
        return told[True], told[False]

    def doubtful(self, model: DriveModel) -> tuple[FloatArray, ...]:
        """What a softer onset of friction would change, shape (m, channels, places) per record.

        No friction sets in at once; how it does within the first tenth of a micrometre, less than
        the encoders see, decides a few hundredths of a micrometre around every reversal.
        """
        bare = model
        if "presliding" in {name.partition("@")[0] for name in model.effects}:
            bare = model.without_effect("presliding")
        places = _ONSET_PLACES[:1] if model.is_rigid else _ONSET_PLACES
        softer = [
            bare.with_effect(f"presliding@{place}", {"distance_m": _ONSET_m}) for place in places
        ]
        base, *moved = self.simulate([bare, *softer])
        return tuple(
            np.stack([m[i] - base[i] for m in moved], axis=2) for i in range(len(self.records))
        )

    def left_by(
        self, residuals: Sequence[FloatArray], columns: Columns, solution: Solution
    ) -> list[FloatArray]:
        """Residuals less what a linearised refit explains, shape (m, channels) per record."""
        return [
            r - combined(c, solution.indices, solution.step)
            for r, c in zip(residuals, columns, strict=True)
        ]


def combined(
    columns: NDArray[np.float32], indices: Sequence[int] | IntArray, step: FloatArray
) -> FloatArray:
    """Sum of some columns times a step, shape (m, channels), in double precision."""
    whole = np.zeros(columns.shape[2])
    whole[np.asarray(indices, dtype=np.int64)] = step
    out = np.empty(columns.shape[:2])
    for start in range(0, columns.shape[0], _PIECE):
        part = columns[start : start + _PIECE]
        out[start : start + _PIECE] = part.astype(np.float64) @ whole
    return out


def _fine(coarse: BoolArray, record: Record) -> BoolArray:
    """Coarse samples spread over the servo grid; the rest that fills no block is left out."""
    wide = np.zeros(record.valid.size, dtype=np.bool_)
    wide[: coarse.size * record.factor] = np.repeat(coarse, record.factor)
    return wide


def split(fit: Sequence[Record], judge: Sequence[Record]) -> tuple[BoolArray, ...]:
    """Which coarse samples are fitted, shape (m,) per record.

    With judging captures all samples of the others are fitted. Without any, two stretches of each
    capture are held back, a sixth of it long, so that every motion is judged and what grows with
    time is judged between the times at which it was fitted.
    """
    if judge:
        return tuple(np.full(r.usable.size, i < len(fit)) for i, r in enumerate([*fit, *judge]))
    return tuple(~np.isin(6 * np.arange(r.usable.size) // r.usable.size, (1, 4)) for r in fit)


def _stretches(fitting: BoolArray) -> list[tuple[int, int, bool]]:
    """First sample, end and kind of the stretches that are all fitted or all judged."""
    ends = [0, *(np.flatnonzero(np.diff(fitting)) + 1).tolist(), fitting.size]
    return [(a, b, bool(fitting[a])) for a, b in pairwise(ends)]
