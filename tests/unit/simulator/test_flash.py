"""SAVE, reset and what a spoiled flash image does."""

import os
from pathlib import Path

import pytest

from pmac_comp.base.errors import ConfigError
from pmac_comp.files.bench import Bench
from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.memory.flash import check_image

from .conftest import Ask

SET_UP = (
    "I130=777 P5=1.25",
    "&2Q7=-3",
    "M500->X:$10F0,0,8",
    "&2#1->100X+5",
    "#3DEFINE COMP 4,1000",
    "10 -20 30 0",
    "#1DEFINE COMP 4,#1D,2000",
    "1 2 3 4",
    "OPEN PROG 5 CLEAR",
    "LINEAR X10",
    "IF(P1=2)X5",
    "ELSE X6",
    "CLOSE",
    "OPEN PLC 3 CLEAR",
    "P6=P6+1",
    "CLOSE",
    "I51=1 I5=2",
)
QUESTIONS = (
    "I130 P5 &2 Q7 M500-> I51",
    "&2#1->",
    "#3LIST COMP",
    "#3LIST COMP DEF",
    "#1LIST COMP",
    "#1LIST COMP DEF",
    "LIST PROG 5",
    "LIST PLC 3",
)


def set_up(ask: Ask) -> list[str]:
    for line in SET_UP:
        assert ask(line) == "", line
    return [ask(q) for q in QUESTIONS]


def test_save_and_reset_bring_everything_back(card: Card, ask: Ask) -> None:
    before = set_up(ask)
    assert ask("SAVE") == ""
    ask("I130=1 P5=0 #1DELETE COMP")
    ask("#3DELETE COMP CLEAR ALL UNDEFINE ALL")
    ask("$$$")
    assert [ask(q) for q in QUESTIONS] == before
    assert ask("LIST GATHER") == "ERR003"
    card.run_cycles(50)
    assert int(ask("P6")) > 0  # PLCs in memory start by I5


def test_reset_without_save_goes_back_to_the_last_save(ask: Ask) -> None:
    before = ask("I130")
    ask("I130=5")
    ask("$$$")
    assert ask("I130") == before


def test_image_file_survives_the_process(bench: Bench, tmp_path: Path) -> None:
    path = tmp_path / "flash.bin"
    card = Card(bench, flash=path)
    port = card.port()
    for line in (*SET_UP, "SAVE"):
        port.line(line)
    again = Card(bench, flash=path).port()
    assert [again.line(q) for q in QUESTIONS] == [port.line(q) for q in QUESTIONS]


@pytest.mark.parametrize("place", [0, 30, 100, -1])
def test_spoiled_image_reverts_to_factory_values(bench: Bench, tmp_path: Path, place: int) -> None:
    path = tmp_path / "flash.bin"
    port = Card(bench, flash=path).port()
    port.line("I130=777 SAVE")
    data = bytearray(path.read_bytes())
    data[place] ^= 1
    path.write_bytes(bytes(data))
    port = Card(bench, flash=path).port()
    assert port.line("I3").endswith(b"1\r\n") or b"\n1\r" in port.line("I3")
    assert b"2000" in port.line("I130")
    word = int(port.line("???").strip(b"\n\r\x06")[:6], 16)
    assert word & (1 << 10)
    assert word & (1 << 13)


def test_reset_reads_the_image_on_disk(bench: Bench, tmp_path: Path) -> None:
    path = tmp_path / "flash.bin"
    port = Card(bench, flash=path).port()
    port.line("I130=777 SAVE")
    data = bytearray(path.read_bytes())
    data[200] ^= 1
    path.write_bytes(bytes(data))
    port.line("$$$")
    assert b"2000" in port.line("I130")
    word = int(port.line("???").strip(b"\n\r\x06")[:6], 16)
    assert word & (1 << 10)
    assert word & (1 << 13)


def test_truncated_image_reverts_too(bench: Bench, tmp_path: Path) -> None:
    path = tmp_path / "flash.bin"
    path.write_bytes(b"TURBO PMAC FLASH 1\n")
    assert b"2000" in Card(bench, flash=path).port().line("I130")


def test_factory_reset_keeps_definitions_and_drops_programs(ask: Ask) -> None:
    set_up(ask)
    ask("$$$***")
    ask("I4=0 I3=2")
    assert ask("I130 P5 &2 Q7 M500->") == "2000 1.25 -3 X:$10F0,0,8"
    assert ask("&2#1->") == "100X+5"
    assert ask("LIST PROG 5") == "ERR003"
    assert ask("#1LIST COMP") == "ERR003"


def test_reset_addresses_the_first_motor_and_system_again_on_every_port(
    card: Card, ask: Ask
) -> None:
    # SRM p. 276-277.
    other = card.port()
    other.line("#5&6##2")
    ask("#3&2##1")
    ask("$$$")
    assert ask("#&##") == "1 1 0"
    assert other.line("#&##") == b"1\r1\r0\r\x06"
    ask("#3&2")
    ask("$$$***")
    ask("I3=2 I4=0")
    assert ask("#&") == "1 1"


def test_reset_starts_the_clock_and_forgets_an_unsaved_password(card: Card, ask: Ask) -> None:
    card.run_cycles(round(5.5 / card.bench.servo_period_s))
    assert ask("TIME") == "00:00:05"
    ask("TIME=12:00:00 PASSWORD=x")
    ask("$$$")
    assert ask("TIME") == "00:00:00"
    ask("OPEN PLC 4 CLEAR P1=1 CLOSE")
    assert ask("LIST PLC 4") == "P1=1 RET"


def test_factory_reset_clears_the_status_of_motors_and_systems(card: Card, ask: Ask) -> None:
    fresh = ask("#1?")
    ask("#1->X #1J/ #1HMZ")
    card.run_cycles(100)
    assert int(ask("#1?")[6:], 16) & 1 << 14
    ask("$$$***")
    ask("I3=2 I4=0")
    word = int(ask("#1?")[6:], 16)
    assert word == 0x078000  # the axis definition stays (p. 273-274)
    assert fresh[6:] == "000000"


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("missing/flash.bin", "there is no folder "),
        ("folder", "it is a folder, not a file"),
        ("notes.txt", "it holds something else"),
        ("notes.txt/flash.bin", "a part of its path is a file"),
    ],
)
def test_a_path_that_cannot_be_saved_to_is_refused_at_the_start(
    tmp_path: Path, name: str, said: str
) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ConfigError, match=said) as refused:
        check_image(tmp_path / name)
    assert refused.value.code == "PC-SIM-006"
    assert "--flash" in refused.value.hint


@pytest.mark.parametrize("is_there", [False, True])
def test_a_folder_that_this_user_may_not_write_is_refused_at_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, is_there: bool
) -> None:
    """It failed at the first SAVE, which replaces the file and so writes its folder."""
    path = tmp_path / "flash.bin"
    if is_there:
        path.write_bytes(b"")
    check_image(path)
    monkeypatch.setattr(os, "access", lambda place, _mode: place != tmp_path)  # root may all
    with pytest.raises(ConfigError, match=f"may not write into the folder {tmp_path}"):
        check_image(path)
