"""Reports in the dual-ported RAM, read as a host reads them: bytes at the offsets of the manual."""

import struct

import pytest

from pmac_comp.simulator.card.card import Card

from .conftest import Ask

UNIT = 32 * 96


def cell(card: Card, offset: int) -> int:
    return int(struct.unpack("<i", card.memory.read_bytes(offset, 4))[0])


def long(card: Card, offset: int) -> int:
    low, high = cell(card, offset) & 0xFFFFFF, cell(card, offset + 4)
    return high * (1 << 24) + low


def half(card: Card, offset: int) -> int:
    return int(struct.unpack("<H", card.memory.read_bytes(offset, 2))[0])


@pytest.fixture
def moving(card: Card, ask: Ask) -> Card:
    ask("&1#1->1000X #1J/")
    card.run_cycles(50)
    ask("#1J:4000")
    card.run_cycles(400)
    return card


def ask_motors(card: Card, *motors: int) -> None:
    mask = sum(1 << (m - 1) for m in motors)
    card.memory.write_bytes(0x70, struct.pack("<I", mask))


def test_motor_data_every_i47_cycles(moving: Card, ask: Ask) -> None:
    # SRM p. 515-519: motor 1 at 0x74, motor 2 at 0xA4.
    ask_motors(moving, 1, 2)
    ask("I47=7 I48=1")
    stamps, fresh = [], 0
    for _ in range(30):
        moving.run_cycles(1)
        stamp = half(moving, 0x6C) | (half(moving, 0x6E) & 0xFF) << 16
        stamps.append(stamp)
        if stamp == int(moving.memory.x[0]):
            fresh += 1
            assert half(moving, 0x6E) & 0x8000
            assert long(moving, 0x9C) / UNIT == moving.servo.position(1)
            assert long(moving, 0x74) / UNIT == pytest.approx(
                moving.servo.following_error(1), abs=1e-3
            )
            assert cell(moving, 0x7C) & 0xFFFFFF == int(moving.memory.x[0xBF])
            assert cell(moving, 0x80) & 0xFFFFFF == int(moving.memory.x[0xB0])
            assert cell(moving, 0x84) & 0xFFFFFF == int(moving.memory.y[0xC0])
            assert long(moving, 0xCC) / UNIT == moving.servo.position(2)
    assert sorted(set(stamps))[1:] == list(range(stamps[-1] - 21, stamps[-1] + 1, 7))
    assert fresh >= 4


def test_host_keeps_the_card_off_while_it_reads(moving: Card, ask: Ask) -> None:
    ask_motors(moving, 1)
    ask("I47=1 I48=1")
    moving.run_cycles(5)
    moving.memory.write_bytes(0x6A, b"\0\x80")
    before = moving.memory.read_bytes(0x6C, 0x38)
    moving.run_cycles(20)
    assert moving.memory.read_bytes(0x6C, 0x38) == before
    moving.memory.write_bytes(0x6A, b"\0\0")
    moving.run_cycles(1)
    assert long(moving, 0x9C) / UNIT == moving.servo.position(1)


def test_on_demand_answers_once(moving: Card, ask: Ask) -> None:
    ask_motors(moving, 1)
    ask("I47=0 I48=1")
    moving.run_cycles(5)
    assert half(moving, 0x6E) == 0
    moving.memory.write_bytes(0x6A, b"\0\x80")
    moving.run_cycles(1)
    assert half(moving, 0x6A) == 0
    assert half(moving, 0x6C) == int(moving.memory.x[0]) & 0xFFFF
    before = moving.memory.read_bytes(0x6C, 0x38)
    moving.run_cycles(9)
    assert moving.memory.read_bytes(0x6C, 0x38) == before


def test_background_reports(moving: Card, ask: Ask) -> None:
    # SRM p. 519-525: global words at 0x688, coordinate system 1 at 0x69C.
    ask_motors(moving, 1)
    moving.memory.write_bytes(0x674, b"\2\0")
    ask("&1%50 PMATCH I5194=8000000 I50=20 I49=1 I57=1 I48=1")
    moving.run_cycles(60)
    assert ask("I48") == "0"  # I57 takes it back
    assert half(moving, 0x6E) & half(moving, 0x67A) & 0x8000
    assert cell(moving, 0x688) & 0xFFFFFF == int(moving.memory.x[6])
    assert cell(moving, 0x68C) & 0xFFFFFF == int(moving.memory.y[6])
    assert cell(moving, 0x6A4) / int(moving.memory.x[0x28]) == pytest.approx(0.5, abs=0.05)
    assert long(moving, 0x6AC) & 0xFFFFFFFFFFFF == (
        int(moving.memory.x[0x2040]) << 24 | int(moving.memory.y[0x2040])
    )
    assert cell(moving, 0x6FC) & 0xFFFFFF == int(moving.memory.y[0x203F])
    x_target = int(moving.memory.x[0x2047]) << 24 | int(moving.memory.y[0x2047])
    assert long(moving, 0x6E4) & 0xFFFFFFFFFFFF == x_target != 0
    ask("I49=0 I57=0")
    before = moving.memory.read_bytes(0x674, 0x90)
    moving.run_cycles(60)
    assert moving.memory.read_bytes(0x674, 0x90) == before


def test_backlash_shows_in_no_report_of_position(moving: Card, ask: Ask) -> None:
    ask_motors(moving, 1)
    ask("I185=100 I186=1600 I187=16 I47=1 I48=1 #1J=1000")
    moving.run_cycles(2000)
    ask("#1J=500")
    moving.run_cycles(2000)
    assert int(moving.memory.y[0x80 + 0x61]) == 1600
    assert float(ask("#1P")) == pytest.approx(500, abs=2)
    assert long(moving, 0x9C) / UNIT == pytest.approx(500, abs=2)
    assert abs(long(moving, 0x74) / UNIT) < 2
