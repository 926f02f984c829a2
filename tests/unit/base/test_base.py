"""Errors, clocks, arrays and atomic files."""

from pathlib import Path

import numpy as np
import pytest

from pmac_comp.base import errors
from pmac_comp.base.arrays import finite_array
from pmac_comp.base.atomic import atomic_write_bytes
from pmac_comp.base.clock import Deadline, VirtualClock


def test_exit_codes_are_those_of_the_contract():
    codes = {
        errors.ConfigError: 2, errors.ConnectFailed: 3, errors.RemoteProtocolError: 4,
        errors.CommandRefused: 5, errors.LeaseHeld: 6, errors.VerifyMismatch: 7,
        errors.GatherOverflow: 8, errors.NotIdentifiable: 9, errors.InternalError: 70,
    }  # fmt: skip
    assert {kind: kind.exit_code for kind in codes} == codes


def test_error_text_says_what_happened_what_is_left_and_what_to_do():
    error = errors.UploadIncomplete(
        "Link lost after entry 57.", code="PC-TBL-012", hint="Run `pmac-comp recover`.",
        left=errors.ControllerState.DISABLED,
    )  # fmt: skip
    assert str(error).splitlines() == [
        "Link lost after entry 57. (PC-TBL-012)",
        "The controller was left: DISABLED.",
        "Run `pmac-comp recover`.",
    ]


def test_all_refusals_are_shown_at_once():
    parts = (errors.AmplitudeExceeded("80 um"), errors.MotorNotSafe("motor 1 moves"))
    text = str(errors.SafetyRefusal("2 refusals", refusals=parts))
    assert "80 um" in text
    assert "motor 1 moves" in text


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_non_finite_values_are_named_with_their_index(bad):
    with pytest.raises(errors.NonFinite, match=r"speed holds .* at index 2"):
        finite_array("speed", [0.0, 1.0, bad])


@pytest.mark.parametrize("bad", [[], [[1.0]], ["a"], [1j], [object()]])
def test_arrays_of_the_wrong_kind_are_refused(bad):
    with pytest.raises(errors.ModelError, match="speed"):
        finite_array("speed", bad)


def test_a_deadline_is_total_not_per_step():
    clock = VirtualClock(10.0)
    deadline = Deadline.after(clock, 1.0)
    clock.sleep_s(0.75)
    assert deadline.remaining_s() == pytest.approx(0.25)
    clock.sleep_s(0.75)
    assert deadline.expired()
    assert deadline.remaining_s() == 0.0


def test_an_interrupted_write_leaves_the_old_file_and_no_litter(tmp_path: Path, monkeypatch):
    target = tmp_path / "model.json"
    target.write_bytes(b"old")

    def broken(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pmac_comp.base.atomic.os.fsync", broken)
    with pytest.raises(OSError, match="No space"):
        atomic_write_bytes(target, b"new")
    assert target.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["model.json"]
