"""A law for a drive at whose table something drags over millimetres, and the passes it costs."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.evaluation import friction_state
from pmac_comp.physics.model.drive import DriveModel, simulate
from pmac_comp.physics.signals.trajectory import sinusoid
from pmac_comp.workflow.compensation import computing
from pmac_comp.workflow.compensation.computing import compute_compensation
from pmac_comp.workflow.compensation.file import Compensation
from pmac_comp.workflow.law.dynamic_law import drag_remarks
from pmac_comp.workflow.law.law_cost import ASKED, MOST_FRAC, fitting_cycles, share_frac

pytestmark = pytest.mark.slow  # half a minute; what it is made of is tested in test_trim

PAPER = load_bench("paper_x4")
# Where the plain law fits into each servo cycle, and not with what drags beside it.
SLOWER = PAPER.controller.model_copy(update={"cpu_clock_MHz": 70.0})
BENCH = PAPER.model_copy(update={"controller": SLOWER})
MODEL = DriveModel.base(BENCH)
CYCLES_OF = partial(fitting_cycles, BENCH)
DRAG_m, DISTANCE_m = 0.3e-6, 4e-3


def run(amplitude_m: float, frequency_Hz: float) -> Capture:
    period_s = BENCH.servo_period_s
    motion = sinusoid(
        period_s=period_s, amplitude_m=amplitude_m, frequency_Hz=frequency_Hz, cycles=3.0,
        centre_m=0.0,
    )  # fmt: skip
    found = simulate(MODEL, motion)
    v = np.gradient(found.motor_position_m, period_s)
    return Capture(
        found.time_s,
        found.commanded_position_m,
        found.motor_position_m,
        table_position_m=found.table_position_m - DRAG_m * friction_state(v, DISTANCE_m, period_s),
        torque_command_Nm=found.torque_command_Nm,
    )


CAPTURES = tuple(run(a, f) for a, f in ((0.002, 2.0), (0.01, 2.0), (0.04, 1.0), (0.06, 0.5)))


@pytest.fixture(scope="module")
def compensation() -> Compensation:
    return compute_compensation(BENCH, MODEL, route="law", captures=CAPTURES)


def test_law_holds_the_drag_in_every_second_cycle(compensation: Compensation) -> None:
    law = compensation.law
    assert law.drag_m == pytest.approx(DRAG_m, rel=0.1)
    assert law.drag_distance_m == DISTANCE_m
    assert law.torque_drag_Nm > 0.0
    assert law.every_cycles == 2
    assert law.provenance[ASKED] == 1
    assert share_frac(BENCH, replace(law, every_cycles=1)) > MOST_FRAC
    assert share_frac(BENCH, replace(law, every_cycles=1, drag_m=0.0)) < MOST_FRAC
    (text,) = drag_remarks(law)
    assert "0.27 um" in text
    assert "within 4 mm" in text


def test_drag_that_plc_0_has_no_time_for_is_said(compensation: Compensation) -> None:
    fast = replace(compensation.law, drag_m=0.0, torque_drag_Nm=0.0, every_cycles=1, provenance={})

    def of(route: str, law: computing.CompensationLaw = fast) -> computing.CompensationLaw:
        return computing._with_drag_that_fits(CYCLES_OF, MODEL, route, law, CAPTURES, None, None)

    left = of("law")
    assert left.drag_m == 0.0
    (text,) = drag_remarks(left)
    assert "--every 2" in text
    assert of("servo").drag_m > 0.0
    assert of("law", replace(fast, every_cycles=2)).drag_m > 0.0
    assert drag_remarks(fast) == []
