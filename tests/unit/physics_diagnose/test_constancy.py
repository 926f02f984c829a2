"""A cause has the same size in every run; what imitates it has not."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pmac_comp.physics.diagnose import constancy
from pmac_comp.physics.diagnose.constancy import gain_apart, inconstant
from pmac_comp.physics.diagnose.gram import Gram, Prior

RUNS, ROWS = 6, 500
EFFECT = 0


def _gram(sizes: list[float], *, seed: int = 1) -> Gram:
    """Runs that ask for such sizes of the first column, at the optimum of one size for all."""
    rng = np.random.default_rng(seed)
    columns = rng.normal(size=(RUNS, ROWS, 3))
    seen = columns[:, :, EFFECT] * np.array(sizes)[:, None] + rng.normal(size=(RUNS, ROWS))
    step = np.linalg.lstsq(columns.reshape(-1, 3), seen.reshape(-1), rcond=None)[0]
    both = np.concatenate([columns, (seen - columns @ step)[:, :, None]], axis=2)
    free = np.full(3, np.inf)
    return Gram(
        np.einsum("rni,rnj->rij", both, both),
        np.ones(RUNS, dtype=np.bool_),
        np.full(RUNS, float(ROWS)),
        Prior(-free, free, np.zeros(3), free),
        np.arange(RUNS),
    )


def test_one_size_earns_nothing_by_being_let_differ():
    gain, sizes = gain_apart(_gram([1.0] * RUNS), [EFFECT])
    assert sizes == pytest.approx(RUNS - 1, abs=0.1)
    assert 0.0 < gain < 20.0  # chi-square of five sizes


def test_sizes_that_differ_earn_what_they_differ_by():
    sizes = [0.0, 2.0, 0.0, 2.0, 0.0, 2.0]
    gain, _ = gain_apart(_gram(sizes), [EFFECT])
    assert gain == pytest.approx(RUNS * ROWS * np.var(sizes), rel=0.15)


def test_a_run_that_says_nothing_of_a_size_does_not_count():
    gram = _gram([1.0] * RUNS)
    gram.blocks[2, EFFECT, :] = gram.blocks[2, :, EFFECT] = 0.0
    _, sizes = gain_apart(gram, [EFFECT])
    assert sizes == pytest.approx(RUNS - 2, abs=0.1)


@pytest.mark.parametrize(
    ("sizes", "earned", "apart"),
    [
        ([0.0, 2.0, 0.0, 2.0, 0.0, 2.0], 3000.0, True),
        ([0.9, 1.1, 0.9, 1.1, 0.9, 1.1], 3000.0, False),  # a model that idealises
        ([0.0, 2.0, 0.0, 2.0, 0.0, 2.0], 1e6, False),  # of something large
    ],
)
def test_an_effect_is_doubted_in_proportion_to_what_it_earns(monkeypatch, sizes, earned, apart):
    def without(_part: Any, _point: Any, *, rounds: int) -> Any:
        return SimpleNamespace(chi2=100.0 + earned)

    monkeypatch.setattr(constancy, "refit", without)
    monkeypatch.setattr(constancy, "evaluate", lambda part, model: None)
    told: Any = SimpleNamespace(
        gram=_gram(sizes),
        directions=[
            SimpleNamespace(run=None, label=name)
            for name in ("payload.mass_kg", "viscous.guide_Ns_per_m", "coulomb.guide_N")
        ],
        part=None,
        point=SimpleNamespace(chi2=100.0),
    )
    grown: Any = SimpleNamespace(
        accepted=(SimpleNamespace(effect="payload", fit_gain=earned),),
        final=SimpleNamespace(model=SimpleNamespace(without_effect=lambda name: None)),
    )
    assert inconstant(grown, told) == (frozenset({"payload"}) if apart else frozenset())
