"""What a fit of a bed must show: less of it where held-out samples judge it as well."""

from types import SimpleNamespace
from typing import Any

import pytest

from pmac_comp.physics.identify.swinging_bed import _HALF_SIGNIFICANT, _SIGNIFICANT, _swings


def fit(ratio: float, ratio_std: float, damping: float) -> Any:
    return SimpleNamespace(
        parameters={
            "base_mode.mass_ratio": SimpleNamespace(value=ratio, std=ratio_std),
            "base_mode.damping_ratio": SimpleNamespace(value=damping, std=0.01),
        }
    )


@pytest.mark.parametrize(
    ("ratio", "std", "damping", "half", "settled"),
    [
        (0.28, 0.07, 0.06, True, False),  # a counterweight on its chain, from half of the samples
        (0.45, 0.007, 0.06, True, True),  # the same from all of them
        (0.10, 0.05, 0.06, False, False),
        (0.45, 0.007, 0.30, False, False),  # that is no swinging
    ],
)
def test_a_bed_swings(
    ratio: float, std: float, damping: float, *, half: bool, settled: bool
) -> None:
    found = fit(ratio, std, damping)
    assert _swings(found, _HALF_SIGNIFICANT) is half
    assert _swings(found, _SIGNIFICANT) is settled
