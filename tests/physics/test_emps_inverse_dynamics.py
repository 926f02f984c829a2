"""The EMPS record gives the published parameters (Janot, Gautier, Brunot 2019)."""

from pathlib import Path

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture, read_capture
from pmac_comp.physics.identify.rigid import rigid_regression

pytestmark = pytest.mark.emps


@pytest.fixture(scope="module")
def record(emps_file: Path) -> Capture:
    return read_capture(emps_file)


def test_symmetric_parameters_are_the_published_ones(record: Capture) -> None:
    fit = rigid_regression([record], load_bench("emps"))
    published = np.array([95.1089, 203.5034, 20.3935, -3.1648])
    published_std = np.array([0.109, 1.15, 0.10, 0.044])
    assert np.all(np.abs(fit.coefficients - published) < 2.0 * published_std)
    assert fit.white_std == pytest.approx(published_std, rel=0.1)
    assert 100.0 * fit.relative_error <= 4.15


def test_coloured_residual_widens_the_intervals(record: Capture) -> None:
    fit = rigid_regression([record], load_bench("emps"))
    std = np.sqrt(np.diag(fit.covariance))
    assert np.all(std > 0.0)
    assert np.any(std > 1.5 * fit.white_std)


def test_asymmetric_friction_is_the_published_one(record: Capture) -> None:
    fit = rigid_regression([record], load_bench("emps"), friction="asymmetric")
    found = dict(zip(fit.names, fit.coefficients, strict=True))
    assert found["viscous_positive_N_s_per_m"] == pytest.approx(166.71, abs=3.0)
    assert found["viscous_negative_N_s_per_m"] == pytest.approx(240.42, abs=3.0)
    assert found["coulomb_positive_N"] == pytest.approx(20.144, abs=0.3)
    assert found["coulomb_negative_N"] == pytest.approx(20.628, abs=0.3)
    assert 100.0 * fit.relative_error < 3.25
