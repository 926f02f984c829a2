"""Bytes of the ASCII dialog, typed in from Software Reference Manual pp. 37-40."""

import pytest

from pmac_comp.machine.wire.dialog import (
    CommandLine,
    ControlCharacter,
    LineReader,
    LineTooLong,
    format_error,
    format_reply,
    format_unsolicited,
)
from pmac_comp.machine.wire.errors import ERROR_MEANINGS, error_meaning, error_text
from pmac_comp.machine.wire.replies import Reply, ReplyReader, read_settled

VALUES = ["25", "50", "75"]  # P1..3 of the manual's example

PLAIN = [
    (0, [], b""),
    (1, [], b"\n"),
    (2, [], b"\x06"),
    (3, [], b"\x06"),
    (0, VALUES, b"25\r50\r75\r"),
    (1, VALUES, b"\n25\r\n50\r\n75\r\n"),
    (2, VALUES, b"25\r50\r75\r\x06"),
    (3, VALUES, b"\n25\r\n50\r\n75\r\x06"),
]


@pytest.mark.parametrize(("i3", "lines", "data"), PLAIN)
def test_answers_in_each_handshake_mode(i3, lines, data):
    assert format_reply(lines, i3=i3) == data
    assert read_settled(data, i3=i3) == Reply(tuple(lines))


@pytest.mark.parametrize(("i3", "lines", "data"), PLAIN)
def test_an_answer_is_not_taken_for_one_of_another_mode(i3, lines, data):
    for other in set(range(4)) - {i3}:
        # an answer without data looks the same with I3=2 and I3=3
        if not (lines == [] and {i3, other} == {2, 3}):
            found = read_settled(data, i3=other)
            assert found is None or found.lines != tuple(lines)


@pytest.mark.parametrize(
    ("i3", "lines", "data"),
    [
        # "5" CR sums to 0x35+0x0D=0x42; LF in front adds 0x0A; the command P1 sums to 0x81.
        (0, ["5"], b"5\r\x42\x81"),
        (1, ["5"], b"\n5\r\x4c\n\x81"),
        (2, ["5"], b"5\r\x42\x06\x81"),
        (3, ["5"], b"\n5\r\x4c\x06\x81"),
        (2, [], b"\x06\x81"),
    ],
)
@pytest.mark.parametrize("i4", [1, 3])
def test_checksums(i3, i4, lines, data):
    assert format_reply(lines, i3=i3, i4=i4, command=b"P1") == data
    assert read_settled(data, i3=i3, i4=i4) == Reply(tuple(lines), command_sum=0x81)


def test_a_sum_may_be_any_byte():
    # the sum of this line is a line feed: it must not count as one
    for i3 in range(4):
        data = format_reply(["KTYYbcpw"], i3=i3, i4=1, command=b"0")
        found = {k: read_settled(data, i3=k, i4=1) for k in range(4)}
        assert found.pop(i3) == Reply(("KTYYbcpw",), command_sum=0x30)
        assert all(reply is None for reply in found.values())


def test_text_of_programs_does_not_hide_a_settled_answer():
    data = format_unsolicited("HI", i3=3) + format_reply(["7"], i3=3)
    assert read_settled(data, i3=3) == Reply(("7",), unsolicited=("HI",))


def test_control_characters_do_not_count_in_the_command_s_sum():
    assert format_reply([], i4=1, command=b"P\x101") == b"\x06\x81"


@pytest.mark.parametrize(
    ("i3", "i6", "data"),
    [
        (2, 0, b"\x07"),
        (2, 1, b"\x07ERR003\r"),
        (2, 2, b"\x07"),
        (2, 3, b"\x07\rERR003\r"),
        (1, 1, b"\x07\nERR003\r"),
        (1, 0, b"\x07"),
        (1, 2, b"\x07"),
        (0, 3, b"\x07\rERR003\r"),
        (1, 3, b"\x07\r\nERR003\r"),
        (3, 1, b"\x07\nERR003\r"),
        (3, 3, b"\x07\r\nERR003\r"),
        (0, 1, b"\x07ERR003\r"),
    ],
)
def test_errors_in_each_reporting_mode(i3, i6, data):
    assert format_error(3, i3=i3, i6=i6) == data


@pytest.mark.parametrize("i6", [1, 3])
@pytest.mark.parametrize("i3", [2, 3])
@pytest.mark.parametrize("error", sorted(ERROR_MEANINGS))
def test_every_error_number_is_read(i3, i6, error):
    reader = ReplyReader()
    assert reader.receive(format_reply(["1"], i3=i3, i6=i6, error=error))
    assert reader.reply == Reply(("1",), error)


def test_twenty_two_errors_have_a_meaning():
    assert sorted(ERROR_MEANINGS) == list(range(1, 23))
    assert error_text(7) == "ERR007"
    assert "already in use" in error_meaning(7)
    assert "without" in error_meaning(99)


def test_text_of_programs():
    assert format_unsolicited("HI") == b"\x02HI\r"
    assert format_unsolicited("HI", i3=1) == b"\x02\nHI\r"
    assert format_unsolicited("HI", i64=0, i62=1) == b"HI"
    assert format_unsolicited("HI", i4=1) == b"\x02HI\r" + bytes([(2 + 72 + 73 + 13) % 256])


@pytest.mark.parametrize("checksum", [False, True])
def test_a_program_may_speak_in_the_middle_of_an_answer(checksum):
    i4 = int(checksum)
    answer = format_reply(["123", "456"], i4=i4, command=b"P1..2")
    speech = format_unsolicited("HI", i4=i4)
    for cut in (0, 1, 2):
        reader = ReplyReader(checksum=checksum)
        assert reader.receive(answer[:cut] + speech + answer[cut:])
        assert reader.reply.lines == ("123", "456")
        assert reader.reply.unsolicited == ("HI",)
        assert reader.reply.faults == ()


def test_the_manual_s_version_answer():
    reader = ReplyReader()
    assert reader.receive(b"1.942  \r\x06")
    assert reader.reply.lines == ("1.942  ",)


def test_bell_without_a_readable_number_is_an_error_of_unknown_number():
    reader = ReplyReader()
    assert reader.receive(b"1\r\x07ERR0x3\r")
    assert reader.reply == Reply(("1",), 0, faults=("'ERR0x3' is no error number",))
    reader = ReplyReader()
    assert reader.receive(b"\x07\x06")
    assert reader.reply == Reply((), 0, faults=("ACK after BEL",))
    reader = ReplyReader()
    assert reader.receive(b"12\x06")
    assert reader.reply == Reply(faults=("'12' ends without CR",))


@pytest.mark.parametrize("noise", [b"\r\n", b"\n", b"\x18", b"\x00", b"\r", b"\x02LATE\r"])
def test_noise_before_an_answer_does_not_shift_it(noise):
    reader = ReplyReader()
    assert reader.receive(noise + b"7\r\x06")
    assert reader.reply.lines == ("7",)
    assert reader.reply.faults == ()


def test_command_lines_of_a_port():
    events = LineReader().receive(b"ver\r\n#1\x10P\r\rP1\x08\x08I5\rgarb\x18P2\r")
    assert events == [
        CommandLine(b"ver"),
        ControlCharacter(0x10, b"#1"),
        CommandLine(b"#1P"),
        CommandLine(b""),
        CommandLine(b"I5"),
        ControlCharacter(0x18, b"garb"),
        CommandLine(b"P2"),
    ]


def test_backspace_takes_one_character_back():
    assert LineReader().receive(b"P12\x083\r\x08\x08I5\r") == [
        CommandLine(b"P13"),
        CommandLine(b"I5"),
    ]


def test_blanks_and_eight_bit_characters_belong_to_the_line():
    assert LineReader().receive(b" #1 J+ ~\x7f\xff\r") == [CommandLine(b" #1 J+ ~\x7f\xff")]
    assert LineReader().receive(b"\x1f\x01\r") == [
        ControlCharacter(0x1F),
        ControlCharacter(1),
        CommandLine(b""),
    ]


def test_a_line_longer_than_the_queue_is_reported_once():
    events = LineReader().receive(b"x" * 300 + b"\rver\r")
    assert events == [LineTooLong(300), CommandLine(b"ver")]
