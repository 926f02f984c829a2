"""F15 to F22: refusals, silent losses, other clients, resets and motion during an upload."""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from pmac_comp.base.errors import (
    CommandRefused,
    ConfigError,
    ControllerState,
    FlashSuspect,
    ForeignChange,
    LeaseHeld,
    MotorNotSafe,
    PmacCompError,
    TableStateError,
)
from pmac_comp.files.bench import load_bench
from pmac_comp.machine.client.reads import is_read
from pmac_comp.machine.controller.change.lease import host_lock
from pmac_comp.machine.controller.change.manifest import Action, Manifest, ManifestState, decide
from pmac_comp.machine.controller.contents import programs
from pmac_comp.machine.controller.contents.comp_table import TableKind
from pmac_comp.machine.controller.law import law_arming, law_goal
from pmac_comp.machine.controller.settings import backup, guard_install
from pmac_comp.machine.controller.tables import table_files, table_recovery, upload
from pmac_comp.machine.controller.tables.table_status import HEAD_LINES, table_status
from pmac_comp.machine.controller.whole import persist, recovery, restore
from pmac_comp.simulator.card.card import Card
from tests.faults.upload_bench import UploadBench, new_table, old_table
from tests.unit.machine_controller.card_bench import CardBench

pytestmark = pytest.mark.faults
Count = Callable[[int], None]


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> UploadBench:
    return UploadBench(tmp_path_factory.mktemp("controller"), n=40)


class LineFault:
    """Answers, drops or doubles the k-th line that changes something on the card."""

    def __init__(self, bench: CardBench, k: int, kind: str, code: int = 3) -> None:
        port = bench.session.port
        self.line_as_it_is, self.verdict_as_it_is = port.line, port.verdict
        self.k, self.kind, self.code = k, kind, code
        self.seen = 0
        port.line = self.line  # type: ignore[method-assign]
        port.verdict = self.verdict  # type: ignore[method-assign]

    def line(self, text: str | bytes) -> bytes:
        """A line of its own, answered with text."""
        raw = text if isinstance(text, bytes) else text.encode()
        if not self._is_it(raw):
            return self.line_as_it_is(text)
        if self.kind == "refuse":
            return b"\x07ERR%03d\r" % self.code
        if self.kind == "drop":
            return b"\x06"
        self.line_as_it_is(text)
        return self.line_as_it_is(text)

    def verdict(self, raw: bytes) -> int | None:
        """A line of a buffer, answered with its error."""
        if not self._is_it(raw):
            return self.verdict_as_it_is(raw)
        if self.kind == "refuse":
            return self.code
        if self.kind == "drop":
            return None
        self.verdict_as_it_is(raw)
        return self.verdict_as_it_is(raw)

    def _is_it(self, raw: bytes) -> bool:
        if is_read(raw.decode()):
            return False
        self.seen += 1
        return self.seen - 1 == self.k


def buffer_lines(rig: UploadBench) -> int:
    """How many lines an upload sends in buffers."""
    counter: list[LineFault] = []
    assert rig.upload_with(lambda b: counter.append(LineFault(b, -1, "none"))) is None
    return counter[0].seen


def test_f15_every_line_refused_with_every_code(
    *, rig: UploadBench, exhaustive: bool, count_runs: Count
) -> None:
    n_lines = buffer_lines(rig)
    codes = range(1, 23) if exhaustive else (3, 6)
    runs = 0
    for k in range(n_lines):
        for code in codes:
            error = rig.upload_with(lambda b, k=k, code=code: LineFault(b, k, "refuse", code))
            runs += 1
            assert isinstance(error, CommandRefused), (k, code, error)
            assert error.context["error"] == code
            assert error.left is rig.state, (k, error)
            if rig.state is ControllerState.DISABLED:
                assert rig.recover(resume=False) is ControllerState.OLD
    count_runs(runs)


@pytest.mark.parametrize("kind", ["drop", "double"])
def test_f16_line_lost_or_doubled_is_found(
    *, rig: UploadBench, kind: str, count_runs: Count
) -> None:
    n_lines = buffer_lines(rig)
    harmless = 0
    for k in range(n_lines):
        error = rig.upload_with(lambda b, k=k: LineFault(b, k, kind))
        state = rig.state
        if error is None:
            # Only a line without which the same tables result may be lost.
            assert state is ControllerState.NEW, k
            harmless += 1
        else:
            assert error.left is state, (k, error)
            assert rig.recover() in {ControllerState.OLD, ControllerState.NEW}
    assert harmless < n_lines
    count_runs(n_lines)


ACTIONS = ["I51=1", "I51=0", "7", "P7072=12345", "#1DELETE COMP", "P7078=77"]


@pytest.mark.parametrize("action", ACTIONS)
def test_f17_another_client_acts_after_every_packet(
    *, rig: UploadBench, action: str, count_runs: Count
) -> None:
    total: list[int] = []
    rig.upload_with(lambda b: setattr(b, "on_request", total.append))
    n_requests = total[-1] + 1
    wrong: list[int] = []
    for k in range(n_requests):

        def install(bench: CardBench, k: int = k) -> None:
            other = bench.side_port()
            bench.on_request = lambda n: other(action) and None if n == k else None

        error = rig.upload_with(install)
        truth = rig.truth
        whole = truth.entries in {None, rig.old.entries, rig.new.entries}
        if error is not None:
            # We never leave a broken table enabled.
            assert whole or not truth.i51, (k, action, error)
        elif not (truth.i51 and truth.entries == rig.new.entries):
            wrong.append(k)
            status = table_status(rig.bench.link, rig.bench.context)
            assert status.decision.state is not ControllerState.NEW, (k, action)
    # What is changed after the last look of the upload is found by the next status.
    assert all(k >= n_requests - 12 for k in wrong), wrong
    count_runs(n_requests)


@pytest.mark.parametrize("guarded", [True, False])
def test_f18_another_client_enables_during_the_upload(
    *, tmp_path: Path, guarded: bool, count_runs: Count
) -> None:
    rig = UploadBench(tmp_path, n=40)
    link = rig.bench.link
    if guarded:
        link.write_buffer([f"M{n}->{d}" for n, d in law_goal.definitions(1).items()])
        programs.download(link, guard_install.guard_program(rig.bench.context.block))
        link.write_buffer(["I5=3", "ENABLE PLC 1"])
        rig.bench.clock.sleep_s(0.05)
        assert rig.bench.p(7080) > 0
    rig.save()
    total: list[int] = []
    rig.upload_with(lambda b: setattr(b, "on_request", total.append))
    live_cycles, runs, told = [], 0, 0
    for k in range(total[-1]):
        since: list[int] = []

        def install(bench: CardBench, k: int = k, since: list[int] = since) -> None:
            other = bench.side_port()

            def act(n: int) -> None:
                writing = bench.p(7071) == 1 and bench.p(7070) == 505143
                if n == k and writing and not bench.i51:
                    other("I51=1")
                    since.append(bench.card.cycles)

            bench.on_request = act

        error = rig.upload_with(install)
        if not since:
            continue
        runs += 1
        assert rig.state in ControllerState
        if guarded:
            assert rig.bench.p(7081) == 1 or rig.bench.p(7082) >= 1 or error is not None
        elif error is not None:
            assert isinstance(error, ForeignChange)
            assert error.context["was_live"]
            assert "live" in error.message
            told += 1
        live_cycles.append(rig.bench.card.cycles - since[0])
    assert runs >= 3
    assert guarded or told >= 3
    count_runs(runs)


def test_f19_two_writers_on_this_host(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    with host_lock(bench.context), pytest.raises(LeaseHeld, match="this host") as refusal:
        upload.upload_tables(bench.link, bench.context, [new_table(40)])
    assert refusal.value.left is ControllerState.OLD


def test_f19_another_host_holds_the_lease(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    bench.link.write_buffer(["P7079=100000", "P7078=4711"])
    with pytest.raises(LeaseHeld) as refusal:
        upload.upload_tables(bench.link, bench.context, [new_table(40)])
    assert refusal.value.context["owner"] == 4711
    assert 0 < float(str(refusal.value.context["expires_in_s"])) < 100
    bench.link.write_buffer(["P7079=1"])
    bench.clock.sleep_s(0.1)
    result = upload.upload_tables(bench.link, bench.context, [new_table(40)])
    assert result.verdict is ControllerState.NEW
    assert bench.p(7078) == 0


@pytest.mark.parametrize("saved", [False, True])
def test_f20_reset_after_every_packet(*, tmp_path: Path, saved: bool, count_runs: Count) -> None:
    card = Card(load_bench("paper"), flash=tmp_path / "flash.bin")
    folder = tmp_path / "store"
    folder.mkdir()
    first = CardBench(folder, card=card)
    upload.upload_tables(first.link, first.context, [old_table(40)])
    if saved:
        first.link.command("SAVE", timeout_s=persist.SAVE_TIMEOUT_s)
    total: list[int] = []
    old, new = old_table(40).entries, new_table(40).entries

    def run(k: int) -> None:
        for path in folder.iterdir():
            path.unlink()
        bench = CardBench(folder, card=card)
        if not saved:
            with suppress(PmacCompError):
                upload.upload_tables(bench.link, bench.context, [old_table(40)])
            for path in folder.iterdir():
                path.unlink()
            bench.reconnect()

        def act(n: int) -> None:
            total.append(n)
            if n == k:
                card.reset()

        bench.on_request = act
        with suppress(PmacCompError):
            upload.upload_tables(bench.link, bench.context, [new_table(40)])
        bench.reconnect()
        values = bench.values("COMP", 1)
        assert not bench.i51 or tuple(values or ()) in {(), old, new}, k
        result = recovery.recover(bench.link, bench.context)
        values = bench.values("COMP", 1)
        if result.verdict is ControllerState.NEW:
            assert bench.i51
            assert tuple(values or ()) == new
        else:
            assert result.verdict is ControllerState.OLD, (k, result)
            assert values is None or tuple(values) == old
            assert bench.i51 or values is None, (k, result)
        card.reset()
        bench.session.close()

    run(10**6)
    n_requests = max(total) + 1
    for k in range(n_requests):
        run(k)
    count_runs(n_requests)


def test_f20_f18_decision_over_its_whole_domain(count_runs: Count) -> None:
    runs = 0
    seen: set[object] = set()
    for state in (None, ManifestState.WRITING, ManifestState.VALID):
        for i51 in (0, 1):
            for crc in (0, 111, 222, 333):
                for enabled_old in (0, 1):
                    for crc_old, crc_new in ((111, 222), (0, 222), (111, 0), (111, 111)):
                        manifest = None
                        if state is not None:
                            manifest = Manifest(state, 5, 40, crc_old, crc_new, enabled_old)
                        found = decide(manifest, i51, crc)
                        runs += 1
                        seen |= {found.state, found.action}
                        if manifest is None:
                            assert found.state is ControllerState.OLD
                            continue
                        if found.state is ControllerState.NEW:
                            assert i51
                            assert crc == crc_new
                            assert state is ManifestState.VALID
                        if found.state is ControllerState.OLD:
                            assert crc == crc_old
                            assert i51 in {1, enabled_old}
                        if found.action is Action.DISABLE:
                            assert i51
                            assert crc != crc_old
                        if found.action is Action.RESUME:
                            assert not (i51 and crc)
                            assert crc == crc_new
    assert seen >= {*ControllerState, Action.DISABLE, Action.RESUME}
    count_runs(runs)


def test_f21_damaged_flash_is_recognised_and_restored(tmp_path: Path, count_runs: Count) -> None:
    flash = tmp_path / "flash.bin"
    card = Card(load_bench("paper"), flash=flash)
    bench = CardBench(tmp_path / "store", card=card)
    upload.upload_tables(bench.link, bench.context, [old_table(40)])
    bench.link.command("SAVE", timeout_s=persist.SAVE_TIMEOUT_s)
    stored = backup.read_backup(bench.link, p_range=(7000, 7199))
    image = flash.read_bytes()
    blocks = [len(image) * k // 5 for k in range(5)]
    for n, at in enumerate(blocks):
        broken = bytearray(image)
        broken[at : at + 64] = b"\xff" * len(broken[at : at + 64])
        flash.write_bytes(bytes(broken))
        bench = CardBench(bench.folder, card=Card(load_bench("paper"), flash=flash))
        with pytest.raises(FlashSuspect):
            backup.check_flash(bench.link, stored)
        if n == 0:
            _, remaining = restore.restore(bench.link, bench.context, stored)
            assert remaining == ()
            assert tuple(bench.values("COMP", 1) or ()) == old_table(40).entries
            backup.check_flash_values(bench.link, stored)
    count_runs(len(blocks))


def test_f22_motion_that_starts_during_the_upload(*, rig: UploadBench, count_runs: Count) -> None:
    total: list[int] = []
    rig.upload_with(lambda b: setattr(b, "on_request", total.append))
    refused = 0
    for k in range(total[-1] + 1):

        def install(bench: CardBench, k: int = k) -> None:
            other = bench.side_port()
            bench.on_request = lambda n: other("#1J+") and None if n == k else None

        error = rig.upload_with(install)
        if error is not None:
            refused += 1
            assert error.left is rig.state, (k, error)
            if error.left is ControllerState.DISABLED:
                assert not rig.bench.i51
        rig.bench.link.command("#1J/")
        rig.bench.clock.sleep_s(0.3)
        rig.bench.link.command("#1J=0")
        rig.bench.clock.sleep_s(0.5)
    assert refused > 0.5 * total[-1]
    count_runs(total[-1] + 1)


def test_f22_a_moving_motor_is_refused_before_anything_is_written(rig: UploadBench) -> None:
    def install(bench: CardBench) -> None:
        bench.link.command("#1J+")
        bench.clock.sleep_s(0.1)

    error = rig.upload_with(install)
    assert isinstance(error, MotorNotSafe)
    assert rig.state is ControllerState.OLD
    rig.bench.link.command("#1J/")
    rig.bench.clock.sleep_s(0.3)
    rig.bench.link.command("#1J=0")
    rig.bench.clock.sleep_s(1.0)


def test_f20_backup_that_was_touched_is_refused(rig: UploadBench) -> None:
    rig.upload_with(lambda _b: None)
    path = next(rig.folder.glob("*.tables.json"))
    data = bytearray(path.read_bytes())
    for k in range(0, len(data), 37):
        broken = bytearray(data)
        broken[k] ^= 1
        path.write_bytes(bytes(broken))
        with suppress(ConfigError):
            table_files.read_table_backup(path)
            text = path.read_text(encoding="utf-8")
            assert text.strip() != data.decode().strip()
            pytest.fail(f"a changed byte {k} was not noticed")
    path.write_bytes(bytes(data))
    assert table_recovery.rollback_tables(rig.bench.link, rig.bench.context, path).verdict is (
        ControllerState.OLD
    )
    assert rig.state is ControllerState.OLD


def test_f16_removal_leaves_nothing(rig: UploadBench) -> None:
    bench = rig.restart()
    upload.remove_tables(bench.link, bench.context, [(TableKind.COMP, 1)])
    assert rig.truth.entries is None
    assert not rig.truth.i51
    with pytest.raises(TableStateError):
        law_arming.arm(bench.link, bench.context)


@pytest.mark.parametrize("prepared", [False, True])
def test_f22_slow_drift_is_refused_before_anything_is_switched(
    *, rig: UploadBench, prepared: bool, count_runs: Count
) -> None:
    """A motor that creeps shows in positions only, over 20 ms and more."""
    switched: list[str] = []

    def creep(bench: CardBench) -> None:
        ask, do = bench.link.query, bench.link.command
        start_s = bench.clock.now_s()

        def crept(text: str, lines: list[str]) -> list[str]:
            before, found, _ = text.partition("#1?#1P#1V#1F")
            if found and "I51=" not in before:
                # Other questions may stand before the motor in its line.
                at = 1 + HEAD_LINES * ("???" in before) + before.count("RL$17")
                lines[at] = f"{float(lines[at]) + 1500.0 * (bench.clock.now_s() - start_s):.1f}"
            return lines

        def query(text: str, **options: float) -> list[str]:
            return crept(text, ask(text, **options))

        def command(text: str, **options: float) -> list[str]:
            switched.append(text)
            return crept(text, do(text, **options))

        bench.link.query, bench.link.command = query, command  # type: ignore[method-assign]

    bench = rig.restart()
    creep(bench)
    with upload.TableUpload(bench.link, bench.context, [rig.new]) as change:
        if prepared:
            assert any("moves by itself" in r.message for r in change.prepare().refusals)
        with pytest.raises(MotorNotSafe, match="moves by itself") as refused:
            change.execute()
    assert refused.value.left is rig.state is ControllerState.OLD
    assert refused.value.context["confirmed"]
    assert not any("I51=" in text for text in switched)
    assert bench.p(7078) == 0
    assert rig.recover() is ControllerState.OLD
    count_runs(1)
