"""A sensor that fails in a run stops the axis while it runs, and the fault is named (F25)."""

from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from pmac_comp.base.errors import CaptureError, MotorNotSafe
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.machine.controller.motors import motors
from pmac_comp.physics.signals.trajectory import trapezoid
from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.plant import make_plant
from pmac_comp.workflow.capture import capturing
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.samples import gather_plan
from pmac_comp.workflow.capture.simulated import embedded
from pmac_comp.workflow.motion.approach import APPROACHED
from pmac_comp.workflow.motion.motions import Motion, parse_motion, relaxing

BENCH = load_bench("paper")
FAIL_AT_m = 0.012


class FailingDrive:
    """The bench's drive; a sensor fails where the table first passes a position."""

    def __init__(self, bench: Bench, fault: str) -> None:
        self.drive = make_plant(bench)
        self.fault = fault
        self.held: tuple[float, float] | None = None
        self.slipped_m = 0.0

    def reset(self, table_position_m: float = 0.0) -> None:
        self.drive.reset(table_position_m)
        self.held = None

    def step(self, torque_command_Nm: float) -> tuple[float, float]:
        angle, table = self.drive.step(torque_command_Nm)
        if self.fault == "REVERSED":
            return -angle, table
        if self.held is None:
            self.held = (angle, table) if table > FAIL_AT_m else None
            return angle, table
        if self.fault == "SCALE_DEAD":
            return angle, self.held[1]
        if self.fault == "ENCODER_DEAD":
            return self.held[0], table
        self.slipped_m = min(self.slipped_m + 2e-6, 2e-3)
        return angle, table - self.slipped_m


def run_until_failure(
    bench: Bench, fault: str, motion: Motion, said: tuple[str, ...] = ()
) -> motors.MotorStatus:
    """Status of the motor after a run that must fail by the fault."""
    with embedded(Card(bench, plant=FailingDrive(bench, fault))) as link:
        axis = Axis(link, bench)
        axis.enable()
        with pytest.raises(MotorNotSafe) as failure:
            axis.run(motion)
        assert failure.value.context["fault"] in (said or (fault,))
        link.clock.sleep_s(0.3)
        return motors.read_motor(link, axis.motor).status


@pytest.mark.parametrize("fault", ["SCALE_DEAD", "ENCODER_DEAD", "SLIP"])
def test_f25_a_failing_sensor_stops_the_axis(fault: str) -> None:
    motion = parse_motion("sine:amplitude_mm=25,frequency_Hz=0.8,cycles=3", BENCH)
    status = run_until_failure(BENCH, fault, motion)
    # A loop whose encoder may lie is not held; with a dead scale it decelerates and holds.
    assert status.is_killed is (fault != "SCALE_DEAD")
    assert status.is_killed or status.is_commanded_still


def test_f25_an_axis_that_ran_away_is_not_said_to_be_held() -> None:
    motion = parse_motion("sine:amplitude_mm=25,frequency_Hz=0.8,cycles=3", BENCH)
    with embedded(Card(BENCH, plant=FailingDrive(BENCH, "REVERSED"))) as link:
        axis = Axis(link, BENCH)
        link.command("I111=800")  # trips after 50 counts, before encoder and scale part
        axis.enable()
        with pytest.raises(MotorNotSafe) as failure:
            axis.run(motion)
        assert motors.read_motor(link, axis.motor).status.is_killed
    said = " ".join([failure.value.message, *getattr(failure.value, "__notes__", ())])
    assert "following error" in said
    assert "Nothing holds it" in said


def test_f25_without_dual_ported_ram_positions_are_asked_for() -> None:
    controller = BENCH.controller.model_copy(update={"dpram": "none"})
    bench = BENCH.model_copy(update={"controller": controller})
    shape = trapezoid(
        period_s=bench.servo_period_s,
        distance_m=0.05,
        speed_m_per_s=0.3,
        acceleration_m_per_s2=8.0,
        dwell_s=0.02,
    )
    # A few places tell that the sensors part, hardly why.
    said = ("SCALE_DEAD", "UNIT")
    status = run_until_failure(bench, "SCALE_DEAD", Motion("short", shape), said)
    assert status.is_closed_loop
    assert status.is_commanded_still


def test_a_motion_that_the_card_cannot_hold_says_how_long_it_may_be() -> None:
    controller = BENCH.controller.model_copy(update={"dpram": "none"})
    bench = BENCH.model_copy(update={"controller": controller})
    motion = parse_motion("sine:amplitude_mm=5,frequency_Hz=1,cycles=5,centre_mm=50", bench)
    with embedded(Card(bench)) as link:
        axis = Axis(link, bench)
        axis.enable()
        stood_ct = motors.read_motor(link, axis.motor).position_ct
        with pytest.raises(CaptureError, match=r"lasts [\d.]+ s .* holds [\d.]+ s") as refused:
            axis.run(motion)
        assert refused.value.code == "PC-AXI-005"
        assert motors.read_motor(link, axis.motor).status.is_commanded_still
        assert abs(motors.read_motor(link, axis.motor).position_ct - stood_ct) < 2.0


def test_a_campaign_that_the_card_cannot_hold_is_refused_before_its_first_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    controller = BENCH.controller.model_copy(update={"dpram": "none"})
    bench = BENCH.model_copy(update={"controller": controller})
    texts = ("trapezoid:distance_mm=5", "sine:amplitude_mm=5,frequency_Hz=1,cycles=5")
    plan = capturing.CapturePlan(bench, tuple(parse_motion(text, bench) for text in texts))
    with embedded(Card(bench)) as link:
        axis = Axis(link, bench)
        monkeypatch.setattr(capturing, "open_axis", lambda _url, _bench: nullcontext(axis))
        with pytest.raises(CaptureError, match=r"sine.* lasts"):
            capturing.capture_to_folder("sim://", "paper", plan, tmp_path / "runs")
        assert motors.read_motor(link, axis.motor).status.is_killed
    assert not list((tmp_path / "runs").iterdir())


def test_runs_in_the_cards_own_memory_are_approached_and_not_wiggled() -> None:
    controller = BENCH.controller.model_copy(update={"dpram": "none"})
    bench = BENCH.model_copy(update={"controller": controller})
    motion = parse_motion(
        "trapezoid:distance_mm=20,speed_mm_per_s=100,acceleration_m_per_s2=2", bench
    )
    with embedded(Card(bench)) as link:
        axis = Axis(link, bench)
        axis.enable()
        words = gather_plan(link, bench).layout.long_words
        free_s = int(link.query("SIZE")[0]) / words * bench.servo_period_s
        assert motion.duration_s < free_s < relaxing(motion)[0].duration_s
        capture = axis.run(motion, relaxed=True)
    assert capture.attributes["start"] == APPROACHED
    assert np.ptp(capture.motor_position_m) == pytest.approx(0.02, abs=1e-4)
