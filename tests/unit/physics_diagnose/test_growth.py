"""Rules of the growth loop that need no data."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pmac_comp.physics.diagnose import contenders, growth, revision
from pmac_comp.physics.diagnose.acceptance import Round
from pmac_comp.physics.diagnose.contenders import Contender
from pmac_comp.physics.diagnose.diagnose import _broken_off
from pmac_comp.physics.diagnose.growth import Grown
from pmac_comp.physics.diagnose.records import Gap
from pmac_comp.physics.diagnose.refit import Frozen
from pmac_comp.physics.diagnose.result import Estimate
from pmac_comp.physics.diagnose.revision import Reviser, _start
from pmac_comp.physics.diagnose.words import Story, _size, statements_of
from pmac_comp.physics.model.effect import effect_library


@pytest.mark.parametrize("effect", ["coulomb", "viscous"])
def test_elementary_friction_is_never_taken_out_again(effect):
    # Nothing may be simulated: where it were, the missing workbench would show.
    done = SimpleNamespace(accepted=SimpleNamespace(effect=effect))
    reviser = Reviser(None, {}, contenders.Rules(), print)  # type: ignore[arg-type]
    assert reviser._without(None, done) is None  # type: ignore[arg-type]


def test_a_name_that_was_in_the_model_is_looked_for_in_the_last_round_that_tried_it():
    # Backlash stood in the model when a soft zone was added, and left it then.
    rounds = [
        SimpleNamespace(screening=SimpleNamespace(starts=starts))
        for starts in ({"backlash": ("first",)}, {"payload": ("x",)}, {"backlash": ("last", "y")})
    ]
    assert _start("backlash", rounds[0], rounds) == "first"  # type: ignore[arg-type]
    assert _start("backlash", rounds[1], rounds) == "last"  # type: ignore[arg-type]
    assert _start("cogging", rounds[1], rounds) is None  # type: ignore[arg-type]


@pytest.mark.parametrize(("fit_gain", "asked"), [(100.0, True), (1e5, False)])
def test_the_only_effect_is_asked_whether_it_is_needed_unless_it_earned_beyond_doubt(
    monkeypatch, fit_gain, asked
):
    whole, less = SimpleNamespace(), SimpleNamespace()
    monkeypatch.setattr(Reviser, "_without", lambda self, whole, done, shared: less)
    reviser = Reviser(None, {}, contenders.Rules(), lambda text: None)  # type: ignore[arg-type]
    accepted = SimpleNamespace(effect="actuator_delay", fit_gain=fit_gain)
    bare = Round(None, None, (), accepted, (), 3e4, 1e4, 1.0, 0.1)  # type: ignore[arg-type]
    kept, (done,) = reviser.pruned(whole, [bare])  # type: ignore[arg-type]
    assert kept is (less if asked else whole)
    assert (done.accepted is None) == asked


def _accepted(effect: str) -> Contender:
    return Contender(effect, effect, None, None, 1e5, 1e5, 1e-9, 1e5, 0.4)  # type: ignore[arg-type]


@pytest.mark.parametrize(("more", "tied"), [(1.0, ("backlash",)), (40.0, ())])
def test_play_lost_by_a_far_start_is_a_tie_where_it_does_as_well_at_the_size_of_the_soft_zone(
    monkeypatch, more, tied
):
    # Both scatter alike from block to block; on the mean the play leaves a little or much more.
    scatter = 30.0 * np.cos(np.arange(50.0) * 2.4)
    zone = _accepted("preload_loss")
    play = SimpleNamespace(effect="backlash", fitted=SimpleNamespace(blocks=scatter + more))
    whole = SimpleNamespace(
        model=SimpleNamespace(effects=("coulomb", "preload_loss@centre")), blocks=np.zeros(50)
    )
    screening = SimpleNamespace(starts={"backlash": ("far",)})
    done = Round(None, screening, (zone,), zone, (), 3e3, 1e3, 1.2, 0.2)  # type: ignore[arg-type]
    monkeypatch.setattr(Reviser, "_instead", lambda self, *a: (play, done))
    monkeypatch.setattr(revision, "earned", lambda *a: True)
    monkeypatch.setattr(
        revision, "Ground", SimpleNamespace(of=lambda *a: SimpleNamespace(rows=np.full(50, 20.0)))
    )
    reviser = Reviser(None, {}, contenders.Rules(), lambda text: None)  # type: ignore[arg-type]
    (after,) = reviser.likened(whole, [done])  # type: ignore[arg-type]
    assert after.tied == tied
    assert (play in after.contenders) == bool(tied)


@pytest.mark.parametrize(
    ("by_shared", "by_own", "rounds"),
    [(40.0, 30.0, ["shared"]), (25.0, 18.0, ["shared", "own"])],
    ids=["plainly", "open"],
)
def test_columns_of_the_whole_model_tell_an_effect_that_is_plainly_needed(
    monkeypatch, by_shared, by_own, rounds
):
    # An effect that explained 100 and of which the others give back all but so much.
    taken = []

    def refitted(part, begun, *, frozen=None, rounds):
        taken.append("own" if frozen is None else "shared")
        return SimpleNamespace(chi2=10.0 + (by_own if frozen is None else by_shared))

    monkeypatch.setattr(revision, "refit", refitted)
    monkeypatch.setattr(revision, "evaluate", lambda part, model: SimpleNamespace(chi2=110.0))
    model = SimpleNamespace(without_effect=lambda effect: None)
    whole = SimpleNamespace(model=model, chi2=10.0)
    done = SimpleNamespace(accepted=SimpleNamespace(effect="cogging"), rows_fit=1.0)
    bench = SimpleNamespace(fitting_bench=lambda: None)
    reviser = Reviser(bench, {}, contenders.Rules(), print)  # type: ignore[arg-type]
    shared = Frozen((SimpleNamespace(),), [])  # type: ignore[arg-type]
    assert reviser._without(whole, done, shared) is None  # type: ignore[arg-type]
    assert taken == rounds


@pytest.mark.parametrize(
    ("std", "told"),
    [(0.1, "fraction = -0.3 +/- 0.2"), (0.4, "fraction is not determined by these runs")],
)
def test_a_size_that_the_runs_leave_open_is_not_told_as_a_figure(std, told):
    estimate = Estimate("friction_asymmetry.fraction", -0.3, "1", std, -1.0, 1.0)
    assert _size(estimate) == told


def _screened(name: str, gain: float) -> SimpleNamespace:
    return SimpleNamespace(start=SimpleNamespace(effect=name), fit_gain=gain, heldout_gain=0.0)


def test_a_late_current_loop_is_tried_where_a_delay_leads_although_no_linear_step_foretells_it():
    ranked = [
        _screened("actuator_delay", 5000.0),
        _screened("stribeck", 900.0),
        _screened("torque_saturation", -10.0),
        _screened("current_bandwidth", -8000.0),
    ]
    screening = SimpleNamespace(
        ranked=ranked, starts={item.start.effect: (item,) for item in ranked}
    )
    chosen = contenders.leaders(screening, 1000.0, effect_library(), contenders.Rules())  # type: ignore[arg-type]
    names = [item.start.effect for item in chosen]
    assert names == ["actuator_delay", "stribeck", "current_bandwidth"]


def test_the_partner_is_not_tried_where_neither_of_the_pair_leads():
    ranked = [_screened("stribeck", 900.0), _screened("current_bandwidth", -8000.0)]
    screening = SimpleNamespace(
        ranked=ranked, starts={item.start.effect: (item,) for item in ranked}
    )
    chosen = contenders.leaders(screening, 1000.0, effect_library(), contenders.Rules())  # type: ignore[arg-type]
    assert [item.start.effect for item in chosen] == ["stribeck"]


def _told(
    before: tuple[float, float],
    after: tuple[float, float],
    named: tuple[str, ...],
    *,
    regions: tuple[SimpleNamespace, ...] = (),
    where: tuple[SimpleNamespace, ...] = (),
    settled_um: float = 9.0,
    forms: tuple[str, ...] = (),
) -> str:
    left = SimpleNamespace(
        noise_floor_um=0.1,
        visible=bool(regions),
        unexplained=False,
        excess_um=0.0,
        settled_um=settled_um,
        calm=SimpleNamespace(left_out=0.0),
        regions=regions,
    )
    verdict = "named" if named else "none"
    story = Story(
        verdict,
        named,
        (),
        (),
        where,
        Gap(*before),
        Gap(*after),
        left,
        (),
        effect_library(),
        {},  # type: ignore[arg-type]
        forms=forms,
    )
    return " ".join(statements_of(story))


def test_what_lives_in_the_torque_is_told_there():
    told = _told((0.353, 0.2), (0.353, 0.1), ("bias_force",))
    assert "torque, whose gap falls from 0.2 to 0.1 N m" in told
    assert "falls from 0.353" not in told
    assert "gap falls from 0.353 to 0.1 um" in _told((0.353, 0.2), (0.1, 0.1), ("backlash",))


def test_the_place_or_the_side_of_its_corner_is_told_of_an_effect_that_has_several():
    """A nut whose half lifts off beyond a force was described as soft around it or beyond it."""
    gaps = (0.4, 0.1), (0.1, 0.1)
    told = _told(*gaps, ("cogging", "preload_loss"), forms=("cogging", "preload_loss@beyond"))
    assert "or larger beyond it), in the grown model as preload_loss@beyond." in told
    assert told.count("in the grown model as") == 1
    assert "in the grown model as" not in _told(*gaps, ("cogging",), forms=("cogging",))


def test_twice_the_noise_floor_is_not_called_noise():
    assert "what is left is noise" in _told((0.12, 0.1), (0.12, 0.1), ())
    assert "2.1 times the noise floor" in _told((0.21, 0.1), (0.21, 0.1), ())


def test_what_other_known_values_close_is_told_as_open_and_not_as_noise():
    open_ones = _told((0.7, 0.1), (0.7, 0.1), (), settled_um=0.11)
    assert "but 0.11 um where the runs that judge are fitted as well" in open_ones
    assert "leave parameters open" not in _told((0.7, 0.1), (0.7, 0.1), (), settled_um=0.65)


def test_what_is_seen_beside_nothing_missing_is_told_as_not_proved():
    ringing = SimpleNamespace(describe=lambda: "table residual rings")
    told = _told((0.13, 0.1), (0.13, 0.1), (), regions=(ringing,))
    assert "what is left is noise" not in told
    assert "Not proved beyond noise: table residual rings." in told
    assert "Left: table residual rings." in _told(
        (0.9, 0.1), (0.13, 0.1), ("backlash",), regions=(ringing,)
    )


def test_what_a_name_leaves_beyond_the_floor_is_told():
    assert "1.8 times the noise floor" in _told((1.85, 0.1), (0.18, 0.1), ("backlash",))
    assert "times the noise floor" not in _told((1.85, 0.1), (0.11, 0.1), ("backlash",))


def test_a_search_that_ended_with_its_last_effect_says_so():
    found: Any = SimpleNamespace(accepted=(1, 2))
    assert _broken_off(found, contenders.Rules()) == ()
    (said,) = _broken_off(found, contenders.Rules(most_effects=2))
    assert "--model" in said


def test_what_repeats_is_not_called_noise_and_told_with_where_it_is_that_large():
    """1 um was called too small beside a gap of 0.18 um: where the axis rests, at 1.63 N m."""
    seen = SimpleNamespace(
        channel="table", coordinate="force", unit="N m", size_um=1.04, low=1.628, high=1.644,
        describe=lambda: "seen",
    )  # fmt: skip
    told = _told((0.1, 0.1), (0.1, 0.1), (), where=(seen,))
    assert "over force, at most 1 um, between 1.628 and 1.644 N m) is too little of it" in told
    assert "left is noise" not in told


def _looked(gain: float) -> Any:
    return SimpleNamespace(rival_gain=gain, frozen=None)


def test_rivals_are_those_beside_the_onset_that_the_final_model_holds():
    # What they earned beside friction that sets in at once, the onset may have taken.
    done: Any = SimpleNamespace(screening=_looked(5e3))
    nothing: Any = None
    grown = Grown(nothing, nothing, nothing, (done,))
    assert grown.rivals.rival_gain == 5e3
    assert replace(grown, beside_onset=_looked(2e2)).rivals.rival_gain == 2e2


def test_a_model_with_an_onset_is_asked_anew_where_rounding_decides_and_what_rivals_earn(
    monkeypatch,
):
    # Calm and bare: as before the onset was in the model.
    bench = SimpleNamespace(calm="bare", fitting_bench=lambda: bench)
    calmed = SimpleNamespace(calm="onset", fitting_bench=lambda: calmed)
    done: Any = SimpleNamespace(accepted=None, screening=_looked(5e3))

    def fitted(effects: tuple[str, ...]) -> Any:
        return SimpleNamespace(model=SimpleNamespace(effects=effects))

    bare, gripping = fitted(("coulomb",)), fitted(("coulomb", "presliding@all"))
    same = {
        "first_noise": lambda bench, model: bench,
        "refit": lambda bench, start, rounds: start,
        "evaluate": lambda bench, model: SimpleNamespace(model=model, chi2=1.0),
        "_look_around": lambda bench, point, library, seen: (bench, point, done.screening, None),
        "_round": lambda *a: done,
        "_slim": lambda done: done,
        "with_onset": lambda bench, point: gripping,
        "Reviser": lambda *a: SimpleNamespace(pruned=lambda whole, rounds: (whole, rounds)),
        "_calmed": lambda bench, model: calmed if model is gripping.model else bench,
        "freed": lambda bench, point: SimpleNamespace(model=point.model, on=bench.calm),
        "not_outgrown": lambda bench, point: point,
        "_rivals_of": lambda bench, model: _looked(2e2 if bench is calmed else 1e3),
    }
    for name, stand_in in same.items():
        monkeypatch.setattr(growth, name, stand_in)
    start: Any = bare.model
    grown = growth.grow(bench, start, {}, contenders.Rules(), lambda text: None)  # type: ignore[arg-type]
    assert grown.workbench is calmed
    assert grown.final.on == "onset"  # type: ignore[attr-defined]
    assert grown.rivals.rival_gain == 2e2


@pytest.mark.parametrize(
    ("replaced", "rounds"), [(0, 3), (1, 4)], ids=["all-stay", "one-is-replaced"]
)
def test_an_effect_that_a_later_one_replaced_takes_no_other_effects_place(
    monkeypatch, replaced, rounds
):
    # Two are sought. One that left the model again had used up its round, and the last one that
    # earned its place, a bias beside seven others, was turned away.
    bench = SimpleNamespace(fitting_bench=lambda: bench)
    model = SimpleNamespace(effects=("coulomb",))
    point = SimpleNamespace(model=model, chi2=1.0)

    def found(*anything: Any) -> Round:
        accepted = SimpleNamespace(effect="any", fitted=point)
        return Round(point, None, (), accepted, (), 1.0, 1.0, 1.0, 0.1)  # type: ignore[arg-type]

    def pruned(whole: Any, done: list[Round]) -> tuple[Any, list[Round]]:
        gone = done[:replaced] if len(done) > replaced else []
        return whole, [*(replace(d, accepted=None) for d in gone), *done[len(gone) :]]

    same = {
        "first_noise": lambda bench, model: bench,
        "refit": lambda bench, start, rounds: start,
        "evaluate": lambda bench, model: point,
        "settled": lambda bench, start: (start, {}),
        "_look_around": lambda bench, point, library, seen: (bench, point, None, None),
        "_round": found,
        "_slim": lambda done: done,
        "with_onset": lambda bench, point: point,
        "Reviser": lambda *a: SimpleNamespace(
            renamed=lambda whole, done: (whole, done),
            widened=lambda whole, done: (whole, done),
            pruned=pruned,
            likened=lambda whole, done: done,
        ),
    }
    for name, stand_in in same.items():
        monkeypatch.setattr(growth, name, stand_in)
    rules = contenders.Rules(most_effects=2)
    grown = growth.grow(bench, model, {}, rules, lambda text: None)  # type: ignore[arg-type]
    assert len(grown.rounds) == rounds
    assert len(grown.accepted) == 2
