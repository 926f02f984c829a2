"""Intervals reach to a second fit of the same runs where that is far."""

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.identify.agreement import widened_where_apart
from pmac_comp.physics.identify.result import Identification, NoiseLevels, estimate
from pmac_comp.physics.model.drive import DriveModel

MODEL = DriveModel.base(load_bench("paper"))
NUT, MOTOR, MASS = "coulomb.nut_Nm", "coulomb.motor_Nm", "chain.table_mass_kg"


def fit(nut_Nm: float, motor_Nm: float, mass_kg: float | None = 122.0) -> Identification:
    """Fit with intervals of 0.01 N m and 1 kg."""
    values = {NUT: (nut_Nm, 0.01), MOTOR: (motor_Nm, 0.01)}
    if mass_kg is not None:
        values[MASS] = (mass_kg, 1.0)
    return Identification(
        model=MODEL,
        parameters={name: estimate(name, v, std, "") for name, (v, std) in values.items()},
        correlation_names=tuple(values),
        correlation=np.eye(len(values)),
        noise=NoiseLevels(None, None, None),
        residuals=(),
        statements=(),
        method="",
    )


def test_two_fits_that_agree_leave_the_intervals_alone() -> None:
    found = fit(0.22, 0.18)
    assert widened_where_apart(found, fit(0.24, 0.17, None)) is found


def test_intervals_reach_to_the_other_fit() -> None:
    found = widened_where_apart(fit(0.01, 0.38), fit(0.24, 0.16, None))
    nut, motor, mass = (found.parameters[name] for name in (NUT, MOTOR, MASS))
    assert nut.std == pytest.approx(np.hypot(0.01, 0.23))
    assert nut.lower95 == 0.0  # no friction pushes
    assert nut.upper95 > 0.24
    assert motor.lower95 < 0.16
    assert (mass.value, mass.std) == (122.0, 1.0)
    assert found.correlation[0, 1] == pytest.approx(-1.0, abs=0.01)
    assert NUT in found.statements[-1]
    assert MASS.partition(".")[2] not in found.statements[-1]
