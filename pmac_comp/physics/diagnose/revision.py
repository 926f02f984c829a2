"""Second thoughts about the effects of a grown model.

What lives here: an accepted effect that is another one in truth, acts at further places, or is no
longer needed. May import ``acceptance``, ``contenders`` and ``widening``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from pmac_comp.base.errors import ModelError
from pmac_comp.base.progress import Tell
from pmac_comp.physics.diagnose.acceptance import Round, earned, inseparable
from pmac_comp.physics.diagnose.contenders import (
    ELEMENTARY,
    Contender,
    Ground,
    Rules,
    contend,
    judged,
)
from pmac_comp.physics.diagnose.imitations import as_true_name, in_its_corner, true_name
from pmac_comp.physics.diagnose.lookalikes import alike, justified
from pmac_comp.physics.diagnose.records import gap
from pmac_comp.physics.diagnose.refit import Fitted, Frozen, evaluate, linearised, refit
from pmac_comp.physics.diagnose.screen import Screened
from pmac_comp.physics.diagnose.widening import wider
from pmac_comp.physics.diagnose.workbench import Workbench
from pmac_comp.physics.model.effect import Effect, split_name

# Where a few steps of the others leave so much chi-square per sample, and so much of what an effect
# explained, more steps do not replace it.
_FIRST_LESS, _MORE_LESS = 3, 5
_MISSED, _SLOWLY = 0.5, 0.1
# The same with columns of the whole model, which find at least half of what own ones find.
_PLAINLY = 3.0
_NONE = Frozen((), [])


def accepted_of(rounds: Sequence[Round]) -> tuple[Contender, ...]:
    """Accepted candidates in order."""
    return tuple(r.accepted for r in rounds if r.accepted is not None)


def _start(name: str, done: Round, rounds: Sequence[Round]) -> Screened | None:
    """Best start of an effect in a round, or in the last one that did not have it in its model."""
    for each in (done, *reversed(rounds)):
        if name in each.screening.starts:
            return each.screening.starts[name][0]
    return None


@dataclass(frozen=True)
class Reviser:
    """What every second thought needs: records, candidates, rules and someone to tell.

    Parameters
    ----------
    workbench : Workbench
        Records with their noise.
    library : Mapping of str to Effect
        Candidates.
    rules : Rules
        Figures of the decisions.
    progress : callable
        Told in words what is being done.
    """

    workbench: Workbench
    library: Mapping[str, Effect]
    rules: Rules
    progress: Tell

    def renamed(self, whole: Fitted, rounds: Sequence[Round]) -> tuple[Fitted, list[Round]]:
        """The model with effects in corners of their range replaced by those that they are there.

        A cable whose rest lies far outside the travel is a bias: it would be withheld as a name,
        and what it stands for has one.
        """
        kept = list(rounds)
        for i, done in enumerate(kept):
            name = "" if done.accepted is None else true_name(done.accepted.effect, whole.model)
            present = {split_name(n)[0] for n in whole.model.effects}
            start = _start(name, done, rounds)
            if done.accepted is None or start is None or name in present:
                continue
            self.progress(f"{done.accepted.effect} is {name} here: refitting with that")
            found = self._instead(whole, done, start)
            if found is None or not earned(found[0], found[1], self.rules):
                continue
            tied = tuple(n for n in done.tied if n != name and alike(n, name, self.library))
            others = (c for c in done.contenders if c.effect != name)
            kept[i] = replace(done, accepted=found[0], tied=tied, contenders=(found[0], *others))
            whole = found[0].fitted
        return whole, kept

    def likened(self, whole: Fitted, rounds: Sequence[Round]) -> list[Round]:
        """Rounds tied with what their effect is in its corner, where that does as well.

        What acts in events has minima of its own: as a candidate it began far from the size that
        the other one found, and lost by where it got stuck.
        """
        kept = list(rounds)
        for i, done in enumerate(kept):
            twin = self._twin(whole, done, rounds)
            if twin is not None:
                others = (c for c in done.contenders if c.effect != twin.effect)
                kept[i] = replace(done, tied=(*done.tied, twin.effect), contenders=(*others, twin))
        return kept

    def _twin(self, whole: Fitted, done: Round, rounds: Sequence[Round]) -> Contender | None:
        """What a round's effect is in its corner, if it earns the place and the runs leave it."""
        if done.accepted is None:
            return None
        name = in_its_corner(done.accepted.effect)
        present = {split_name(n)[0] for n in whole.model.effects}
        start = _start(name, done, rounds)
        known = name in {*present, *done.tied}
        if start is None or known or not justified(done.accepted.effect, name):
            return None
        self.progress(f"refitting with {name} of that size instead")
        found = self._instead(whole, done, start)
        if found is None or not earned(found[0], found[1], self.rules):
            return None
        rows = Ground.of(self.workbench, whole, self.library).rows
        now = replace(done.accepted, fitted=whole)
        return found[0] if inseparable(now, found[0], rows, self.rules) else None

    def _instead(
        self, whole: Fitted, done: Round, start: Screened
    ) -> tuple[Contender, Round] | None:
        """Another effect in the place of a round's, the round judged against neither of them."""
        if done.accepted is None:
            return None
        part = self.workbench.fitting_bench()
        bare = whole.model.without_effect(done.accepted.effect)
        try:
            less = evaluate(
                self.workbench, refit(part, evaluate(part, bare), rounds=_MORE_LESS).model
            )
        except ModelError:
            return None
        ground = Ground.of(self.workbench, less, self.library)
        tried = contend(ground, replace(start, own_SI={}), Frozen((), []))
        tried += self._as_large(ground, whole, done.accepted.effect, start)
        left = gap(self.workbench.calm_records, less.model, self.workbench.executor)
        best = max(tried, key=lambda c: c.gain, default=None)
        return None if best is None else (best, done.judged_against(left))

    def _as_large(
        self, ground: Ground, whole: Fitted, effect: str, start: Screened
    ) -> list[Contender]:
        """The other effect at the size of the one in its corner, all else as it was beside that."""
        part = self.workbench.fitting_bench()
        same = as_true_name(effect, whole.model)
        if start.start.effect not in {split_name(n)[0] for n in same.effects}:
            return []
        try:
            fitted = refit(part, evaluate(part, same))
        except ModelError:
            return []
        return [judged(ground, start, evaluate(self.workbench, fitted.model))]

    def widened(self, whole: Fitted, rounds: Sequence[Round]) -> tuple[Fitted, list[Round]]:
        """The model with accepted effects at further places where those earn themselves."""
        kept = list(rounds)
        for i, done in enumerate(kept):
            if done.accepted is None or not self.library[done.accepted.effect].joint_places:
                continue
            found = wider(Ground.of(self.workbench, whole, self.library), done.accepted)
            left = gap(self.workbench.calm_records, whole.model, self.workbench.executor)
            if found is None or not earned(found, done.judged_against(left), self.rules):
                continue
            self.progress(f"{done.accepted.effect} acts at further places: {found.key}")
            whole = found.fitted
            both = replace(
                found,
                fit_gain=found.fit_gain + done.accepted.fit_gain,
                judged_gain=found.judged_gain + done.accepted.judged_gain,
            )
            kept[i] = replace(done, accepted=both)
        return whole, kept

    def pruned(self, whole: Fitted, rounds: Sequence[Round]) -> tuple[Fitted, list[Round]]:
        """The model less the effects that no longer earn their place beside the later ones.

        What was added first stood for everything that was missing then; once its true cause is in
        the model, an imitation has nothing left to explain.
        """
        kept = list(rounds)
        while accepted_of(kept):
            alone = len(accepted_of(kept)) == 1
            shared = _NONE if alone else self._columns(whole)
            for i, done in enumerate(kept):
                certain = alone and self._beyond_doubt(done)
                less = None if certain else self._without(whole, done, shared)
                if less is not None:
                    self.progress("an effect is no longer needed beside those found after it")
                    kept[i] = replace(done, accepted=None, tied=())
                    whole = less
                    break
            else:
                break
        return whole, kept

    def _beyond_doubt(self, done: Round) -> bool:
        """Whether a round's effect earned so much that no refit of the others replaces it."""
        least = self.rules.overwhelming * self.rules.material * done.rows_fit
        return done.accepted is not None and done.accepted.fit_gain > least

    def _columns(self, whole: Fitted) -> Frozen:
        """What every parameter of the model does, once for all of its effects."""
        part = self.workbench.fitting_bench()
        _, directions, columns = linearised(part, evaluate(part, whole.model), None)
        return Frozen(tuple(directions), columns)

    def _without(self, whole: Fitted, done: Round, shared: Frozen = _NONE) -> Fitted | None:
        """The model refitted without a round's effect, or None where that earns its place.

        Elementary friction stays: every drive has it, and a flexible form can always stand in for
        it. Columns of the whole model, if there are any, tell most of the effects that are needed.
        """
        if done.accepted is None or done.accepted.effect in ELEMENTARY:
            return None
        part = self.workbench.fitting_bench()
        try:
            bare = whole.model.without_effect(done.accepted.effect)
            begun, had = evaluate(part, bare), whole.chi2
            limit = max(_MISSED * done.rows_fit, _SLOWLY * (begun.chi2 - had))
            if shared.directions:
                quick = refit(part, begun, frozen=shared, rounds=_FIRST_LESS)
                if quick.chi2 - had > _PLAINLY * limit:
                    return None
            fitted = refit(part, begun, rounds=_FIRST_LESS)
            if fitted.chi2 - had > limit:
                return None
            less = evaluate(self.workbench, refit(part, fitted, rounds=_MORE_LESS).model)
        except ModelError:
            return None
        left = gap(self.workbench.calm_records, less.model, self.workbench.executor)
        back = judged(Ground.of(self.workbench, less, self.library), done.accepted.screened, whole)
        needed = left.position_um > self.rules.widened * back.gap_um
        return None if needed or earned(back, done.judged_against(left), self.rules) else less
