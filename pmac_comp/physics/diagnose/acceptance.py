"""By which rules a candidate is accepted, or tied with look-alikes.

What lives here: a round of the growth loop and what is asked of its best candidate. The rules'
figures are collected in ``Rules``. May import ``contenders``, ``imitations`` and ``lookalikes``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from pmac_comp.base.arrays import FloatArray
from pmac_comp.physics.diagnose.contenders import ELEMENTARY, Contender, Rules
from pmac_comp.physics.diagnose.imitations import true_name
from pmac_comp.physics.diagnose.lookalikes import alike, exact_twins, justified
from pmac_comp.physics.diagnose.records import Gap
from pmac_comp.physics.diagnose.refit import Fitted
from pmac_comp.physics.diagnose.screen import Screening
from pmac_comp.physics.diagnose.statistics import studentised
from pmac_comp.physics.model.effect import Effect, split_name

_FAR_MORE = 4.0
# Laws of a contact that softens (a series in the deflection, one in the force, Hertz's own) leave
# of each other, refitted, so much of what softening does: a corner may win by that among them.
_LAWS = 0.3
# Effects that are a quantity of the bench file at another value.
_STATED = frozenset({"payload", "actuator_delay", "current_bandwidth"})


@dataclass(frozen=True)
class Round:
    """One round of the loop."""

    before: Fitted
    screening: Screening
    contenders: tuple[Contender, ...]
    accepted: Contender | None
    tied: tuple[str, ...]
    rows_fit: float
    rows_judge: float
    gap_um: float
    floor_um: float
    torque_Nm: float | None = None

    def judged_against(self, left: Gap) -> "Round":
        """The round as if it had begun with such a gap."""
        return replace(self, gap_um=left.position_um, torque_Nm=left.torque_Nm)


def best(
    worthy: Sequence[Contender], contenders: Sequence[Contender], gap_um: float
) -> Contender | None:
    """The best candidate, if it earned its place, or one that closes far more of the gap.

    Slow effects are small to a whitener that expects slow noise; what they close in um is not.
    """
    if not worthy:
        return None

    def closed_um2(contender: Contender) -> float:
        return gap_um**2 - contender.gap_um**2

    widest = max(worthy, key=closed_um2)
    if closed_um2(widest) > _FAR_MORE * max(closed_um2(contenders[0]), 0.0):
        return widest
    return contenders[0] if contenders[0] in worthy else None


def earned(winner: Contender, done: Round, rules: Rules) -> bool:
    """Whether a candidate is worth a name: material, held out, and not by chance."""
    if winner.p_value >= rules.p_value or winner.bic_gain <= 0.0:
        return False
    if winner.gap_um > rules.widened * done.gap_um:
        return False
    return _material(winner, done, rules)


def _material(winner: Contender, done: Round, rules: Rules) -> bool:
    """Whether what a candidate changes is large enough, in one of the ways in which effects are."""
    fit, judged = winner.fit_gain / done.rows_fit, winner.judged_gain / done.rows_judge
    if min(fit, judged) > rules.material:
        return True
    # Runs for judging need not excite what the fitting runs show beyond doubt.
    if fit > rules.overwhelming * rules.material and judged > 0.0:
        return True
    # Slow effects are large in um, or in the torque that an integrator has to find, and small to a
    # whitener that expects slow noise.
    if judged > 0.0 and _torque_closed(winner, done) > rules.material_torque:
        return True
    certain = _restates_the_bench(winner, done) and winner.p_value < rules.p_certain
    if certain and min(fit, judged) > rules.material_certain:
        return True
    closed_um2 = done.gap_um**2 - winner.gap_um**2
    return (
        min(fit, judged) > 0.1 * rules.material
        and closed_um2 > (rules.material_gap * done.floor_um) ** 2
    )


def _restates_the_bench(winner: Contender, done: Round) -> bool:
    """Whether a candidate is a quantity of the bench file at another value, and the first name.

    What a form of friction idealises can look like another form, and what a first effect leaves
    like a second one; neither looks like a mass or a delay.
    """
    present = {split_name(n)[0] for n in done.before.model.effects}
    return winner.effect in _STATED and present <= ELEMENTARY


def _torque_closed(winner: Contender, done: Round) -> float:
    """What a candidate closes of the torque's gap on judging runs, over what it leaves, squared."""
    if done.torque_Nm is None or winner.torque_Nm is None or winner.torque_Nm <= 0.0:
        return 0.0
    return (done.torque_Nm / winner.torque_Nm) ** 2 - 1.0


def tied_with(
    winner: Contender,
    contenders: Sequence[Contender],
    library: Mapping[str, Effect],
    rows: FloatArray,
    rules: Rules,
    *,
    gap_um: float,
) -> tuple[str, ...]:
    """Look-alikes that the data cannot tell from the winner; ``rows`` of shape (blocks,)."""
    tied = [
        other.effect
        for other in contenders
        if other.effect != winner.effect
        and alike(other.effect, winner.effect, library)
        # In that corner of its range it is the winner, not a rival of it.
        and true_name(other.effect, other.fitted.model) != winner.effect
        and (inseparable(winner, other, rows, rules) or _bends(winner, other, gap_um))
    ]
    tied += [name for name in exact_twins(winner.effect) if name not in tied]
    return tuple(tied)


def inseparable(winner: Contender, other: Contender, rows: FloatArray, rules: Rules) -> bool:
    """Whether runs leave open which of two look-alikes it is; ``rows`` of shape (blocks,)."""
    lost = other.fitted.blocks - winner.fitted.blocks
    per_row = float(lost.sum()) / float(rows.sum())
    if not justified(winner.effect, other.effect):
        close = other.gain > rules.tie_share * winner.gain
        return close and per_row < rules.tie_material and studentised(lost) < rules.tie_z
    return per_row < rules.tie_material or studentised(lost) < rules.tie_z


def _bends(winner: Contender, other: Contender, gap_um: float) -> bool:
    """Whether a joint that gives way beyond a force may as well soften towards it.

    Both are a nut with too little preload for the forces: only how sharply it gives way differs.
    """
    corner = winner.key == "preload_loss@beyond" and other.effect == "axial_stiffness_nonlinear"
    closed_um2 = gap_um**2 - winner.gap_um**2
    return corner and other.gap_um**2 - winner.gap_um**2 < _LAWS**2 * closed_um2
