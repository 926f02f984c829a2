"""Which of the effects in a grown model may be claimed by name.

What lives here: the last doubts about effects that earned their place by the numbers. An effect
that closes the gap only as the imitation of another is part of the model and no finding. May import
``growth`` and ``remainder``.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from pmac_comp.base.units import MM_PER_M
from pmac_comp.physics.diagnose.candidates import amplitude_of
from pmac_comp.physics.diagnose.contenders import Contender, Rules
from pmac_comp.physics.diagnose.growth import Grown, Round
from pmac_comp.physics.diagnose.remainder import Remainder
from pmac_comp.physics.diagnose.result import Estimate
from pmac_comp.physics.model.drive import DriveModel

_LEAST_SIGMAS = 3.0
_WIDE = 1.5  # of the noise floor: what is closed in um is then no chance
# Of the base model's excess: where less is left, forms that explain the rest are right.
_OPEN_SHARE = 0.1
_SHORTEST_DIP_m = 0.15e-3  # dips are half to five millimetres long, presliding 5 to 50 um
_SHORTEST_PRESLIDING_m = 1e-6
_TOO_SMALL = "its size cannot be told from nothing"
_ONSET = "it is so short that the friction is Coulomb friction, which nowhere sets in at once"
_NO_IMITATIONS = frozenset({_TOO_SMALL, _ONSET})


def _far_cable(model: DriveModel) -> str:
    travel = model.bench.travel
    reach_m = (travel.max_mm - travel.min_mm) / MM_PER_M
    middle_m = 0.5 * (travel.max_mm + travel.min_mm) / MM_PER_M
    if abs(model.parameters["cable_drag.centre_m"] - middle_m) < 1.5 * reach_m:
        return ""
    return "its centre lies so far outside the travel that its force is constant: a bias"


def _no_ratio(model: DriveModel) -> str:
    if model.parameters["preload_loss.stiffness_ratio"] > 0.02:
        return ""
    return "its soft zone has no stiffness left: a backlash"


def _no_mode(model: DriveModel) -> str:
    if model.parameters["base_mode.damping_ratio"] < 0.7:
        return ""
    return "its damping leaves no resonance"


def _no_curve(model: DriveModel) -> str:
    if 0.05 < model.parameters["viscous_nonlinear.exponent"] < 0.95:
        return ""
    return "its exponent makes it Coulomb or viscous friction"


def _short_dip(model: DriveModel) -> str:
    if model.parameters["post_reversal_dip.length_m"] > _SHORTEST_DIP_m:
        return ""
    return "its length is that of presliding"


def _onset(model: DriveModel) -> str:
    shortest = max(_SHORTEST_PRESLIDING_m, model.bench.motor_resolution_m)
    return "" if model.parameters["presliding.distance_m"] > shortest else _ONSET


# Corners of an effect's range where it is another effect.
_IMITATIONS: Mapping[str, Callable[[DriveModel], str]] = {
    "cable_drag": _far_cable,
    "preload_loss": _no_ratio,
    "base_mode": _no_mode,
    "viscous_nonlinear": _no_curve,
    "post_reversal_dip": _short_dip,
    "presliding": _onset,
}


def imitation(effect: str, model: DriveModel) -> str:
    """What an effect of a model is in truth, in words; nothing where it is itself."""
    told = _IMITATIONS.get(effect)
    return "" if told is None else told(model)


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


def claims_of(grown: Grown, left: Remainder, estimates: Sequence[Estimate], rules: Rules) -> Claims:
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
        if why:
            withheld[done.accepted.effect] = why
            imitated |= why not in _NO_IMITATIONS and not _narrow(done, done.accepted)
        else:
            claimed.append(done)
    return Claims(tuple(claimed), withheld, imitated)


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
    if _weak(done, accepted, rules) and _nothing(accepted, model, estimates):
        return _TOO_SMALL
    # Small change next to something large and unknown is no finding.
    if left.unexplained and not left.explained:
        return "most of the gap stays open with it"
    rivals = left.open_share > _OPEN_SHARE and accepted.fit_gain < done.screening.rival_gain
    if left.unexplained and rivals:
        return "smooth functions without a name explain more than it does"
    return ""


def _weak(done: Round, accepted: Contender, rules: Rules) -> bool:
    """Whether neither the weighted samples nor the gap in um show an effect beyond doubt."""
    return accepted.fit_gain < rules.overwhelming * rules.material * done.rows_fit and _narrow(
        done, accepted
    )


def _narrow(done: Round, accepted: Contender) -> bool:
    """Whether an effect closes too little of the gap to show in um."""
    return done.gap_um**2 - accepted.gap_um**2 < (_WIDE * done.floor_um) ** 2


def _nothing(accepted: Contender, model: DriveModel, estimates: Sequence[Estimate]) -> bool:
    """Whether the size of an effect that vanishes at zero may be zero."""
    if not accepted.screened.start.linear:
        return False
    effect, place = model.effect(accepted.key)
    size = amplitude_of(effect.name, effect.specs(place))
    name = f"{effect.name}.{size.file_name or size.name}"
    return any(e.name == name and abs(e.value) < _LEAST_SIGMAS * e.std for e in estimates)
