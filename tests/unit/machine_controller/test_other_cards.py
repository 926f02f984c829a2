"""Cards that behave differently: each works, or is refused in words."""

from pathlib import Path

import pytest

from pmac_comp.base.errors import CommandRefused, ControllerState, MotorNotSafe
from pmac_comp.files.bench import load_bench
from pmac_comp.machine.controller.card import identity
from pmac_comp.machine.controller.contents import programs
from pmac_comp.machine.controller.contents.law_bank import LawParameters
from pmac_comp.machine.controller.contents.programs import Program, ProgramKind
from pmac_comp.machine.controller.law import law_install, law_upload
from pmac_comp.machine.controller.motors import motors
from pmac_comp.machine.controller.settings import backup, guard_install
from pmac_comp.machine.controller.settings.program_upload import upload_program
from pmac_comp.machine.controller.tables import upload
from pmac_comp.machine.controller.whole import grouping
from pmac_comp.simulator.card.card import Card
from tests.faults.upload_bench import new_table
from tests.unit.machine_controller.card_bench import CardBench, make_plc_bench

LAW = LawParameters(T0=150.0, T_LIMIT=500.0)
PROGRAM = Program(ProgramKind.PROG, 704, ("LINEAR", "X1000"))


def locked(folder: Path) -> CardBench:
    """A card whose password came with its flash."""
    bench = make_plc_bench(folder)
    programs.download(bench.link, Program(ProgramKind.PLC, 9, ("P900=P900+1",)))
    bench.card.programs.password, bench.card.programs.unlocked = "Geheim", False
    return bench


def test_password_does_not_hinder_tables_and_motion_programs(tmp_path: Path) -> None:
    bench = locked(tmp_path)
    with grouping.grouped(bench.link, bench.context, "table") as parts:
        (said,) = guard_install.install_guard(bench.link, parts)
        result = upload.upload_tables(bench.link, parts, [new_table(40)])
    assert "password" in said
    assert result.verdict is ControllerState.NEW
    assert upload_program(bench.link, bench.context, PROGRAM).verdict is ControllerState.NEW


def test_password_refuses_the_law_and_the_backup_in_words(tmp_path: Path) -> None:
    bench = locked(tmp_path)
    with pytest.raises(CommandRefused) as refusal:
        law_install.install_law(bench.link, bench.context, 1)
    assert refusal.value.left is ControllerState.OLD
    assert "PASSWORD=" in (refusal.value.hint or "")
    with pytest.raises(CommandRefused) as refusal:
        backup.read_backup(bench.link, p_range=(0, 1), with_q=False)
    assert "PASSWORD=" in (refusal.value.hint or "")
    bench.link.command("PASSWORD=Geheim")
    law_install.install_law(bench.link, bench.context, 1)
    assert law_upload.upload_law(bench.link, bench.context, LAW).verdict is ControllerState.NEW


@pytest.mark.parametrize("i3", [0, 1, 2, 3])
def test_every_echo_mode_that_was_left_behind(tmp_path: Path, i3: int) -> None:
    bench = make_plc_bench(tmp_path)
    bench.link.command("I9=1")
    bench.side_port()(f"I3={i3}I6=3I9=3")
    bench.reconnect()
    assert identity.read_identity(bench.link).dpram == "large"
    result = upload.upload_tables(bench.link, bench.context, [new_table(40)])
    assert result.verdict is ControllerState.NEW
    assert tuple(bench.values("COMP", 1) or ()) == new_table(40).entries


def test_card_without_dual_ported_ram(tmp_path: Path) -> None:
    bench = CardBench(tmp_path, card=Card(load_bench("paper"), dpram="none"))
    assert identity.read_identity(bench.link).dpram == "none"
    motors.enable(bench.link, 1)
    assert upload.upload_tables(bench.link, bench.context, [new_table(40)]).verdict is (
        ControllerState.NEW
    )
    law_install.install_law(bench.link, bench.context, 1)
    assert law_upload.upload_law(bench.link, bench.context, LAW).verdict is ControllerState.NEW


def test_motor_that_is_not_phased_stays_off_in_words(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    # Phase-reference error, bit 8 of the second status word (p. 282).
    bench.card.memory.y[0xC0] = int(bench.card.memory.y[0xC0]) | 1 << 8
    bench.card.memory.touch()
    with pytest.raises(MotorNotSafe, match="phasing error"):
        motors.enable(bench.link, 1, timeout_s=0.2)


def test_old_firmware_that_is_still_supported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = make_plc_bench(tmp_path)
    receive = bench.session.receive
    monkeypatch.setattr(
        bench.session, "receive", lambda data: receive(data).replace(b"1.947", b"1.940")
    )
    assert identity.read_identity(bench.link).firmware == "1.940"
    result = upload.upload_tables(bench.link, bench.context, [new_table(40)])
    assert result.verdict is ControllerState.NEW
