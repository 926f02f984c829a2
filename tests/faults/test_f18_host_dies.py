"""F18: the host dies, and the axis moves: the card keeps half-written things off by itself."""

from collections.abc import Callable
from pathlib import Path

import pytest

from pmac_comp.base.errors import ControllerState, LinkLost, SafetyRefusal
from pmac_comp.machine.controller.contents.law_bank import Index, LawBlock, LawParameters
from pmac_comp.machine.controller.law import law_arming, law_install, law_upload
from pmac_comp.machine.controller.settings import guard_install
from pmac_comp.machine.controller.whole import recovery
from pmac_comp.machine.transport.tap import Fault, FaultKind, Way
from tests.faults.upload_bench import UploadBench
from tests.unit.machine_controller.card_bench import CardBench, make_plc_bench

pytestmark = pytest.mark.faults
Count = Callable[[int], None]
BLOCK = LawBlock()
WRITING, SCANS = BLOCK.p(Index.MANIFEST) + 1, 7080
BOUND_CT = 5.0  # the bench's limit of a step


def half_written(rig: UploadBench) -> list[int]:
    """Numbers of bytes after which the tables stand half-written on the card."""
    found: list[int] = []

    def watch(bench: CardBench) -> None:
        def note(_n: int) -> None:
            if bench.p(WRITING) == 1 and not bench.i51:
                found.append(bench.tap.sent)

        bench.on_request = note

    assert rig.upload_with(watch) is None
    return found[:-1]  # the last of them seals


def worst_error_ct(bench: CardBench, cycles: int) -> float:
    """Largest following error, correction included, over so many servo cycles."""
    other = bench.side_port()
    worst = 0.0
    for _ in range(cycles):
        bench.card.run_cycles(1)
        worst = max(worst, abs(float(other("#1F").strip(b"\r\x06"))))
    return worst


@pytest.mark.parametrize("kind", [FaultKind.CUT, FaultKind.SILENCE])
def test_f02_a_lost_answer_beside_the_guard_is_not_called_certain(
    *, tmp_path: Path, kind: FaultKind, count_runs: Count
) -> None:
    """The card took the manifest, and the guard then switched off: a confirmed verdict is true."""
    rig = UploadBench(tmp_path, n=40)
    rig.bench.link.command("I5=2")
    guard_install.install_guard(rig.bench.link, rig.bench.context)
    rig.save()
    ends: list[int] = []

    def note(bench: CardBench) -> None:
        bench.on_request = lambda _n: ends.append(bench.tap.received)

    assert rig.upload_with(note) is None
    switched_off = confirmed = 0
    for n in ends:
        error = rig.upload_with(lambda b, n=n: b.tap.schedule([Fault(kind, Way.RECEIVE, n)]))
        rig.bench.clock.sleep_s(0.1)
        if error is not None and error.context["confirmed"]:
            assert error.left is rig.state, n
            confirmed += 1
        switched_off += rig.bench.p(WRITING) == 1 and not rig.bench.i51
        assert rig.recover() in {ControllerState.OLD, ControllerState.NEW}
        count_runs(1)
    assert switched_off
    assert confirmed


def test_f18_half_written_tables_stay_off_a_moving_axis(tmp_path: Path, count_runs: Count) -> None:
    """Somebody jogs the axis and switches on what the dead host left: the guard is faster."""
    rig = UploadBench(tmp_path, n=40)
    guard_install.install_guard(rig.bench.link, rig.bench.context)
    rig.bench.clock.sleep_s(0.05)
    rig.save()
    at = half_written(rig)
    assert len(at) >= 3
    for n in at:
        rig.upload_with(lambda b, n=n: b.tap.schedule([Fault(FaultKind.CUT, Way.SEND, n)]))
        bench = rig.bench
        assert bench.p(WRITING) == 1
        bench.reconnect()
        other = bench.side_port()
        other("#1J+")
        bench.clock.sleep_s(0.3)
        usual = worst_error_ct(bench, 100)
        scans = bench.p(SCANS)
        other("I51=1")
        while bench.i51:
            bench.card.run_cycles(1)
        assert bench.p(SCANS) - scans <= 5
        assert worst_error_ct(bench, 400) <= usual + 2.0 * BOUND_CT
        with pytest.raises(SafetyRefusal, match="executing a move"):
            recovery.recover(bench.link, bench.context)
        assert not bench.i51
        other("#1J/")
        bench.clock.sleep_s(0.3)
        other("#1K")
        bench.clock.sleep_s(0.5)
        rig.recover(resume=bool(n % 2))
        count_runs(1)


def test_f18_a_lost_heartbeat_in_motion_fades_the_law(tmp_path: Path, count_runs: Count) -> None:
    """Without its host the gain falls by its slew, in motion too, and nothing jumps."""
    bench = make_plc_bench(tmp_path)
    law_install.install_law(bench.link, bench.context, 1)
    law = LawParameters(S0=20.0, S_INV=0.05, T0=200.0, T_INV=0.05, T_LIMIT=500.0)
    law_upload.upload_law(bench.link, bench.context, law)
    law_arming.arm(bench.link, bench.context)
    bench.link.command("#1J+")
    bench.clock.sleep_s(0.5)
    gain, heartbeat = BLOCK.p(Index.GAIN), BLOCK.p(Index.HEARTBEAT)
    slew = bench.p(BLOCK.p(Index.SLEW))
    bench.link.command(f"P{heartbeat}=100")
    bench.session.close()  # the host is gone
    before = bench.p(gain)
    assert before == 1.0
    torque = bench.card.variables.read_i(129)
    for _ in range(3000):
        bench.card.run_cycles(1)
        now, then = bench.p(gain), bench.card.variables.read_i(129)
        assert before - now <= 1.01 * slew
        assert abs(then - torque) <= 200.0 * slew + 1.0
        before, torque = now, then
    assert before == 0.0
    assert torque == 0
    count_runs(1)


def test_f01_f18_a_lost_answer_is_confirmed_only_where_the_guard_had_its_say(
    tmp_path: Path, count_runs: Count
) -> None:
    """The card carries a request out and its answer is lost; the guard acts on what came."""
    rig = UploadBench(tmp_path, n=8)
    rig.bench.link.write_buffer(["I5=2"])
    guard_install.install_guard(rig.bench.link, rig.bench.context)
    rig.bench.clock.sleep_s(0.05)
    rig.save()

    def lose(bench: CardBench, n: int) -> None:
        receive = bench.session.receive

        def deaf(data: bytes) -> bytes:
            answer = receive(data)
            if data and bench.n_requests > n:
                raise LinkLost("the answer was lost", code="PC-LNK-001")
            return answer

        bench.session.receive = deaf  # type: ignore[method-assign]

    told: set[tuple[ControllerState | None, object]] = set()
    n = 0
    while (error := rig.upload_with(lambda b, n=n: lose(b, n))) is not None:
        rig.bench.clock.sleep_s(0.1)
        told.add((error.left, error.context["confirmed"]))
        if error.context["confirmed"]:
            assert rig.state is error.left, n
        n += 1
    assert (ControllerState.OLD, True) in told
    assert (ControllerState.OLD, False) in told
    count_runs(n)
