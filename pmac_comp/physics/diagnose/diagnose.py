"""Find where simulation and measurement disagree, name the missing effect, show the gap shrink.

What lives here: the door of the package and the assembly of the answer. May import the rest of
this package.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from pmac_comp.base.errors import NotIdentifiable
from pmac_comp.base.progress import Tell
from pmac_comp.base.threads import working
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.diagnose.by_run import told_by_run
from pmac_comp.physics.diagnose.claims import Claims, claims_of, named_alone, unreached
from pmac_comp.physics.diagnose.clipping import told_of_clipping
from pmac_comp.physics.diagnose.clocks import SLOW
from pmac_comp.physics.diagnose.constancy import inconstant
from pmac_comp.physics.diagnose.contenders import Rules
from pmac_comp.physics.diagnose.control_law import told_of_law
from pmac_comp.physics.diagnose.estimates import Told, estimates_of, possible, pulled
from pmac_comp.physics.diagnose.growth import Grown, grow
from pmac_comp.physics.diagnose.localise import Region, localise
from pmac_comp.physics.diagnose.lookalikes import (
    alike,
    separating_experiment,
    telling_experiment,
    unlisted_twins,
)
from pmac_comp.physics.diagnose.onset import told, without_onset
from pmac_comp.physics.diagnose.records import Gap, gap, prepare
from pmac_comp.physics.diagnose.remainder import Remainder, remainder_of
from pmac_comp.physics.diagnose.result import (
    Diagnosis,
    Estimate,
    Evidence,
    Finding,
    Growth,
    SeparatingExperiment,
    Trace,
    Verdict,
)
from pmac_comp.physics.diagnose.simpler import single_cause, stretched
from pmac_comp.physics.diagnose.statistics import sign_flip_p
from pmac_comp.physics.diagnose.torque_place import told_by_torque
from pmac_comp.physics.diagnose.words import Rival, Story, statements_of
from pmac_comp.physics.diagnose.workbench import Workbench, split
from pmac_comp.physics.identify.rigid import rigid_start
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.effect import Effect, effect_library, split_name

_CLIPS = "torque_saturation"
_RULED_OUT = 0.05  # largest p-value at which a look-alike counts as ruled out
# Forms of friction for prediction: a second one of presliding, whose phenomenon is named once, and
# one that a drive shows by creeping at rest, which `identify` looks for.
_FORMS = frozenset({"presliding_gms", "smooth_coulomb"})


def diagnose(
    captures: Sequence[Capture],
    bench: Bench,
    *,
    validate: Sequence[Capture] = (),
    model: DriveModel | None = None,
    effects: Mapping[str, Effect] | None = None,
    progress: Tell | None = None,
    rules: Rules | None = None,
) -> Diagnosis:
    """What the base model lacks on these captures.

    Parameters
    ----------
    captures : sequence of Capture
        Runs for fitting, from rest or cut out of a motion.
    bench : Bench
        What is known of the drive.
    validate : sequence of Capture
        Runs for judging; without any, part of ``captures`` is held back.
    model : DriveModel or None
        Base model instead of that of the bench.
    effects : Mapping of str to Effect or None
        Candidates instead of the built-in library (a user's own are added to it by the caller).
    progress : callable or None
        Told in words what is being done.
    rules : Rules or None
        Figures of the decisions.

    Returns
    -------
    Diagnosis

    Raises
    ------
    NotIdentifiable
        No capture, or one that cannot be used.
    ModelError
        The base model cannot be simulated on these captures.

    Source
    ------
    Grow one effect at a time as Bacher and Madsen (2011), with whole closed-loop runs instead of
    innovations, look-alikes kept as ties and flexible rivals as the bound of what has no name.
    """
    if not captures:
        raise NotIdentifiable(
            "There is no capture to diagnose.",
            code="PC-DIA-002",
            hint="Give at least one capture; three or more places and speeds tell more.",
        )
    tell = progress or _silent
    rules = rules or Rules()
    start = DriveModel.base(bench) if model is None else without_onset(model)
    library = _candidates(effects, start)
    fit = prepare([*captures, *validate], bench, prefix="capture")
    records, judges = fit[: len(captures)], fit[len(captures) :]
    start = rigid_start(captures, bench, start)
    with working() as executor:
        workbench = Workbench(fit, split(records, judges), executor)
        _refuse_unjudged(workbench)
        grown = grow(workbench, start, library, rules, tell)
        tell("measuring what is left")
        told_of = Told.of(grown)
        estimates, findings = estimates_of(grown, told_of, rules.material)
        apart = inconstant(grown, told_of)
        beyond = unreached(grown)
        doubted = bool(beyond) or (not grown.accepted and stretched(grown.final.model))
        simpler = single_cause(grown, findings, doubted=doubted)
        if simpler is not None:
            grown, estimates, findings = simpler[0], (), (simpler[1],)
        alone = simpler is not None
        left = remainder_of(grown, bench, rivals_apply=not alone)
        found = _Found(grown, left, estimates, findings, alone, beyond, apart)
        return _assembled(found, library, bench, rules)


def _silent(text: str) -> None:
    """Progress that nobody listens to."""


def _refuse_unjudged(workbench: Workbench) -> None:
    """What is judged where nothing moves is judged by nothing."""
    fitted, judged = workbench.telling([r.usable for r in workbench.records])
    if fitted and judged:
        return
    raise NotIdentifiable(
        "The runs cannot be diagnosed: too few samples after the first motion are left to "
        f"{'judge by' if fitted else 'fit'}.",
        code="PC-DIA-017",
        hint="Without --validate two sixths of each capture are held back for judging: give "
        "captures that move for most of their time, or more of them.",
    )


def _broken_off(grown: Grown, rules: Rules) -> tuple[str, ...]:
    """That as many effects were found as are sought, where that ended the search."""
    if len(grown.accepted) < rules.most_effects:
        return ()
    return (
        f"The search ended with {rules.most_effects} effects, as many as are sought in one "
        "diagnosis; give the grown model as --model to look for more.",
    )


def _candidates(effects: Mapping[str, Effect] | None, start: DriveModel) -> dict[str, Effect]:
    """Effects that may be added: the library, less what the model already holds."""
    present = {split_name(name)[0] for name in start.effects}
    offered = effect_library() if effects is None else effects
    return {
        name: effect
        for name, effect in offered.items()
        if name not in present and name not in _FORMS
    }


@dataclass(frozen=True)
class _Found:
    """What the loop found.

    ``alone``: one quantity of the bench file in place of effects; ``beyond`` and ``apart``: effects
    with a corner that no run crosses, and with another size in every run.
    """

    grown: Grown
    left: Remainder
    estimates: tuple[Estimate, ...]
    findings: tuple[Finding, ...]
    alone: bool
    beyond: Mapping[str, str]
    apart: frozenset[str]


def _assembled(
    found: _Found, library: Mapping[str, Effect], bench: Bench, rules: Rules
) -> Diagnosis:
    grown, left, estimates, findings = found.grown, found.left, found.estimates, found.findings
    executor = grown.workbench.executor
    judging = grown.workbench.judging_records
    before = gap(judging, grown.base.model, executor)
    after = gap(judging, grown.final.model, executor)
    # One quantity that leaves nothing proved was moved by nothing but itself.
    doubtful = left.unexplained or (left.visible and not found.alone)
    findings = pulled(findings) if doubtful else findings
    claims = claims_of(
        grown, left, estimates, rules, findings, beyond=found.beyond, apart=found.apart
    )
    tied = _tied_groups(claims)
    named = _named(claims, tied)
    # What the bench file knows cannot be what the data asks for: a name beside that is a stand-in.
    unknown = left.unexplained or claims.imitated or bool(findings)
    verdict = _verdict(named, tied, unknown=unknown)
    where = _where(grown, bench)
    alone = named_alone(grown, claims)
    if alone is not None:
        estimates, _ = estimates_of(alone, Told.of(alone), rules.material)
    estimates = tuple(e for e in estimates if e.name.partition(".")[0] in claims.effects)
    experiment = _experiment(tied, left, grown, library)
    released, impossible = possible(grown.final.model, findings)
    return Diagnosis(
        verdict=verdict,
        named=named,
        tied=tied,
        evidence=_evidence(grown, library),
        where=where,
        gap_before_um=before.position_um,
        gap_after_um=after.position_um,
        torque_gap_before_Nm=before.torque_Nm,
        torque_gap_after_Nm=after.torque_Nm,
        noise_floor_um=left.noise_floor_um,
        gap_channel="table" if grown.workbench.channels > 1 else "motor",
        residual=_residual(left, where, verdict),
        separating_experiment=experiment,
        findings=released,
        statements=(
            *told_of_law(grown.workbench.records, bench),
            *(() if _CLIPS in claims.effects else told_of_clipping(grown.workbench.records, bench)),
            *statements_of(
                Story(
                    verdict,
                    named,
                    tied,
                    estimates,
                    where,
                    before,
                    after,
                    left,
                    ruled_out(grown, library) if named else (),
                    library,
                    claims.withheld,
                    alone=alone is not None,
                    restated=findings[0].text if found.alone else "",
                    forms=grown.final.model.effects,
                )
            ),
            *impossible,
            *_broken_off(grown, rules),
            *told_by_run(grown, left),
            *told_by_torque(grown, left),
            *told(grown.final.model, claims.effects),
            *unlisted_twins(grown.final.model, claims.effects),
            *_undated(grown, left, claims),
        ),
        model=grown.final.model,
        estimates=estimates,
        path=_path(grown, before, after),
        traces=_traces(grown, bench),
    )


def _undated(grown: Grown, left: Remainder, claims: Claims) -> tuple[str, ...]:
    """Says on which order of the runs an answer rests that depends on time."""
    records = grown.workbench.records
    slow = SLOW & {*claims.effects, *claims.withheld}
    late = left.unexplained and any(r.coordinate == "time" for r in left.regions)
    if len(records) < 2 or records[0].dated_s is not None or not (slow or late):
        return ()
    return (
        "The captures carry no start times: what changes slowly was sought in the order in which "
        "they were given, and as if each run began anew. Give them in the order in which they ran.",
    )


def _residual(left: Remainder, where: tuple[Region, ...], verdict: Verdict) -> tuple[Region, ...]:
    """What has no name: the remainder, or all of it where an imitation fills the model."""
    if left.visible:
        return left.regions
    return where if verdict == "unknown" else ()


def _tied_groups(claims: Claims) -> tuple[tuple[str, ...], ...]:
    return tuple(
        (r.accepted.effect, *r.tied) for r in claims.rounds if r.accepted is not None and r.tied
    )


def _named(claims: Claims, tied: tuple[tuple[str, ...], ...]) -> tuple[str, ...]:
    """Tied groups first, then the settled effects in the order added."""
    grouped = [name for group in tied for name in group]
    settled = [name for name in claims.effects if name not in grouped]
    return tuple(dict.fromkeys([*grouped, *settled]))


def _verdict(
    named: tuple[str, ...], tied: tuple[tuple[str, ...], ...], *, unknown: bool
) -> Verdict:
    if unknown:
        return "unknown"
    if tied:
        return "tie"
    return "named" if named else "none"


def _experiment(
    tied: tuple[tuple[str, ...], ...],
    left: Remainder,
    grown: Grown,
    library: Mapping[str, Effect],
) -> SeparatingExperiment | None:
    if tied:
        return separating_experiment(tied[0], library, grown.final.model.bench)
    if left.unexplained and left.regions:
        return telling_experiment(left.regions[0].coordinate, grown.final.model.bench)
    return None


def ruled_out(grown: Grown, library: Mapping[str, Effect]) -> tuple[Rival, ...]:
    """Look-alikes of the accepted effects that the data rules out, with their evidence."""
    found: dict[str, Rival] = {}
    taken = {c.effect for c in grown.accepted}
    for done in grown.rounds:
        winner = done.accepted
        if winner is None:
            continue
        tried = {c.effect: c for c in done.contenders}
        # An effect found under another name need not have been looked at in its round.
        own = {winner.effect: winner.screened.gain}
        gains = own | {s.start.effect: s.gain for s in done.screening.ranked}
        for name, gain in gains.items():
            if name in taken or name in done.tied or not alike(name, winner.effect, library):
                continue
            p_value = None
            if name in tried:
                lost = tried[name].fitted.blocks - winner.fitted.blocks
                p_value = sign_flip_p(lost, seed=7)
                if p_value > _RULED_OUT:
                    continue
            share = gain / max(gains[winner.effect], 1e-12)
            found.setdefault(name, Rival(name, p_value, share))
    return tuple(found.values())


def _evidence(grown: Grown, library: Mapping[str, Effect]) -> tuple[Evidence, ...]:
    found = []
    for number, done in enumerate(grown.rounds, start=1):
        listed = set()
        for contender in done.contenders:
            listed.add(contender.effect)
            chosen = done.accepted is not None and contender.effect == done.accepted.effect
            status = "chosen" if chosen else "lost"
            if contender.effect in done.tied:
                status = "tied"
            found.append(
                Evidence(
                    contender.effect,
                    number,
                    1e3 * contender.judged_gain / max(done.rows_judge, 1.0),
                    contender.screened.fit_gain,
                    contender.bic_gain,
                    contender.p_value,
                    contender.gap_um,
                    status,
                )
            )
        for item in done.screening.ranked:
            if item.start.effect in listed:
                continue
            found.append(
                Evidence(
                    item.start.effect, number, float("nan"), item.fit_gain,
                    float("nan"), float("nan"), float("nan"), "screened",
                )
            )  # fmt: skip
    return tuple(found)


def _where(grown: Grown, bench: Bench) -> tuple[Region, ...]:
    """Where the base model disagrees, in the table channel and in the motor's."""
    workbench = grown.workbench
    residuals = workbench.residuals(grown.base.simulated)
    responses = [r.response(grown.base.model) for r in workbench.records]
    coordinates = [
        r.coordinates(p, bench.pitch_m) for r, p in zip(workbench.records, responses, strict=True)
    ]
    period = workbench.records[0].coarse_period_s
    names = ["motor"] if workbench.channels == 1 else ["motor", "table"]
    found: list[Region] = []
    for i, name in reversed(list(enumerate(names))):
        marked = [
            np.where(c, d[:, i], np.nan) for c, d in zip(workbench.counted, residuals, strict=True)
        ]
        found += localise(marked, coordinates, channel=name, sample_s=period)
    return tuple(found)


def _path(grown: Grown, before: Gap, after: Gap) -> tuple[Growth, ...]:
    steps = [Growth((), before.position_um, before.torque_Nm)]
    judging, executor = grown.workbench.judging_records, grown.workbench.executor
    accepted = grown.accepted
    for i, contender in enumerate(accepted):
        here = after if i == len(accepted) - 1 else gap(judging, contender.fitted.model, executor)
        steps.append(Growth((contender.effect,), here.position_um, here.torque_Nm))
    return tuple(steps)


def _traces(grown: Grown, bench: Bench) -> tuple[Trace, ...]:
    """Residuals of the judging samples before and after, for figures."""
    workbench = grown.workbench
    before = workbench.residuals(grown.base.simulated)
    after = workbench.residuals(grown.final.simulated)
    traces = []
    for i, (record, mask) in enumerate(zip(workbench.records, workbench.fitting, strict=True)):
        part = ~mask & record.usable
        if not part.any():
            continue
        at = record.coordinates(record.response(grown.final.model), bench.pitch_m)
        traces.append(
            Trace(
                record.name,
                at.values["time"][part],
                MappingProxyType({k: v[part] for k, v in at.values.items()}),
                UM_PER_M * (before[i][part, -1] - before[i][part, -1].mean()),
                UM_PER_M * (after[i][part, -1] - after[i][part, -1].mean()),
            )
        )
    return tuple(traces)
