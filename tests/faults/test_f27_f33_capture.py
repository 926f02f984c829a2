"""F27, F28, F31 to F33: disk full, kill, overflow, gaps and wraps of a capture."""

import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pmac_comp.base.errors import GatherOverflow, SampleGap, StorageFull
from pmac_comp.machine.controller.gather import gather
from pmac_comp.machine.controller.gather.capture_log import MAGIC, CaptureLog, recover
from pmac_comp.machine.controller.gather.gather import RingReader
from pmac_comp.machine.controller.gather.gather_plan import (
    GatherMode,
    GatherPlan,
    GatherSource,
    bench_sources,
    motor_source,
)
from pmac_comp.machine.controller.gather.gather_samples import (
    Gap,
    GatherResult,
    Unwrapper,
    unwrap_word,
)
from pmac_comp.machine.wire.numbers import signed_24_array
from tests.unit.machine_controller.card_bench import CardBench, make_plc_bench

pytestmark = pytest.mark.faults
Count = Callable[[int], None]
WRAP = 1 << 24


def block(start: int, n: int) -> dict[str, np.ndarray]:
    cycle = np.arange(start, start + n, dtype=np.int64)
    return {"servo_cycle": cycle, "actual": cycle * 7 - 3}


def test_f27_disk_full_at_every_block(tmp_path: Path, count_runs: Count) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    n_blocks = 12
    for at in range(n_blocks):
        path = tmp_path / f"full-{at}.log"
        log = CaptureLog.create(path, {"n": 1})
        head = path.stat().st_size
        log.append(block(0, 50))
        one = path.stat().st_size - head
        resource.setrlimit(resource.RLIMIT_FSIZE, (head + one * (at + 1) + one // 3, hard))
        try:
            stored = 50
            failure = None
            while failure is None:
                try:
                    log.append(block(stored, 50))
                    stored += 50
                except StorageFull as error:
                    failure = error
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        log.abandon()
        assert failure.context["rows"] == stored == 50 * (at + 1)
        found = recover(path)
        assert not found.is_complete
        assert len(found.columns["actual"]) == stored
        assert np.array_equal(found.columns["servo_cycle"], np.arange(stored))
    count_runs(n_blocks)


def test_f27_gathering_is_stopped_on_the_card(tmp_path: Path) -> None:
    bench = make_plc_bench(tmp_path)
    log = CaptureLog.create(tmp_path / "full.log", {}, clock=bench.clock)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    plan = GatherPlan(bench_sources(1, 2))
    resource.setrlimit(resource.RLIMIT_FSIZE, (30000, hard))
    try:
        with pytest.raises(StorageFull):
            gather.gather_ring(bench.link, plan, 2.0, bench.bench.servo_period_s, log=log)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    log.abandon()
    assert not bench.card.gathering.running
    assert not bench.card.gathering.exists
    assert len(recover(tmp_path / "full.log").columns["actual"]) > 100


WRITER = """
import sys, numpy as np
from pathlib import Path
from pmac_comp.machine.controller.gather.capture_log import CaptureLog
log = CaptureLog.create(Path(sys.argv[1]), {"n": 1})
k = 0
print("ready", flush=True)
while True:
    cycle = np.arange(50 * k, 50 * k + 50, dtype=np.int64)
    log.append({"servo_cycle": cycle, "actual": cycle * 7 - 3})
    k += 1
    print(50 * k, flush=True)
"""


def test_f28_kill_at_random_times(*, tmp_path: Path, exhaustive: bool, count_runs: Count) -> None:
    rng = np.random.default_rng(28)
    n_kills = 200 if exhaustive else 4
    for k in range(n_kills):
        path = tmp_path / f"kill-{k}.log"
        with subprocess.Popen(
            [sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, text=True
        ) as child:
            assert child.stdout is not None
            assert child.stdout.readline() == "ready\n"
            time.sleep(float(rng.uniform(0.0, 0.1)))
            child.kill()
            said = [int(x) for x in child.stdout.read().split()]
        found = recover(path)
        cycle = found.columns.get("servo_cycle", np.empty(0, dtype=np.int64))
        assert len(cycle) >= (said[-2] if len(said) > 1 else 0)
        assert np.array_equal(cycle, np.arange(len(cycle)))
        assert found.reason is None
    count_runs(n_kills)


def test_f28_any_truncation_or_flip_leaves_whole_blocks(tmp_path: Path, count_runs: Count) -> None:
    path = tmp_path / "whole.log"
    log = CaptureLog.create(path, {"bench": "paper"})
    for k in range(4):
        log.append(block(20 * k, 20))
    log.gap(79, 3, "test")
    log.close("complete")
    data = path.read_bytes()
    first = data.index(b'"paper"') + 10
    runs = 0
    for at in range(first, len(data), 11):
        for broken in (data[:at], data[:at] + bytes([data[at] ^ 0x40]) + data[at + 1 :]):
            path.write_bytes(broken)
            found = recover(path)
            n = len(found.columns.get("actual", ()))
            assert n % 20 == 0
            expected = block(0, n)["actual"]
            assert n == 0 or np.array_equal(found.columns["actual"], expected)
            assert not found.is_complete or at >= len(data) - 1
            runs += 1
    assert data.startswith(MAGIC)
    count_runs(runs)


def ring(bench: CardBench, *names: str) -> GatherPlan:
    sources = [motor_source(name, 1, 0x0B) for name in names]
    return GatherPlan(tuple(sources))


@pytest.mark.parametrize("extra", [-1, 0, 1])
def test_f31_reader_stalls_for_a_ring_and_one_sample(tmp_path: Path, extra: int) -> None:
    bench = CardBench(tmp_path)
    plan = ring(bench, "actual")
    reader = RingReader(bench.link, plan)
    with gather.prepared(bench.link, plan):
        bench.link.command("GATHER")
        bench.card.run_cycles(100)
        assert reader.poll() > 0
        seen = reader.n
        bench.card.run_cycles(plan.ring_samples + extra)
        reader.poll()
        bench.card.run_cycles(50)
        reader.poll()
        result = reader.result()
    assert seen > 90
    whole = result.servo_cycle[-1] - result.servo_cycle[0] + 1
    lost = sum(gap.n_missing for gap in result.gaps)
    assert result.n + lost == whole
    if result.gaps:
        with pytest.raises(GatherOverflow, match=f"{lost} samples"):
            result.require_whole()
    # Whatever is there is true: the counter rises by one wherever no gap was declared.
    breaks = np.flatnonzero(np.diff(result.servo_cycle) != 1)
    assert list(breaks) == [gap.index for gap in result.gaps]
    assert bool(result.gaps) == (extra > -1 or lost > 0)


def test_f31_ring_runs_for_a_long_time_without_a_gap(tmp_path: Path) -> None:
    bench = make_plc_bench(tmp_path)
    sources = (*bench_sources(1, 2), motor_source("error", 1, 0x11),
               GatherSource("word", 0x4010F8))  # fmt: skip
    plan = GatherPlan(sources)
    bench.link.command("#1J:20000")
    result = gather.gather_ring(bench.link, plan, 5.0, bench.bench.servo_period_s).require_whole()
    assert result.n >= 5.0 / bench.bench.servo_period_s
    assert result.n > 10 * plan.ring_samples
    assert np.ptp(result.raw["actual"]) > 19000 * 3072


@pytest.mark.parametrize("fault", ["drop", "double"])
def test_f32_every_chunk_dropped_or_doubled(fault: str, count_runs: Count) -> None:
    rng = np.random.default_rng(32)
    cycles = (np.arange(1000) + WRAP - 400) % WRAP
    for start in range(0, 960, 40):
        length = int(rng.integers(1, 30))
        part = cycles[start : start + length]
        if fault == "drop":
            words = np.concatenate([cycles[:start], cycles[start + length :]])
        else:
            words = np.concatenate([cycles[: start + length], part, cycles[start + length :]])
        counter = Unwrapper(1)
        at = int(rng.integers(1, 900))
        values = np.concatenate([counter.feed(words[:at]), counter.feed(words[at:])])
        assert np.array_equal(values % WRAP, words)
        missing = sum(gap.n_missing for gap in counter.gaps)
        if start == 0 and fault == "drop":
            assert not counter.gaps
        elif fault == "drop":
            assert [(g.index, g.n_missing) for g in counter.gaps] == [(start - 1, length)]
        else:
            assert missing == -length
    count_runs(24)


def test_f32_gap_is_written_into_the_result() -> None:
    plan = GatherPlan((GatherSource("word", 0x4010F8),))
    result = GatherResult(
        {"word": np.zeros(4, dtype=np.int64)},
        np.array([1, 2, 5, 6]),
        (Gap(1, 2),),
        GatherPlan(plan.sources, mode=GatherMode.RAM),
    )
    with pytest.raises(SampleGap, match="after sample 1, 2 long"):
        result.require_whole()


@given(
    start=st.integers(0, WRAP - 1),
    steps=st.lists(st.integers(-(1 << 23) + 1, (1 << 23) - 1), min_size=1, max_size=60),
)
def test_f33_positions_unwrap_exactly(start: int, steps: list[int]) -> None:
    truth = start + np.concatenate([[0], np.cumsum(steps)])
    words = signed_24_array(truth % WRAP)
    found = unwrap_word(words)
    assert np.array_equal(found - found[0], truth - truth[0])


@given(start=st.integers(0, WRAP - 1), period=st.integers(1, 50), n=st.integers(2, 200))
def test_f33_counter_unwraps_across_blocks(start: int, period: int, n: int) -> None:
    truth = start + period * np.arange(n)
    counter = Unwrapper(period)
    words = truth % WRAP
    values = np.concatenate([counter.feed(words[: n // 2]), counter.feed(words[n // 2 :])])
    assert np.array_equal(values, truth)
    assert counter.gaps == []


def test_f33_words_keep_their_sign() -> None:
    assert signed_24_array(np.array([0xFFFFFF, 0x800000, 0x7FFFFF, 0])).tolist() == [
        -1, -(1 << 23), (1 << 23) - 1, 0
    ]  # fmt: skip


def test_f33_counter_wrap_on_the_card(tmp_path: Path) -> None:
    bench = make_plc_bench(tmp_path)
    bench.card.memory.x[0] = WRAP - 500
    plan = ring(bench, "actual")
    result = gather.gather_ring(bench.link, plan, 0.5, bench.bench.servo_period_s).require_whole()
    assert result.servo_cycle[0] < WRAP < result.servo_cycle[-1]
