"""F23 to F26: jumps at enabling, trips during a run, sensors that disagree, the wrong card."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pmac_comp.base.errors import (
    ConnectFailed,
    ControllerState,
    MotorNotSafe,
    SafetyRefusal,
)
from pmac_comp.machine.controller.card import identity
from pmac_comp.machine.controller.contents import programs
from pmac_comp.machine.controller.contents.comp_table import CompTable
from pmac_comp.machine.controller.gather import gather
from pmac_comp.machine.controller.gather.capture_log import CaptureLog, recover
from pmac_comp.machine.controller.gather.gather_plan import GatherPlan, bench_sources
from pmac_comp.machine.controller.motors import motors
from pmac_comp.machine.controller.motors.supervision import SensorFault, SensorWatch, trips
from pmac_comp.machine.controller.settings import guard_install
from pmac_comp.machine.controller.tables import upload
from pmac_comp.machine.controller.whole import grouping, rollback
from tests.unit.machine_controller.card_bench import CardBench, make_plc_bench

pytestmark = pytest.mark.faults
Count = Callable[[int], None]


def offset_table(amplitude_ct: float) -> CompTable:
    entries = [round(16 * amplitude_ct * math.sin(2 * math.pi * k / 64)) for k in range(1, 64)]
    return CompTable(1, (*entries, 0), 640000, by_desired=True)


def test_f23_enabling_never_jumps_by_more_than_the_bound(tmp_path: Path, count_runs: Count) -> None:
    runs = refused = 0
    bench = make_plc_bench(tmp_path)
    for position in (0, 20000, 80000):
        bench.link.command(f"#1J={position}")
        motors.wait_in_position(bench.link, 1, timeout_s=20.0)
        for amplitude in (4.0, 12.0, 50.0):
            table = offset_table(amplitude)
            step = abs(float(table.correction_ct(float(position))))
            runs += 1
            # What the tables before left in the register would be a step of its own.
            bench.link.write_buffer(["#1K", "I51=0", "WL$90,0", "#1DELETE COMP", "#1J/"])
            bench.clock.sleep_s(0.5)
            worst = watch_following_error(bench)
            if step > 5.05:
                with pytest.raises(MotorNotSafe, match="at once") as refusal:
                    upload.upload_tables(bench.link, bench.context, [table])
                refused += 1
                assert refusal.value.left is ControllerState.OLD
                assert refusal.value.context["step_ct"] == pytest.approx(
                    float(table.correction_ct(float(position))), abs=0.1
                )
                stand = float(str(refusal.value.context["stand_at_ct"]))
                assert abs(float(table.correction_ct(stand))) <= 5.0
                assert not bench.i51
            elif step < 4.95:
                upload.upload_tables(bench.link, bench.context, [table])
                bench.clock.sleep_s(0.2)
                assert bench.i51
                assert max(worst) < 10.0
    assert refused >= 3
    count_runs(runs)


def test_f18_guard_comes_with_tables_and_goes_with_them(tmp_path: Path) -> None:
    bench = make_plc_bench(tmp_path)
    with grouping.grouped(bench.link, bench.context, "table") as parts:
        assert "guard" in guard_install.install_guard(bench.link, parts)[0]
        upload.upload_tables(bench.link, parts, [offset_table(3.0)])
    bench.clock.sleep_s(0.1)
    scans = bench.p(7080)
    bench.clock.sleep_s(0.1)
    assert bench.p(7080) > scans, "the guard runs"
    assert guard_install.install_guard(bench.link, bench.context) == ()
    rollback.rollback_last(bench.link, bench.context)
    assert bench.link.query("M7007->") == ["*"]
    assert not bench.card.plcs.enabled(1)
    assert bench.values("COMP", 1) is None


@pytest.mark.parametrize("taken", ["OPEN PLC 1 CLEAR\rP900=P900+1\rCLOSE", "M7007->X:$10"])
def test_f18_guard_leaves_alone_what_is_not_ours(tmp_path: Path, taken: str) -> None:
    bench = make_plc_bench(tmp_path)
    bench.link.write_buffer(taken.split("\r"))
    before = bench.link.query("M7007->"), programs.listing(bench.link, programs.ProgramKind.PLC, 1)
    (said,) = guard_install.install_guard(bench.link, bench.context)
    assert "the guard was not installed" in said
    after = bench.link.query("M7007->"), programs.listing(bench.link, programs.ProgramKind.PLC, 1)
    assert after == before


def watch_following_error(bench: CardBench) -> list[float]:
    """Following error at each request, read from the card's registers."""
    worst = [0.0]

    def note(_n: int) -> None:
        worst.append(abs(float(bench.side_port()("#1F").strip(b"\r\x06"))))

    bench.on_request = note
    return worst


@pytest.mark.parametrize("kind", ["amplifier", "following error", "limit", "kill"])
def test_f24_trip_during_a_run_closes_the_capture(
    *, tmp_path: Path, kind: str, exhaustive: bool, count_runs: Count
) -> None:
    rng = np.random.default_rng(24)
    n_runs = 200 if exhaustive else 3
    for k in range(n_runs):
        folder = tmp_path / f"{kind}-{k}"
        folder.mkdir()
        bench = make_plc_bench(folder)
        at_s = float(rng.uniform(0.15, 0.5))
        bench.link.command("#1J+")
        start = bench.card.time_s
        log = CaptureLog.create(folder / "run.log", {"bench": "paper"}, clock=bench.clock)
        reasons: list[str] = []

        def keep_going(
            bench: CardBench = bench, at_s: float = at_s, start: float = start,
            reasons: list[str] = reasons,
        ) -> bool:  # fmt: skip
            if bench.card.time_s - start > at_s:
                trip(bench, kind)
            reasons[:] = trips(bench.link, [1])
            return not reasons

        plan = GatherPlan(bench_sources(1, 2))
        result = gather.gather_ring(
            bench.link, plan, 2.0, bench.bench.servo_period_s, log=log, keep_going=keep_going
        )
        log.close("; ".join(reasons))
        assert not result.complete
        assert not result.gaps
        stored = recover(folder / "run.log")
        assert stored.is_complete
        assert stored.reason
        assert "motor #1" in stored.reason
        assert np.array_equal(stored.columns["actual"], result.raw["actual"])
        status = motors.read_motor(bench.link, 1).status
        assert status.is_killed or status.trips
    count_runs(n_runs)


def trip(bench: CardBench, kind: str) -> None:
    side = bench.side_port()
    if kind == "kill":
        side("#1K")
    elif kind == "limit":
        side("I113=100")
    elif kind == "following error":
        side("I111=1")
    else:
        bench.card.servo.kill(1)
        bench.card.memory.y[0x80 + 0x40] |= 1 << 3


FAULTS = {
    SensorFault.NONE: lambda x, n: x,
    SensorFault.SCALE_DEAD: lambda x, n: np.zeros(n),
    SensorFault.SIGN: lambda x, n: -x,
    SensorFault.UNIT: lambda x, n: 0.5 * x,
    SensorFault.SLIP: lambda x, n: x + np.where(np.arange(n) > 700, 300.0, 0.0),
}


@pytest.mark.parametrize("fault", list(FAULTS))
def test_f25_sensors_that_disagree_are_named(fault: SensorFault) -> None:
    n, period_s = 2262, 442e-6
    time_s = np.arange(n) * period_s
    motor = 10000 * (1 - np.cos(2 * np.pi * 1.0 * time_s))
    error = 20 * np.sin(2 * np.pi * 1.0 * time_s)
    scale = FAULTS[fault](motor + error, n)
    watch = SensorWatch(limit=100.0)
    block = round(0.01 / period_s)
    found, parted_at = SensorFault.NONE, None
    for start in range(0, n, block):
        part = slice(start, start + block)
        found = watch.feed(motor[part], scale[part])
        if found is not SensorFault.NONE:
            break
    beyond = np.flatnonzero(np.abs((motor - motor[0]) - (scale - scale[0])) > 100.0)
    assert found is fault
    if fault is not SensorFault.NONE:
        parted_at = beyond[0]
        assert (min(start + block, n) - parted_at) * period_s <= 0.02


def test_f25_dead_encoder() -> None:
    scale = np.linspace(0, 5000, 500)
    assert SensorWatch(limit=100.0).feed(np.zeros(500), scale) is SensorFault.ENCODER_DEAD


class Answers:
    """A conversation that answers from a table."""

    def __init__(self, identity_lines: list[str]) -> None:
        self.identity_lines = identity_lines

    def query(self, text: str) -> list[str]:
        if text.startswith("CID"):
            return self.identity_lines
        return {"I10": ["3707733"], "RY$3F": ["409600"], "SID": ["0"]}[text]


CARDS = [
    (["603382", "1.947  ", "TURBO2, X4", "56303", "25000"], None),
    (["603382", "1.933  ", "TURBO2, X4", "56303", "25000"], "firmware 1.933"),
    (["602413", "1.16", "PMAC2", "56002", "900"], "PMAC2 with firmware"),
    (["603382", "abc", "TURBO2, X4", "56303", "25000"], "firmware abc"),
    (["POWER PMAC", "2.5", "x", "y", "z"], "no Turbo PMAC"),
    (["603382"], "no Turbo PMAC"),
    ([], "no Turbo PMAC"),
]


@pytest.mark.parametrize(("lines", "refusal"), CARDS)
def test_f26_the_wrong_card_is_refused(lines: list[str], refusal: str | None) -> None:
    link = Answers(lines)
    if refusal is None:
        assert identity.read_identity(link).dpram == "large"  # type: ignore[arg-type]
        return
    with pytest.raises(ConnectFailed, match=refusal):
        identity.read_identity(link)  # type: ignore[arg-type]


def test_f26_a_table_too_large_for_the_memory_is_refused(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    table = CompTable(1, (0,) * 30000, 640000)
    with pytest.raises(SafetyRefusal, match=r"need 30008 long words, \d+ are free") as refusal:
        upload.upload_tables(bench.link, bench.context, [table])
    assert refusal.value.left is ControllerState.OLD
    assert bench.values("COMP", 1) is None
