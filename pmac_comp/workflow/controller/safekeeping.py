"""Backup and restore of a whole controller, and the download of program files."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from pmac_comp.base.errors import ConfigError, ControllerState, PmacCompError, VerifyMismatch
from pmac_comp.base.progress import Progress, Steps
from pmac_comp.base.reading import why
from pmac_comp.files.bench import load_bench
from pmac_comp.files.resources import DEFAULT_JOURNAL
from pmac_comp.machine.controller.card.variables import read_one
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.verdict import mark_left
from pmac_comp.machine.controller.contents import programs
from pmac_comp.machine.controller.contents.law_bank import LawBlock
from pmac_comp.machine.controller.contents.settings import Settings, differences, read_settings
from pmac_comp.machine.controller.settings import backup as kept
from pmac_comp.machine.controller.settings.settings_upload import change_settings
from pmac_comp.machine.controller.whole.grouping import grouped
from pmac_comp.machine.controller.whole.restore import restore
from pmac_comp.workflow.capture.at_work import at_work, require_free_block
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.capture.session import open_axis

_SHOWN = 40
_NAMED = 8
_BACKGROUND_PLCS = 2  # bit of I5 (Software Reference Manual, I5)
_LINE_SHOWN = 60
_DEFINITION: Final = re.compile(r"M(\d+)\s*->\s*(\S.*)", re.I)
_OPENS_SERVO: Final = re.compile(r"^\s*OPEN\s*SERVO\b", re.I | re.M)
_VALUE: Final = re.compile(r"([IP]\d+)\s*=\s*(\$[0-9A-F]+|[-+]?[\d.]+)", re.I)


def backup_to_file(
    url: str, bench: str, out: Path, *, progress: Progress | None = None
) -> dict[str, Any]:
    """Read everything twice, compare, and store it sealed.

    Raises
    ------
    VerifyMismatch
        The two readings differ: somebody writes to the controller.
    """
    with open_axis(url, bench) as axis:
        first = kept.read_backup(axis.link, progress=_steps(progress, ", 1 of 2"))
        second = kept.read_backup(axis.link, progress=_steps(progress, ", 2 of 2"))
    moving = kept.compare(first, second)
    if moving:
        raise VerifyMismatch(
            f"{len(moving)} item(s) changed between two readings, first {moving[0].item}.",
            code="PC-BCK-010",
            hint="Stop other clients and programs that write, then back up again.",
        )
    kept.write_backup(out, first)
    stored = kept.load_backup(out)
    return {
        "file": out,
        "summary": f"{len(stored.ivariables)} I, {len(stored.pvariables)} P, "
        f"{len(stored.qvariables)} Q, "
        f"{len(stored.definitions)} M, {len(stored.programs)} programs, "
        f"{len(stored.tables)} tables",
        "identity": stored.identity,
    }


def plan_restore(url: str, bench: str, source: Path) -> dict[str, Any]:
    """What a restore would change, or the lines a program file would send."""
    if source.suffix != ".json":
        goal, others = _settings_of(programs.parse_source(_program_text(bench, source)))
        with open_axis(url, bench) as axis:
            require_free_block(axis, url)
            stands = read_settings(axis.link, goal)
        lines = [*others, *(f"would change: {text}" for text in differences(goal, stands))]
        lines += [line for body in goal.programs.values() for line in body]
        return {"summary": f"{len(lines)} lines of {source.name}", "lines": lines}
    stored = kept.load_backup(source)
    with open_axis(url, bench) as axis:
        require_free_block(axis, url)
        present = kept.read_backup(axis.link)
    live = kept.live_variables(stored)
    differing = [d for d in kept.compare(present, stored) if d.item not in live]
    lines = [f"{d.item}: {_short(d.before)} -> {_short(d.after)}" for d in differing[:_SHOWN]]
    if len(differing) > _SHOWN:
        lines.append(f"... and {len(differing) - _SHOWN} more")
    return {"summary": f"{len(differing)} items differ", "lines": lines}


def restore_from_file(
    url: str,
    bench: str,
    source: Path,
    *,
    journal: Path = DEFAULT_JOURNAL,
    other_card: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Bring a backup back, or download a program file and compare what the card lists."""
    if source.suffix != ".json":
        goal, others = _settings_of(programs.parse_source(_program_text(bench, source)))
        with open_axis(url, bench) as axis:
            context = context_of(axis, journal, progress)
            with at_work(axis, url):
                _load(axis, context, source.name, goal, others)
            held = _held_programs(axis, goal)
        counts = {
            "variables": len(goal.variables),
            "definitions": len(goal.definitions),
            "programs": len(goal.programs),
        }
        written = [f"{n} {name[:-1] if n == 1 else name}" for name, n in counts.items()]
        return {
            **counts,
            "commands": list(others),
            "verdict": ControllerState.NEW.value,
            "summary": f"{source.name}: {written[0]}, {written[1]} and {written[2]} written and "
            "read back"
            + (f", {len(others)} commands sent that no rollback undoes" if others else "")
            + held,
        }
    stored = kept.load_backup(source)
    with open_axis(url, bench) as axis:
        context = context_of(axis, journal, progress)
        with at_work(axis, url):
            result, left = restore(
                axis.link, context, stored, other_card=other_card, progress=_steps(progress)
            )
    return {
        **result.as_dict(),
        "remaining": [f"{d.item}: {d.before} -> {d.after}" for d in left],
        "summary": _restored_text([d.item for d in left]),
    }


def _load(axis: Axis, context: Context, name: str, goal: Settings, others: list[str]) -> None:
    """Send a program file as one change; commands that no rollback undoes are owned up to."""
    sent = False
    try:
        with grouped(axis.link, context, name) as inner:
            sent = bool(others)
            axis.link.write_buffer(["CLOSE", *others])
            if not goal.is_empty:
                change_settings(axis.link, inner, goal, route="program")
    except PmacCompError as error:
        if sent:
            mark_left(error, ControllerState.DISABLED, confirmed=False)
            error.add_note(
                "Commands of the file may have acted that no rollback undoes: "
                + ", ".join(others[:_NAMED])
            )
        raise


def _restored_text(left: Sequence[str]) -> str:
    if not left:
        return "restored, and read again: nothing differs"
    more = f" and {len(left) - _NAMED} more" if len(left) > _NAMED else ""
    return (
        f"restored; {len(left)} item(s) cannot be set or live on the card: "
        f"{', '.join(left[:_NAMED])}{more}"
    )


def _held_programs(axis: Axis, goal: Settings) -> str:
    """That I5 holds the background PLCs of a file: ENABLE is taken then, and nothing happens."""
    background = [n for kind, n in goal.programs if kind is programs.ProgramKind.PLC and n > 0]
    i5 = int(read_one(axis.link, "I5"))
    if not background or i5 & _BACKGROUND_PLCS:
        return ""
    return (
        f"; I5 = {i5} holds background PLCs, ENABLE PLC {background[0]} starts nothing: state "
        f"I5 = {i5 | _BACKGROUND_PLCS} in the bench file and run "
        "`pmac-comp setup URL --bench FILE`"
    )


def _settings_of(parsed: programs.Source) -> tuple[Settings, list[str]]:
    """What a program file sets and can be taken back, and its other commands."""
    definitions: dict[int, str] = {}
    variables: dict[str, str] = {}
    others: list[str] = []
    for line in parsed.commands:
        if found := _DEFINITION.fullmatch(line):
            definitions[int(found[1])] = found[2]
        elif found := _VALUE.fullmatch(line):
            variables[found[1].upper()] = found[2]
        elif line.upper() != "CLOSE":
            others.append(line)
    bodies = {(p.kind, p.number): p.lines for p in parsed.programs}
    return Settings(variables, definitions, bodies), others


def _program_text(bench: str, source: Path) -> str:
    loaded = load_bench(bench)
    block = LawBlock.from_p_block(loaded.controller.p_block)
    try:
        text = source.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"The program file {source} cannot be read: {why(error)}.",
            code="PC-BCK-011",
            hint="Give a backup (.json) or a program file as text. Nothing was changed.",
        ) from error
    if not text.strip():
        raise ConfigError(
            f"The program file {source} is empty.",
            code="PC-BCK-012",
            hint="Give a backup (.json) or a program file as text. Nothing was changed.",
        )
    if _OPENS_SERVO.search(text):
        raise ConfigError(
            f"{source} is the source of an open servo: a controller takes it compiled only.",
            code="PC-BCK-013",
            hint="`pmac-comp config servo BENCH` prints it for your p_block; compile that with the "
            "vendor's tool, or rehearse with `pmac-comp sim --servo`. Nothing was changed.",
        )
    motor = loaded.encoder.motor_number
    scale_motor = loaded.scale.motor_number if loaded.scale else motor
    return programs.render(text, motor=motor, scale_motor=scale_motor, first_p=block.first)


def _short(value: object) -> str:
    """One line of at most 60 characters: a whole program would bury what differs."""
    first, *rest = str(value).splitlines() or [""]
    return (first[:_LINE_SHOWN] + f" ... ({len(rest)} more lines)") if rest else first or "nothing"


def _steps(progress: Progress | None, time: str = "") -> Steps:
    def told(step: str, done: int, total: int) -> None:
        if progress is not None:
            progress(step + time, done / max(total, 1))

    return told
