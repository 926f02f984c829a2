"""The file formats of captures: named columns and attributes in HDF5, CSV and MAT files.

What lives here: bytes to columns and back, in the units that the columns' names say, with one clear
error for each way in which a file can be wrong. What may not: what the columns mean (``capture``).
Imports ``base`` only; h5py and scipy are loaded on use.
"""

import csv
import io
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.atomic import atomic_write_text, sync_folder
from pmac_comp.base.errors import CaptureError
from pmac_comp.files.sidecar import Attribute, read_attributes, write_attributes

MAX_SAMPLES = 200_000_000
_LONGEST_LINE = 100_000  # of a heading; what the csv module takes ends a little above
_WORDS = {"": np.nan, "true": 1.0, "false": 0.0}
_OTHER_SEPARATORS = (";", "\t", " ")  # what spreadsheets of other countries write
Columns = Mapping[str, FloatArray]


def read_hdf5(path: Path) -> tuple[dict[str, FloatArray], dict[str, Attribute]]:
    """Columns and attributes of an HDF5 file; CaptureError where it holds anything else."""
    import h5py

    try:
        with h5py.File(path, "r") as file:
            columns = {name: _dataset(file, name) for name in file}
            attributes = {key: _attribute(value) for key, value in file.attrs.items()}
    except OSError as error:
        raise CaptureError(
            "it is empty."
            if not path.stat().st_size
            else "not a readable HDF5 file, or one that was cut off.",
            code="PC-CAP-010",
            hint="If the run was interrupted, "
            "`pmac-comp capture URL --bench FILE --recover LOG --out FOLDER` rebuilds it.",
        ) from error
    return columns, attributes


def headings(path: Path) -> tuple[set[str], dict[str, Attribute]]:
    """Names of the columns and attributes of an HDF5 or CSV file; its samples are not looked at."""
    if path.suffix.lower() != ".csv":
        return _hdf5_headings(path)
    with path.open(encoding="utf-8-sig", errors="replace") as stream:
        head: list[str] = []
        while not head or head[-1].startswith("#"):
            head.append(stream.readline(_LONGEST_LINE).rstrip("\n"))
    return set(_csv_names(head[-1:])), _csv_attributes(head[:-1]) | read_attributes(path)


def _hdf5_headings(path: Path) -> tuple[set[str], dict[str, Attribute]]:
    import h5py

    with h5py.File(path, "r") as file:
        return set(file), {key: _attribute(value) for key, value in file.attrs.items()}


def _dataset(file: Any, name: str) -> FloatArray:
    import h5py

    link = file.get(name, getlink=True)
    item: Any = file.get(name) if isinstance(link, h5py.HardLink) else None
    plain = isinstance(item, h5py.Dataset) and not (item.is_virtual or item.external)
    # MATLAB knows no vectors: its version 7.3 writes matrices of one row.
    is_row = plain and item.ndim in {1, 2} and item.size == max(item.shape)
    if not is_row or item.dtype.kind not in "fiub" or item.size > MAX_SAMPLES:
        raise CaptureError(
            f"entry {name!r} is not a plain one-dimensional column of numbers.",
            code="PC-CAP-011",
            hint="Links, groups, virtual and external datasets are not read.",
        )
    return np.asarray(item[()], dtype=np.float64).reshape(-1)


def _attribute(value: Any) -> Attribute:
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    if isinstance(value, np.integer):
        return int(value)
    if isinstance(value, np.floating):
        return float(value)
    return str(value)


def write_hdf5(
    path: Path,
    columns: Columns,
    units: Mapping[str, str],
    attributes: Mapping[str, Attribute],
) -> None:
    """Write columns as datasets with their unit; OSError leaves the old file as it was."""
    import h5py

    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        for name, values in columns.items():
            file.create_dataset(name, data=values).attrs["units"] = units[name]
        for key, value in attributes.items():
            file.attrs[key] = value
    # Built in memory first: an error of the disk inside h5py cannot then damage the process.
    temporary = path.with_name(f".{path.name}.partial")
    try:
        temporary.write_bytes(buffer.getbuffer())
        temporary.replace(path)
        sync_folder(path.parent)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise


def read_csv(path: Path) -> tuple[dict[str, FloatArray], dict[str, Attribute]]:
    """Columns of a CSV file; attributes of its first lines (``# key = value``) and beside it."""
    lines = _text_lines(path)
    n_told = next((i for i, line in enumerate(lines) if not line.startswith("#")), len(lines))
    attributes, lines = _csv_attributes(lines[:n_told]) | read_attributes(path), lines[n_told:]
    names = _csv_names(lines[:1])
    if not names or len(set(names)) != len(names):
        raise CaptureError(
            "the header line is missing or names a column twice.",
            code="PC-CAP-012",
            hint="The first line must name the columns: time_s,commanded_position_mm,"
            "motor_position_mm and more.",
        )
    if len(names) == 1 and any(mark in names[0] for mark in _OTHER_SEPARATORS):
        raise CaptureError(
            f"the columns of the header line are not separated by commas: {names[0][:80]!r}.",
            code="PC-CAP-016",
            hint="Export with commas between columns and a point in numbers.",
        )
    _require_names(names)
    rows = _number_rows(lines[1:], len(names))
    return {name: rows[:, i].copy() for i, name in enumerate(names)}, attributes


def _csv_attributes(lines: list[str]) -> dict[str, Attribute]:
    parts = [line[1:].partition("=") for line in lines]
    # A spreadsheet fills each line up to the width of the table.
    return {key.strip(): value.rstrip(",").strip() for key, _, value in parts}


def _require_names(names: Collection[str]) -> None:
    """Refuse columns that no HDF5 file could hold: without a name, a dot, with a slash."""
    wrong = [name for name in names if not name or name == "." or "/" in name]
    if wrong:
        raise CaptureError(
            f"a column is named {wrong[0]!r}."
            if wrong[0]
            else "a column has no name, as an index of pandas.",
            code="PC-CAP-021",
            hint="Name each column, without a slash (pandas: to_csv(index=False)).",
        )


def _csv_names(lines: list[str]) -> list[str]:
    return [name.strip() for name in next(csv.reader(lines), [])]


def _text_lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise CaptureError(
            "not a text file in UTF-8.", code="PC-CAP-013", hint="Export the capture as CSV again."
        ) from error


def _number_rows(lines: list[str], n_columns: int) -> FloatArray:
    body = [line for line in lines if line.strip()]
    rows = np.empty((len(body), n_columns))
    for i, row in enumerate(csv.reader(body)):
        try:
            rows[i] = [_number(cell) for cell in row]
        except ValueError as error:
            raise CaptureError(
                f"data row {i + 1} is not {n_columns} numbers: {','.join(row)[:80]!r}.",
                code="PC-CAP-014",
                hint="Each row needs one decimal number (point, no thousands sign) per column.",
            ) from error
    return rows


def _number(cell: str) -> float:
    """Number of a cell: pandas writes what is missing as nothing, and truth in words."""
    word = cell.strip().lower()
    return _WORDS[word] if word in _WORDS else float(cell)


def write_csv(path: Path, columns: Columns, attributes: Mapping[str, Attribute]) -> None:
    """Write columns under a header line; attributes go into a file of their own beside it."""
    out = io.StringIO()
    out.write(",".join(columns) + "\n")
    table = np.column_stack(list(columns.values()))
    np.savetxt(out, table, delimiter=",", fmt=[_digits(name) for name in columns])
    write_attributes(path, out.getvalue(), attributes)
    atomic_write_text(path, out.getvalue())


def _digits(name: str) -> str:
    """Format of a column: a round trip loses nothing.

    A millionth of a nm and 0.1 ns are far below any resolution, also of what is made of differences
    of readings; of columns of others (a time of day, a count) it is not known.
    """
    if name == "time_s":
        return "%.10f"
    return "%.13g" if name.endswith(("_mm", "_Nm")) else "%.16g"


def read_mat(path: Path) -> dict[str, Any]:
    """Variables of a MAT file of version 5, arrays without dimensions of one."""
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        return dict(loadmat(path, squeeze_me=True))
    except (MatReadError, NotImplementedError, ValueError, TypeError) as error:
        raise CaptureError(
            "not a readable MAT file of version 5, or one that was cut off.",
            code="PC-CAP-015",
            hint="Save with `save -v7`; version 7.3 files are HDF5: rename them to .h5.",
        ) from error


def columns_of(variables: Mapping[str, Any]) -> dict[str, FloatArray]:
    """Those variables of a MAT file that are rows or columns of numbers."""
    return {
        name: np.asarray(value, dtype=np.float64)
        for name, value in variables.items()
        if not name.startswith("__") and getattr(value, "dtype", np.dtype("O")).kind in "fiu"
        and np.ndim(value) == 1
    }  # fmt: skip
