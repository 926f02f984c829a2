"""Putting a backup back, as one upload of settings, programs and tables that can be taken back."""

from collections.abc import Mapping

from pmac_comp.base.errors import ConfigError, ControllerState, MotorNotSafe, SafetyRefusal
from pmac_comp.base.progress import Steps
from pmac_comp.machine.controller.card.identity import Identity, read_identity
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.variables import describe
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.manifest import (
    MAGIC,
    MANIFEST_SIZE,
    Manifest,
    ManifestState,
)
from pmac_comp.machine.controller.change.transaction import UploadResult
from pmac_comp.machine.controller.change.verdict import untouched
from pmac_comp.machine.controller.contents import programs
from pmac_comp.machine.controller.contents.law_bank import Index
from pmac_comp.machine.controller.contents.programs import ProgramKind
from pmac_comp.machine.controller.contents.safety import raise_all
from pmac_comp.machine.controller.contents.settings import Buffer, Settings
from pmac_comp.machine.controller.motors.motors import read_motors
from pmac_comp.machine.controller.settings import temporary
from pmac_comp.machine.controller.settings.backup import (
    NOT_RESTORED,
    Q_WINDOW,
    Backup,
    Difference,
    compare,
    live_variables,
    read_backup,
    silent,
)
from pmac_comp.machine.controller.settings.settings_upload import SettingsUpload, lease_refusals
from pmac_comp.machine.controller.tables.upload import TableUpload
from pmac_comp.machine.controller.whole.grouping import grouped
from pmac_comp.machine.controller.whole.waiting import waiting_refusals
from pmac_comp.machine.wire.numbers import read_number


def restore(
    link: Link,
    context: Context,
    backup: Backup,
    *,
    other_card: bool = False,
    progress: Steps = silent,
) -> tuple[UploadResult, tuple[Difference, ...]]:
    """Put a backup on the controller as one upload, and say what still differs.

    All motors must be killed. What differs afterwards is told: what the card refuses or does not
    let anybody set, and what lives on it, as the PLCs that others switch on and what they write.
    Interrupted, ``recover`` brings back what stood before.

    Parameters
    ----------
    link, context
        Conversation, folder, block.
    backup : Backup
        What shall stand.
    other_card : bool
        Whether a person said that the backup of another card, firmware or memory may be used.
    progress : callable
        Told of each part.

    Raises
    ------
    MotorNotSafe
        A motor is enabled; nothing was changed.
    ConfigError
        The backup is of another kind of controller.
    """
    with untouched():
        if not other_card:
            _refuse_other_card(read_identity(link), backup)
        raise_all(waiting_refusals(link, context), "The restore")
        temporary.take_off(link, context)
        raise_all([*_enabled_motors(link), *lease_refusals(link, context)], "The restore")
        present = _read_like(link, backup, progress)
        refusals = _enabled_motors(link)  # once more: reading takes minutes on a serial line
    with grouped(link, context, "restore") as parts:
        goal = _goal(present, backup, context)
        with SettingsUpload(
            link, parts, goal, route="restore", refusals=refusals, skip_refused=True
        ) as upload:
            upload.write(first=lambda: link.command("I5=0"))
            upload.finish()
        with TableUpload(
            link,
            parts,
            exactly=backup.tables,
            enable_after=backup.enabled and len(backup.tables) > 0,
            check_limits=False,
        ) as tables:
            result = tables.execute()
    after = _read_like(link, backup, progress)
    return result, compare(backup, after)


def _read_like(link: Link, backup: Backup, progress: Steps) -> Backup:
    """What stands of the variables that the backup has."""
    return read_backup(
        link,
        p_range=_span(backup.pvariables),
        with_q=bool(backup.qvariables),
        progress=progress,
    )


def _enabled_motors(link: Link) -> list[SafetyRefusal]:
    active = [k + 1 for k, v in enumerate(link.query("I100,32,100")) if read_number(v)]
    alive = [m for m, r in read_motors(link, active).items() if not r.status.is_killed]
    if not alive:
        return []
    return [
        MotorNotSafe(
            f"Restoring needs all motors killed; enabled: {', '.join(f'#{m}' for m in alive)}.",
            code="PC-BCK-003",
            hint="Kill each where the axis is safe without torque: "
            + " ".join(f"`pmac-comp terminal URL -c '#{m}K'`" for m in alive)
            + ".",
            left=ControllerState.OLD,
        )
    ]


def _span(values: Mapping[int, str]) -> tuple[int, int]:
    return (min(values), max(values)) if values else (0, 0)


def _refuse_other_card(identity: Identity, backup: Backup) -> None:
    found = identity.as_dict()
    wrong = [
        f"{name} {backup.identity.get(name)} there, {found[name]} here"
        for name in ("card", "firmware", "card_type", "cpu", "dpram")
        if backup.identity.get(name) != found[name]
    ]
    if wrong:
        raise ConfigError(
            f"The backup is of another controller: {'; '.join(wrong)}.",
            code="PC-BCK-004",
            hint="Defaults and addresses may mean something else there. If you know that they do "
            "not, say so with --other-card.",
            left=ControllerState.OLD,
        )


def _goal(present: Backup, backup: Backup, context: Context) -> Settings:
    """Everything that differs and may be set; I5 last, so that PLCs find the rest in place.

    What the backup's programs write themselves is left to them: the torque that a law sent then
    would push an axis that is enabled before its PLC runs.
    """
    live = live_variables(backup)
    ours = range(context.block.p(Index.MANIFEST), context.block.p(Index.RESTS))
    variables = {
        f"I{n}": v
        for n, v in backup.ivariables.items()
        if n not in NOT_RESTORED
        and n != 5
        and f"I{n}" not in live
        and not describe(n).read_only
        and present.ivariables.get(n) != v
    }
    variables |= {
        f"P{n}": v
        for n, v in _without_past_uploads(backup.pvariables).items()
        # Manifest and lease belong to the upload that runs now.
        if n not in ours and present.pvariables.get(n) != v
    }
    variables |= {
        f"{Q_WINDOW}{n}": v for n, v in backup.qvariables.items() if present.qvariables.get(n) != v
    }
    differing = {n: v for n, v in backup.definitions.items() if present.definitions.get(n) != v}
    bodies = {(p.kind, p.number): p.lines for p in backup.programs}
    there = {(p.kind, p.number): p.tokens for p in present.programs}
    changed: dict[Buffer, tuple[str, ...]] = {
        key: bodies.get(key, ())
        for key in {**there, **bodies}
        if programs.canonical(bodies.get(key, ())) != there.get(key, ())
    }
    # Programs that are the same and run in one of them only.
    changed |= {(ProgramKind.PLC, n): bodies[ProgramKind.PLC, n]
                for n in backup.running ^ present.running
                if (ProgramKind.PLC, n) in bodies}  # fmt: skip
    plcs = {n for kind, n in changed if kind is ProgramKind.PLC and (kind, n) in bodies}
    return Settings(
        {**variables, "I5": backup.ivariables.get(5, "0")},
        differing,
        changed,
        backup.axes if set(present.axes) != set(backup.axes) else None,
        backup.running & plcs,
        frozenset(plcs - backup.running),
    )


def _without_past_uploads(stored: Mapping[int, str]) -> dict[int, str]:
    """P-variables without the leases of their time, and without uploads that were under way then.

    They may lie in the block of another bench file: a manifest is known by its own checksum. A
    lease would keep writers out whom nobody holds up any more, an unfinished upload would have the
    guard PLC switch the tables off.
    """
    values = dict(stored)
    for first in [n for n, v in stored.items() if v == str(MAGIC)]:
        span = range(first, first + MANIFEST_SIZE)
        if not all(n in stored for n in span):
            continue
        manifest = Manifest.told_by([float(read_number(stored[n])) for n in span])
        if manifest is None:
            continue
        gone = [first + MANIFEST_SIZE]
        gone += span if manifest.state is ManifestState.WRITING else []
        values |= {n: "0" for n in gone if n in stored}
    return values
