"""What no name explains is not called nothing because friction might excuse it."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pmac_comp.physics.diagnose import remainder
from pmac_comp.physics.diagnose.remainder import _shaped, remainder_of

EXCUSED_um = 0.1


def test_shapes_of_an_onset_explain_no_more_than_they_may():
    shape = np.sin(np.linspace(0.0, 20.0, 400))[:, None] * 1e-7
    small, large = 2.0 * shape[:, 0], 9.0 * shape[:, 0]
    assert np.allclose(_shaped(small, shape, 3.0), small, atol=1e-12)
    assert np.allclose(_shaped(large, shape, 3.0), large / 3.0, atol=1e-12)


@pytest.mark.parametrize(
    ("gap_um", "plain_um", "accepted", "told_um"),
    [
        (1.0, 0.7, (), 0.7),
        (0.7, 0.5, (), None),  # a little more than the floor
        (0.8, 0.7, ("backlash",), None),  # beside a name that is told, and no doubt of it
        (1.0, 0.7, ("backlash",), 0.9165),  # held-out runs refute the name
        (1.0, 0.5, ("presliding",), None),  # fitted as well they are met: no name is refuted
        (1.0, 0.7, ("presliding",), 0.7),
    ],
)
def test_twice_the_floor_is_unknown_whatever_might_excuse_it(
    monkeypatch, gap_um, plain_um, accepted, told_um
):
    rivals = SimpleNamespace(rival_gain=0.0, rival_drop=np.zeros(30), rows_fit=1e4)
    done = SimpleNamespace(screening=rivals, rows_fit=1e4, rows_judge=5e3)
    drive = SimpleNamespace(motor_resolution_m=1e-6)
    onset = SimpleNamespace(bench=drive, parameters={"presliding.distance_m": 5e-8})
    point = SimpleNamespace(blocks=np.zeros(30), model=onset)
    effects = [SimpleNamespace(effect=name) for name in accepted]
    grown: Any = SimpleNamespace(
        rounds=(done,), rivals=rivals, workbench=None, base=point, final=point, accepted=effects
    )
    monkeypatch.setattr(remainder, "noise_floor_um", lambda *a, **k: 0.4)
    monkeypatch.setattr(remainder, "ambient_m2", lambda *a: 0.0)
    monkeypatch.setattr(remainder, "_rms_um", lambda *a: gap_um)
    monkeypatch.setattr(remainder, "_onset_um", lambda *a: 0.3)
    monkeypatch.setattr(remainder, "_left_out", lambda *a: 0.0)
    monkeypatch.setattr(remainder, "_regions", lambda *a: ())
    monkeypatch.setattr(remainder, "_material_wave", lambda *a: None)
    monkeypatch.setattr(remainder, "_material_place", lambda *a: None)
    monkeypatch.setattr(
        remainder, "_excess_um", lambda *a: (EXCUSED_um, 0.5 * EXCUSED_um, plain_um, gap_um)
    )
    bench: Any = None
    left = remainder_of(grown, bench)
    assert left.unexplained == (told_um is not None)
    assert left.excess_um == pytest.approx(told_um or EXCUSED_um, abs=1e-4)
    assert left.missed == (accepted == ("backlash",) and gap_um > 0.9)
