"""Samples of a run that is cut off are on the disk, and a capture is made from them."""

from pathlib import Path

import numpy as np
import pytest

from pmac_comp.base.errors import CaptureError, ConfigError, StorageFull
from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import read_capture
from pmac_comp.machine.controller.gather.capture_log import CaptureLog
from pmac_comp.workflow.capture import capturing
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.capturing import CapturePlan, capture_to_folder, recover_to_folder
from pmac_comp.workflow.capture.run_log import RunLog, capture_of_log, new_log
from pmac_comp.workflow.motion.motions import parse_motion

BENCH = load_bench("paper")
MOTION = parse_motion("trapezoid:distance_mm=5", BENCH)
PLAN = CapturePlan(BENCH, (MOTION,))


def test_a_run_and_its_log_hold_the_same(axis: Axis, tmp_path: Path) -> None:
    axis.run_log = new_log(tmp_path, "run")
    measured = axis.run(MOTION)
    recovered, found = capture_of_log(tmp_path / "run.log", load_bench("paper_x4"))
    assert found.is_complete
    assert found.gaps == ()
    assert recovered.valid is None
    assert recovered.attributes["bench_text"] == BENCH.text
    assert "recovered" in str(recovered.attributes["source"])
    begins = int(np.flatnonzero(np.diff(recovered.commanded_position_m))[0])
    first = begins - int(np.flatnonzero(np.diff(measured.commanded_position_m))[0])
    part = slice(first, first + measured.n)
    for name in (
        "commanded_position_m",
        "desired_position_m",
        "motor_position_m",
        "table_position_m",
        "torque_command_Nm",
    ):
        assert np.array_equal(getattr(recovered, name)[part], getattr(measured, name)), name


def test_a_log_of_lost_samples_marks_them(tmp_path: Path) -> None:
    log = CaptureLog.create(tmp_path / "run.log", {"motion": "m"})
    for cycles in ([10, 11, 12], [15, 16]):
        values = np.array(cycles, dtype=np.int64)
        log.append({"commanded": values, "actual": values, "servo_cycle": values})
    log.abandon()
    capture, found = capture_of_log(tmp_path / "run.log", BENCH)
    assert not found.is_complete
    assert capture.mask.tolist() == [True] * 3 + [False] * 2 + [True] * 2
    assert capture.time_s[-1] == pytest.approx(6 * BENCH.servo_period_s)


def test_a_log_without_samples_is_no_capture(tmp_path: Path) -> None:
    CaptureLog.create(tmp_path / "run.log", {}).close()
    with pytest.raises(CaptureError, match="holds no samples"):
        capture_of_log(tmp_path / "run.log", BENCH)


def test_a_run_that_cannot_be_stored_is_kept_in_its_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise StorageFull("no room")

    monkeypatch.setattr(capturing, "write_capture", full)
    with pytest.raises(StorageFull) as caught:
        capture_to_folder("sim://", "paper", PLAN, tmp_path)
    (log,) = tmp_path.iterdir()
    assert str(log) in "".join(caught.value.__notes__)
    monkeypatch.undo()
    result = recover_to_folder(log, "paper", tmp_path)
    assert read_capture(result["file"]).n == result["samples"] > 1000
    with pytest.raises(ConfigError, match="earlier capture"):
        recover_to_folder(log, "paper", tmp_path)


def test_ctrl_c_keeps_what_was_gathered(tmp_path: Path) -> None:
    def progress(step: str, fraction: float) -> None:
        del step
        if fraction > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as stop:
        capture_to_folder("sim://", "paper", PLAN, tmp_path, progress=progress)
    (log,) = tmp_path.iterdir()
    assert str(log) in stop.value.__notes__[-1]
    capture, found = capture_of_log(log, BENCH)
    assert found.reason == "interrupted"
    assert np.ptp(capture.motor_position_m) > 50e-6  # the wiggle before the motion at least


def test_a_whole_run_leaves_its_file_only_and_is_not_written_over(tmp_path: Path) -> None:
    done = capture_to_folder("sim://", "paper", PLAN, tmp_path)
    assert list(tmp_path.iterdir()) == done["files"]
    assert done["samples"] == sum(read_capture(path).n for path in done["files"])
    before = done["files"][0].read_bytes()
    with pytest.raises(ConfigError, match="earlier capture"):
        capture_to_folder("sim://", "paper", PLAN, tmp_path)
    assert done["files"][0].read_bytes() == before


def test_logs_that_earlier_runs_left_stay(tmp_path: Path) -> None:
    (tmp_path / "run.log").write_bytes(b"kept")
    assert new_log(tmp_path, "run").path == tmp_path / "run_2.log"
    assert RunLog().kept() == ""
