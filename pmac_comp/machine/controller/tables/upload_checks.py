"""What forbids an upload, and what it would change."""

from collections.abc import Iterable, Sequence
from typing import Final

from pmac_comp.base.errors import (
    ControllerState,
    MotorNotSafe,
    SafetyRefusal,
)
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.change.manifest import ManifestState
from pmac_comp.machine.controller.contents.comp_table import Table
from pmac_comp.machine.controller.contents.table_set import (
    TableSet,
)
from pmac_comp.machine.controller.motors.motors import (
    Standstill,
    moving_motors,
)
from pmac_comp.machine.controller.tables.table_status import FLASH_FAULTS, Head

HEADER_LONG_WORDS: Final = 8  # allowed for per table on top of its entries
PACKET_BYTES: Final = 1024
_BUFFER_BITS: Final = {
    1 << 20: "a binary rotary buffer",
    1 << 19: "a motion program buffer",
    1 << 18: "a rotary buffer",
    1 << 17: "a PLC buffer",
}
_GATHERING: Final = 1 << 19


def difference(meant: TableSet, found: TableSet) -> str:
    """First difference between two sets, in words."""
    for table in meant:
        twin = found.get(table.kind, table.motor)
        name = f"{table.kind.value} of motor #{table.motor}"
        if twin is None:
            return f"{name} is missing"
        if len(twin.entries) != len(table.entries):
            return f"{name} has {len(twin.entries)} entries instead of {len(table.entries)}"
        for k, (a, b) in enumerate(zip(table.entries, twin.entries, strict=True), start=1):
            if a != b:
                return f"{name}: entry {k} is {b} instead of {a}"
        if table.canonical != twin.canonical:
            return f"{name} has another source, target, span or value at 0"
    if len(found) == len(meant):
        return "a table selects its entries by another position (D)"
    return f"{len(found)} tables instead of {len(meant)}"


def flash_refusals(head: Head) -> list[SafetyRefusal]:
    """Refusal because the controller came up with something else than what was saved.

    Its settings are the factory's then: what is written beside them acts on no axis of ours.
    """
    if not head.global1 & FLASH_FAULTS:
        return []
    return [
        SafetyRefusal(
            "The controller reports a flash error: it came up with something else than its saved "
            "configuration.",
            code="PC-BCK-005",
            hint="Check the axis before moving it. `pmac-comp restore` brings a backup back "
            "(motors killed); save that (`pmac-comp terminal URL -c SAVE`): the report ends with a "
            "reset.",
            left=ControllerState.DISABLED,
            context={"confirmed": False},
        )
    ]


def buffer_refusals(head: Head) -> list[SafetyRefusal]:
    """Refusals because of open buffers or running data gathering."""
    refusals = [
        SafetyRefusal(
            f"{name.capitalize()} is open on the controller.",
            code="PC-UPL-020",
            hint="Close it (CLOSE) where it was opened. If nobody is loading a program, `pmac-comp "
            "terminal URL -c 'CLOSE ALL'` closes it.",
        )
        for bit, name in _BUFFER_BITS.items()
        if head.global2 & bit
    ]
    if head.global1 & _GATHERING:
        refusals.append(
            SafetyRefusal(
                "Data gathering is running.",
                code="PC-UPL-021",
                hint="Somebody is measuring, or was killed at it: wait for its end, or run "
                "`pmac-comp recover` where it was started, which gives back what it borrowed. "
                "Where nobody is, stop it (ENDGATHER).",
            )
        )
    return refusals


def incomplete_refusals(head: Head, old: TableSet, after: TableSet) -> list[SafetyRefusal]:
    """Refusal of letting tables act that an interrupted upload may have left half-written."""
    manifest = head.manifest
    if manifest is None or manifest.state is not ManifestState.WRITING:
        return []
    left = [t for t in after if old.get(t.kind, t.motor) == t]
    if old.crc in {manifest.crc_old, manifest.crc_new} or not left:
        return []
    names = ", ".join(f"{t.kind.value} of motor #{t.motor}" for t in left)
    return [
        SafetyRefusal(
            f"An upload of tables was interrupted on this controller; {names} may be incomplete "
            "and would act.",
            code="PC-UPL-024",
            hint="Run `pmac-comp recover` where that upload was started, or put a backup back.",
        )
    ]


def acted(head: Head) -> bool:
    """Whether tables act, or did until an upload that was interrupted switched them off."""
    manifest = head.manifest
    if manifest is None or manifest.state is not ManifestState.WRITING:
        return bool(head.i51)
    return bool(head.i51 or manifest.enabled_old)


def unasked_refusals(head: Head, kept: Iterable[Table]) -> list[SafetyRefusal]:
    """Refusal of switching on, with new tables, others that were off: nobody asked for those."""
    names = ", ".join(f"{t.kind.value} of motor #{t.motor}" for t in kept)
    if not names or acted(head):
        return []
    return [
        SafetyRefusal(
            f"Tables are off on this controller (I51 = 0); {names} would begin to act with the "
            "new ones.",
            code="PC-UPL-070",
            hint="If they may act, switch them on before, with their motors killed or where they "
            "correct little: `pmac-comp terminal URL -c 'I51=1'`. If not, take them off: "
            "`pmac-comp remove` with their bench file.",
        )
    ]


def memory_refusals(head: Head, old: TableSet, new: TableSet) -> list[SafetyRefusal]:
    """Refusal if the new tables do not fit the memory that is free or becomes free."""
    freed = old.n_entries + HEADER_LONG_WORDS * len(old)
    needed = new.n_entries + HEADER_LONG_WORDS * len(new)
    if needed <= freed + head.free_long_words:
        return []
    return [
        SafetyRefusal(
            f"The tables need {needed} long words, {freed + head.free_long_words} are free.",
            code="PC-UPL-022",
            hint="Use fewer entries, or delete buffers.",
        )
    ]


def motion_refusals(
    link: Link, motors: Sequence[int], *looks: Standstill | None
) -> list[SafetyRefusal]:
    """One refusal for every motor that moves; see ``moving_motors``."""
    return not_at_rest(moving_motors(link, motors, *looks))


def not_at_rest(reasons: Iterable[str]) -> list[SafetyRefusal]:
    """Refusals of what ``moving_motors`` says."""
    return [
        MotorNotSafe(
            f"{reason[0].upper()}{reason[1:]}.",
            code="PC-UPL-023",
            hint="Stop the motion and wait until the motor stands, then run the command again.",
        )
        for reason in reasons
    ]
