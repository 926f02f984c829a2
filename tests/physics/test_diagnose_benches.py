"""A diagnosis on benches and runs beside the typical ones: a verdict or a clear error, always."""

from dataclasses import replace

import numpy as np
import pytest

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.diagnose import Diagnosis, diagnose
from pmac_comp.physics.model.drive import DriveModel, simulate
from pmac_comp.physics.model.effect import effect_library
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.servo.closed_loop import closed_loop_capture
from tests.generators.motions import sine

BENCH = load_bench("paper")
LIBRARY = {n: effect_library()[n] for n in ("backlash", "payload", "bias_force", "lead_cyclic")}
VERDICTS = ("named", "none", "unknown", "tie")
FORCE = "external_force_N"
SECONDS = 4.0


def runs(
    made: Bench, effects: dict[str, dict[str, float]], force_N: FloatArray | None = None
) -> list[Capture]:
    """Three motions of a drive of nominal values with effects hidden in it."""
    plant = make_plant(made, effects=effects, seed=3, spread=0.0)
    commands = [
        sine(made, half, frequency, SECONDS, centre)
        for half, frequency, centre in ((0.02, 0.8, 0.1), (0.05, 1.0, 0.0), (0.03, 0.9, -0.1))
    ]
    captures = []
    for command in commands:
        force = None if force_N is None else force_N[: command.size]
        capture = closed_loop_capture(made, plant, command, external_force_N=force)
        extra = dict(capture.extra) if force is None else {**capture.extra, FORCE: force}
        captures.append(replace(capture, extra=extra))
    return captures


def judged(captures: list[Capture], bench: Bench) -> Diagnosis:
    return diagnose(captures[:2], bench, validate=captures[2:], effects=LIBRARY)


def push() -> FloatArray:
    """Force of the loading screws: it swells to 150 N and back."""
    time = BENCH.servo_period_s * np.arange(round(SECONDS / BENCH.servo_period_s) + 1)
    return np.asarray(75.0 * (1.0 - np.cos(2 * np.pi * time / SECONDS)))


def test_a_known_external_force_is_not_taken_for_an_effect():
    found = judged(runs(BENCH, {}, push()), BENCH)
    assert found.named == ()
    assert found.gap_after_um < 0.3


def test_a_gap_is_found_beside_a_known_external_force():
    found = judged(runs(BENCH, {"backlash": {"gap_um": 4.0}}, push()), BENCH)
    assert found.named == ("backlash",)
    gap = found.estimates[0]
    # Reversals beside a swelling force are few, and friction's share in them is open: the estimate
    # has to say so itself, and to be right within that.
    assert abs(gap.value - 4.0) < 3.0 * gap.std
    assert gap.std < 0.1 * gap.value
    assert found.gap_after_um < 0.3 * found.gap_before_um


def test_a_bias_is_named_although_a_cable_that_rests_far_away_fits_it_as_well():
    library = {name: effect_library()[name] for name in ("cable_drag", "bias_force", "payload")}
    captures = runs(BENCH, {"bias_force": {"force_N": 40.0}})
    found = diagnose(captures[:2], BENCH, validate=captures[2:], effects=library)
    assert found.named == ("bias_force",)
    assert abs(abs(found.estimates[0].value) - 40.0) < 3.0 * found.estimates[0].std


@pytest.mark.parametrize("share", [0.5, pytest.param(1.5, marks=pytest.mark.slow)])
def test_other_servo_gains_than_the_typical_ones_lead_to_no_other_name(share):
    given = dict(BENCH.controller.ivariables)
    name = next(key for key in given if key.upper().endswith("30"))
    bench = with_controller(BENCH, {**given, name: round(share * given[name])})
    found = judged(runs(bench, {"backlash": {"gap_um": 4.0}}), bench)
    # Two short runs may not be enough evidence for a name; they must not lead to a wrong one.
    assert found.verdict in ("named", "unknown")
    assert set(found.named) <= {"backlash"}
    assert found.evidence[0].name == "backlash"
    if found.verdict == "named":
        assert found.gap_after_um < 0.5 * found.gap_before_um


def with_controller(bench: Bench, ivariables: dict[str, float]) -> Bench:
    controller = bench.controller.model_copy(update={"ivariables": ivariables})
    return bench.model_copy(update={"controller": controller})


@pytest.mark.slow
def test_a_bench_ten_per_cent_off_in_several_values_still_gets_a_verdict():
    off = {
        key: 1.1 * value if key != "efficiency" else 0.9 * value
        for key, value in BENCH.nominal.model_dump().items()
        if value is not None
    }
    truth = BENCH.model_copy(update={"nominal": BENCH.nominal.model_copy(update=off)})
    found = judged(runs(truth, {"backlash": {"gap_um": 4.0}}), BENCH)
    assert found.verdict in VERDICTS
    assert np.isfinite([found.gap_before_um, found.gap_after_um, found.noise_floor_um]).all()
    # Ten per cent more mass than the file says is a finding or an effect, not swallowed.
    assert "payload" in found.named or found.findings or found.verdict == "unknown"


def test_cogging_is_found_without_a_torque_channel():
    values = {"amplitude_Nm": 0.06, "order_per_rev": 4.0, "phase_rad": 0.5}
    captures = [replace(c, torque_command_Nm=None) for c in runs(BENCH, {"cogging": values})]
    library = {n: effect_library()[n] for n in ("cogging", "friction_per_rev", "backlash")}
    found = diagnose(captures, BENCH, effects=library)
    assert found.named == ("cogging",)
    assert found.estimates[0].value == pytest.approx(0.06, rel=0.05)


@pytest.mark.slow
def test_a_bias_out_of_the_library_is_not_called_a_cable():
    library = {n: effect_library()[n] for n in ("cable_drag", "backlash")}
    found = diagnose(runs(BENCH, {"bias_force": {"force_N": 80.0}}), BENCH, effects=library)
    assert found.verdict == "unknown"
    assert found.named == ()


def heavy_and_late() -> Bench:
    """Motor encoder only, a cascade for 300 kg whose lag is known; the mass is not."""
    emps = load_bench("emps")
    cascade = emps.controller.cascade
    assert cascade is not None
    tuned = cascade.model_copy(
        update={"kp_per_s": 60.0, "kv_V_per_m_per_s": 1200.0, "gain_N_per_V": 35.0}
    )
    lag = emps.nominal.model_copy(
        update={"current_bandwidth_Hz": 350.0, "actuator_delay_us": 1000.0}
    )
    controller = emps.controller.model_copy(update={"cascade": tuned})
    return emps.model_copy(update={"controller": controller, "nominal": lag})


def test_an_axis_much_heavier_than_usual_that_nobody_weighed_gets_no_name():
    # With 50 kg this loop swings between the limits of its torque, and no step led out of that: a
    # torque limit got the name.
    bench = heavy_and_late()
    drive = DriveModel.base(bench).with_parameters(
        {"chain.mass_kg": 300.0, "coulomb.guide_N": 90.0, "viscous.guide_Ns_per_m": 650.0}
    )
    time_s = bench.servo_period_s * np.arange(4000)
    captures = []
    for half_m, frequency_Hz in ((0.05, 0.8), (0.02, 1.7), (0.04, 1.0)):
        command = half_m * (1.0 - np.cos(2.0 * np.pi * frequency_Hz * time_s))
        seen = simulate(drive, command, quantise=True)
        captures.append(
            Capture(
                time_s, command, seen.motor_position_m, torque_command_Nm=seen.torque_command_Nm
            )
        )
    offered = {n: effect_library()[n] for n in ("torque_saturation", "payload", "bias_force")}
    found = diagnose(captures[:2], bench, validate=captures[2:], effects=offered)
    assert found.verdict == "none"
    assert found.model.parameters["chain.mass_kg"] == pytest.approx(300.0, rel=0.01)
    assert found.gap_after_um < 1.0
