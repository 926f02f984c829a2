"""When runs began: by their dates, in phase with a wave, and as directions of a refit."""

from dataclasses import replace

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.diagnose.clocks import clock_directions, merged_clocks, moved_clocks
from pmac_comp.physics.diagnose.records import DATED, prepare
from pmac_comp.physics.diagnose.spectra import _in_phase, _in_sequence
from pmac_comp.physics.model.drive import DriveModel

BENCH = load_bench("paper_x4")
FREQUENCY_Hz = 6.3
N = 8000


def _capture(**attributes: str) -> Capture:
    time = BENCH.servo_period_s * np.arange(N)
    command = 0.01 * np.sin(2 * np.pi * np.maximum(0.0, time - 0.2))
    return Capture(
        time_s=time,
        commanded_position_m=command,
        motor_position_m=command,
        torque_command_Nm=np.zeros(N),
        attributes=attributes,
    )


def test_dates_place_runs_in_their_session_unless_runs_would_overlap():
    dates = ["2026-03-04T10:00:12+00:00", "2026-03-04T10:00:00+00:00", "2026-03-04T10:00:30+00:00"]
    dated = prepare([_capture(start_utc=d) for d in dates], BENCH, prefix="run")
    assert [r.dated_s for r in dated] == [12.0, 0.0, 30.0]
    assert _in_sequence(dated) == (DATED,)
    at_once = prepare([_capture(start_utc=dates[0])] * 3, BENCH, prefix="run")
    assert [r.dated_s for r in at_once] == [None] * 3
    assert list(_in_sequence(at_once)[0].values()) == pytest.approx(
        [i * N * BENCH.servo_period_s for i in range(3)]
    )


def test_runs_whose_clock_goes_on_may_each_have_begun_anew():
    first, second = _capture(), _capture()
    later = replace(second, time_s=second.time_s + 20.0)
    assert _in_sequence(prepare([first, later], BENCH, prefix="run")) == ({0: 0.0, 1: 0.0},)


def test_start_times_bring_a_wave_into_phase_in_all_runs():
    records = prepare([_capture() for _ in range(4)], BENCH, prefix="run")
    turn = 2 * np.pi * FREQUENCY_Hz
    phases = np.array([0.3, 2.9, 5.1, 1.7])
    torques = [np.sin(turn * r.capture.time_s + p) for r, p in zip(records, phases, strict=True)]
    clocks = _in_phase(records, torques, FREQUENCY_Hz)
    away = np.array([turn * clocks[i] - (phases[i] - phases[0]) for i in range(4)])
    assert np.angle(np.exp(1j * away)) == pytest.approx(np.zeros(4), abs=0.02)


def test_every_run_but_the_first_has_a_start_time_of_its_own():
    model = DriveModel.base(BENCH).with_effect("thermal_growth")
    model = model.with_clocks({0: 0.0, 1: 10.0, 2: 5.0})
    directions = clock_directions(model, 1.0)
    assert [d.run for d in directions] == [1, 2]
    # Nothing has warmed up before it began.
    least = moved_clocks(model, directions, [d.lower for d in directions])
    assert least == pytest.approx({0: 0.0, 1: 0.0, 2: 0.0})
    assert clock_directions(model.without_effect("thermal_growth"), 1.0) == []
    assert clock_directions(model.with_clocks(DATED), 1.0) == []


def test_a_wave_beside_growth_keeps_its_phase_and_the_clock_of_the_session():
    model = DriveModel.base(BENCH).with_effect("external_force", {"frequency_Hz": 5.0})
    model = model.with_clocks({0: 0.0, 1: 0.13})
    merged = merged_clocks(model, "thermal_growth", {}, {0: 0.0, 1: 12.0})
    assert merged[1] == pytest.approx(12.0, abs=0.1)
    assert (merged[1] - 0.13) / 0.2 == pytest.approx(round((merged[1] - 0.13) / 0.2))
