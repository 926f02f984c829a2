"""Names that an effect at the corner of its range does not deserve."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.diagnose import claims
from pmac_comp.physics.diagnose.claims import Claims, claims_of, named_alone, unreached
from pmac_comp.physics.diagnose.contenders import Rules
from pmac_comp.physics.diagnose.estimates import pulled
from pmac_comp.physics.diagnose.growth import Grown
from pmac_comp.physics.diagnose.imitations import as_true_name, imitation, true_name
from pmac_comp.physics.diagnose.result import Estimate, Finding
from pmac_comp.physics.model.drive import DriveModel, simulate

BENCH = load_bench("paper")
SIZED = SimpleNamespace(start=SimpleNamespace(linear=False))  # does not vanish at zero


@pytest.mark.parametrize(("ratio", "share"), [(0.0, 0.02), (0.02, 0.25)])
def test_a_soft_zone_without_stiffness_and_the_backlash_that_it_is_move_alike(ratio, share):
    values = {"half_width_m": 3e-6, "stiffness_ratio": ratio}
    corner = DriveModel.base(BENCH).with_effect("preload_loss", values)
    same = as_true_name("preload_loss", corner)
    assert same.parameters["backlash.gap_m"] == pytest.approx(6e-6, rel=0.03)
    assert not any(name.startswith("preload_loss") for name in same.effects)
    time_s = BENCH.servo_period_s * np.arange(4000)
    command = 10e-3 * (1.0 - np.cos(4.0 * np.pi * time_s))
    one, other = (simulate(m, command).mechanical_error_m for m in (corner, same))
    plain = simulate(DriveModel.base(BENCH), command).mechanical_error_m
    assert np.std(one - other) < share * np.std(one - plain)


@pytest.mark.parametrize(("first_um", "imitated"), [(2.4, True), (0.25, False)])
def test_an_imitation_that_outlived_what_closed_the_gap_is_not_nothing(first_um, imitated):
    # Backlash closed the gap in the first round and was not needed beside the soft zone of the
    # second, which closed little of what was left then.
    zone = SimpleNamespace(effect="preload_loss", fit_gain=1e5, gap_um=0.22)
    gone = SimpleNamespace(accepted=None, gap_um=first_um, floor_um=0.2, rows_fit=1e4)
    kept = SimpleNamespace(accepted=zone, gap_um=0.24, floor_um=0.2, rows_fit=1e4)
    last = SimpleNamespace(accepted=None, gap_um=0.22, floor_um=0.2, rows_fit=1e4)
    model = DriveModel.base(BENCH).with_effect("preload_loss", {"stiffness_ratio": 0.0})
    grown: Any = SimpleNamespace(
        rounds=(gone, kept, last), accepted=(zone,), final=SimpleNamespace(model=model)
    )
    left: Any = SimpleNamespace(unexplained=False, visible=False, open_share=0.0, missed=False)
    found = claims_of(grown, left, (), Rules())
    assert found.effects == ()
    assert found.imitated is imitated


@pytest.mark.parametrize("unexplained", [False, True])
def test_a_size_that_is_not_determined_is_claimed_only_where_nothing_is_left(unexplained):
    # On a drive whose coupling has play, presliding and skew lean on one another: both close much
    # and the size of neither is known.
    skew = SimpleNamespace(
        effect="channel_skew",
        key="channel_skew",
        fit_gain=1e9,
        gap_um=0.5,
        screened=SimpleNamespace(start=SimpleNamespace(linear=True)),
    )
    done = SimpleNamespace(
        accepted=skew,
        gap_um=2.0,
        floor_um=0.2,
        rows_fit=1e4,
        screening=SimpleNamespace(rival_gain=0.0),
    )
    model = DriveModel.base(BENCH).with_effect("channel_skew", {"time_s": -2.7e-6})
    size = Estimate("channel_skew.time_us", -2.7, "us", 9.0, -20.0, 15.0)
    grown: Any = SimpleNamespace(
        rounds=(done,), accepted=(skew,), final=SimpleNamespace(model=model)
    )
    left: Any = SimpleNamespace(
        unexplained=unexplained, explained=True, visible=False, open_share=0.0, missed=False
    )
    found = claims_of(grown, left, (size,), Rules())
    assert found.effects == (() if unexplained else ("channel_skew",))


@pytest.mark.parametrize(
    ("effect", "own", "corner"),
    [
        (
            "cable_drag",
            {"stiffness_N_per_m": 250.0, "centre_m": 0.1},
            {"stiffness_N_per_m": -10.0, "centre_m": 10.0},
        ),
        ("preload_loss", {"stiffness_ratio": 0.3}, {"stiffness_ratio": 0.0}),
        ("base_mode", {"damping_ratio": 0.05}, {"damping_ratio": 1.0}),
        ("viscous_nonlinear", {"exponent": 0.5}, {"exponent": 0.99}),
        ("viscous_nonlinear", {"exponent": 2.0}, {"exponent": 1.01}),
        ("post_reversal_dip", {"length_m": 1e-3}, {"length_m": 2e-5}),
        ("presliding", {"distance_m": 5e-6}, {"distance_m": 3e-7}),
        ("thermal_growth", {"time_constant_s": 5.0}, {"time_constant_s": 0.05}),
    ],
)
def test_an_effect_at_the_corner_of_its_range_is_another_one(effect, own, corner):
    base = DriveModel.base(BENCH)
    assert imitation(effect, base.with_effect(effect, own)) == ""
    assert imitation(effect, base.with_effect(effect, corner)) != ""


def test_effects_without_such_a_corner_are_themselves():
    assert imitation("payload", DriveModel.base(BENCH).with_effect("payload")) == ""


def test_a_far_cable_is_told_by_its_true_name_and_a_near_one_by_its_own():
    base = DriveModel.base(BENCH)
    far = base.with_effect("cable_drag", {"stiffness_N_per_m": -10.0, "centre_m": 10.0})
    near = base.with_effect("cable_drag", {"stiffness_N_per_m": 250.0, "centre_m": 0.1})
    assert true_name("cable_drag", far) == "bias_force"
    assert true_name("cable_drag", near) == ""
    assert true_name("payload", base.with_effect("payload")) == ""


FINDING = Finding("chain.motor_inertia_kgm2", 6e-4, 5.45e-4, 0.03, "inertia is outside")


@pytest.mark.parametrize(
    ("visible", "findings", "claimed"),
    [
        (True, (FINDING,), ()),  # it takes a wrong bench file, and even so something is left
        (True, (), ("payload",)),
        (False, (FINDING,), ("payload",)),  # two causes, and nothing is left
    ],
)
def test_a_name_that_needs_the_bench_file_to_be_wrong_must_explain_all(visible, findings, claimed):
    accepted = SimpleNamespace(effect="payload", fit_gain=1e5, gap_um=0.2)
    done: Any = SimpleNamespace(accepted=accepted, rows_fit=1e4, gap_um=5.0, floor_um=0.1)
    grown: Any = SimpleNamespace(
        rounds=(done,),
        accepted=(accepted,),
        final=SimpleNamespace(model=DriveModel.base(BENCH).with_effect("payload")),
    )
    left: Any = SimpleNamespace(unexplained=False, visible=visible, open_share=0.0, missed=False)
    found = claims_of(grown, left, (), Rules(), findings)
    assert found.effects == claimed
    assert all("motor_inertia" in why for why in found.withheld.values())


@pytest.mark.parametrize("apart", [frozenset(), frozenset({"payload"})])
def test_an_effect_of_another_size_in_every_run_is_claimed_by_nobody(apart):
    accepted = SimpleNamespace(effect="payload", fit_gain=1e5, gap_um=0.2)
    done: Any = SimpleNamespace(accepted=accepted, rows_fit=1e4, gap_um=5.0, floor_um=0.1)
    model = DriveModel.base(BENCH).with_effect("payload")
    grown: Any = SimpleNamespace(
        rounds=(done,), accepted=(accepted,), final=SimpleNamespace(model=model)
    )
    left: Any = SimpleNamespace(unexplained=False, visible=False, open_share=0.0, missed=False)
    found = claims_of(grown, left, (), Rules(), apart=apart)
    assert found.effects == (() if apart else ("payload",))
    assert found.imitated == bool(apart)
    assert all("from run to run" in why for why in found.withheld.values())


@pytest.mark.parametrize(
    ("missed", "count", "claimed"), [(True, 3, 1), (True, 2, 2), (False, 3, 3)]
)
def test_of_many_effects_that_foretell_no_run_the_small_ones_are_stand_ins(missed, count, claimed):
    # The first closes most of what it met, as Coulomb friction does on a real axis.
    steps = (("payload", 5.0, 0.8), ("backlash", 0.8, 0.6), ("base_mode", 0.6, 0.4))[:count]
    accepted = tuple(
        SimpleNamespace(effect=n, fit_gain=1e5, gap_um=after, screened=SIZED)
        for n, _, after in steps
    )
    rounds: Any = tuple(
        SimpleNamespace(accepted=a, rows_fit=1e4, gap_um=before, floor_um=0.1)
        for a, (_, before, _) in zip(accepted, steps, strict=True)
    )
    model = DriveModel.base(BENCH)
    for name, _, _ in steps:
        model = model.with_effect(name)
    final = SimpleNamespace(model=model)
    grown: Any = SimpleNamespace(rounds=rounds, accepted=accepted, final=final)
    left: Any = SimpleNamespace(
        unexplained=missed, visible=missed, explained=True, open_share=0.0, missed=missed
    )
    assert len(claims_of(grown, left, (), Rules()).effects) == claimed


def test_a_finding_beside_a_remainder_says_what_may_have_moved_it():
    (moved,) = pulled((FINDING,))
    assert moved.text.startswith(FINDING.text)
    assert "no name" in moved.text
    assert moved.value == FINDING.value


@pytest.mark.parametrize(
    ("compliance", "unexplained", "claimed"),
    [(1.5e-3, True, ()), (1.5e-3, False, ("coupling_windup",)), (1e-5, True, ("coupling_windup",))],
)
def test_a_stiffness_out_of_tolerance_that_leaves_something_is_no_finding(
    compliance, unexplained, claimed
):
    # A scale on a bracket of 170 Hz lags with the acceleration, most of which a coupling ten times
    # as soft as stated makes up for.
    soft = SimpleNamespace(effect="coupling_windup", fit_gain=1e5, gap_um=0.21, screened=SIZED)
    done = SimpleNamespace(accepted=soft, gap_um=0.63, floor_um=0.09, rows_fit=1e4)
    done.screening = SimpleNamespace(rival_gain=1e3)
    model = DriveModel.base(BENCH).with_effect(
        "coupling_windup", {"compliance_rad_per_Nm": compliance}
    )
    grown: Any = SimpleNamespace(
        rounds=(done,), accepted=(soft,), final=SimpleNamespace(model=model)
    )
    left: Any = SimpleNamespace(
        unexplained=unexplained, visible=True, explained=True, open_share=0.05, missed=False
    )
    found = claims_of(grown, left, (), Rules())
    assert found.effects == claimed
    assert ("torsional_stiffness" in " ".join(found.withheld.values())) is not bool(claimed)


@pytest.mark.parametrize("place", ["centre", "beyond"])
def test_a_corner_that_no_run_crosses_carries_no_name(place):
    def grown(half_width_m: float, largest_N: float) -> Any:
        values = {"half_width_m": half_width_m, "stiffness_ratio": 0.5}
        model = DriveModel.base(BENCH).with_effect(f"preload_loss@{place}", values)
        response = SimpleNamespace(joint_force_N=np.array([0.01 * largest_N, -largest_N]))
        record = SimpleNamespace(response=lambda _model: response)
        return SimpleNamespace(
            final=SimpleNamespace(model=model), workbench=SimpleNamespace(records=[record])
        )

    assert unreached(grown(1e-6, 700.0)) == {}
    within = unreached(grown(23e-6, 700.0))
    assert within.keys() == {"preload_loss"}
    beyond = unreached(grown(0.0, 700.0))
    assert beyond.keys() == ({"preload_loss"} if place == "beyond" else set())
    # Of bearing and nut as stated, 211 and 180 N/um, the nut is half as stiff.
    halved = within if place == "centre" else beyond
    assert "stiffness: 63.1 N/um of bearing and nut in series" in halved["preload_loss"]
    assert "axial_stiffness_N_per_um = 97.14;" in halved["preload_loss"]
    plain: Any = SimpleNamespace(final=SimpleNamespace(model=DriveModel.base(BENCH)))
    assert unreached(plain) == {}


@pytest.mark.parametrize(
    ("order", "ends"),
    [
        (("payload", "cable_drag"), True),
        (("payload",), False),  # all that is in the model is claimed
        (("cable_drag", "payload"), False),  # never fitted alone
    ],
)
def test_sizes_of_named_effects_are_taken_without_what_is_not_claimed(monkeypatch, order, ends):
    model, accepted = DriveModel.base(BENCH), []
    for name in order:
        model = model.with_effect(name, {"mass_kg": 12.0} if name == "payload" else {})
        fitted = SimpleNamespace(model=model)
        accepted.append(SimpleNamespace(effect=name, key=name, fitted=fitted))
    rounds: Any = tuple(SimpleNamespace(accepted=a) for a in accepted)
    claimed = tuple(r for r in rounds if r.accepted.effect == "payload")
    withheld = {name: "why" for name in order if name != "payload"}
    bench: Any = SimpleNamespace(fitting_bench=lambda: None)
    grown = Grown(bench, accepted[0].fitted, accepted[-1].fitted, rounds, {"payload.mass_kg": 1.0})
    monkeypatch.setattr(claims, "evaluate", lambda _bench, m: SimpleNamespace(model=m))
    monkeypatch.setattr(claims, "refit", lambda _part, point, rounds: point)
    alone = named_alone(grown, Claims(claimed, withheld, imitated=False))
    assert (alone is not None) == ends
    if alone is not None:
        assert alone.final.model is accepted[0].fitted.model
        assert [c.effect for c in alone.accepted] == ["payload"]
        assert not alone.open_SI


@pytest.mark.parametrize(("skew_us", "claimed"), [(-0.9, False), (-3.0, True), (0.9, True)])
def test_a_coupling_whose_lag_by_speed_a_skew_takes_back_is_none(skew_us, claimed):
    # A scale head that tilts by 0.25 um per m/s2 got both names, each well determined.
    rounds = []
    for name in ("coupling_windup", "channel_skew"):
        item = SimpleNamespace(
            effect=name,
            key=name,
            fit_gain=1e9,
            gap_um=0.1,
            screened=SimpleNamespace(start=SIZED.start),
        )
        screening = SimpleNamespace(rival_gain=0.0)
        rounds.append(
            SimpleNamespace(
                accepted=item, gap_um=0.2, floor_um=0.07, rows_fit=1e4, screening=screening
            )
        )
    model = (
        DriveModel.base(BENCH)
        .with_effect("coupling_windup", {"compliance_rad_per_Nm": 5e-4})
        .with_effect("channel_skew", {"time_s": 1e-6 * skew_us})
    )
    size = Estimate("channel_skew.time_us", skew_us, "us", 0.2, skew_us - 0.4, skew_us + 0.4)
    grown: Any = SimpleNamespace(
        rounds=tuple(rounds),
        accepted=tuple(r.accepted for r in rounds),
        final=SimpleNamespace(model=model),
    )
    left: Any = SimpleNamespace(
        unexplained=False, explained=True, visible=False, open_share=0.0, missed=False
    )
    found = claims_of(grown, left, (size,), Rules())
    assert found.effects == (("coupling_windup", "channel_skew") if claimed else ())
    assert found.imitated is not claimed
    assert all("0.31 um per m/s2" in why for why in found.withheld.values())
