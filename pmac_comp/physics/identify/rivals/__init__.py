"""Rival models of the mechanical error, each as published so far as the public record allows.

One file per rival: its equation ``error_m(signals, theta, bench)``, its parameters, its source.
``rivals()`` collects them. They are given the measured motion of the motor (and the torque where
the publication uses it), which is more than a pre-computed compensation would know.
"""

from functools import cache

from pmac_comp.physics.identify.rivals.base import FittedRival, Rival, fit_rival, signals_of


@cache
def rivals() -> tuple[Rival, ...]:
    """All rivals, oldest idea first."""
    from pmac_comp.physics.identify.rivals import (
        axial_two_mass,
        elastic_deformation,
        paper,
        sigmoid_friction,
        torsion,
    )

    return (
        torsion.RIVAL,
        axial_two_mass.RIVAL,
        elastic_deformation.RIVAL,
        sigmoid_friction.RIVAL,
        paper.WITHOUT_TORQUE_TRANSMISSION,
        paper.WITH_TORQUE_TRANSMISSION,
    )


__all__ = ["FittedRival", "Rival", "fit_rival", "rivals", "signals_of"]
