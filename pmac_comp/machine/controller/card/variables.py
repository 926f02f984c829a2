"""Variables of the controller: a typed map, and reading and writing many with verification.

Ranges and units: Software Reference Manual p. 35-191 (I-variables), p. 243 (counts). Imports
``base`` and this layer.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from pmac_comp.base.errors import ConfigError, RemoteProtocolError, VerifyMismatch
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.numbers import nine_digits, plain
from pmac_comp.machine.wire.numbers import read_number

VARIABLES: Final = 8192  # of each kind: I, P, Q, M
LINE_LIMIT: Final = 200  # characters; a command line of more than about 255 is unsafe


@dataclass(frozen=True)
class IVariable:
    """What is known of an I-variable."""

    number: int
    name: str
    unit: str = ""
    lower: float | None = None
    upper: float | None = None
    read_only: bool = False
    is_address: bool = False


_GLOBAL: Final = (
    IVariable(3, "handshake mode", "", 0, 3),
    IVariable(4, "checksum mode", "", 0, 3),
    IVariable(5, "PLC enable", "", 0, 3),
    IVariable(6, "error reporting", "", 0, 3),
    IVariable(8, "real-time interrupt period", "SC", 0, 255),
    IVariable(9, "listing form", "", 0, 3),
    IVariable(10, "servo interrupt time", "2^-23 ms", 0, 8388607),
    IVariable(13, "foreground in-position", "", 0, 1),
    IVariable(15, "trigonometric unit", "", 0, 1),
    *(IVariable(n, f"MACRO IC {n - 20} base", "", is_address=True) for n in range(20, 24)),
    IVariable(24, "DPRAM base", "", is_address=True),
    IVariable(30, "table wrap while loading", "", 0, 1),
    IVariable(36, "abort leaves killed motors", "", 0, 1),
    IVariable(41, "I-variable lock mask", "", 0, 15),
    IVariable(42, "PVT and spline time", "", 0, 1),
    IVariable(51, "compensation tables", "", 0, 1),
    IVariable(52, "CPU frequency", "10 MHz less 1", 0, 31),
    IVariable(68, "active coordinate systems", "", 0, 15),
    IVariable(4904, "status", "", read_only=True),
    IVariable(4908, "end of unreserved memory", "", read_only=True, is_address=True),
    IVariable(5000, "gather mode", "", 0, 3),
    *(IVariable(n, f"gather source {n - 5000}", "", is_address=True) for n in range(5001, 5049)),
    IVariable(5049, "gather period", "SC", 0, 8388607),
    IVariable(5050, "gather mask 1", "", 0, 0xFFFFFF, is_address=True),
    IVariable(5051, "gather mask 2", "", 0, 0xFFFFFF, is_address=True),
)
# The columns are those of IVariable, with Ixx numbers.
_MOTOR: Final = (
    (0, "activation", "", 0, 1, False),
    (1, "commutation", "", 0, 3, False),
    (2, "output address", "", None, None, True),
    (3, "position feedback address", "", None, None, True),
    (4, "velocity feedback address", "", None, None, True),
    (5, "master address", "", None, None, True),
    (6, "following mode", "", 0, 3, False),
    (7, "master scale factor", "", -8388608, 8388607, False),
    (8, "position scale factor", "", 0, 8388607, False),
    (9, "velocity scale factor", "", 0, 8388607, False),
    (11, "fatal following error", "1/16 ct", 0, 8388607, False),
    (12, "warning following error", "1/16 ct", 0, 8388607, False),
    (13, "positive software limit", "ct", None, None, False),
    (14, "negative software limit", "ct", None, None, False),
    (15, "abort deceleration", "ct/ms^2", 0, None, False),
    (16, "program velocity", "ct/ms", 0, None, False),
    (17, "program acceleration", "ct/ms^2", 0, None, False),
    (19, "jog acceleration", "ct/ms^2", 0, None, False),
    (20, "jog acceleration time", "ms", 0, 8388607, False),
    (21, "jog S-curve time", "ms", 0, 8388607, False),
    (22, "jog speed", "ct/ms", 0, None, False),
    (23, "homing speed", "ct/ms", None, None, False),
    (24, "flag mode", "", 0, 0xFFFFFF, True),
    (25, "flag address", "", None, None, True),
    (26, "home offset", "1/16 ct", -8388608, 8388607, False),
    (28, "in-position band", "1/16 ct", 0, 8388607, False),
    (29, "output offset", "DAC", -32768, 32767, False),
    (30, "proportional gain", "", -8388608, 8388607, False),
    (31, "derivative gain", "", -8388608, 8388607, False),
    (32, "velocity feedforward", "", -8388608, 8388607, False),
    (33, "integral gain", "", 0, 8388607, False),
    (34, "integration mode", "", 0, 1, False),
    (35, "acceleration feedforward", "", -8388608, 8388607, False),
    (36, "notch N1", "", -2, 2, False),
    (37, "notch N2", "", -2, 2, False),
    (38, "notch D1", "", -2, 2, False),
    (39, "notch D2", "", -2, 2, False),
    (40, "desired position filter", "", 0, 0.999999, False),
    (59, "user-written servo", "", 0, 3, False),
    (60, "servo cycle extension", "", 0, 255, False),
    (63, "integration limit", "", -8388608, 8388607, False),
    (64, "deadband gain", "", -32768, 32767, False),
    (65, "deadband size", "1/16 ct", -32768, 32767, False),
    (67, "position error limit", "1/16 ct", 0, 8388607, False),
    (68, "friction feedforward", "DAC", 0, 32767, False),
    (69, "output limit", "DAC", 0, 32767, False),
    (85, "backlash take-up rate", "1/16 ct per background cycle", 0, 8388607, False),
    (86, "backlash size", "1/16 ct", -8388608, 8388607, False),
    (87, "backlash hysteresis", "1/16 ct", 0, 8388607, False),
    (88, "in-position scans", "", 0, 255, False),
    (92, "jog calculation time", "ms", 1, 8388607, False),
    (96, "command output mode", "", 0, 3, False),
    (97, "trigger mode", "", 0, 3, False),
)


def _build() -> dict[int, IVariable]:
    table = {item.number: item for item in _GLOBAL}
    for motor in range(1, 33):
        for number, name, unit, lower, upper, address in _MOTOR:
            full = 100 * motor + number
            table[full] = IVariable(
                full, f"motor {motor} {name}", unit, lower, upper, is_address=address
            )
    return table


I_VARIABLES: Final[Mapping[int, IVariable]] = _build()


def describe(number: int) -> IVariable:
    """What is known of I``number``; variables outside our map have no range."""
    if not 0 <= number <= 8191:
        raise ConfigError(f"There is no I{number}; I-variables are I0 to I8191.", code="PC-VAR-004")
    return I_VARIABLES.get(number, IVariable(number, f"I{number}"))


def check_value(name: str, value: float) -> None:
    """Refuse a value outside the range of an I-variable: the card would wrap it silently.

    Raises
    ------
    ConfigError
        Range exceeded or variable read-only.
    """
    if not (name.startswith("I") and name[1:].isdigit()):
        return
    item = describe(int(name[1:]))
    low = item.lower is not None and value < item.lower
    high = item.upper is not None and value > item.upper
    if item.read_only or low or high:
        raise ConfigError(
            f"{name} ({item.name}) cannot be set to {value}: "
            + ("it is read-only" if item.read_only else f"range {item.lower} to {item.upper}"),
            code="PC-VAR-001",
            hint="The card would take the value modulo its range without an error.",
        )


Between = Callable[[float], None]
"""Called before each request of many with the seconds until it can be called again."""


def quiet(ahead_s: float) -> None:
    """Nothing to be done between two requests."""
    del ahead_s


def ask(
    link: Link,
    names: Sequence[str],
    between: Between = quiet,
    *,
    code: str = "PC-VAR-002",
    words: str = "{} variables were asked for, {} values came back.",
) -> list[str]:
    """One line for each name, several names per question.

    Parameters
    ----------
    link : Link
        Conversation.
    names : sequence of str
        Questions that are answered with one line each.
    between : callable
        Called before each request.
    code, words : str
        Of the error; ``words`` takes the numbers asked for and answered.

    Raises
    ------
    RemoteProtocolError
        Number of answers differs from the number of questions.
    """
    found: list[str] = []
    for group in batches(names):
        between(0.0)
        lines = link.query(" ".join(group))
        if len(lines) != len(group):
            raise RemoteProtocolError(
                words.format(len(group), len(lines)),
                code=code,
                context={"asked": list(group), "answer": lines[:8]},
            )
        found += [line.strip() for line in lines]
    return found


def answers(link: Link, text: str, n: int) -> list[str]:
    """Lines that answer a question; raises RemoteProtocolError if they are not ``n``."""
    lines = link.query(text)
    if len(lines) != n:
        raise RemoteProtocolError(f"'{text}' was answered with {len(lines)} lines, not {n}.")
    return lines


def read_many(link: Link, names: Sequence[str]) -> dict[str, float]:
    """Values of variables such as ``I130`` or ``P7001``, several per question."""
    return dict(zip(names, map(read_number, ask(link, names)), strict=True))


def read_one(link: Link, name: str) -> float:
    """Value of one variable."""
    return read_many(link, [name])[name]


def read_range(link: Link, letter: str, first: int, last: int) -> list[float]:
    """Values of consecutive variables, e.g. P7010 to P7039, as one question."""
    lines = link.query(f"{letter}{first}..{last}")
    if len(lines) != last - first + 1:
        raise RemoteProtocolError(
            f"{letter}{first}..{last} returned {len(lines)} values.", code="PC-VAR-003"
        )
    return [read_number(line) for line in lines]


def write_many(link: Link, values: Mapping[str, float], *, verify: bool = True) -> None:
    """Set variables in packets and read them back.

    Raises
    ------
    ConfigError
        A value outside the range of its I-variable; nothing was written.
    VerifyMismatch
        A variable does not hold what was written.
    """
    for name, value in values.items():
        check_value(name, value)
    link.write_buffer([f"{name}={plain(value)}" for name, value in values.items()])
    if verify:
        verify_many(link, values)


def verify_many(link: Link, values: Mapping[str, float]) -> None:
    """Read variables back and compare in nine digits; raises VerifyMismatch naming each."""
    found = read_many(link, list(values))
    wrong = [name for name, value in values.items() if not same_value(found[name], value)]
    if wrong:
        text = ", ".join(f"{n} is {found[n]}, {values[n]} was written" for n in wrong[:5])
        raise VerifyMismatch(
            f"{len(wrong)} variable(s) do not hold what was written: {text}.",
            code="PC-VAR-010",
            hint="I41 may lock them, or another program writes them.",
            context={"variables": wrong},
        )


def same_value(found: float, meant: float) -> bool:
    """Whether two values agree in nine digits (24-bit fractions agree in seven)."""
    if nine_digits(found) == nine_digits(meant):
        return True
    return abs(found - meant) <= max(abs(meant) * 1e-8, 3e-7 if abs(meant) < 2 else 0.0)


def batches(items: Iterable[str], limit: int = LINE_LIMIT) -> Iterator[list[str]]:
    """Items in groups that fit one command line, or another limit in characters."""
    group: list[str] = []
    length = 0
    for item in items:
        if group and length + len(item) + 1 > limit:
            yield group
            group, length = [], 0
        group.append(item)
        length += len(item) + 1
    if group:
        yield group
