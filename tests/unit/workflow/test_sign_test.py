"""A sign that was not measured is not told as measured; the first error of a test is kept."""

from collections.abc import Callable
from pathlib import Path

import pytest

from pmac_comp.base.errors import LinkLost
from pmac_comp.machine.controller.contents.table_set import read_tables
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.compensation.file import Compensation
from pmac_comp.workflow.controller import sign_test
from pmac_comp.workflow.controller.deploy import deploy
from pmac_comp.workflow.controller.sign_test import check_law_sign, check_table_sign
from tests.compensations import lead_map


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
