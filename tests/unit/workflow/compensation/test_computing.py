"""What a compensation takes from the model at its end."""

from dataclasses import replace

import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.compensate.law import CompensationLaw, REST_UNWIND_per_s
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.workflow.compensation import computing
from pmac_comp.workflow.compensation.computing import compute_compensation

BENCH = load_bench("paper")
MODEL = DriveModel.base(BENCH)


def test_the_lag_at_rest_is_the_model_s(monkeypatch: pytest.MonkeyPatch) -> None:
    fitted = CompensationLaw(
        inertia_s2=2.2e-6,
        viscous_s=3.8e-6,
        coulomb_m=0.93e-6,
        torque_coulomb_Nm=0.5,
        torque_limit_Nm=10.0,
        lookahead_s=1.5e-3,
    )
    monkeypatch.setattr(computing, "_law_that_fits", lambda *_args, **_more: fitted)
    law = compute_compensation(BENCH, MODEL, route="law").law
    # Of the paper's drive: a law is computed for the model that it corrects, not for any. The hard
    # ends of moves leave as much of it as 8.31 per s would of all.
    assert law.rest_unwind_per_s == pytest.approx(9.86, rel=0.01)
    assert fitted.rest_unwind_per_s == REST_UNWIND_per_s == 9.05
    assert replace(law, rest_unwind_per_s=fitted.rest_unwind_per_s) == fitted
