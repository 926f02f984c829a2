"""The answer of a diagnosis: what is missing, how sure, what it is worth, what would settle it.

What lives here: frozen values and their JSON. No computation. May import ``files`` and ``model``.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from pmac_comp.base.arrays import FloatArray
from pmac_comp.physics.diagnose.localise import Region
from pmac_comp.physics.model.drive import DriveModel

Verdict = Literal["named", "none", "unknown", "tie"]
SCHEMA_VERSION = 1


@dataclass(frozen=True)
class Estimate:
    """A parameter of a named effect with its interval, in the unit of the files."""

    name: str
    value: float
    unit: str
    std: float
    lower95: float
    upper95: float


@dataclass(frozen=True)
class Evidence:
    """What one candidate earned in one round of the growth loop.

    Parameters
    ----------
    name : str
        Effect.
    round : int
        Round of the loop, from 1.
    heldout_gain : float
        Drop of the whitened sum of squares per thousand samples on validation captures, after
        the joint refit; NaN for a candidate that was only screened.
    screen_gain : float
        Drop of the whitened sum of squares on the fitting captures in the linearised joint refit.
    bic_gain : float
        Drop of the Bayesian information criterion with the effective number of samples; twice
        the log Bayes factor, near enough.
    p_value : float
        Block sign-flip p-value of the gain, corrected for the number of candidates. The blocks of
        fitting and judging samples count alike (a candidate has one to three parameters); the
        held-out gain must be material besides.
    gap_um : float
        Gap on validation captures with this candidate added; NaN if only screened.
    status : str
        ``chosen``, ``tied``, ``lost`` or ``screened``.
    estimates : tuple of Estimate
        The candidate's own parameters after its joint refit.
    """

    name: str
    round: int
    heldout_gain: float
    screen_gain: float
    bic_gain: float
    p_value: float
    gap_um: float
    status: str
    estimates: tuple[Estimate, ...] = ()


@dataclass(frozen=True)
class SeparatingExperiment:
    """A run that tells look-alikes apart, in words and as motions a bench can make."""

    effects: tuple[str, ...]
    text: str
    motions: tuple[str, ...] = ()


@dataclass(frozen=True)
class Growth:
    """One step of the growth path."""

    added: tuple[str, ...]
    gap_um: float
    torque_gap_Nm: float | None


@dataclass(frozen=True)
class Finding:
    """A known parameter outside the tolerance of the bench file."""

    parameter: str
    value: float
    nominal: float
    tolerance_frac: float
    text: str


@dataclass(frozen=True)
class Trace:
    """Residuals of one validation capture for figures, before and after, block means."""

    name: str
    time_s: FloatArray
    coordinates: Mapping[str, FloatArray]
    before_um: FloatArray
    after_um: FloatArray


@dataclass(frozen=True)
class Diagnosis:
    """Everything a diagnosis found.

    Parameters
    ----------
    verdict : str
        ``named``, ``none``, ``unknown`` or ``tie``.
    named : tuple of str
        Settled effects in the order added; with ``tie`` the tied group comes first.
    tied : tuple of tuple of str
        Groups of look-alikes that the data cannot separate.
    evidence : tuple of Evidence
        All candidates of all rounds, best first within a round.
    where : tuple of Region
        Where the base model disagrees.
    gap_before_um, gap_after_um : float
        Rms of measured minus simulated table position (motor where there is no scale) over the
        validation captures, refitted base and refitted grown model.
    torque_gap_before_Nm, torque_gap_after_Nm : float or None
        The same for the torque command, where it was captured.
    noise_floor_um : float
        What the gap would be with a perfect model.
    gap_channel : str
        ``table`` or ``motor``.
    residual : tuple of Region
        What is left after growth; empty when it is noise.
    separating_experiment : SeparatingExperiment or None
        For a tie, or the best next run when something is unknown.
    findings : tuple of Finding
        Known parameters outside their tolerance.
    statements : tuple of str
        Sentences for a person.
    model : DriveModel
        The grown, refitted model.
    estimates : tuple of Estimate
        Parameters of the named effects.
    path : tuple of Growth
        Growth path, base first.
    traces : tuple of Trace
        Data for figures.
    """

    verdict: Verdict
    named: tuple[str, ...]
    tied: tuple[tuple[str, ...], ...]
    evidence: tuple[Evidence, ...]
    where: tuple[Region, ...]
    gap_before_um: float
    gap_after_um: float
    torque_gap_before_Nm: float | None
    torque_gap_after_Nm: float | None
    noise_floor_um: float
    gap_channel: str
    residual: tuple[Region, ...]
    separating_experiment: SeparatingExperiment | None
    findings: tuple[Finding, ...]
    statements: tuple[str, ...]
    model: DriveModel
    estimates: tuple[Estimate, ...] = ()
    path: tuple[Growth, ...] = ()
    traces: tuple[Trace, ...] = field(default=(), repr=False)

    def to_json(self) -> dict[str, Any]:
        """Plain values for ``--json``; arrays for figures are left out, NaN becomes null."""
        plain = {
            "schema_version": SCHEMA_VERSION,
            "verdict": self.verdict,
            "named": list(self.named),
            "tied": [list(group) for group in self.tied],
            "evidence": [asdict(e) for e in self.evidence],
            "where": [asdict(r) for r in self.where],
            "gap_before_um": self.gap_before_um,
            "gap_after_um": self.gap_after_um,
            "torque_gap_before_Nm": self.torque_gap_before_Nm,
            "torque_gap_after_Nm": self.torque_gap_after_Nm,
            "noise_floor_um": self.noise_floor_um,
            "gap_channel": self.gap_channel,
            "residual": [asdict(r) for r in self.residual],
            "separating_experiment": (
                asdict(self.separating_experiment) if self.separating_experiment else None
            ),
            "findings": [asdict(f) for f in self.findings],
            "statements": list(self.statements),
            "parameters": {e.name: asdict(e) for e in self.estimates},
            "path": [asdict(g) for g in self.path],
        }
        return {key: _finite_or_null(value) for key, value in plain.items()}


def _finite_or_null(value: Any) -> Any:
    """JSON has no NaN: unknown numbers become null, tuples become lists."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {k: _finite_or_null(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite_or_null(v) for v in value]
    return value
