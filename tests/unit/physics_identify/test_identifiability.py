"""What a fit says of parameters that the runs move together."""

import re
from dataclasses import replace

import numpy as np
import pytest

from pmac_comp.base.errors import NotIdentifiable
from pmac_comp.files.bench import load_bench
from pmac_comp.physics.identify.identifiability import require_identifiable, statements
from pmac_comp.physics.identify.output_error import Fit
from pmac_comp.physics.identify.regression import regress
from pmac_comp.physics.model.drive import DriveModel

MODEL = DriveModel.base(load_bench("paper"))
NAMES = ("coulomb.nut_Nm", "coulomb.motor_Nm", "coulomb.guide_N", "viscous.guide_Ns_per_m")


def fit_with(correlation: np.ndarray) -> Fit:
    """Fit of four parameters with unit scales and a correlation matrix."""
    one = np.ones(len(NAMES))
    return Fit(
        model=MODEL,
        names=NAMES,
        covariance=1e-6 * correlation,
        information=np.eye(len(NAMES)),
        prior=one,
        scales=one,
        nuisance=np.zeros(0),
        freedom=np.full(len(NAMES), 50.0),
        rounds=1,
        step=0.0,
    )


def test_a_pair_is_named_with_the_run_that_separates_it() -> None:
    correlation = np.eye(4)
    correlation[0, 1] = correlation[1, 0] = -0.97
    text = statements(fit_with(correlation))
    assert len(text) == 1
    assert "coulomb.nut_Nm and coulomb.motor_Nm cannot be told apart on these runs" in text[0]
    assert "an added mass or a side load would" in text[0]


def test_a_group_is_one_sentence() -> None:
    # One direction that nothing determines ties all pairs of its parameters: six sentences of it.
    text = statements(fit_with(np.full((4, 4), 0.99) + 0.01 * np.eye(4)))
    assert len(text) == 1
    assert "coulomb.guide_N and viscous.guide_Ns_per_m cannot be told apart" in text[0]


def test_what_is_told_apart_is_not_mentioned() -> None:
    assert statements(fit_with(np.eye(4))) == ()


def test_a_refusal_speaks_of_friction_and_not_of_regressors() -> None:
    rng = np.random.default_rng(1)
    one = np.ones(200)
    columns = np.column_stack([rng.normal(size=200), -one, one])
    with pytest.raises(NotIdentifiable, match="Coulomb friction and the static error") as caught:
        regress(
            ("speed", "direction", "static0"),
            columns,
            one,
            block=10,
            advice={"direction": "slow runs in both directions"},
        )
    assert "static0" not in str(caught.value)
    assert "slow runs in both directions" in str(caught.value.hint)


def fit_with_viscous_std(std: float) -> Fit:
    """Fit that misfit has pushed to hardly any viscous friction, known to what the runs excite."""
    scales = np.array([0.2, 0.2, 45.0, 200.0])
    return replace(
        fit_with(np.eye(4)),
        model=MODEL.with_parameters({"viscous.guide_Ns_per_m": 4.0}),
        information=np.diag((scales / np.array([0.001, 0.001, 1.0, std])) ** 2),
        prior=np.zeros(4),
        scales=scales,
    )


def test_a_friction_that_something_unnamed_pushed_to_nothing_is_no_less_determined() -> None:
    # 30 N s/m of 200 that are usual: the runs tell it, whatever value a gap leaves of it.
    require_identifiable(fit_with_viscous_std(30.0), has_torque=True)
    with pytest.raises(NotIdentifiable, match="viscous friction of the guide"):
        require_identifiable(fit_with_viscous_std(200.0), has_torque=True)


def test_viscous_friction_that_no_run_of_this_bench_could_tell_is_said_and_not_refused() -> None:
    fit, fastest = fit_with_viscous_std(200.0), MODEL.bench.usable_speed_m_per_s
    with pytest.raises(NotIdentifiable, match="viscous friction of the guide"):
        require_identifiable(fit, has_torque=True, speed_m_per_s=0.3 * fastest)
    (text,) = require_identifiable(fit, has_torque=True, speed_m_per_s=0.7 * fastest)
    assert "viscous friction of the guide is not determined" in text
    assert re.search(r"bends the drive by up to [\d.]+ um", text)


def test_damping_that_no_bench_file_states_is_not_told_as_a_value_of_the_bench_file() -> None:
    names = ("chain.table_mass_kg", "chain.damping_time_s")
    spec = MODEL.spec(names[1])

    def fit(std: float, damping_s: float) -> Fit:
        return replace(
            fit_with(np.eye(4)),
            model=MODEL.with_parameters({names[1]: damping_s}),
            names=names,
            covariance=np.diag([1e-6, std**2]),
            scales=np.array([1e-3, 0.3 * spec.nominal]),
            prior=np.ones(2),
        )

    assert statements(fit(1e-7, 3.4 * spec.nominal)) == (
        "These values rest mainly on the bench file, not on the captures: table_mass_kg.",
    )
    assert (
        "damping_time_us rests mainly on what is usual"
        in statements(fit(0.3 * spec.nominal, spec.nominal))[-1]
    )
