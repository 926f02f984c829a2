"""Captures: one servo-rate run in SI in memory, in mm under the names of the header in files.

What lives here: the ``Capture`` value, what its columns are called in files, reading and writing by
suffix. What may not: the formats themselves (``capture_formats``), or anything that computes with
the data. Imports ``base`` only.
"""

import hashlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pmac_comp.base.arrays import BoolArray, FloatArray
from pmac_comp.base.errors import CaptureError, SampleGap, StorageFull
from pmac_comp.base.reading import why
from pmac_comp.base.units import MM_PER_M, US_PER_S
from pmac_comp.files import capture_formats as formats
from pmac_comp.files.sidecar import Attribute

SCHEMA_VERSION = 1
_GAP_TOLERANCE = 0.5  # of a sample period: a larger departure from the grid is a gap

# Column in files -> (field, unit in files, factor to SI), in the order of the header.
_COLUMNS: dict[str, tuple[str, str, float]] = {
    "time_s": ("time_s", "s", 1.0),
    "commanded_position_mm": ("commanded_position_m", "mm", 1.0 / MM_PER_M),
    "motor_position_mm": ("motor_position_m", "mm", 1.0 / MM_PER_M),
    "table_position_mm": ("table_position_m", "mm", 1.0 / MM_PER_M),
    "torque_command_Nm": ("torque_command_Nm", "N m", 1.0),
    "desired_position_mm": ("desired_position_m", "mm", 1.0 / MM_PER_M),
}
# Endings of further columns, the longer ones first.
_UNITS = {
    "mm_per_s": "mm/s", "m_per_s2": "m/s2", "m_per_s": "m/s", "rad_per_s": "rad/s", "mm": "mm",
    "um": "um", "m": "m", "s": "s", "ms": "ms", "us": "us", "Hz": "Hz", "Nm": "N m", "N": "N",
    "ct": "ct", "V": "V", "A": "A", "C": "degC", "bar": "bar", "rad": "rad", "deg": "deg",
}  # fmt: skip
_REQUIRED = ("time_s", "commanded_position_mm", "motor_position_mm")
_VALID = "valid"
# Further columns of which something is made.
EXTERNAL_FORCE = "external_force_N"
TORQUE_FEEDFORWARD = "torque_feedforward_Nm"
TRUE_POSITIONS = ("true_table_position_m", "true_motor_position_m")
_READ_BESIDE = frozenset({EXTERNAL_FORCE, TORQUE_FEEDFORWARD, *TRUE_POSITIONS})
PREDICTED = "predicted by a model, not measured"  # what such a capture says under ``source``


@dataclass(frozen=True)
class Capture:
    """One run on a uniform time grid.

    Parameters
    ----------
    time_s : ndarray, shape (n,)
        Uniform grid in s.
    commanded_position_m, motor_position_m : ndarray, shape (n,)
        Trajectory r and motor position expressed at the table, m.
    desired_position_m : ndarray, shape (n,), or None
        r + correction; None means the commanded position, or unknown (see ``tells_desired``).
    table_position_m : ndarray, shape (n,), or None
        Scale reading in m; None on motor-encoder-only benches.
    torque_command_Nm : ndarray, shape (n,), or None
        Torque command in N m.
    valid : ndarray of bool, shape (n,), or None
        False marks dropped or clipped samples; None means that all are valid.
    extra : Mapping of str to ndarray, shape (n,)
        Further columns, in the unit that their name says. Those of which nothing is made may hold
        NaN, as a thermometer that is read once a second leaves it.
    attributes : Mapping of str to str, float or int
        Servo period, UTC start, bench text, controller identity and the like.

    Raises
    ------
    CaptureError
        Lengths differ, a valid sample is not finite, or fewer than two samples.
    SampleGap
        Time does not run on a uniform grid.
    """

    time_s: FloatArray
    commanded_position_m: FloatArray
    motor_position_m: FloatArray
    desired_position_m: FloatArray | None = None
    table_position_m: FloatArray | None = None
    torque_command_Nm: FloatArray | None = None
    valid: BoolArray | None = None
    extra: Mapping[str, FloatArray] = field(default_factory=dict)
    attributes: Mapping[str, Attribute] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.time_s.ndim != 1 or self.time_s.size < 2:
            raise CaptureError(
                f"The capture has {self.time_s.size} samples; at least two are needed.",
                code="PC-CAP-001",
                hint="Capture again, or check that the file is whole.",
            )
        for name, column in self._all_columns():
            self._check_length(name, column)
            if name not in self.extra or name in _READ_BESIDE:
                self._check_finite(name, column)
        self._check_grid()

    @property
    def n(self) -> int:
        """Number of samples."""
        return int(self.time_s.size)

    @property
    def sample_period_s(self) -> float:
        """Sample period in s."""
        return float((self.time_s[-1] - self.time_s[0]) / (self.n - 1))

    @property
    def desired_m(self) -> FloatArray:
        """Desired position in m: the stored one, or the commanded one where none is stored."""
        if self.desired_position_m is None:
            return self.commanded_position_m
        return self.desired_position_m

    @property
    def tells_desired(self) -> bool:
        """Whether the desired position is known: a compensation that was on added what is lost."""
        return self.desired_position_m is not None or self.attributes.get("compensation") != "on"

    @property
    def largest_added_m(self) -> float:
        """Largest correction that a compensation added to the command, m."""
        return float(np.max(np.abs(self.desired_m - self.commanded_position_m)))

    @property
    def mask(self) -> BoolArray:
        """Validity of each sample as an array, shape (n,)."""
        return np.ones(self.n, dtype=np.bool_) if self.valid is None else self.valid

    def with_attributes(self, **attributes: Attribute) -> "Capture":
        """Copy with attributes added."""
        return replace(self, attributes={**self.attributes, **attributes})

    def slice(self, start: int, stop: int) -> "Capture":
        """Copy of samples ``start`` to ``stop - 1``."""
        part: Callable[[Any], Any] = lambda a: None if a is None else a[start:stop]  # noqa: E731
        return replace(
            self,
            time_s=self.time_s[start:stop],
            commanded_position_m=self.commanded_position_m[start:stop],
            motor_position_m=self.motor_position_m[start:stop],
            desired_position_m=part(self.desired_position_m),
            table_position_m=part(self.table_position_m),
            torque_command_Nm=part(self.torque_command_Nm),
            valid=part(self.valid),
            extra={name: column[start:stop] for name, column in self.extra.items()},
        )

    def _all_columns(self) -> list[tuple[str, Any]]:
        own = [(name, getattr(self, entry[0])) for name, entry in _COLUMNS.items()]
        columns = [*own, (_VALID, self.valid), *self.extra.items()]
        return [(name, column) for name, column in columns if column is not None]

    def _check_length(self, name: str, column: Any) -> None:
        if column.shape != self.time_s.shape:
            raise CaptureError(
                f"Column {name} has {column.size} samples, time_s has {self.time_s.size}.",
                code="PC-CAP-002",
                hint="All columns of a capture must have one length.",
            )

    def _check_finite(self, name: str, column: Any) -> None:
        bad = np.flatnonzero(~np.isfinite(column) & (self.mask | (name == "time_s")))
        if bad.size:
            raise CaptureError(
                f"Column {name} holds {column[bad[0]]} at sample {int(bad[0])} "
                f"({bad.size} such samples).",
                code="PC-CAP-003",
                hint="Mark such samples in a column 'valid' (0 = not valid), or capture again.",
                context={"column": name, "index": int(bad[0]), "count": int(bad.size)},
            )

    def _check_grid(self) -> None:
        steps = np.diff(self.time_s)
        period_s = float(np.median(steps))
        back = np.flatnonzero(steps <= 0.0)
        if back.size:
            i = int(back[0])
            raise SampleGap(
                f"Column time_s does not ascend: {self.time_s[i + 1]:.6f} s follows "
                f"{self.time_s[i]:.6f} s after sample {i} ({back.size} such places).",
                code="PC-CAP-004",
                hint="Sort the samples by time and remove doubled ones; two runs are two files.",
                context={"index": i, "places": int(back.size)},
            )
        bad = np.flatnonzero(np.abs(steps - period_s) > _GAP_TOLERANCE * period_s)
        if bad.size:
            i = int(bad[0])
            missing = round(float(steps[i]) / period_s) - 1
            raise SampleGap(
                f"Time jumps from {self.time_s[i]:.6f} s to {self.time_s[i + 1]:.6f} s after "
                f"sample {i}: {missing} samples of {period_s * US_PER_S:.1f} us are missing "
                f"({bad.size} such places).",
                code="PC-CAP-005",
                hint="Fill the gap with rows marked valid = 0, split the file, or capture again.",
                context={"index": i, "missing": missing, "places": int(bad.size)},
            )


def told_by(captures: Iterable[Capture], attribute: str) -> list[str]:
    """What captures say under an attribute, each once, in their order."""
    told = (capture.attributes.get(attribute) for capture in captures)
    return list(dict.fromkeys(str(value) for value in told if value))


def read_capture(path: Path | str) -> Capture:
    """Capture read from a file; the suffix decides: ``.h5 .hdf5 .csv .mat``.

    Raises
    ------
    CaptureError
        The file is missing, is not a capture, lacks a column or holds NaN.
    SampleGap
        Time has a gap.
    """
    source = Path(path)
    readers: dict[str, Callable[[Path], Capture]] = {
        ".h5": _read_hdf5, ".hdf5": _read_hdf5, ".csv": _read_csv, ".mat": _read_mat,
    }  # fmt: skip
    reader = readers.get(source.suffix.lower())
    if reader is None:
        raise _unknown_suffix(source, sorted(readers))
    if not source.is_file():
        raise CaptureError(
            f"{source} is a folder, not a capture file."
            if source.is_dir()
            else f"There is no capture file {source}.",
            code="PC-CAP-006",
            hint="Check the path; `pmac-comp capture` writes new ones.",
        )
    try:
        return reader(source)
    except OSError as error:
        raise CaptureError(
            f"The capture file {source} cannot be read: {why(error)}.",
            code="PC-CAP-017",
            hint="Check the path and the rights to read it.",
        ) from error
    except CaptureError as error:
        error.message = f"{source.name}: {error.message}"
        raise


def write_capture(path: Path | str, capture: Capture) -> None:
    """Write a capture to ``.h5``/``.hdf5`` or ``.csv``; the target is replaced whole or not at all.

    Raises
    ------
    CaptureError
        Unknown suffix.
    StorageFull
        The disk took no more data; the target is untouched.
    """
    target = Path(path)
    writers: dict[str, Callable[[Path, Capture], None]] = {
        ".h5": _write_hdf5, ".hdf5": _write_hdf5, ".csv": _write_csv,
    }  # fmt: skip
    writer = writers.get(target.suffix.lower())
    if writer is None:
        raise _unknown_suffix(target, sorted(writers))
    try:
        writer(target, capture)
    except OSError as error:
        raise StorageFull(
            f"{target} could not be written: {why(error)}.",
            code="PC-CAP-007",
            hint="Free space or choose another folder; nothing was changed.",
        ) from error


def predicted_remarks(captures: Iterable[Capture]) -> tuple[str, ...]:
    """That captures are no measurements but predictions of a model, where some are."""
    found = [capture.attributes.get("source") == PREDICTED for capture in captures]
    if not any(found):
        return ()
    return (
        f"{sum(found)} of {len(found)} captures are predictions of a model, not measurements: no "
        "figure made from them says anything of the axis",
    )


def holds_runs(path: Path) -> bool:
    """Whether a file holds a run that no computation brings back: a capture that is no prediction.

    A file that cannot be opened counts as one: it may be damaged, or open in another program.
    """
    suffix = path.suffix.lower()
    if suffix not in {".h5", ".hdf5", ".csv", ".mat"} or not path.is_file():
        return False
    if path.stat().st_size == 0:
        return False
    if suffix == ".mat":  # never written here
        return True
    try:
        names, attributes = formats.headings(path)
    except OSError:
        return True
    return names.issuperset(_REQUIRED) and attributes.get("source") != PREDICTED


def capture_source(path: Path) -> str:
    """Where the run of a file was made, as its headings say; empty where they do not.

    A file that cannot be opened says nothing either: it may be damaged, and is nobody's to replace.
    """
    try:
        return str(formats.headings(path)[1].get("source", ""))
    except OSError:
        return ""


def file_digest(path: Path) -> str:
    """SHA-256 of a file as hex text."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _unknown_suffix(path: Path, known: list[str]) -> CaptureError:
    wrong = "is a folder" if path.is_dir() else "has a suffix that is not a capture format"
    return CaptureError(
        f"{path.name} {wrong}.",
        code="PC-CAP-008",
        hint="Use one of " + " ".join(known) + ".",
    )


def _from_columns(columns: Mapping[str, FloatArray], attributes: dict[str, Attribute]) -> Capture:
    missing = [name for name in _REQUIRED if name not in columns]
    if missing:
        raise CaptureError(
            f"column(s) missing: {', '.join(missing)}; found: {', '.join(columns) or 'none'}.",
            code="PC-CAP-009",
            hint="A capture needs " + ", ".join(_REQUIRED) + "; others are optional.",
            context={"missing": missing},
        )
    known = {
        entry[0]: np.ascontiguousarray(columns[name] * entry[2])
        for name, entry in _COLUMNS.items()
        if name in columns
    }
    valid = columns[_VALID] > 0.5 if _VALID in columns else None
    extra = {k: v for k, v in columns.items() if k not in _COLUMNS and k != _VALID}
    return Capture(**known, valid=valid, extra=extra, attributes=attributes)


def _to_columns(capture: Capture) -> tuple[dict[str, FloatArray], dict[str, str]]:
    """Columns in the units of files, and these units."""
    columns: dict[str, FloatArray] = {}
    units: dict[str, str] = {}
    for name, (attribute, unit, factor) in _COLUMNS.items():
        values = getattr(capture, attribute)
        if values is not None:
            columns[name], units[name] = values / factor, unit
    if capture.valid is not None:
        columns[_VALID], units[_VALID] = capture.valid.astype(np.float64), "1"
    for name, values in capture.extra.items():
        columns[name], units[name] = values, _unit_of(name)
    return columns, units


def _unit_of(name: str) -> str:
    """Unit that a column of others has by its name; empty where it tells none that is known."""
    found = next((unit for end, unit in _UNITS.items() if name.endswith(f"_{end}")), "")
    is_rate = "_per_" in name and "/" not in found
    return "" if is_rate else found


def _read_hdf5(path: Path) -> Capture:
    return _from_columns(*formats.read_hdf5(path))


def _read_csv(path: Path) -> Capture:
    return _from_columns(*formats.read_csv(path))


def _read_mat(path: Path) -> Capture:
    from pmac_comp.files import emps

    variables = formats.read_mat(path)
    if variables.keys() >= emps.VARIABLES:
        return emps.emps_capture(variables)
    return _from_columns(formats.columns_of(variables), {"source": path.name})


def _write_hdf5(path: Path, capture: Capture) -> None:
    columns, units = _to_columns(capture)
    attributes = {
        **capture.attributes,
        "schema_version": SCHEMA_VERSION,
        "sample_period_s": capture.sample_period_s,
    }
    formats.write_hdf5(path, columns, units, attributes)


def _write_csv(path: Path, capture: Capture) -> None:
    formats.write_csv(path, _to_columns(capture)[0], capture.attributes)
