"""Tables as values: text, order, checksum, and what they do, against the card and by hand."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pmac_comp.base.errors import ConfigError, RemoteProtocolError, VerifyMismatch
from pmac_comp.machine.controller.contents.comp_table import (
    BacklashTable,
    CompTable,
    TableKind,
    TorqueTable,
    entry_lines,
    parse_entries,
    parse_header,
)
from pmac_comp.machine.controller.contents.law_bank import (
    BankIndex,
    LawBlock,
    LawParameters,
    bank_seal,
)
from pmac_comp.machine.controller.contents.table_set import TableSet, plan, read_tables
from pmac_comp.machine.controller.tables.table_files import table_from_json, table_to_json
from tests.unit.machine_controller.card_bench import CardBench

entries = st.lists(st.integers(-(1 << 23), (1 << 23) - 1), min_size=1, max_size=60)


def test_definition_as_the_manual_writes_it() -> None:
    # Software Reference Manual p. 302-305: 100 entries, source and target stated, span.
    table = CompTable(2, (0,) * 100, 100000)
    assert table.definition == "#2DEFINE COMP 100,#2,#2,100000"
    cross = CompTable(4, (5, 0), 5000, source=3, target=1, by_desired=True)
    assert cross.lines == ("I30=0", "#4DEFINE COMP 2,#3D,#1,5000", "5 0")
    assert BacklashTable(1, (0,), 500).definition == "#1DEFINE BLCOMP 1,500"
    assert TorqueTable(1, (0,), 500).definition == "#1DEFINE TCOMP 1,500"


def test_values_by_hand() -> None:
    # 48 is 3 counts (p. 303); spacing 1000; half-way between the entries half of the sum.
    table = CompTable(1, (48, 16, 0), 3000)
    assert table.correction_ct(np.array([0.0, 500, 1000, 1500, 2000, 3000, 3500])) == pytest.approx(
        [0.0, 1.5, 3.0, 2.0, 1.0, 0.0, 1.5]
    )
    # Negative travel uses the end of the table (User Manual, roll-over).
    assert table.correction_ct(-1000.0) == pytest.approx(1.0)
    assert CompTable(1, (48, 32), 2000, wrap=True).correction_ct(0.0) == pytest.approx(2.0)
    assert TorqueTable(1, (256, 0), 20).torque_dac(10.0) == pytest.approx(1.0)


@given(entries)
def test_entries_survive_the_text(values: list[int]) -> None:
    lines = entry_lines(list(map(str, values)))
    assert all(len(line) <= 120 for line in lines)
    assert parse_entries(lines) == tuple(values)


@given(entries, st.integers(1, 32), st.booleans())
def test_tables_survive_files(values: list[int], motor: int, by_desired: bool) -> None:  # noqa: FBT001
    table = CompTable(motor, tuple(values), 10**6, wrap=True, by_desired=by_desired)
    assert table_from_json(table_to_json(table)) == table
    assert table_from_json({**table_to_json(table), "entries": values}) == table  # older backups
    other = CompTable(motor, (*values[:-1], values[-1] ^ 1), 10**6, wrap=True)
    assert other.crc != table.crc


def test_header_forms() -> None:
    header = parse_header(TableKind.COMP, 2, ["100,#2,#3,100000"])
    assert (header.n_entries, header.source, header.target, header.span_ct) == (100, 2, 3, 100000)
    assert header.by_desired is None
    assert parse_header(TableKind.COMP, 2, ["100,#2D,#3,100000"]).by_desired
    assert parse_header(TableKind.BLCOMP, 2, ["100,5000"]).span_ct == 5000
    with pytest.raises(RemoteProtocolError, match="Two-dimensional"):
        parse_header(TableKind.COMP, 2, ["10,20,#4,#5,#6,50000,100000"])


def test_order_of_definition_and_deletion() -> None:
    comp = {m: CompTable(m, (0,), 1000) for m in (1, 2, 3)}
    torque, backlash = TorqueTable(2, (0,), 1000), BacklashTable(1, (0,), 1000)
    old = TableSet((comp[1], backlash, comp[3], torque, comp[2]))
    assert [(t.kind.value, t.motor) for t in old] == [
        ("COMP", 3), ("COMP", 2), ("COMP", 1), ("TCOMP", 2), ("BLCOMP", 1)
    ]  # fmt: skip
    new = old.with_tables([CompTable(2, (4, 0), 1000)])
    steps = plan(old, new)
    assert steps.delete_lines == [
        "#1DELETE BLCOMP", "#2DELETE TCOMP", "#1DELETE COMP", "#2DELETE COMP"
    ]  # fmt: skip
    assert [t.motor for t in steps.define] == [2, 1, 2, 1]
    assert plan(old, old).delete == ()
    assert plan(old, old).define == ()


def test_order_plan_is_accepted_by_the_card(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    rng = np.random.default_rng(5)

    def some() -> TableSet:
        tables = []
        for motor in (1, 2, 3, 7):
            for maker in (CompTable, TorqueTable, BacklashTable):
                if rng.random() < 0.5:
                    values = (*rng.integers(-9999, 9999, 5).tolist(), 0)
                    tables.append(maker(motor, values, int(rng.integers(1000, 9000))))
        return TableSet(tuple(tables))

    before = TableSet()
    for _ in range(12):
        after = some()
        steps = plan(before, after)
        bench.link.write_buffer([*steps.delete_lines, *steps.define_lines])
        assert read_tables(bench.link).crc == after.crc
        before = after


@pytest.mark.parametrize("by_desired", [True, False])
def test_the_card_moves_by_what_the_table_says(tmp_path: Path, by_desired: bool) -> None:  # noqa: FBT001
    bench = CardBench(tmp_path)
    values = [round(160 * np.sin(k / 5)) for k in range(1, 64)]
    table = CompTable(1, (*values, 0), 640000, by_desired=by_desired)
    bench.link.write_buffer([*table.lines, "I51=1", "#1J/"])
    for position in (0, 25000, -131000, 77777):
        bench.link.command(f"#1J={position}")
        bench.clock.sleep_s(8.0)
        encoder = float(bench.link.query("M162")[0]) / 3072
        # The integrator brings the motor to the corrected position within a count.
        assert encoder == pytest.approx(position + float(table.correction_ct(position)), abs=1.5)


def test_bank_survives_and_its_seal_does_not_lie() -> None:
    law = LawParameters(A0=11.123456789123, S_INV=1e-9, TC=-123456.789, T_LIMIT=5, JL=7)
    assert law.A0 == 11.1234568
    values = law.values()
    assert LawParameters.from_values(values) == law
    for k in range(len(values)):
        broken = list(values)
        broken[k] += 1
        with pytest.raises(VerifyMismatch):
            LawParameters.from_values(broken)
    with pytest.raises(VerifyMismatch, match="not sealed"):
        LawParameters.from_values(law.values(sealed=False))


@pytest.mark.parametrize("name", ["A0", "J0", "TJ", "TK", "TE"])
def test_terms_that_a_jerk_limit_of_zero_would_silence_are_refused(name: str) -> None:
    with pytest.raises(ConfigError, match=f"limit JL of zero {name} would correct nothing"):
        LawParameters(**{name: 1.0})
    LawParameters(**{name: 1.0, "JL": 1.0})


def test_sealed_bank_that_is_no_law_is_not_taken_for_one() -> None:
    values = list(LawParameters(A0=1.0, JL=1.0).values(sealed=False))
    values[BankIndex.JL] = 0.0
    values[BankIndex.SEALED] = bank_seal(values)
    with pytest.raises(VerifyMismatch, match="no law of this version"):
        LawParameters.from_values(values)


def test_block_addresses() -> None:
    block = LawBlock(7000)
    assert block.bank(0) == 7010
    assert block.bank(1, BankIndex.TI) == 7069
    ends = [block.bank(bank, k) for bank in (0, 1) for k in (BankIndex.UF, BankIndex.TF)]
    assert ends == [7106, 7148, 7116, 7158]
    with pytest.raises(ConfigError):
        LawBlock(8000)
    with pytest.raises(ConfigError):
        LawBlock.from_p_block([7000, 7100])
