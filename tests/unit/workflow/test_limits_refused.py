"""What is said where a correction passes the limits: which way out there is for which route."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from pmac_comp.base.errors import AmplitudeExceeded
from pmac_comp.physics.compensate.exact import Aim
from pmac_comp.workflow import computing
from pmac_comp.workflow.computing import compensate_files

MOTION = "sine:amplitude_mm=12,frequency_Hz=3.5"


@pytest.mark.parametrize(
    ("route", "aim", "offers_less"),
    [
        ("cam", Aim.TOTAL, True),
        ("program", Aim.TOTAL, True),
        ("cam", Aim.MECHANICAL, False),
        ("law", Aim.TOTAL, False),
    ],
)
def test_a_motion_cut_by_the_limit_offers_the_smaller_aim(
    monkeypatch, tmp_path, route: str, aim: Aim, offers_less: object
) -> None:
    drive = SimpleNamespace(effects=())
    monkeypatch.setattr("pmac_comp.workflow.identification.load_model", lambda *a, **k: drive)
    monkeypatch.setattr(computing, "check_amplitude", lambda *a: None)
    monkeypatch.setattr(computing, "compute_compensation", lambda *a, **k: "cut")
    monkeypatch.setattr(computing, "limits_report", lambda *a: ["26.0 % of the motion is cut"])
    out = tmp_path / "c.json"
    with pytest.raises(AmplitudeExceeded, match=r"26\.0 %") as refused:
        compensate_files("paper", Path("m.json"), out, route=route, command=MOTION, aim=aim)
    assert ("--aim mechanical" in refused.value.hint) is offers_less
    assert not out.exists()
