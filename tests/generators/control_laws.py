"""The paper's control law stated in other forms than I-variables."""

import math

from pmac_comp.files.bench import Bench, load_bench, parse_bench

PAPER = load_bench("paper")
# The physical form of the paper's gains (K_P 23.7 N m/rad and so on), per mm of table travel.
_PER_MM = 2 * math.pi / 10.0
SI = f"""
[controller.si]
Kp_Nm_per_mm = {23.7 * _PER_MM}
Ki_Nm_per_mm_s = {298.0 * _PER_MM}
Kd_Nm_s_per_mm = {0.227 * _PER_MM}
Kvff_Nm_s_per_mm = {0.2295 * _PER_MM}
Kaff_Nm_s2_per_mm = {1.112e-3 * _PER_MM}
"""


def other_law(kind: str, table: str) -> Bench:
    """The paper's bench with its clock, its law stated in another form."""
    head, tail = PAPER.text.split("[controller.ivariables]")
    rest = tail[tail.index("[travel]") :]
    return parse_bench(head.replace('kind = "pmac"', f'kind = "{kind}"') + table + rest)
