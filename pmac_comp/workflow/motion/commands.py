"""Files that commands are given: command files, and lists of captures with folders in them."""

import csv
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pmac_comp.base.arrays import FloatArray, finite_array
from pmac_comp.base.errors import CaptureError, ConfigError, SampleGap
from pmac_comp.base.reading import why
from pmac_comp.base.units import MM_PER_M
from pmac_comp.files.capture import read_capture

_TIME, _POSITION = "time_s", "commanded_position_mm"
_UNEVEN = 1.5  # times the usual step, or a part of it: rounded times stay below
_CAPTURES = frozenset({".h5", ".hdf5", ".csv", ".mat"})
_SIDES = re.compile("(before|after)_[0-9]+$")  # as `verify --out` names its runs


def read_command(path: Path) -> tuple[FloatArray, FloatArray]:
    """Time in s and commanded position in m of a CSV command file or of a capture.

    Raises
    ------
    CaptureError
        Missing file or column, or a cell that is no number.
    SampleGap
        Time does not run on a uniform grid.
    """
    if path.suffix.lower() != ".csv":
        capture = read_capture(path)
        return capture.time_s, capture.commanded_position_m
    rows = _rows(path)
    header = [name.strip() for name in rows[0]] if rows else []
    missing = [name for name in (_TIME, _POSITION) if name not in header]
    if missing and len(header) == 1 and ";" in header[0]:
        raise CaptureError(
            f"{path.name}: the columns are not separated by commas.",
            code="PC-CMD-007",
            hint="Export with commas between columns and a point in numbers.",
        )
    if missing:
        raise CaptureError(
            f"{path.name}: column(s) missing: {', '.join(missing)}.",
            code="PC-CMD-001",
            hint=f"A command file has the header {_TIME},{_POSITION}.",
        )
    try:
        columns = [
            finite_array(name, [float(row[header.index(name)]) for row in rows[1:]], min_size=2)
            for name in (_TIME, _POSITION)
        ]
    except (ValueError, IndexError) as error:
        raise CaptureError(
            f"{path.name}: a row does not hold {len(header)} numbers: {error}.",
            code="PC-CMD-002",
            hint="Each row needs one decimal number (point, no thousands sign) per column.",
        ) from error
    time_s, position_mm = columns
    _require_even(path, time_s)
    return time_s, position_mm / MM_PER_M


def _require_even(path: Path, time_s: FloatArray) -> None:
    """Raise SampleGap for the first row whose time is not about one step after the one before."""
    steps = np.diff(time_s)
    forward = steps[steps > 0.0]
    # One of the steps, not the middle of two: half of a file may be sampled twice as fast.
    usual_s = float(np.quantile(forward, 0.5, method="lower")) if forward.size else 0.0
    off = np.flatnonzero((steps <= 0.0) | (steps * _UNEVEN < usual_s) | (steps > _UNEVEN * usual_s))
    if not off.size:
        return
    before = int(off[0])
    expected = f"{usual_s:.6g} s" if usual_s else "more than 0 s"
    raise SampleGap(
        f"{path.name}: time does not run on a uniform grid: row {before + 2} of the numbers, at "
        f"{time_s[before + 1]:.9g} s, comes {steps[before]:.6g} s after the row before it; "
        f"expected is {expected}.",
        code="PC-CMD-003",
        hint="Give one row per servo period.",
        context={"row": before + 2, "rows": int(off.size)},
    )


def capture_paths(paths: Sequence[Path], *, side: str = "") -> tuple[Path, ...]:
    """Files of a list that may hold folders: a folder stands for its captures in order of name.

    With a ``side`` (``before`` or ``after``) a folder that ``verify --out`` wrote, to its end or
    not, stands for its runs of that side.

    Raises
    ------
    ConfigError
        A folder without captures, or a name that is neither file nor folder.
    """
    found: list[Path] = []
    for path in paths:
        if not path.exists():
            raise ConfigError(
                f"There is no file or folder {path}.",
                code="PC-CMD-006",
                hint="Check the path; `pmac-comp capture --out` and `verify --out` write folders.",
            )
        if not path.is_dir():
            found.append(path)
            continue
        inside = sorted(p for p in path.iterdir() if p.suffix.lower() in _CAPTURES)
        if side and all(_SIDES.search(p.stem) for p in inside):
            inside = [p for p in inside if side in p.stem]
        if not inside:
            raise ConfigError(
                f"The folder {path} holds no captures.",
                code="PC-CMD-005",
                hint="Give files, or a folder with .h5, .csv or .mat files.",
            )
        found += inside
    return tuple(found)


def _rows(path: Path) -> list[list[str]]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise CaptureError(
            f"The command file {path} cannot be read: {why(error)}.",
            code="PC-CMD-004",
            hint="Give a CSV file with time_s,commanded_position_mm, or a capture (.csv .h5 .mat).",
        ) from error
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    return list(csv.reader(lines))
