"""Where candidates are tried from."""

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.diagnose.candidates import starts_of
from pmac_comp.physics.diagnose.spectra import Peaks
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.effect import effect_library


@pytest.mark.parametrize("largest_torque_Nm", [0.8, 5.4, 18.0])
def test_a_torque_limit_is_tried_below_the_largest_torque_asked_for(largest_torque_Nm):
    bench = load_bench("paper")
    effect = effect_library()["torque_saturation"]
    peaks = Peaks(largest_torque_Nm=largest_torque_Nm)
    starts = starts_of(effect, DriveModel.base(bench), bench, peaks)
    limits = [start.values["limit_Nm"] for start in starts]
    assert max(limits) == pytest.approx(0.995 * largest_torque_Nm)
    assert min(limits) < 0.5 * largest_torque_Nm
    # The value itself is judged: no share of it, and no multiple.
    assert all(d.lower == d.upper == 1.0 for start in starts for d in start.directions)


def test_every_bed_that_may_swing_begins_near_a_start():
    """From 20 Hz no refit finds a hardly damped bed of 14 Hz: a line in time was named for it."""
    starts = [s["frequency_Hz"] for s in effect_library()["base_mode"].starts]
    for frequency_Hz in np.geomspace(7.5, 69.0, 50):
        assert min(abs(np.log(s / frequency_Hz)) for s in starts) < np.log(7.0 / 6.0)
