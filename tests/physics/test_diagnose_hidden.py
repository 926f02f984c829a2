"""Hidden effects are found, clean data stays clean, what has no name is called unknown.

A small run: short captures and a part of the library. Rates over hundreds of cases are measured by
``tools/acceptance/diagnose_hidden.py``.
"""

import json

import numpy as np
import pytest

from pmac_comp.base.errors import NotIdentifiable
from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.diagnose import Diagnosis, diagnose
from pmac_comp.physics.model.effect import effect_library
from tests.generators.hidden_effects import make_case

BENCH = load_bench("paper")
NEAR = (
    "backlash",
    "payload",
    "bias_force",
    "friction_asymmetry",
    "lead_cyclic",
    "encoder_eccentricity",
    "lead_linear",
    "scale_slope",
    "channel_skew",
    "cogging",
)


def run(hidden: list[str], seed: int, without: tuple[str, ...] = ()) -> tuple[Diagnosis, dict]:
    case = make_case(BENCH, hidden, seed=seed, seconds=3.0)
    library = {name: effect_library()[name] for name in NEAR if name not in without}
    found = diagnose(
        [case.fit[i] for i in (0, 1, 2, 4, 5)],
        BENCH,
        validate=[case.judge[i] for i in (0, 1)],
        effects=library,
    )
    return found, dict(case.hidden)


@pytest.fixture(scope="module")
def clean() -> Diagnosis:
    return run([], 5)[0]


def test_clean_data_gets_no_name(clean):
    assert clean.verdict == "none"
    assert clean.named == ()
    assert clean.gap_after_um == clean.gap_before_um
    assert clean.gap_after_um < 1.2 * clean.noise_floor_um


def test_a_payload_is_found_although_mass_has_a_tolerance():
    found, hidden = run(["payload"], 6)
    assert (found.verdict, found.named) == ("named", ("payload",))
    mass = next(e for e in found.estimates if e.name == "payload.mass_kg")
    assert mass.value == pytest.approx(hidden["payload"]["mass_kg"], abs=9.0)
    assert found.gap_after_um < 1.4 * found.noise_floor_um
    assert found.gap_before_um > 2.0 * found.gap_after_um


@pytest.mark.slow
def test_a_wobble_of_the_screw_is_told_from_an_eccentric_encoder():
    found, hidden = run(["lead_cyclic"], 7)
    assert found.named[0] == "lead_cyclic" or {"lead_cyclic"} <= set(found.tied[0])
    amplitude = next(e for e in found.estimates if e.name.endswith("amplitude_um"))
    assert amplitude.value == pytest.approx(hidden["lead_cyclic"]["amplitude_um"], rel=0.05)
    assert found.where[0].coordinate == "screw_angle"


def test_exact_twins_are_a_tie_with_the_experiment_that_separates_them():
    found, _ = run(["scale_slope"], 8)
    assert found.verdict == "tie"
    assert set(found.tied[0]) == {"lead_linear", "scale_slope"}
    assert set(found.named[:2]) == {"lead_linear", "scale_slope"}
    assert found.separating_experiment is not None
    assert "laser" in found.separating_experiment.text


def test_an_effect_out_of_the_library_is_unknown_and_described():
    found, _ = run(["lead_cyclic"], 9, without=("lead_cyclic", "encoder_eccentricity"))
    assert found.verdict == "unknown"
    assert found.residual
    assert any("without a name" in line for line in found.statements)


def test_the_answer_is_plain_json(clean):
    text = json.dumps(clean.to_json(), allow_nan=False)
    answer = json.loads(text)
    for key in ("verdict", "named", "tied", "evidence", "where", "gap_before_um", "gap_after_um"):
        assert key in answer
    assert answer["separating_experiment"] is None


def test_no_capture_and_a_standing_axis_are_refused():
    with pytest.raises(NotIdentifiable, match="no capture"):
        diagnose([], BENCH)
    time = BENCH.servo_period_s * np.arange(4000)
    still = Capture(time, np.zeros(4000), np.zeros(4000), table_position_m=np.zeros(4000))
    with pytest.raises(NotIdentifiable, match="does not move"):
        diagnose([still], BENCH)


@pytest.mark.slow
def test_five_hidden_effects_are_found_one_after_another() -> None:
    hidden = ["lead_cyclic", "cogging", "bias_force", "external_force", "scale_subdivision"]
    bench = load_bench("paper_x4")
    case = make_case(bench, hidden, seed=7, seconds=3.0, quiet=True)
    beside = ("backlash", "payload", "friction_asymmetry", "torque_ripple", "encoder_eccentricity")
    library = {name: effect_library()[name] for name in (*hidden, *beside)}
    found = diagnose(case.fit[:4], bench, validate=case.judge[:2], effects=library)
    assert found.verdict == "named"
    assert sorted(found.named) == sorted(hidden)
    assert found.gap_after_um < 1.1 * found.noise_floor_um < 0.05 * found.gap_before_um
