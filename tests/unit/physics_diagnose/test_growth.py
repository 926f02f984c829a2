"""Rules of the growth loop that need no data."""

from types import SimpleNamespace

import pytest

from pmac_comp.physics.diagnose import growth
from pmac_comp.physics.diagnose.result import Estimate
from pmac_comp.physics.diagnose.words import _size


@pytest.mark.parametrize("effect", ["coulomb", "viscous"])
def test_elementary_friction_is_never_taken_out_again(effect):
    # Nothing may be simulated: where it were, the missing workbench would show.
    done = SimpleNamespace(accepted=SimpleNamespace(effect=effect))
    assert growth._without(None, None, done, {}, growth.Rules()) is None  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("std", "told"),
    [(0.1, "fraction = -0.3 +/- 0.2"), (0.4, "fraction is not determined by these runs")],
)
def test_a_size_that_the_runs_leave_open_is_not_told_as_a_figure(std, told):
    estimate = Estimate("friction_asymmetry.fraction", -0.3, "1", std, -1.0, 1.0)
    assert _size(estimate) == told
