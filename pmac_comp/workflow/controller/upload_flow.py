"""Uploads as a person runs them: the plan, the upload itself, recovery and rollback.

What lives here: which parts are asked in which order, and the words for people. What may not: the
transactions (``machine.controller``), what is written (``deploy``).
"""

import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pmac_comp.base.errors import ChangeInterrupted, ControllerState, PmacCompError, SafetyRefusal
from pmac_comp.base.progress import Progress
from pmac_comp.files.resources import DEFAULT_JOURNAL
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.journals import ChangeKind
from pmac_comp.machine.controller.change.lease import drop_lease, read_change
from pmac_comp.machine.controller.change.verdict import is_told, link_is_lost, mark_left, untouched
from pmac_comp.machine.controller.contents.programs import ProgramKind
from pmac_comp.machine.controller.motors import motors
from pmac_comp.machine.controller.settings import temporary
from pmac_comp.machine.controller.tables.table_files import read_table_backup
from pmac_comp.machine.controller.whole import parts, recovery, rollback, waiting
from pmac_comp.machine.controller.whole.persist import persist as save_checked
from pmac_comp.workflow.capture.at_work import at_work
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.capture.session import open_axis
from pmac_comp.workflow.compensation.cam import CAM_PROGRAM, has_cam, rest_time_motor
from pmac_comp.workflow.compensation.file import Compensation, read_compensation
from pmac_comp.workflow.compensation.program import COMPENSATED_PROGRAM
from pmac_comp.workflow.controller.deploy import Deployment, deploy
from pmac_comp.workflow.controller.motion_owners import MOTIONS, motion_refusals
from pmac_comp.workflow.controller.owners import time_motor_refusals
from pmac_comp.workflow.controller.standing import (
    Sets,
    bringing_back,
    place_refusals,
    stand_to_switch,
)

_PROGRAMS = {
    "cam": ((ProgramKind.PROG, CAM_PROGRAM),),
    "program": ((ProgramKind.PROG, COMPENSATED_PROGRAM),),
}


@contextmanager
def _ready(
    url: str, bench: str, journal: Path, progress: Progress | None
) -> Iterator[tuple[Axis, Context]]:
    with open_axis(url, bench) as axis:
        context = context_of(axis, journal, progress)
        with at_work(axis, url):
            yield axis, context


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
    said: list[str] = []
    with _ready(url, bench, journal, progress) as (axis, context):
        try:
            deployment = deploy(axis, compensation, context)
        except PmacCompError as error:
            error.hint = error.hint or _after_failure(error, url, bench, journal)
            raise
        said += deployment.notes or ["uploaded, read back and compared"]
        if persist:
            _save(axis, context, compensation.route)
            said.append(f"motor #{axis.motor} was killed, all of it saved to flash and read again")
    return {
        **deployment.as_result(),
        "saved": persist,
        "said": said,
        "summary": "; ".join(said),
        "next": "\n".join(
            next_steps(url, bench, new, journal, compensation, deployment, persist=persist)
        ),
    }


def next_steps(
    url: str,
    bench: str,
    new: Path,
    journal: Path,
    compensation: Compensation,
    deployment: Deployment,
    *,
    persist: bool = False,
) -> Iterator[str]:
    """Commands that may follow an upload, ready to be run; a saved one is taken back by a SAVE."""
    where, again = _where(url, bench), _again(journal)
    file = shlex.quote(str(new))
    if not deployment.acts:
        yield (
            "Arm it: enable the motor "
            f"(pmac-comp terminal {shlex.quote(url)} -c '#{deployment.motor}J/'), then "
            f"pmac-comp upload {where} {file}{again}"
        )
    check = f"pmac-comp verify {where}{again} --compensation {file}"
    yield f"Check it: {check}{_promise(new, compensation)}"
    saved = " --persist" if persist else ""
    yield f"Take it back: {rollback_command(url, bench, journal)}{saved}"


def _where(url: str, bench: str) -> str:
    return f"{shlex.quote(url)} --bench {shlex.quote(bench)}"


def _again(journal: Path) -> str:
    return "" if journal == DEFAULT_JOURNAL else f" --journal {shlex.quote(str(journal))}"


def rollback_command(url: str, bench: str, journal: Path) -> str:
    """Command that takes the last upload of a journal back."""
    return f"pmac-comp rollback {_where(url, bench)}{_again(journal)}"


def removal_command(url: str, bench: str, journal: Path) -> str:
    """Command that takes off what stands; a journal makes known what stood before."""
    return f"pmac-comp remove {_where(url, bench)}{_again(journal)}"


def look_after(url: str, bench: str, journal: Path, state: str) -> str:
    """Command that may follow a change which was taken back or settled, ready to be run."""
    if state == ControllerState.DISABLED.value:
        return f"Bring back what stood before: {rollback_command(url, bench, journal)}"
    return f"Look at it: pmac-comp status {_where(url, bench)}{_again(journal)}"


def _promise(new: Path, compensation: Compensation) -> str:
    """Option that names the model, for the promise; in words where its file is not found.

    A compensation knows the name of its model only: looked for beside its file, then here.
    """
    name = Path(str(compensation.law.provenance.get("model", ""))).name
    if not name:
        return ""
    found = [path for path in (new.parent / name, Path(name)) if path.is_file()]
    if found:
        return f" --model {shlex.quote(str(found[0]))}"
    return f" (and, for the promise, --model with the path of {name})"


def _save(
    axis: Axis, context: Context, route: str, left: ControllerState = ControllerState.NEW
) -> None:
    """SAVE what stands, with the axis and a cam's time motor killed, and see it again."""
    axis.kill()
    if has_cam(axis):
        motors.kill(axis.link, axis.bench.controller.cam_motor_number)
    try:
        save_checked(axis.link, context, _PROGRAMS.get(route, ()))
    except PmacCompError as error:
        what = "upload" if left is ControllerState.NEW else "rollback"
        if isinstance(error, ChangeInterrupted) and error.left is not None:
            mark_left(error, left, confirmed=True)  # the end that was asked for came behind SAVE
            error.add_note(f"The {what} stands, and was saved to flash.")
            raise
        reset = False if link_is_lost(error) else _is_reset(axis, context)
        if reset is None:
            mark_left(error, left, confirmed=False)
            error.add_note(
                f"The {what} itself stands until the next reset; whether SAVE came to its end was "
                "not seen: `pmac-comp status` tells what stands."
            )
            raise
        if reset:
            mark_left(error, ControllerState.DISABLED, confirmed=False)
            error.add_note(f"The controller was reset: of the {what} what was not saved is gone.")
            raise
        mark_left(error, left, confirmed=not link_is_lost(error))
        error.add_note(
            f"The {what} itself stands until the next reset; only SAVE did not end well."
        )
        raise


def _is_reset(axis: Axis, context: Context) -> bool | None:
    """Whether the number is gone that the last upload, or its rollback, left on the controller.

    None where the controller does not answer, as while it still saves.
    """
    last = parts.uploads(context)[-1]
    try:
        return waiting.reset_since(context, last, read_change(axis.link, context))
    except PmacCompError:
        return None


def _after_failure(error: PmacCompError, url: str, bench: str, journal: Path) -> str:
    """What to do next after an upload that stopped, by the state it left."""
    if error.left is ControllerState.OLD:
        return "The controller is as it was; nothing is to be undone."
    where = f"{_where(url, bench)}{_again(journal)}"
    return (
        f"Go on or go back with `pmac-comp recover {where}`, then look with "
        f"`pmac-comp status {where}`."
    )


def recover_upload(
    url: str, bench: str, journal: Path, *, keep: bool = False, progress: Progress | None = None
) -> dict[str, Any]:
    """Settle what an interrupted upload left; with ``keep`` close it without writing."""
    settle = recovery.keep if keep else recovery.recover
    with _ready(url, bench, journal, progress) as (axis, context):
        result = settle(axis.link, context)
        drop_lease(axis.link, context)  # of a measurement that was killed
    said = list(result.notes) or ["nothing was left open"]
    return {
        **result.as_dict(),
        "said": said,
        "summary": "; ".join(said),
        "next": look_after(url, bench, journal, result.verdict.value),
    }


def tables_coming_back(axis: Axis, context: Context) -> Sets:
    """Tables that taking the last upload back puts in the place of those that stand.

    Raises
    ------
    ConfigError
        There is no upload to take back.
    """
    _, parts = rollback.upload_to_take_back(context)
    backups = [
        context.store / Path(str(part.intent.data["backup"])).name
        for part in parts
        if part.kind is ChangeKind.TABLES
    ]
    return bringing_back(axis.motor, lambda: [read_table_backup(path)[0] for path in backups])


def _of_another_axis(axis: Axis, context: Context) -> list[SafetyRefusal]:
    """Refusals to bring a compensated motion back, or what it replaced, over that of another axis.

    Its table, axes and time motor would go; of programs alone it is known who has set them since.
    """
    _, parts = rollback.upload_to_take_back(context)
    settings = [part.new_settings for part in parts if part.kind is ChangeKind.SETTINGS]
    touched = {motion for motion in MOTIONS for new in settings if motion in new.programs}
    is_cam = (ProgramKind.PROG, CAM_PROGRAM) in touched
    return [
        *(time_motor_refusals(axis) if is_cam else ()),
        *(motion_refusals(axis) if touched else ()),
    ]


@contextmanager
def _nothing_taken_back() -> Iterator[None]:
    """Errors before the first step of a rollback leave with NEW on them, unless they tell more."""
    try:
        yield
    except PmacCompError as error:
        if not is_told(error):
            mark_left(error, ControllerState.NEW, confirmed=not link_is_lost(error))
        raise


_FLASH = (
    "the flash was not touched: if the upload was saved there, a reset brings it back "
    "(--persist saves the old over it, motors killed)"
)


def rollback_upload(
    url: str,
    bench: str,
    journal: Path,
    *,
    persist: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Bring back what the last upload replaced, all parts of it, the last one first."""
    with _ready(url, bench, journal, progress) as (axis, context):
        temporary.take_off(axis.link, context)
        with untouched():
            sets = tables_coming_back(axis, context)  # none: the axis does not move for it
        with _nothing_taken_back():
            taken = _of_another_axis(axis, context)
            rollback.refuse_rollback(axis.link, context, [*taken, *place_refusals(axis, sets)])
            rest_time_motor(axis)
            stand_to_switch(axis, sets)
        result = rollback.rollback_last(axis.link, context)
        rest_time_motor(axis)  # of a cam that came back
        said = _FLASH
        if persist:
            _save(axis, context, result.route, ControllerState.OLD)
            said = f"motor #{axis.motor} was killed, all of it saved to flash and read again"
    told = [*result.notes, said]
    return {
        **result.as_dict(),
        "saved": persist,
        "said": told,
        "summary": "; ".join(told),
        "next": look_after(url, bench, journal, result.verdict.value),
    }
