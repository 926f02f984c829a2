"""Captures: round trips, and every way in which a file can be bad."""

import csv
from dataclasses import replace

import h5py
import numpy as np
import pytest

from pmac_comp.base.errors import CaptureError, SampleGap, StorageFull
from pmac_comp.files.capture import (
    PREDICTED,
    Capture,
    holds_runs,
    predicted_remarks,
    read_capture,
    write_capture,
)
from pmac_comp.files.kinds import kind_to_keep
from pmac_comp.files.sidecar import sidecar_of

PERIOD_s = 3707733 / 8388608 / 1e3


def _capture(n: int = 200) -> Capture:
    time_s = PERIOD_s * np.arange(n)
    r = 0.01 * np.sin(20.0 * time_s)
    return Capture(
        time_s=time_s, commanded_position_m=r, motor_position_m=r + 1e-6,
        desired_position_m=r + 2e-6, table_position_m=r - 1e-6, torque_command_Nm=0.1 * r,
        extra={"servo_cycle": np.arange(n, dtype=float)}, attributes={"controller": "simulated"},
    )  # fmt: skip


@pytest.mark.parametrize("suffix", [".h5", ".csv"])
def test_round_trip_loses_nothing_that_a_sensor_could_see(tmp_path, suffix):
    capture = _capture()
    write_capture(tmp_path / f"run{suffix}", capture)
    back = read_capture(tmp_path / f"run{suffix}")
    for name in ("time_s", "commanded_position_m", "motor_position_m", "desired_position_m",
                 "table_position_m", "torque_command_Nm"):  # fmt: skip
        np.testing.assert_allclose(getattr(back, name), getattr(capture, name), atol=1e-10)
    np.testing.assert_array_equal(back.extra["servo_cycle"], capture.extra["servo_cycle"])
    assert back.attributes["controller"] == "simulated"
    assert back.sample_period_s == pytest.approx(PERIOD_s, rel=1e-6)


def test_csv_begins_with_the_header_and_holds_numbers_only(tmp_path):
    write_capture(tmp_path / "run.csv", _capture().with_attributes(bench="[screw]\npitch_mm = 10"))
    with (tmp_path / "run.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert ",".join(rows[0]).startswith(
        "time_s,commanded_position_mm,motor_position_mm,table_position_mm,torque_command_Nm,"
        "desired_position_mm"
    )
    assert [float(row["table_position_mm"]) for row in rows] == pytest.approx(
        1e3 * _capture().table_position_m, abs=1e-7
    )
    assert read_capture(tmp_path / "run.csv").attributes["bench"] == "[screw]\npitch_mm = 10"


@pytest.mark.parametrize("beside", ["of another content", "{", '{"attributes": {"a": [1]}}', None])
def test_attributes_beside_a_csv_count_for_its_content_only(tmp_path, beside):
    write_capture(tmp_path / "run.csv", _capture())
    if beside == "of another content":
        (tmp_path / "run.csv").write_text((tmp_path / "run.csv").read_text().replace("0.1", "0.2"))
    elif beside is not None:
        sidecar_of(tmp_path / "run.csv").write_text(beside)
    else:
        sidecar_of(tmp_path / "run.csv").unlink()
    assert read_capture(tmp_path / "run.csv").attributes == {}
    assert holds_runs(tmp_path / "run.csv")


def test_a_file_of_others_beside_a_csv_is_not_replaced(tmp_path):
    sidecar_of(tmp_path / "run.csv").write_text('{"mine": 1}')
    with pytest.raises(CaptureError, match="holds no attributes"):
        write_capture(tmp_path / "run.csv", _capture())
    assert sidecar_of(tmp_path / "run.csv").read_text() == '{"mine": 1}'
    assert not (tmp_path / "run.csv").exists()
    write_capture(tmp_path / "b.csv", _capture())
    write_capture(tmp_path / "b.csv", _capture())
    assert kind_to_keep(sidecar_of(tmp_path / "b.csv")) == "file of attributes of a capture"


@pytest.mark.parametrize("suffix", [".h5", ".csv"])
def test_columns_of_others_keep_their_digits_and_no_unit_is_made_up(tmp_path, suffix):
    unix_s = 1764268803.444506 + np.arange(50) * PERIOD_s
    extra = {"unix_s": unix_s, "feed_mm_per_s": unix_s, "flow_per_s": unix_s, "pump_on": unix_s}
    write_capture(tmp_path / f"run{suffix}", replace(_capture(50), extra=extra))
    back = read_capture(tmp_path / f"run{suffix}")
    for values in back.extra.values():
        np.testing.assert_allclose(values, unix_s, rtol=0.0, atol=1e-6)
    if suffix == ".h5":
        with h5py.File(tmp_path / "run.h5") as file:
            units = {name: str(file[name].attrs["units"]) for name in extra}
        assert units == {"unix_s": "s", "feed_mm_per_s": "mm/s", "flow_per_s": "", "pump_on": ""}


def test_predictions_among_captures_are_named():
    assert predicted_remarks([_capture()]) == ()
    (told,) = predicted_remarks([_capture(), _capture().with_attributes(source=PREDICTED)])
    assert told.startswith("1 of 2 captures are predictions of a model, not measurements")


def test_hdf5_columns_carry_the_names_and_units_of_csv_files(tmp_path):
    write_capture(tmp_path / "run.h5", _capture())
    with h5py.File(tmp_path / "run.h5") as file:
        assert file["table_position_mm"].attrs["units"] == "mm"
        assert file["torque_command_Nm"].attrs["units"] == "N m"
        assert file["motor_position_mm"][0] == pytest.approx(1e-3)


def test_motor_only_captures_are_captures(tmp_path):
    (tmp_path / "a.csv").write_text(
        "time_s,commanded_position_mm,motor_position_mm\n0,0,0\n0.001,1,1\n0.002,2,2\n"
    )
    capture = read_capture(tmp_path / "a.csv")
    assert capture.table_position_m is None
    assert capture.motor_position_m[2] == pytest.approx(2e-3)


@pytest.mark.parametrize(
    ("text", "kind", "expected"),
    [
        ("time_s,commanded_position_mm\n0,0\n1,1\n", CaptureError, "motor_position_mm"),
        ("time_s,commanded_position_mm,motor_position_mm\n0,0,0\n1,nan,1\n2,2,2\n",
         CaptureError, "commanded_position_mm holds nan at sample 1"),
        ("time_s,commanded_position_mm,motor_position_mm\n0,0,0\n1,1,1\n2,2,2\n5,5,5\n6,6,6\n",
         SampleGap, "2 samples of"),
        ("time_s,commanded_position_mm,motor_position_mm\n0,0,0\n1,1,1\n1,1,1\n2,2,2\n3,2,2\n",
         SampleGap, "does not ascend: 1.000000 s follows 1.000000 s after sample 1"),
        ("time_s,commanded_position_mm,motor_position_mm\n0,0,0\n1,1,1\n2,2,2\n0,0,0\n1,1,1\n",
         SampleGap, "two runs are two files"),
        ("time_s,commanded_position_mm,motor_position_mm\n0,0,0\n1,x,1\n", CaptureError, "row 2"),
        ("time_s,commanded_position_mm,motor_position_mm\n0,0,0\n1,1\n", CaptureError, "row 2"),
        ("", CaptureError, "header"),
        ("time_s,commanded_position_mm,motor_position_mm\n0,0,0\n", CaptureError, "1 samples"),
        (",time_s,commanded_position_mm,motor_position_mm\n0,0,0,0\n", CaptureError, "no name"),
        ("time_s,commanded_position_mm,motor_position_mm,m/s\n0,0,0,0\n", CaptureError, "'m/s'"),
        ("time_s,time_s,motor_position_mm\n0,0,0\n", CaptureError, "twice"),
        ("time_s;commanded_position_mm;motor_position_mm\n0;0;0\n", CaptureError, "commas"),
    ],
)  # fmt: skip
def test_bad_csv_is_refused_with_the_place(tmp_path, text, kind, expected):
    (tmp_path / "bad.csv").write_text(text)
    with pytest.raises(kind) as caught:
        read_capture(tmp_path / "bad.csv")
    assert expected in str(caught.value)
    assert "bad.csv" in str(caught.value)


def test_attributes_are_read_as_a_spreadsheet_leaves_them(tmp_path):
    (tmp_path / "a.csv").write_text(
        "\ufeff# start = relaxed,,\n# servo_period_s = 0.001,,\n"
        "time_s,commanded_position_mm,motor_position_mm\n0,0,0\n0.001,1,1\n"
    )
    attributes = read_capture(tmp_path / "a.csv").attributes
    assert attributes == {"start": "relaxed", "servo_period_s": "0.001"}


def test_matrices_of_one_row_are_columns_as_matlab_writes_them(tmp_path):
    write_capture(tmp_path / "run.h5", _capture())
    with h5py.File(tmp_path / "run.h5") as file:
        columns = {name: file[name][()] for name in file}
    for shape in ((1, -1), (-1, 1)):
        with h5py.File(tmp_path / "matlab.h5", "w") as file:
            for name, values in columns.items():
                file[name] = values.reshape(shape)
        read, meant = (read_capture(tmp_path / name) for name in ("matlab.h5", "run.h5"))
        assert np.array_equal(read.motor_position_m, meant.motor_position_m)
    with h5py.File(tmp_path / "matlab.h5", "a") as file:
        file["picture_mm"] = np.zeros((2, 3))
    with pytest.raises(CaptureError, match="not a plain"):
        read_capture(tmp_path / "matlab.h5")


def test_samples_marked_not_valid_may_hold_nan(tmp_path):
    (tmp_path / "a.csv").write_text(
        "time_s,commanded_position_mm,motor_position_mm,valid\n0,0,0,1\n1,1,nan,0\n2,2,2,1\n"
    )
    assert read_capture(tmp_path / "a.csv").mask.tolist() == [True, False, True]


def test_columns_that_nothing_is_made_of_may_have_holes(tmp_path):
    """As pandas writes a thermometer that is read now and then, and truth in words."""
    path = tmp_path / "a.csv"
    heading = "time_s,commanded_position_mm,motor_position_mm,valid,"
    rows = "\n0,0,0,True,21.5\n1,1,,False,\n2,2,2,True,\n"
    path.write_text(heading + "temperature_C" + rows)
    capture = read_capture(path)
    assert capture.mask.tolist() == [True, False, True]
    np.testing.assert_array_equal(capture.extra["temperature_C"], [21.5, np.nan, np.nan])
    write_capture(tmp_path / "b.csv", capture)
    np.testing.assert_array_equal(
        read_capture(tmp_path / "b.csv").extra["temperature_C"], [21.5, np.nan, np.nan]
    )
    path.write_text(heading + "external_force_N" + rows)
    with pytest.raises(CaptureError, match="external_force_N holds nan at sample 2"):
        read_capture(path)


def test_links_in_hdf5_are_refused(tmp_path):
    write_capture(tmp_path / "run.h5", _capture())
    with h5py.File(tmp_path / "run.h5", "a") as file:
        file["other"] = h5py.ExternalLink("secret.h5", "/x")
    with pytest.raises(CaptureError, match="not a plain"):
        read_capture(tmp_path / "run.h5")


@pytest.mark.parametrize("name", ["a.h5", "a.mat", "a.txt"])
def test_files_that_are_no_captures_are_refused(tmp_path, name):
    (tmp_path / name).write_bytes(b"\x00\x01nonsense")
    with pytest.raises(CaptureError):
        read_capture(tmp_path / name)


def test_a_failed_write_leaves_the_old_capture(tmp_path, monkeypatch):
    target = tmp_path / "run.h5"
    write_capture(target, _capture(50))
    monkeypatch.setattr("pathlib.Path.write_bytes", _no_space)
    with pytest.raises(StorageFull, match="No space"):
        write_capture(target, _capture(100))
    assert read_capture(target).n == 50
    assert [p.name for p in tmp_path.iterdir()] == ["run.h5"]


def _no_space(*_):
    raise OSError(28, "No space left on device")


@pytest.mark.emps
def test_the_emps_record_is_read_where_it_lies(emps_file):
    capture = read_capture(emps_file)
    assert capture.n == 24841
    assert capture.sample_period_s == pytest.approx(1e-3, rel=1e-6)
    assert capture.table_position_m is None


@pytest.mark.parametrize("suffix", [".h5", ".csv"])
def test_a_run_is_told_from_what_can_be_computed_again(tmp_path, suffix):
    path = tmp_path / f"run{suffix}"
    assert not holds_runs(path)
    path.touch()
    assert not holds_runs(path)
    write_capture(path, _capture())
    assert holds_runs(path)
    write_capture(path, _capture().with_attributes(source=PREDICTED))
    assert not holds_runs(path)


@pytest.mark.parametrize(
    ("name", "content", "kept"),
    [
        ("damaged.h5", b"\x89HDF and no more", True),
        ("of_matlab.mat", b"anything", True),
        ("gap.csv", b"time_s,commanded_position_mm,motor_position_mm\n0,0,0\n1,nan,1\n9,2,2", True),
        ("command.csv", b"# note = none\ntime_s,commanded_position_mm\n0,0\n", False),
        ("remarks.csv", b"# only a remark", False),
        ("binary.csv", bytes(range(256)) * 1000, False),
        ("model.json", b"{}", False),
    ],
)
def test_what_may_be_a_run_is_taken_for_one(tmp_path, name, content, kept):
    (tmp_path / name).write_bytes(content)
    assert holds_runs(tmp_path / name) is kept


def test_a_folder_is_no_file_with_a_wrong_suffix(tmp_path):
    with pytest.raises(CaptureError, match="is a folder"):
        read_capture(tmp_path)
