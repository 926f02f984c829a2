"""F29, F30: the program is killed or interrupted in the middle of an upload."""

import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from pmac_comp.base.errors import (
    ControllerState,
    UploadIncomplete,
)
from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.controller import upload
from tests.faults.killed_child import serve_child
from tests.faults.upload_bench import UploadBench
from tests.unit.machine_controller.card_bench import CardBench

pytestmark = pytest.mark.faults
Count = Callable[[int], None]


def killed_upload(rig: UploadBench, kill_after: int) -> tuple[int, int]:
    """An upload killed after so many bytes: exit status and bytes."""

    def work(link: Commander) -> None:
        upload.upload_tables(link, rig.bench.context, [rig.new])

    return serve_child(rig.bench.card, work, kill_after)


def test_f29_sigkill_at_any_byte(*, tmp_path: Path, exhaustive: bool, count_runs: Count) -> None:
    rig = UploadBench(tmp_path)
    rig.restart()
    status, total = killed_upload(rig, 1 << 30)
    assert status == 0
    assert rig.state is ControllerState.NEW
    points = range(0, total, 1 if exhaustive else total // 9)
    for n in points:
        rig.restart()
        status, _ = killed_upload(rig, n)
        assert os.WIFSIGNALED(status)
        assert os.WTERMSIG(status) == signal.SIGKILL
        assert rig.state in ControllerState
        rig.bench.link.command("P7080=0")
        assert rig.recover(resume=n % 2 == 0) in {ControllerState.OLD, ControllerState.NEW}
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
        with pytest.raises(UploadIncomplete) as stopped:
            upload.upload_tables(bench.link, context, [rig.new])
        runs += 1
        assert stopped.value.left is rig.state
        assert rig.state is not ControllerState.NEW
        assert bench.p(7080) == 0
        if rig.state is ControllerState.DISABLED:
            assert rig.recover() is ControllerState.OLD
    count_runs(runs)
