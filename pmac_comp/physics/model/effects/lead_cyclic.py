"""Lead wobble: the nut advances unevenly within a revolution."""

import math

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.shapes import fill_harmonic, harmonic_m
from pmac_comp.physics.model.terms import Coordinate, Site, TableTerm

_KNOTS = 128  # a period; straight lines between them miss a cosine by 0.03 %


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    if place != "reading":
        fill_harmonic(vector, s.WOBBLE, values["amplitude_m"], values)


def _reading(values: Values, bench: Bench) -> tuple[TableTerm, ...]:
    """The same error where only the reading knows it: no force, whatever the speed."""
    turns = np.arange(_KNOTS + 1) / _KNOTS
    period_m = bench.pitch_m / max(values["order_per_rev"], 1e-9)
    error_m = values["amplitude_m"] * np.cos(2.0 * math.pi * turns + values["phase_rad"])
    return (
        TableTerm(
            Coordinate.TABLE_POSITION_M,
            Site.TABLE_READING_M,
            0.0,
            period_m / _KNOTS,
            error_m,
            period=period_m,
        ),
    )


EFFECT = Effect(
    name="lead_cyclic",
    parameters=harmonic_m(1.0),
    apply=_apply,
    where="screw: in the nut, which the chain carries to the table, or in the reading alone",
    source="Fourier series over the pitch p: A_k cos(2 pi k x/p + phi_k)",
    signature=(
        "table minus motor repeats with the pitch, the same in both directions and at any "
        "speed; none in the torque"
    ),
    separating_experiment=(
        "re-index the coupling by 90 degrees: encoder eccentricity moves with the motor, lead"
        " wobble does not"
    ),
    look_alikes=("encoder_eccentricity", "friction_per_rev"),
    places=("nut", "reading"),
    place_terms={"reading": _reading},
    starts=({"order_per_rev": 1.0}, {"order_per_rev": 2.0}),
    min_substeps=4,
)
