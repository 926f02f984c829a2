"""What is left after growth: noise, or something without a name.

What lives here: the noise floor and the test of the remainder against flexible rivals. May import
the rest of this package below ``diagnose``.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import lsq_linear

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.physics.diagnose.fine import FinePattern, fine_pattern
from pmac_comp.physics.diagnose.growth import Grown
from pmac_comp.physics.diagnose.imitations import ONSET, imitation
from pmac_comp.physics.diagnose.localise import Region, localise
from pmac_comp.physics.diagnose.noise import ambient_m2, noise_floor_um
from pmac_comp.physics.diagnose.onset import holds_onset
from pmac_comp.physics.diagnose.place import PlacePattern, place_pattern
from pmac_comp.physics.diagnose.records import gap
from pmac_comp.physics.diagnose.refit import evaluate, refit
from pmac_comp.physics.diagnose.statistics import block_means, corrected_p, sign_flip_p
from pmac_comp.physics.diagnose.workbench import Workbench
from pmac_comp.physics.model.drive import DriveModel

_UNEXPLAINED = 0.10  # of the noise variance per sample, earned by flexible rivals on both parts
_TOLD = 0.003  # of the variance that the grown model removed: the form is right to this
_FORM = 0.15  # the same where it hardly shows in um: no right form leaves so much
# What two careful integrations of the same drive differ by around reversals, at least; and how
# many deviations of what the onset of friction leaves open.
_MODEL_um = 0.08
_ONSETS = 1.5
_TRIM = 0.1
# Of the onset's shapes, and the same where the model holds an onset that was fitted.
_LARGEST_SHAPE, _FITTED_SHAPE = 3.0, 1.0
_TRIM_BLOCK = 50  # coarse samples, a ninth of a second
_MOST = 0.25  # of the base model's excess, in squares: half of it in um
# Where nothing has a name: of the noise floor, and times what idealisation leaves at stops.
_PLAIN, _IDEAL = 1.5, 3.0
_FAR = 2.0  # of the noise floor: no name closes a gap that leaves so much
_EXCESS = 0.8  # of the noise floor: what the flexible rivals may have missed
_CHANCE = 1e-4  # that white noise shows the wave that is told
_BY_PLACE = 0.01  # that runs foretell each other by place


@dataclass(frozen=True)
class Calm:
    """Gaps without the samples in which the sensors' rounding decides the motion.

    Parameters
    ----------
    left_out : float
        Share of the judging time that those samples are.
    before_um, after_um, floor_um : float
        Gaps of base and grown model, and the noise floor, on the others.
    """

    left_out: float
    before_um: float
    after_um: float
    floor_um: float


@dataclass(frozen=True)
class Remainder:
    """What the grown model leaves.

    Parameters
    ----------
    unexplained : bool
        Whether something material is left.
    explained : bool
        Whether the accepted effects closed most of the base model's excess: more than half in um.
    missed : bool
        Whether runs not used for fitting stay far from the grown model, with effects and all.
    open_share : float
        Share of the base model's gap beyond the noise floor that is left, in squares.
    fit_share, judged_share : float
        Drop of chi-square per sample that flexible rivals earn; excess over the noise floor.
    p_value : float
        That the judged share comes from chance.
    floor_um : float
        Rms that a perfect model would leave on the judging samples that evidence comes from.
    noise_floor_um : float
        The same on all of them, those included where rounding decides the motion.
    calm : Calm
        The gap without the samples in which rounding decides the motion.
    excess_um : float
        Gap beyond the noise floor, root of the difference of squares.
    settled_um : float
        Gap where the judging runs are fitted as well, with nothing added.
    regions : tuple of Region
        Where the remainder lives.
    """

    unexplained: bool
    explained: bool
    missed: bool
    open_share: float
    fit_share: float
    judged_share: float
    p_value: float
    floor_um: float
    noise_floor_um: float
    calm: "Calm"
    excess_um: float
    settled_um: float
    regions: tuple[Region, ...]

    @property
    def visible(self) -> bool:
        """Whether the remainder is worth describing."""
        return self.unexplained or self.excess_um > 0.5 * self.floor_um


def remainder_of(grown: Grown, bench: Bench, *, rivals_apply: bool = True) -> Remainder:
    """Judge what the last round left against flexible rivals and against the noise floor.

    Unless ``rivals_apply``, the rivals of the last round were those of another model.
    """
    last = grown.rounds[-1]
    rivals = grown.rivals
    fit_share = rivals.rival_gain / max(rivals.rows_fit, 1.0)
    floor_um = noise_floor_um(grown.workbench, grown.final.model, calm=True)
    gap_um = _rms_um(grown, grown.final.model)
    excess_um, quiet_um, plain_um, settled_um = _excess_um(grown, gap_um, floor_um)
    p_value = corrected_p(sign_flip_p(rivals.rival_drop, seed=1), 1)
    removed = float((grown.base.blocks - grown.final.blocks).sum()) / float(
        last.rows_fit + last.rows_judge
    )
    material = max(_UNEXPLAINED, _TOLD * removed)
    open_um = max(_MODEL_um, _ONSETS * _onset_um(grown))
    noticeable = excess_um > max(0.3 * floor_um, open_um)
    by_rivals = fit_share > material and p_value < 0.01 and (noticeable or fit_share > _FORM)
    base_um = float(np.sqrt(max(0.0, _rms_um(grown, grown.base.model) ** 2 - floor_um**2)))
    worth = max(_EXCESS * floor_um, open_um, 0.25 * base_um)
    explained = excess_um**2 < _MOST * base_um**2
    far = excess_um > max(worth, _FAR * floor_um)
    beyond = quiet_um > worth or far or (excess_um > worth and not explained)
    # Effects that miss runs not used for fitting by so much have not been shown, whatever a fit to
    # those runs would make of them; how friction sets in is no effect.
    raw_um = float(np.sqrt(max(0.0, gap_um**2 - floor_um**2)))
    named = [c for c in grown.accepted if imitation(c.effect, grown.final.model) != ONSET]
    missed = bool(named) and raw_um > max(_FAR * floor_um, _IDEAL * _MODEL_um)
    if missed:
        beyond, excess_um = True, max(excess_um, raw_um)
    # Where nothing has a name, what the onset of friction might excuse is not nothing either.
    if not named and plain_um > max(_PLAIN * floor_um, _IDEAL * _MODEL_um, open_um):
        beyond, excess_um = True, max(excess_um, plain_um)
    worth_um = max(floor_um, _MODEL_um, 0.25 * base_um)
    fine = _material_wave(grown, worth_um)
    place = _material_place(grown, bench, worth_um)
    regions = _regions(grown, bench)
    patterns = tuple(p.region for p in (place, fine) if p is not None)
    if patterns:
        excess_um = float(np.sqrt(max(excess_um**2, gap_um**2 - floor_um**2)))
        regions = (*patterns, *(r for r in regions if place is None or r.coordinate != "position"))
    return Remainder(
        explained=explained,
        missed=missed,
        open_share=max(0.0, gap_um**2 - floor_um**2) / max(base_um**2, 1e-12),
        unexplained=bool((by_rivals and rivals_apply) or beyond or patterns),
        fit_share=fit_share,
        judged_share=excess_um / max(floor_um, 1e-12),
        p_value=p_value,
        floor_um=floor_um,
        calm=Calm(_left_out(grown.workbench), _rms_um(grown, grown.base.model), gap_um, floor_um),
        noise_floor_um=noise_floor_um(
            grown.workbench,
            grown.final.model,
            ambient_m2=ambient_m2(grown.workbench, grown.final.model),
        ),
        excess_um=excess_um,
        settled_um=settled_um,
        regions=regions,
    )


def _material_wave(grown: Grown, worth_um: float) -> FinePattern | None:
    """A wave within coarse samples that is neither chance nor small.

    The gap beyond the floor is looked for on the coarse grid, which averages such a wave away.
    """
    fine = fine_pattern(grown.workbench, grown.final.model)
    if fine is None or fine.p_value > _CHANCE or fine.rms_um < worth_um:
        return None
    return fine


def _material_place(grown: Grown, bench: Bench, worth_um: float) -> PlacePattern | None:
    """What the table shows at the same places in every run, neither by chance nor small.

    What friction does at stops may excuse a gap, but runs that stop elsewhere show nothing there.
    """
    workbench = grown.workbench
    if workbench.channels < 2:
        return None
    pattern = place_pattern(
        [r[:, -1] for r in workbench.residuals(grown.final.simulated)],
        [y[:, -1] for y in grown.final.simulated],
        workbench.counted,
        pitch_m=bench.pitch_m,
        block=max(1, round(workbench.block_s / workbench.records[0].coarse_period_s)),
    )
    if pattern is None or pattern.p_value > _BY_PLACE or pattern.rms_um < worth_um:
        return None
    return pattern


def _excess_um(grown: Grown, gap_um: float, floor_um: float) -> tuple[float, float, float, float]:
    """Gap beyond the noise floor that no choice of the grown model's parameters closes.

    All of it; without the worst tenth of the time, as where an axis sticks for a moment not even
    the true model repeats itself; and all of it with nothing taken for the onset of friction. At
    last the gap that such a choice leaves.

    Fitting runs may leave parameters open that the judging runs need; that is no missing effect.
    """
    excess_um = float(np.sqrt(max(0.0, gap_um**2 - floor_um**2)))
    if excess_um < max(0.3 * floor_um, _MODEL_um):
        return excess_um, excess_um, excess_um, gap_um
    workbench = grown.workbench
    every = replace(workbench, fitting=tuple(np.ones_like(mask) for mask in workbench.fitting))
    settled = refit(every, evaluate(every, grown.final.model), rounds=2)
    both = [_doubted_um2(workbench, model) for model in (grown.final.model, settled.model)]
    whole, quiet, plain = (
        float(np.sqrt(max(0.0, min(b[i] for b in both) - floor_um**2))) for i in (0, 1, 2)
    )
    return whole, quiet, plain, _rms_um(grown, settled.model)


def _doubted_um2(workbench: Workbench, model: DriveModel) -> tuple[float, float, float]:
    """Mean square of the gap less the shapes that the onset of friction leaves open.

    Of all the time, without the worst tenth, and of all the time with those shapes.
    """
    simulated = workbench.simulate([model])[0]
    doubtful = None if workbench.noise is None else workbench.noise.doubtful
    largest = _FITTED_SHAPE if holds_onset(model) else _LARGEST_SHAPE
    powers, plain = [], []
    counted = workbench.counted
    for i, (record, mask) in enumerate(zip(workbench.records, workbench.fitting, strict=True)):
        judged = np.flatnonzero(~mask & counted[i])
        left = (record.coarse_measured_m[:, -1] - simulated[i][:, -1])[judged]
        if left.size < _TRIM_BLOCK:
            continue
        if workbench.channels > 1:
            left = left - np.median(left)
        plain.append(block_means(left**2, _TRIM_BLOCK))
        if doubtful is not None:
            left = left - _shaped(left, doubtful[i][judged, -1], largest)
        powers.append(block_means(left**2, _TRIM_BLOCK))
    ranked = np.sort(np.concatenate(powers)) if powers else np.zeros(1)
    kept = ranked[: max(1, round((1.0 - _TRIM) * ranked.size))]
    every = np.concatenate(plain) if plain else np.zeros(1)
    return float(1e12 * ranked.mean()), float(1e12 * kept.mean()), float(1e12 * every.mean())


def _shaped(left_m: FloatArray, shapes_m: FloatArray, largest: float) -> FloatArray:
    """What shapes of one standard deviation each explain at no more than so many of them."""
    bounded = lsq_linear(UM_PER_M * shapes_m, UM_PER_M * left_m, bounds=(-largest, largest))
    return np.asarray(shapes_m @ bounded.x)


def _onset_um(grown: Grown) -> float:
    """Rms of what the onset of friction leaves open in the last channel."""
    noise = grown.workbench.noise
    if noise is None or noise.doubtful is None:
        return 0.0
    powers = [float(np.mean(np.sum(d[:, -1] ** 2, axis=1))) for d in noise.doubtful]
    return UM_PER_M * float(np.sqrt(np.mean(powers)))


def _left_out(workbench: Workbench) -> float:
    """Share of the judging time in which rounding decides the motion."""
    judged = [
        u & ~f
        for u, f in zip((r.usable for r in workbench.records), workbench.fitting, strict=True)
    ]
    kept = sum(int(np.count_nonzero(j & c)) for j, c in zip(judged, workbench.counted, strict=True))
    return 1.0 - kept / max(1, sum(int(np.count_nonzero(j)) for j in judged))


def _rms_um(grown: Grown, model: DriveModel) -> float:
    return gap(grown.workbench.calm_records, model, grown.workbench.executor).position_um


def _regions(grown: Grown, bench: Bench) -> tuple[Region, ...]:
    workbench = grown.workbench
    residuals: Sequence[FloatArray] = workbench.residuals(grown.final.simulated)
    coordinates = [
        r.coordinates(r.response(grown.final.model), bench.pitch_m) for r in workbench.records
    ]
    marked = [
        np.where(c, d[:, -1], np.nan) for c, d in zip(workbench.counted, residuals, strict=True)
    ]
    channel = "table" if workbench.channels > 1 else "motor"
    period = workbench.records[0].coarse_period_s
    return localise(marked, coordinates, channel=channel, sample_s=period)
