"""Uploads as a person runs them: the plan, the upload itself, recovery and rollback.

What lives here: which parts are asked in which order, and the words for people. What may not: the
transactions (``machine.controller``), what is written (``deploy``).
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pmac_comp.base.errors import (
    ConfigError,
    ControllerState,
    ForeignChange,
)
from pmac_comp.machine.controller import law_upload, recovery
from pmac_comp.machine.controller.program_upload import rollback_program
from pmac_comp.machine.controller.transaction import Context, UploadResult
from pmac_comp.workflow.axis import Axis
from pmac_comp.workflow.cam import (
    release_time_motor,
    rest_time_motor,
)
from pmac_comp.workflow.compensation_file import (
    read_compensation,
)
from pmac_comp.workflow.deploy import LAST_UPLOAD, Progress, context_of, deploy, stand_at_zero
from pmac_comp.workflow.session import open_axis


@contextmanager
def _ready(
    url: str, bench: str, journal: Path, progress: Progress | None
) -> Iterator[tuple[Axis, Context]]:
    with open_axis(url, bench) as axis:
        yield axis, context_of(axis, journal, progress)


def upload_file(
    url: str,
    bench: str,
    new: Path,
    journal: Path,
    *,
    persist: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Upload a compensation file."""
    compensation = read_compensation(new)
    with _ready(url, bench, journal, progress) as (axis, context):
        deployment = deploy(axis, compensation, context)
        if persist:
            from pmac_comp.machine.controller.upload import save

            axis.kill()
            save(axis.link)
    return {
        **deployment.as_result(),
        "summary": "; ".join(deployment.notes) or "uploaded, read back and compared",
        "next": f"Check it: pmac-comp verify {url} --compensation {new}. "
        f"Take it back: pmac-comp rollback {url}.",
    }


def recover_upload(
    url: str, bench: str, journal: Path, *, progress: Progress | None = None
) -> dict[str, Any]:
    """Settle what an interrupted upload left."""
    with _ready(url, bench, journal, progress) as (axis, context):
        result = recovery.recover(axis.link, context)
    return {**result.as_dict(), "summary": "; ".join(result.notes) or "nothing was left open"}


def rollback_upload(
    url: str, bench: str, journal: Path, *, progress: Progress | None = None
) -> dict[str, Any]:
    """Bring back what the last upload replaced: law first, then program, then tables."""
    with _ready(url, bench, journal, progress) as (axis, context):
        done: list[UploadResult] = []
        backups = _last_backups(context)
        law = _of_kind(backups, "law")
        if law is not None:
            done.append(law_upload.rollback_law(axis.link, context, law))
        program = _of_kind(backups, "program")
        if program is not None:
            done.append(rollback_program(axis.link, context, program))
        tables = _of_kind(backups, "tables")
        if tables is not None:
            rest_time_motor(axis)
            stand_at_zero(axis)
            done.append(recovery.rollback(axis.link, context, tables))
            release_time_motor(axis)
    if not done:
        raise ConfigError(
            f"There is no backup in {journal}.",
            code="PC-DEP-020",
            hint="Name the folder of the upload with --journal.",
        )
    return {
        "verdict": ControllerState.OLD.value,
        "parts": [part.as_dict() for part in done],
        "summary": "; ".join(note for part in done for note in part.notes) or "the old law is back",
    }


def _last_backups(context: Context) -> list[Path]:
    """Backups of the last upload that the journal folder notes.

    Raises
    ------
    ForeignChange
        The last upload went to another controller.
    """
    note = context.store / LAST_UPLOAD
    if not note.is_file():
        return sorted(context.store.glob("*.json"), key=lambda path: path.stat().st_mtime_ns)
    last = json.loads(note.read_text(encoding="utf-8"))
    if last["controller"] != context.controller:
        raise ForeignChange(
            "The last upload in this journal went to another controller.",
            code="PC-DEP-021",
            hint="Name the journal folder of this controller's upload with --journal.",
            left=ControllerState.OLD,
        )
    return [context.store / Path(name).name for name in last["backups"]]


def _of_kind(backups: list[Path], kind: str) -> Path | None:
    found = [path for path in backups if path.name.endswith(f".{kind}.json")]
    return found[-1] if found else None
