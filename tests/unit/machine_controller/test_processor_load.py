"""How busy the processor is: the manual's arithmetic, and what the simulated card spends."""

from pathlib import Path

import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.machine.controller.card import processor_load
from pmac_comp.machine.controller.card.processor_load import ProcessorLoad, load_of, read_load
from tests.unit.machine_controller.card_bench import CardBench

PERIOD_s = 440e-6  # 17600 half cycles at 80 MHz, four phase interrupts of 4400
I52, I8, I40 = 7, 0, 0


def load(*values: int, i8: int = I8, i52: int = I52) -> ProcessorLoad:
    found = load_of([*values, 36000, 4000, i52, i8, I40], PERIOD_s)
    assert found is not None
    return found


def test_task_times_that_nothing_interrupts_are_shares_as_they_are() -> None:
    found = load(4400, 220, 1760, 880)
    assert found.phase_frac == pytest.approx(0.05)
    assert found.servo_frac == pytest.approx(0.10)
    assert found.rti_frac == pytest.approx(0.05)
    assert found.foreground_frac == pytest.approx(0.20)
    assert found.background_s == pytest.approx(0.9e-3)
    assert found.watchdog_frac == pytest.approx(4000 / 4095)


def test_what_interrupts_a_task_is_taken_out_of_its_time() -> None:
    # Servo tasks of 5000 with one phase interrupt in them; a real-time interrupt of 20000 that runs
    # over five phase interrupts and one servo interrupt (User Manual p. 239-240, by hand).
    found = load(4400, 200, 5200, 21000)
    assert found.servo_frac == pytest.approx(5000 / 17600)
    in_it = 6 * 200 + 1 * 5000
    assert found.rti_frac == pytest.approx((21000 - in_it) / 17600)
    assert load(4400, 200, 5200, 21000, i8=1).rti_frac == pytest.approx(found.rti_frac / 2)


def test_a_pass_of_known_length_is_a_share_of_this_card() -> None:
    found = load(4400, 220, 1760, 880)
    assert found.share_frac(27600.0, 1) == pytest.approx(345e-6 / PERIOD_s)
    assert found.share_frac(27600.0, 2) == pytest.approx(345e-6 / PERIOD_s / 2)
    # A card of twice the frequency: twice the half cycles in a period.
    faster = load(8800, 220, 1760, 880, i52=15)
    assert faster.share_frac(27600.0, 1) == pytest.approx(345e-6 / PERIOD_s / 2)


@pytest.mark.parametrize("interval", [0, 3000, 100_000])
def test_a_phase_interval_that_fits_no_clock_tells_nothing(interval: int) -> None:
    assert load_of([interval, 200, 1500, 400, 36000, 4000, I52, I8, I40], PERIOD_s) is None


def test_a_card_that_does_not_show_its_registers_tells_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = CardBench(tmp_path)
    monkeypatch.setattr(processor_load, "_QUESTION", "RX$FFFF8C NONSENSE")
    assert read_load(bench.link, bench.bench.servo_period_s) is None


def test_the_simulated_card_tells_what_plc_0_takes(tmp_path: Path) -> None:
    bench = CardBench(tmp_path, bench=load_bench("paper"))
    link, period_s = bench.link, bench.bench.servo_period_s
    bench.card.run_cycles(20)
    idle = read_load(link, period_s)
    assert idle is not None
    assert 0.05 < idle.foreground_frac < 0.2
    body = [f"P{k}=P{k}+1" for k in range(100, 150)]
    link.write_buffer(["OPEN PLC 0 CLEAR", *body, "CLOSE", "I5=1", "ENABLE PLC 0"])
    bench.card.run_cycles(20)
    busy = read_load(link, period_s)
    assert busy is not None
    # Two operations a line, about 3 us each at 80 MHz.
    expected_frac = 100 * 3e-6 / period_s
    taken_frac = busy.rti_frac - idle.rti_frac
    assert taken_frac == pytest.approx(expected_frac, rel=0.35)
    assert busy.servo_frac == pytest.approx(idle.servo_frac)
    # Background cycles take longer by what is left to them.
    left = (1.0 - idle.foreground_frac) / (1.0 - busy.foreground_frac)
    assert busy.background_s / idle.background_s == pytest.approx(left, rel=0.02)
    assert busy.watchdog_frac < idle.watchdog_frac
    # Every second cycle: half of it.
    link.command("I8=1")
    bench.card.run_cycles(20)
    seldom = read_load(link, period_s)
    assert seldom is not None
    assert seldom.rti_frac == pytest.approx(busy.rti_frac / 2, rel=0.02)
    link.command("DISABLE PLC 0")
    bench.card.run_cycles(20)
    after = read_load(link, period_s)
    assert after is not None
    assert after.rti_frac == pytest.approx(idle.rti_frac / 2, rel=0.02)
