"""An accepted effect that acts at more places than where it was found.

What lives here: the step from one place to several with a value of each kind. May import
``contenders`` and ``refit``.

A candidate enters at one place, since that is what a first look can tell. Friction that grips over
a distance does so wherever parts rub: at the guide and, with a distance of its own, at nut and
motor. The second place has to earn itself as any effect has to.
"""

from dataclasses import replace

from pmac_comp.base.errors import ModelError
from pmac_comp.physics.diagnose.contenders import Contender, Ground, judged
from pmac_comp.physics.diagnose.refit import Fitted, evaluate, refit
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.effect import split_name

_FIRST_ROUNDS = 2
_ROUNDS = 4


def wider(ground: Ground, accepted: Contender) -> Contender | None:
    """The best form of an accepted effect at several places, judged against the model with one.

    Parameters
    ----------
    ground : Ground
        The model that holds the effect at one place.
    accepted : Contender
        As it was accepted.

    Returns
    -------
    Contender or None
        None where the effect has no such form, has it already, or none can be simulated.
    """
    effect, place = split_name(accepted.key)
    joint = ground.library[effect].joint_places
    if place in joint or ground.before.model.is_rigid:
        return None
    begun = [
        (fitted, f"{effect}@{other}")
        for other in joint
        for start in _starts(ground, effect, other)
        if (fitted := _begun(ground, start)) is not None
    ]
    if not begun:
        return None
    fitted, key = min(begun, key=lambda b: b[0].chi2)
    fitted = refit(ground.workbench.fitting_bench(), fitted, rounds=_ROUNDS)
    found = judged(ground, accepted.screened, evaluate(ground.workbench, fitted.model))
    return replace(found, key=key)


def _starts(ground: Ground, effect: str, place: str) -> list[DriveModel]:
    """The model with the effect at several places: from its present values, and from usual ones."""
    model = ground.before.model
    key = f"{effect}@{place}"
    library = {effect: ground.library[effect]}
    bare = model.without_effect(effect)
    usual = bare.with_effect(key, library=library)
    names = [s.name for s in usual.specs if s.name.startswith(f"{effect}.")]
    present = {n: model.parameters[n] for n in names if n in model.parameters}
    return [usual.with_parameters(present), usual]


def _begun(ground: Ground, start: DriveModel) -> Fitted | None:
    """A few steps from a start, enough to tell which start is the better one."""
    part = ground.workbench.fitting_bench()
    try:
        return refit(part, evaluate(part, start), rounds=_FIRST_ROUNDS)
    except ModelError:
        return None
