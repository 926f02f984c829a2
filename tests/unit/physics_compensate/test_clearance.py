"""A gap that the model does not hold, found beside what it hides behind."""

from dataclasses import replace

import numpy as np
import pytest

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.clearance import measured_clearance, settled, with_clearance
from pmac_comp.physics.model.drive import DriveModel, simulate
from pmac_comp.physics.signals.trajectory import sinusoid, triangle

BENCH = load_bench("paper")
TRUE = {"coulomb.guide_N": 45.0, "coulomb.motor_Nm": 0.2, "coulomb.nut_Nm": 0.1}
PERIOD = BENCH.servo_period_s
MOTIONS = (
    sinusoid(period_s=PERIOD, amplitude_m=0.01, frequency_Hz=4.0, cycles=4.0, centre_m=-0.2),
    sinusoid(period_s=PERIOD, amplitude_m=0.04, frequency_Hz=0.8, cycles=2.0, centre_m=0.1),
    triangle(
        period_s=PERIOD,
        amplitude_m=2e-3,
        speed_m_per_s=4e-3,
        cycles=2,
        centre_m=0.0,
        acceleration_m_per_s2=0.5,
    ),
)


def runs_of(model: DriveModel) -> list[Capture]:
    """Runs of a drive with readings of an encoder and a scale."""
    found = []
    for motion in MOTIONS:
        run = simulate(model, motion)
        found.append(
            Capture(
                run.time_s,
                run.commanded_position_m,
                steps(run.motor_position_m, BENCH.motor_resolution_m),
                table_position_m=steps(run.table_position_m + 7e-6, BENCH.scale_resolution_m),
                torque_command_Nm=run.torque_command_Nm,
            )
        )
    return found


def steps(position_m: FloatArray, size_m: float | None) -> FloatArray:
    return np.round(position_m / (size_m or 1e-9)) * (size_m or 1e-9)


def shifted(run: Capture, torque_Nm: float) -> Capture:
    assert run.torque_command_Nm is not None
    return replace(run, torque_command_Nm=run.torque_command_Nm + torque_Nm)


def winding(guide_N: float, stiffness: float) -> DriveModel:
    """Model without a gap whose guide has more friction, and whose motor has less."""
    true = DriveModel.base(BENCH, TRUE)
    per_N = BENCH.pitch_m / (2.0 * np.pi)
    return true.with_parameters(
        {
            "coulomb.guide_N": guide_N,
            "coulomb.motor_Nm": max(0.0, 0.2 - (guide_N - 45.0) * per_N),
            "chain.axial_stiffness_N_per_m": stiffness
            * true.parameters["chain.axial_stiffness_N_per_m"],
        }
    )


@pytest.mark.parametrize("gap_m", [1e-6, pytest.param(4e-6, marks=pytest.mark.slow)])
def test_gap_taken_for_friction_is_found_with_what_it_hid_behind(gap_m: float) -> None:
    true = DriveModel.base(BENCH, TRUE).with_effect("backlash", {"gap_m": gap_m})
    found = measured_clearance(winding(110.0, 0.7), runs_of(true), None)
    assert found is not None
    assert not found.is_soft
    assert found.gap_m == pytest.approx(gap_m, abs=0.15e-6)
    assert found.values["coulomb.guide_N"] == pytest.approx(45.0, rel=0.1)
    assert found.values["chain.axial_stiffness_N_per_m"] == pytest.approx(
        true.parameters["chain.axial_stiffness_N_per_m"], rel=0.1
    )
    assert found.with_um < 0.8 * found.without_um
    # What the guide loses nut and motor keep: the torque measured the sum.
    loose = with_clearance(winding(110.0, 0.7), found.values)
    assert loose.parameters["backlash.gap_m"] == found.gap_m
    lost_Nm = (110.0 - found.values["coulomb.guide_N"]) * BENCH.pitch_m / (2.0 * np.pi)
    turning = [
        model.parameters["coulomb.motor_Nm"] + model.parameters["coulomb.nut_Nm"]
        for model in (winding(110.0, 0.7), loose)
    ]
    assert turning[1] == pytest.approx(turning[0] + lost_Nm)


def test_viscous_friction_that_a_gap_put_at_the_nut_comes_back_to_the_guide() -> None:
    # Beside a gap table minus motor grows less with speed than a model without one would have it.
    viscous = {"viscous.guide_Ns_per_m": 200.0, "viscous.nut_Nms_per_rad": 1e-3}
    true = DriveModel.base(BENCH, {**TRUE, **viscous})
    moved_Nms = 185.0 * BENCH.lead_m_per_rad**2
    at_nut = {"viscous.guide_Ns_per_m": 15.0, "viscous.nut_Nms_per_rad": 1e-3 + moved_Nms}
    start = winding(90.0, 0.8).with_parameters(at_nut)
    found = measured_clearance(start, runs_of(true.with_effect("backlash", {"gap_m": 2e-6})), None)
    assert found is not None
    assert found.values["viscous.guide_Ns_per_m"] == pytest.approx(200.0, rel=0.15)
    assert found.values["coulomb.guide_N"] == pytest.approx(45.0, rel=0.1)
    loose = with_clearance(start, found.values)  # the torque measured the sum
    assert total_viscous_Nms(loose) == pytest.approx(total_viscous_Nms(start))


def total_viscous_Nms(model: DriveModel) -> float:
    """Viscous friction of the whole drive at the motor."""
    own = model.parameters
    turning = own["viscous.nut_Nms_per_rad"] + own["viscous.motor_Nms_per_rad"]
    return turning + own["viscous.guide_Ns_per_m"] * BENCH.lead_m_per_rad**2


@pytest.mark.parametrize("force_N", [150.0, -60.0])
@pytest.mark.slow
def test_load_that_presses_the_nut_on_one_flank_is_found_with_the_gap(force_N: float) -> None:
    loaded = DriveModel.base(BENCH, TRUE).with_effect("bias_force", {"force_N": force_N})
    true = loaded.with_effect("backlash", {"gap_m": 4e-6})
    found = measured_clearance(winding(70.0, 0.9), runs_of(true), None)
    assert found is not None
    assert found.gap_m == pytest.approx(4e-6, rel=0.1)
    assert found.values["bias_force.force_N"] == pytest.approx(force_N, rel=0.1)
    whole = with_clearance(winding(70.0, 0.9), found.values)
    assert {"backlash", "bias_force"} <= set(whole.effects)
    assert whole.parameters["bias_force.force_N"] == found.values["bias_force.force_N"]


def test_load_of_the_motor_presses_no_nut() -> None:
    # An offset of the output, or a weight on a belt of the motor's.
    true = DriveModel.base(BENCH, TRUE).with_effect("backlash", {"gap_m": 4e-6})
    runs = [shifted(run, 0.2) for run in runs_of(true)]
    found = measured_clearance(winding(70.0, 0.9), runs, None)
    assert found is not None
    assert found.gap_m == pytest.approx(4e-6, rel=0.1)
    assert "bias_force.force_N" not in found.values


@pytest.mark.parametrize(
    ("half_m", "ratio"), [(2e-6, 0.4), pytest.param(5e-6, 0.6, marks=pytest.mark.slow)]
)
def test_nut_without_preload_is_told_from_play(half_m: float, ratio: float) -> None:
    zone = {"half_width_m": half_m, "stiffness_ratio": ratio}
    true = DriveModel.base(BENCH, TRUE).with_effect("preload_loss", zone)
    found = measured_clearance(winding(90.0, 0.8), runs_of(true), None)
    assert found is not None
    assert found.is_soft
    assert found.values["preload_loss.half_width_m"] == pytest.approx(half_m, rel=0.2)
    assert found.gap_m == pytest.approx(2.0 * (1.0 - ratio) * half_m, rel=0.2)
    soft = with_clearance(winding(90.0, 0.8), found.values)
    assert soft.parameters["preload_loss.stiffness_ratio"] == pytest.approx(ratio, rel=0.2)
    assert "backlash" not in soft.effects


@pytest.mark.parametrize(
    ("guide_N", "stiffness"), [pytest.param(45.0, 1.0, marks=pytest.mark.slow), (70.0, 0.85)]
)
def test_wind_up_by_friction_is_no_gap(guide_N: float, stiffness: float) -> None:
    runs = runs_of(DriveModel.base(BENCH, TRUE))
    assert measured_clearance(winding(guide_N, stiffness), runs, None) is None


def test_model_with_a_gap_of_its_own_is_left_alone() -> None:
    true = DriveModel.base(BENCH, TRUE).with_effect("backlash", {"gap_m": 4e-6})
    assert measured_clearance(true, runs_of(true), None) is None


def test_samples_before_the_nut_has_moved_are_left_out() -> None:
    run = runs_of(DriveModel.base(BENCH, TRUE))[0]
    use = settled(run)
    assert not use[0]
    assert use[-1]
    way = np.abs(run.commanded_position_m - run.commanded_position_m[0])
    assert way[np.argmax(use)] == pytest.approx(0.2e-3, rel=0.2)
