"""What a fit holds at a usual value although it is known to a tolerance only.

What lives here: how a drive divides what its bench file states as one figure, and what an error of
that does to a fit. What may not: fitting it. Imports ``problem`` and ``normal_equations``.

No bench file says how much of the motor's inertia is the coupling's, and the model ties the torsion
of the screw's core to its axial rigidity by the square of a diameter. On a slender screw half of
the compliance is torsion: rigidity, mass and inertia are then found to a thousandth for a division
that is known to some per cent.

Source: consider covariance (Schmidt 1966; Bierman 1977, chapter VIII).
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.identify.normal_equations import normal_equations
from pmac_comp.physics.identify.problem import TOLERANCE_IN_STD, Problem
from pmac_comp.physics.identify.whitening import Whitener
from pmac_comp.physics.model.chain import Shares

# Tolerances, as a maker would state them. Metal bellows and disc couplings against the rotors that
# they suit: a twentieth to a third of both together.
_COUPLING = 0.15
# Bearings of 100 to 735 N/um and nuts of 180 to 260 with their housings, by catalogues: the
# quotient is known to a factor of two.
_BEARING_OVER_NUT = 2.0
# Diameter where a bench file does not state it: catalogues of rolled and ground screws from 12 to
# 63 mm have cores of 0.80 to 0.92 of the nominal diameter, the default being 0.88.
_CORE_FRAC = 0.07


def considered_scores(
    problem: Problem,
    theta: FloatArray,
    filters: list[list[Whitener]],
    slopes: Sequence[Sequence[FloatArray]],
) -> FloatArray:
    """Mean square of the scores that errors of usual values make, shape (p, p).

    Parameters
    ----------
    problem : Problem
        What is fitted.
    theta : ndarray, shape (p,)
        Scaled parameters at the estimate.
    filters : list of list of Whitener
        Weights, per record and channel.
    slopes : sequences of ndarray
        Derivatives, per parameter and record, shape (m, c) each.

    Returns
    -------
    ndarray, shape (p, p)
        To be added to the scatter of the scores in the covariance.
    """
    total = np.zeros((theta.size, theta.size))
    if problem.model.is_rigid:
        return total
    usual = problem.many([theta], problem.slope_substeps)[0]
    for shares in one_deviation_off(problem.model.shares, problem.model.bench):
        other = replace(problem, model=replace(problem.model, shares=shares), latest={})
        off = other.many([theta], problem.slope_substeps)[0]
        change = [b - a for a, b in zip(usual, off, strict=True)]
        score = normal_equations(problem, filters, change, slopes, scatter=False).gradient
        total += np.outer(score, score)
    return total


def one_deviation_off(shares: Shares, bench: Bench) -> tuple[Shares, ...]:
    """Shares of which one each is a standard deviation from what is usual.

    The screw's rigidity is stated to a tolerance. As it goes with the square of the core's
    diameter, the quotient of torsional and axial rigidity, which does too, is known to the same.
    """
    core = bench.tolerance.screw_rigidity_N
    if bench.screw.root_diameter_mm is None:
        core = math.hypot(core, 2.0 * _CORE_FRAC)
    coupling = shares.coupling_of_motor + _COUPLING / TOLERANCE_IN_STD
    quotient = shares.bearing_over_nut * _BEARING_OVER_NUT ** (1.0 / TOLERANCE_IN_STD)
    torsion = shares.torsion_of_core * (1.0 + core / TOLERANCE_IN_STD)
    return (
        replace(shares, coupling_of_motor=coupling),
        replace(shares, bearing_over_nut=quotient),
        replace(shares, torsion_of_core=torsion),
    )
