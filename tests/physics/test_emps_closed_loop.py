"""EMPS through ``identify``: the published table, and the closed loop it simulates."""

from pathlib import Path

import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import read_capture
from pmac_comp.physics.identify import Identification, identify, model_from_file, to_model_file
from pmac_comp.physics.identify.compare_rigid import compare_rigid

pytestmark = pytest.mark.emps


@pytest.fixture(scope="module")
def found(emps_file: Path) -> Identification:
    return identify([read_capture(emps_file)], load_bench("emps"))


def test_parameters_are_named_as_published(found: Identification) -> None:
    stored = to_model_file(found, load_bench("emps"))
    published = {
        "mass_kg": (95.1089, 0.109),
        "viscous_N_s_per_m": (203.5034, 1.15),
        "coulomb_N": (20.3935, 0.10),
        "offset_N": (-3.1648, 0.044),
    }
    for name, (value, std) in published.items():
        entry = stored.parameters[name]
        assert entry.value == pytest.approx(value, abs=2.0 * std)
        assert entry.std is not None
        assert std < entry.std < 6.0 * std
        assert entry.lower95 is not None
        assert entry.upper95 is not None
        assert entry.lower95 < value < entry.upper95


def test_closed_loop_meets_the_record(found: Identification) -> None:
    # Computed from the published parameters without the official model's delay of a sample: 1.6 um
    # and 4.56 %.
    assert found.figures["relative_force_error_percent"] <= 4.15
    assert found.figures["closed_loop_position_rms_um"] <= 1.65
    assert found.figures["closed_loop_force_error_percent"] <= 4.6


def test_model_file_gives_the_model_back(found: Identification) -> None:
    bench = load_bench("emps")
    again = model_from_file(to_model_file(found, bench), bench)
    assert found.model is not None
    assert dict(again.parameters) == pytest.approx(dict(found.model.parameters), rel=1e-12)


def test_models_are_judged_lap_by_lap(emps_file: Path) -> None:
    growth = (("bias_force",), ("bias_force", "friction_asymmetry", "viscous_nonlinear"))
    compared = compare_rigid(read_capture(emps_file), load_bench("emps"), growth=growth)
    plain, grown = compared.rows
    assert compared.n_laps == 4
    assert compared.floor_um == pytest.approx(0.26, abs=0.02)
    # 1.6 um with the published parameters.
    assert plain.left_rms_um < 1.75
    assert grown.left_rms_um < 1.1
    assert grown.one_step_nm < plain.one_step_nm < 70.0  # the lattice is 50 nm
