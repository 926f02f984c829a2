"""Intervals of a fit, held against another fit that should agree with it.

What lives here: the comparison of two fits and the widening that follows. What may not: fitting.
Imports this package.
"""

from dataclasses import replace

import numpy as np

from pmac_comp.physics.identify.persistence import file_key
from pmac_comp.physics.identify.result import (
    Z95,
    Identification,
    ParameterEstimate,
    correlation_of,
)

_FAR = 3.0  # standard deviations; two fits of the same runs differ by about one


def widened_where_apart(found: Identification, other: Identification) -> Identification:
    """The fit with intervals that reach to a second fit of the same runs where that is far.

    A small error of the model (what rounding does, a detail of friction) can move parameters that
    the runs hardly determine from one end of what is possible to the other; all blocks of time then
    pull alike and their scatter does not show it. A fit to a part of the runs goes elsewhere
    (a specification test of Hausman's kind).

    Parameters
    ----------
    found : Identification
        The fit to give out.
    other : Identification
        A fit of the same model to part of its samples; its parameters may be fewer.

    Returns
    -------
    Identification
        ``found`` itself where the two agree; else with the difference of the two as one more
        direction of uncertainty, and a statement that says so.
    """
    names, model = found.correlation_names, found.model
    std = np.array([found.parameters[name].std for name in names])
    values = np.array([found.parameters[name].value for name in names])
    elsewhere = np.array(
        [
            other.parameters[name].value if name in other.parameters else value
            for name, value in zip(names, values, strict=True)
        ]
    )
    apart = elsewhere - values
    far = np.abs(apart) > _FAR * std
    if not far.any():
        return found
    covariance = found.correlation * np.outer(std, std) + np.outer(apart, apart)
    wider = np.sqrt(np.diag(covariance))
    parameters = dict(found.parameters)
    for name, size in zip(names, wider, strict=True):
        parameters[name] = _with_std(found, name, float(size))
    listed = ", ".join(
        file_key(model.spec(name), rigid=model.is_rigid)
        for name, is_far in zip(names, far, strict=True)
        if is_far
    )
    return replace(
        found,
        parameters=parameters,
        correlation=correlation_of(covariance),
        statements=(
            *found.statements,
            f"Half of the samples put these values elsewhere than all of them: {listed}. "
            "Their intervals reach to both.",
        ),
    )


def _half_width_std(entry: ParameterEstimate) -> float:
    """Half width of a 95 % interval in standard deviations, where bounds do not cut it."""
    half = max(entry.upper95 - entry.value, entry.value - entry.lower95)
    return max(half / entry.std, Z95) if entry.std > 0.0 else Z95


def _with_std(found: Identification, name: str, std: float) -> ParameterEstimate:
    entry = found.parameters[name]
    half_width = _half_width_std(entry)
    spec = found.model.spec(name)
    return replace(
        entry,
        std=std,
        lower95=max(entry.value - half_width * std, spec.lower),
        upper95=min(entry.value + half_width * std, spec.upper),
    )
