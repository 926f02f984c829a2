"""What an upload of tables would do, and all that forbids it; nothing is written here."""

from collections.abc import Callable
from dataclasses import dataclass

from pmac_comp.base.errors import SafetyRefusal
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.numbers import parse_integer
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.lease import CLOCK_TEXT, refuse_foreign_lease
from pmac_comp.machine.controller.contents.comp_table import Table
from pmac_comp.machine.controller.contents.safety import check_sums, check_table
from pmac_comp.machine.controller.contents.table_set import (
    POINTERS_TEXT,
    Key,
    TablePlan,
    TableSet,
    keys_of,
    lists_lookup,
    parse_pointers,
    plan,
    read_tables,
    with_lookup,
)
from pmac_comp.machine.controller.motors.motors import (
    MotorReading,
    Standstill,
    begin_standstill,
    executing_moves,
    parse_readings,
    read_motors,
    reading_text,
)
from pmac_comp.machine.controller.motors.switching import FEW
from pmac_comp.machine.controller.tables.bumpless import offset_refusals, step_refusals
from pmac_comp.machine.controller.tables.table_files import put_last
from pmac_comp.machine.controller.tables.table_status import HEAD_LINES, Head, head_text, parse_head
from pmac_comp.machine.controller.tables.upload_checks import (
    acted,
    buffer_refusals,
    incomplete_refusals,
    memory_refusals,
    motion_refusals,
    not_at_rest,
    unasked_refusals,
)


@dataclass(frozen=True)
class UploadPlan:
    """What an upload would do, for a person to look at before it is done.

    Parameters
    ----------
    old, new : TableSet
        Tables before and after.
    enabled_old, enabled_new : bool
        Whether tables act now, and afterwards.
    refusals : tuple of SafetyRefusal
        Everything that forbids it.
    lines : tuple of str
        What would be sent for the tables.
    motors : tuple of int
        Motors that must stand still.
    remarks : tuple of str
        What a person should know.
    """

    old: TableSet
    new: TableSet
    enabled_old: bool
    enabled_new: bool
    refusals: tuple[SafetyRefusal, ...]
    lines: tuple[str, ...]
    motors: tuple[int, ...]
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class Wish:
    """What shall stand on the controller.

    Parameters
    ----------
    change : TableSet
        Tables that replace those of the same kind and motor.
    without : tuple of (TableKind, int)
        Tables to remove.
    exactly : TableSet or None
        Complete new set instead of a change (rollback).
    enable_after : bool
        Whether tables act at the end; what only takes tables off leaves the others as they were.
    check_limits : bool
        False only to restore what was there before.
    """

    change: TableSet
    without: tuple[Key, ...] = ()
    exactly: TableSet | None = None
    enable_after: bool = True
    check_limits: bool = True

    def of(self, old: TableSet) -> TableSet:
        """Complete new set."""
        if self.exactly is not None:
            return self.exactly
        return old.with_tables(self.change, without=self.without)

    def acts(self, head: Head, new: TableSet) -> bool:
        """Whether the new set acts at the end, by what the card had on before."""
        if self.exactly is None and not self.change:
            return len(new) > 0 and acted(head)
        return self.enable_after

    def kept(self, after: TableSet) -> list[Table]:
        """Tables of a new set that were there before and are not touched."""
        return [t for t in after if self.change.get(t.kind, t.motor) is None]


@dataclass(frozen=True)
class Look:
    """What the pre-flight found: the plan, the head it began with, and where motors were then."""

    plan: UploadPlan
    head: Head
    begun: Standstill


def look(
    link: Link,
    context: Context,
    wish: Wish,
    *,
    to_the_end: bool = True,
    meanwhile: Callable[[], object] = lambda: None,
) -> Look:
    """Everything that can be known before anything is changed.

    Parameters
    ----------
    link, context, wish
        Conversation, limits, what shall stand.
    to_the_end : bool
        Whether to wait until slow drift of a motor shows. If not, the caller has to prove
        standstill from ``begun`` before it switches anything.
    meanwhile : callable
        Work of the host that is done while the controller answers.
    """
    context.progress("pre-flight", 0, 1)
    checks: dict[Key, list[SafetyRefusal]] = {}

    def work() -> None:
        _work_out(context, wish, checks)
        meanwhile()

    first = _first_look(link, context, wish.of(TableSet()).motors, work)
    head, begun = first.head, first.begun
    old = read_tables(link, first.keys, meanwhile=lambda: _put_in_words(wish))
    if not lists_lookup(old):
        old = with_lookup(old, put_last(context))
    new = wish.of(old)
    motors = tuple(sorted(set(old.motors) | set(new.motors)))
    refusals: list[SafetyRefusal] = []
    lease = refuse_foreign_lease(head.lease, context.owner, first.clock)
    if lease is not None:
        refusals.append(lease)
    refusals += buffer_refusals(head)
    if wish.check_limits:
        changed = [t for t in new if old.get(t.kind, t.motor) != t]
        refusals += [r for table in changed for r in checks[(table.kind, table.motor)]]
        refusals += check_sums(new, changed, context.limits)
    refusals += memory_refusals(head, old, new)
    readings: dict[int, MotorReading] = {}
    if motors and to_the_end:
        refusals += motion_refusals(link, motors, begun)
    if motors:
        known = begun.first if not (to_the_end or set(motors) - set(begun.first)) else None
        readings = read_motors(link, motors) if known is None else known
        refusals += [] if to_the_end else not_at_rest(executing_moves(readings))
    if set(motors) - set(begun.first):
        begun = Standstill(readings, link.clock.now_s())
    acts = wish.acts(head, new)
    after = new if acts else TableSet()
    if wish.exactly is None:
        refusals += incomplete_refusals(head, old, after)
        refusals += unasked_refusals(head, wish.kept(after))
    acting = old if head.i51 else TableSet()
    refusals += step_refusals(link, context.limits, readings, acting, after)
    if after and not head.i51:
        refusals += offset_refusals(link, context.limits)
    steps = plan(old, new)
    found = UploadPlan(
        old=old,
        new=new,
        enabled_old=bool(head.i51),
        enabled_new=acts,
        refusals=tuple(refusals),
        lines=(*steps.delete_lines, *steps.define_lines),
        motors=motors,
        remarks=_remarks(old, steps),
    )
    context.progress("pre-flight", 1, 1)
    return Look(found, head, begun)


def _remarks(old: TableSet, steps: TablePlan) -> tuple[str, ...]:
    """Tables that go, and come back now or with a rollback, of which the card does not say all."""
    gone = (old.get(*key) for key in steps.delete)
    return tuple(
        f"what {t.kind.value} of motor #{t.motor} holds at position 0 cannot be read from this "
        "card: where it is written again it holds its last entry there (I30 = 1)"
        for t in gone
        if t is not None and t.is_wrap_guessed
    )


@dataclass(frozen=True)
class _FirstLook:
    head: Head
    clock: int
    begun: Standstill
    keys: list[Key]


def _work_out(context: Context, wish: Wish, checks: dict[Key, list[SafetyRefusal]]) -> None:
    """What the new tables need of the host: it has time while the controller answers."""
    _ = context.owner
    for table in wish.of(TableSet()):
        if wish.check_limits:
            checks[(table.kind, table.motor)] = check_table(table, context.limits)


def _put_in_words(wish: Wish) -> None:
    for table in wish.of(TableSet()):
        _ = table.lines, table.canonical


def _first_look(
    link: Link, context: Context, motors: tuple[int, ...], meanwhile: Callable[[], None]
) -> _FirstLook:
    """All that can be asked before the tables are known, in one line for a few motors."""
    group = motors if len(motors) <= FEW else ()
    text = f"{head_text(context)}{CLOCK_TEXT}{reading_text(group)}{POINTERS_TEXT}"
    lines = link.query(text, meanwhile=meanwhile)
    clock, *rest = lines[HEAD_LINES:] or [""]
    head = parse_head(lines[:HEAD_LINES])
    n = 4 * len(group)
    readings = parse_readings(group, rest[:n])
    begun = Standstill(readings, link.clock.now_s())
    keys = keys_of(parse_pointers(rest[n:]))
    if group != motors:
        begun = begin_standstill(link, motors)
    return _FirstLook(head, parse_integer(clock), begun, keys)
