"""What is left, run by run: which motions show it, and whether only large torques do.

What lives here: sentences about runs where something without a name is left. May import ``growth``
and ``remainder``.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pmac_comp.base.units import UM_PER_M
from pmac_comp.physics.diagnose.growth import Grown
from pmac_comp.physics.diagnose.remainder import Remainder

_UNEVEN = 3.0  # times what the quietest run leaves
_ALIKE = 0.5  # of the largest: runs that are named with it
_MOST_NAMES = 3
# A level of torque parts the runs if those beyond leave so many times as much, and ask for so much
# more than the others, of which there are at least two.
_PARTED, _APART, _LEAST_BELOW = 4.0, 1.05, 2


@dataclass(frozen=True)
class RunLeft:
    """What a model leaves of one run.

    Parameters
    ----------
    name : str
        Of the run.
    left_um : float
        Rms of its last channel.
    peak_Nm : float
        Largest torque command, 0 where it was not captured.
    judges : bool
        Whether nothing of it was fitted.
    """

    name: str
    left_um: float
    peak_Nm: float
    judges: bool = False


def told_by_run(grown: Grown, left: Remainder) -> tuple[str, ...]:
    """Sentences on the runs that show what has no name; none where nothing is left.

    Parameters
    ----------
    grown : Grown
        Result of the growth loop.
    left : Remainder
        What it leaves.

    Returns
    -------
    tuple of str
    """
    return sentences(_runs(grown)) if left.unexplained else ()


def _runs(grown: Grown) -> list[RunLeft]:
    workbench = grown.workbench
    residuals = workbench.residuals(grown.final.simulated)
    found = []
    for record, fitting, counted, residual in zip(
        workbench.records, workbench.fitting, workbench.counted, residuals, strict=True
    ):
        missed = residual[counted, -1]
        if missed.size:
            peak = 0.0 if record.torque_Nm is None else float(np.abs(record.torque_Nm).max())
            found.append(
                RunLeft(record.name, UM_PER_M * float(missed.std()), peak, not fitting.any())
            )
    return found


def sentences(runs: Sequence[RunLeft]) -> tuple[str, ...]:
    """Which runs show most and least of it, and which level of torque parts them.

    Parameters
    ----------
    runs : sequence of RunLeft
        All runs.

    Returns
    -------
    tuple of str
        Nothing where all runs show it alike.
    """
    if len(runs) < 2:
        return ()
    ranked = sorted(runs, key=lambda r: -r.left_um)
    if ranked[0].left_um < _UNEVEN * ranked[-1].left_um:
        return ()
    most = [r for r in ranked if r.left_um > _ALIKE * ranked[0].left_um][:_MOST_NAMES]
    listed = ", ".join(f"{r.name} ({r.left_um:.3g} um)" for r in most)
    text = f"Runs that show it most: {listed}; least: {ranked[-1].name} ({ranked[-1].left_um:.2g}"
    return (f"{text} um).", *_new(runs), *_parted(sorted(runs, key=lambda r: r.peak_Nm)))


def _new(runs: Sequence[RunLeft]) -> tuple[str, ...]:
    """That the runs which judge show it and those that were fitted do not: it was not there."""
    judging, fitted = ([r.left_um for r in runs if r.judges is which] for which in (True, False))
    if not judging or not fitted or min(judging) < max(fitted):
        return ()
    # One run with many rests leaves as much as rounding makes of them.
    all_fitted, all_judging = (float(np.sqrt(np.mean(np.square(v)))) for v in (fitted, judging))
    if all_judging < _PARTED * all_fitted:
        return ()
    return (
        f"The runs that were fitted leave {all_fitted:.2g} um rms, at most {max(fitted):.2g} um; "
        f"all that judge leave at least {min(judging):.2g} um: it came with these. A load, a "
        "setting or a temperature changed before them, or their motions ask for what no fitted one "
        "does; runs without an effect name none. Give them all without --validate, and part of "
        "each is fitted.",
    )


def _parted(rising: Sequence[RunLeft]) -> tuple[str, ...]:
    """The level of torque beyond which runs show it and below which they do not."""
    for count in range(_LEAST_BELOW, len(rising)):
        below, beyond = rising[:count], rising[count:]
        quiet, loud = max(r.left_um for r in below), min(r.left_um for r in beyond)
        low, high = below[-1].peak_Nm, beyond[0].peak_Nm
        if loud > _PARTED * quiet and 0.0 < _APART * low < high:
            return (
                f"Runs whose torque command stays within {low:.3g} N m leave at most {quiet:.2g} "
                f"um, all that pass {high:.3g} N m at least {loud:.2g} um: look at what limits the "
                "torque in between, the drive's current or voltage or the output of the card.",
            )
    return ()
