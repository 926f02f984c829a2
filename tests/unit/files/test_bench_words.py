"""Every key of a bench file is described where a user looks."""

from collections.abc import Iterator

import pytest
from pydantic import BaseModel

from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.workflow.bench.view import bench_rows


def undescribed(model: type[BaseModel], prefix: str = "") -> Iterator[str]:
    for name, field in model.model_fields.items():
        kinds = [field.annotation, *getattr(field.annotation, "__args__", ())]
        tables = [k for k in kinds if isinstance(k, type) and issubclass(k, BaseModel)]
        if tables:
            yield from undescribed(tables[0], f"{prefix}{name}.")
        elif not field.description and name != "text":
            yield prefix + name


def test_every_key_has_a_description() -> None:
    assert list(undescribed(Bench)) == []


@pytest.mark.parametrize("name", ["paper", "emps"])
def test_config_show_tells_what_each_key_is(name: str) -> None:
    rows = bench_rows(load_bench(name))
    assert len(rows) > 40
    assert [row[0] for row in rows if not row[3] and row[1] is not None] == []


def test_config_show_does_not_round() -> None:
    shown = {row[0]: row[1] for row in bench_rows(load_bench("paper"))}
    assert shown["nominal.table_mass_kg"] == "122.86"
    assert shown["drive.torque_per_dac_Nm"] == "0.00058319"
