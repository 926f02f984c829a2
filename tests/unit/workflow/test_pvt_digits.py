"""PVT programs of benches with many counts keep within the digits that a listing shows."""

import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.workflow.campaigns import calibration_motions
from pmac_comp.workflow.pvt import pvt_program


@pytest.mark.parametrize("bench_name", ["paper", "paper_x4"])
def test_no_number_has_more_digits_than_the_card_lists_back(bench_name):
    bench = load_bench(bench_name)
    for motion in calibration_motions(bench):
        for line in pvt_program(motion, bench).lines:
            if line.startswith("X"):
                for number in line[1:].split(":"):
                    digits = number.lstrip("-").replace(".", "").lstrip("0")
                    assert len(digits) <= 10, line
