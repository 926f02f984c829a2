"""Whether the P-variables that we may use are free, or ours.

A bench file allows a block of them (``p_block``). Where a program of the machine uses one that
nobody thought of, writing it would change what the machine does.
"""

from collections.abc import Iterable, Mapping
from typing import Final

from pmac_comp.base.errors import SafetyRefusal
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.numbers import plain
from pmac_comp.machine.controller.card.variables import VARIABLES, answers, read_range
from pmac_comp.machine.controller.change.lease import parse_number
from pmac_comp.machine.controller.change.manifest import (
    MAGIC,
    MANIFEST_SIZE,
    Manifest,
    ManifestState,
)
from pmac_comp.machine.controller.contents.law_bank import (
    BLOCK_SIZE,
    OF_EVERY_MOTOR,
    SIGNATURE_PLC,
    SIGNATURE_SERVO,
    Index,
    LawBlock,
)
from pmac_comp.machine.controller.contents.settings import MOTORS, plc_runs
from pmac_comp.machine.controller.law.law_goal import law_stands
from pmac_comp.machine.controller.motors.open_servos import is_in_open_servo, motors_in_open_servo
from pmac_comp.machine.wire.numbers import read_number

_SHOWN: Final = 5
_LEAST_NUMBER: Final = 1000  # of a change, drawn below 2^31: hardly one is less


def block_refusals(link: Link, block: LawBlock) -> list[SafetyRefusal]:
    """Refusal where another block of ours reaches into this one, which is not left over.

    Or where the block holds values, and none of the marks that our changes leave.

    Marks are the signature of a law, the manifest of tables and the number of the last change.
    Left out is what may stand without them: the lease that a capture took, what motion programs use
    at the end of the block, and what an open servo scribbles, for whichever motor, before it is set
    up for ours.
    """
    texts = answers(link, f"P{block.first}..{block.p(Index.MOTIONS) - 1}", int(Index.MOTIONS))
    values = [float(read_number(text)) for text in texts]
    marked = (
        int(values[Index.SIGNATURE]) in {SIGNATURE_PLC, SIGNATURE_SERVO}
        or values[Index.MANIFEST] == MAGIC
        or parse_number(texts[Index.CHANGE]) != 0
    )
    left_out = set(range(Index.LEASE, Index.CHANGE))
    if motors_in_open_servo(link):
        left_out |= set(OF_EVERY_MOTOR)
    used = {
        block.first + k: value
        for k, value in enumerate(values)
        if value != 0.0 and k not in left_out
    }
    others = _others(link, block)  # of whatever marks this block has: both would be at work
    if others:
        return [_overlap_refusal(block, others[0][0])]
    if marked or not used:
        return []
    return [_used_refusal(block, used, _left_by(link, block, used))]


def law_over_refusals(link: Link, block: LawBlock) -> list[SafetyRefusal]:
    """Refusal to write anything into a block that the law of another bench file reaches into.

    A manifest or a lease there would take the place of coefficients by which a law that may be
    armed sends torque.
    """
    return [_law_refusal(block, first) for first, is_law in _others(link, block) if is_law]


def _others(link: Link, block: LawBlock) -> list[tuple[int, bool]]:
    """First variables of blocks of ours that begin elsewhere and reach into this one.

    Each is known by a law, with its motor (True), or by a whole manifest of tables (False).
    """
    low, values = _around(link, block)
    signatures, manifest = {SIGNATURE_PLC, SIGNATURE_SERVO}, int(Index.MANIFEST)
    found: list[tuple[int, bool]] = []
    for k in range(min(len(values), 2 * BLOCK_SIZE - 1)):
        if low + k == block.first:
            continue
        motor = values[k + Index.MOTOR] if k + Index.MOTOR < len(values) else 0.0
        is_law = values[k] in signatures and 1 <= motor <= MOTORS
        has_law = is_law and _runs(link, low + k, values[k], int(motor))
        tables = Manifest.from_values(values[k + manifest : k + manifest + MANIFEST_SIZE])
        # After a removal a manifest of no entries is left, which hinders nobody.
        in_use = tables is not None and (
            tables.n_entries > 0 or tables.state is ManifestState.WRITING
        )
        if has_law or in_use:
            found.append((low + k, has_law))
    return found


def _around(link: Link, block: LawBlock) -> tuple[int, list[float]]:
    """Variables of all blocks that may reach into this one, and the number of the first."""
    low = max(0, block.first - BLOCK_SIZE + 1)
    high = min(VARIABLES, block.first + 2 * BLOCK_SIZE)
    return low, read_range(link, "P", low, high - 1)


def _left_by(link: Link, block: LawBlock, used: Iterable[int]) -> int | None:
    """First variable of another block of ours that all of these lie in, if there is one.

    With neither law nor tables it is known by the number of its last change, which has ended, and
    the end of its lease: a set-up leaves no more.
    """
    low, values = _around(link, block)
    numbers = list(used)
    for k, (owner, expires, number) in enumerate(
        zip(values[Index.LEASE :], values[Index.LEASE + 1 :], values[Index.CHANGE :], strict=False)
    ):
        ended = parse_number(plain(number)) <= -_LEAST_NUMBER and owner == 0.0 and expires > 0.0
        if ended and all(0 <= n - low - k < BLOCK_SIZE for n in numbers):
            return low + k
    return None


def _runs(link: Link, first: int, signature: float, motor: int) -> bool:
    """Whether the law of a block may run; one that was taken off leaves its signature behind.

    What runs in PLC 0 may be the law of another block by now.
    """
    if signature == SIGNATURE_PLC:
        fits = first <= VARIABLES - BLOCK_SIZE  # else nobody's block begins there
        return fits and plc_runs(link, 0) and law_stands(link, LawBlock(first))
    return is_in_open_servo(link, motor)


def _used_refusal(block: LawBlock, used: Mapping[int, float], left_by: int | None) -> SafetyRefusal:
    """Of values that stand in the block, maybe left by changes with another block of ours."""
    told = ", ".join(f"P{n} = {plain(value)}" for n, value in list(used.items())[:_SHOWN])
    more = f" and {len(used) - _SHOWN} more" if len(used) > _SHOWN else ""
    holds = "P-variables of the block that we may use (p_block) hold"
    zeroed = f"`pmac-comp terminal URL -c 'P{block.first}..{block.p(Index.MOTIONS) - 1}=0'`"
    if left_by is None:
        return SafetyRefusal(
            f"{holds} values that are not ours: {told}{more}. A program of the machine may use "
            "them.",
            code="PC-COM-010",
            hint="Choose another block with [controller] p_block = [first, last]; or, if they are "
            f"left from something old, {zeroed}.",
        )
    return SafetyRefusal(
        f"{holds} what a change with another bench file of this card has left, as setup, restore "
        f"and remove do: {told}{more}. Its p_block P{left_by}..{left_by + BLOCK_SIZE - 1} overlaps "
        "this one.",
        code="PC-COM-010",
        hint="Choose a block apart from it with [controller] p_block = [first, last], and compute "
        f"again; or, if that bench file is used no more, {zeroed}.",
    )


def _law_refusal(block: LawBlock, other: int) -> SafetyRefusal:
    last = BLOCK_SIZE - 1
    return SafetyRefusal(
        f"The law of another bench file of this card, P{other}..{other + last}, reaches into the "
        f"p_block P{block.first}..{block.first + last}: what is written there would change the "
        "torque that it sends.",
        code="PC-COM-012",
        hint="Take that law off with its bench file ([controller] p_block from "
        f"P{other}): `pmac-comp remove`; or choose a block apart from it.",
    )


def _overlap_refusal(block: LawBlock, other: int) -> SafetyRefusal:
    last = BLOCK_SIZE - 1
    return SafetyRefusal(
        f"The p_block P{block.first}..{block.first + last} overlaps P{other}..{other + last}, "
        "which another bench file of this card uses or has used: each would write what the other "
        "works with.",
        code="PC-COM-011",
        hint="Choose a block apart from it with [controller] p_block = [first, last], and compute "
        "again.",
    )
