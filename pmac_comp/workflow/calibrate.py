"""Captures from a controller: the proposed campaigns and motions that a person names."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pmac_comp.base.errors import CaptureError, ConfigError, StorageFull
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import write_capture
from pmac_comp.machine.controller.capture_log import recover
from pmac_comp.workflow.axis import Axis, run_all
from pmac_comp.workflow.campaigns import calibration_motions, lead_motions
from pmac_comp.workflow.commissioning import reference_remarks, require_as_described
from pmac_comp.workflow.motions import (
    Motion,
    check_motion,
    motion_rows,
    parse_motion,
)
from pmac_comp.workflow.scales import Scales
from pmac_comp.workflow.session import open_axis

Progress = Callable[[str, float], None]
_CAMPAIGNS: dict[str, Callable[[Bench], list[Motion]]] = {
    "calibration": calibration_motions,
    "lead": lead_motions,
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
    chosen = _CAMPAIGNS[campaign](loaded)
    for motion in chosen:
        check_motion(motion, loaded)
    return CapturePlan(loaded, tuple(chosen))


def capture_to_folder(
    url: str, bench: str, plan: CapturePlan, out: Path, *, progress: Progress | None = None
) -> dict[str, Any]:
    """Run the motions of a plan and store one HDF5 file each; names of the files."""
    _probe(out)
    files: list[Path] = []
    with open_axis(url, bench) as axis:
        remarks = reference_remarks(axis.link, axis.bench)
        prepare(axis)
        for i, motion in enumerate(plan.motions):
            capture = run_all(
                axis, [motion], progress=progress, what=f"{i + 1}/{len(plan.motions)}"
            )
            path = out / f"{i + 1:02d}_{_file_name(motion.name)}.h5"
            write_capture(path, capture[0])
            files.append(path)
        axis.kill()
    return {"files": files, "samples": len(files), "remarks": remarks}


def prepare(axis: Axis) -> None:
    """Close the loop of an axis where it stands, if the card is as the bench file says."""
    require_as_described(axis)
    axis.enable()


def _probe(folder: Path) -> None:
    """Refuse a folder that cannot be written before the machine is touched."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".pmac-comp-probe"
        probe.write_bytes(b"probe")
        probe.unlink()
    except OSError as error:
        raise StorageFull(
            f"{folder} cannot be written: {error}.",
            code="PC-CAL-002",
            hint="Choose another folder with --out; nothing was moved.",
        ) from error


def _file_name(name: str) -> str:
    kept = "".join(c if c.isalnum() or c in "-_" else "_" for c in name)
    return kept[:60]


def recover_to_folder(log: Path, bench: str, out: Path) -> dict[str, Any]:
    """Rebuild what a cut-off capture log holds as a CSV file of raw and SI columns.

    Raises
    ------
    CaptureError
        The log lacks the columns of a capture.
    """
    found = recover(log)
    scales = Scales.of(load_bench(bench))
    needed = {"commanded", "actual"}
    if not needed <= set(found.columns):
        raise CaptureError(
            f"{log.name} holds {', '.join(found.columns)}, not a capture of an axis.",
            code="PC-CAL-003",
        )
    _probe(out)
    from pmac_comp.files.capture import Capture

    raw = found.columns
    n = raw["commanded"].size
    capture = Capture(
        time_s=np.arange(n, dtype=np.float64) * scales.period_s,
        commanded_position_m=scales.motor_m(raw["commanded"]),
        motor_position_m=scales.motor_m(raw["actual"]),
        table_position_m=scales.table_m(raw["scale"]) if "scale" in raw else None,
        torque_command_Nm=scales.torque_Nm(raw["output"]) if "output" in raw else None,
        attributes={"source": f"recovered from {log.name}", "gaps": len(found.gaps)},
    )
    path = out / f"{log.stem}_recovered.h5"
    write_capture(path, capture)
    whole = "whole" if found.is_complete else f"cut off, {found.bytes_lost} bytes damaged"
    return {
        "file": path,
        "samples": n,
        "gaps": list(found.gaps),
        "summary": f"{path}: {n} samples, {len(found.gaps)} gaps, log {whole}",
    }
