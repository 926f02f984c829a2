"""One quantity of the bench file at another value, in place of a model that needs several.

What lives here: the plainest answer where the data asks for what the bench file excludes. No
effects. May import ``growth``, ``estimates``, ``candidates``, ``onset`` and ``refit``.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

from scipy.stats import chi2

from pmac_comp.base.errors import ModelError
from pmac_comp.files.bench import Bench
from pmac_comp.physics.diagnose.candidates import own_directions
from pmac_comp.physics.diagnose.estimates import finding_of
from pmac_comp.physics.diagnose.growth import Grown
from pmac_comp.physics.diagnose.onset import holds_onset, with_onset
from pmac_comp.physics.diagnose.records import gap
from pmac_comp.physics.diagnose.refit import Fitted, evaluate, refit
from pmac_comp.physics.diagnose.result import Finding
from pmac_comp.physics.model.chain import USUAL_ONLY
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.parameters import ParameterSpec

_INERTIAS = ("chain.motor_inertia_kgm2", "chain.screw_inertia_kgm2")
_MOVED = (*_INERTIAS, "chain.table_mass_kg")
_FREE = 1.0  # tolerance of a quantity that is taken for unknown
_PINNED = 0.9
_ROUNDS = 8
_END = 1e-6  # in steps of a refit
_TOGETHER = 1e-3  # chance that stated quantities lie so far out within their tolerances
_NEARLY = 1.1
_AS_CLOSE = 1.03  # to the runs that judge as the grown model


def single_cause(
    grown: Grown, findings: Sequence[Finding], *, doubted: bool = False
) -> tuple[Grown, Finding] | None:
    """The base model with one quantity of the bench file outside its tolerance, if that does.

    Parameters
    ----------
    grown : Grown
        What the growth loop found.
    findings : sequence of Finding
        What its model needs outside a tolerance; without any there is nothing to be simpler than.
    doubted : bool
        Whether its model stands for a stated quantity without such a finding: by an effect, or by
        many others at the ends of their tolerances (``stretched``).

    Returns
    -------
    tuple of Grown and Finding, or None
        The growth without its effects and with that quantity, and the quantity.
    """
    if not findings and not doubted:
        return None
    needed = {f.parameter for f in findings}
    asked = [s for s in grown.base.model.specs if s.name in needed or _pinned(grown.base.model, s)]
    tried = [t for t in (_loosened(grown, spec) for spec in asked) if t is not None]
    if not tried:
        return None
    judging, executor = grown.workbench.calm_records, grown.workbench.executor
    gaps = [gap(judging, fitted.model, executor).position_um for _, fitted in tried]
    best = min(range(len(tried)), key=gaps.__getitem__)
    spec, fitted = tried[best]
    most_um = _AS_CLOSE * gap(judging, grown.final.model, executor).position_um
    if gaps[best] > most_um:
        fitted = _gripping_as(grown, fitted)
        if gap(judging, fitted.model, executor).position_um > most_um:
            return None
    found = finding_of(spec, grown.workbench.fitting_bench(), fitted)
    if found is None:
        return None
    rivals = [s for (s, _), g in zip(tried, gaps, strict=True) if g <= _NEARLY * gaps[best]]
    also = " or ".join(s.file_name or s.name for s in rivals if s.name != spec.name)
    if also:
        found = replace(found, text=f"{found.text} ({also} instead would do nearly as well)")
    if spec.name in _INERTIAS:
        found = replace(found, text=f"{found.text}; {_as_torque(grown.base.model, fitted.model)}")
    bare = tuple(replace(done, accepted=None, tied=()) for done in grown.rounds)
    final = evaluate(grown.workbench, fitted.model)
    return replace(grown, final=final, rounds=bare, open_SI={}), found


def stretched(model: DriveModel) -> bool:
    """Whether stated quantities are each within tolerance, but hardly ever all so far out at once.

    One that is far outside its own can be shared out among the others' tolerances.
    """
    stated = [
        (d.centre / d.sigma) ** 2
        for d in own_directions(model)
        if math.isfinite(d.sigma) and d.label != USUAL_ONLY
    ]
    return bool(stated) and float(chi2.sf(sum(stated), len(stated))) < _TOGETHER


def _as_torque(base: DriveModel, found: DriveModel) -> str:
    """An inertia out of tolerance as the torque constant that no run tells from it."""
    stated = base.with_parameters({name: base.spec(name).nominal for name in _MOVED})
    share = _shaft_inertia_kgm2(stated) / _shaft_inertia_kgm2(found)
    return (
        f"a drive that gives {share:.3g} times the torque that its stated constant says looks the "
        "same, as friction and inertia scale alike: check that figure first"
    )


def _shaft_inertia_kgm2(model: DriveModel) -> float:
    """Inertia of all that moves, at the motor's shaft."""
    advance_m_per_rad = model.bench.pitch_m / (2.0 * math.pi)
    values = model.parameters
    rotary = sum(values[name] for name in _INERTIAS)
    return float(rotary + advance_m_per_rad**2 * values["chain.table_mass_kg"])


def _pinned(model: DriveModel, spec: ParameterSpec) -> bool:
    """Whether the base model holds a known quantity at the end of its tolerance."""
    width = abs(spec.nominal) * (spec.tolerance_frac or 0.0)
    known = spec.kind == "known" and width > 0.0 and spec.name != USUAL_ONLY
    return known and abs(model.parameters[spec.name] - spec.nominal) > _PINNED * width


def _loosened(grown: Grown, spec: ParameterSpec) -> tuple[ParameterSpec, Fitted] | None:
    """The base model refitted with one quantity that nothing is known of."""
    part = grown.workbench.fitting_bench()
    loose = replace(grown.base.model, bench=_unknown(grown.base.model.bench, spec))
    nominal = {s.name: s.nominal for s in loose.specs if s.kind == "known" and s.name != spec.name}
    try:
        start = evaluate(part, loose.with_parameters(nominal))
        fitted = refit(part, start, rounds=_ROUNDS)
    except ModelError:
        return None
    return None if _at_an_end(fitted.model, spec.name) else (spec, fitted)


def _gripping_as(grown: Grown, fitted: Fitted) -> Fitted:
    """A refitted base model with friction that sets in over a distance, where the grown one has it.

    That is no effect, and the two are to differ by those alone.
    """
    if not holds_onset(grown.final.model):
        return fitted
    whole = with_onset(grown.workbench, evaluate(grown.workbench, fitted.model))
    return evaluate(grown.workbench.fitting_bench(), whole.model)


def _at_an_end(model: DriveModel, name: str) -> bool:
    """Whether a refit took a quantity as far as it may go: that is where it gave up, no value."""
    ways = [d for d in own_directions(model) if d.label == name]
    return any(d.lower > -_END or d.upper < _END for d in ways)


def _unknown(bench: Bench, spec: ParameterSpec) -> Bench:
    tolerance = bench.tolerance.model_copy(update={spec.file_name or "": _FREE})
    return bench.model_copy(update={"tolerance": tolerance})
