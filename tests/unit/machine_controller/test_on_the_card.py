"""Motors, gathering, backups, programs and the sign test on the simulated card."""

from pathlib import Path

import numpy as np
import pytest

from pmac_comp.base.errors import ConfigError, ControllerState, MotorNotSafe, VerifyMismatch
from pmac_comp.machine.controller.card import variables
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.change import transaction
from pmac_comp.machine.controller.contents import programs
from pmac_comp.machine.controller.contents.comp_table import BacklashTable, CompTable, TorqueTable
from pmac_comp.machine.controller.contents.law_bank import LawParameters
from pmac_comp.machine.controller.contents.programs import Program, ProgramKind
from pmac_comp.machine.controller.contents.settings import Settings
from pmac_comp.machine.controller.gather import gather
from pmac_comp.machine.controller.gather.gather_plan import GatherMode, GatherPlan, bench_sources
from pmac_comp.machine.controller.law import law_arming, law_install, law_state, law_upload
from pmac_comp.machine.controller.motors import motors, sign_check
from pmac_comp.machine.controller.settings import backup, program_upload, settings_upload
from pmac_comp.machine.controller.tables import upload
from pmac_comp.machine.controller.whole import recovery, restore, rollback
from tests.unit.machine_controller.card_bench import CardBench, CycleClock, make_plc_bench


def test_status_words_by_name() -> None:
    # Holding in position, homed, axis X of coordinate system 1 (Reference Manual p. 280-286).
    status = motors.MotorStatus.parse("892000078401")
    assert status.is_closed_loop
    assert status.is_commanded_still
    assert status.is_in_position
    assert "HOME_COMPLETE" in status.names()
    killed = motors.MotorStatus.parse("850000000000")
    assert killed.is_killed
    assert not killed.is_closed_loop
    assert motors.MotorStatus.parse("812000000006").trips == ("fatal following error",)


def test_motor_moves_and_waits(tmp_path: Path) -> None:
    bench = make_plc_bench(tmp_path)
    reading = motors.move_to(bench.link, 1, 12345.0, timeout_s=20.0)
    assert reading.position_ct == pytest.approx(12345.0, abs=5)
    bench.link.command("#1J:50000")
    with pytest.raises(MotorNotSafe, match="executing a move"):
        motors.require_stationary(bench.link, [1, 2])
    motors.kill(bench.link, 1)
    with pytest.raises(MotorNotSafe):
        motors.wait_in_position(bench.link, 1, timeout_s=5.0)


def test_variables_are_written_verified_and_refused(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    variables.write_many(bench.link, {"I113": 250000.0, "P7190": 1.2345678, "I135": 30000.0})
    assert variables.read_many(bench.link, ["I135", "P7190"]) == {
        "I135": 30000.0,
        "P7190": 1.2345678,
    }
    with pytest.raises(ConfigError, match="range"):
        variables.write_many(bench.link, {"I129": 40000.0})
    bench.link.command("I41=1")
    with pytest.raises(VerifyMismatch, match="I41"):
        variables.write_many(bench.link, {"I135": 1000.0})


def gather_ram(
    link: Link, plan: GatherPlan, duration_s: float, servo_period_s: float
) -> gather.GatherResult:
    """Samples of a fixed duration through the RAM buffer."""
    n_samples = 1 + int(np.ceil(duration_s / (servo_period_s * plan.period_cycles)))
    words = plan.layout.long_words * n_samples + gather.HEADER_LONG_WORDS
    with gather.prepared(link, plan, words):
        link.command("GATHER")
        link.clock.sleep_s(n_samples * plan.period_cycles * servo_period_s)
        gather.await_stored(link, plan, n_samples)
        link.command("ENDGATHER")
        return gather.read_ram(link, plan, n_samples)


def test_ram_gather_equals_ring_gather(tmp_path: Path) -> None:
    bench = make_plc_bench(tmp_path)
    sources = bench_sources(1, 2)
    period = bench.bench.servo_period_s
    bench.link.command("#1J:3000")
    ram = gather_ram(
        bench.link, GatherPlan(sources, mode=GatherMode.RAM), 0.5, period
    ).require_whole()
    bench.link.command("#1J:-3000")
    ring = gather.gather_ring(bench.link, GatherPlan(sources), 0.5, period).require_whole()
    for result in (ram, ring):
        assert np.all(np.diff(result.servo_cycle) == 1)
        error = (result.raw["commanded"] - result.raw["actual"]) / 3072
        assert np.max(np.abs(error)) < 200
        assert np.ptp(result.raw["actual"]) > 2000 * 3072
        assert np.ptp(result.raw["scale"]) > 15000 * 3072
        assert np.ptp(result.raw["output"]) > 256
    assert set(ram.raw) == set(ring.raw)


def test_decimated_gather(tmp_path: Path) -> None:
    bench = make_plc_bench(tmp_path)
    plan = GatherPlan(bench_sources(1, None), period_cycles=5)
    result = gather.gather_ring(bench.link, plan, 0.5, bench.bench.servo_period_s).require_whole()
    assert np.all(np.diff(result.servo_cycle) == 5)


class SlowCardClock(CycleClock):
    """Time of a host whose simulated card runs at half its speed."""

    def now_s(self) -> float:
        return 2.0 * super().now_s()

    def sleep_s(self, duration_s: float) -> None:
        super().sleep_s(0.5 * duration_s)


@pytest.mark.parametrize("mode", [GatherMode.RING, GatherMode.RAM])
def test_a_card_slower_than_the_host_is_gathered_for_its_own_time(
    tmp_path: Path, mode: GatherMode
) -> None:
    bench = make_plc_bench(tmp_path)
    bench.clock = SlowCardClock(bench.card)
    bench.connect()
    plan = GatherPlan(bench_sources(1, 2), mode=mode)
    way = gather.gather_ring if mode is GatherMode.RING else gather_ram
    result = way(bench.link, plan, 0.5, bench.bench.servo_period_s).require_whole()
    assert len(result.servo_cycle) >= int(0.5 / bench.bench.servo_period_s)


def test_sign_is_measured_and_everything_taken_back(tmp_path: Path) -> None:
    bench = make_plc_bench(tmp_path)
    bench.link.command("I134=0")
    before = float(bench.link.query("M162")[0]) / 3072
    law_install.install_law(bench.link, bench.context, 1)
    law_arming.disarm(bench.link, bench.context)
    bench.link.command("DISABLE PLC 0")
    found = sign_check.check_master_sign(bench.link, 1, offset_ct=20.0)
    assert found.sign == 1
    assert found.moved_ct == pytest.approx(20.0, abs=4.0)
    bench.clock.sleep_s(2.0)
    assert float(bench.link.query("M162")[0]) / 3072 == pytest.approx(before, abs=3.0)


def test_backup_compare_restore(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    tables = [
        CompTable(1, (16, 32, 0), 640000, by_desired=True),
        BacklashTable(1, (8, 0), 640000),
        TorqueTable(1, (256, 0), 640000),
    ]
    upload.upload_tables(bench.link, bench.context, tables)
    programs.download(bench.link, Program(ProgramKind.PROG, 55, ("LINEAR", "X1000", "DWELL100")))
    programs.download(bench.link, Program(ProgramKind.PLC, 9, ("P7150=P7150+1",)))
    bench.link.write_buffer(["&1#1->1000X", "M500->X:$10F0,0,8", "P7150=1.25"])
    stored = backup.read_backup(bench.link, p_range=(7000, 7199))
    path = tmp_path / "whole.json"
    backup.write_backup(path, stored)
    assert backup.load_backup(path) == stored
    bench.link.write_buffer(
        ["I130=5", "I51=0", "#1DELETE BLCOMP", "&1#1->2000X", "M500->*", "OPEN PROG 55 CLEAR",
         "X5", "CLOSE", "P7150=9", "OPEN PROG 66 CLEAR", "X1", "CLOSE"]
    )  # fmt: skip
    changed = backup.read_backup(bench.link, p_range=(7000, 7199))
    items = {d.item for d in backup.compare(stored, changed)}
    assert {"I130", "I51", "M500->", "&1#1->", "PROG 55", "PROG 66", "BLCOMP #1"} <= items
    result, remaining = restore.restore(bench.link, bench.context, stored)
    assert result.verdict is ControllerState.NEW
    assert remaining == ()
    assert bench.p(7150) == 1.25


def test_restore_brings_a_law_back_whole(tmp_path: Path) -> None:
    """Also what of its bank stands apart, behind manifest and lease."""
    bench = CardBench(tmp_path)
    law_install.install_law(bench.link, bench.context, 1)
    law = LawParameters(V0=0.1, TC=100.0, TP=0.001, SX=0.5, SS=0.1)
    law_upload.upload_law(bench.link, bench.context, law)
    found = backup.read_backup(bench.link)
    for other in (LawParameters(V0=0.2), LawParameters(V0=0.3)):
        law_upload.upload_law(bench.link, bench.context, other)
    restore.restore(bench.link, bench.context, found)
    block = bench.context.block
    bank = law_state.read_law_head(bench.link, block).bank
    assert law_state.read_bank(bench.link, block, bank) == law


def test_a_law_that_was_uploaded_again_is_the_new_one(tmp_path: Path) -> None:
    bench = make_plc_bench(tmp_path)
    for _ in range(2):
        law_upload.upload_law(bench.link, bench.context, LawParameters(T0=200.0, T_LIMIT=500.0))
        told = recovery.recover(bench.link, bench.context)
        assert told.verdict is ControllerState.NEW
        assert "the new law is in use" in told.notes[0]


def test_settings_that_were_put_on_again_are_the_new_ones(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    meant = Settings({"P10": "5"})
    for _ in range(2):
        settings_upload.change_settings(bench.link, bench.context, meant, route="settings")
        assert recovery.recover(bench.link, bench.context).verdict is ControllerState.NEW


def test_restore_refuses_an_enabled_motor(tmp_path: Path) -> None:
    bench = make_plc_bench(tmp_path)
    stored = backup.read_backup(bench.link, p_range=(7000, 7001))
    with pytest.raises(MotorNotSafe, match="killed"):
        restore.restore(bench.link, bench.context, stored)


def test_program_goes_up_and_comes_back(tmp_path: Path) -> None:
    bench = make_plc_bench(tmp_path)
    old = Program(ProgramKind.PROG, 710, ("LINEAR", "X1000"))
    first = program_upload.upload_program(bench.link, bench.context, old)
    new = Program(ProgramKind.PROG, 710, ("LINEAR", "X2000", "DWELL10"))
    second = program_upload.upload_program(bench.link, bench.context, new)
    assert (first.crc_old, second.crc_old, second.crc_new) == (0, old.crc, new.crc)
    assert second.backup is not None
    before = settings_upload.read_settings_backup(second.backup)
    settings_upload.change_settings(bench.link, bench.context, before)
    assert programs.is_present(bench.link, old)


EVERYTHING = [
    "M500->Y:$78000,0,16,S", "M501->D:$88", "M502->*", "M600->X:$B0,18,1",
    "I8000=$78000", "I8001=$78008", "I5001=$400088", "I5049=5", "I5050=$7",
    "I130=45000", "I5113=0", "P100=3.25", "P101=-0.0000125", "&1#1->1000X", "I122=35.5",
]  # fmt: skip


def filled(folder: Path) -> CardBench:
    """A card with something of every kind that a backup holds."""
    bench = CardBench(folder)
    bench.link.write_buffer([*EVERYTHING, "&1Q7=3.25"])
    programs.download(
        bench.link, Program(ProgramKind.PLC, 4, ("IF(P100>3)", "P102=SIN(P101)*2", "ENDIF"))
    )
    programs.download(
        bench.link, Program(ProgramKind.PROG, 20, ("LINEAR", "TA100", "X10F5", "DWELL100"))
    )
    bench.link.write_buffer(["I5=2", "ENABLE PLC 4"])
    tables = [
        CompTable(1, (16, 32, 16, 0), 640000, by_desired=True),
        BacklashTable(1, (8, 8, 8, 8), 640000, wrap=True),
        TorqueTable(1, (256, 0), 640000),
    ]
    upload.upload_tables(bench.link, bench.context, tables)
    return bench


def test_backup_of_everything_comes_back_token_by_token(tmp_path: Path) -> None:
    bench = filled(tmp_path)
    stored = backup.read_backup(bench.link, p_range=(100, 110))
    assert stored.running == {4}
    assert (stored.qvariables[7], len(stored.qvariables)) == ("3.25", 8192)
    assert {t.kind for t in stored.tables} == {t.kind for t in upload_kinds()}
    bench.link.write_buffer(
        ["M500->*", "M600->*", "I8000=0", "I5001=0", "I5049=0",
         "I130=1", "P100=0", "P101=7", "UNDEFINE ALL", "I122=2", "&1Q7=-1", "&1Q8191=2"]
    )  # fmt: skip
    programs.delete(bench.link, ProgramKind.PLC, 4)
    programs.delete(bench.link, ProgramKind.PROG, 20)
    programs.download(bench.link, Program(ProgramKind.PLC, 6, ("P110=1",)))
    upload.remove_tables(bench.link, bench.context, [(t.kind, t.motor) for t in stored.tables])
    before = backup.read_backup(bench.link, p_range=(100, 110))
    result, remaining = restore.restore(bench.link, bench.context, stored)
    assert result.verdict is ControllerState.NEW
    assert remaining == ()
    found = backup.read_backup(bench.link, p_range=(100, 110))
    assert backup.compare(stored, found, with_p=True) == ()
    assert bench.link.query("&1Q7 Q8191") == ["3.25", "0"]
    assert found.running == {4}
    # And the whole of it can be taken back.
    rollback.rollback_last(bench.link, bench.context)
    assert backup.compare(before, backup.read_backup(bench.link, p_range=(100, 110))) == ()


def test_long_restore_renews_its_lease(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = filled(tmp_path)
    stored = backup.read_backup(bench.link, p_range=(100, 2000))
    bench.link.write_buffer([f"P{n}=1" for n in range(110, 2000)])
    monkeypatch.setattr(transaction, "LEASE_s", 0.05)
    ends: list[float] = []
    bench.on_request = lambda _n: ends.append(bench.p(7079)) if bench.p(7078) else None
    restore.restore(bench.link, bench.context, stored)
    # Taken once for the settings and once for the tables; all others are renewals.
    assert len(set(ends)) > 5


def upload_kinds() -> tuple[CompTable, BacklashTable, TorqueTable]:
    return (
        CompTable(1, (0,), 640000), BacklashTable(1, (0,), 640000), TorqueTable(1, (0,), 640000)
    )  # fmt: skip


def test_restore_refuses_another_firmware_unless_told(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    stored = backup.read_backup(bench.link, p_range=(100, 101))
    stored.identity["firmware"] = "1.942"
    with pytest.raises(ConfigError, match=r"firmware 1\.942 there, 1\.947") as refusal:
        restore.restore(bench.link, bench.context, stored)
    assert refusal.value.left is ControllerState.OLD
    result, remaining = restore.restore(bench.link, bench.context, stored, other_card=True)
    assert result.verdict in {ControllerState.NEW, ControllerState.DISABLED}
    assert remaining == ()


@pytest.mark.faults
@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_f29_restore_that_is_cut_comes_back_to_what_stood(tmp_path: Path, share: float) -> None:
    bench = filled(tmp_path)
    stored = backup.read_backup(bench.link, p_range=(100, 110))
    bench.link.write_buffer(["I130=1", "P100=0", "M500->*"])
    programs.delete(bench.link, ProgramKind.PROG, 20)
    before = backup.read_backup(bench.link, p_range=(100, 110))
    requests: list[int] = []
    bench.on_request = requests.append
    restore.restore(bench.link, bench.context, stored)
    # Reading everything takes the first and the last requests; the change lies between.
    reading = sum(1 for _ in requests)
    rollback.rollback_last(bench.link, bench.context)
    bench.reconnect()
    first, last = _changing(bench, stored)
    rollback.rollback_last(bench.link, bench.context)
    bench.reconnect()
    cut_at = first + int(share * (last - first))

    def stop(n: int) -> None:
        if n == cut_at:
            raise ConnectionResetError

    bench.on_request = stop
    with pytest.raises(ConnectionResetError):
        restore.restore(bench.link, bench.context, stored)
    bench.reconnect()
    assert recovery.recover(bench.link, bench.context).verdict is ControllerState.OLD
    assert backup.compare(before, backup.read_backup(bench.link, p_range=(100, 110))) == ()
    assert reading > last


def _changing(bench: CardBench, stored: backup.Backup) -> tuple[int, int]:
    """Numbers of the first and last request of a restore while its lease is held."""
    held: list[int] = []
    bench.on_request = lambda n: held.append(n) if bench.p(7078) else None
    restore.restore(bench.link, bench.context, stored)
    return held[0], held[-1]


@pytest.mark.parametrize(
    ("to_ct", "said", "back"),
    [(12345, "above its software limit I113 = 5000", "#1J=4860"),
     (-12345, "below its software limit I114 = -9000", "#1J=-8860")],
)  # fmt: skip
def test_a_motor_beyond_its_software_limit_is_told_the_way_back(
    tmp_path: Path, to_ct: int, said: str, back: str
) -> None:
    bench = CardBench(tmp_path)
    motors.enable(bench.link, 1)
    bench.link.command("I113=5000 I114=-9000")
    with pytest.raises(MotorNotSafe, match="stopped on a position limit"):
        motors.move_to(bench.link, 1, to_ct, timeout_s=20.0)
    bench.clock.sleep_s(0.5)
    with pytest.raises(MotorNotSafe, match=said) as refused:
        motors.enable(bench.link, 1)
    assert refused.value.code == "PC-MOT-042"
    assert f"-c '{back}'" in str(refused.value.hint)
    bench.link.command(back)
    bench.clock.sleep_s(2.0)
    motors.enable(bench.link, 1)


def test_a_motor_on_a_limit_switch_is_not_told_of_its_amplifier(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    motors.enable(bench.link, 1)
    bench.link.command("I113=5000 I114=-5000")
    with pytest.raises(MotorNotSafe):
        motors.move_to(bench.link, 1, 12345.0, timeout_s=20.0)
    bench.link.command("I113=0 I114=0")  # what stopped it is no software limit
    with pytest.raises(MotorNotSafe, match="held by a limit switch") as refused:
        motors.enable(bench.link, 1)
    assert refused.value.code == "PC-MOT-043"
