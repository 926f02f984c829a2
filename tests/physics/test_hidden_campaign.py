"""The campaign of hidden effects: what is hidden, how large it is, and how answers are scored.

A few cases only; hundreds are run by ``tools/acceptance/diagnose_hidden.py``.
"""

import ast
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.model.effect import effect_library
from tests.generators.effects import EFFECTS, NOT_HIDDEN, truth_of
from tests.generators.hidden_effects import make_case, surroundings
from tests.generators.motions import campaign, judging_campaign
from tests.generators.sizing import Sizing
from tools.acceptance import diagnose_hidden as harness
from tools.acceptance.diagnose_scores import (
    both,
    print_report,
    ratio,
    reason,
    right,
    settled,
    wrong,
)

BENCH = load_bench("paper")
GENERATORS = Path(__file__).resolve().parents[1] / "generators"


def test_every_effect_of_the_library_is_hidden_or_has_a_reason_not_to_be() -> None:
    assert set(EFFECTS) | set(NOT_HIDDEN) == set(effect_library())
    assert not set(EFFECTS) & set(NOT_HIDDEN)


def test_the_code_that_makes_the_data_shares_nothing_with_the_fitted_model() -> None:
    paths = sorted(GENERATORS.glob("*.py"))
    assert {"effects.py", "hidden_effects.py", "motions.py"} <= {path.name for path in paths}
    for path in paths:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        names = {n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}
        names |= {a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}
        shared = [n for n in names if n and n.startswith(("pmac_comp.physics", "pmac_comp.work"))]
        assert not shared, path


@pytest.mark.parametrize(
    ("name", "target"), [("bias_force", 4.0), ("lead_cyclic", 15.0), ("payload", 6.0)]
)
def test_an_effect_gets_the_size_that_was_asked_for(name: str, target: float) -> None:
    case = make_case(BENCH, [name], seed=3, over_noise=[target], seconds=3.0)
    assert case.ratios[name] == pytest.approx(target, rel=0.12)
    assert case.noise_um > 0.03  # the scale's step alone makes 0.036 um


def test_the_size_counts_only_what_a_refit_of_the_base_cannot_absorb() -> None:
    around = surroundings(5, 1.0, quiet=True)
    fit, judge = campaign(BENCH, 5, seconds=3.0), judging_campaign(BENCH, 5, seconds=3.0)
    sizing = Sizing(BENCH, around, fit, judge)
    inside = sizing.ratio({"payload": {"mass_kg": 0.02 * 122.86}})
    beyond = sizing.ratio({"payload": {"mass_kg": 0.30 * 122.86}})
    assert inside < 0.5  # within the 5 % to which the mass is known
    assert beyond > 20.0 * inside


def test_jitter_and_force_are_repeatable_and_differ_between_runs() -> None:
    one, two = (make_case(BENCH, [], seed=7, seconds=1.0) for _ in range(2))
    for a, b in zip(one.fit, two.fit, strict=True):
        assert np.array_equal(a.table_position_m, b.table_position_m)
    quiet = make_case(BENCH, [], seed=7, seconds=1.0, quiet=True)
    assert not np.array_equal(quiet.fit[0].table_position_m, one.fit[0].table_position_m)
    errors = [c.table_position_m - c.extra["true_table_position_m"] for c in one.fit[:2]]
    assert abs(np.corrcoef(*errors)[0, 1]) < 0.3


def test_hidden_values_are_told_in_the_meaning_of_the_library() -> None:
    truth = truth_of("coupling_windup", {"stiffness_Nm_per_rad": 5000.0})
    assert truth == {"compliance_rad_per_Nm": 2e-4}
    assert truth_of("chain_damping", {"time_us": 290.0}, damping_time_us=73.0)["time_us"] == 217.0
    assert truth_of("presliding", {"distance_um": 9.0, "place": "nut", "elements": 0.0}) == {
        "distance_um": 9.0
    }


def row(
    kind: str, hidden: list[str], named: list[str], verdict: str, **rest: Any
) -> dict[str, Any]:
    return {
        "kind": kind,
        "seed": 1,
        "bench": "paper",
        "hidden": {name: {} for name in hidden},
        "over_noise": dict.fromkeys(hidden, 5.0),
        "generator_noise_um": 0.1,
        "left_out": [],
        "named": named,
        "tied": [],
        "verdict": verdict,
        "gap_before_um": 1.0,
        "gap_after_um": 0.1,
        "noise_floor_um": 0.1,
        "parameter": None,
        "left": [],
        "cpu_s": 1.0,
        "seconds": 2.0,
        "peak_memory_MB": 400.0,
        "evidence": [],
        **rest,
    }


def test_a_justified_tie_counts_and_another_one_does_not() -> None:
    twins = ["lead_linear", "scale_slope"]
    assert right(row("hidden", ["scale_slope"], twins, "tie", tied=[twins]))
    loose = ["payload", "scale_slope"]
    assert not right(row("hidden", ["scale_slope"], loose, "tie", tied=[loose]))
    assert wrong(row("hidden", ["scale_slope"], loose, "tie", tied=[loose]))


def test_a_name_beside_unknown_is_right_but_not_settled_and_a_wrong_one_stays_wrong() -> None:
    beside = row("hidden", ["backlash"], ["backlash"], "unknown")
    assert right(beside)
    assert not settled(beside)
    assert wrong(row("hidden", ["backlash"], ["cogging"], "unknown"))
    assert not both(row("pair", ["backlash", "cogging"], ["backlash"], "named"))


def test_the_report_prints_every_aim_and_explains_what_it_missed(
    capsys: pytest.CaptureFixture[str],
) -> None:
    lost = [
        ["cogging", 1, "lost", 3.0, 5.0, 0.5, 0.9],
        ["payload", 1, "chosen", 9.0, 9.0, 0.0, 0.2],
    ]
    found = {
        "name": "payload.mass_kg",
        "truth": 10.0,
        "value": 10.4,
        "lower95": 9.0,
        "upper95": 12.0,
    }
    rows = [
        row(
            "hidden",
            ["payload"],
            ["payload"],
            "named",
            parameter=found,
            over_noise={"payload": 8.0},
        ),
        row("hidden", ["cogging"], ["payload"], "named", evidence=lost),
        row("clean", [], [], "none"),
        row("left-out", ["backlash"], [], "unknown", left_out=["backlash"]),
        row("pair", ["backlash", "cogging"], ["cogging", "backlash"], "named"),
    ]
    print_report(rows)
    text = capsys.readouterr().out
    assert "first name right, 3 to 20 times the noise: 1/2 = 50.0 % (95 %: 9.5 .. 90.5)" in text
    assert "parameter within 5 % above 6 times the noise: 1/1" in text
    assert "both of two found: 1/1" in text
    assert "left out of the library: unknown: 1/1" in text
    assert "cases that miss their aim: 1" in text
    assert "cogging lost the refit: held-out gain 3 against 9 of payload" in text
    assert ratio(rows[0]) == 8.0
    assert "not in the library" in reason({**rows[3], "evidence": []})


def test_a_campaign_is_resumed_and_its_rows_are_whole(tmp_path: Path) -> None:
    out = tmp_path / "rows.jsonl"
    harness.work(("hidden", 5, 2.0, out))
    assert harness.read(out)[0]["hidden"].keys() == {"bias_force"}
    first = harness.read(out)[0]
    assert first["named"][:1] == ["bias_force"]
    assert first["generator_noise_um"] > 0.0
    assert 50.0 < first["peak_memory_MB"] < 2000.0
    assert first["parameter"]["truth"] == pytest.approx(first["parameter"]["value"], rel=0.2)
    harness.main(["run", "--out", str(out), "--kind", "hidden", "--first", "5", "--cases", "1"])
    assert len(harness.read(out)) == 1
