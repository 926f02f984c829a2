"""PVT programs of benches with many counts keep within the digits that a listing shows."""

import pytest

from pmac_comp.files.bench import bundled_benches, load_bench
from pmac_comp.workflow.motion.campaigns import calibration_motions
from pmac_comp.workflow.motion.pvt import pvt_program

ON_A_CARD = [name for name in bundled_benches() if load_bench(name).controller.kind == "pmac"]


@pytest.mark.parametrize("bench_name", ON_A_CARD)
def test_no_number_has_more_digits_than_the_card_lists_back(bench_name):
    bench = load_bench(bench_name)
    for motion in calibration_motions(bench):
        points = [line[1:] for line in pvt_program(motion, bench).lines if line.startswith("X")]
        assert len(points) > 20
        for point in points:
            for number in point.split(":"):
                digits = number.lstrip("-").replace(".", "").lstrip("0")
                assert len(digits) <= 10, point
