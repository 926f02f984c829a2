"""Program text on the controller: download, list back, compare token by token.

What lives here: the files of ``firmware_plc`` as programs, adapted to the bench's motor and
P-block, and the comparison of what the card lists with what was sent. The card stores programs as
tokens and lists them in its own spelling (Software Reference Manual p. 297, 347-348), so texts are
compared after both are brought to one spelling.
"""

import re
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from typing import Final

from pmac_comp.base.errors import CommandRefused, ConfigError, VerifyMismatch
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.contents.law_bank import BLOCK_SIZE, DEFAULT_FIRST

PROTECTED: Final = 2  # ERR002
SLOWEST_CHARACTERS_PER_s: Final = 800.0  # 9600 baud with an answer to every line
_OPEN: Final = re.compile(r"^OPEN\s*(PLC|PROG(?:RAM)?)\s*(\d+)\s*(CLEAR)?$", re.I)
_P_OF_BLOCK: Final = re.compile(r"\bP(7[01]\d\d)\b(?:\.\.(7[01]\d\d)\b)?")
_MOTOR_I: Final = re.compile(r"\bI1(\d\d)\b")
# Alone or as a gather source, whose first digits say what is gathered (I5001-I5048).
_MOTOR_REGISTER: Final = re.compile(r"\$(?:([48C]00)([01][0-9A-F]{2})|([01]?[0-9A-F]{2}))\b")
_SEAL_OF_MOTOR: Final = 1000  # added to the motor; lines of a motion have no labels
_SEALED: Final = re.compile(r"^GOT10(0[1-9]|[12]\d|3[0-2])$")
_NUMBER: Final = re.compile(r"(?<![A-Z$\d.])(\d*\.?\d+|\d+\.)(?![\d.])")
_SPELLINGS: Final = (
    ("LINEAR", "LIN"),
    ("RAPID", "RPD"),
    ("ENDWHILE", "ENDW"),
    ("ENDIF", "ENDI"),
    ("COMMAND", "CMD"),
    ("DWELL", "DWE"),
    ("DELAY", "DLY"),
    ("RETURN", "RET"),
    ("SPLINE", "SPL"),
    ("DISABLE", "DIS"),
    ("ENABLE", "ENA"),
    ("WHILE", "WH"),
    ("GATHER", "GAT"),
    ("GOSUB", "GOS"),
    ("GOTO", "GOT"),
    ("HOME", "HM"),
)


class ProgramKind(Enum):
    """Kind of a program buffer, valued by its command word."""

    PLC = "PLC"
    PROG = "PROG"


@dataclass(frozen=True)
class Program:
    """A PLC or motion program.

    Parameters
    ----------
    kind : ProgramKind
        PLC or PROG.
    number : int
        Its number.
    lines : tuple of str
        Statements, without OPEN, CLEAR and CLOSE.
    """

    kind: ProgramKind
    number: int
    lines: tuple[str, ...]

    def __post_init__(self) -> None:
        limit = 31 if self.kind is ProgramKind.PLC else 32767
        low = 0 if self.kind is ProgramKind.PLC else 1
        if not low <= self.number <= limit:
            raise ConfigError(
                f"There is no {self.kind.value} {self.number}.",
                code="PC-PRG-001",
                hint="PLC programs are 0 to 31, motion programs 1 to 32767.",
            )
        if not self.lines:
            raise ConfigError("A program needs at least one line.", code="PC-PRG-002")

    @property
    def name(self) -> str:
        """As commands name it."""
        return f"{self.kind.value} {self.number}"

    @property
    def tokens(self) -> tuple[str, ...]:
        """Statements in one spelling."""
        return canonical(self.lines)

    @property
    def crc(self) -> int:
        """CRC-32 of the canonical statements."""
        return zlib.crc32("\n".join(self.tokens).encode("ascii"))

    def download_lines(self) -> list[str]:
        """Lines that replace the program on the card.

        CLOSE first: another buffer that was left open would take the text. CLOSE twice at the
        end: should one be lost, the buffer would swallow what is sent next.
        """
        return ["CLOSE", f"OPEN {self.name}", "CLEAR", *self.lines, "CLOSE", "CLOSE"]


def sealed_motion(number: int, lines: Sequence[str], *, motor: int) -> Program:
    """Motion program of a motor that moves nothing before its last line is there.

    The first statement jumps to the last, which jumps back to the body. Cut short and closed by
    hand the program stops at its start with run-time error 6, missing label (Turbo PMAC Software
    Reference Manual, code in Y:$2014 of coordinate system 1). The label of the last statement tells
    the motor: axes of one card share the numbers of their programs.
    """
    body, seal = 1, _SEAL_OF_MOTOR + motor
    text = (f"GOTO{seal}", f"N{body}", *lines, "RETURN", f"N{seal}", f"GOTO{body}")
    return Program(ProgramKind.PROG, number, text)


def motor_of_motion(lines: Sequence[str]) -> int | None:
    """Motor of a program of ``sealed_motion``, by how it begins; None for any other program.

    It is 0 where the seal is of an earlier version, which did not name the motor.
    """
    jump, *behind = canonical(lines)[:2] or ("",)
    if behind != ["N1"]:
        return None
    if jump == "GOT2":
        return 0
    found = _SEALED.match(jump)
    return int(found[1]) if found else None


@dataclass(frozen=True)
class Source:
    """A file of on-line commands and at most a few programs, in order.

    Parameters
    ----------
    commands : tuple of str
        On-line commands outside programs.
    programs : tuple of Program
        Programs.
    """

    commands: tuple[str, ...]
    programs: tuple[Program, ...]

    @property
    def program(self) -> Program:
        """The only program; raises ConfigError if there is none or several."""
        if len(self.programs) != 1:
            raise ConfigError(f"One program was expected, not {len(self.programs)}.")
        return self.programs[0]


def strip_comments(text: str) -> list[str]:
    """Lines without comments and blank lines; the card knows no comments."""
    stripped = (line.split(";", 1)[0].strip() for line in text.splitlines())
    return [line for line in stripped if line]


def parse_source(text: str) -> Source:
    """Commands and programs of a firmware file.

    Raises
    ------
    ConfigError
        A program without CLOSE.
    """
    commands: list[str] = []
    programs: list[Program] = []
    body: list[str] | None = None
    head = (ProgramKind.PLC, 0)
    for line in strip_comments(text):
        match = _OPEN.match(line)
        if match and body is None:
            kind = ProgramKind.PLC if match[1].upper() == "PLC" else ProgramKind.PROG
            head, body = (kind, int(match[2])), []
        elif body is None:
            commands.append(line)
        elif line.upper() == "CLOSE":
            programs.append(Program(*head, tuple(body)))
            body = None
        elif line.upper() != "CLEAR":
            body.append(line)
    if body is not None:
        raise ConfigError(
            f"{head[0].value} {head[1]} is not closed.",
            code="PC-PRG-003",
            hint="End the program in the file with CLOSE.",
        )
    return Source(tuple(commands), tuple(programs))


def render(text: str, *, motor: int = 1, scale_motor: int = 2, first_p: int = DEFAULT_FIRST) -> str:
    """A firmware file for other motors and another block of P-variables.

    Our files are written for motor 1, a scale read by motor 2, and P7000: P7000-P7199, I1xx,
    ``#1`` and the addresses of both motors' registers ($80-$FF, $100-$17F) are moved.
    """
    if not 0 <= first_p <= 8192 - BLOCK_SIZE or not 1 <= motor <= 32:
        raise ConfigError(
            f"No place for motor #{motor} and P{first_p}.",
            code="PC-PRG-004",
            hint=f"Motors are 1 to 32; p_block of the bench file needs {BLOCK_SIZE} P-variables.",
        )
    moved = []
    for line in text.splitlines():
        code, mark, comment = line.partition(";")
        code = _P_OF_BLOCK.sub(lambda m: _move_block(m, first_p), code)
        code = _MOTOR_I.sub(lambda m: f"I{motor}{m[1]}", code)
        code = re.sub(r"#1(?!\d)", f"#{motor}", code)
        code = _MOTOR_REGISTER.sub(lambda m: _move_register(m, (motor, scale_motor)), code)
        moved.append(code + mark + comment)
    return "\n".join(moved) + "\n"


def _move_block(found: re.Match[str], first_p: int) -> str:
    first, *last = (int(x) - DEFAULT_FIRST + first_p for x in found.groups() if x)
    return f"P{first}" + "".join(f"..{number}" for number in last)


def _move_register(found: re.Match[str], motors: tuple[int, int]) -> str:
    """Register of motor 1 or 2 as that of the motors that stand for them; others stay."""
    half, digits = found[1] or "", found[2] or found[3]
    base, offset = divmod(int(digits, 16), 0x80)
    if base not in {1, 2}:
        return found[0]
    address = 0x80 * motors[base - 1] + offset
    return f"${half}{address:03X}" if half else f"${address:X}"


def canonical(lines: Iterable[str]) -> tuple[str, ...]:
    """Statements in one spelling: upper case, no blanks, short words, plain numbers.

    Line breaks are ignored, because the card lists one statement per line and a source may hold
    several; the final RETURN that CLOSE adds is dropped.
    """
    joined = "\n".join(_spell(line) for line in lines)
    parts = [part for part in re.split(r"\n", joined) if part]
    while parts and parts[-1] == "RET":
        parts.pop()
    return tuple(parts)


@lru_cache(maxsize=4096)  # the statements of one program are compared again and again
def _spell(line: str) -> str:
    outside = re.split(r'("[^"]*")', line)
    text = "".join(
        part if part.startswith('"') else re.sub(r"\s+", "", part).upper() for part in outside
    )
    for long, short in _SPELLINGS:
        text = text.replace(long, short)
    text = re.sub(r"\$([0-9A-F]+)", lambda m: str(int(m[1], 16)), text)
    return _NUMBER.sub(lambda m: _plain(m[1]), text)


def _plain(text: str) -> str:
    value = float(text)
    return str(int(value)) if value == int(value) else f"{value:.10g}"


def download_s(lines: Sequence[str]) -> float:
    """Longest time in s that a download and its reading back may take, on a slow serial line."""
    return 2.0 * sum(len(line) + 1 for line in lines) / SLOWEST_CHARACTERS_PER_s


def download(link: Link, program: Program) -> None:
    """Replace a program and compare what the card lists.

    Raises
    ------
    CommandRefused
        A line was refused; the buffer is closed and the program is incomplete.
    VerifyMismatch
        The card lists something else.
    """
    try:
        link.write_buffer(program.download_lines())
    except CommandRefused as error:
        explain_protection(error)
        _close_quietly(link, error)
        raise
    verify(link, program)


def explain_protection(error: CommandRefused) -> bool:
    """Whether a password was the reason; then the error says what to do."""
    if error.context.get("error") != PROTECTED:
        return False
    error.hint = (
        "A password protects PLC 0 to 15 and PROG 1000 and above on this controller: unlock it "
        "with `pmac-comp terminal URL -c 'PASSWORD=...'` and try again."
    )
    return True


def _close_quietly(link: Link, error: CommandRefused) -> None:
    try:
        link.command("CLOSE")
    except CommandRefused as second:
        error.add_note(f"CLOSE was refused as well: {second.message}")


def listing(link: Link, kind: ProgramKind, number: int) -> list[str] | None:
    """Lines of a program as the card lists them, None if there is none (ERR003).

    Raises
    ------
    CommandRefused
        A password protects PLC 0-15 and PROG 1000 and above (ERR002, p. 384).
    """
    try:
        return link.query(f"LIST {kind.value} {number}")
    except CommandRefused as error:
        if error.context.get("error") == 3:
            return None
        explain_protection(error)
        raise


def verify(link: Link, program: Program) -> None:
    """Compare a program on the card with what was meant, token by token."""
    lines = listing(link, program.kind, program.number)
    found = canonical(lines or ())
    if _flat(found) == _flat(program.tokens):
        return
    place = first_difference(program.tokens, found)
    raise VerifyMismatch(
        f"{program.name} on the card differs from what was sent: {place}.",
        code="PC-PRG-010",
        hint="Download it again; somebody else may have written to it.",
    )


def is_present(link: Link, program: Program) -> bool:
    """Whether exactly this program is on the card."""
    lines = listing(link, program.kind, program.number)
    return lines is not None and _flat(canonical(lines)) == _flat(program.tokens)


def _flat(tokens: Sequence[str]) -> str:
    return "".join(tokens)


def first_difference(meant: Sequence[str], found: Sequence[str]) -> str:
    """Place at which two programs part, in words."""
    for k, (a, b) in enumerate(zip(meant, found, strict=False), start=1):
        if a != b:
            return f"line {k} is {b!r} instead of {a!r}"
    return f"{len(found)} lines instead of {len(meant)}"


def delete(link: Link, kind: ProgramKind, number: int) -> None:
    """Empty a program buffer."""
    link.write_buffer(["CLOSE", f"OPEN {kind.value} {number}", "CLEAR", "CLOSE", "CLOSE"])
