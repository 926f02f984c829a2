"""Which of the effects in a grown model may be claimed by name.

What lives here: the last doubts about effects that earned their place by the numbers. An effect
that closes the gap only as the imitation of another is part of the model and no finding. May import
``growth`` and ``remainder``.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from pmac_comp.base.units import US_PER_S
from pmac_comp.physics.diagnose.acceptance import Round
from pmac_comp.physics.diagnose.candidates import amplitude_of
from pmac_comp.physics.diagnose.contenders import Contender, Rules
from pmac_comp.physics.diagnose.growth import Grown
from pmac_comp.physics.diagnose.imitations import ONSET, imitation
from pmac_comp.physics.diagnose.lookalikes import tilt_um_per_m_per_s2, windup_lags_s
from pmac_comp.physics.diagnose.refit import evaluate, refit
from pmac_comp.physics.diagnose.remainder import Remainder
from pmac_comp.physics.diagnose.result import Estimate, Finding
from pmac_comp.physics.identify.result import Z95
from pmac_comp.physics.model import slots
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.effect import split_name

_LEAST_SIGMAS = 3.0
_WIDE = 1.5  # of the noise floor: what is closed in um is then no chance
# Of the base model's excess: where less is left, forms that explain the rest are right.
_OPEN_SHARE = 0.1
_MOST_BESIDE = 2  # effects that are claimed beside much that has no name, whatever each closes
_BULK = (
    0.5  # of the gap in um that an effect met: more is closed by what is there, on real data too
)
_ALONE_ROUNDS = 3
_LEAST_WITHIN = 0.02  # of the time that runs spend below the force of a corner that they cross
_TILT = frozenset({"coupling_windup", "channel_skew"})
_TOO_SMALL = "its size cannot be told from nothing"
_NO_IMITATIONS = frozenset({_TOO_SMALL, ONSET})

# Effects that are another stiffness than the bench file states, and show in the table's lag alone.
_STIFFNESSES = {
    "coupling_windup": (slots.K_COUPLING, "chain.torsional_stiffness_Nm_per_rad"),
    "axial_stiffness_position": (slots.EA, "chain.screw_rigidity_N"),
}


@dataclass(frozen=True)
class Claims:
    """What is claimed, and what is not although it is in the model.

    Parameters
    ----------
    rounds : tuple of Round
        Rounds whose effect is claimed.
    withheld : Mapping of str to str
        Effects that are not claimed, and why.
    imitated : bool
        Whether one of those stands for something that the library cannot name; others are merely
        too small to tell from nothing, or close no more than the onset of friction leaves open.
    """

    rounds: tuple[Round, ...]
    withheld: Mapping[str, str]
    imitated: bool

    @property
    def effects(self) -> tuple[str, ...]:
        """Claimed effects in the order added."""
        return tuple(r.accepted.effect for r in self.rounds if r.accepted is not None)


def claims_of(
    grown: Grown,
    left: Remainder,
    estimates: Sequence[Estimate],
    rules: Rules,
    findings: Sequence[Finding] = (),
    *,
    beyond: Mapping[str, str] = MappingProxyType({}),
    apart: Collection[str] = (),
) -> Claims:
    """Effects that may be claimed by name.

    Parameters
    ----------
    grown : Grown
        Result of the growth loop.
    left : Remainder
        What it leaves.
    estimates : sequence of Estimate
        Parameters of the accepted effects.
    rules : Rules
        Figures of the decisions.
    findings : sequence of Finding
        Known parameters that the data places outside their tolerance.
    beyond : Mapping of str to str
        Effects whose corner no run crosses, and what they are then.
    apart : collection of str
        Effects whose size would have to differ from run to run.

    Returns
    -------
    Claims
    """
    claimed: list[Round] = []
    withheld: dict[str, str] = {}
    imitated = False
    for done in grown.rounds:
        if done.accepted is None:
            continue
        why = _doubt(done, done.accepted, grown.final.model, left, estimates, rules)
        if done.accepted.effect in beyond:
            why = beyond[done.accepted.effect]
        if done.accepted.effect in _TILT and not why:
            why = _tilted(grown, estimates)
        if done.accepted.effect in apart and not why:
            why = "its size would have to differ from run to run"
        many = left.missed and len(grown.accepted) > _MOST_BESIDE
        if many and not why and done.accepted.gap_um > (1.0 - _BULK) * done.gap_um:
            why = (
                f"{len(grown.accepted)} effects together still miss the runs not used for fitting "
                "by more than twice the noise, and it closes the smaller part of what it met: they "
                "may share what none of them is"
            )
        if left.visible and findings and not why:
            # Names that need quantities of the bench file to be wrong, and explain it not even
            # then, share among them what is none of them.
            why = f"beside it {_listed(findings)} would have to leave the tolerance"
        if why:
            withheld[done.accepted.effect] = why
            imitated |= why not in _NO_IMITATIONS and not _narrow(done, done.accepted)
        else:
            claimed.append(done)
    imitated |= not _NO_IMITATIONS.issuperset(withheld.values()) and _unclaimed(grown, claimed)
    return Claims(tuple(claimed), withheld, imitated)


def named_alone(grown: Grown, claims: Claims) -> Grown | None:
    """The growth as if it had ended with the claimed effects.

    What is not claimed stays in the grown model and shares with them what each alone would carry:
    on real data Coulomb friction is 19 N alone and anything beside three of those. None where all
    are claimed, or where one that is not came before.
    """
    first = grown.accepted[: len(claims.effects)]
    if not claims.withheld or not first or tuple(c.effect for c in first) != claims.effects:
        return None
    part = grown.workbench.fitting_bench()
    point = refit(part, evaluate(part, first[-1].fitted.model), rounds=_ALONE_ROUNDS)
    final = evaluate(grown.workbench, point.model)
    return replace(grown, final=final, rounds=claims.rounds, open_SI={})


def unreached(grown: Grown) -> Mapping[str, str]:
    """Effects with a corner in the joint's spring that no run crosses, and what they are then.

    It lies beyond the force of every run, or, of a joint that gives way beyond it, so near to none
    that the runs stay on its far side.
    """
    model = grown.final.model
    key = next((n for n in model.effects if split_name(n)[0] == "preload_loss"), "")
    if not key:
        return {}
    vector = model.kernel_vector()
    corner_N = vector[slots.K_NUT] * vector[slots.SOFT_RATIO] * vector[slots.SOFT_HALF]
    forces_N = [np.abs(r.response(model).joint_force_N) for r in grown.workbench.records]
    within = float(np.mean(np.concatenate(forces_N) <= corner_N))
    # A zone around zero force may be narrow in force and wide in deflection: play has none.
    passed = split_name(key)[1] != "beyond" or within > _LEAST_WITHIN
    if passed and within < 1.0:
        return {}
    softer = vector[slots.SOFT_RATIO] if within == 1.0 else 1.0
    return {"preload_loss": _another_spring(model, float(softer * vector[slots.K_NUT]))}


def _another_spring(model: DriveModel, nut_N_per_m: float) -> str:
    """A joint without a corner in words: bearing and nut in series, beside the bench file's."""
    why = "no run crosses its corner, so what shows is a spring of another stiffness"
    spec = model.spec("chain.axial_stiffness_N_per_m")
    bearing_N_per_m = float(model.kernel_vector()[slots.K_BEARING])
    series_N_per_m = 1.0 / (1.0 / bearing_N_per_m + 1.0 / nut_N_per_m) if nut_N_per_m else 0.0
    return (
        f"{why}: {spec.to_file(series_N_per_m):.3g} {spec.file_unit or spec.unit} of bearing and "
        f"nut in series, where the bench file has {spec.file_name or spec.name} = "
        f"{spec.to_file(spec.nominal):.4g}; if that figure is wrong, correct it first"
    )


def _tilted(grown: Grown, estimates: Sequence[Estimate]) -> str:
    """Why a coupling that winds up beside a skew is neither, or nothing.

    What passes a coupling is the torque of inertia and friction. Where a skew gives back the lag
    that viscous friction makes in it, the table lags by the acceleration alone.
    """
    model = grown.final.model
    if not {c.effect for c in grown.accepted} >= _TILT:
        return ""
    least_us, most_us = (US_PER_S * lag for lag in windup_lags_s(model))
    given_back = any(
        e.name == "channel_skew.time_us"
        and e.value < -Z95 * e.std
        and least_us - Z95 * e.std < -e.value < most_us + Z95 * e.std
        for e in estimates
    )
    if not given_back:
        return ""
    return (
        f"the skew takes back the {least_us:.2g} to {most_us:.2g} us of lag that viscous friction "
        "makes in such a coupling, so that the table lags by its acceleration alone, as where a "
        f"table, scale head or bracket tilts by {tilt_um_per_m_per_s2(model):.2g} um per m/s2"
    )


def _listed(findings: Sequence[Finding]) -> str:
    return " and ".join(f.parameter.partition(".")[2] or f.parameter for f in findings)


def _doubt(
    done: Round,
    accepted: Contender,
    model: DriveModel,
    left: Remainder,
    estimates: Sequence[Estimate],
    rules: Rules,
) -> str:
    """Why an effect may not be claimed, or nothing."""
    if why := imitation(accepted.effect, model):
        return why
    # Where something stays open, effects that lean on one another close much and are still none.
    doubtful = left.unexplained or _weak(done, accepted, rules)
    if doubtful and _nothing(accepted, model, estimates):
        return _TOO_SMALL
    # A stiffness beyond its tolerance that leaves something all the same is the part of that which
    # goes with the force: a scale on a bracket, a carriage that pitches.
    if left.unexplained and (stated := _stiffness_out(accepted.effect, model)):
        return f"{stated} of the bench file would have to be wrong, and something is left even then"
    # Small change next to something large and unknown is no finding.
    if left.unexplained and not left.explained:
        return "most of the gap stays open with it"
    rivals = left.open_share > _OPEN_SHARE and accepted.fit_gain < done.screening.rival_gain
    if left.unexplained and rivals:
        return "smooth functions without a name explain more than it does"
    return ""


def _stiffness_out(effect: str, model: DriveModel) -> str:
    """Stiffness of the bench file that an effect takes out of its tolerance; nothing if none."""
    if effect not in _STIFFNESSES:
        return ""
    slot, name = _STIFFNESSES[effect]
    spec = model.spec(name)
    off = abs(float(model.kernel_vector()[slot]) - spec.nominal)
    within = off <= abs(spec.nominal) * (spec.tolerance_frac or 0.0)
    return "" if within else spec.file_name or spec.name


def _weak(done: Round, accepted: Contender, rules: Rules) -> bool:
    """Whether neither the weighted samples nor the gap in um show an effect beyond doubt."""
    return accepted.fit_gain < rules.overwhelming * rules.material * done.rows_fit and _narrow(
        done, accepted
    )


def _narrow(done: Round, accepted: Contender) -> bool:
    """Whether an effect closes too little of the gap to show in um."""
    return done.gap_um**2 - accepted.gap_um**2 < (_WIDE * done.floor_um) ** 2


def _unclaimed(grown: Grown, claimed: Sequence[Round]) -> bool:
    """Whether more than chance was closed of the gap than those did that are claimed.

    What an effect closes is measured in its round. One that came late and outlived the first, which
    then was not needed beside it, closes what that one closed.
    """
    first, last = grown.rounds[0], grown.rounds[-1]
    left_um = last.gap_um if last.accepted is None else last.accepted.gap_um
    closed = sum(d.gap_um**2 - d.accepted.gap_um**2 for d in claimed if d.accepted is not None)
    return first.gap_um**2 - left_um**2 - closed > (_WIDE * last.floor_um) ** 2


def _nothing(accepted: Contender, model: DriveModel, estimates: Sequence[Estimate]) -> bool:
    """Whether the size of an effect that vanishes at zero may be zero."""
    if not accepted.screened.start.linear:
        return False
    effect, place = model.effect(accepted.key)
    size = amplitude_of(effect.name, effect.specs(place))
    name = f"{effect.name}.{size.file_name or size.name}"
    return any(e.name == name and abs(e.value) < _LEAST_SIGMAS * e.std for e in estimates)
