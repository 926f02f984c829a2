"""A sign that was not measured is not told as measured; the first error of a test is kept."""

from collections.abc import Callable
from pathlib import Path

import pytest

from pmac_comp.base.errors import LinkLost
from pmac_comp.files.bench import load_bench, parse_bench
from pmac_comp.machine.controller.contents.table_set import read_tables
from pmac_comp.machine.controller.law.law_install import install_law
from pmac_comp.machine.controller.motors.motors import read_motor, require_stationary
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.capture.simulated import embedded, make_card
from pmac_comp.workflow.compensation.file import Compensation
from pmac_comp.workflow.controller import sign_test
from pmac_comp.workflow.controller.deploy import deploy
from pmac_comp.workflow.controller.sign_test import check_law_sign, check_table_sign
from tests.compensations import lead_map

# Sixteen times the counts of the paper's bench, the same loop in SI.
FINE = {
    "counts_per_rev = 10000.0": "counts_per_rev = 160000.0",
    "I130 = 139449": "I130 = 8716",
    "I111 = 32000": "I111 = 512000",
    "I112 = 16000": "I112 = 256000",
    "I113 = 305000": "I113 = 4880000",
    "I114 = -305000": "I114 = -4880000",
}


def test_tables_that_do_not_act_have_no_measured_sign(axis: Axis, tmp_path: Path) -> None:
    context = context_of(axis, tmp_path)
    deploy(axis, Compensation("table", CompensationLaw(), lead_map(20.0)), context)
    tables = tuple(read_tables(axis.link))
    (said,) = check_table_sign(axis, tables, context)
    assert said.startswith("sign of the tables measured at ")
    axis.link.command("I51=0")
    (said,) = check_table_sign(axis, tables, context)
    assert "their sign was not measured" in said
    assert "+0.0 um found" in said.replace("-0.0", "+0.0")


def test_a_link_that_dies_in_a_sign_test_is_the_error_that_is_told(
    axis: Axis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command: Callable[..., list[str]] = axis.link.command

    def dead(text: str, **options: float) -> list[str]:
        if text == "ENABLE PLC 0":
            raise LinkLost("second", code="PC-LNK-001")
        return command(text, **options)

    def first(_axis: Axis) -> None:
        raise LinkLost("first", code="PC-LNK-001")

    monkeypatch.setattr(axis.link, "command", dead)
    monkeypatch.setattr(sign_test, "_sign_against_friction", first)
    with pytest.raises(LinkLost, match="first") as told:
        check_law_sign(axis, context_of(axis, tmp_path))
    assert told.value.__notes__ == ["Cleaning up failed as well: second"]


def test_the_motor_stands_where_it_stood_when_its_sign_is_measured(tmp_path: Path) -> None:
    # Within its friction it stands away from there for some tenths of a second, and then goes back
    # by more counts than a standing motor may: arming the law was refused, the upload taken back.
    text = load_bench("paper").text
    for coarse, fine in FINE.items():
        text = text.replace(coarse, fine)
    bench = parse_bench(text)
    with embedded(make_card(bench)) as link:
        axis = Axis(link, bench, "test", simulated=True)
        axis.enable()
        context = context_of(axis, tmp_path)
        install_law(link, context, 1)
        before_ct = read_motor(link, 1).position_ct
        check_law_sign(axis, context)
        for _ in range(40):
            require_stationary(link, [1])
        assert read_motor(link, 1).position_ct == pytest.approx(before_ct, abs=100.0)
