"""Uploads as a person runs them: the plan, the upload itself, recovery and rollback.

What lives here: which parts are asked in which order, and the words for people. What may not: the
transactions (``machine.controller``), what is written (``deploy``).
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pmac_comp.machine.controller import recovery
from pmac_comp.machine.controller.context import Context
from pmac_comp.machine.controller.persist import persist as save_checked
from pmac_comp.workflow.axis import Axis
from pmac_comp.workflow.cam import (
    release_time_motor,
    rest_time_motor,
)
from pmac_comp.workflow.compensation_file import (
    read_compensation,
)
from pmac_comp.workflow.deploy import Progress, context_of, deploy, stand_at_zero
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
            axis.kill()
            save_checked(axis.link, context)
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
    """Bring back what the last upload replaced, all parts of it, the last one first."""
    with _ready(url, bench, journal, progress) as (axis, context):
        rest_time_motor(axis)
        stand_at_zero(axis)
        result = recovery.rollback_last(axis.link, context)
        release_time_motor(axis)
    return {**result.as_dict(), "summary": "; ".join(result.notes)}
