"""Patterns within coarse samples are seen, white noise is not taken for one."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.diagnose.fine import FinePattern, fine_pattern
from pmac_comp.physics.diagnose.records import prepare
from pmac_comp.physics.diagnose.workbench import Workbench
from pmac_comp.physics.model.drive import DriveModel
from tests.generators.hidden_effects import make_case

BENCH = load_bench("paper_x4")
MODEL = DriveModel.base(BENCH)
NOISE_m = 0.1e-6


@pytest.fixture(scope="module")
def records():
    """Runs whose reading is the model's own and white noise."""
    case = make_case(BENCH, [], seed=3, seconds=2.0, quiet=True)
    rng = np.random.default_rng(4)
    made = []
    for record in prepare(case.judge, BENCH, prefix="run"):
        exact = record.channels_of(record.response(MODEL))
        noise = np.zeros_like(exact)
        noise[:, -1] = rng.normal(0.0, NOISE_m, exact.shape[0])
        made.append(replace(record, measured_m=exact + noise))
    return made


def seen(records, add) -> FinePattern | None:
    told = []
    for record in records:
        time = record.period_s * np.arange(record.valid.size)
        measured = record.measured_m.copy()
        measured[:, -1] += add(time, record.response(MODEL).table_position_m)
        told.append(replace(record, measured_m=measured))
    with ThreadPoolExecutor(1) as executor:
        none = tuple(np.zeros(r.usable.size, dtype=bool) for r in told)
        return fine_pattern(Workbench(tuple(told), none, executor), MODEL)


def test_white_noise_shows_no_wave(records):
    found = seen(records, lambda time, place: 0.0)
    assert found is not None
    assert found.p_value > 1e-3
    assert found.rms_um < 0.1 * 1e6 * NOISE_m


def test_a_pattern_of_the_scale_is_told_by_its_period_and_its_size(records):
    found = seen(records, lambda time, place: 0.5e-6 * np.cos(2 * np.pi * place / 16e-6 + 1.0))
    assert found is not None
    assert found.p_value < 1e-12
    assert found.region.coordinate == "position"
    assert found.region.low == pytest.approx(16.0, abs=0.02)
    assert found.region.size_um == pytest.approx(0.5, rel=0.1)
    assert "every 16 um of position" in found.region.describe()


def test_a_chatter_is_told_by_its_frequency(records):
    found = seen(records, lambda time, place: 0.5e-6 * np.sin(2 * np.pi * 700.0 * time))
    assert found is not None
    assert found.region.coordinate == "frequency"
    assert found.region.low == pytest.approx(700.0, abs=1.0)
    assert found.region.size_um == pytest.approx(0.5, rel=0.1)
    assert "at 700 Hz" in found.region.describe()
