"""Variables, definitions and programs as a transaction: what stood before, or what was meant.

While it is written the PLCs concerned are held and a motion program cannot start, because its
buffer is open or was found quiet. A failure with the link alive is taken back at once; after a
lost link ``recover`` reads every item and decides by comparing it with both sides.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, Self

from pmac_comp.base.errors import (
    CommandRefused,
    ControllerState,
    MotorNotSafe,
    SafetyRefusal,
    VerifyMismatch,
)
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.numbers import plain
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.journals import ROLLED_BACK, TEMPORARY, ChangeKind
from pmac_comp.machine.controller.change.lease import parse_lease, read_clock, refuse_foreign_lease
from pmac_comp.machine.controller.change.sealed_json import read_sealed_json, write_sealed_json
from pmac_comp.machine.controller.change.transaction import Change, UploadResult
from pmac_comp.machine.controller.contents import programs
from pmac_comp.machine.controller.contents.law_bank import Index
from pmac_comp.machine.controller.contents.programs import ProgramKind
from pmac_comp.machine.controller.contents.safety import raise_all
from pmac_comp.machine.controller.contents.settings import (
    SYSTEMS,
    Settings,
    differences,
    read_settings,
    require_settings,
    write_settings,
)
from pmac_comp.machine.controller.tables.upload_checks import motion_refusals

RUNNING_PROGRAM: Final = 1 << 0  # first word of ??, bit 0 (p. 287)


class SettingsUpload:
    """One change of settings: ``write`` does it, leaving the ``with`` closes it.

    Parameters
    ----------
    link, context
        Conversation, folder, block.
    goal : Settings
        What shall stand; the same items are backed up.
    route : str
        For the result.
    motors : sequence of int
        Motors that must stand still.
    refusals : sequence of SafetyRefusal
        What the caller found that forbids it, reported with the rest.
    skip_refused : bool
        Leave out what the card refuses, and do not insist on reading it back.
    temporary : bool
        The journal stays open until ``temporary.take_off``; ends with ``leave_open``.
    """

    def __init__(
        self,
        link: Link,
        context: Context,
        goal: Settings,
        *,
        route: str = "settings",
        motors: Sequence[int] = (),
        refusals: Sequence[SafetyRefusal] = (),
        skip_refused: bool = False,
        temporary: bool = False,
    ) -> None:
        self.link = link
        self.context = context
        self.goal = goal
        self.route = route
        self.refused: tuple[str, ...] = ()
        self.old = Settings()
        self._motors = tuple(motors)
        self._refusals = tuple(refusals)
        self._skip_refused = skip_refused
        self._temporary = temporary
        self._change = Change(link, context, ChangeKind.SETTINGS)
        self._backup: Path | None = None

    def __enter__(self) -> Self:
        self._change.__enter__()
        return self

    def __exit__(self, *failure: object) -> None:
        self._change.__exit__(*failure)

    def write(self, first: Callable[[], object] | None = None) -> None:
        """Look, back up, write, read back.

        Parameters
        ----------
        first : callable, optional
            What has to happen on the controller before the settings change.

        Raises
        ------
        SafetyRefusal
            All refusals together; nothing was changed.
        CommandRefused, VerifyMismatch
            It was taken back; ``left`` says whether that succeeded.
        """
        change = self._change
        with change.explained():
            self.old = read_settings(self.link, self.goal)
            raise_all(self._look(), "The change")
            change.begin({"route": self.route})
            self._backup = change.backup_path("settings")
            write_settings_backup(self._backup, self.old)
            change.step(
                "intent",
                {
                    "backup": self._backup.name,
                    "new": self.goal.as_dict(),
                    "skip_refused": int(self._skip_refused),
                    TEMPORARY: int(self._temporary),
                },
            )
            change.settle = self._take_back
            change.left = ControllerState.DISABLED
            present = self.old
            if first is not None:
                first()
                present = read_settings(self.link, self.goal, between=change.keep_lease)
            self._write(present)

    def _look(self) -> list[SafetyRefusal]:
        found = [*self._refusals, *lease_refusals(self.link, self.context)]
        if any(kind is ProgramKind.PROG for kind, _ in self.goal.programs):
            found += running_refusals(self.link)
        if self._motors:
            found += motion_refusals(self.link, self._motors)
        return found

    def _write(self, present: Settings) -> None:
        self.context.progress("write", 0, 2)
        keep = self._change.keep_lease
        self.refused = write_settings(
            self.link, present, self.goal, skip_refused=self._skip_refused, between=keep
        )
        self.context.progress("write", 1, 2)
        if not self._skip_refused:
            require_settings(self.link, self.goal, between=keep)
        self.context.progress("write", 2, 2)

    def check(self, proof: Callable[[], None]) -> None:
        """Let the caller prove that what was written works; a failure takes it back."""
        with self._change.explained():
            proof()

    def finish(self) -> UploadResult:
        """Close the change as done."""
        with self._change.explained():
            self._change.finish(ControllerState.NEW)
        return UploadResult(
            ControllerState.NEW,
            self.route,
            self.old.crc,
            self.goal.crc,
            0.0,
            self._backup,
            self._change.journal.path,
        )

    def leave_open(self) -> None:
        """Give the lease back and leave the journal open, for settings that stand for a while."""
        with self._change.explained():
            self._change.leave_open(ControllerState.NEW)

    def _take_back(self) -> ControllerState:
        state = put_back(self.link, self.old, skip_refused=self._skip_refused)
        if state is ControllerState.OLD:
            self._change.step(ROLLED_BACK)
        return state


def change_settings(
    link: Link,
    context: Context,
    goal: Settings,
    *,
    route: str = "settings",
    motors: Sequence[int] = (),
) -> UploadResult:
    """Change variables, definitions and programs in one call; see ``SettingsUpload``."""
    with SettingsUpload(link, context, goal, route=route, motors=motors) as upload:
        upload.write()
        return upload.finish()


def put_back(link: Link, old: Settings, *, skip_refused: bool = False) -> ControllerState:
    """Write settings back and read them: OLD, or DISABLED with the programs emptied.

    The items go back in the opposite order: what was switched on last goes off first.
    """
    link.write_buffer(["CLOSE"])
    backwards = replace(old, variables=dict(reversed(list(old.variables.items()))))
    present = read_settings(link, backwards)
    wanted = tolerated(old) if skip_refused else old
    try:
        write_settings(link, present, backwards, skip_refused=skip_refused)
        require_settings(link, wanted)
    except (CommandRefused, VerifyMismatch):
        for kind, number in old.programs:
            programs.delete(link, kind, number)
        return ControllerState.DISABLED
    return ControllerState.OLD


def tolerated(wanted: Settings) -> Settings:
    """What is insisted on where the card may refuse some: the programs.

    Those that run may also start others.
    """
    return replace(wanted, variables={}, definitions={}, axes=None, stopped=frozenset())


def finish_settings(link: Link, new: Settings) -> None:
    """Enable what an interruption left disabled; everything else stands already."""
    write_settings(link, read_settings(link, new), new)


def decide_settings(
    wrong_old: Sequence[str], wrong_new: Sequence[str]
) -> tuple[ControllerState, str]:
    """State of settings from what differs from each side: a pure function."""
    if not wrong_old:
        return ControllerState.OLD, "everything stands as before"
    if not wrong_new:
        return ControllerState.NEW, "everything stands as meant"
    return ControllerState.DISABLED, f"half changed: {wrong_old[0]}"


def settings_state(link: Link, old: Settings, new: Settings) -> tuple[ControllerState, str]:
    """``decide_settings`` of what stands on the card."""
    found = read_settings(link, new)
    return decide_settings(differences(old, found), differences(new, found))


def lease_refusals(link: Link, context: Context) -> list[SafetyRefusal]:
    """Refusal if another host holds the lease."""
    first = context.block.p(Index.LEASE)
    lease = parse_lease([float(v) for v in link.query(f"P{first}..{first + 1}")])
    refusal = refuse_foreign_lease(lease, context.owner, read_clock(link))
    return [] if refusal is None else [refusal]


def running_refusals(link: Link) -> list[SafetyRefusal]:
    """Refusals because a motion program runs in a coordinate system."""
    words = link.query("".join(f"&{n}??" for n in range(1, SYSTEMS + 1)))
    return [
        MotorNotSafe(
            f"A motion program runs in coordinate system {n}.",
            code="PC-PRG-020",
            hint=f"Wait for its end, or abort it with `pmac-comp terminal URL -c '&{n}A'`.",
        )
        for n, word in enumerate(words, start=1)
        if int(word.strip()[:6], 16) & RUNNING_PROGRAM
    ]


def write_settings_backup(path: Path, old: Settings) -> None:
    """Store settings, sealed; read again and compared."""
    stamp = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    write_sealed_json(path, {"kind": "settings", "settings": old.as_dict(), "written_utc": stamp})


def read_settings_backup(path: Path) -> Settings:
    """Settings of a backup; the digest is checked."""
    return Settings.from_dict(read_sealed_json(path).get("settings"))


def texts(values: Mapping[str, float]) -> dict[str, str]:
    """Variables as command texts."""
    return {name: plain(value) for name, value in values.items()}
