"""A model file read back: the unit that it states is the one in which a value is taken."""

from dataclasses import dataclass

import pytest

from pmac_comp.base.errors import ModelError
from pmac_comp.files.bench import load_bench
from pmac_comp.files.model_file import ModelFile, ModelParameter
from pmac_comp.physics.identify import model_from_file

BENCH = load_bench("paper")


@dataclass(frozen=True)
class Case:
    name: str
    value: float
    unit: str
    wrong: str


@pytest.mark.parametrize(
    "case",
    [
        Case("axial_stiffness_N_per_um", 97.0, "N/um", "N/m"),
        Case("table_mass_kg", 120.0, "kg", "g"),
        Case("coulomb.nut_Nm", 0.1, "N m", "N"),
    ],
    ids=lambda case: case.name,
)
def test_a_value_in_another_unit_is_refused(case: Case) -> None:
    """It was taken as if the unit were the usual one."""

    def stored(unit: str) -> ModelFile:
        value = ModelParameter(value=case.value, unit=unit)
        return ModelFile(effects=["coulomb", "viscous"], parameters={case.name: value})

    assert model_from_file(stored(case.unit), BENCH).effects == ("coulomb", "viscous")
    meant = rf"{case.name} in {case.wrong} \({case.unit} is meant\)"
    with pytest.raises(ModelError, match=meant):
        model_from_file(stored(case.wrong), BENCH)
