"""F38: the host's disk fills up, or SAVE fails, at any point of a change; verdicts stay true.

What the disk holds after a power failure of the host is enough to settle the change.
"""

import errno
import os
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from pmac_comp.base.errors import (
    CommandRefused,
    ControllerState,
    PmacCompError,
    ReplyTimeout,
    StorageFull,
)
from pmac_comp.machine.controller.change import journals
from pmac_comp.machine.controller.change.journal import Journal
from pmac_comp.machine.controller.tables import upload
from pmac_comp.machine.controller.whole import grouping, persist, waiting
from pmac_comp.machine.controller.whole.taking_back import RESET_NOTE
from pmac_comp.machine.transport.tap import Fault, FaultKind, Way
from tests.faults.change_bench import ChangeBench, Scenario
from tests.faults.test_f01_f29_every_kind import SCENARIOS
from tests.faults.upload_bench import UploadBench
from tests.unit.machine_controller.card_bench import CardBench

pytestmark = pytest.mark.faults
Count = Callable[[int], None]


class FullDisk:
    """The disk has room for so many syncs; then every one of them fails, or only the next."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.left = 1 << 30
        self.for_good = True
        self.count = 0
        self.room = 0
        self._fsync = os.fsync
        monkeypatch.setattr(os, "fsync", self.fsync)

    def fsync(self, fd: int) -> None:
        self.count += 1
        self.left -= 1
        if self.left == -1 or (self.left < 0 and self.for_good):
            if self.room:
                self.left, self.room = self.room, 0
            raise OSError(errno.ENOSPC, "No space left on device")
        self._fsync(fd)

    @contextmanager
    def room_again(self, syncs: int) -> Iterator[None]:
        """Room for so many syncs after the first that fails; for all of them at the end."""
        self.room = syncs
        yield
        self.left, self.room = 1 << 30, 0


@pytest.mark.parametrize("for_good", [True, False])
@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda s: s.name)
def test_f38_full_disk_at_every_sync(
    *,
    scenario: Scenario,
    for_good: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    exhaustive: bool,
    count_runs: Count,
) -> None:
    rig = ChangeBench(tmp_path, scenario)
    disk = FullDisk(monkeypatch)
    disk.for_good = for_good
    assert rig.run() is None
    total, confirmed = disk.count, 0
    for n in range(0, total, 1 if exhaustive else max(1, total // 5)):
        rig.restart()
        disk.left = n
        error = rig.attempt()
        disk.left = 1 << 30
        assert isinstance(error, PmacCompError), n
        assert error.left is not None, (n, error)
        rig.fresh()
        if error.context.get("confirmed") and error.left is ControllerState.DISABLED:
            assert rig.bench.i51 == 0  # by the guard PLC
        elif error.context.get("confirmed"):
            rig.judge(error.left)
        confirmed += bool(error.context.get("confirmed"))
        rig.recover(resume=bool(n % 2))
        count_runs(1)
    assert confirmed


@pytest.mark.parametrize("for_good", [True, False])
def test_f38_full_disk_at_every_sync_of_an_upload_of_tables(
    *, for_good: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, count_runs: Count
) -> None:
    rig = UploadBench(tmp_path, n=40)
    disk = FullDisk(monkeypatch)
    disk.for_good = for_good
    assert rig.upload_with(lambda _b: None) is None
    total, confirmed = disk.count, 0

    def fill(n: int) -> None:
        disk.left = n

    for n in range(total):
        error = rig.upload_with(lambda _b, n=n: fill(n))
        fill(1 << 30)
        assert isinstance(error, StorageFull), (n, error)
        if error.context["confirmed"]:
            assert error.left is rig.state, n
            confirmed += 1
        assert rig.recover(resume=bool(n % 2)) in {ControllerState.OLD, ControllerState.NEW}
        count_runs(1)
    assert confirmed == total


def test_f38_what_a_full_disk_leaves_of_an_upload_is_seen_and_is_no_reset(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, count_runs: Count
) -> None:
    """Some room is left for taking back: its own number stood for that which a reset had taken."""
    (scenario,) = (s for s in SCENARIOS if s.name == "law route")
    rig = ChangeBench(tmp_path, scenario)
    disk = FullDisk(monkeypatch)
    assert rig.run() is None
    total, seen = disk.count, 0
    for n in range(total // 3, total, 2):
        for room in (1, 3):
            rig.restart()
            disk.left = n
            with disk.room_again(room):
                error = rig.attempt()
            assert isinstance(error, PmacCompError), n
            said = "".join(getattr(error, "__notes__", []))
            if "could not be taken back" in said:
                seen += 1
                assert "left open: `pmac-comp recover` takes it back. Stands: " in said
            rig.fresh()
            done = rig.recover(resume=False)
            assert RESET_NOTE not in done.notes, (n, room)
            count_runs(1)
    assert seen


@pytest.mark.parametrize("how", ["refused", "silent"])
def test_f21_save_that_fails_leaves_the_upload_and_says_so(
    *, tmp_path: Path, how: str, count_runs: Count
) -> None:
    rig = UploadBench(tmp_path, n=40)
    bench = rig.restart()
    bench.link.command("#1K")
    bench.clock.sleep_s(0.5)
    do = bench.link.command

    def command(text: str, **options: float) -> list[str]:
        if "SAVE" not in text:
            return do(text, **options)
        if how == "refused":
            raise CommandRefused("ERR001", context={"error": 1})
        raise ReplyTimeout("silence")

    bench.link.command = command  # type: ignore[method-assign]
    rig.upload()
    with pytest.raises(CommandRefused if how == "refused" else ReplyTimeout):
        persist.persist(bench.link, bench.context)
    assert rig.recover() is ControllerState.NEW
    count_runs(1)


def test_f38_a_line_of_the_journal_that_did_not_fit_is_taken_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, count_runs: Count
) -> None:
    """A write may end short without an error; what is appended later must stay readable."""
    journal = Journal(tmp_path / "a.journal")
    journal.write("begin")
    whole = os.write
    for room in range(0, 40, 3):
        monkeypatch.setattr(os, "write", lambda fd, data, n=room: whole(fd, data[:n]))
        with pytest.raises(StorageFull):
            journal.write("intent", {"backup": "x" * 40})
        monkeypatch.setattr(os, "write", whole)
        count_runs(1)
    journal.write("rolled back")
    assert [entry.step for entry in journal.entries()] == ["begin", "rolled back"]


@pytest.mark.parametrize("resume", [True, False])
def test_f38_half_a_line_in_the_journal_locks_nobody_out(
    *, resume: bool, tmp_path: Path, count_runs: Count
) -> None:
    """The power of the host fails while a line is written: recovered once, uploads go on."""
    rig = UploadBench(tmp_path, n=24)
    sent: list[int] = []

    def note(bench: CardBench) -> None:
        bench.on_request = lambda _n: sent.append(bench.tap.sent)

    assert rig.upload_with(note) is None
    torn = 0
    for n in sent[:: max(1, len(sent) // 6)]:
        rig.upload_with(lambda b, n=n: b.tap.schedule([Fault(FaultKind.CUT, Way.SEND, n)]))
        for journal in journals.journals(rig.bench.context):
            torn += journals.is_torn(journal)
            with journal.path.open("ab") as file:
                file.write(b'5f3a9c11 {"steps": ["se')
        assert rig.recover(resume=resume) in {ControllerState.OLD, ControllerState.NEW}
        assert waiting.left_open(rig.bench.context) == ()
        upload.upload_tables(rig.bench.link, rig.bench.context, [rig.old])
        assert rig.state is ControllerState.OLD
        count_runs(1)
    assert torn


def test_f38_the_name_of_a_journal_is_on_the_disk_before_its_intent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, count_runs: Count
) -> None:
    """A power failure must not take away the file that says what was begun."""
    rig = UploadBench(tmp_path, n=24)
    bench = rig.restart()
    known: set[str] = set()
    intents: list[str] = []

    def fsync(fd: int) -> None:
        if stat.S_ISDIR(os.fstat(fd).st_mode):
            known.update(path.name for path in tmp_path.iterdir())
        for journal in journals.journals(bench.context):
            if journal.last("intent") is not None and journal.path.name not in intents:
                intents.append(journal.path.name)
                assert journal.path.name in known

    monkeypatch.setattr(os, "fsync", fsync)
    with grouping.grouped(bench.link, bench.context, "table") as parts:
        upload.upload_tables(bench.link, parts, [rig.new])
    assert intents
    assert {journal.path.name for journal in journals.journals(bench.context)} <= known
    count_runs(1)
