"""Growth on the EMPS record: from mass and viscous friction alone, judged on a held-back lap."""

from pathlib import Path

import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import read_capture
from pmac_comp.physics.diagnose import Rules, diagnose
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.effect import effect_library

pytestmark = pytest.mark.emps
FRICTION = ("coulomb", "friction_asymmetry", "bias_force", "stribeck", "presliding", "payload")


def test_coulomb_friction_then_its_asymmetry_are_found_on_real_data(emps_file: Path) -> None:
    bench = load_bench("emps")
    found = diagnose(
        [read_capture(emps_file)],
        bench,
        model=DriveModel(bench, ("viscous",), {}),
        effects={name: effect_library()[name] for name in FRICTION},
        rules=Rules(most_effects=2),
    )
    assert found.named[0] == "coulomb"
    assert set(found.named[1:]) & {"friction_asymmetry", "bias_force"}
    gaps = [step.gap_um for step in found.path]
    assert gaps == sorted(gaps, reverse=True)
    # The published loop without the delay reaches 1.6 um; the laps differ by 0.26 um.
    assert found.gap_after_um < 1.6 < found.gap_before_um
    assert found.noise_floor_um == pytest.approx(0.185, abs=0.02)
    assert found.gap_channel == "motor"


@pytest.mark.slow
def test_all_effects_beside_them_do_not_take_the_names_of_real_friction_away(
    emps_file: Path,
) -> None:
    bench = load_bench("emps")
    found = diagnose([read_capture(emps_file)], bench, model=DriveModel(bench, ("viscous",), {}))
    assert found.named[0] == "coulomb"
    assert set(found.named[1:]) & {"friction_asymmetry", "bias_force"}
    assert found.gap_after_um < 1.1
    assert found.residual
    # Beside effects that are not claimed Coulomb friction would be anything from 0 to 18 N.
    assert any(s.startswith("The sizes are those with the named effects") for s in found.statements)
    size = next(e for e in found.estimates if e.name == "coulomb.coulomb_N")
    assert 15.0 < size.value < 23.0
    assert size.lower95 < 20.4 < size.upper95  # published
    assert size.std < 3.0
