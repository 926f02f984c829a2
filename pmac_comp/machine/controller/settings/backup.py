"""A backup of everything a bench needs, its comparison, and putting it back.

What lives here: reading the whole configuration as text the card printed, a sealed file of it,
differences, restoring in an order the card takes. SAVE is never part of it.
"""

import math
import re
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from pmac_comp.base.errors import (
    ConfigError,
    ControllerState,
    FlashSuspect,
    RemoteProtocolError,
)
from pmac_comp.base.progress import Steps
from pmac_comp.machine.controller.card.identity import read_identity
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.numbers import parse_integer
from pmac_comp.machine.controller.card.variables import VARIABLES
from pmac_comp.machine.controller.change.sealed_json import read_sealed_json, write_sealed_json
from pmac_comp.machine.controller.contents.programs import Program, ProgramKind
from pmac_comp.machine.controller.contents.settings import Buffer, plc_runs, read_axes, read_body
from pmac_comp.machine.controller.contents.table_set import TableSet, read_tables
from pmac_comp.machine.controller.tables.table_files import table_from_json, table_to_json
from pmac_comp.machine.controller.tables.table_status import FLASH_FAULTS
from pmac_comp.machine.wire.numbers import read_number

STEP: Final = 64
Q_WINDOW: Final = "&1Q"  # all of the pool; the windows of other systems begin within it
PROGRAM_TABLE: Final = 0x3000  # X: number, Y: storage address, 224 entries (p. 509)
N_PROGRAMS: Final = 224
_ASSIGNED: Final = re.compile(r"^(I\d+)=")
_DEFINITION: Final = re.compile(r"\*|[A-Z]{1,3}:[!-~]{1,40}")
_WANTED: Final = "Give a file that `pmac-comp backup --out` wrote."
SUSPECT_SHARE: Final = 0.2
SUSPECT_LEAST: Final = 5
# Communication modes belong to the conversation, I51 and I30 to the tables.
NOT_RESTORED: Final = frozenset({0, 1, 3, 4, 6, 9, 30, 51, 53, 54})
# User timers Isx11 and Isx12 run (p. 176): they are no configuration.
TIMERS: Final = frozenset(100 * s + k for s in range(51, 67) for k in (11, 12))


@dataclass(frozen=True)
class Backup:
    """Configuration of a controller as text.

    Parameters
    ----------
    identity : dict
        Who it was.
    ivariables, pvariables, qvariables : dict of int to str
        Values as printed; Q in the window of coordinate system 1, which begins with the pool.
    definitions : dict of int to str
        M-variable definitions.
    axes : tuple of (int, int, str)
        Coordinate system, motor, definition.
    programs : tuple of Program
        PLCs and motion programs.
    tables : TableSet
        Compensation tables.
    enabled : bool
        I51.
    running : frozenset of int
        PLCs that are enabled.
    """

    identity: dict[str, object]
    ivariables: dict[int, str]
    pvariables: dict[int, str]
    definitions: dict[int, str]
    axes: tuple[tuple[int, int, str], ...] = ()
    programs: tuple[Program, ...] = ()
    tables: TableSet = field(default_factory=TableSet)
    enabled: bool = False
    running: frozenset[int] = frozenset()
    qvariables: dict[int, str] = field(default_factory=dict)

    def as_dict(self) -> dict[str, object]:
        """For the file."""
        return {
            "kind": "backup",
            "identity": self.identity,
            "i": {str(k): v for k, v in self.ivariables.items()},
            "p": {str(k): v for k, v in self.pvariables.items()},
            "q": {str(k): v for k, v in self.qvariables.items()},
            "m": {str(k): v for k, v in self.definitions.items()},
            "axes": [list(a) for a in self.axes],
            "programs": [
                {"kind": p.kind.value, "number": p.number, "lines": list(p.lines)}
                for p in self.programs
            ],
            "tables": [table_to_json(t) for t in self.tables],
            "enabled": int(self.enabled),
            "running": sorted(self.running),
        }


@dataclass(frozen=True)
class Difference:
    """One item that differs."""

    item: str
    before: str
    after: str


def silent(step: str, done: int, total: int) -> None:
    """Tell nobody."""
    del step, done, total


def read_backup(
    link: Link,
    *,
    p_range: tuple[int, int] = (0, VARIABLES - 1),
    with_q: bool = True,
    progress: Steps = silent,
) -> Backup:
    """Read the whole configuration; nothing is changed.

    Parameters
    ----------
    link : Link
        Conversation.
    p_range : (int, int)
        First and last P-variable to keep.
    with_q : bool
        Whether Q-variables are read.
    progress : callable
        Told of each request: variables read, and variables in all.
    """
    identity = read_identity(link)
    whole = range(VARIABLES)
    wanted = {"I": whole, "P": range(p_range[0], p_range[1] + 1), "M": whole}
    if with_q:
        wanted[Q_WINDOW] = whole
    values = _read_variables(link, wanted, progress)
    i_values = values["I"]
    found = tuple(_read_programs(link))
    return Backup(
        identity=dict(identity.as_dict()),
        ivariables={n: v for n, v in i_values.items() if n not in TIMERS},
        pvariables=values["P"],
        qvariables=values.get(Q_WINDOW, {}),
        definitions=values["M"],
        axes=read_axes(link),
        programs=found,
        tables=read_tables(link),
        enabled=i_values.get(51) == "1",
        running=frozenset(
            p.number for p in found if p.kind is ProgramKind.PLC and plc_runs(link, p.number)
        ),
    )


def _read_variables(
    link: Link, wanted: Mapping[str, range], progress: Steps
) -> dict[str, dict[int, str]]:
    """Values by letter and number; of M-variables the definitions."""
    in_all, done = sum(map(len, wanted.values())), 0
    values: dict[str, dict[int, str]] = {letter: {} for letter in wanted}
    for letter, numbers in wanted.items():
        for start in range(numbers.start, numbers.stop, STEP):
            group = range(start, min(start + STEP, numbers.stop))
            values[letter].update(zip(group, _read_group(link, letter, group), strict=True))
            done += len(group)
            progress("reading variables", done, in_all)
    return values


def _read_group(link: Link, letter: str, group: range) -> list[str]:
    asked = f"{letter}{group.start}..{group.stop - 1}"
    lines = link.query(asked + ("->" if letter == "M" else ""))
    if len(lines) != len(group):
        raise RemoteProtocolError(f"{asked} answered {len(lines)} lines.")
    return [line.strip() for line in lines]


def stored_buffers(link: Link) -> Iterator[Buffer]:
    """PLCs, there or not, and motion programs by the card's own table of them."""
    words = [
        parse_integer(w)
        for line in link.query(f"RX${PROGRAM_TABLE:X},{N_PROGRAMS}")
        for w in line.split()
    ]
    numbers = sorted({w & 0xFFFF for w in words if w & 0xFFFF})
    yield from ((ProgramKind.PLC, number) for number in range(32))
    yield from ((ProgramKind.PROG, number) for number in numbers)


def _read_programs(link: Link) -> Iterator[Program]:
    for kind, number in stored_buffers(link):
        body = read_body(link, kind, number)
        if body:
            yield Program(kind, number, body)


def write_backup(path: Path, backup: Backup) -> None:
    """Store a backup, sealed with its SHA-256."""
    stamp = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    write_sealed_json(path, {**backup.as_dict(), "written_utc": stamp})


def load_backup(path: Path) -> Backup:
    """Read a backup file; raises ConfigError if it was changed or is none."""
    data = read_sealed_json(path)
    if data.get("kind") != "backup":
        raise ConfigError(f"{path} is no backup of a controller.", code="PC-BCK-001", hint=_WANTED)
    try:
        return _from_dict(data)
    except (KeyError, TypeError, ValueError) as error:
        raise ConfigError(
            f"{path} is not understood: {error}.", code="PC-BCK-002", hint=_WANTED
        ) from error


def _is_number(text: str) -> bool:
    """Whether a card can have printed it, so that nothing else is ever sent as a value."""
    try:
        return math.isfinite(read_number(text))
    except RemoteProtocolError:
        return False


def _is_definition(text: str) -> bool:
    return bool(_DEFINITION.fullmatch(text))


def _from_dict(data: Mapping[str, object]) -> Backup:
    def numbered(name: str, is_one: Callable[[str], bool] = _is_number) -> dict[int, str]:
        found = {int(k): str(v) for k, v in dict(data[name]).items()}  # type: ignore[call-overload]
        wrong = [
            f"{name}{k} = {v!r}" for k, v in found.items() if not (0 <= k < VARIABLES and is_one(v))
        ]
        if wrong:
            raise ValueError(f"there cannot be {wrong[0]}")
        return found

    axes = [(int(c), int(m), str(t)) for c, m, t in data["axes"]]  # type: ignore[attr-defined]
    found = [
        Program(ProgramKind(p["kind"]), int(p["number"]), tuple(map(str, p["lines"])))
        for p in data["programs"]  # type: ignore[attr-defined]
    ]
    tables = [table_from_json(t) for t in data["tables"]]  # type: ignore[attr-defined]
    return Backup(
        identity=dict(data["identity"]),  # type: ignore[call-overload]
        ivariables=numbered("i"),
        pvariables=numbered("p"),
        # Backups of earlier versions have none.
        qvariables=numbered("q") if "q" in data else {},
        definitions=numbered("m", _is_definition),
        axes=tuple(axes),
        programs=tuple(found),
        tables=TableSet(tuple(tables)),
        enabled=bool(data["enabled"]),
        running=frozenset(int(n) for n in data.get("running", [])),  # type: ignore[attr-defined]
    )


def compare(before: Backup, after: Backup, *, with_p: bool = False) -> tuple[Difference, ...]:
    """What differs between two backups; P and Q live and are compared only on request.

    So does what a program writes that runs in both: the torque of a law (Ixx29).
    """
    live = live_variables(before) & live_variables(after)
    found = [
        d for d in _differences("I", before.ivariables, after.ivariables) if d.item not in live
    ]
    found += _differences("M", before.definitions, after.definitions, suffix="->")
    if with_p:
        found += _differences("P", before.pvariables, after.pvariables)
        if before.qvariables and after.qvariables:
            found += _differences(Q_WINDOW, before.qvariables, after.qvariables)
    found += _differences("", _axes(before), _axes(after))
    found += _differences("", _programs(before), _programs(after))
    for table in {*before.tables, *after.tables}:
        texts = [s.get(table.kind, table.motor) for s in (before.tables, after.tables)]
        a, b = ("" if t is None else t.canonical for t in texts)
        if a != b:
            found.append(Difference(f"{table.kind.value} #{table.motor}", a[:80], b[:80]))
    return tuple(dict.fromkeys(found))


def live_variables(backup: Backup) -> frozenset[str]:
    """Names of the I-variables that running PLCs of a backup write: outputs, no settings."""
    return frozenset(
        name
        for program in backup.programs
        if program.kind is ProgramKind.PLC and _runs(backup, program.number)
        for line in program.lines
        for name in _ASSIGNED.findall(line)
    )


def _runs(backup: Backup, plc: int) -> bool:
    """Whether a PLC is enabled, and let go by I5: bit 0 for PLC 0, bit 1 for the others (p. 39)."""
    i5 = int(read_number(backup.ivariables.get(5, "0")))
    return plc in backup.running and bool(i5 >> (plc > 0) & 1)


def _differences(
    letter: str, before: Mapping[Any, str], after: Mapping[Any, str], suffix: str = ""
) -> Iterator[Difference]:
    for key in {**before, **after}:
        a, b = before.get(key, ""), after.get(key, "")
        if a != b:
            yield Difference(f"{letter}{key}{suffix}", a, b)


def _axes(backup: Backup) -> dict[str, str]:
    return {f"&{c}#{m}->": text for c, m, text in backup.axes}


def _programs(backup: Backup) -> dict[str, str]:
    found = {p.name: "\n".join(p.tokens) for p in backup.programs}
    return found | {f"PLC {n} enabled": "yes" for n in backup.running}


# After a reset -----------------------------------------------------------------------------------


def check_flash(link: Link, backup: Backup) -> None:
    """Recognise a card that came up with other values than those of a backup.

    Raises
    ------
    FlashSuspect
        The card reports a flash or checksum error, or too many I-variables differ: a power cut
        during SAVE reverts it to factory values (p. 394).
    """
    check_flash_status(link)
    check_flash_values(link, backup)


def check_flash_status(link: Link) -> None:
    """The same by what the card reports of itself alone; raises FlashSuspect."""
    status = int(link.query("???")[0].strip()[:6], 16)
    if status & FLASH_FAULTS:
        raise _suspect("It reports a flash error.", [])


def check_flash_values(link: Link, backup: Backup) -> None:
    """The same by the motor variables alone; raises FlashSuspect."""
    active = [m for m in range(1, 33) if backup.ivariables.get(100 * m) == "1"]
    found: dict[int, str] = {}
    for motor in active:
        first = 100 * motor + 2
        lines = link.query(f"I{first}..{first + 67}")
        found.update(zip(range(first, first + 68), (x.strip() for x in lines), strict=True))
    wrong = [n for n, value in found.items() if backup.ivariables.get(n) != value]
    if len(wrong) > max(SUSPECT_LEAST, SUSPECT_SHARE * len(found)):
        raise _suspect(f"{len(wrong)} of {len(found)} motor variables differ.", wrong)


def _suspect(why: str, wrong: list[int]) -> FlashSuspect:
    return FlashSuspect(
        f"The controller came up with something else than its saved configuration. {why}",
        code="PC-BCK-005",
        hint="`pmac-comp restore` brings the backup back; check the axis before moving it.",
        context={"differ": [f"I{n}" for n in wrong[:20]]},
        left=ControllerState.DISABLED,
    )
