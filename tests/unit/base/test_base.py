"""Errors, clocks, arrays and atomic files."""

import re
from pathlib import Path

import numpy as np
import pytest

from pmac_comp.base import errors
from pmac_comp.base.arrays import finite_array
from pmac_comp.base.atomic import atomic_write_bytes
from pmac_comp.base.clock import Deadline, VirtualClock


def test_exit_codes_are_those_of_the_readme():
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


def test_all_refusals_are_shown_at_once_and_general_advice_once():
    parts = (
        errors.AmplitudeExceeded("80 um"),
        errors.MotorNotSafe("motor 1 moves", hint="Wait until it stands."),
    )
    text = str(errors.SafetyRefusal("2 refusals", refusals=parts))
    assert "80 um" in text
    assert "motor 1 moves (PC-SAF-000)\n    Wait until it stands." in text
    assert text.count(errors.SafetyRefusal.usual_advice) == 1


def _kinds(root: type[errors.PmacCompError] = errors.PmacCompError):
    return [kind for child in root.__subclasses__() for kind in (child, *_kinds(child))]


@pytest.mark.parametrize("kind", [k for k in _kinds() if k is not errors.InternalError])
def test_an_error_raised_with_a_message_alone_still_has_a_code_and_advice(kind):
    error = kind("It happened.")
    assert error.code in str(error)
    assert str(error).endswith(error.usual_advice)
    assert error.usual_advice
    assert error.hint == ""  # callers that know better may fill it in


def test_a_code_belongs_to_one_package_only():
    package = Path(errors.__file__).parents[1]
    found: dict[str, set[str]] = {}
    whole = re.compile(r"^(workflow|machine/controller|physics/identify)/.*")  # with their folders
    for path in package.rglob("*.py"):
        place = whole.sub(r"\1", path.relative_to(package).parent.as_posix())
        for code in re.findall(r"code=\"(PC-[A-Z]+-\d{3})\"", path.read_text(encoding="utf-8")):
            found.setdefault(code, set()).add(place)
    assert len(found) > 200
    assert {code: where for code, where in found.items() if len(where) > 1} == {}


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
