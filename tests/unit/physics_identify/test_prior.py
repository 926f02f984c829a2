"""What holds parameters that no maker states."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.identify import problem as own
from pmac_comp.physics.identify.records import nuisances, prepare
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.signals.trajectory import sinusoid
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.servo.closed_loop import closed_loop_capture

BENCH = load_bench("paper")


@pytest.mark.parametrize(("force_N", "least_N"), [(5.0, 19.0), (-5900.0, 5900.0)])
def test_the_prior_of_a_free_parameter_is_as_wide_as_what_the_fit_starts_from(
    force_N: float, least_N: float
) -> None:
    run = sinusoid(period_s=BENCH.servo_period_s, amplitude_m=0.01, frequency_Hz=3.0, cycles=2)
    capture = closed_loop_capture(BENCH, make_plant(BENCH, effects={}), run.position_m)
    records = [prepare(capture, BENCH)]
    columns, _ = nuisances(records, BENCH, static_map=False)
    start = DriveModel.base(BENCH).with_effect("bias_force", {"force_N": force_N})
    with ThreadPoolExecutor(1) as workers:
        found = own.problem_of(records, columns, start, BENCH, None, workers, None, 1)
    names = [spec.name for spec in found.specs]
    std = found.scales / np.sqrt(found.weight)
    assert std[names.index("bias_force.force_N")] >= least_N
    mass = names.index("chain.table_mass_kg")  # a tolerance of 5 % is two standard deviations
    assert std[mass] == pytest.approx(0.025 * BENCH.nominal.table_mass_kg)  # type: ignore[operator]
