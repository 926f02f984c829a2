"""Where the feed-forward law lives in P-variables: one layout for host, PLC 0 and open servo.

What lives here: the exact indices, the two banks of coefficients with their seal, and the law as
arithmetic on counts and servo cycles, written once more so that every form of it can be held
against this one. What may not: physics (SI), sockets, files. Imports ``base`` only.

Block (first variable ``P7000`` unless the bench says otherwise), offsets from the first variable::

    0  signature   written by the running algorithm at rest: 20261 PLC 0, 20262 open servo
    1  bank        index of the bank in use (0 or 1), written by the host only
    2  target      gain the algorithm ramps to (0 off .. 1 on), host
    3  gain        present gain, algorithm
    4  clamp       largest correction in counts, host
    5  heartbeat   -1 not used; > 0 servo cycles left, counted down; at 0 the target becomes 0
    6  slew        change of the gain per servo cycle, host
    7  motor       number of the motor concerned, host
    8  out scale   units of the master word (X:$10F8) per count = 32 Ixx08 / Ixx07, host
    9  in scale    counts per unit of the commanded position register = 1 / (32 Ixx08), host
    10..39  bank 0      40..69  bank 1      (offsets within a bank: ``BankIndex``)
    70..77  manifest of the last upload     78..83  lease, guard, number of the last change
            (``manifest`` and ``lease`` have the meaning)
    84..91  rest of bank 0   92..99  rest of bank 1
    100..129  working variables of the PLC 0 form, 130..147 and 150..157 of the open servo; of those
              the other form uses what it lacks: PLC 0 131..133 (bed that swings: b, its speed and
              place), 134..157 but 150 (jerk, look-ahead, ripple, copy of the bank's rest), the open
              servo 113..129 but 116 (115 jerk, 127..129 bed)
    106, 148, 149  last values of bank 0   116, 158, 159  of bank 1: of the working variables what
              no form uses
    160..189  working copy of the bank in use (PLC 0 form); 160..174 the open servo's (ripple,
              rests, friction that turns over, hand-over registers)
    190..199  parameters of the motion and homing programs, no part of the law

The law, all quantities in counts and servo cycles (SC), r = commanded position of the motor
(register D:$88, before any compensation)::

    v = dr                                                (differences over dn cycles; steps of
                                                          6/3072 and less are a rest, before
                                                          which less than 24/3072 is none)
    j = limit(dv - a, JL)         a += j                  acceleration with its jerk limited
    k = j, 0 where |dv - a| > 2 JL                        a step of it: the torque answers no jerk
    d = (v + L1 (a + (L1 + dn) j / 2)) dn                 way of a cycle L1 cycles later
    h = |v| dn S_INV                                      way of the command
    u = d S_INV          s = (s + u) / (1 + |u|)          friction state, follows distance
    m = SL m + (1 - SL) s                                 the same with a lag
    w = d T_INV          t = (t + w) / (1 + |w|)          the same for the torque
    x = (w - |w| t) / dn                                  by how much it turns over
    y = BS a + BD y1 + BO y2                              bed that swings: its acceleration, speed
    y1 = y1 - y          y2 = y2 + y1                     and place, in passes and by the correction
    b = (b - h y) / (1 + h)                               what the table feels of it, but
        between -y - B0 (1 + s) and -y + B0 (1 - s)     B0 = S0 + SX
      or, where BS < 0, what drags at the table and turns over within -BS counts:
    b = (BD d - BS b) / (|d| - BS)                      follows distance as the friction states
    z = (SS d)^2         w = 1/(1 + z + z^2/2)            what speed leaves of Stribeck friction,
                                                          or lacks where friction sets in with it
    e = A0 a + V0 v + VU |v| + (S0 + SX w) m + b         VU, TU: only with a GH of zero
    f = GB + e + L1 A0 j                                  with a constant load, L1 cycles later
    g = f / max(GW, |f|), at rest as it was               flank: goes with the force
    l = l + GL (g - l)                                    flank as the motor changes it
    c = (1 + C1 r) e + GH (l - l0) + J0 j                l0 = GB / max(GW, |GB|)
    correction = gain clamp(c)         is ADDED to the command (positive moves the motor up)
    p = r + L1 v                                          place of the screw
    q = TJ a + TK k + TI (j' - j") + TB v + (TC + TX w + TE |a|) t + T0 + TP r + BT b
        + TF x + TL x' + TR sin(NR p + PR) (t, or 1 where NR < 0), but where TR < 0
          TR sin(NR r' + PR + 45 t) v^3, with r' = r in PLC 0 and r - v in the open servo
    q = q + (q + RT a + RV v) RS sin(NR p + PR)            RS: with a GH or BS of zero and no TR
    q = q + TH sin(NH p + PH) + TU |v| + TG (g - l)
    torque = gain limit(q)             16-bit DAC units, added to the servo output

The friction state is the implicit Euler form of ds/dx = (sign - s) S_INV: it needs no direction
logic, holds its value at standstill and never overshoots. It looks L1 cycles ahead, so that the
step at a reversal arrives with the axis in spite of latency, delay and current loop. Over the first
100 cycles of a rest t fades by RF and s by UF h / (h + R) a cycle, with h how hard the motion ended
(the mean of |a|, each pass of a motion a tenth of the way to it) and R = 0.3 (S0 + SX) / A0, or 0
with a bed; PLC 0 and the open servo look at what the
output holds over a longer rest and begin the next motion from there; what they then send against
the integrator gives way in the 100 cycles after those where it pushes as t does
(``feedforward_law.plc0``).
"""

import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from enum import IntEnum
from typing import Final

import numpy as np

from pmac_comp.base.arrays import BoolArray, FloatArray, finite_array
from pmac_comp.base.errors import ConfigError, VerifyMismatch
from pmac_comp.machine.controller.card.numbers import nine_digits

SIGNATURE_PLC: Final = 20261
SIGNATURE_SERVO: Final = 20262
SEAL: Final = 1 << 28  # a seal is a checksum with this bit: nine digits, never by chance
BANK_SIZE: Final = 30  # variables in a row; the rest of a bank stands elsewhere
REST_SIZE: Final = 8
_LAST: Final = (106, 148, 149)  # offsets of the last ones of bank 0: among working variables
_LAST_APART: Final = 10  # in bank 1 so many variables later than in bank 0
BANK_VALUES: Final = BANK_SIZE + REST_SIZE + len(_LAST)
# Offsets that the open servo writes for every motor that runs through it.
OF_EVERY_MOTOR: Final = (*range(150, 158), 162, *range(170, 175))
BLOCK_SIZE: Final = 200
DEFAULT_FIRST: Final = 7000
MASTER_WORD_ADDRESS: Final = 0x10F8  # one of the 16 open registers (Reference Manual p. 503)
MASTER_SCALE_IXX07: Final = 3  # with Ixx08 = 96 one unit of the master word is 1/1024 count
REST_CYCLES: Final = 100  # of a rest, in which the friction states fade
# How hard a motion ends: of the way to the present acceleration in a cycle, and of the acceleration
# that loads the nut as friction does.
_HARDNESS_SHARE: Final = 0.1
_SOFT_FRAC: Final = 0.3
_NO_ACCELERATION: Final = 1e-9  # counts/SC^2
_WOBBLE_LEAD_deg: Final = 45.0  # of the torque against the wobble of the lead, in the way it goes
STEP: Final = 2.0  # of the jerk limit: beyond, it is a step of the acceleration
# Of a bank: the checksum begins with it, so that another layout's does not fit, nor that of a law
# whose flank follows the force over a way.
_LAYOUT: Final = 16
# Of a servo cycle, of the commanded position: its register has steps of 1/3072 (Ixx08 = 96), by
# single ones of which it creeps after a move, and which the look-ahead makes more of.
_STILL_ct: Final = 6.0 / 3072
_SOFT_ct: Final = 24.0 / 3072  # an end from less is no step of the speed
# In one place each: of a gap or, without one, uneven friction and ripple; beside one ripple or bed.
_OF_GAP, _UNEVEN = ("TG", "GB", "GL", "GW"), ("TU", "VU")
_RIPPLE, _OF_BED = ("RS", "RT"), ("BD", "BO")
# Nothing without a jerk limit.
_OF_ACCELERATION: Final = ("A0", "J0", "TJ", "TK", "TI", "TE", "BS", "RT")


class Index(IntEnum):
    """Offsets of the head of the block."""

    SIGNATURE = 0
    BANK = 1
    TARGET = 2
    GAIN = 3
    CLAMP = 4
    HEARTBEAT = 5
    SLEW = 6
    MOTOR = 7
    OUT_SCALE = 8
    IN_SCALE = 9
    BANKS = 10
    MANIFEST = 70
    LEASE = 78
    CHANGE = 83  # number of the last change: positive under way, negative ended, 0 none
    RESTS = 84
    WORK_PLC = 100
    STEP_SERVO = 114  # largest acceleration of the command that is a motion, counts/SC^2; where
    STEP_PLC = 152  # the other form works, as no place is left that neither uses
    MOTIONS = 190  # homing and other motion programs
    IN_USE_PLC = 120  # bank in use, -1 loop open, -2 not sealed
    CORRECTION_PLC = 122  # before the gain, counts
    TORQUE_PLC = 124  # before the gain, DAC units; what is sent stands in Ixx29
    BED_SERVO = 127
    WORK_SERVO = 130
    BED_PLC = 131
    SCRATCH_SERVO = 150  # for every motor that runs through it; PLC 0 leaves it alone
    COPY = 160


class WorkIndex(IntEnum):
    """Offsets within the working variables; the open servo keeps the same order."""

    COUNTER = 0  # servo counter of the last pass
    POSITION = 1  # r, counts
    VELOCITY = 2  # v, counts/SC; PLC 0 by the pass, as the next
    ACCELERATION = 3  # a, counts/SC^2
    STATE = 4  # s
    TORQUE_STATE = 5  # t
    JERK = 6  # open servo: the jerk two cycles ago; PLC 0 keeps a bank's last value there
    FLANK = 7  # g
    ANSWERS_JERK = 8  # open servo: whether the torque answers the jerk
    CORRECTION = 9  # open servo: what was sent, counts
    TORQUE = 10  # open servo: what was sent, DAC units
    CLAMPED = 11  # passes in which the clamp acted
    ELAPSED = 12  # open servo: dn
    LIVE = 13  # open servo: 0 loop open, 1 or 2: bank 0 or 1 is in use, -1: bank not sealed


class BankIndex(IntEnum):
    """Offsets within a bank."""

    A0 = 0  # counts per (count/SC^2), as V0 and S0 at position zero
    C1 = 1  # 1/counts, change of the compliance along the travel
    V0 = 2  # counts per (count/SC)
    GL = 3  # share of the way to a new flank that the motor goes in a pass
    RS = 3  # without a clearance, else BD's: share of the torque that ripples, with NR and PR
    S0 = 4  # counts
    TG = 5  # DAC units while the nut crosses its clearance
    TU = 5  # without a clearance: DAC units per (count/SC), viscous friction more one way
    RF = 6  # 1/SC, share of the friction torque that fades in a cycle of rest
    GB = 7  # counts, elastic correction of the constant load that the nut carries
    VU = 7  # without a clearance: counts per (count/SC), what the screw makes of TU
    S_INV = 8  # 1/counts, inverse of the break-away distance of s
    TJ = 9  # DAC units per (count/SC^2)
    TB = 10  # DAC units per (count/SC)
    TC = 11  # DAC units
    J0 = 12  # counts per (count/SC^3)
    L1 = 13  # SC, look-ahead of friction states, flank and angle
    JL = 14  # counts/SC^3, largest jerk that the law follows
    T_INV = 15  # 1/counts, inverse of the break-away distance of t
    T0 = 16  # DAC units, constant, at position zero
    GW = 17  # counts, elastic correction at which all of GH is taken up
    RT = 17  # without a clearance, else BO's: DAC units per (count/SC^2), what the loop sends
    TR = 18  # DAC units, friction per turn, or a second cogging; below zero DAC units per
    # (count/SC)^3: what the loop lacks to follow a table that takes the lead's wobble away
    RV = 18  # beside RS: DAC units per (count/SC), what the loop sends
    PR = 19  # degrees
    TE = 20  # DAC units per (count/SC^2), friction that grows with load
    T_LIMIT = 21  # DAC units, largest torque feed-forward
    TK = 22  # DAC units per (count/SC^3), undoes delay and current loop
    TH = 23  # DAC units, cogging
    NH = 24  # degrees per count (I15 = 0)
    PH = 25  # degrees
    GH = 26  # counts, half the clearance of the nut; with it S0 and GW are positive
    NR = 27  # degrees per count, of TR; negative: TR pushes whichever way, as TH does
    SEALED = 28  # the checksum of the others, once the bank was read back
    TI = 29  # DAC units per (count/SC^3), against the ringing that steps of the jerk excite
    BS = 30  # counts per (count/SC^2), A0 times the bed's share; 0: no bed that swings; below zero
    # counts: the distance within which what drags at the table turns over
    BD = 31  # 1/pass, damping of the bed; with a BS below zero counts, the size of what drags
    BO = 32  # 1/pass^2, stiffness of the bed
    BT = 33  # DAC units per count, torque of the table's mass or of what drags
    SL = 33  # without either (BO's beside what drags): what a pass leaves of the way to a new s
    SX = 34  # counts, friction at rest beyond S0; -S0 where friction sets in with speed
    TX = 35  # DAC units, friction torque at rest beyond TC; -TC there
    SS = 36  # passes per count, inverse of the Stribeck speed; 0: no Stribeck friction
    TP = 37  # DAC units per count, load that changes along the travel
    UF = 38  # 1/SC, share of the table's friction state that fades in a cycle of rest
    TF = 39  # DAC units per (1/SC), while friction turns over, against the ringing of that
    TL = 40  # the same a pass later


@dataclass(frozen=True)
class LawBlock:
    """Addresses of the block whose first P-variable is ``first``."""

    first: int = DEFAULT_FIRST

    def __post_init__(self) -> None:
        if not 0 <= self.first <= 8192 - BLOCK_SIZE:
            raise ConfigError(
                f"A block of {BLOCK_SIZE} P-variables does not fit at P{self.first}.",
                code="PC-LAW-001",
                hint="Choose [controller] p_block with at least 200 variables below P8192.",
            )

    @classmethod
    def from_p_block(cls, p_block: Sequence[int]) -> "LawBlock":
        """Block at the start of the bench's ``p_block = [first, last]``.

        Raises
        ------
        ConfigError
            Fewer than 200 variables are allowed.
        """
        if p_block[1] - p_block[0] + 1 < BLOCK_SIZE:
            raise ConfigError(
                f"p_block P{p_block[0]}..P{p_block[1]} is smaller than {BLOCK_SIZE} variables.",
                code="PC-LAW-002",
                hint="Reserve 200 P-variables that no other program uses.",
            )
        return cls(p_block[0])

    def p(self, offset: int) -> int:
        """Number of the P-variable at an offset of the block."""
        return self.first + offset

    def bank(self, bank: int, offset: int = 0) -> int:
        """Number of the P-variable at an offset of bank 0 or 1."""
        if bank not in {0, 1}:
            raise ConfigError(f"There is no bank {bank}.", code="PC-LAW-003")
        if offset >= BANK_SIZE + REST_SIZE:
            return self.first + _LAST[offset - BANK_SIZE - REST_SIZE] + _LAST_APART * bank
        if offset >= BANK_SIZE:
            return self.first + Index.RESTS + REST_SIZE * bank + offset - BANK_SIZE
        return self.first + Index.BANKS + BANK_SIZE * bank + offset

    def bank_text(self, bank: int) -> str:
        """Question for all values of bank 0 or 1, in their order."""
        first, rest = self.bank(bank), self.bank(bank, BANK_SIZE)
        last = (self.bank(bank, k) for k in range(BANK_SIZE + REST_SIZE, BANK_VALUES))
        rows = f"P{first}..{first + BANK_SIZE - 1}P{rest}..{rest + REST_SIZE - 1}"
        return rows + "".join(f"P{number}" for number in last)


def bank_seal(values: Sequence[float]) -> int:
    """Seal of a bank: the low 28 bits of the CRC-32 of its coefficients in nine-digit text."""
    law = (*values[: BankIndex.SEALED], *values[BankIndex.SEALED + 1 :])
    text = " ".join(nine_digits(value) for value in law)
    return zlib.crc32(text.encode("ascii"), _LAYOUT) & (SEAL - 1) | SEAL


def _absent(clearance: float, bed: float, share: float) -> tuple[str, ...]:
    """Coefficients whose place others have: a law with a clearance has its own there."""
    by_turn = "RV" if share == 0.0 else "TR"
    of_bed = ("SL",) if bed > 0.0 else ("BO",) if bed < 0.0 else ("BT",)
    if clearance <= 0.0:
        return (by_turn, *of_bed, *_OF_GAP)
    return (by_turn, *of_bed, *_UNEVEN, *(_RIPPLE if bed != 0.0 else _OF_BED))


def _place(name: str, clearance: float, bed: float) -> BankIndex:
    """Place of a coefficient: beside a clearance torque that ripples has those of a bed."""
    if clearance > 0.0 and name in _RIPPLE:
        return BankIndex[_OF_BED[_RIPPLE.index(name)]]
    if name == "SL" and bed < 0.0:
        return BankIndex.BO
    return BankIndex[name]


@dataclass(frozen=True)
class LawParameters:
    """Coefficients of the law in counts and servo cycles (the module docstring has the law).

    Every value is rounded to nine significant digits and ten decimals at construction, so that
    what is compared after read-back is what was meant; a smaller coefficient becomes zero.
    """

    A0: float = 0.0
    V0: float = 0.0
    S0: float = 0.0
    C1: float = 0.0
    S_INV: float = 0.0
    TJ: float = 0.0
    TB: float = 0.0
    TC: float = 0.0
    J0: float = 0.0
    L1: float = 0.0
    JL: float = 0.0
    T_INV: float = 0.0
    T0: float = 0.0
    TE: float = 0.0
    T_LIMIT: float = 0.0
    TK: float = 0.0
    TI: float = 0.0
    TR: float = 0.0
    NR: float = 0.0
    PR: float = 0.0
    TH: float = 0.0
    NH: float = 0.0
    PH: float = 0.0
    GH: float = 0.0
    GW: float = 0.0
    GL: float = 1.0
    GB: float = 0.0
    RF: float = 0.01
    UF: float = 0.004
    TG: float = 0.0
    VU: float = 0.0
    TU: float = 0.0
    RS: float = 0.0
    RT: float = 0.0
    RV: float = 0.0
    BS: float = 0.0
    BD: float = 0.0
    BO: float = 0.0
    BT: float = 0.0
    SX: float = 0.0
    TX: float = 0.0
    SS: float = 0.0
    TP: float = 0.0
    TF: float = 0.0
    TL: float = 0.0
    SL: float = 0.0

    def __post_init__(self) -> None:
        values = finite_array("law parameters", [getattr(self, f.name) for f in fields(self)])
        for item, value in zip(fields(self), values, strict=True):
            object.__setattr__(self, item.name, float(nine_digits(float(value))))
        sizes = ("S_INV", "T_INV", "T_LIMIT", "JL", "GH", "GW", "BD", "BO", "SS")
        negative = [n for n in sizes if getattr(self, n) < 0.0]
        # Friction that sets in with speed has none at rest, but never less.
        below = {"SX": self.S0, "TX": self.TC}
        negative += [n for n, own in below.items() if getattr(self, n) < min(-own, 0.0)]
        if negative:
            raise ConfigError(f"{', '.join(negative)} must not be negative.", code="PC-LAW-004")
        still = {"BS"} if self.drags else set()
        idle = [n for n in _OF_ACCELERATION if getattr(self, n) != 0.0 and n not in still]
        if idle and self.JL == 0.0:
            raise ConfigError(
                f"With a jerk limit JL of zero {', '.join(idle)} would correct nothing.",
                code="PC-LAW-005",
                hint="Set JL above the largest jerk of the motions, in counts per servo cycle^3.",
            )
        if self.GH > 0.0 and min(self.S0, self.GW) <= 0.0:
            raise ConfigError(
                "GH needs a positive S0, which tells the flank of the gap, and a positive GW.",
                code="PC-LAW-006",
            )
        unset = {item.name: item.default for item in fields(self)}
        absent = _absent(self.GH, self.BS, self.RS)
        misplaced = [n for n in absent if getattr(self, n) != unset[n]]
        if misplaced:
            raise ConfigError(
                f"A law with GH = {self.GH:g}, BS = {self.BS:g} and RS = {self.RS:g} has no place "
                f"for {' and '.join(misplaced)}.",
                code="PC-LAW-009",
                hint="A law takes up a clearance, or has friction that differs by direction. "
                "Torque that ripples in proportion goes with one of clearance and bed, and "
                "not with friction by the turn.",
            )
        if not (0.0 <= self.RF <= 1.0 and 0.0 <= self.UF <= 1.0):
            raise ConfigError(
                f"RF = {self.RF} or UF = {self.UF} is not a share of friction from 0 to 1.",
                code="PC-LAW-008",
            )
        if not 0.0 <= self.SL < 1.0:
            raise ConfigError(
                f"SL = {self.SL} is no share of the way to a new friction state from 0 to below 1.",
                code="PC-LAW-013",
            )
        if not 0.0 < self.GL <= 1.0:
            raise ConfigError(
                f"GL = {self.GL} is not a share of the way to the new flank above 0 and up to 1.",
                code="PC-LAW-007",
            )

    @property
    def is_second_cogging(self) -> bool:
        """Whether TR is no friction: it pushes whichever way the screw turns."""
        return self.NR <= 0.0

    @property
    def drags(self) -> bool:
        """Whether BS, below zero, is the distance within which what drags turns over."""
        return self.BS < 0.0

    @property
    def is_wobble(self) -> bool:
        """Whether TR, below zero, lets the motor follow the wobble of the lead."""
        return self.TR < 0.0

    def values(self, *, sealed: bool = True) -> tuple[float, ...]:
        """All values of a bank, with its seal unless ``sealed`` is False."""
        bank = [0.0] * BANK_VALUES
        for name in self._names(self.GH, self.BS, self.RS):
            bank[_place(name, self.GH, self.BS)] = getattr(self, name)
        if sealed:
            bank[BankIndex.SEALED] = bank_seal(bank)
        return tuple(bank)

    @classmethod
    def _names(cls, clearance: float, bed: float, share: float) -> list[str]:
        """Coefficients of a bank, with or without clearance, bed that swings and ripple."""
        absent = _absent(clearance, bed, share)
        return [item.name for item in fields(cls) if item.name not in absent]

    @classmethod
    def from_values(cls, values: Sequence[float]) -> "LawParameters":
        """Parameters of a sealed bank that was read back.

        Raises
        ------
        VerifyMismatch
            The bank is not sealed or its checksum does not fit.
        """
        if len(values) != BANK_VALUES or values[BankIndex.SEALED] < SEAL:
            raise VerifyMismatch("The bank is not sealed.", code="PC-LAW-010")
        if int(values[BankIndex.SEALED]) != bank_seal(values):
            raise VerifyMismatch(
                "The checksum of the bank does not fit its values.",
                code="PC-LAW-011",
                hint="Upload the law again; somebody wrote into the block, or another version of "
                "pmac-comp did.",
            )
        try:
            gap, bed = values[BankIndex.GH], values[BankIndex.BS]
            share = 0.0 if gap > 0.0 and bed != 0.0 else values[_place("RS", gap, bed)]
            names = cls._names(gap, bed, share)
            return cls(**{name: values[_place(name, gap, bed)] for name in names})
        except ConfigError as error:
            raise VerifyMismatch(
                f"The bank is sealed but holds no law of this version: {error.message}",
                code="PC-LAW-012",
                hint="Upload the law again.",
            ) from error

    @property
    def held_flank(self) -> float:
        """Flank from -1 to 1 that the constant load on the nut holds at rest."""
        widest = max(self.GW, abs(self.GB))
        return self.GB / widest if widest > 0.0 else 0.0

    @property
    def digest(self) -> int:
        """Checksum that the sealed bank carries."""
        return bank_seal(self.values(sealed=False))


@dataclass(frozen=True)
class LawOutput:
    """What the law sends, arrays of shape (n,)."""

    correction_ct: FloatArray
    torque_dac: FloatArray
    n_clamped: int


def evaluate(
    parameters: LawParameters,
    position_ct: FloatArray,
    *,
    clamp_ct: float,
    gain: float = 1.0,
    start_state: Mapping[str, float] | None = None,
    latency_cycles: int = 0,
) -> LawOutput:
    """Correction in counts and torque in DAC units for a commanded position at every servo cycle.

    Parameters
    ----------
    parameters : LawParameters
        The bank.
    position_ct : FloatArray, shape (n,), counts
        Commanded position of consecutive servo cycles; the first one is taken as standstill.
    clamp_ct : float
        Amplitude limit of the correction in counts.
    gain : float
        Constant gain (a finished ramp).
    start_state : Mapping, optional
        ``s``, ``t`` and ``g`` at the start.
    latency_cycles : int
        1 for PLC 0, 0 for the open servo: what goes against a wobble comes a cycle late by either.

    Returns
    -------
    LawOutput
        The values of the same cycles: the servo receives them one cycle later from PLC 0 and in
        the same cycle from the open servo.
    """
    p = parameters
    r = finite_array("position_ct", position_ct)
    v = np.diff(r, prepend=r[0])
    rests = np.abs(v) <= _STILL_ct
    v[rests] = 0.0
    before = _a_pass_ago(v)
    soft_ends = rests & (before != 0.0) & (np.abs(before) < _SOFT_ct)
    a, j, answered = _jerk_limited(np.diff(v, prepend=0.0), p.JL, soft_ends)
    start = dict(start_state or {})
    way = v + p.L1 * (a + 0.5 * (p.L1 + 1.0) * j)
    unwinds = p.UF * _unwinding(p, a, rests)
    s = _fading_state(way * p.S_INV, rests, start.get("s", 0.0), unwinds)
    w = way * p.T_INV
    m = _towards(s, np.full_like(s, 1.0 - p.SL), start.get("s", 0.0))
    t = _fading_state(w, rests, start.get("t", 0.0), np.full_like(w, p.RF))
    angle = r + p.L1 * v
    slowness = (way * p.SS) ** 2
    slow = 1.0 / (1.0 + slowness * (1.0 + 0.5 * slowness)) if p.SS > 0.0 else np.zeros_like(way)
    level = p.TC + p.TX * slow + p.TE * np.abs(a)
    wave = p.TR * np.sin(np.radians(p.NR * angle + p.PR)) * (1.0 if p.is_second_cogging else t)
    if p.is_wobble:
        place = r - max(0, 1 - latency_cycles) * v
        wave = p.TR * np.sin(np.radians(p.NR * place + p.PR + _WOBBLE_LEAD_deg * t)) * v**3
    cogging = p.TH * np.sin(np.radians(p.NH * angle + p.PH))
    kick = p.TI * _a_pass_ago(np.diff(j, prepend=0.0))
    q = p.TJ * a + p.TK * answered + kick + p.TB * v + level * t
    turned = w - np.abs(w) * t
    q = q + p.TF * turned + p.TL * _a_pass_ago(turned) + p.T0 + p.TP * r + wave
    passed = np.abs(v) * p.S_INV
    felt = _dragged(p, way) if p.drags else _felt_of_bed(p, a, s, passed / (1.0 + passed))
    q = q + p.BT * felt
    q = q + (q + p.RT * a + p.RV * v) * p.RS * np.sin(np.radians(p.NR * angle + p.PR))
    q = q + cogging + p.TU * np.abs(v)
    elastic = p.A0 * a + p.V0 * v + p.VU * np.abs(v) + (p.S0 + p.SX * slow) * m + felt
    c = (1.0 + p.C1 * r) * elastic
    if p.GH > 0.0:
        foreseen = p.GB + elastic + p.L1 * p.A0 * j
        goal = foreseen / np.maximum(p.GW, np.abs(foreseen))
        held = p.held_flank
        first = start.get("g", held)
        flank = _towards(goal, np.where(rests, 0.0, 1.0), first)
        lagged = _towards(flank, np.full_like(flank, p.GL), first)
        c = c + p.GH * (lagged - held)
        q = q + p.TG * (flank - _a_pass_ago(lagged, first))
    c = c + p.J0 * j
    return LawOutput(
        correction_ct=gain * np.clip(c, -clamp_ct, clamp_ct),
        torque_dac=gain * np.clip(q, -p.T_LIMIT, p.T_LIMIT),
        n_clamped=int(np.count_nonzero(np.abs(c) > clamp_ct)),
    )


def _a_pass_ago(values: FloatArray, first: float = 0.0) -> FloatArray:
    """Values of the pass before each, and what was before the first."""
    return np.concatenate([[first], values[:-1]])


def _felt_of_bed(
    p: LawParameters, acceleration: FloatArray, friction: FloatArray, share: FloatArray
) -> FloatArray:
    """What the table feels of a bed that swings, by the correction that it needs, counts."""
    if p.BS == 0.0:
        return np.zeros_like(acceleration)
    felt = np.empty_like(acceleration)
    breaks = p.S0 + p.SX
    speed = place = value = 0.0
    for k in range(acceleration.size):
        swing = -(p.BS * acceleration[k] + p.BD * speed + p.BO * place)
        speed += swing
        place += speed
        value += share[k] * (swing - value)
        free = swing - breaks * friction[k]
        value = min(max(value, free - breaks), free + breaks)
        felt[k] = value
    return felt


def _dragged(p: LawParameters, way: FloatArray) -> FloatArray:
    """What drags at the table along the way of the place expected, counts of correction."""
    felt = np.empty_like(way)
    value = 0.0
    for k, step in enumerate(way.tolist()):
        value = (p.BD * step - p.BS * value) / (abs(step) - p.BS)
        felt[k] = value
    return felt


def _jerk_limited(
    acceleration: FloatArray, limit: float, soft_ends: BoolArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Acceleration that follows no faster than a limit per cycle, its jerk, the motion's own."""
    followed, jerk, own = (np.zeros_like(acceleration) for _ in range(3))
    value = 0.0
    for k, wanted in enumerate(acceleration.tolist()):
        if soft_ends[k] and abs(value) < _SOFT_ct:
            value = 0.0
            continue
        jerk[k] = min(max(wanted - value, -limit), limit)
        own[k] = jerk[k] if abs(wanted - value) <= STEP * limit else 0.0
        value += jerk[k]
        followed[k] = value
    return followed, jerk, own


def _unwinding(p: LawParameters, acceleration: FloatArray, rests: BoolArray) -> FloatArray:
    """Share of what may unwind at a rest that does, by how hard the motion before it ended."""
    soft = (p.S0 + p.SX) / p.A0 if p.A0 > 0.0 else math.inf
    soft = max(_NO_ACCELERATION, 0.0 if p.BS > 0.0 else _SOFT_FRAC * soft)
    hard = _towards(np.abs(_a_pass_ago(acceleration)), np.where(rests, 0.0, _HARDNESS_SHARE), 0.0)
    return hard / (hard + soft)


def _fading_state(
    u: FloatArray, rests: BoolArray, start: float, fade_per_cycle: FloatArray
) -> FloatArray:
    """Friction state that fades over the first cycles of a rest."""
    state = np.empty_like(u)
    value, rested = start, 0
    for k, (step, still) in enumerate(zip(u.tolist(), rests.tolist(), strict=True)):
        rested = rested + 1 if still else 0
        if 0 < rested < REST_CYCLES:
            value *= 1.0 - fade_per_cycle[k]
        value = (value + step) / (1.0 + abs(step))
        state[k] = value
    return state


def _towards(goal: FloatArray, share: FloatArray, start: float) -> FloatArray:
    """State that goes a share of the way to its goal in each pass."""
    state = np.empty_like(goal)
    value = start
    for k, (wanted, part) in enumerate(zip(goal.tolist(), share.tolist(), strict=True)):
        value += part * (wanted - value)
        state[k] = value
    return state
