"""Shapes that several effects share: a harmonic of an angle, a slope over the travel.

What lives here: their parameters and how they fill the kernel's slots. What may not: what an effect
means. Imports the kernel layout's types, ``base`` and ``parameters``.
"""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model.effect import Apply, Values
from pmac_comp.physics.model.parameters import ParameterSpec, order, parameter, phase

SLOPE = (
    parameter(
        "slope", "m/m", 30e-6, (-0.05, 0.05), scale=10e-6, file=("slope_um_per_m", "um/m", UM_PER_M)
    ),
)
SLOPE_STARTS = ({"slope": 30e-6}, {"slope": -30e-6})


def harmonic_m(orders_per_rev: float) -> tuple[ParameterSpec, ...]:
    """Parameters of a length that repeats with an angle: amplitude (um in files), order, phase."""
    amplitude = parameter(
        "amplitude_m", "m", 1e-6, (0.0, 1e-3), file=("amplitude_um", "um", UM_PER_M)
    )
    return (amplitude, order(orders_per_rev), phase())


def harmonic_Nm(
    nominal_Nm: float, orders_per_rev: float, *, description: str = ""
) -> tuple[ParameterSpec, ...]:
    """Parameters of a torque that repeats with an angle: amplitude, order, phase."""
    amplitude = parameter("amplitude_Nm", "N m", nominal_Nm, (0.0, 100.0), description=description)
    return (amplitude, order(orders_per_rev), phase())


def fill_harmonic(vector: FloatArray, first: int, amplitude: float, values: Values) -> None:
    """Set amplitude, order and phase in a kernel vector, shape (N_SLOTS,), from ``first`` on."""
    vector[first] = amplitude
    vector[first + 1] = values["order_per_rev"]
    vector[first + 2] = values["phase_rad"]


def harmonic_at(first: int, amplitude: str) -> Apply:
    """``apply`` of an effect that is one harmonic; ``amplitude`` names its parameter."""

    def apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
        fill_harmonic(vector, first, values[amplitude], values)

    return apply


def slope_at(slot: int) -> Apply:
    """``apply`` of an effect that is one slope."""

    def apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
        vector[slot] = values["slope"]

    return apply
