"""Variables, definitions and programs as one value: read, compared, put onto the card.

What lives here: a set of settings as the card prints them, and the commands that bring them there.
What may not: journal and verdict (``settings_upload``). A program without lines stands for an
empty buffer.
"""

import re
import zlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Final

from pmac_comp.base.errors import CommandRefused, ConfigError, RemoteProtocolError, VerifyMismatch
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.numbers import parse_integer
from pmac_comp.machine.controller.card.variables import Between, ask, quiet, same_value
from pmac_comp.machine.controller.contents import programs
from pmac_comp.machine.controller.contents.programs import Program, ProgramKind
from pmac_comp.machine.wire.numbers import read_number

PLC_TABLE: Final = 0x3100  # Y: bits 0-18 storage address, bit 22 disabled (p. 509)
PLC_DISABLED: Final = 1 << 22
PLC_STORED: Final = (1 << 19) - 1
PLCS: Final = 32
MOTORS: Final = 32
SYSTEMS: Final = 16
_ACTIVATION: Final = re.compile(r"^I([1-9]|[12]\d|3[0-2])00$")

Buffer = tuple[ProgramKind, int]
AxisDefinitions = tuple[tuple[int, int, str], ...]  # coordinate system, motor, text


@dataclass(frozen=True)
class Settings:
    """What stands or shall stand on a controller.

    Parameters
    ----------
    variables : Mapping of str to str
        I- and P-variables by name, in the order of writing.
    definitions : Mapping of int to str
        M-variable definitions.
    programs : Mapping of (ProgramKind, int) to tuple of str
        Statements of buffers; none for an empty one.
    axes : tuple of (int, int, str) or None
        All axis definitions (coordinate system, motor, text); None to leave them alone.
    running, stopped : frozenset of int
        PLCs among ``programs`` that are enabled, and that stand there disabled; of one in neither
        nothing is said.
    """

    variables: Mapping[str, str] = field(default_factory=dict)
    definitions: Mapping[int, str] = field(default_factory=dict)
    programs: Mapping[Buffer, tuple[str, ...]] = field(default_factory=dict)
    axes: AxisDefinitions | None = None
    running: frozenset[int] = frozenset()
    stopped: frozenset[int] = frozenset()

    @property
    def crc(self) -> int:
        """CRC-32 over everything, 0 for nothing at all."""
        lines = [f"{k}={_number_text(v)}" for k, v in self.variables.items()]
        lines += [f"M{k}->{_plain_definition(v)}" for k, v in self.definitions.items()]
        lines += [f"&{c}#{m}->{text}" for c, m, text in self.axes or ()]
        for (kind, number), body in self.programs.items():
            # A single program keeps the checksum of its own.
            if body and len(self.programs) > 1:
                lines.append(f"{kind.value}{number}")
            lines += programs.canonical(body)
        return zlib.crc32("\n".join(lines).encode()) if lines else 0

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing to read or write."""
        return not (self.variables or self.definitions or self.programs or self.axes is not None)

    def as_dict(self) -> dict[str, object]:
        """For a file."""
        return {
            "variables": dict(self.variables),
            "definitions": {str(k): v for k, v in self.definitions.items()},
            "programs": [[k.value, n, list(body)] for (k, n), body in self.programs.items()],
            "axes": None if self.axes is None else [list(a) for a in self.axes],
            "running": sorted(self.running),
            "stopped": sorted(self.stopped),
        }

    @classmethod
    def from_dict(cls, data: object) -> "Settings":
        """Settings of a file; raises ConfigError on anything unexpected."""
        try:
            item = dict(data)  # type: ignore[call-overload]
            axes = item["axes"]
            return cls(
                {str(k): str(v) for k, v in dict(item["variables"]).items()},
                {int(k): str(v) for k, v in dict(item["definitions"]).items()},
                {
                    (ProgramKind(k), int(n)): tuple(map(str, body))
                    for k, n, body in item["programs"]
                },
                None if axes is None else tuple((int(c), int(m), str(t)) for c, m, t in axes),
                frozenset(int(n) for n in item["running"]),
                frozenset(int(n) for n in item.get("stopped", ())),  # earlier files have none
            )
        except (KeyError, TypeError, ValueError) as error:
            raise ConfigError(
                f"Stored settings are not understood: {error}.",
                code="PC-SET-003",
                hint="The file is damaged or of another version; use another backup.",
            ) from error


def read_settings(link: Link, like: Settings, *, between: Between = quiet) -> Settings:
    """The same items as ``like`` has, as they stand; ``between`` is called between requests."""
    definitions = [f"M{n}->" for n in like.definitions]
    found = {kind_number: read_body(link, *kind_number) for kind_number in like.programs}
    plcs = {n for (kind, n), body in found.items() if kind is ProgramKind.PLC and body}
    running = frozenset(n for n in plcs if plc_runs(link, n))
    return Settings(
        dict(zip(like.variables, _ask(link, list(like.variables), between), strict=True)),
        dict(zip(like.definitions, _ask(link, definitions, between), strict=True)),
        found,
        None if like.axes is None else read_axes(link),
        running,
        frozenset(plcs - running),
    )


def _ask(link: Link, names: Sequence[str], between: Between) -> list[str]:
    words = "{} questions were answered with {} lines."
    return ask(link, names, between, code="PC-SET-001", words=words)


def read_body(link: Link, kind: ProgramKind, number: int) -> tuple[str, ...]:
    """Statements of a buffer as listed, none for an empty one; a RETURN within it stays."""
    lines = [line.strip() for line in programs.listing(link, kind, number) or []]
    while lines and lines[-1].upper() in {"RETURN", "RET"}:
        lines.pop()  # CLOSE adds it
    return tuple(lines)


def read_axes(link: Link, systems: Sequence[int] = range(1, SYSTEMS + 1)) -> AxisDefinitions:
    """Axis definitions of all motors in coordinate systems, active or not."""
    found: list[tuple[int, int, str]] = []
    for system in systems:
        lines = link.query(f"&{system}" + "".join(f"#{m}->" for m in range(1, MOTORS + 1)))
        if len(lines) != MOTORS:
            raise RemoteProtocolError(
                f"{MOTORS} axis definitions were asked for, {len(lines)} came.",
                code="PC-SET-004",
            )
        pairs = enumerate((line.strip() for line in lines), start=1)
        found += [(system, motor, text) for motor, text in pairs if text != "0"]
    return tuple(found)


def plc_runs(link: Link, number: int) -> bool:
    """Whether a PLC stands in memory and is enabled (I5 may still hold it)."""
    word = parse_integer(link.query(f"RY${PLC_TABLE + number:X}")[0]) & 0xFFFFFF
    return bool(word & PLC_STORED) and not word & PLC_DISABLED


# Comparing ----------------------------------------------------------------------------------------


def differences(meant: Settings, found: Settings) -> list[str]:
    """What of ``meant`` does not stand on the card, in words; the spelling does not matter."""
    out = [
        f"{name} is {found.variables.get(name)} instead of {text}"
        for name, text in meant.variables.items()
        if not _same_number(found.variables.get(name), text)
    ]
    out += [
        f"M{n} is {found.definitions.get(n)} instead of {text}"
        for n, text in meant.definitions.items()
        if _plain_definition(found.definitions.get(n, "")) != _plain_definition(text)
    ]
    for (kind, number), body in meant.programs.items():
        there = programs.canonical(found.programs.get((kind, number), ()))
        if "".join(there) != "".join(programs.canonical(body)):
            place = programs.first_difference(programs.canonical(body), there)
            out.append(f"{kind.value} {number}: {place}")
    if meant.axes is not None and plain_axes(meant.axes) != plain_axes(found.axes or ()):
        out.append("the axis definitions differ")
    out += [f"PLC {n} is not enabled" for n in sorted(meant.running - found.running)]
    out += [f"PLC {n} is enabled" for n in sorted(meant.stopped & found.running)]
    return out


def stands(left: Settings, found: Settings) -> bool:
    """Whether settings are as they were left; a program that was stopped or started is."""
    return not differences(replace(left, running=frozenset(), stopped=frozenset()), found)


def single_items(settings: Settings) -> Iterator[tuple[str, Settings]]:
    """Each item by itself; P-variables are state, those of a block the marks that it is known by.

    Axis definitions are one whole and no item.
    """
    for name, text in settings.variables.items():
        if not name.startswith("P"):
            yield name, Settings({name: text})
    for number, text in settings.definitions.items():
        yield f"M{number}", Settings(definitions={number: text})
    for key, body in settings.programs.items():
        plc = {key[1]} if key[0] is ProgramKind.PLC else set()
        running, stopped = settings.running & plc, settings.stopped & plc
        yield program_name(key), Settings(programs={key: body}, running=running, stopped=stopped)


def program_name(buffer: Buffer) -> str:
    """As commands have it: ``PLC 0``."""
    return f"{buffer[0].value} {buffer[1]}"


def without(settings: Settings, names: Collection[str]) -> Settings:
    """All but the items of these names (``single_items``)."""
    gone = {n for n in range(PLCS) if program_name((ProgramKind.PLC, n)) in names}
    return replace(
        settings,
        variables={k: v for k, v in settings.variables.items() if k not in names},
        definitions={n: v for n, v in settings.definitions.items() if f"M{n}" not in names},
        programs={k: v for k, v in settings.programs.items() if program_name(k) not in names},
        running=settings.running - gone,
        stopped=settings.stopped - gone,
    )


def set_by_others(old: Settings, new: Settings, found: Settings) -> list[str]:
    """Names of items of a finished change that somebody else has set since: a pure function.

    They stand neither as before nor as meant; the beginning of a program is one that was being
    written back.
    """
    befores = dict(single_items(old))
    return [
        name
        for name, left in single_items(new)
        if not any(stands(side, found) or _begun(side, found) for side in (left, befores[name]))
    ]


def _begun(meant: Settings, found: Settings) -> bool:
    return bool(meant.programs) and all(
        "".join(programs.canonical(body)).startswith(
            "".join(programs.canonical(found.programs[key]))
        )
        for key, body in meant.programs.items()
    )


def plain_axes(axes: AxisDefinitions) -> set[tuple[int, int, str]]:
    """Axis definitions in one spelling: ``1X`` and ``X`` are the same."""
    return {
        (system, motor, re.sub(r"(?<![\d.])1(?=[A-Z])", "", text.upper().replace(" ", "")))
        for system, motor, text in axes
    }


def same_definition(first: str, second: str) -> bool:
    """Whether two M-variable definitions mean the same, however they are spelled."""
    return _plain_definition(first) == _plain_definition(second)


def _same_number(found: str | None, meant: str) -> bool:
    return found is not None and same_value(float(read_number(found)), float(read_number(meant)))


def _number_text(text: str) -> str:
    return f"{float(read_number(text)):.9g}"


def _plain_definition(text: str) -> str:
    """Definition in one spelling: hexadecimal without leading zeros, defaults left out."""
    head, *rest = text.upper().replace(" ", "").split(",")
    space, _, address = head.partition(":")
    if address.startswith("$"):
        head = f"{space}:{int(address[1:], 16)}"
    # "X:$0,24" and "X:$0,0,24" both name the whole word, unsigned unless S is said.
    kept = [part for part in rest if part not in {"U", "0"}]
    return ",".join([head, *kept])


# Writing ------------------------------------------------------------------------------------------


def write_settings(
    link: Link,
    present: Settings,
    goal: Settings,
    *,
    skip_refused: bool = False,
    between: Between = quiet,
) -> tuple[str, ...]:
    """Bring the card from ``present`` to ``goal``; PLCs that change or stop are held first.

    Parameters
    ----------
    link : Link
        Conversation.
    present, goal : Settings
        As they stand, and as they shall be.
    skip_refused : bool
        Leave out variables and definitions that the card refuses (a backup of another firmware).
    between : callable
        Called between requests while no buffer is open, to renew a lease.

    Returns
    -------
    tuple of str
        Lines that were refused and left out.

    Raises
    ------
    CommandRefused, VerifyMismatch
        It stopped half-way.
    """
    changed = {
        key: body
        for key, body in goal.programs.items()
        if programs.canonical(body) != programs.canonical(present.programs.get(key, ()))
    }
    plcs = {number for kind, number in changed if kind is ProgramKind.PLC}
    plcs |= goal.stopped & present.running
    if goal.programs:
        # A buffer that an interrupted upload left open would swallow what follows.
        link.write_buffer(["CLOSE"])
    if plcs:
        link.write_buffer([f"DISABLE PLC {n}" for n in sorted(plcs)])
    if any(changed.values()):
        with suppress(CommandRefused):  # gathering runs: whether there is room will be seen
            link.command("DELETE GATHER")  # its buffer takes all free memory
    lines = setting_lines(present, goal)
    refused = _send(link, lines, between, skip_refused=skip_refused)
    for (kind, number), body in changed.items():
        between(programs.download_s(body))
        if body:
            programs.download(link, Program(kind, number, body))
        else:
            programs.delete(link, kind, number)
    wanted = [n for n in goal.running if (ProgramKind.PLC, n) in goal.programs]
    if wanted:
        link.write_buffer([f"ENABLE PLC {n}" for n in sorted(wanted)])
    return refused


def setting_lines(present: Settings, goal: Settings) -> list[str]:
    """Commands for variables, definitions and axes that differ."""
    lines = [
        f"M{n}->{text}"
        for n, text in goal.definitions.items()
        if present.definitions.get(n) != text
    ]
    for name, text in goal.variables.items():
        if present.variables.get(name) != text:
            off = _ACTIVATION.match(name) if text == "0" else None
            # A motor that is deactivated in closed loop would keep saying that it is closed.
            lines += [f"#{off[1]}K"] if off else []
            lines.append(f"{name}={text}")
    if goal.axes is not None and set(goal.axes) != set(present.axes or ()):
        lines += ["UNDEFINE ALL", *(f"&{c}#{m}->{text}" for c, m, text in goal.axes)]
    return lines


def _send(
    link: Link, lines: Sequence[str], between: Between, *, skip_refused: bool
) -> tuple[str, ...]:
    rest, refused = list(lines), []
    while rest:
        try:
            link.write_buffer(rest, progress=lambda _done, _total: between(0.0))
        except CommandRefused as error:
            if not skip_refused:
                raise
            # Setting a variable twice to the same value is harmless, unlike a table entry.
            rest = rest[int(str(error.context.get("lines_accepted", 0))) :]
            refused += _one_by_one(link, rest[:64])
            rest = rest[64:]
        else:
            break
    return tuple(refused)


def _one_by_one(link: Link, lines: Sequence[str]) -> list[str]:
    refused = []
    for line in lines:
        try:
            link.command(line)
        except CommandRefused:
            refused.append(line)
    return refused


def require_settings(link: Link, goal: Settings, *, between: Between = quiet) -> None:
    """Read everything back; raises VerifyMismatch naming what differs."""
    wrong = differences(goal, read_settings(link, goal, between=between))
    if wrong:
        raise VerifyMismatch(
            f"{len(wrong)} setting(s) do not stand as written: {'; '.join(wrong[:5])}.",
            code="PC-SET-002",
            hint="I41 may lock them, or another program writes them.",
        )
