"""The feed-forward law on the controller: program, banks, arming.

The running bank is never touched: the idle one is filled, read back and sealed, then one write of
the index changes over. So there is no disabled gap: old law or new law. Arming is a step of its
own; the algorithm ramps the gain and clamps the correction by itself.
"""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Final

from pmac_comp.base.clock import Deadline
from pmac_comp.base.errors import (
    ControllerState,
    LinkError,
    MotorNotSafe,
    PmacCompError,
    ProtocolError,
    ReplyTimeout,
    SafetyRefusal,
    TableStateError,
    VerifyMismatch,
)
from pmac_comp.files.resources import firmware_path
from pmac_comp.machine.controller import programs
from pmac_comp.machine.controller.law_bank import (
    BANK_SIZE,
    MASTER_SCALE_IXX07,
    MASTER_WORD_ADDRESS,
    SIGNATURE_PLC,
    SIGNATURE_SERVO,
    BankIndex,
    Index,
    LawBlock,
    LawParameters,
    WorkIndex,
)
from pmac_comp.machine.controller.link import Link
from pmac_comp.machine.controller.motors import moving_motors, read_motor
from pmac_comp.machine.controller.numbers import parse_integer, plain
from pmac_comp.machine.controller.programs import Program, ProgramKind
from pmac_comp.machine.controller.safety import check_law, raise_all
from pmac_comp.machine.controller.transaction import (
    Context,
    UploadResult,
    host_lock,
    mark_left,
    new_transaction_id,
    open_journal,
    parse_lease,
    read_clock,
    read_sealed_json,
    refuse_foreign_lease,
    release_lease,
    take_lease,
    write_sealed_json,
)
from pmac_comp.machine.controller.variables import read_many, read_range, verify_many, write_many

DEFAULT_RAMP_s: Final = 0.5
SIGN_OF_LIFE_CYCLES: Final = 400
GAIN_TOLERANCE: Final = 1e-6


class LawForm(Enum):
    """Which algorithm evaluates the law, valued by its signature."""

    NONE = 0
    PLC = SIGNATURE_PLC
    SERVO = SIGNATURE_SERVO


@dataclass(frozen=True)
class LawHead:
    """Head and working variables of the block.

    Parameters
    ----------
    signature : int
        Written by the running algorithm; may be stale.
    bank : int
        Index of the bank in use.
    target, gain : float
        Gain wanted and present.
    clamp_ct : float
        Amplitude limit in counts.
    heartbeat : float
        Servo cycles left, -1 off.
    slew : float
        Gain change per servo cycle.
    motor : int
        Motor of the law.
    correction_ct, torque_dac : float
        Present outputs of the form that runs.
    n_clamped : int
        Passes in which the clamp acted.
    bank_in_use : int or None
        What the algorithm says it uses; None while the loop is open.
    """

    signature: int
    bank: int
    target: float
    gain: float
    clamp_ct: float
    heartbeat: float
    slew: float
    motor: int
    correction_ct: float
    torque_dac: float
    n_clamped: int
    bank_in_use: int | None

    @property
    def form(self) -> LawForm:
        """Algorithm that wrote the signature last."""
        known = {form.value for form in LawForm}
        return LawForm(self.signature) if self.signature in known else LawForm.NONE

    @property
    def is_armed(self) -> bool:
        """Whether the gain is or goes up."""
        return self.target != 0.0 or abs(self.gain) > GAIN_TOLERANCE


def read_law_head(link: Link, block: LawBlock) -> LawHead:
    """Head and outputs in one question."""
    first, work = block.p(0), block.p(Index.WORK_PLC)
    servo = block.p(Index.WORK_SERVO)
    lines = link.query(f"P{first}..{first + 9}P{work}..{work + 13}P{servo}..{servo + 13}")
    values = [float(v) for v in lines]
    head, plc, own = values[:10], values[10:24], values[24:38]
    running = own if int(head[0]) == SIGNATURE_SERVO else plc
    live = int(running[WorkIndex.LIVE])
    return LawHead(
        signature=int(head[Index.SIGNATURE]),
        bank=int(head[Index.BANK]),
        target=head[Index.TARGET],
        gain=head[Index.GAIN],
        clamp_ct=head[Index.CLAMP],
        heartbeat=head[Index.HEARTBEAT],
        slew=head[Index.SLEW],
        motor=int(head[Index.MOTOR]),
        correction_ct=running[WorkIndex.CORRECTION],
        torque_dac=running[WorkIndex.TORQUE],
        n_clamped=int(running[WorkIndex.CLAMPED]),
        bank_in_use=live - 1 if live > 0 else None,
    )


def read_bank(link: Link, block: LawBlock, bank: int) -> LawParameters | None:
    """Parameters of a sealed bank, None if it is not sealed or its checksum does not fit."""
    first = block.bank(bank)
    try:
        return LawParameters.from_values(read_range(link, "P", first, first + BANK_SIZE - 1))
    except VerifyMismatch:
        return None


def is_running(link: Link, block: LawBlock, servo_period_s: float) -> LawForm:
    """Form that proves to run now: its signature comes back after it was cleared."""
    link.command(f"P{block.p(Index.SIGNATURE)}=0")
    link.clock.sleep_s(SIGN_OF_LIFE_CYCLES * servo_period_s)
    return read_law_head(link, block).form


# Installing ---------------------------------------------------------------------------------------


def law_program(context_block: LawBlock, motor: int) -> Program:
    """PLC 0 of ``firmware_plc`` for a motor and a block."""
    text = firmware_path("feedforward_law.plc0").read_text(encoding="utf-8")
    return programs.parse_source(
        programs.render(text, motor=motor, first_p=context_block.first)
    ).program


def guard_program(context_block: LawBlock) -> Program:
    """Guard PLC 1 of ``firmware_plc`` for a block."""
    text = firmware_path("comp_guard.plc").read_text(encoding="utf-8")
    return programs.parse_source(programs.render(text, first_p=context_block.first)).program


def definition_lines(motor: int) -> list[str]:
    """M-variables that PLC 0 and the guard use (as ``bench_setup.pmc`` has them)."""
    base = 0x80 * motor
    return [
        "M7000->X:$0,24",
        f"M7001->D:${base + 0x08:X}",
        f"M7002->X:${MASTER_WORD_ADDRESS:X},0,24,S",
        f"M7003->X:${base + 0x30:X},18",
        f"M7004->X:${base + 0x30:X},19",
        "M7007->D:$17",
    ]


def install_law(
    link: Link, context: Context, motor: int, *, ramp_s: float = DEFAULT_RAMP_s
) -> tuple[str, ...]:
    """Put law and guard on the controller, switched off, and prove that they run.

    Following of the master word is set up with the word at zero, so nothing moves. Does nothing
    to what is there already.

    Returns
    -------
    tuple of str
        What was done, for the report.

    Raises
    ------
    MotorNotSafe
        The motor moves, or an armed law would be replaced.
    VerifyMismatch
        A program does not list back as sent, or PLC 0 gives no sign of life.
    """
    with host_lock(context), _explained(ControllerState.DISABLED):
        block = context.block
        done: list[str] = []
        if int(read_many(link, [f"I{motor}59"])[f"I{motor}59"]) & 1:
            raise MotorNotSafe(
                f"The open servo has the law already (I{motor}59 = 1): PLC 0 would correct twice.",
                code="PC-LAW-032",
                hint=f"Use --route servo, or set I{motor}59 = 0 with the motor killed.",
            )
        program, guard = law_program(block, motor), guard_program(block)
        head = read_law_head(link, block)
        if programs.is_present(link, program) and head.motor == motor:
            done.append("PLC 0 is on the card already")
        else:
            _require_quiet(link, head, motor)
            _write_law(link, context, motor, program, ramp_s)
            done.append("PLC 0 was written and listed back")
        _follow_master_word(link, context, motor, done)
        if not programs.is_present(link, guard):
            programs.download(link, guard)
            done.append("the guard (PLC 1) was written and listed back")
        link.write_buffer(["ENABLE PLC 0", "ENABLE PLC 1"])
        if is_running(link, block, context.servo_period_s) is not LawForm.PLC:
            raise VerifyMismatch(
                "PLC 0 gives no sign of life.",
                code="PC-LAW-020",
                hint="I5 must be 1 or 3 and I8 small; control-D disables all PLCs.",
            )
    return tuple(done)


def _require_quiet(link: Link, head: LawHead, motor: int) -> None:
    if head.form is not LawForm.NONE and abs(head.gain) > GAIN_TOLERANCE:
        raise MotorNotSafe(
            "A law is armed; disarm it before its program is replaced.", code="PC-LAW-021"
        )
    reasons = moving_motors(link, [motor])
    if reasons:
        raise MotorNotSafe("; ".join(reasons) + ".", code="PC-LAW-022")


def _write_law(link: Link, context: Context, motor: int, program: Program, ramp_s: float) -> None:
    link.write_buffer(definition_lines(motor))
    _write_head(link, context, motor, ramp_s)
    programs.download(link, program)


def _write_head(link: Link, context: Context, motor: int, ramp_s: float) -> None:
    """Head of the block for a motor, banks and working variables empty; only while disarmed."""
    block = context.block
    first, work = block.p(0), block.p(Index.WORK_PLC)
    i08 = read_many(link, [f"I{motor}08"])[f"I{motor}08"]
    link.write_buffer([f"P{first}..{first + Index.MANIFEST - 1}=0", f"P{work}..{first + 199}=0"])
    write_many(
        link,
        {
            f"P{block.p(Index.CLAMP)}": context.limits.max_correction_ct,
            f"P{block.p(Index.HEARTBEAT)}": -1,
            f"P{block.p(Index.SLEW)}": context.servo_period_s / ramp_s,
            f"P{block.p(Index.MOTOR)}": motor,
            f"P{block.p(Index.OUT_SCALE)}": 32.0 * i08 / MASTER_SCALE_IXX07,
            f"P{block.p(Index.IN_SCALE)}": 1.0 / (32.0 * i08),
        },
    )


def _follow_master_word(link: Link, context: Context, motor: int, done: list[str]) -> None:
    wanted = {
        f"I{motor}05": float(MASTER_WORD_ADDRESS),
        f"I{motor}06": 3.0,
        f"I{motor}07": float(MASTER_SCALE_IXX07),
    }
    if read_many(link, list(wanted)) == wanted:
        return
    word = parse_integer(link.query(f"RX${MASTER_WORD_ADDRESS:X}")[0])
    if word != 0:
        raise MotorNotSafe(
            f"The master word is {word}, not zero: following it would make the motor jump.",
            code="PC-LAW-023",
            hint=f"Clear it with the motor killed: WX${MASTER_WORD_ADDRESS:X},0.",
        )
    head = read_law_head(link, context.block)
    if abs(head.gain) > GAIN_TOLERANCE:
        raise MotorNotSafe("A law is armed.", code="PC-LAW-021")
    write_many(link, {f"I{motor}06": 0.0})
    write_many(link, {k: v for k, v in wanted.items() if not k.endswith("06")})
    write_many(link, {f"I{motor}06": 3.0})
    done.append(f"motor #{motor} follows X:${MASTER_WORD_ADDRESS:X} in offset mode")


def require_open_servo(
    link: Link, context: Context, motor: int, *, ramp_s: float = DEFAULT_RAMP_s
) -> None:
    """Refuse the route ``servo`` unless the expected open servo proves to run for a motor.

    PLC 0 is disabled first (two algorithms must not correct at once), and the head of the block
    is set up if it is not yet this motor's.

    Raises
    ------
    TableStateError
        No signature: says what to do.
    MotorNotSafe
        A law is armed in PLC 0, or the block must be set up while the motor moves.
    """
    with host_lock(context), _explained(ControllerState.OLD):
        mode = int(read_many(link, [f"I{motor}59"])[f"I{motor}59"])
        if not mode & 1:
            raise _no_servo(context, motor, mode)
        head = read_law_head(link, context.block)
        if head.form is LawForm.PLC:
            _require_quiet(link, head, motor)
            link.command("DISABLE PLC 0")
        if head.motor != motor or head.slew == 0.0:
            _require_quiet(link, head, motor)
            _write_head(link, context, motor, ramp_s)
        if is_running(link, context.block, context.servo_period_s) is not LawForm.SERVO:
            raise _no_servo(context, motor, mode)


def _no_servo(context: Context, motor: int, mode: int) -> TableStateError:
    return TableStateError(
        f"The open servo does not run for motor #{motor} "
        f"(I{motor}59 = {mode}, no signature {SIGNATURE_SERVO} in P{context.block.p(0)}).",
        code="PC-LAW-024",
        hint="Compile firmware_plc/feedforward_servo.txt with the vendor's tool, download it, and "
        f"set I{motor}59 = 1 with the motor killed; or use --route law.",
        left=ControllerState.OLD,
    )


# Banks --------------------------------------------------------------------------------------------


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
    with host_lock(context), _explained(ControllerState.OLD):
        block = context.block
        head = read_law_head(link, block)
        _refuse_law(link, context, head, parameters, clamp)
        old = read_bank(link, block, head.bank)
        transaction = new_transaction_id()
        journal = open_journal(context, transaction)
        take_lease(link, context, read_clock(link))
        backup = context.store / f"{context.controller}-{transaction:010d}.law.json"
        write_sealed_json(
            backup,
            {
                "kind": "law",
                "bank": head.bank,
                "clamp_ct": head.clamp_ct,
                "values": None if old is None else list(old.values()),
                "written_utc": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            },
        )
        idle = 1 - head.bank
        crc_old = 0 if old is None else old.digest
        journal.write("intent law", {"bank": idle, "crc_new": parameters.digest})
        context.progress("write", 0, 3)
        fill_bank(link, block, idle, parameters)
        context.progress("write", 1, 3)
        if clamp != head.clamp_ct:
            write_many(link, {f"P{block.p(Index.CLAMP)}": clamp})
        journal.write("enable", {"bank": idle})
        _change_over(link, context, idle)
        context.progress("write", 3, 3)
        journal.write("done", {"verdict": "NEW"})
        release_lease(link, context)
    return UploadResult(
        ControllerState.NEW, "law", crc_old, parameters.digest, 0.0, backup, journal.path
    )


def _refuse_law(
    link: Link, context: Context, head: LawHead, parameters: LawParameters, clamp_ct: float
) -> None:
    first = context.block.p(Index.LEASE)
    lease = parse_lease([float(v) for v in link.query(f"P{first}..{first + 1}")])
    refusals: list[SafetyRefusal] = check_law(parameters, clamp_ct, context.limits)
    foreign = refuse_foreign_lease(lease, context.owner, read_clock(link))
    if foreign is not None:
        refusals.append(foreign)
    if clamp_ct != head.clamp_ct and head.is_armed:
        refusals.append(
            MotorNotSafe("The clamp can only change while the law is disarmed.", code="PC-LAW-025")
        )
    raise_all(refusals, "The law")


def fill_bank(link: Link, block: LawBlock, bank: int, parameters: LawParameters) -> None:
    """Write a bank unsealed, read it back, then seal it.

    Raises
    ------
    VerifyMismatch
        A value does not read back; the bank stays unsealed and is never taken over.
    """
    first = block.bank(bank)
    values = parameters.values()
    link.write_buffer(
        [
            f"P{first + BankIndex.SEALED}=0",
            *(f"P{first + k}={plain(v)}" for k, v in enumerate(values) if k != BankIndex.SEALED),
        ]
    )
    body = {f"P{first + k}": v for k, v in enumerate(values) if k != BankIndex.SEALED}
    verify_many(link, body)
    link.command(f"P{first + BankIndex.SEALED}={int(values[BankIndex.SEALED])}")
    found = LawParameters.from_values(read_range(link, "P", first, first + BANK_SIZE - 1))
    if found != parameters:
        raise VerifyMismatch("The sealed bank holds another law.", code="PC-LAW-026")


def _change_over(link: Link, context: Context, bank: int) -> None:
    block = context.block
    try:
        link.command(f"P{block.p(Index.BANK)}={bank}")
    except (LinkError, ProtocolError) as error:
        mark_left(error, ControllerState.NEW, confirmed=False)
        raise
    link.clock.sleep_s(4 * context.servo_period_s)
    head = read_law_head(link, block)
    if head.bank != bank:
        raise VerifyMismatch(f"The bank index is {head.bank} after writing {bank}.")
    if head.bank_in_use is not None and head.bank_in_use != bank:
        raise VerifyMismatch(
            "The algorithm did not take the new bank over.",
            code="PC-LAW-027",
            left=ControllerState.OLD,
        )


def decide_law(crc_in_use: int, crc_old: int, crc_new: int) -> ControllerState | None:
    """OLD or NEW from the checksum of the bank in use, None for somebody else's: pure."""
    if crc_in_use == crc_new:
        return ControllerState.NEW
    return ControllerState.OLD if crc_in_use == crc_old else None


def rollback_law(link: Link, context: Context, backup: Path) -> UploadResult:
    """Put the law of a backup back; a backup without a law disarms and empties the banks."""
    data = read_sealed_json(backup)
    values = data.get("values")
    if isinstance(values, list):
        old = LawParameters.from_values([float(v) for v in values])
        result = upload_law(link, context, old)
        return UploadResult(
            ControllerState.OLD, "law", result.crc_old, result.crc_new, 0.0, result.backup
        )
    disarm(link, context)
    head = read_law_head(link, context.block)
    before = read_bank(link, context.block, head.bank)
    for bank in (0, 1):
        link.command(f"P{context.block.bank(bank, BankIndex.SEALED)}=0")
    return UploadResult(
        ControllerState.OLD,
        "law",
        0 if before is None else before.digest,
        0,
        notes=("law removed",),
    )


# Arming -------------------------------------------------------------------------------------------


def arm(link: Link, context: Context, *, gain: float = 1.0, timeout_s: float = 10.0) -> LawHead:
    """Ramp the gain up and wait until it is there.

    Raises
    ------
    TableStateError
        No algorithm runs, or the bank in use is not sealed.
    ReplyTimeout
        The gain did not arrive (loop open, heartbeat lost).
    """
    block = context.block
    head = read_law_head(link, block)
    if is_running(link, block, context.servo_period_s) is LawForm.NONE:
        raise TableStateError(
            "No algorithm evaluates the law.", code="PC-LAW-028", left=ControllerState.DISABLED
        )
    if read_bank(link, block, head.bank) is None:
        raise TableStateError(
            f"Bank {head.bank} holds no sealed law.",
            code="PC-LAW-029",
            hint="Upload a law first.",
            left=ControllerState.DISABLED,
        )
    if not read_motor(link, head.motor).status.is_closed_loop:
        raise MotorNotSafe(
            f"Motor #{head.motor} is not in closed loop.",
            code="PC-LAW-030",
            left=ControllerState.DISABLED,
        )
    return _ramp(link, context, gain, timeout_s)


def disarm(link: Link, context: Context, *, timeout_s: float = 10.0) -> LawHead:
    """Ramp the gain to zero and wait; the correction fades, nothing jumps.

    With no algorithm running the outputs are what it left: they are taken to zero in small steps.
    """
    head = read_law_head(link, context.block)
    if is_running(link, context.block, context.servo_period_s) is LawForm.NONE:
        return _fade_by_hand(link, context, head)
    return _ramp(link, context, 0.0, timeout_s)


def _ramp(link: Link, context: Context, gain: float, timeout_s: float) -> LawHead:
    link.command(f"P{context.block.p(Index.TARGET)}={plain(gain)}")
    deadline = Deadline.after(link.clock, timeout_s)
    while True:
        head = read_law_head(link, context.block)
        if abs(head.gain - gain) <= GAIN_TOLERANCE:
            return head
        if deadline.expired():
            raise ReplyTimeout(
                f"The gain of the law is {head.gain:g} instead of {gain:g} after {timeout_s:g} s.",
                code="PC-LAW-031",
                hint="The loop may be open, the heartbeat lost or PLC 0 disabled.",
                left=ControllerState.DISABLED,
            )
        link.clock.sleep_s(0.02)


def _fade_by_hand(link: Link, context: Context, head: LawHead) -> LawHead:
    link.write_buffer([f"P{context.block.p(k)}=0" for k in (Index.TARGET, Index.GAIN)])
    word = parse_integer(link.query(f"RX${MASTER_WORD_ADDRESS:X}")[0])
    step = max(1, abs(word) // 50)
    while word:
        word = int(word - max(-step, min(step, word)))
        link.command(f"WX${MASTER_WORD_ADDRESS:X},{word}")
        link.clock.sleep_s(0.01)
    if head.motor:
        write_many(link, {f"I{head.motor}29": 0.0})
    return read_law_head(link, context.block)


def remove_law(link: Link, context: Context) -> None:
    """Take the law off: fade, stop following, delete PLC 0."""
    with host_lock(context):
        head = disarm(link, context)
        link.command("DISABLE PLC 0")
        if head.motor:
            write_many(link, {f"I{head.motor}06": 0.0, f"I{head.motor}29": 0.0})
        programs.delete(link, ProgramKind.PLC, 0)
        link.command(f"P{context.block.p(0)}=0")


@contextmanager
def _explained(left: ControllerState) -> Iterator[None]:
    try:
        yield
    except PmacCompError as error:
        if error.left is None:
            mark_left(error, left, confirmed=not isinstance(error, LinkError | ProtocolError))
        raise


def operation_count(lines: Sequence[str] | None = None) -> int:
    """Interpreted operations of one pass of PLC 0: operators, functions, stores and tests.

    Counted over the statements of an ordinary pass (loop closed, bank unchanged, gain settled).
    """
    body = lines if lines is not None else law_program(LawBlock(), 1).lines
    return sum(_operations(line) for line in ordinary_pass(body))


def ordinary_pass(lines: Sequence[str]) -> list[str]:
    """Statements that run in an ordinary pass of ``feedforward_law.plc0``."""
    skipped_tests = {
        "IF(M7003=1 OR M7004=0)",
        "IF(P7112>16)",
        "IF(P7113!=P7001+1)",
        "IF(P7122>P7004)",
        "IF(P7122<0-P7004)",
        "IF(P7124>P7181)",
        "IF(P7124<0-P7181)",
        "IF(P7005>0)",
        "IF(P7005=0)",
        "IF(P7003<P7002)",
        "IF(P7003>P7002)",
        "IF(P7125!=0 OR P7126!=0)",
    }
    kept: list[str] = []
    live = [True]
    for line in lines:
        if line.startswith("IF("):
            if live[-1]:
                kept.append(line)
            live.append(live[-1] and line not in skipped_tests)
        elif line == "ELSE":
            live[-1] = live[-2] and not live[-1]
        elif line == "ENDIF":
            live.pop()
        elif live[-1]:
            kept.append(line)
    return kept


def _operations(line: str) -> int:
    functions = line.count("ABS(")
    operators = sum(line.count(c) for c in "+-*/%<>")
    return operators + functions + line.count("=") + line.count("AND") + line.count("OR")


def law_cost_us(cpu_clock_MHz: float) -> float:
    """CPU time of one pass of PLC 0 in us: about 3 us per operation at 80 MHz (User Manual)."""
    return 3.0 * 80.0 / cpu_clock_MHz * operation_count()
