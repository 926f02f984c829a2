"""F35 to F38: limits, number formats, clock jumps and folders of the host."""

import dataclasses
import math
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pmac_comp.base.errors import (
    AmplitudeExceeded,
    ConfigError,
    ControllerState,
    NonFinite,
    PmacCompError,
    SafetyRefusal,
    SlopeExceeded,
    StorageFull,
)
from pmac_comp.machine.controller.card.numbers import nine_digits, plain
from pmac_comp.machine.controller.card.variables import check_value
from pmac_comp.machine.controller.change.journal import Journal, Sync
from pmac_comp.machine.controller.change.journals import new_transaction_id
from pmac_comp.machine.controller.contents.comp_table import CompTable
from pmac_comp.machine.controller.contents.law_bank import LawParameters
from pmac_comp.machine.controller.contents.safety import check_law, check_table
from pmac_comp.machine.controller.tables import upload
from pmac_comp.workflow.capture.context import context_of
from tests.unit.machine_controller.card_bench import LIMITS, CardBench

pytestmark = pytest.mark.faults
Count = Callable[[int], None]
N = 64
SPACING = 10000


def ramp(peak_ct16: int, n_steps: int) -> CompTable:
    """Trapezoid that reaches its peak in n_steps entries."""
    up = [round(peak_ct16 * k / n_steps) for k in range(1, n_steps + 1)]
    flat = [peak_ct16] * (N - 2 * n_steps)
    return CompTable(1, (*up, *flat, *up[-2::-1], 0), N * SPACING)


@pytest.mark.parametrize(("excess", "refused"), [(-1, False), (0, False), (1, True)])
def test_f35_amplitude(excess: int, refused: bool) -> None:  # noqa: FBT001
    table = ramp(16 * 60 + excess, 10)
    found = check_table(table, LIMITS)
    assert bool(found) is refused
    if refused:
        assert isinstance(found[0], AmplitudeExceeded)
        assert "60.1 um" in found[0].message
        assert "counts" in found[0].message


@pytest.mark.parametrize(("excess", "refused"), [(-1, False), (0, False), (1, True)])
def test_f35_slope(excess: int, refused: bool) -> None:  # noqa: FBT001
    limits = dataclasses.replace(LIMITS, max_slope=100 / 16 / SPACING)
    table = CompTable(1, (100 + excess, *([0] * (N - 1))), N * SPACING)
    table = dataclasses.replace(table, entries=(100 + excess, 50, *([0] * (N - 2))))
    found = check_table(table, limits)
    assert [type(r) for r in found] == ([SlopeExceeded] if refused else [])


@pytest.mark.parametrize(("excess", "refused"), [(-1, True), (0, False), (1, False)])
def test_f35_span_shorter_than_the_travel(excess: int, refused: bool) -> None:  # noqa: FBT001
    table = CompTable(1, (0,) * N, 600000 + excess)
    assert bool(check_table(table, LIMITS)) is refused


def test_f35_values_that_no_register_takes() -> None:
    for bad in ((1 << 23, 0), (-(1 << 23) - 1, 0), (1.5, 0), ("7", 0), (True, 0), ()):
        with pytest.raises(ConfigError):
            CompTable(1, bad, 600000)  # type: ignore[arg-type]
    for entries, span in (((0, 0), 1), ((0,), 0), ((0,), 1 << 31)):
        with pytest.raises(ConfigError):
            CompTable(1, entries, span)
    assert CompTable(1, ((1 << 23) - 1, 0), 600000)
    for name, value in (("I130", 8388608), ("I129", 32768), ("I4904", 1), ("I51", 2)):
        with pytest.raises(ConfigError):
            check_value(name, value)


def test_f35_a_table_that_jumps_where_it_repeats_is_refused() -> None:
    assert [r.code for r in check_table(CompTable(1, (5, 7), 600000), LIMITS)] == ["PC-TBL-005"]
    assert check_table(CompTable(1, (5, 7), 600000, wrap=True), LIMITS) == []


def test_f35_all_refusals_are_reported_together(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    bad = CompTable(1, tuple([16 * 200] * 10 + [0] * 54), 500000)
    bench.link.write_buffer(["P7079=900000", "P7078=4711"])
    with pytest.raises(SafetyRefusal) as failure:
        upload.upload_tables(bench.link, bench.context, [bad])
    kinds = {type(r).__name__ for r in failure.value.refusals}
    assert {"AmplitudeExceeded", "LeaseHeld", "SafetyRefusal"} <= kinds
    assert failure.value.left is ControllerState.OLD
    assert bench.values("COMP", 1) is None
    assert "200 um" in str(failure.value)


def test_f35_law_beyond_its_limits() -> None:
    law = LawParameters(A0=10.0, JL=1000.0)
    assert check_law(law, 60.0, LIMITS) == []
    for clamp in (60.001, 0.0, -1.0):
        assert isinstance(check_law(law, clamp, LIMITS)[0], AmplitudeExceeded)
    jump = [0.0] * 10 + [100.0] * 10
    assert check_law(law, 60.0, LIMITS, jump)[0].code == "PC-SAF-007"  # type: ignore[arg-type]


@given(st.floats(allow_nan=False, allow_infinity=False, min_value=-1e9, max_value=1e9))
def test_f36_numbers_survive_the_way_there_and_back(value: float) -> None:
    text = plain(value)
    assert set(text) <= set("-.0123456789")
    assert text != "-0"
    back = float(text)
    assert nine_digits(back) == nine_digits(value)
    assert math.isclose(back, value, rel_tol=1e-8, abs_tol=1e-10)


@given(st.integers(-(1 << 35) + 1, (1 << 35) - 1))
def test_f36_integers_keep_every_digit(value: int) -> None:
    assert plain(value) == str(value)


def test_f36_what_cannot_be_said_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    for bad in (math.nan, math.inf, -math.inf):
        with pytest.raises(NonFinite):
            nine_digits(bad)
        with pytest.raises(PmacCompError):
            LawParameters(A0=bad)
    with pytest.raises(PmacCompError):
        plain(1 << 36)
    monkeypatch.setenv("LC_ALL", "de_DE.UTF-8")
    assert plain(1e-7) == "0.0000001"
    assert plain(1.5) == "1.5"


@given(st.floats(min_value=1e-7, max_value=1e6))
def test_f36_the_card_reads_and_prints_what_was_meant(value: float) -> None:
    bench = shared_bench()
    law = LawParameters(C1=value)
    bench.link.command(f"P7011={plain(law.C1)}")
    assert nine_digits(float(bench.link.query("P7011")[0])) == nine_digits(law.C1)


_shared: list[CardBench] = []


def shared_bench() -> CardBench:
    if not _shared:
        _shared.append(CardBench(Path()))
    return _shared[0]


def test_f37_wall_clock_jumps_do_not_matter(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = CardBench(tmp_path)
    now = iter(range(10**9, 0, -86400))
    monkeypatch.setattr(time, "time", lambda: float(next(now)))
    table = ramp(320, 10)
    result = upload.upload_tables(bench.link, bench.context, [table])
    again = upload.upload_tables(bench.link, bench.context, [ramp(160, 10)])
    assert result.verdict is again.verdict is ControllerState.NEW
    assert result.journal != again.journal
    assert len({new_transaction_id() for _ in range(2000)}) == 2000


def bad_folders(tmp_path: Path) -> list[Path]:
    plain_file = tmp_path / "file"
    plain_file.write_text("x", encoding="utf-8")
    return [
        plain_file,
        plain_file / "below",
        tmp_path / ("n" * 300),
        tmp_path / "/".join(["d" * 200] * 25),
        Path("/proc/nothing/here"),
    ]


def test_f38_folders_are_probed_before_the_machine_is_touched(
    tmp_path: Path, count_runs: Count
) -> None:
    bench = CardBench(tmp_path)
    folders = bad_folders(tmp_path)
    for folder in folders:
        bench.folder = folder
        before = bench.n_requests
        with pytest.raises(ConfigError, match="cannot be written"):
            upload.upload_tables(bench.link, bench.context, [ramp(320, 10)])
        assert bench.n_requests == before
        with pytest.raises(ConfigError, match="cannot be written"):
            context_of(SimpleNamespace(setup=SimpleNamespace()), folder)  # type: ignore[arg-type]
    assert bench.values("COMP", 1) is None
    count_runs(len(folders))


def test_f38_read_only_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_arguments: object) -> int:
        raise PermissionError(13, "Permission denied")

    bench = CardBench(tmp_path)
    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(ConfigError, match="Permission denied"):
        upload.upload_tables(bench.link, bench.context, [ramp(320, 10)])
    assert bench.n_requests == 0


def test_f38_full_disk_is_seen_before_the_machine_is_touched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = CardBench(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _path: SimpleNamespace(free=0))
    with pytest.raises(ConfigError, match="No space left"):
        upload.upload_tables(bench.link, bench.context, [ramp(320, 10)])
    assert bench.n_requests == 0


@pytest.mark.parametrize(
    ("refused", "left"), [("intent", ControllerState.OLD), ("seal", ControllerState.DISABLED)]
)
def test_f38_journal_that_cannot_be_written_stops_the_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: str, left: ControllerState
) -> None:
    bench = CardBench(tmp_path)
    real = Journal.write

    def full(self: Journal, step: str, data: object = None, **options: Sync) -> None:
        if step == refused:
            raise StorageFull("no room", left=None)
        real(self, step, data, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(Journal, "write", full)
    with pytest.raises(StorageFull) as failure:
        upload.upload_tables(bench.link, bench.context, [ramp(320, 10)])
    assert failure.value.left is left
    assert bench.i51 == 0
    assert (bench.values("COMP", 1) is None) == (left is ControllerState.OLD)


def test_f38_torn_journal_lines_are_ignored(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "a.journal")
    journal.write("begin", {"kind": "tables"})
    journal.write("intent", {"n": 5})
    data = journal.path.read_bytes()
    for cut in range(len(data)):
        journal.path.write_bytes(data[:cut])
        steps = [e.step for e in journal.entries()]
        assert steps == ["begin", "intent"][: len(steps)]
        assert len(steps) <= data[: cut + 1].count(b"\n")
