"""F29, F30: the program is killed or interrupted in the middle of an upload."""

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from pmac_comp.base.errors import ChangeInterrupted, ControllerState
from pmac_comp.base.interrupts import DeferredInterrupt
from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.controller.change import journals
from pmac_comp.machine.controller.tables import upload
from pmac_comp.machine.transport.tap import FaultKind, Way
from tests.fault_table import all_of
from tests.faults.change_bench import ChangeBench
from tests.faults.killed_child import serve_child
from tests.faults.same_state import stand_ins
from tests.faults.test_f01_f29_every_kind import SCENARIOS
from tests.faults.upload_bench import SameIds, UploadBench
from tests.unit.machine_controller.card_bench import CardBench

pytestmark = pytest.mark.faults
Count = Callable[[int], None]


def killed_upload(rig: UploadBench, kill_after: int) -> tuple[int, int]:
    """An upload killed after so many bytes: exit status and bytes."""

    def work(link: Commander) -> None:
        upload.upload_tables(link, rig.bench.context, [rig.new])

    return serve_child(rig.bench.card, work, kill_after)


def test_f29_sigkill_at_any_byte(
    *,
    tmp_path: Path,
    exhaustive: bool,
    count_runs: Count,
    count_places: Count,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ids = SameIds()
    monkeypatch.setattr(journals, "secrets", ids)
    rig = UploadBench(tmp_path, ids=ids)
    rig.restart()
    status, total = killed_upload(rig, 1 << 30)
    assert status == 0
    assert rig.state is ControllerState.NEW
    if exhaustive:
        places = rig.places(Way.SEND, FaultKind.CUT)
        count_places(sum(map(len, places)))
        points = all_of(stand_ins(places))
    else:
        points = [(n, n % 2 == 0) for n in range(0, total, total // 9)]
    for n, resume in points:
        rig.restart()
        status, _ = killed_upload(rig, n)
        if not os.WIFSIGNALED(status):
            # It waited less often than the first, and was through before this byte.
            assert (status, rig.state) == (0, ControllerState.NEW), n
            continue
        assert os.WTERMSIG(status) == signal.SIGKILL
        assert rig.state in ControllerState
        rig.bench.link.command("P7078=0")
        assert rig.recover(resume=resume) in {ControllerState.OLD, ControllerState.NEW}
    count_runs(len(points))


def test_f30_interrupt_at_every_request(tmp_path: Path, count_runs: Count) -> None:
    rig = UploadBench(tmp_path, n=40)
    total: list[int] = []
    rig.upload_with(lambda b: setattr(b, "on_request", total.append))
    for k in range(total[-1] + 1):

        def install(bench: CardBench, k: int = k) -> None:
            def interrupt(n: int) -> None:
                if n == k:
                    raise KeyboardInterrupt

            bench.on_request = interrupt

        with pytest.raises(KeyboardInterrupt):
            rig.upload_with(install)
        assert rig.state in ControllerState
        assert rig.recover(resume=bool(k % 2)) in {ControllerState.OLD, ControllerState.NEW}
    count_runs(total[-1] + 1)


def test_f30_first_request_to_stop_ends_after_the_packet(tmp_path: Path, count_runs: Count) -> None:
    rig = UploadBench(tmp_path, n=1000)
    runs = 0
    for after in range(5):
        bench = rig.restart()
        asked: list[int] = []

        def stop(asked: list[int] = asked, after: int = after) -> bool:
            asked.append(1)
            return len(asked) > after

        context = upload.Context(
            bench.context.block, bench.context.limits, bench.folder, bench.context.servo_period_s,
            stop_requested=stop,
        )  # fmt: skip
        with pytest.raises(ChangeInterrupted) as stopped:
            upload.upload_tables(bench.link, context, [rig.new])
        runs += 1
        assert stopped.value.left is rig.state
        assert rig.state is not ControllerState.NEW
        assert bench.p(7078) == 0
        if rig.state is ControllerState.DISABLED:
            assert rig.recover() is ControllerState.OLD
    count_runs(runs)


@pytest.fixture
def plain_signals() -> Iterator[None]:
    """As a program starts: Ctrl-C raises KeyboardInterrupt."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def signalled(k: int, times: int = 1) -> Callable[[CardBench], None]:
    """Ctrl-C while the k-th request is under way."""

    def install(bench: CardBench) -> None:
        def interrupt(n: int) -> None:
            if n == k:
                for _ in range(times):
                    os.kill(os.getpid(), signal.SIGINT)

        bench.on_request = interrupt

    return install


@pytest.mark.usefixtures("plain_signals")
def test_f30_first_ctrl_c_ends_with_a_verdict(tmp_path: Path, count_runs: Count) -> None:
    rig = UploadBench(tmp_path, n=40)
    total: list[int] = []
    rig.upload_with(lambda b: setattr(b, "on_request", total.append))
    verdicts = set()
    for k in range(total[-1] + 1):
        error = rig.upload_with(signalled(k))
        assert isinstance(error, ChangeInterrupted), k
        assert error.exit_code == 130
        assert error.left is rig.state, k
        assert error.context["confirmed"]
        assert rig.bench.p(7078) == 0
        verdicts.add(rig.state)
        assert rig.recover() in {ControllerState.OLD, ControllerState.NEW}
    assert verdicts == set(ControllerState)
    count_runs(total[-1] + 1)


@pytest.mark.usefixtures("plain_signals")
def test_f30_second_ctrl_c_ends_at_once(tmp_path: Path, count_runs: Count) -> None:
    rig = UploadBench(tmp_path, n=40)
    total: list[int] = []
    rig.upload_with(lambda b: setattr(b, "on_request", total.append))
    for k in range(total[-1] + 1):
        with pytest.raises(KeyboardInterrupt):
            rig.upload_with(signalled(k, times=2))
        assert rig.state in ControllerState
        assert rig.recover(resume=bool(k % 2)) in {ControllerState.OLD, ControllerState.NEW}
    count_runs(total[-1] + 1)


@pytest.mark.usefixtures("plain_signals")
def test_f30_ctrl_c_in_an_upload_of_several_parts(tmp_path: Path, count_runs: Count) -> None:
    """The parts before are taken back at once, also from between the parts."""
    for scenario in (s for s in SCENARIOS if s.name in {"law route", "cam route"}):
        rig = ChangeBench(tmp_path, scenario)
        total: list[int] = []
        rig.restart()
        rig.bench.on_request = total.append
        rig.scenario.change(rig.bench.link, rig.bench.context)
        for k in total[1 :: max(1, len(total) // 12)]:
            rig.restart()
            signalled(k)(rig.bench)
            error = rig.attempt()
            assert isinstance(error, ChangeInterrupted), (scenario.name, k)
            assert error.left is ControllerState.OLD, (scenario.name, k)
            rig.fresh()
            rig.judge(ControllerState.OLD)
            count_runs(1)


@pytest.mark.usefixtures("plain_signals")
def test_f30_signals_of_others_are_left_alone() -> None:
    seen: list[int] = []
    signal.signal(signal.SIGINT, lambda number, _frame: seen.append(number))
    with DeferredInterrupt() as deferred:
        os.kill(os.getpid(), signal.SIGINT)
    assert seen == [signal.SIGINT]
    assert not deferred.pending
