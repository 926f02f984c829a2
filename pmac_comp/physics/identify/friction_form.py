"""Which form of friction the captures themselves ask for.

What lives here: Coulomb friction first, forms with presliding and Stribeck beside it, and the
choice between them on samples that were not fitted. What may not: how those are parted and judged
(``trial``), causes other than friction (``diagnose`` names those). Imports this package.

Coulomb and viscous friction stay the base. A form is added only if it predicts the held-out samples
of the same captures clearly better, and the result says so.
"""

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import ModelError
from pmac_comp.base.progress import Progress
from pmac_comp.base.units import UM_PER_M, US_PER_S
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.identify import records as rec
from pmac_comp.physics.identify.agreement import widened_where_apart
from pmac_comp.physics.identify.joint import share_after_reversals
from pmac_comp.physics.identify.linear_start import SKEW_TIME, lag_by_speed_s
from pmac_comp.physics.identify.problem import BEYOND_STEPS, step_floors
from pmac_comp.physics.identify.result import Identification
from pmac_comp.physics.identify.scale_age import SKEW
from pmac_comp.physics.identify.smooth import SMOOTH, smooth_values, turns_over_at_once
from pmac_comp.physics.identify.trial import Trial, channel_sizes, is_better, rms_um
from pmac_comp.physics.model.drive import BASE_EFFECTS, DriveModel
from pmac_comp.physics.model.effect import split_name

_WORDS = {
    "presliding": "presliding at the guide (presliding)",
    "presliding@rotary": "presliding at nut and motor (presliding@rotary)",
    "presliding@all": "presliding at guide, nut and motor (presliding@all)",
    "presliding@nut": "presliding at the nut alone (presliding@nut)",
    "presliding@motor": "presliding at the motor alone (presliding@motor)",
    "presliding_gms": "presliding at the guide with memory of earlier reversals (presliding_gms)",
    SMOOTH: "friction that turns over with speed and holds nothing at rest (smooth_coulomb)",
    "stribeck": "Stribeck friction at the guide (stribeck)",
    "stribeck@nut": "Stribeck friction at nut and motor (stribeck@nut)",
}
_CARRIES = ("chain.table_mass_kg", "chain.axial_stiffness_N_per_m")
_TURNING = ("nut_", "motor_", "rotary")
STICK_ZONE_m = 1e-6  # below it a reversal is as sharp as Coulomb friction for any sensor here
_NO_ZONE_m = 0.0
_SIGNIFICANT = 3.0  # standard deviations
_SUSPECT = 1.9  # misfit after reversals over elsewhere; Coulomb friction alone gives 1.5 to 1.8
# Standard errors of the mean over blocks. Where the misfit itself lies around reversals another
# friction is what is likely, and what else the model lacks scatters the blocks.
_CLEARLY, _PROBABLY, _RATHER = 3.0, 2.0, 1.0


@dataclass(frozen=True)
class _Form:
    """Friction beside Coulomb and viscous: a distance each for guide and screw side, Stribeck."""

    guide_m: float
    rotary_m: float
    excess_N: float
    stribeck_m_per_s: float
    memory: bool = False
    has_stribeck: bool = True
    guide_damping: float = 0.05
    rotary_damping: float = 0.05

    @property
    def is_coulomb(self) -> bool:
        """Whether nothing of it is left."""
        return max(self.guide_m, self.rotary_m) <= STICK_ZONE_m and not self.has_stribeck

    @property
    def is_whole(self) -> bool:
        """Whether every part of it is there."""
        return min(self.guide_m, self.rotary_m) > STICK_ZONE_m and self.has_stribeck

    @property
    def with_memory(self) -> "_Form":
        """The same with memory at the guide: from end to end that form takes twice its distance."""
        return replace(self, guide_m=0.5 * self.guide_m, memory=True)

    def effects(self, least_m: float) -> list[tuple[str, dict[str, float]]]:
        """Effects with their values, distances up to ``least_m`` left out."""
        guide, rotary = self.guide_m > least_m, self.rotary_m > least_m
        found: list[tuple[str, dict[str, float]]] = []
        if self.memory and guide:
            memory = {"distance_m": self.guide_m, "damping_ratio": self.guide_damping}
            found.append(("presliding_gms", memory))
            guide = False
        if guide and rotary:
            both = {"distance_m": self.guide_m, "rotary_m": self.rotary_m}
            damping = {
                "damping_ratio": self.guide_damping,
                "rotary_damping_ratio": self.rotary_damping,
            }
            found.append(("presliding@all", {**both, **damping}))
        elif guide:
            at_guide = {"distance_m": self.guide_m, "damping_ratio": self.guide_damping}
            found.append(("presliding", at_guide))
        elif rotary:
            turning = {"distance_m": self.rotary_m, "damping_ratio": self.rotary_damping}
            found.append(("presliding@rotary", turning))
        if self.has_stribeck or least_m == _NO_ZONE_m:
            values = {"excess_N": self.excess_N, "speed_m_per_s": self.stribeck_m_per_s}
            found.append(("stribeck", values))
        return found


_TURNING_FRAC = 0.2  # of Coulomb friction at nut and motor, where a fit of their Stribeck's begins
_FIRST_GUESS = _Form(guide_m=10e-6, rotary_m=5e-6, excess_N=10.0, stribeck_m_per_s=0.005)
# No friction turns over at once: Coulomb's, as drives have it.
_ONSET = _Form(0.2e-6, 0.2e-6, excess_N=0.0, stribeck_m_per_s=0.005, has_stribeck=False)
_SHARP = replace(_ONSET, guide_m=0.0, rotary_m=0.0)
_ANY_m = 1e-9
# Lag of the table by speed that is twice what guides usually make, or a lead, which no friction
# makes: there the base model is also fitted with a scale that is read late, of which it makes
# viscous friction that the torque lacks. Less is looked for once friction is known (``scale_age``).
_MUCH_FOR_FRICTION_s, _NO_FRICTION_s, _LATE_s = 8e-6, -1e-6, 4e-6
_LENGTHS = ("presliding.distance_m", "presliding.rotary_m")


class _FrictionTrial(Trial):
    """What a trial of friction fits and what it keeps."""

    def outlined(self) -> Identification | None:
        """The base model fitted to within the noise; None where it cannot be.

        Enough to see whether Coulomb friction does, and to start from. The rest of that fit is for
        drives that keep to Coulomb friction, and so are the words where it fails.
        """
        base = DriveModel.base(self.bench)
        if base.is_rigid:
            return None
        try:
            lag_s = lag_by_speed_s(self.captures, self.bench, base)
        except ModelError:
            return None
        plain, late = self._outline(None), None
        if not _NO_FRICTION_s < lag_s < _MUCH_FOR_FRICTION_s:
            late = self._outline(base.with_effect(SKEW))
        if plain is None or late is None:
            return plain or late
        much = abs(late.parameters[SKEW_TIME].value) > _LATE_s
        clear = is_better(self.errors(late), self.errors(plain), _CLEARLY)
        return late if much and clear else plain

    def _outline(self, start: DriveModel | None) -> Identification | None:
        try:
            return self.fit(start, None, None, "outline", warm=False)
        except ModelError:
            return None

    def smooth(self) -> Identification | None:
        """Smooth friction fitted to one half; None where the drive holds at rest.

        With Stribeck's curve beside it, at the guide or at the nut, where that rather predicts the
        other half: fitted without, its fall with speed goes into the split of the levels.
        """
        base = DriveModel.base(self.bench)
        values = smooth_values(self.captures, base)
        outline = None if values is None else self._outline(base.with_effect(SMOOTH, values))
        best = alone = None if outline is None else self.half(outline.model, None)
        if best is None or alone is None:
            return None
        for name, curve in _curves(alone.model).items():
            other = self.half(alone.model.with_effect(name, curve), None)
            if other is not None and is_better(self.errors(other), self.errors(best), _RATHER):
                best = other
        return None if turns_over_at_once(best.model) else best

    def plain(self, outline: Identification | None) -> Identification:
        """The base model fitted in full, from where its outline ended."""
        start = None if outline is None else outline.model
        return self.fit(start, None, None, "all" if start is None else "fine")

    def fitted(self, start: DriveModel) -> Identification | None:
        """Friction fitted to one half from a start; None where the captures do not carry it."""
        return self.half(start, _asked(start))

    def fitted_at_guide(self, start: DriveModel) -> Identification | None:
        """The same for the guide alone, the turning side as it was."""
        names = [n for n in _asked(start) if not any(word in n for word in _TURNING)]
        return self.half(start, names)

    def shaped(self, start: DriveModel) -> DriveModel:
        """The start with distances and Stribeck's curve fitted to one half, levels as they were.

        All at once, levels can run into a corner while the distances are still far off.
        """
        shape = [n for n in _asked(start) if n.partition(".")[0] not in BASE_EFFECTS]
        found = self.half(start, shape, "rough")
        return start if found is None else found.model

    def suspects(self, found: Identification) -> bool:
        """Whether the misfit of table minus motor around reversals asks for another friction.

        It does where it grows there, or where it is more than the steps of the sensors make: what
        else a model lacks, as torque ripple, can hide by its own misfit that it grows.
        """
        records = [rec.prepare(capture, self.bench) for capture in self.captures]
        levels = share_after_reversals(records, found.residuals)
        if levels is None:
            return False
        steps_m = step_floors(self.bench)["difference"]
        return levels[1] > min(_SUSPECT * levels[0], BEYOND_STEPS * steps_m)


def identify_with_friction(
    captures: Sequence[Capture],
    bench: Bench,
    *,
    progress: Progress | None = None,
    executor: Executor | None = None,
) -> Identification:
    """``identify``, with the form of friction chosen by what the captures show.

    The base model is fitted first, to within the noise. A drive that creeps at rest (``smooth``)
    gets friction that turns over with speed, if that is clearly better. For others presliding at
    guide, nut and motor with Stribeck friction is fitted to alternate stretches of the captures and
    judged, like the base model, by table minus motor and torque on the other stretches; then the
    same with memory at the guide, and with presliding at the nut or at the motor alone. Where
    nothing comes of it, and the base model leaves clearly more around reversals than elsewhere, or
    than the sensors' steps make, Coulomb friction that sets in over some tenths of a micrometre is
    tried in the same way. What is clearly better, without the parts that came out as nothing, is
    fitted to everything. Otherwise the fit of the base model goes on to its end.

    Parameters
    ----------
    captures, bench, progress, executor
        As in ``identify``.

    Returns
    -------
    Identification
        Of the chosen form; its statements say which and why, ``figures`` hold the held-out rms of
        every form that was tried (``held_out_*_um``).

    Raises
    ------
    NotIdentifiable, DidNotConverge, CaptureError
        As ``identify`` raises them for the base model.
    """
    trial = _FrictionTrial(captures, bench, progress, executor)
    base, smooth = trial.outlined(), trial.smooth()
    figures: dict[str, float] = {}
    errors = None
    if base is not None:
        errors = trial.errors(base)
        figures["held_out_coulomb_um"] = rms_um(errors)
    best = _if_better(trial, errors, smooth, figures)
    if best is None and base is not None and errors is not None:
        best = _holding(trial, base, errors, figures)
    final = None
    if best is not None:
        final = _without_nothing(trial, trial.settled(best.model), best)
    if final is None or best is None:
        base = trial.plain(base)
        statements = (*_late_in_words(base), *base.statements)
        return replace(base, statements=statements, figures={**base.figures, **figures})
    final = widened_where_apart(final, best)
    said = _in_words(final, figures.get("held_out_coulomb_um"), rms_um(trial.errors(best)))
    statements = (said, *_late_in_words(final), *final.statements)
    return replace(final, statements=statements, figures={**final.figures, **figures})


def _if_better(
    trial: _FrictionTrial,
    plain: FloatArray | None,
    smooth: Identification | None,
    figures: dict[str, float],
) -> Identification | None:
    """Smooth friction, where it predicts what was held out clearly better than Coulomb's.

    Or where that has no fit at all: of friction that turns over within 5 mm/s the guide's Coulomb
    friction is not identifiable.
    """
    if smooth is None:
        return None
    errors = trial.errors(smooth)
    figures["held_out_smooth_um"] = rms_um(errors)
    return smooth if plain is None or is_better(errors, plain, _CLEARLY) else None


def _holding(
    trial: _FrictionTrial, base: Identification, plain: FloatArray, figures: dict[str, float]
) -> Identification | None:
    """Best form of friction that holds at rest, where the captures ask for more than Coulomb's."""
    suspected = trial.suspects(base)
    best = _chosen(trial, base.model, plain, figures, suspected=suspected)
    if best is None and suspected:
        best = _set_in(trial, base.model, plain, figures)
    return best


def _chosen(
    trial: _FrictionTrial,
    base: DriveModel,
    plain: FloatArray,
    figures: dict[str, float],
    *,
    suspected: bool,
) -> Identification | None:
    """Best form that predicts what was held out better than Coulomb friction, or None.

    Clearly better; ``suspected`` says that the misfit itself asks for another friction, where
    probably better does if neither channel gets worse.
    """
    first = trial.fitted(trial.shaped(_start(base, _FIRST_GUESS, _NO_ZONE_m)))
    if first is None:
        return None
    whole = [fit for fit in (first, _with_curve_anew(trial, first)) if fit is not None]
    reduced = [_reduced(trial, fit) for fit in whole]
    best = _best(trial, reduced, plain)
    # A part that does not stand out of its own deviation can still be what predicts the rest.
    left_out = [f for f, less in zip(whole, reduced, strict=True) if not less or less[0] is not f]
    kept = _best(trial, [_whole(fit) for fit in left_out], plain)
    if best is None or (kept is not None and is_better(kept[2], best[2], _RATHER)):
        best = kept
    if best is None:
        return None
    found, form, errors = best
    probable = suspected and bool(np.all(np.mean(errors - plain, axis=0) <= 0.0))
    if not is_better(errors, plain, _PROBABLY if probable else _CLEARLY):
        return None
    figures["held_out_lugre_um"] = rms_um(errors)
    # Memory of the guide's friction can only show where there is presliding at the guide. Coarse
    # counts can hide what it leaves around reversals: only the held-out samples tell.
    if form.guide_m > STICK_ZONE_m:
        other = trial.fitted_at_guide(_start(found.model or base, form.with_memory, STICK_ZONE_m))
        if other is not None:
            left = trial.errors(other)
            figures["held_out_gms_um"] = rms_um(left)
            found, errors = (other, left) if is_better(left, errors, _RATHER) else (found, errors)
    for place in ("nut", "motor") if form.rotary_m > STICK_ZONE_m else ():
        other = _turning_over_at(trial, found, place, form)
        if other is not None:
            left = trial.errors(other)
            figures[f"held_out_presliding_{place}_um"] = rms_um(left)
            found, errors = (other, left) if is_better(left, errors, _RATHER) else (found, errors)
    other = _with_turning_curve(trial, found)
    if other is None:
        return found
    left = trial.errors(other)
    figures["held_out_turning_stribeck_um"] = rms_um(left)
    return other if is_better(left, errors, _RATHER) else found


def _with_turning_curve(trial: _FrictionTrial, found: Identification) -> Identification | None:
    """The same with Stribeck's curve at the nut instead of the guide.

    What nut and bearings lose with speed costs torque and hardly moves the table: a curve at the
    guide, which moves both, comes out as nothing beside it or bends the guide's other friction.
    """
    model = found.model
    if "stribeck" in model.effects:
        model = model.without_effect("stribeck")
    return trial.fitted(model.with_effect("stribeck@nut", _curves(model)["stribeck@nut"]))


def _turning_over_at(
    trial: _FrictionTrial, found: Identification, place: str, form: _Form
) -> Identification | None:
    """The same with presliding at nut or motor alone, which else turn over at once like the guide.

    With one distance for both of them a fit gives one all their friction, and from there it does
    not come back: their levels begin even.
    """
    model = found.model
    start = _start(model, _SHARP, STICK_ZONE_m)
    even_Nm = 0.5 * (start.parameters["coulomb.nut_Nm"] + start.parameters["coulomb.motor_Nm"])
    start = start.with_parameters({"coulomb.nut_Nm": even_Nm, "coulomb.motor_Nm": even_Nm})
    turning = {"distance_m": form.rotary_m, "damping_ratio": _FIRST_GUESS.rotary_damping}
    start = start.with_effect(f"presliding@{place}", turning)
    if "stribeck" in model.effects:
        start = start.with_effect("stribeck", model.values_of("stribeck"))
    return trial.fitted(start)


def _curves(model: DriveModel) -> dict[str, dict[str, float]]:
    """Stribeck's curve at guide and at nut, where its fit begins."""
    own, guess = model.parameters, _FIRST_GUESS
    turning_Nm = own["coulomb.nut_Nm"] + own["coulomb.motor_Nm"]
    speed = {"speed_m_per_s": guess.stribeck_m_per_s}
    return {
        "stribeck": {"excess_N": guess.excess_N, **speed},
        "stribeck@nut": {"excess_Nm": _TURNING_FRAC * turning_Nm, **speed},
    }


def _with_curve_anew(trial: _FrictionTrial, found: Identification) -> Identification | None:
    """The same with Stribeck's curve begun anew, beside the distances that were found.

    While those are still far off the curve can run to speeds at which nothing moves, or imitate
    presliding; from there it does not come back.
    """
    guess = _FIRST_GUESS
    anew = replace(
        _form_of(found),
        excess_N=guess.excess_N,
        stribeck_m_per_s=guess.stribeck_m_per_s,
        has_stribeck=True,
    )
    return trial.fitted(_start(found.model, anew, _NO_ZONE_m))


def _reduced(
    trial: _FrictionTrial, found: Identification | None
) -> tuple[Identification, _Form] | None:
    """A fit of every part without those that came out as nothing, and its form; None if all did."""
    if found is None or (form := _form_of(found)).is_coulomb:
        return None
    if form.is_whole:
        return found, form
    # Left out from the start: what came out as nothing can hold the rest in a corner.
    return trial.fitted(_start(found.model, form, STICK_ZONE_m)) or found, form


def _whole(found: Identification) -> tuple[Identification, _Form]:
    """A fit of every part as it is, and its form."""
    return found, replace(_form_of(found), has_stribeck=True)


def _best(
    trial: _FrictionTrial,
    fits: Sequence[tuple[Identification, _Form] | None],
    plain: FloatArray,
) -> tuple[Identification, _Form, FloatArray] | None:
    """The fit with the smallest misfit on what was held out, its form and that misfit."""
    tried = [(*fit, trial.errors(fit[0])) for fit in fits if fit is not None]
    return min(tried, key=lambda fit: _left(fit[2], plain), default=None)


def _left(errors: FloatArray, plain: FloatArray) -> float:
    """Held-out misfit of both channels over that of the base model."""
    if not plain.size:
        return np.inf
    return float(np.sum(np.mean(errors, axis=0) / channel_sizes(plain)))


def _without_nothing(
    trial: _FrictionTrial, final: Identification | None, half: Identification
) -> Identification | None:
    """The fit again without Stribeck friction of which all captures together leave nothing.

    Nothing is what does not stand out of a deviation that reaches to what one half of them gave.
    """
    if final is None:
        return final
    name = next((n for n in final.model.effects if split_name(n)[0] == "stribeck"), None)
    if name is None:
        return final
    judged = widened_where_apart(final, half).parameters
    excess = judged[f"stribeck.excess_{'Nm' if name == 'stribeck@nut' else 'N'}"]
    if excess.value > excess.std:
        return final
    return trial.settled(final.model.without_effect(name)) or final


def _set_in(
    trial: _FrictionTrial, base: DriveModel, plain: FloatArray, figures: dict[str, float]
) -> Identification | None:
    """Coulomb friction with the distances over which it sets in, where held-out samples show it."""
    found = trial.fitted(_start(base, _ONSET, _ANY_m))
    if found is None:
        return None
    errors = trial.errors(found)
    figures["held_out_onset_um"] = rms_um(errors)
    return found if is_better(errors, plain, _CLEARLY) else None


def _asked(model: DriveModel) -> list[str]:
    """Parameters that a trial moves: friction, and what carries its force to the table."""
    names = [spec.name for spec in model.specs]
    return [n for n in names if not n.startswith("chain.") or n in _CARRIES]


def _start(model: DriveModel, form: _Form, least_m: float) -> DriveModel:
    """Base parameters of a model with a form of friction, parts up to ``least_m`` left out."""
    names = [spec.name for spec in DriveModel.base(model.bench).specs]
    start = DriveModel.base(model.bench, {name: model.parameters[name] for name in names})
    if SKEW in model.effects:
        start = start.with_effect(SKEW, model.values_of(SKEW))
    for name, values in form.effects(least_m):
        start = start.with_effect(name, values)
    return start


def _form_of(found: Identification) -> _Form:
    """Form of friction of the first trial, which holds every part."""
    size = {name: estimate.value for name, estimate in found.parameters.items()}
    excess = found.parameters["stribeck.excess_N"]
    return _Form(
        guide_m=size["presliding.distance_m"],
        rotary_m=size["presliding.rotary_m"],
        guide_damping=size["presliding.damping_ratio"],
        rotary_damping=size["presliding.rotary_damping_ratio"],
        excess_N=excess.value,
        stribeck_m_per_s=size["stribeck.speed_m_per_s"],
        has_stribeck=excess.value > _SIGNIFICANT * excess.std,
    )


def _in_words(found: Identification, before_um: float | None, after_um: float) -> str:
    model = found.model
    words = ", ".join(_WORDS[name] for name in model.effects if name in _WORDS)
    what = f"Friction beside Coulomb and viscous: {words}."
    if sets_in_unseen(model):
        over = " and ".join(f"{UM_PER_M * model.parameters[name]:.2g}" for name in _LENGTHS)
        what = (
            f"Coulomb friction sets in over {over} um (guide; nut and motor), which is less than "
            "the motor's encoder resolves: every drive has that, it is no finding."
        )
    alone = "have no fit" if before_um is None else f"{before_um:.2f} um"
    return (
        f"{what} On stretches of the captures that were not fitted this leaves {after_um:.2f} um "
        f"rms of table minus motor, Coulomb and viscous friction alone {alone}. "
        "--friction coulomb keeps to the base model."
    )


def _late_in_words(found: Identification) -> tuple[str, ...]:
    if SKEW_TIME not in found.parameters:
        return ()
    age = found.parameters[SKEW_TIME]
    us, when = age.value * US_PER_S, "after" if age.value > 0.0 else "before"
    return (
        f"The scale is read {abs(us):.1f} us {when} the encoder (channel_skew): the table lags in "
        "proportion to speed by more than any viscous friction that the torque pays for. That lag "
        "is no error of the table, and no law takes it away.",
    )


def sets_in_unseen(model: DriveModel) -> bool:
    """Whether all presliding of a model is shorter than a count of its encoder: no presliding."""
    own = [n for n in model.effects if n in _WORDS]
    lengths_m = [model.parameters[name] for name in _LENGTHS if name in model.parameters]
    return own == ["presliding@all"] and max(lengths_m) <= model.bench.motor_resolution_m
