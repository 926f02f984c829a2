"""One change that got as far as its intent, of any kind: what it meant, how it stands, settling it.

What a kind does to the controller lives with it (``table_recovery``, ``law_upload``,
``settings_upload``); tables alone are settled by their manifest, in ``table_recovery``.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from pmac_comp.base.errors import (
    ControllerState,
    ForeignChange,
    MotorNotSafe,
    PmacCompError,
    SafetyRefusal,
    VerifyMismatch,
)
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.numbers import parse_integer
from pmac_comp.machine.controller.card.registers import OPEN_REGISTERS
from pmac_comp.machine.controller.card.variables import same_value
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.journal import Entry, Journal
from pmac_comp.machine.controller.change.journals import (
    DONE,
    ROLLED_BACK,
    ChangeKind,
    is_temporary,
    journals,
    number_of,
    own_numbers,
)
from pmac_comp.machine.controller.change.lease import (
    give_back,
    host_lock,
    is_lost,
    release_lease,
    take_lease,
)
from pmac_comp.machine.controller.change.transaction import UploadResult
from pmac_comp.machine.controller.change.verdict import link_is_lost
from pmac_comp.machine.controller.contents.comp_table import TableKind
from pmac_comp.machine.controller.contents.law_bank import (
    BLOCK_SIZE,
    MASTER_WORD_ADDRESS,
    LawParameters,
)
from pmac_comp.machine.controller.contents.programs import ProgramKind
from pmac_comp.machine.controller.contents.safety import raise_all
from pmac_comp.machine.controller.contents.settings import (
    Settings,
    differences,
    plc_runs,
    read_settings,
    set_by_others,
    without,
)
from pmac_comp.machine.controller.contents.table_set import TableSet, read_tables
from pmac_comp.machine.controller.law.law_arming import disarm, fade_by_hand
from pmac_comp.machine.controller.law.law_checks import beside_open_servo
from pmac_comp.machine.controller.law.law_goal import followers, running_form
from pmac_comp.machine.controller.law.law_state import (
    LawForm,
    LawHead,
    read_bank,
    read_law_head,
)
from pmac_comp.machine.controller.law.law_upload import (
    LawBackup,
    decide_law,
    read_law_backup,
    restore_law,
)
from pmac_comp.machine.controller.motors.motors import read_motors
from pmac_comp.machine.controller.settings.settings_upload import (
    finish_settings,
    put_back,
    read_settings_backup,
    running_refusals,
    settings_state,
    tolerated,
)
from pmac_comp.machine.controller.tables.table_files import read_table_backup, table_from_json
from pmac_comp.machine.controller.tables.table_recovery import (
    Uploaded,
    require_known,
    rollback_refusals,
    rollback_tables,
    tables_state,
)
from pmac_comp.machine.controller.tables.table_status import announced_elsewhere, read_head
from pmac_comp.machine.controller.tables.upload import ASKED
from pmac_comp.machine.controller.tables.upload_checks import motion_refusals

_FOLLOWING: Final = re.compile(r"I\d+06")
# What closes the loop: activation, addresses, scales, flags; gains and filters; output and limits.
_OF_THE_LOOP: Final = frozenset(
    f"{n:02d}" for n in (*range(5), *range(8, 11), 24, 25, *range(30, 40), *range(59, 70))
)
_OF_MOTOR: Final = re.compile(r"I([1-9]|[12]\d|3[0-2])\d\d")  # Ixx00 to Ixx99


@dataclass(frozen=True)
class Part:
    """A change that got as far as its intent."""

    journal: Journal
    kind: ChangeKind
    intent: Entry

    @property
    def closing(self) -> str:
        """Last step of the journal."""
        return self.journal.last_step

    @property
    def new_settings(self) -> Settings:
        """What a change of settings meant."""
        return Settings.from_dict(self.intent.data["new"])

    @property
    def crc_of_law(self) -> int:
        """Checksum of the law that was meant, 0 for none."""
        values = self.intent.data["values"]
        if not isinstance(values, list):
            return 0
        return LawParameters.from_values([float(v) for v in values]).digest

    @property
    def items(self) -> set[object]:
        """What it touches: two changes with a common item exclude each other."""
        if self.kind is not ChangeKind.SETTINGS:
            return {self.kind}
        new = self.new_settings
        return {*new.variables, *new.definitions, *new.programs} | (
            {"axes"} if new.axes is not None else set()
        )


def parts_of(context: Context) -> list[Part]:
    """Changes with an intent, oldest first."""
    found = []
    for journal in journals(context):
        intent = journal.last("intent")
        lasting = not is_temporary(journal)
        if intent is not None and lasting and journal.kind != ChangeKind.GROUP.value:
            found.append(Part(journal, ChangeKind(journal.kind), intent))
    return found


def parts_in(context: Context, group: int) -> list[Part]:
    """Those of one upload, oldest first."""
    return [part for part in parts_of(context) if part.journal.group == group]


def unsettled(context: Context) -> list[Part]:
    """Open changes, newest first, that no later change of the same items has replaced."""
    found: list[Part] = []
    touched: set[object] = set()
    for part in reversed(parts_of(context)):
        if part.journal.is_open and not part.items & touched:
            found.append(part)
        touched |= part.items
    return found


def uploads(context: Context) -> list[Journal]:
    """Uploads, oldest first; one that was refused before its first change was none."""
    groups = [j for j in journals(context) if j.kind == ChangeKind.GROUP.value]
    begun = {part.journal.group for part in parts_of(context)}
    return [j for j in groups if j.is_open or j.group in begun or j.last(DONE) is not None]


def standing_parts(context: Context, group: Journal) -> tuple[Part, ...]:
    """Parts of an upload that were not taken back, the last one first."""
    parts = reversed(parts_in(context, group.group))
    return tuple(part for part in parts if part.closing != ROLLED_BACK)


def settings_before(context: Context, group: Journal) -> list[Settings]:
    """Settings that taking an upload back brings back."""
    return [
        read_settings_backup(_backup(context, part))
        for part in standing_parts(context, group)
        if part.kind is ChangeKind.SETTINGS
    ]


def replaced_since(context: Context, part: Part) -> set[object]:
    """What later changes, of other uploads, put in the place of a part's items."""
    known = parts_of(context)
    behind = known[1 + next(k for k, p in enumerate(known) if p.journal == part.journal) :]
    return {
        item
        for later in behind
        if later.journal.group != part.journal.group
        and later.closing != ROLLED_BACK
        and later.intent.data.get("closing") != ROLLED_BACK
        for item in later.items
    }


# How it stands -----------------------------------------------------------------------------------


def missing(link: Link, context: Context, part: Part) -> str:
    """What of a part does not stand, in words; empty if all of it does."""
    if part.kind is ChangeKind.TABLES:
        state, reason = _tables_of(link, context, part)
        return "" if state is ControllerState.NEW else reason
    if part.kind is ChangeKind.LAW:
        runs = running_form(link, context, read_law_head(link, context.block)) is not LawForm.NONE
        law = read_bank(link, context.block, read_law_head(link, context.block).bank)
        if (0 if law is None else law.digest) != part.crc_of_law:
            return "the bank in use holds another law"
        return "" if runs or law is None else "the program of the law does not run"
    new = part.new_settings
    if part.intent.data["skip_refused"]:
        # Of a backup of another firmware not everything can stand.
        new = tolerated(new)
    # Our own block is state: parts that follow change it, and so does the law itself.
    first = context.block.first
    ours = {f"P{n}" for n in range(first, first + BLOCK_SIZE)}
    kept = {name: text for name, text in new.variables.items() if name not in ours}
    new = replace(new, variables=kept)
    return "; ".join(differences(new, read_settings(link, new))[:3])


def _tables_of(link: Link, context: Context, part: Part) -> tuple[ControllerState, str]:
    """How the tables of a change stand; those that other axes put beside them are no change of it.

    The manifest of this block knows nothing of them: that of the other axis tells.
    """
    state, reason = tables_state(link, context, part.journal)
    if state is not ControllerState.DISABLED or part.closing != DONE:
        return state, reason
    present = read_tables(link)
    other = announced_elsewhere(link, context, present) if read_head(link, context).i51 else None
    meant, (old, _) = _meant_tables(part), read_table_backup(_backup(context, part))
    touched = meant.changed(old) | set(meant.asked)
    if other is None or any(present.get(*key) != meant.tables.get(*key) for key in touched):
        return state, reason
    return other.state, other.reason


def first_missing(link: Link, context: Context, group: int) -> str:
    """What of a finished upload does not stand, in words; empty if all of it does.

    What was put on last is looked at last: who touches a bank switches the law off with it.
    """
    touched: set[object] = set()
    standing: list[Part] = []
    for part in reversed(parts_in(context, group)):
        # Some parts an upload can do without; such a one was taken back.
        if part.closing == DONE and not part.items & touched:
            standing.append(part)
        touched |= part.items
    return next((wrong for p in reversed(standing) if (wrong := missing(link, context, p))), "")


def is_back(link: Link, context: Context, part: Part) -> bool:
    """Whether what stood before a part that was taken back still stands, as far as can be told."""
    if part.kind is ChangeKind.TABLES:
        old, _ = read_table_backup(_backup(context, part))
        meant, present = _meant_tables(part), read_tables(link)
        touched = meant.changed(old) | set(meant.asked)
        same = all(present.get(*key) == old.get(*key) for key in touched)
        return same and not is_switched_off(link, context, part)
    return bool(missing(link, context, part))


def is_switched_off(link: Link, context: Context, part: Part) -> bool:
    """Whether tables that acted before an upload were taken back and do not act."""
    if part.kind is not ChangeKind.TABLES:
        return False
    old, enabled = read_table_backup(_backup(context, part))
    return enabled and len(old) > 0 and not read_head(link, context).i51


def how_it_stands(link: Link, context: Context, part: Part) -> UploadResult:
    """How a finished change stands now: a reset without SAVE may have taken it away."""
    state, reason, crc_old, crc_new = _judge(link, context, part)
    if state is ControllerState.DISABLED:
        reason = f"something changed since the last upload: {reason}"
    return UploadResult(
        state, part.kind.value, crc_old, crc_new, journal=part.journal.path, notes=(reason,)
    )


def _judge(link: Link, context: Context, part: Part) -> tuple[ControllerState, str, int, int]:
    """State of a law or of settings, why, and both checksums."""
    if part.kind is ChangeKind.LAW:
        state, old, head = _law_in_use(link, context, part)
        return state, _law_reason(state, head), old.crc, part.crc_of_law
    before, new = read_settings_backup(_backup(context, part)), part.new_settings
    state, reason = settings_state(link, before, new)
    done = part.closing == DONE and state is ControllerState.OLD
    if done and not differences(new, read_settings(link, new)):
        state, reason = ControllerState.NEW, _AS_MEANT
    return state, reason, before.crc, new.crc


def what_stands(link: Link, context: Context, parts: Sequence[Part]) -> tuple[ControllerState, str]:
    """State of changes that wait, and in words that of each; nothing is changed.

    Tables are named first: whether they act is what an axis shows of a compensation. Only where
    everything is as before the state is OLD.
    """
    order = list(ChangeKind)
    found = [(p.kind, *_state_of(link, context, p)) for p in parts]
    found.sort(key=lambda item: order.index(item[0]))
    if not found:
        return ControllerState.OLD, "nothing of it was begun"
    told = [f"{kind.value}: {state.value}, {reason}" for kind, state, reason in found]
    state = found[0][1]
    if any(other is not ControllerState.OLD for _, other, _ in found):
        state = ControllerState.DISABLED if state is ControllerState.OLD else state
    return state, "; ".join(dict.fromkeys(told))


def _state_of(link: Link, context: Context, part: Part) -> tuple[ControllerState, str]:
    if part.closing == ROLLED_BACK:
        return ControllerState.OLD, "taken back"
    if part.kind is ChangeKind.TABLES:
        return _tables_of(link, context, part)
    # Settings that parts behind them have changed stand as meant all the same.
    stands = not missing(link, context, part)
    if part.kind is not ChangeKind.LAW or (stands and not part.crc_of_law):
        as_meant = (ControllerState.NEW, _AS_MEANT)
        return as_meant if stands else _judge(link, context, part)[:2]
    state, old, head = _law_in_use(link, context, part)
    if state is ControllerState.OLD and not same_value(head.clamp_ct, old.clamp_ct):
        return ControllerState.DISABLED, f"{_LAW_REASONS[state]}, with another clamp"
    return state, _law_reason(state, head)


def _law_in_use(
    link: Link, context: Context, part: Part
) -> tuple[ControllerState, LawBackup, LawHead]:
    """State of a law by the bank in use, what was kept of the old one, and the head as it is.

    Where the old law is the new one too, a change that was done has put it there.
    """
    old = read_law_backup(_backup(context, part))
    head = read_law_head(link, context.block)
    law = read_bank(link, context.block, head.bank)
    state = decide_law(0 if law is None else law.digest, old.crc, part.crc_of_law)
    if part.closing == DONE and old.crc == part.crc_of_law and state is ControllerState.OLD:
        state = ControllerState.NEW
    return state, old, head


_AS_MEANT = "stands as meant"
_LAW_REASONS = {
    ControllerState.OLD: "the old law is in use",
    ControllerState.NEW: "the new law is in use",
    ControllerState.DISABLED: "the bank in use holds neither the old nor the new law",
}


def _law_reason(state: ControllerState, head: LawHead) -> str:
    """Why the law is judged so, and whether a new one acts."""
    loaded = state is ControllerState.NEW and not head.is_armed
    return _LAW_REASONS[state] + (", not armed: upload it with the motor enabled" if loaded else "")


# Settling it -------------------------------------------------------------------------------------


def settle(
    link: Link, context: Context, part: Part, *, resume: bool, was_reset: bool = False
) -> UploadResult:
    """Bring an interrupted law or settings to OLD or NEW and close the journal.

    ``was_reset`` says that the controller was reset since: what stands otherwise than before and
    than meant is nobody's then.
    """
    with _locked(link, context, part):
        _require_rest(link, context, part)
        if part.kind is ChangeKind.LAW:
            return _settle_law(link, context, part, resume=resume)
        return _settle_settings(link, context, part, resume=resume, was_reset=was_reset)


@contextmanager
def _locked(link: Link, context: Context, part: Part) -> Iterator[None]:
    """The locks of a change, under the number that it had: of this host, and of the controller.

    The number and the claim stay, as between the parts of an upload, until all is settled.
    """
    number = part.journal.group or number_of(part.journal)
    with host_lock(context):
        lease, _ = take_lease(link, context, number, lambda n: n in own_numbers(context))
        try:
            yield
            if is_lost(link, context, lease):
                raise ForeignChange(
                    "The lease is gone: the controller was reset while the old was written back, "
                    "or somebody took it.",
                    code="PC-TXN-040",
                    hint="Run `pmac-comp recover`; it looks at what stands.",
                    left=ControllerState.DISABLED,
                    context={"confirmed": False},
                )
        except (PmacCompError, KeyboardInterrupt) as error:
            if not (isinstance(error, PmacCompError) and link_is_lost(error)):
                with suppress(PmacCompError):
                    give_back(link, context)
            raise
        release_lease(link, context)


def _require_rest(link: Link, context: Context, part: Part) -> None:
    """A law or the settings of a motor are not changed while it moves; raises MotorNotSafe."""
    raise_all(_rest_refusals(link, context, part), "Writing back what stood before")


def _rest_refusals(link: Link, context: Context, part: Part) -> list[SafetyRefusal]:
    new = part.new_settings if part.kind is ChangeKind.SETTINGS else Settings()
    motors = {int(found[1]) for name in new.variables if (found := _OF_MOTOR.fullmatch(name))}
    if part.kind is ChangeKind.LAW or (ProgramKind.PLC, 0) in new.programs:
        motors |= {read_law_head(link, context.block).motor} - {0}
    return motion_refusals(link, sorted(motors)) + _loop_refusals(link, new) if motors else []


def _loop_refusals(link: Link, new: Settings) -> list[SafetyRefusal]:
    """Gains, scales and the like were set with the motor killed, and go back so.

    A motor that counts time for a cam drives nothing, and is killed when it goes.
    """
    names = [(name, found) for name in new.variables if (found := _OF_MOTOR.fullmatch(name))]
    tuned = {int(found[1]) for name, found in names if name[-2:] in _OF_THE_LOOP}
    tuned -= {motor for motor in tuned if _counts_time(motor, new.variables)}
    return [
        MotorNotSafe(
            f"Motor #{motor} is enabled: its settings were changed with the motor killed and go "
            "back so.",
            code="PC-REC-011",
            hint=f"Kill it where the axis is safe without torque (`pmac-comp terminal URL -c "
            f"'#{motor}K'`) and run the command again.",
        )
        for motor, reading in read_motors(link, sorted(tuned)).items()
        if reading.status.is_closed_loop
    ]


def _counts_time(motor: int, new: Mapping[str, str]) -> bool:
    """Whether a change switches on a motor whose output no amplifier sees, or switches one off.

    What a restore switches off was killed before.
    """
    active, output = new.get(f"I{motor}00"), new.get(f"I{motor}02")
    if active is None or parse_integer(active) == 0:
        return active is not None
    return output is not None and parse_integer(output) in OPEN_REGISTERS


def _settle_law(link: Link, context: Context, part: Part, *, resume: bool) -> UploadResult:
    state, reason, crc_old, crc_new = _judge(link, context, part)
    if not (state is ControllerState.NEW and resume):
        restore_law(link, context, read_law_backup(_backup(context, part)))
        state, reason = ControllerState.OLD, _LAW_REASONS[ControllerState.OLD]
    part.journal.write(DONE if state is ControllerState.NEW else ROLLED_BACK)
    return UploadResult(state, "law", crc_old, crc_new, journal=part.journal.path, notes=(reason,))


def _backup(context: Context, part: Part) -> Path:
    return context.store / Path(str(part.intent.data["backup"])).name


def _settle_settings(
    link: Link, context: Context, part: Part, *, resume: bool, was_reset: bool
) -> UploadResult:
    new, tolerant = part.new_settings, bool(part.intent.data["skip_refused"])
    if any(kind is ProgramKind.PROG for kind, _ in new.programs):
        raise_all(running_refusals(link), "The recovery")
    # What follows would go into a buffer that the interruption left open.
    link.write_buffer(["CLOSE"])
    state, reason, crc_old, crc_new = _judge(link, context, part)
    if state is ControllerState.NEW and resume:
        finish_settings(link, new)
    else:
        old = read_settings_backup(_backup(context, part))
        others: list[str] = []
        # What an interruption left may be neither; of another firmware not all stands as meant.
        if part.closing == DONE and state is ControllerState.DISABLED and not was_reset:
            asked = tolerated(new) if tolerant else new
            others = set_by_others(old, asked, read_settings(link, asked))
            if others:  # not by one misread listing
                again = set_by_others(old, asked, read_settings(link, asked))
                others = [name for name in others if name in again]
        old = without(old, others)
        raise_all(beside_open_servo(link, context, old), "Writing back what stood before")
        _take_offset_out(link, context, old)
        _disarm_before_stop(link, context, old)
        state = put_back(link, old, skip_refused=tolerant)
        _clear_master_word(link, old)
        reason = "the old settings and programs are back"
        if others:
            reason += f", but for {', '.join(others)}: somebody else has set that since; it stands"
        if state is ControllerState.DISABLED:
            raise VerifyMismatch(
                "The old settings could not be written back; the programs concerned are empty.",
                code="PC-REC-006",
                hint="Run `pmac-comp recover` again; what stood before is in "
                f"{_backup(context, part).name}. If the controller never takes it: `--keep`.",
                left=state,
            )
    part.journal.write(DONE if state is ControllerState.NEW else ROLLED_BACK)
    return UploadResult(
        state, "settings", crc_old, crc_new, journal=part.journal.path, notes=(reason,)
    )


def _disarm_before_stop(link: Link, context: Context, old: Settings) -> None:
    """A PLC 0 that stood disabled before stops with its law faded, not with its outputs frozen."""
    if 0 in old.stopped and plc_runs(link, 0) and read_law_head(link, context.block).is_armed:
        disarm(link, context)


def _take_offset_out(link: Link, context: Context, old: Settings) -> None:
    """What a sign test left in the master word goes out slowly, while the motor still follows it.

    A motor that stops following keeps the offset: it would stand beside its place from then on.
    """
    stops = any(not parse_integer(v) & 1 for k, v in old.variables.items() if _FOLLOWING.match(k))
    head = read_law_head(link, context.block)
    if stops and head.motor in followers(link) and not plc_runs(link, 0):
        fade_by_hand(link, context, head)


def _clear_master_word(link: Link, old: Settings) -> None:
    """Zero the master word that a sign test left, once no motor follows it.

    The next upload would be refused by it: following it would make the motor jump.
    """
    modes = [text for name, text in old.variables.items() if _FOLLOWING.fullmatch(name)]
    if modes and not any(parse_integer(text) & 1 for text in modes) and not followers(link):
        link.command(f"WX${MASTER_WORD_ADDRESS:X},0")


def uploaded_tables(part: Part) -> Uploaded | None:
    """Tables that an upload left behind, all of them whole; None if it did not get that far."""
    return _meant_tables(part) if part.closing == DONE else None


def _meant_tables(part: Part) -> Uploaded:
    """Tables that an upload meant to leave behind."""
    new, asked = part.intent.data["new"], part.intent.data.get(ASKED, [])
    return Uploaded(
        TableSet(tuple(table_from_json(t) for t in new)),  # type: ignore[attr-defined]
        tuple((TableKind(kind), int(motor)) for kind, motor in asked),  # type: ignore[attr-defined]
    )


def refuse_foreign(link: Link, context: Context, part: Part) -> None:
    """Look, before it is taken back, whether that would delete what somebody else put on.

    Raises
    ------
    ForeignChange
        It would; nothing was changed.
    """
    if part.kind is ChangeKind.TABLES and part.closing in {DONE, ROLLED_BACK}:
        require_known(link, _backup(context, part), _meant_tables(part).tables)


def refusals_to_take_back(link: Link, context: Context, part: Part) -> list[SafetyRefusal]:
    """What forbids ``take_back`` as the controller and its motors stand now; nothing is changed."""
    if part.kind is ChangeKind.TABLES:
        return rollback_refusals(link, context, _backup(context, part), uploaded_tables(part))
    return _rest_refusals(link, context, part)


def take_back(link: Link, context: Context, part: Part, *, was_reset: bool = False) -> str:
    """Bring back what stood before a part of any kind (``settle``); what was done, in words."""
    backup = _backup(context, part)
    if part.kind is ChangeKind.TABLES:
        rollback_tables(link, context, backup, uploaded_tables(part))
        return "the old tables are back"
    if part.kind is ChangeKind.LAW:
        with _locked(link, context, part):
            _require_rest(link, context, part)
            old = read_law_backup(backup)
            restore_law(link, context, old)
        return _law_that_came_back(link, context, old)
    settled = settle(link, context, part, resume=False, was_reset=was_reset)
    return "; ".join(settled.notes)


def _law_that_came_back(link: Link, context: Context, old: LawBackup) -> str:
    """A law is its bank: the program that evaluates it may be gone, as after a reset."""
    runs = running_form(link, context, read_law_head(link, context.block)) is not LawForm.NONE
    if old.law is None or runs:
        return "the old law is back"
    return "the values of the old law are back, but nothing evaluates them: upload it again"
