"""F24, F29: a measurement leaves the whole card as it found it, however it ends."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from pmac_comp.base.errors import LinkError, PmacCompError
from pmac_comp.files.bench import load_bench
from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.controller.motors import motors
from pmac_comp.machine.controller.settings.backup import Backup, compare, read_backup
from pmac_comp.machine.controller.whole import recovery, waiting
from pmac_comp.machine.transport.tap import Fault, FaultKind, Way
from pmac_comp.workflow.capture import session
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.axis_setup import AxisSetup
from pmac_comp.workflow.capture.capturing import CapturePlan, capture_to_folder
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.motion.motions import Motion, parse_motion
from tests.faults.killed_child import dies_after
from tests.faults.test_f19_f26_safety import trip
from tests.faults.upload_bench import put_back, saved
from tests.unit.machine_controller.card_bench import CardBench

pytestmark = pytest.mark.faults
Count = Callable[[int], None]
BENCH = load_bench("paper")
MOTION = "sine:amplitude_mm=0.2,frequency_Hz=5,cycles=2"
_MOTION_s = 8.0  # what a host that died has begun runs to its end on the card
FOREIGN = ("UNDEFINE ALL", "&1#1->500X", "&2#3->7Z", "I5190=500", "CLOSE")
OURS = ("CLOSE", "OPEN PROG 703 CLEAR", "DWELL100", "DWELL50", "CLOSE")


class Desk:
    """A person's card: what stands on it, and ``capture`` in this process."""

    def __init__(self, folder: Path, lines: tuple[str, ...], monkeypatch: pytest.MonkeyPatch):
        self.out, self.store = folder / "runs", folder / "journal"
        self.bench = CardBench(folder, bench=BENCH)
        for axis_file, value in BENCH.controller.ivariables.items():
            if axis_file not in {"I10", "I7000", "I7001", "I7002"}:
                self.bench.link.command(f"{axis_file}={value:.9g}")
        self.bench.link.write_buffer(list(lines))
        self.start = saved(self.bench)
        monkeypatch.setattr(session, "open_link", self._link)
        monkeypatch.setattr(
            session, "Axis", lambda link, bench, name, simulated, _address: Axis(
                link, bench, name, simulated, setup=AxisSetup(self.store)
            )
        )  # fmt: skip

    @contextmanager
    def _link(self, *_: object, **__: object) -> Iterator[Commander]:
        yield self.bench.link

    def restart(self) -> None:
        put_back(self.bench, self.start)
        for path in [*self.store.glob("*"), *self.out.glob("*")]:
            path.unlink()
        self.bench.tap.sent = self.bench.tap.received = 0

    def capture(self) -> None:
        plan = CapturePlan(BENCH, (parse_motion(MOTION, BENCH),))
        capture_to_folder("tcp://card", "paper", plan, self.out)

    def state(self) -> tuple[Backup, bool]:
        """All that stands on the card but our own block, and whether motor 1 holds."""
        self.bench.reconnect()
        self.bench.link.flush()
        whole = read_backup(self.bench.link, p_range=(7100, 7199), with_q=False)
        return whole, motors.read_motor(self.bench.link, 1).status.is_closed_loop


STANDING = {
    "bare": ("UNDEFINE ALL", "CLOSE"),
    "held": ("UNDEFINE ALL", "CLOSE", "#1J/"),
    "foreign": FOREIGN,
    "own axis": ("UNDEFINE ALL", "&1#1->X", "CLOSE"),
    "earlier run": OURS,
}


@pytest.fixture(params=STANDING)
def desk(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Desk:
    return Desk(tmp_path, STANDING[request.param], monkeypatch)


def unchanged(desk: Desk, before: tuple[Backup, bool]) -> bool:
    now = desk.state()
    assert [str(d) for d in compare(before[0], now[0])] == []
    return now[1] == before[1]


def test_f29_a_capture_leaves_the_card_as_found(desk: Desk, count_runs: Count) -> None:
    before = desk.state()
    desk.capture()
    assert unchanged(desk, before)
    count_runs(1)


@pytest.mark.parametrize("how", ["trip", "refused", "no samples", "interrupt"])
def test_f24_a_capture_that_fails_leaves_the_card_as_found(
    *, desk: Desk, how: str, monkeypatch: pytest.MonkeyPatch, count_runs: Count
) -> None:
    before = desk.state()
    run = Axis.run

    def failing(axis: Axis, motion: Motion, **options: object) -> object:
        if how == "no samples":
            raise PmacCompError("no samples", code="PC-TST-001")
        if how == "refused":
            axis.prepare(motion)
            axis.link.command("OPEN PROG 703 CLEAR NONSENSE")
        seen = [0]

        def act(_n: int) -> None:
            system = desk.bench.card.systems.get(1)
            seen[0] += system is not None and system.running
            if seen[0] == 3 and how == "trip":
                trip(desk.bench, "amplifier")
            if seen[0] == 3 and how == "interrupt":
                seen[0] += 1
                raise KeyboardInterrupt

        desk.bench.on_request = act
        return run(axis, motion, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(Axis, "run", failing)
    with pytest.raises((PmacCompError, KeyboardInterrupt)):
        desk.capture()
    held = unchanged(desk, before)
    assert held or (how == "trip" and before[1])  # a motor that tripped is left killed
    assert waiting.left_open(desk.bench.context) == ()
    count_runs(1)


@pytest.mark.parametrize("how", ["kill", "cut"])
def test_f29_after_a_kill_recover_leaves_the_card_as_found(
    *, desk: Desk, how: str, exhaustive: bool, count_runs: Count
) -> None:
    desk.restart()
    before = desk.state()
    desk.restart()
    desk.capture()
    total = desk.bench.tap.sent
    for n in range(total // 10, total, total // (40 if exhaustive else 4)):
        desk.restart()
        if how == "kill":
            with dies_after(desk.bench.tap, n):
                desk.capture()
        else:
            desk.bench.tap.schedule([Fault(FaultKind.CUT, Way.SEND, n)])
            with pytest.raises(LinkError):
                desk.capture()
        desk.bench.reconnect()
        desk.bench.clock.sleep_s(_MOTION_s)
        with session.open_axis("sim://", "paper") as axis:
            context = context_of(axis, desk.store)
            recovery.recover(axis.link, context)
            assert waiting.left_open(context) == ()
        unchanged(desk, before)
        count_runs(1)
