"""What forbids to switch a table where the axes stand, and where they might stand instead."""

import os
from pathlib import Path

from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.contents.comp_table import CompTable
from pmac_comp.machine.controller.contents.law_bank import LawBlock
from pmac_comp.machine.controller.contents.safety import Limits, check_step, check_sums

LIMITS = Limits(
    max_correction_ct=1000.0,
    max_slope=0.1,
    max_step_ct=1.0,
    min_position_ct=0.0,
    max_position_ct=2000.0,
    um_per_ct=1.0,
    hardest_ct_per_s2=1.2e7,
)


def _refused(*entries: int) -> str:
    table = CompTable(1, entries, 2000, wrap=True)
    (refusal,) = check_step([], [table], {1: 1000.0}, {1: True}, LIMITS)
    return refusal.hint


def test_a_step_is_refused_with_the_place_where_it_is_none() -> None:
    # Entries at 1000 and 2000 counts, in 1/16 count: 10 counts where it stands, none at the ends.
    assert "'#1K'" in _refused(160, 0)
    assert "let it stand where it is small (`-c '#1J=0'`)" in _refused(160, 0)


def test_no_place_is_named_where_there_is_none() -> None:
    assert "#1J=" not in _refused(160, 160)


def test_a_killed_motor_follows_without_a_step() -> None:
    table = CompTable(1, (160, 0), 2000, wrap=True)
    assert check_step([table], [], {1: 1000.0}, {1: False}, LIMITS) == []


def test_a_folder_has_one_owner_in_every_locale() -> None:
    stored = "/bench/café axis 1".encode()
    # What Python makes of these bytes in the locale of the test, and where it is ASCII.
    names = (os.fsdecode(stored), stored.decode("ascii", "surrogateescape"))
    assert len({Context(LawBlock(), LIMITS, Path(n), 442e-6).owner for n in names}) == 1


def test_tables_that_correct_one_motor_share_its_limit() -> None:
    up, down = CompTable(1, (8000, 0), 2000), CompTable(2, (-8000, 0), 2000, source=1, target=1)
    more = CompTable(3, (8016, 0), 2000, source=1, target=1)
    assert check_sums([up], [up], LIMITS) == []
    assert check_sums([up, CompTable(2, (16000, 0), 2000)], [up], LIMITS) == []
    assert check_sums([up, down, more], [more], LIMITS) == []  # 501 counts in all
    (refusal,) = check_sums([up, more], [more], LIMITS)
    assert refusal.code == "PC-SAF-042"
    assert "#1 and #3 all correct motor #1, together by up to 1e+03 um" in refusal.message
    elsewhere = CompTable(3, (0, 8016, 0, 0), 2000, source=8, target=1)
    assert len(check_sums([up, elsewhere], [elsewhere], LIMITS)) == 1
    assert check_sums([up, more], [CompTable(4, (8, 0), 2000)], LIMITS) == []


def test_one_place_is_named_where_neither_the_old_nor_the_new_tables_step() -> None:
    """Old entries at 500..2000: 10 0 10 0 counts; new ones 10 10 0 0. Both are none at 2000."""
    old, new = CompTable(1, (160, 0, 160, 0), 2000), CompTable(1, (160, 160, 0, 0), 2000)
    refusals = check_step([old], [new], {1: 500.0}, {1: True}, LIMITS)
    assert [refusal.context["stand_at_ct"] for refusal in refusals] == [0.0, 0.0]


def test_a_place_is_one_of_the_motor_that_would_step() -> None:
    """Of a table whose position is another motor's, no place of this motor takes anything away."""
    own = CompTable(1, (160, 0, 160, 0), 2000)
    other = CompTable(8, (0, 48, 48, 48), 2000, target=1)
    (refusal,) = check_step([], [own, other], {1: 500.0, 8: 1000.0}, {1: True}, LIMITS)
    assert refusal.context["step_ct"] == 13.0
    assert refusal.context["stand_at_ct"] is None
