"""Bytecode of expressions, PLCs, motion programs and the open servo, and the loop that runs it.

One stack machine serves all of the card's languages, so that a formula means the same on line, in
a PLC and in the servo task. It is compiled, so that PLC 0 can run inside the servo loop.

Code is a flat ``int64`` array of op codes and operands, constants a ``float64`` array. The state
array keeps the program counter between scans. What needs the rest of the card (CMD, moves, ENABLE
PLC ...) is an ``EVENT``: its number and arguments go to the event words, and the run either goes on
(``state[S_SUSPEND] == 0``, PLC 0) or returns ``EVENTS`` (everything planned outside).

The change counter ``dirty[0]`` is bumped by stores to I-variables and to registers that the servo
task may have decoded, but not by stores to the registers a law writes every cycle: D:+$10, X:+$2E,
Ixx29 (Y:+$33), Ixx68 (Y:+$31), the user timers, and everything above $1100 except the encoder
table. Those must be read afresh.

Source: Turbo PMAC User Manual p. 241-248, Software Reference Manual p. 486-494 (operators,
functions), p. 354-359 (M-variable pointers).
"""

# Forms below are chosen for numba.
# ruff: noqa: PLR0911, PLR1714, SIM109, RUF046
from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pmac_comp.simulator.memory.memory import (
    read_dpram32,
    read_float48,
    read_long,
    write_dpram32,
    write_float48,
    write_long,
)

IntTable = NDArray[np.int64]
WordSpace = NDArray[np.int32]
FloatTable = NDArray[np.float64]

# A part of the loop that allocates nothing: inlined, and without counts of references to its
# arrays, which are atomic.
_part = njit(cache=True, _nrt=False, forceinline=True)

# Status of a run.
FINISHED, SCAN_END, EVENTS, OUT_OF_BUDGET, FAULT, JUMPED_BACK = range(6)

# State words.
(
    S_PC,
    S_SP,
    S_CS,  # coordinate system - 1: Q window and the Q0 of ATAN2
    S_EVENTS,  # words used in the event array
    S_SUSPEND,
    S_R1,  # base + $30 of the motor (open servo)
    S_MOTOR,
    S_JUMPS,  # backward jumps since the last move
    S_STEPS,  # instructions of the last run
    S_MOTOR_ADDRESS,  # modal motor of a PLC (ADDRESS statement)
    N_STATE,
) = range(11)

# Result and hand-over registers of the open servo.
N_REGS = 8
REG_RETURN = 5
REG_RETURNED = 6

STACK_DEPTH = 64
EVENT_WORDS = 4096
SATURATED = 140737488355328.0  # 2**47: quotient by zero, TAN(90)

# Op codes. Operands follow in the code array as named.
(
    OP_END,
    OP_CONST,  # k
    OP_LOAD_P,  # n
    OP_LOAD_Q,  # n
    OP_LOAD_I,  # n
    OP_LOAD_M,  # n
    OP_LOAD_P_AT,
    OP_LOAD_Q_AT,
    OP_LOAD_I_AT,
    OP_LOAD_M_AT,
    OP_STORE_P,  # n
    OP_STORE_Q,
    OP_STORE_I,
    OP_STORE_M,
    OP_STORE_P_AT,  # index below value on the stack
    OP_STORE_Q_AT,
    OP_STORE_I_AT,
    OP_STORE_M_AT,
    OP_ADD,
    OP_SUB,
    OP_MUL,
    OP_DIV,
    OP_MOD,
    OP_AND,
    OP_OR,
    OP_XOR,
    OP_NEG,
    OP_SIN,
    OP_COS,
    OP_TAN,
    OP_ASIN,
    OP_ACOS,
    OP_ATAN,
    OP_ATAN2,
    OP_SQRT,
    OP_LN,
    OP_EXP,
    OP_ABS,
    OP_INT,
    OP_EQ,
    OP_NE,
    OP_GT,
    OP_NGT,
    OP_LT,
    OP_NLT,
    OP_APPROX,
    OP_NAPPROX,
    OP_LAND,
    OP_LOR,
    OP_JUMP,  # target
    OP_JUMP_FALSE,  # target
    OP_JUMP_BACK,  # target; counts
    OP_SCAN_END,  # target of the next scan
    OP_EVENT,  # number, arguments taken from the stack
    OP_ADDRESS,  # motor or 0, coordinate system or 0
    OP_LOAD_FIELD,  # space (0 X, 1 Y), relative, address, offset, width, signed
    OP_STORE_FIELD,
    OP_LOAD_LONG,  # relative, address
    OP_STORE_LONG,
    OP_LOAD_FLOAT,
    OP_STORE_FLOAT,
    OP_LOAD_FIELD_AT,  # as OP_LOAD_FIELD, index taken from the stack
    OP_STORE_FIELD_AT,  # index below value
    OP_LOAD_LONG_AT,
    OP_STORE_LONG_AT,
    OP_LOAD_FLOAT_AT,
    OP_STORE_FLOAT_AT,
    OP_COPYREG,  # P number
    OP_MOTOR,
    OP_RETURN_VALUE,
    OP_INT_DIV,  # rounds to nearest, halves up
    OP_WRAP24,
    OP_CALL,  # target
    OP_RETURN,
) = range(74)

# Kinds of I-variable registers (column 0 of the table).
I_ABSENT, I_X, I_Y, I_LONG, I_FLOAT = range(5)
# Columns of the I-variable table.
(IT_KIND, IT_ADDRESS, IT_OFFSET, IT_WIDTH, IT_SIGNED, IT_QUIET, IT_COLUMNS) = range(7)

# Types of an M-variable definition (bits 20-23 of X:$4000+n).
M_SELF, M_X, M_Y, M_D, M_L, M_DP, M_F, M_TW = range(8)
M_UNSIGNED, M_SIGNED, M_BCD, M_COMPLEMENT = range(4)
ADDRESS_MASK = 0x7FFFF


@njit(cache=True)
def nearest(value: float) -> int:
    """Integer nearest to a value (halves up), saturated to 63 bits."""
    if value >= 9.2e18:
        return 9200000000000000000
    if value <= -9.2e18:
        return -9200000000000000000
    return int(math.floor(value + 0.5))


@njit(cache=True)
def read_field(space: WordSpace, address: int, offset: int, width: int, signed: int) -> float:
    """Value of a bit field of one 24-bit word."""
    raw = (np.int64(space[address]) >> offset) & ((np.int64(1) << width) - 1)
    if signed != 0 and raw >= (np.int64(1) << (width - 1)):
        raw -= np.int64(1) << width
    return float(raw)


@njit(cache=True)
def write_field(space: WordSpace, address: int, offset: int, width: int, value: float) -> None:
    """Store the nearest integer modulo 2^width in a bit field."""
    mask = (np.int64(1) << width) - 1
    word = np.int64(space[address]) & ~(mask << offset)
    space[address] = (word | ((np.int64(nearest(value)) & mask) << offset)) & 0xFFFFFF


@njit(cache=True)
def read_i(x: WordSpace, y: WordSpace, imap: IntTable, iscale: FloatTable, number: int) -> float:
    """Value of an I-variable; numbers outside 0..8191 wrap."""
    n = number & 8191
    kind = imap[n, IT_KIND]
    address = imap[n, IT_ADDRESS]
    if kind == I_X:
        return float(
            iscale[n]
            * read_field(x, address, imap[n, IT_OFFSET], imap[n, IT_WIDTH], imap[n, IT_SIGNED])
        )
    if kind == I_Y:
        return float(
            iscale[n]
            * read_field(y, address, imap[n, IT_OFFSET], imap[n, IT_WIDTH], imap[n, IT_SIGNED])
        )
    if kind == I_LONG:
        return float(read_long(x, y, address))
    if kind == I_FLOAT:
        return float(read_float48(x, y, address))
    return float(iscale[n])


@njit(cache=True)
def write_i(
    x: WordSpace,
    y: WordSpace,
    dirty: IntTable,
    imap: IntTable,
    iscale: FloatTable,
    number: int,
    value: float,
) -> None:
    """Store an I-variable: out of range wraps modulo its width, absent ones keep their value."""
    n = number & 8191
    kind = imap[n, IT_KIND]
    address = imap[n, IT_ADDRESS]
    if kind == I_X:
        write_field(x, address, imap[n, IT_OFFSET], imap[n, IT_WIDTH], value / iscale[n])
    elif kind == I_Y:
        write_field(y, address, imap[n, IT_OFFSET], imap[n, IT_WIDTH], value / iscale[n])
    elif kind == I_LONG:
        write_long(x, y, address, nearest(value))
    elif kind == I_FLOAT:
        write_float48(x, y, address, value)
    if imap[n, IT_QUIET] == 0:
        dirty[0] += 1


@njit(cache=True)
def _from_bcd(raw: int, width: int) -> float:
    total = 0
    factor = 1
    for digit in range((width + 3) // 4):
        total += ((raw >> (4 * digit)) & 15) * factor
        factor *= 10
    return float(total)


@njit(cache=True)
def _to_bcd(value: int) -> int:
    raw = 0
    shift = 0
    rest = abs(value)
    while rest > 0 and shift < 24:
        raw |= (rest % 10) << shift
        rest //= 10
        shift += 4
    return raw


@njit(cache=True)
def _ieee32(bits: int) -> float:
    sign = -1.0 if bits & 0x80000000 else 1.0
    exponent = (bits >> 23) & 0xFF
    fraction = bits & 0x7FFFFF
    if exponent == 0:
        return sign * math.ldexp(float(fraction), -149)
    if exponent == 255:
        return sign * 3.4028234663852886e38
    return sign * math.ldexp(float(fraction + 0x800000), exponent - 150)


@njit(cache=True)
def _to_ieee32(value: float) -> int:
    if value == 0.0 or math.isnan(value):
        return 0
    sign = 0x80000000 if value < 0 else 0
    fraction, exponent = math.frexp(abs(value))
    mantissa = int(math.floor(fraction * 16777216.0 + 0.5))
    if mantissa == 16777216:
        mantissa = 8388608
        exponent += 1
    biased = exponent + 126
    if biased >= 255:
        return sign | 0x7F7FFFFF
    if biased <= 0:
        return sign
    return sign | (biased << 23) | (mantissa & 0x7FFFFF)


@njit(cache=True)
def read_m(x: WordSpace, y: WordSpace, number: int) -> float:
    """Value of the register an M-variable points to, through its definition words."""
    cell = 0x4000 + (number & 8191)
    definition = np.int64(x[cell])
    kind = definition >> 20
    address = np.int64(y[cell]) & ADDRESS_MASK
    if kind == M_SELF:
        return float(read_field(y, cell, 0, 24, 1))
    if kind == M_X or kind == M_Y:
        space = x if kind == M_X else y
        width = (definition >> 6) & 63
        form = (definition >> 12) & 15
        raw = read_field(space, address, definition & 63, width, 1 if form == M_SIGNED else 0)
        if form == M_BCD:
            return float(_from_bcd(int(raw), width))
        if form == M_COMPLEMENT:
            return float((np.int64(1) << width) - 1 - np.int64(raw))
        return float(raw)
    if kind == M_D:
        return float(read_long(x, y, address))
    if kind == M_L:
        return float(read_float48(x, y, address))
    if kind == M_DP:
        bits = read_dpram32(x, y, address)
        return float(bits - 4294967296 if bits >= 2147483648 else bits)
    if kind == M_F:
        return float(_ieee32(int(read_dpram32(x, y, address))))
    return 0.0


@njit(cache=True)
def write_m(x: WordSpace, y: WordSpace, dirty: IntTable, number: int, value: float) -> None:
    """Store through an M-variable; integers are rounded to nearest and wrap."""
    cell = 0x4000 + (number & 8191)
    definition = np.int64(x[cell])
    kind = definition >> 20
    address = np.int64(y[cell]) & ADDRESS_MASK
    if kind == M_SELF:
        write_field(y, cell, 0, 24, value)
        return
    if kind == M_X or kind == M_Y:
        space = x if kind == M_X else y
        width = (definition >> 6) & 63
        form = (definition >> 12) & 15
        stored = value
        if form == M_BCD:
            stored = float(_to_bcd(int(nearest(value))))
        elif form == M_COMPLEMENT:
            stored = float((np.int64(1) << width) - 1) - value
        write_field(space, address, definition & 63, width, stored)
    elif kind == M_D:
        write_long(x, y, address, nearest(value))
    elif kind == M_L:
        write_float48(x, y, address, value)
    elif kind == M_DP:
        write_dpram32(x, y, address, nearest(value))
    elif kind == M_F:
        write_dpram32(x, y, address, _to_ieee32(value))
    if _is_cached(address, kind):
        dirty[0] += 1


@njit(cache=True)
def _is_cached(address: int, kind: int) -> bool:
    if address >= 0x1100:
        return 0x3501 <= address <= 0x35C0 or 0x2000 <= address < 0x3000
    if address >= 0x1080:
        return False
    offset = address & 0x7F
    return not (offset == 0x10 or (offset == 0x2E and kind == M_X))


@njit(cache=True)
def divide(a: float, b: float) -> float:
    """Quotient; by zero it saturates at +-2^47 and the program goes on."""
    if b == 0.0:
        return -SATURATED if a < 0.0 else SATURATED
    return a / b


@njit(cache=True)
def modulo(a: float, b: float) -> float:
    """Remainder a % b: [0, b) for positive b, [-|b|, |b|) for negative b, 0 for b = 0."""
    if b == 0.0:
        return 0.0
    if b > 0.0:
        return a - b * math.floor(a / b)
    half = -b
    return (a + half) - 2.0 * half * math.floor((a + half) / (2.0 * half)) - half


@njit(cache=True)
def bitwise(op: int, a: float, b: float) -> float:
    """And, or, exclusive or over integer and fractional bits, two's complement."""
    largest = max(abs(a), abs(b), 1.0)
    exponent = math.frexp(largest)[1]
    shift = min(24, 61 - exponent)
    left = np.int64(math.floor(math.ldexp(a, shift)))
    right = np.int64(math.floor(math.ldexp(b, shift)))
    if op == OP_AND:
        result = left & right
    elif op == OP_OR:
        result = left | right
    else:
        result = left ^ right
    return math.ldexp(float(result), -shift)


@njit(cache=True)
def _function(op: int, a: float, per_radian: float) -> float:
    if op == OP_SIN:
        return math.sin(a / per_radian)
    if op == OP_COS:
        return math.cos(a / per_radian)
    if op == OP_TAN:
        cosine = math.cos(a / per_radian)
        if abs(cosine) < 1e-15:
            return SATURATED if math.sin(a / per_radian) > 0 else -SATURATED
        return math.sin(a / per_radian) / cosine
    if op == OP_ASIN:
        return math.asin(min(1.0, max(-1.0, a))) * per_radian
    if op == OP_ACOS:
        return math.acos(min(1.0, max(-1.0, a))) * per_radian
    if op == OP_ATAN:
        return math.atan(a) * per_radian
    if op == OP_SQRT:
        return math.sqrt(a) if a > 0.0 else 0.0
    if op == OP_LN:
        return math.log(a) if a > 0.0 else 0.0
    if op == OP_EXP:
        return math.exp(min(a, 700.0))
    if op == OP_ABS:
        return abs(a)
    return math.floor(a)


@njit(cache=True)
def _compare(op: int, a: float, b: float) -> float:
    if op == OP_EQ:
        result = a == b
    elif op == OP_NE:
        result = a != b
    elif op == OP_GT:
        result = a > b
    elif op == OP_NGT:
        result = not (a > b)
    elif op == OP_LT:
        result = a < b
    elif op == OP_NLT:
        result = not (a < b)
    elif op == OP_APPROX:
        result = abs(a - b) < 0.5
    else:
        result = not (abs(a - b) < 0.5)
    return 1.0 if result else 0.0


@njit(cache=True)
def _q_address(x: WordSpace, y: WordSpace, cs: int, number: int) -> int:
    # Y of the first word of the C.S. block holds the start of its window in the pool.
    start = np.int64(y[0x2000 + 0x100 * cs])
    return int(0x8000 + ((start - 0x8000 + number) & 8191))


@_part
def _index(value: float) -> int:
    """Number of a variable that was computed."""
    return int(math.floor(value + 1e-6)) & 8191


@_part
def _read_variable(
    x: WordSpace,
    y: WordSpace,
    imap: IntTable,
    iscale: FloatTable,
    cs: int,
    kind: int,
    number: int,
) -> float:
    """Variable P, Q, I or M (``kind`` 0 to 3) of that number."""
    if kind == 0:
        return float(read_float48(x, y, 0x6000 + number))
    if kind == 1:
        return float(read_float48(x, y, _q_address(x, y, cs, number)))
    if kind == 2:
        return float(read_i(x, y, imap, iscale, number))
    return float(read_m(x, y, number))


@_part
def _write_variable(
    x: WordSpace,
    y: WordSpace,
    dirty: IntTable,
    imap: IntTable,
    iscale: FloatTable,
    cs: int,
    kind: int,
    number: int,
    value: float,
) -> None:
    """Store to variable P, Q, I or M (``kind`` 0 to 3) of that number."""
    if kind == 0:
        write_float48(x, y, 0x6000 + number, value)
    elif kind == 1:
        write_float48(x, y, _q_address(x, y, cs, number), value)
    elif kind == 2:
        write_i(x, y, dirty, imap, iscale, number, value)
    else:
        write_m(x, y, dirty, number, value)


@_part
def _arithmetic(op: int, a: float, b: float) -> float:
    """Value of a two-sided operator."""
    if op == OP_ADD:
        return a + b
    if op == OP_SUB:
        return a - b
    if op == OP_MUL:
        return a * b
    if op == OP_DIV:
        return float(divide(a, b))
    if op == OP_MOD:
        return float(modulo(a, b))
    return float(bitwise(op, a, b))


@_part
def _access(
    x: WordSpace,
    y: WordSpace,
    dirty: IntTable,
    code: IntTable,
    stack: FloatTable,
    op: int,
    motor_base: int,
    pc: int,
    sp: int,
) -> tuple[int, int]:
    """Load or store of a register by its address: a field, a long word or a 48-bit float.

    Program counter and stack pointer afterwards.
    """
    storing = (op - OP_LOAD_FIELD) & 1
    indexed = op >= OP_LOAD_FIELD_AT
    form = ((op - OP_LOAD_FIELD) % 6) // 2  # 0 field, 1 long, 2 float
    space = 0
    if form == 0:
        space = code[pc]
        pc += 1
    address = code[pc + 1] + (motor_base if code[pc] != 0 else 0)
    pc += 2
    value = 0.0
    if storing:
        sp -= 1
        value = stack[sp]
    if indexed:
        sp -= 1
        address += int(math.floor(stack[sp] + 1e-6))
    address &= ADDRESS_MASK
    if form == 0:
        words = x if space == 0 else y
        if storing:
            write_field(words, address, code[pc], code[pc + 1], value)
        else:
            value = read_field(words, address, code[pc], code[pc + 1], code[pc + 2])
        pc += 3
    elif form == 1:
        if storing:
            write_long(x, y, address, nearest(value))
        else:
            value = float(read_long(x, y, address))
    elif storing:
        write_float48(x, y, address, value)
    else:
        value = read_float48(x, y, address)
    if not storing:
        stack[sp] = value
        sp += 1
    elif _is_cached(address, M_X if space == 0 and form == 0 else M_Y):
        dirty[0] += 1
    return pc, sp


@njit(cache=True, _nrt=False)
def run(
    x: WordSpace,
    y: WordSpace,
    dirty: IntTable,
    imap: IntTable,
    iscale: FloatTable,
    code: IntTable,
    consts: FloatTable,
    stack: FloatTable,
    state: IntTable,
    regs: FloatTable,
    events: FloatTable,
    budget: int,
) -> int:
    """Run from ``state[S_PC]`` to the end of the scan, an event or the end of the budget.

    Parameters
    ----------
    x, y, dirty
        Memory of the card and its change counter.
    imap, iscale
        I-variable table of `variables`.
    code, consts, stack
        Program, its constants, and scratch of `STACK_DEPTH`.
    state : ndarray of int64, shape (N_STATE,)
        Kept between calls.
    regs : ndarray, shape (N_REGS,)
        In: the five values of COPYREG; out: value and flag of RETURN.
    events : ndarray, shape (EVENT_WORDS,)
        Receives ``number, count, arguments...`` of each event.
    budget : int
        Most instructions of this call.

    Returns
    -------
    int
        FINISHED, SCAN_END, EVENTS, OUT_OF_BUDGET, FAULT or JUMPED_BACK.
    """
    pc = state[S_PC]
    sp = state[S_SP]
    used = state[S_EVENTS]
    steps = 0
    status = OUT_OF_BUDGET
    call_base = STACK_DEPTH // 2
    while steps < budget:
        steps += 1
        op = code[pc]
        pc += 1
        if op == OP_CONST:
            stack[sp] = consts[code[pc]]
            sp += 1
            pc += 1
        elif OP_LOAD_P <= op <= OP_LOAD_M:
            kind = op - OP_LOAD_P
            stack[sp] = _read_variable(x, y, imap, iscale, state[S_CS], kind, code[pc])
            sp += 1
            pc += 1
        elif OP_LOAD_P_AT <= op <= OP_LOAD_M_AT:
            kind, index = op - OP_LOAD_P_AT, _index(stack[sp - 1])
            stack[sp - 1] = _read_variable(x, y, imap, iscale, state[S_CS], kind, index)
        elif OP_STORE_P <= op <= OP_STORE_M:
            sp -= 1
            kind, value = op - OP_STORE_P, stack[sp]
            _write_variable(x, y, dirty, imap, iscale, state[S_CS], kind, code[pc], value)
            pc += 1
        elif OP_STORE_P_AT <= op <= OP_STORE_M_AT:
            sp -= 2
            kind, index, value = op - OP_STORE_P_AT, _index(stack[sp]), stack[sp + 1]
            _write_variable(x, y, dirty, imap, iscale, state[S_CS], kind, index, value)
        elif OP_ADD <= op <= OP_XOR:
            sp -= 1
            stack[sp - 1] = _arithmetic(op, stack[sp - 1], stack[sp])
        elif op == OP_JUMP_FALSE:
            sp -= 1
            pc = code[pc] if stack[sp] == 0.0 else pc + 1
        elif op == OP_JUMP:
            pc = code[pc]
        elif OP_EQ <= op <= OP_NAPPROX:
            sp -= 1
            stack[sp - 1] = _compare(op, stack[sp - 1], stack[sp])
        elif op == OP_LAND:
            sp -= 1
            stack[sp - 1] = 1.0 if stack[sp - 1] != 0.0 and stack[sp] != 0.0 else 0.0
        elif op == OP_LOR:
            sp -= 1
            stack[sp - 1] = 1.0 if stack[sp - 1] != 0.0 or stack[sp] != 0.0 else 0.0
        elif op == OP_NEG:
            stack[sp - 1] = -stack[sp - 1]
        elif OP_SIN <= op <= OP_INT:
            per_radian = 1.0 if read_i(x, y, imap, iscale, 15) == 1.0 else 57.29577951308232
            if op == OP_ATAN2:
                # The cosine argument comes from Q0 of the addressed coordinate system.
                cosine = read_float48(x, y, _q_address(x, y, state[S_CS], 0))
                stack[sp - 1] = math.atan2(stack[sp - 1], cosine) * per_radian
            else:
                stack[sp - 1] = _function(op, stack[sp - 1], per_radian)
        elif op == OP_JUMP_BACK:
            pc = code[pc]
            state[S_JUMPS] += 1
            if state[S_JUMPS] >= 2:
                state[S_JUMPS] = 0
                status = JUMPED_BACK
                break
        elif op == OP_SCAN_END:
            pc = code[pc]
            status = SCAN_END
            break
        elif op == OP_EVENT:
            count = code[pc + 1]
            if used + 2 + count > EVENT_WORDS:
                status = FAULT
                break
            events[used] = code[pc]
            events[used + 1] = count
            sp -= count
            for k in range(count):
                events[used + 2 + k] = stack[sp + k]
            used += 2 + count
            pc += 2
            if state[S_SUSPEND] != 0:
                status = EVENTS
                break
        elif op == OP_ADDRESS:
            if code[pc] > 0:
                state[S_MOTOR_ADDRESS] = code[pc]
            if code[pc + 1] > 0:
                state[S_CS] = code[pc + 1] - 1
            pc += 2
        elif OP_LOAD_FIELD <= op <= OP_STORE_FLOAT_AT:
            pc, sp = _access(x, y, dirty, code, stack, op, state[S_R1], pc, sp)
        elif op == OP_COPYREG:
            for k in range(5):
                write_float48(x, y, 0x6000 + ((code[pc] + k) & 8191), regs[k])
            pc += 1
        elif op == OP_MOTOR:
            stack[sp] = float(state[S_MOTOR])
            sp += 1
        elif op == OP_RETURN_VALUE:
            sp -= 1
            regs[REG_RETURN] = stack[sp]
            regs[REG_RETURNED] = 1.0
            pc = 0
            status = FINISHED
            break
        elif op == OP_INT_DIV:
            sp -= 1
            stack[sp - 1] = math.floor(divide(stack[sp - 1], stack[sp]) + 0.5)
        elif op == OP_WRAP24:
            stack[sp - 1] = modulo(stack[sp - 1], -8388608.0)
        elif op == OP_CALL:
            depth = int(stack[call_base])
            if depth >= 15:
                status = FAULT
                break
            stack[call_base + 1 + depth] = float(pc + 1)
            stack[call_base] = depth + 1
            pc = code[pc]
        elif op == OP_RETURN:
            depth = int(stack[call_base])
            if depth == 0:
                pc = 0
                status = FINISHED
                break
            stack[call_base] = depth - 1
            pc = np.int64(stack[call_base + depth])
        elif op == OP_END:
            pc = 0
            status = FINISHED
            break
        else:
            status = FAULT
            break
        if sp >= call_base - 1:
            status = FAULT
            break
    if status == FINISHED or status == SCAN_END or status == FAULT:
        sp = 0
        state[S_JUMPS] = 0
    state[S_PC] = pc
    state[S_SP] = sp
    state[S_EVENTS] = used
    state[S_STEPS] = steps
    return status
