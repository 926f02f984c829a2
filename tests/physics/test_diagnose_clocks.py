"""Effects that depend on time, in runs that begin when they do: pumps, and sessions that go on."""

import math
from dataclasses import replace

import numpy as np
import pytest

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.diagnose import Diagnosis, diagnose
from pmac_comp.physics.model.drive import DriveModel, simulate
from pmac_comp.physics.model.effect import effect_library

BENCH = load_bench("paper_x4")
PERIOD_s = BENCH.servo_period_s
LENGTH_s = 3.0
PAUSE_s = 4.0
RUNS = 4
OFFERED = (
    "external_force",
    "thermal_growth",
    "friction_warmup",
    "lead_linear",
    "scale_slope",
    "stribeck",
    "viscous_nonlinear",
    "bias_force",
)


def _time() -> FloatArray:
    return PERIOD_s * np.arange(round(LENGTH_s / PERIOD_s))


def _command(run: int) -> FloatArray:
    """Tones around a place of their own in every run, with a soft start."""
    time = _time()
    soft = np.clip((time - 0.1) / 0.4, 0.0, 1.0)
    soft = soft**3 * (10.0 - 15.0 * soft + 6.0 * soft**2)
    wide = 0.03 * np.sin(2 * np.pi * (0.6 + 0.1 * run) * time)
    fine = 0.004 * np.sin(2 * np.pi * (1.7 + 0.4 * run) * time + run)
    return np.asarray(soft * (wide + fine) + (-0.15, 0.12, -0.05, 0.18)[run])


def _run(
    run: int, *, force_N: FloatArray | None = None, strain: FloatArray | None = None
) -> Capture:
    """A run of the base drive with a force or a strain given as plain formulas of time."""
    command = _command(run)
    response = simulate(DriveModel.base(BENCH), command, external_force_N=force_N, quantise=True)
    rng = np.random.default_rng([91, run])
    table = response.table_position_m + 3e-8 * rng.standard_normal(command.size)
    if strain is not None:
        table = table + strain * (command + 0.45)
    return Capture(
        time_s=_time(),
        commanded_position_m=command,
        motor_position_m=response.motor_position_m,
        table_position_m=table,
        torque_command_Nm=response.torque_command_Nm,
    )


def _diagnosed(captures: list[Capture], validate: list[Capture]) -> Diagnosis:
    library = {name: effect_library()[name] for name in OFFERED}
    return diagnose(captures, BENCH, validate=validate, effects=library)


def _value(found: Diagnosis, name: str) -> float:
    return next(e.value for e in found.estimates if e.name == name)


def test_a_pump_that_knows_nothing_of_the_runs_is_named_with_its_force():
    amplitude_N, frequency_Hz = 25.0, 6.3
    phases = (0.3, 2.9, 5.1, 1.7)
    runs = [
        _run(i, force_N=amplitude_N * np.sin(2 * np.pi * frequency_Hz * _time() + phases[i]))
        for i in range(RUNS)
    ]
    found = _diagnosed(runs[:3], runs[3:])
    assert found.named == ("external_force",)
    assert _value(found, "external_force.amplitude_N") == pytest.approx(amplitude_N, rel=0.05)
    assert _value(found, "external_force.frequency_Hz") == pytest.approx(frequency_Hz, abs=0.03)
    assert found.gap_after_um < 1.3 * found.noise_floor_um


@pytest.mark.parametrize(
    "clock", ["dated", *(pytest.param(c, marks=pytest.mark.slow) for c in ("unknown", "restarts"))]
)
def test_growth_is_named_whether_runs_restart_it_or_are_pieces_of_a_session(clock):
    final, time_constant_s = 40e-6, 12.0
    runs = []
    for i in range(RUNS):
        warm_s = 0.0 if clock == "restarts" else i * (LENGTH_s + PAUSE_s)
        strain = final * (1.0 - np.exp(-(warm_s + _time()) / time_constant_s))
        capture = _run(i, strain=strain)
        if clock == "dated":
            date = f"2026-03-04T10:00:{math.floor(warm_s):02d}.000+00:00"
            capture = replace(capture, attributes={"start_utc": date})
        runs.append(capture)
    found = _diagnosed(runs[:3], runs[3:])
    assert found.named == ("thermal_growth",)
    assert found.gap_after_um < 0.5 * found.gap_before_um
    assert any("no start times" in s for s in found.statements) == (clock != "dated")
    if clock == "dated":
        assert _value(found, "thermal_growth.final_um_per_m") == pytest.approx(40.0, rel=0.1)
        assert found.gap_after_um < 1.5 * found.noise_floor_um
