"""The coefficients of the law as a transaction: old law or new law, no gap.

The running bank is never touched: the idle one is filled, read back and sealed, then one write of
the index changes over. Arming is a step of its own (``law_arming``).
"""

import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from pmac_comp.base.errors import (
    ConfigError,
    ControllerState,
    ForeignChange,
    MotorNotSafe,
    SafetyRefusal,
    StorageFull,
    VerifyMismatch,
)
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.numbers import plain
from pmac_comp.machine.controller.card.variables import same_value, verify_many, write_many
from pmac_comp.machine.controller.change.card_time import CardDeadline
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.journals import ROLLED_BACK, ChangeKind
from pmac_comp.machine.controller.change.sealed_json import read_sealed_json, write_sealed_json
from pmac_comp.machine.controller.change.transaction import Change, UploadResult
from pmac_comp.machine.controller.contents.law_bank import (
    BankIndex,
    Index,
    LawBlock,
    LawParameters,
)
from pmac_comp.machine.controller.contents.safety import check_law, raise_all
from pmac_comp.machine.controller.law.law_arming import arm, disarm
from pmac_comp.machine.controller.law.law_state import (
    LawForm,
    LawHead,
    degree_refusals,
    read_bank,
    read_bank_values,
    read_law_head,
)
from pmac_comp.machine.controller.motors.motors import read_motor
from pmac_comp.machine.controller.settings.settings_upload import lease_refusals
from pmac_comp.machine.controller.tables.upload_checks import motion_refusals

_TAKE_OVER_s: Final = 0.5


@dataclass(frozen=True)
class LawBackup:
    """What stood before a law was uploaded.

    Parameters
    ----------
    bank : int
        Bank in use.
    clamp_ct : float
        Amplitude limit in counts.
    target : float
        Gain that was wanted: 0 disarmed.
    law : LawParameters or None
        Law of the bank, None if it was not sealed.
    """

    bank: int
    clamp_ct: float
    target: float
    law: LawParameters | None

    @property
    def crc(self) -> int:
        """Checksum of the law, 0 for none."""
        return 0 if self.law is None else self.law.digest


def upload_law(
    link: Link, context: Context, parameters: LawParameters, *, clamp_ct: float | None = None
) -> UploadResult:
    """Put a law into the idle bank and change over to it: old or new, no gap.

    Parameters
    ----------
    link, context
        Conversation and limits.
    parameters : LawParameters
        The new law.
    clamp_ct : float, optional
        Amplitude limit in counts; the bench's limit if not given. Changed only while disarmed.

    Raises
    ------
    SafetyRefusal
        All refusals together; nothing was changed.
    VerifyMismatch
        The bank does not read back; the old law still is in use.
    """
    clamp = context.limits.max_correction_ct if clamp_ct is None else clamp_ct
    change = Change(link, context, ChangeKind.LAW)
    with change, change.explained():
        head = read_law_head(link, context.block)
        old = LawBackup(
            head.bank, head.clamp_ct, head.target, read_bank(link, context.block, head.bank)
        )
        raise_all(_refusals(link, context, head, old.law, parameters, clamp), "The law")
        change.begin()
        backup = change.backup_path("law")
        write_law_backup(backup, old)
        idle = 1 - head.bank
        change.step(
            "intent",
            {
                "backup": backup.name,
                "bank": idle,
                "values": list(parameters.values()),
                "clamp_ct": clamp,
            },
        )
        change.settle = lambda: _settled(change, old, parameters)
        context.progress("write", 0, 3)
        fill_bank(link, context.block, idle, parameters)
        context.progress("write", 1, 3)
        _set_clamp(link, context.block, clamp, head.clamp_ct)
        change.step("enable", {"bank": idle})
        change.left = ControllerState.NEW  # if the answer is lost; sent once, unconfirmed
        _require_ours(link, context, head)
        change_over(link, context, idle)
        law = read_bank(link, context.block, idle)
        if law is None or law.digest != parameters.digest:
            raise VerifyMismatch(
                "The bank in use holds something else: the controller was reset meanwhile, or "
                "somebody wrote to it.",
                code="PC-LAW-036",
                hint="Find out which, then run `pmac-comp recover` and upload again.",
            )
        context.progress("write", 3, 3)
        change.finish(ControllerState.NEW)
    return UploadResult(
        ControllerState.NEW,
        "law",
        old.crc,
        parameters.digest,
        0.0,
        backup,
        change.journal.path,
    )


def _settled(change: Change, old: LawBackup, new: LawParameters) -> ControllerState:
    """Judge what a failure left; the old law in use needs no recovery."""
    state = settle_law(change.link, change.context, old, new)
    if state is ControllerState.OLD:
        with suppress(StorageFull):
            change.step(ROLLED_BACK)
    return state


def standing_refusals(
    link: Link, context: Context, new: LawParameters, clamp_ct: float
) -> list[SafetyRefusal]:
    """What forbids a law wherever the axis stands; for a plan, nothing is changed."""
    head = read_law_head(link, context.block)
    return check_law(new, clamp_ct, context.limits) + _clamp_refusals(head, clamp_ct)


def _clamp_refusals(head: LawHead, clamp_ct: float) -> list[SafetyRefusal]:
    if same_value(clamp_ct, head.clamp_ct) or not head.is_armed:
        return []
    return [
        MotorNotSafe(
            f"The clamp of the law ({head.clamp_ct:.6g} counts now, {clamp_ct:.6g} then) can only "
            "change while the law is disarmed.",
            code="PC-LAW-025",
            hint="Take the law off first: `pmac-comp remove`, or `pmac-comp rollback` where the "
            "last upload put it on.",
        )
    ]


def _refusals(
    link: Link,
    context: Context,
    head: LawHead,
    old: LawParameters | None,
    new: LawParameters,
    clamp_ct: float,
) -> list[SafetyRefusal]:
    refusals: list[SafetyRefusal] = check_law(new, clamp_ct, context.limits)
    refusals += [*lease_refusals(link, context), *degree_refusals(link)]
    if head.motor:
        refusals += motion_refusals(link, [head.motor])
    refusals += _clamp_refusals(head, clamp_ct)
    step_ct = predicted_step_ct(head, old, new)
    if abs(step_ct) > context.limits.max_step_ct:
        refusals.append(
            MotorNotSafe(
                f"Changing the law over would move motor #{head.motor} by "
                f"{context.limits.text_um(step_ct)} at once; the limit is "
                f"{context.limits.text_um(context.limits.max_step_ct)}.",
                code="PC-LAW-033",
                hint="Disarm the law first, its gain ramps down: `pmac-comp terminal URL -c "
                f"P{context.block.p(Index.TARGET)}=0`.",
                context={"motor": head.motor, "step_ct": step_ct},
            )
        )
    return refusals


def predicted_step_ct(head: LawHead, old: LawParameters | None, new: LawParameters) -> float:
    """Step of the correction in counts when an axis at rest changes over where it stands.

    At rest only the states are left of the law: (1 + C1 r) (S0 s + b) for friction and a bed
    that swings, GH (g - l0) for a gap.
    """
    if not head.is_armed:
        return 0.0

    def at_rest(law: LawParameters | None) -> float:
        if law is None:
            return 0.0
        bed = head.bed_state if law.BS > 0.0 else 0.0
        elastic = (1.0 + law.C1 * head.position_ct) * (law.S0 * head.friction_state + bed)
        value = elastic + law.GH * (head.flank_state - law.held_flank)
        return max(-head.clamp_ct, min(head.clamp_ct, value))

    return head.gain * (at_rest(new) - at_rest(old))


def _require_ours(link: Link, context: Context, before: LawHead) -> None:
    """The motor still stands, and nobody took the lease or another bank meanwhile.

    Raises
    ------
    MotorNotSafe, ForeignChange
        It does not; the old law is in use.
    """
    raise_all(lease_refusals(link, context), "The law")
    first = context.block.p(Index.LEASE)
    owner = int(float(link.query(f"P{first}")[0]))
    bank = read_law_head(link, context.block).bank
    if owner != context.owner or bank != before.bank:
        raise ForeignChange(
            "Another client changed the lease or the bank index during the upload.",
            code="PC-LAW-034",
            hint="Find out who writes to this controller, then run `pmac-comp recover`.",
        )
    if before.motor:  # last: nothing lies between this look and the change-over
        raise_all(motion_refusals(link, [before.motor]), "The law")


def _set_clamp(link: Link, block: LawBlock, clamp_ct: float, present_ct: float) -> None:
    if not same_value(clamp_ct, present_ct):
        write_many(link, {f"P{block.p(Index.CLAMP)}": clamp_ct})


def fill_bank(link: Link, block: LawBlock, bank: int, parameters: LawParameters) -> None:
    """Write a bank unsealed, read it back, then seal it.

    Raises
    ------
    VerifyMismatch
        A value does not read back; the bank stays unsealed and is never taken over.
    """
    values, seal = parameters.values(), f"P{block.bank(bank, BankIndex.SEALED)}"
    body = {f"P{block.bank(bank, k)}": v for k, v in enumerate(values) if k != BankIndex.SEALED}
    link.write_buffer([f"{seal}=0", *(f"{name}={plain(v)}" for name, v in body.items())])
    verify_many(link, body)
    link.command(f"{seal}={int(values[BankIndex.SEALED])}")
    found = LawParameters.from_values(read_bank_values(link, block, bank))
    if found != parameters:
        raise VerifyMismatch(
            "The sealed bank holds another law than was written.",
            code="PC-LAW-026",
            hint="Something else writes the P-variables of p_block; the law in use was not "
            "touched. Find it, or choose another p_block in the bench file.",
        )


def change_over(link: Link, context: Context, bank: int) -> None:
    """Write the bank index and see that the algorithm took it.

    Raises
    ------
    VerifyMismatch
        The index does not read back, or the algorithm uses another bank.
    """
    block = context.block
    link.command(f"P{block.p(Index.BANK)}={bank}")
    link.clock.sleep_s(4 * context.servo_period_s)
    deadline = CardDeadline(link, _TAKE_OVER_s)
    while True:
        head = read_law_head(link, block)
        if head.bank != bank:
            raise VerifyMismatch(
                f"The bank index is {head.bank} after writing {bank}.",
                code="PC-LAW-042",
                hint=f"Something else writes P{block.p(Index.BANK)}: find it, then run "
                "`pmac-comp recover`.",
            )
        if head.bank_in_use in {None, bank}:
            return
        if deadline.expired():
            raise VerifyMismatch(
                f"The algorithm did not take bank {bank} over within {_TAKE_OVER_s:g} s.",
                code="PC-LAW-027",
                hint="Does PLC 0 run (I5 = 1 or 3), or the open servo for this motor? "
                "`pmac-comp status` says which law runs.",
            )
        link.clock.sleep_s(0.01)


# After a doubt ------------------------------------------------------------------------------------


def decide_law(crc_in_use: int, crc_old: int, crc_new: int) -> ControllerState:
    """State from the checksum of the bank in use, 0 for one that is not sealed: pure.

    ``DISABLED`` stands for a law that is neither: nothing of it may act.
    """
    if crc_in_use == crc_old:
        return ControllerState.OLD
    if crc_in_use == crc_new:
        return ControllerState.NEW
    return ControllerState.DISABLED


def settle_law(link: Link, context: Context, old: LawBackup, new: LawParameters) -> ControllerState:
    """Judge the bank in use and make the rest fit it: the clamp of the old law, or disarmed.

    Raises
    ------
    VerifyMismatch, CommandRefused
        The controller does not take it.
    """
    block = context.block
    head = read_law_head(link, block)
    law = read_bank(link, block, head.bank)
    state = decide_law(0 if law is None else law.digest, old.crc, new.digest)
    if state is ControllerState.OLD:
        _set_clamp(link, block, old.clamp_ct, head.clamp_ct)
    if state is ControllerState.DISABLED and head.is_armed:
        disarm(link, context)
    return state


def restore_law(link: Link, context: Context, old: LawBackup) -> None:
    """Bring the law of a backup back, with its clamp and armed or not as it was.

    Raises
    ------
    VerifyMismatch
        It does not read back.
    """
    block = context.block
    head = read_law_head(link, block)
    found = read_bank(link, block, head.bank)
    if (0 if found is None else found.digest) != old.crc:
        step_ct = 0.0 if old.law is None else predicted_step_ct(head, found, old.law)
        if head.is_armed and (old.law is None or abs(step_ct) > context.limits.max_step_ct):
            disarm(link, context)
        idle = 1 - head.bank
        if old.law is None:
            for bank in (0, 1):
                link.command(f"P{block.bank(bank, BankIndex.SEALED)}=0")
        else:
            fill_bank(link, block, idle, old.law)
            change_over(link, context, idle)
    head = read_law_head(link, block)
    if not same_value(head.clamp_ct, old.clamp_ct):
        if head.is_armed:
            disarm(link, context)
        _set_clamp(link, block, old.clamp_ct, head.clamp_ct)
    if old.target == 0.0 and read_law_head(link, block).is_armed:
        disarm(link, context)
    if old.target != 0.0 and old.law is not None and head.form is not LawForm.NONE:
        _arm_again(link, context, old.target)


def _arm_again(link: Link, context: Context, gain: float) -> None:
    """Armed as it was: in an open loop the gain waits at zero and ramps when the loop is closed."""
    motor = read_law_head(link, context.block).motor
    if motor and not read_motor(link, motor).status.is_closed_loop:
        write_many(link, {f"P{context.block.p(Index.TARGET)}": gain})
    else:
        arm(link, context, gain=gain)


def write_law_backup(path: Path, old: LawBackup) -> None:
    """Store what stood before, sealed."""
    write_sealed_json(
        path,
        {
            "kind": "law",
            "bank": old.bank,
            "clamp_ct": old.clamp_ct,
            "target": old.target,
            "values": None if old.law is None else list(old.law.values()),
            "written_utc": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        },
    )


def read_law_backup(path: Path) -> LawBackup:
    """What stood before, from its file; the digest is checked.

    Raises
    ------
    ConfigError
        No backup of a law.
    """
    data = read_sealed_json(path)
    values = data.get("values")
    if data.get("kind") != "law":
        raise ConfigError(
            f"{path} is no backup of a law.",
            code="PC-LAW-035",
            hint="The folder of journals was changed by hand; name the right one with --journal.",
        )
    law = None
    if isinstance(values, list):
        law = LawParameters.from_values([float(v) for v in values])
    return LawBackup(
        int(str(data["bank"])), float(str(data["clamp_ct"])), float(str(data["target"])), law
    )
