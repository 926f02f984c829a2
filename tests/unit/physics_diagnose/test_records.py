"""What a run begins with."""

from dataclasses import replace

import numpy as np
import pytest

from pmac_comp.base.errors import CaptureError, NotIdentifiable
from pmac_comp.base.threads import working
from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.diagnose import diagnose
from pmac_comp.physics.diagnose.growth import first_noise
from pmac_comp.physics.diagnose.records import Record, prepare
from pmac_comp.physics.diagnose.refit import evaluate, linearised
from pmac_comp.physics.diagnose.workbench import Workbench, split
from pmac_comp.physics.model import slots
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.start import Start

BENCH = load_bench("paper_x4")
HELD_Nm = 0.315


@pytest.fixture
def flickering() -> Capture:
    """A run that begins at rest, its encoder between two counts and its command not quite exact."""
    gains = DriveModel.base(BENCH).kernel_vector()
    period_s = BENCH.servo_period_s
    time = period_s * np.arange(2000)
    command = 0.05 * np.maximum(0.0, time - 0.03) + 1e-14 * np.sin(900.0 * time)
    motor = command + BENCH.motor_resolution_m * (np.arange(2000) % 4 == 0)
    torque = HELD_Nm + gains[slots.KP] * (command - motor)
    torque -= gains[slots.KD] * np.gradient(motor - command, period_s)
    return Capture(
        time_s=time,
        commanded_position_m=command,
        motor_position_m=motor,
        torque_command_Nm=torque,
    )


def test_a_flickering_encoder_does_not_hide_what_the_integrator_holds(flickering):
    (record,) = prepare([flickering], BENCH, prefix="run")
    assert record.start.torque_Nm == pytest.approx(HELD_Nm, abs=2e-3)


def test_a_run_that_has_no_file_is_told_by_its_motion(flickering):
    """An improvement told of "capture 12", and nobody knew which of its files that is."""
    at_work = flickering.with_attributes(motion="move 41 mm 465 mm/s")
    stored = at_work.with_attributes(name="03_move.h5")
    found = prepare([at_work, stored, flickering], BENCH, prefix="capture")
    assert [r.name for r in found] == ["move 41 mm 465 mm/s", "03_move.h5", "capture 3"]


@pytest.fixture
def axis() -> Capture:
    """A run of 40 mm and back with a table that lags by 3 um, and no torque."""
    time = BENCH.servo_period_s * np.arange(4000)
    command = 0.02 * (1.0 - np.cos(4.0 * time))
    step_m = BENCH.motor_resolution_m
    motor = step_m * np.round(command / step_m)
    table = command - 3e-6 * np.sign(np.sin(4.0 * time))
    return Capture(
        time_s=time,
        commanded_position_m=command,
        motor_position_m=motor,
        table_position_m=table,
    )


@pytest.mark.parametrize(
    ("column", "factor", "says"),
    [
        ("table_position_m", -1.0, "counts against the motor"),
        ("table_position_m", 2.0, "the table moved 2"),
        ("motor_position_m", 0.5, "the motor moved 0.5"),
        ("motor_position_m", -1.0, "moved against the command"),
    ],
)
def test_channels_that_are_no_positions_of_one_axis_are_refused(axis, column, factor, says):
    prepare([axis], BENCH, prefix="run")
    wrong = replace(axis, **{column: factor * getattr(axis, column)})
    with pytest.raises(CaptureError, match=says):
        prepare([wrong], BENCH, prefix="run")


def test_a_worn_nut_on_a_short_way_is_no_wrong_scale(axis):
    short = replace(
        axis,
        commanded_position_m=axis.commanded_position_m / 100.0,
        motor_position_m=axis.motor_position_m / 100.0,
        table_position_m=axis.motor_position_m / 100.0 * 0.97,
    )
    prepare([short], BENCH, prefix="run")


def test_runs_that_move_only_where_they_are_fitted_are_refused():
    # The last sixth moves; the second and the fifth are held back.
    command = np.concatenate([np.zeros(5000), 1e-3 * (1.0 - np.cos(0.02 * np.arange(900)))])
    resting = Capture(
        time_s=BENCH.servo_period_s * np.arange(command.size),
        commanded_position_m=command,
        motor_position_m=command,
        table_position_m=command,
    )
    with pytest.raises(NotIdentifiable) as refused:
        diagnose([resting], BENCH)
    assert refused.value.code == "PC-DIA-017"
    assert "--validate" in refused.value.hint


def test_the_same_model_is_not_simulated_again_and_another_of_its_values_is(flickering):
    (record,) = prepare([flickering], BENCH, prefix="capture")
    model = DriveModel.base(BENCH)
    first = record.response(model)
    assert record.masked(np.zeros_like(record.valid)).response(model) is first
    begun = replace(record, start=Start(torque_Nm=0.3))
    assert begun.response(model) is not first
    assert record.response(model, quantise=True) is not first
    again = record.response(model.with_parameters({}))
    assert again is not first
    assert np.array_equal(again.table_position_m, first.table_position_m)
    probed = record.response(model, probe_torque_Nm=np.ones(record.desired_m.size))
    assert not np.array_equal(probed.table_position_m, first.table_position_m)


def test_columns_of_a_model_serve_again_until_it_moves(flickering, monkeypatch):
    simulated = []
    once = Record.simulated_m

    def counted(self, model, *, substeps=None):
        simulated.append(model)
        return once(self, model, substeps=substeps)

    monkeypatch.setattr(Record, "simulated_m", counted)
    records = prepare([flickering], BENCH, prefix="capture")
    with working() as executor:
        bench = Workbench(records, split(records, []), executor)
        bench = first_noise(bench, DriveModel.base(BENCH))
        point = evaluate(bench, DriveModel.base(BENCH))
        simulated.clear()
        _, directions, columns = linearised(bench, point, None)
        assert len(simulated) == len(directions) + 1
        _, _, again = linearised(bench, point, None)
        assert len(simulated) == len(directions) + 1
        assert np.array_equal(again[0], columns[0])
        linearised(bench, point, None, step_frac=0.004)
        assert len(simulated) == 2 * (len(directions) + 1)
        moved = evaluate(bench, point.model.with_parameters({"coulomb.guide_N": 30.0}))
        simulated.clear()
        _, _, other = linearised(bench, moved, None)
        assert len(simulated) == len(directions) + 1
        assert not np.array_equal(other[0], columns[0])
