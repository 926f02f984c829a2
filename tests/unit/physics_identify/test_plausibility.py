"""Captures that contradict the bench file are refused with what to look at."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from pmac_comp.base.errors import CaptureError
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.identify.plausibility import require_plausible, require_positions
from pmac_comp.physics.signals.trajectory import sinusoid
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.servo.closed_loop import closed_loop_capture

BENCH = load_bench("paper")
MOTION = sinusoid(
    period_s=BENCH.servo_period_s, amplitude_m=0.01, frequency_Hz=3.0, cycles=5, centre_m=0.1
)
RUN = closed_loop_capture(BENCH, make_plant(BENCH, effects=None, seed=3), MOTION.position_m)
TABLE = RUN.table_position_m
TORQUE = RUN.torque_command_Nm
assert TABLE is not None
assert TORQUE is not None
ALIVE = np.arange(RUN.n) < RUN.n // 2
FROZEN = np.asarray(np.where(ALIVE, TABLE, TABLE[RUN.n // 2]), dtype=np.float64)


def repeated() -> Capture:
    index = np.arange(RUN.n) // 2 * 2
    assert TABLE is not None
    assert TORQUE is not None
    return replace(
        RUN,
        commanded_position_m=RUN.commanded_position_m[index],
        motor_position_m=RUN.motor_position_m[index],
        table_position_m=TABLE[index],
        torque_command_Nm=TORQUE[index],
        desired_position_m=None,
        extra={},
    )


SPOILT: dict[str, tuple[Capture, str]] = {
    "clipped torque": (replace(RUN, torque_command_Nm=np.clip(TORQUE, -1.0, 1.0)), "clipped"),
    "swapped": (replace(RUN, motor_position_m=TABLE, table_position_m=RUN.motor_position_m),
                "swapped"),
    "reversed scale": (replace(RUN, table_position_m=-TABLE), "sign"),
    "scale in um": (replace(RUN, table_position_m=1e3 * TABLE), "units"),
    "dead scale": (replace(RUN, table_position_m=np.full(RUN.n, 0.1)), "connected"),
    "scale freezes": (
        replace(RUN, table_position_m=FROZEN), "cable, supply and reading head of the scale"
    ),
    "torque reversed": (replace(RUN, torque_command_Nm=-TORQUE), "sign"),
    "torque in percent": (replace(RUN, torque_command_Nm=5.0 * TORQUE), "torque_per_dac_Nm"),
    "torque in mN m": (replace(RUN, torque_command_Nm=1e3 * TORQUE), "in N m"),
    "repeated samples": (repeated(), "rate"),
    "motor without power": (
        replace(RUN, motor_position_m=np.full(RUN.n, 0.1), table_position_m=np.full(RUN.n, 0.1)),
        "powered",
    ),
    "motor in counts": (replace(RUN, motor_position_m=RUN.motor_position_m * 1e3), "units"),
    "motor reversed": (replace(RUN, motor_position_m=-RUN.motor_position_m), "sign"),
}  # fmt: skip


@pytest.mark.faults
@pytest.mark.parametrize("case", SPOILT)
def test_f40_a_spoilt_capture_is_told(case: str) -> None:
    capture, word = SPOILT[case]
    with pytest.raises(CaptureError) as caught:
        require_plausible([capture], BENCH)
    assert word in f"{caught.value.message} {caught.value.hint}"


@pytest.mark.faults
def test_f40_half_the_pitch_is_told() -> None:
    screw = BENCH.screw.model_copy(update={"pitch_mm": 5.0})
    with pytest.raises(CaptureError, match="torque per acceleration"):
        require_plausible([RUN], BENCH.model_copy(update={"screw": screw}))


@pytest.mark.faults
@pytest.mark.parametrize(("pitch_mm", "counts"), [(20.0, 10_000.0), (10.0, 5_000.0)])
def test_f40_readings_between_two_counts_are_told(pitch_mm: float, counts: float) -> None:
    # Twice the pitch changes the inertia at the motor by 8 % only; the counts give it away.
    screw = BENCH.screw.model_copy(update={"pitch_mm": pitch_mm})
    encoder = BENCH.encoder.model_copy(update={"counts_per_rev": counts})
    bench = BENCH.model_copy(update={"screw": screw, "encoder": encoder})
    with pytest.raises(CaptureError, match=r"multiples of 1 um; by the bench file a count is 2 um"):
        require_plausible([RUN], bench)


def test_a_frozen_scale_passes_where_its_samples_are_marked() -> None:
    require_plausible([replace(RUN, table_position_m=FROZEN, valid=ALIVE)], BENCH)


@pytest.mark.parametrize("frequency_Hz", [0.5, 1.0, 1.5])
def test_a_slow_run_that_torque_ripple_shakes_passes(frequency_Hz: float) -> None:
    ripple = {"cogging": {"amplitude_Nm": 0.4, "order_per_rev": 20.0}}
    slow = sinusoid(
        period_s=BENCH.servo_period_s, amplitude_m=0.01, frequency_Hz=frequency_Hz, cycles=3
    )
    plant = make_plant(BENCH, effects=ripple, seed=3)
    require_plausible([closed_loop_capture(BENCH, plant, slow.position_m)], BENCH)


def test_readings_without_counts_pass() -> None:
    exact = replace(
        RUN,
        motor_position_m=RUN.extra["true_motor_position_m"],
        table_position_m=RUN.extra["true_table_position_m"],
    )
    require_plausible([exact], BENCH)
    ramp = np.linspace(0.0, 0.6e-6 * RUN.n, RUN.n)
    steady = replace(
        RUN, commanded_position_m=ramp, desired_position_m=None, motor_position_m=ramp,
        table_position_m=ramp, torque_command_Nm=None, extra={},
    )  # fmt: skip
    require_plausible([steady], BENCH)


def weaker(bench: Bench) -> Bench:
    drive = bench.drive.model_copy(update={"torque_limit_Nm": 2.0})
    return bench.model_copy(update={"drive": drive})


@pytest.mark.parametrize("change", [lambda bench: bench, weaker])
def test_whole_captures_pass_saturated_or_not(change: Callable[[Bench], Bench]) -> None:
    bench = change(BENCH)
    run = closed_loop_capture(bench, make_plant(bench, effects={}, seed=4), MOTION.position_m)
    require_plausible([run], bench)


def test_a_slender_screw_lets_a_fast_sine_grow_and_a_wrong_scale_is_still_told() -> None:
    # At 4.5 Hz inertia stretches a screw with 35 Hz by 1.6 per cent of the way; at 1 Hz by 0.1.
    soft = BENCH.nominal.model_copy(update={"axial_stiffness_N_per_um": 6.5})
    slender = BENCH.model_copy(update={"nominal": soft})

    def grown(ratio: float, frequency_Hz: float) -> Capture:
        way = sinusoid(
            period_s=BENCH.servo_period_s, amplitude_m=0.01, frequency_Hz=frequency_Hz, cycles=5
        )
        at = way.position_m
        return Capture(way.time_s, at, at, table_position_m=ratio * at)

    require_positions(grown(1.02, 4.5), slender, "run")
    for bench, ratio, frequency_Hz in (
        (BENCH, 1.02, 4.5),
        (slender, 1.06, 4.5),
        (slender, 1.02, 1.0),
    ):
        with pytest.raises(CaptureError, match="the table moved"):
            require_positions(grown(ratio, frequency_Hz), bench, "run")


@pytest.mark.parametrize("frequency_Hz", [25.0, 40.0])
def test_a_motion_faster_than_the_loop_is_not_taken_for_wrong_counts_or_a_wrong_sign(frequency_Hz):
    law = BENCH.controller
    slack = {name: value * 0.5 for name, value in law.ivariables.items() if name == "I130"}
    without = {**law.ivariables, **slack, "I132": 0.0, "I135": 0.0}
    bench = BENCH.model_copy(update={"controller": law.model_copy(update={"ivariables": without})})
    motion = sinusoid(
        period_s=bench.servo_period_s, amplitude_m=2e-4, frequency_Hz=frequency_Hz, cycles=60
    )
    run = closed_loop_capture(bench, make_plant(bench, effects=None, seed=3), motion.position_m)
    in_step = np.polyfit(run.commanded_position_m, run.motor_position_m, 1)[0]
    assert in_step < 0.7
    require_positions(run, bench, "run")
    # The same on top of a slow motion, with a motor that counts the wrong way.
    slow_m = 5e-3 * np.sin(2.0 * np.pi * 0.5 * run.time_s)
    reversed_run = replace(
        run,
        commanded_position_m=run.commanded_position_m + slow_m,
        motor_position_m=-run.motor_position_m - slow_m,
        desired_position_m=None,
    )
    with pytest.raises(CaptureError, match="moved against the command"):
        require_positions(reversed_run, bench, "run")
