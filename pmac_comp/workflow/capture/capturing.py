"""Captures from a controller: the proposed campaigns and motions that a person names."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pmac_comp.base.errors import ConfigError, PmacCompError, StorageFull
from pmac_comp.base.progress import Progress, Tell
from pmac_comp.base.reading import why
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import Capture, write_capture
from pmac_comp.files.resources import DEFAULT_JOURNAL
from pmac_comp.machine.controller.card.numbers import plain
from pmac_comp.machine.controller.card.variables import read_one
from pmac_comp.machine.controller.contents.table_set import read_tables
from pmac_comp.machine.controller.motors import motors
from pmac_comp.workflow.capture.as_described import place_remarks, require_as_described
from pmac_comp.workflow.capture.at_work import measuring
from pmac_comp.workflow.capture.axis import Axis, run_all
from pmac_comp.workflow.capture.context import acting, context_to_look
from pmac_comp.workflow.capture.run_log import RunLog, capture_of_log, new_log
from pmac_comp.workflow.capture.session import open_axis
from pmac_comp.workflow.motion.campaigns import calibration_motions, lead_motions, require_scale
from pmac_comp.workflow.motion.motions import (
    Motion,
    check_motion,
    motion_rows,
    parse_motion,
    time_needed,
)

_LEAD = "lead"
_CAMPAIGNS: dict[str, Callable[[Bench], list[Motion]]] = {
    "calibration": calibration_motions,
    _LEAD: lead_motions,
    "repeat": lambda bench: [motion for motion in calibration_motions(bench)[:2] for _ in range(3)],
}


@dataclass(frozen=True)
class CapturePlan:
    """Motions to be run, checked against travel and safety limits."""

    bench: Bench
    motions: tuple[Motion, ...]

    def rows(self) -> list[tuple[Any, ...]]:
        """Rows for people."""
        return motion_rows(self.motions)

    def time_needed(self) -> str:
        """How long the session takes, for people."""
        return time_needed([(1, motion) for motion in self.motions])

    def files(self, folder: Path) -> list[Path]:
        """Capture files of the motions in a folder."""
        motions = enumerate(self.motions, 1)
        return [folder / f"{i:02d}_{_file_name(motion.name)}.h5" for i, motion in motions]

    def require_room_in(self, folder: Path) -> None:
        """Refuse a folder with earlier runs, as the capture would; nothing is written.

        Raises
        ------
        ConfigError
            One of the files is there already.
        """
        _refuse_old(self.files(folder), folder)

    def as_result(self) -> dict[str, Any]:
        """Mapping for ``--json``."""
        names = ("name", "duration_s", "from_mm", "to_mm", "peak_mm_per_s", "peak_m_per_s2")
        return {"motions": [dict(zip(names, row, strict=True)) for row in self.rows()]}


def plan_capture(bench: str, *, campaign: str, motions: tuple[str, ...]) -> CapturePlan:
    """Motions of a campaign, or those named, all checked before anything moves."""
    loaded = load_bench(bench)
    if motions:
        return CapturePlan(loaded, tuple(parse_motion(text, loaded) for text in motions))
    if campaign not in _CAMPAIGNS:
        raise ConfigError(
            f"'{campaign}' is not a campaign.",
            code="PC-CAL-001",
            hint="Use one of " + ", ".join(_CAMPAIGNS) + ".",
        )
    if campaign == _LEAD:
        require_scale(loaded, "the lead error")
    chosen = _CAMPAIGNS[campaign](loaded)
    for motion in chosen:
        check_motion(motion, loaded)
    return CapturePlan(loaded, tuple(chosen))


def capture_to_folder(
    url: str,
    bench: str,
    plan: CapturePlan,
    out: Path,
    *,
    journal: Path = DEFAULT_JOURNAL,
    progress: Progress | None = None,
    tell: Tell | None = None,
) -> dict[str, Any]:
    """Run the motions of a plan and store one HDF5 file each; names of the files.

    ``tell`` is called with each remark before the axis moves, when it is not too late to stop.
    """
    paths = plan.files(out)
    require_new(paths, out)
    with open_axis(url, bench) as axis, measuring(borrowing_in(axis, journal), url):
        remarks = (*place_remarks(axis.link, axis.bench), *acting_remarks(axis))
        remarks += offset_remarks(axis)
        if tell is not None:
            for remark in remarks:
                tell(remark)
        for motion in plan.motions:  # all of them before the first one moves the axis
            axis.require_room(motion)
        with motor_as_found(axis):
            prepare(axis)
            runs = run_to_files(axis, plan.motions, paths, progress)
    return {"files": paths, "samples": sum(run.n for run in runs), "remarks": remarks}


def borrowing_in(axis: Axis, journal: Path) -> Axis:
    """The axis; what it borrows is journalled in the folder named, by default in its own."""
    if journal != DEFAULT_JOURNAL:
        axis.setup.store = journal
    return axis


def acting_remarks(axis: Axis) -> tuple[str, ...]:
    """That the runs will be made with a compensation on: none is computed from such runs."""
    law, tables = acting(axis, context_to_look(axis))
    ours = tables and any(table.motor == axis.motor for table in read_tables(axis.link))
    told = [name for name, acts in (("tables", ours), ("a law", law)) if acts]
    if not told:
        return ()
    return (
        f"{' and '.join(told)} of a compensation acted in these runs; a new one is computed from "
        "runs without: `pmac-comp rollback` or `pmac-comp remove` before the next capture",
    )


def offset_remarks(axis: Axis) -> tuple[str, ...]:
    """That the output has an offset, which the route ``law`` would write over."""
    name = f"I{axis.motor}29"
    law, _ = acting(axis, context_to_look(axis))
    offset = 0.0 if law else read_one(axis.link, name)
    if offset == 0.0:
        return ()
    return (
        f"{name} = {plain(offset)} offsets the output; the route law writes {name} itself: for it, "
        "make the runs with 0 there",
    )


def run_to_files(
    axis: Axis, motions: Sequence[Motion], paths: Sequence[Path], progress: Progress | None
) -> list[Capture]:
    """Captures of motions, each in its file before the next one begins.

    While a run lasts its samples are in a log beside its file; an error says where they are.
    """
    captures: list[Capture] = []
    for i, (motion, path) in enumerate(zip(motions, paths, strict=True)):
        with _kept_meanwhile(axis, path):
            captures += run_all(axis, [motion], progress=progress, what=f"{i + 1}/{len(motions)}")
            write_capture(path, captures[-1])
    return captures


@contextmanager
def motor_as_found(axis: Axis) -> Iterator[None]:
    """Afterwards, however it ends, the motor holds or is killed as it was found.

    After an error it is killed once it stands: ``Axis.run`` has stopped it.
    """
    held = motors.read_motor(axis.link, axis.motor).status.is_closed_loop
    try:
        yield
    except (PmacCompError, KeyboardInterrupt):
        if not held:
            axis.kill_once_it_stands()
        raise
    if not held:
        axis.kill()


@contextmanager
def _kept_meanwhile(axis: Axis, path: Path) -> Iterator[None]:
    """Keep the samples of a run in a log until its file is whole; after an error, say where."""
    axis.run_log = new_log(path.parent, path.stem)
    try:
        yield
    except PmacCompError as error:
        if said := axis.run_log.kept():
            error.add_note(said)
        raise
    except KeyboardInterrupt as stop:
        if said := axis.run_log.kept():
            stop.add_note(said)
        raise
    else:
        axis.run_log.drop()
    finally:
        axis.run_log = RunLog()


def prepare(axis: Axis) -> None:
    """Close the loop of an axis where it stands, if the card is as the bench file says."""
    require_as_described(axis)
    axis.enable()


def require_new(paths: Sequence[Path], folder: Path) -> None:
    """Refuse a folder that holds earlier runs or cannot be written, before anything moves.

    Raises
    ------
    ConfigError
        One of the files is there already.
    StorageFull
        The folder cannot be written.
    """
    _refuse_old(paths, folder)
    _probe(folder)


def _refuse_old(paths: Sequence[Path], folder: Path) -> None:
    """Refuse to write over earlier runs: nobody can measure them again."""
    old = [path.name for path in paths if path.exists()]
    if old:
        raise ConfigError(
            f"{folder} holds {old[0]}{f' and {len(old) - 1} more' if old[1:] else ''} of an "
            "earlier capture.",
            code="PC-CAL-004",
            hint="Name another folder with --out; nothing was moved.",
        )


def _probe(folder: Path) -> None:
    """Refuse a folder that cannot be written before the machine is touched."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".pmac-comp-probe"
        try:
            probe.write_bytes(b"probe")
        finally:
            probe.unlink(missing_ok=True)
    except OSError as error:
        raise StorageFull(
            f"{folder} cannot be written: {why(error)}.",
            code="PC-CAL-002",
            hint="Choose another folder with --out; nothing was moved.",
        ) from error


def _file_name(name: str) -> str:
    kept = "".join(c if c.isalnum() or c in "-_" else "_" for c in name)
    return kept[:60]


def recover_to_folder(log: Path, bench: str, out: Path) -> dict[str, Any]:
    """Make a capture of what a log holds that a run left behind.

    Raises
    ------
    CaptureError
        Not a log of a capture.
    """
    capture, found = capture_of_log(log, load_bench(bench))
    path = out / f"{log.stem}_recovered.h5"
    require_new([path], out)
    write_capture(path, capture)
    whole = "whole" if found.is_complete else f"cut off, {found.bytes_lost} bytes damaged"
    return {
        "file": path,
        "samples": capture.n,
        "gaps": list(found.gaps),
        "summary": f"{path}: {capture.n} samples, {len(found.gaps)} gaps, log {whole}",
    }
