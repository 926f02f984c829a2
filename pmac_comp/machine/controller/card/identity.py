"""Who answers: model, firmware, memory and clock of the controller, as one fingerprint."""

import hashlib
from dataclasses import asdict, dataclass
from typing import Final

from pmac_comp.base.errors import CommandRefused, ConnectFailed
from pmac_comp.base.units import CLOCK_CT_PER_MS, MS_PER_S
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.numbers import parse_integer
from pmac_comp.machine.controller.card.registers import DPRAM_BASE, DPRAM_END
from pmac_comp.machine.controller.card.variables import read_one
from pmac_comp.machine.wire.identity import SIMULATED_ID

# Software Reference Manual p. 296.
CARDS: Final = {
    602191: "Turbo PMAC-PC",
    602199: "Turbo PMAC-VME",
    602404: "Turbo PMAC2-PC",
    602413: "Turbo PMAC2-VME",
    603182: "Turbo PMAC2-PC Ultralite",
    603367: "Turbo PMAC2-PCI",
    603382: "3U Turbo PMAC2 (UMAC, Geo Brick)",
}
OLDEST_FIRMWARE: Final = 1.934  # per-port addressing, ## groups (p. 270, 276)
NO_MODULE: Final = "0"  # answer to SID without an ID module (p. 331)


@dataclass(frozen=True)
class Identity:
    """Answers of a controller about itself.

    Parameters
    ----------
    card : int
        CID.
    card_name : str
        Its name.
    firmware, card_type, cpu : str
        Answers to VERSION, TYPE and CPU.
    dpram : str
        ``none``, ``small`` or ``large``.
    servo_period_s : float
        From I10.
    free_long_words : int
        SIZE.
    serial : str
        Number of its ID module (SID), ``0`` without one.
    """

    card: int
    card_name: str
    firmware: str
    card_type: str
    cpu: str
    dpram: str
    servo_period_s: float
    free_long_words: int
    serial: str = NO_MODULE

    @property
    def is_simulated(self) -> bool:
        """Whether the controller says itself that it is a simulated one."""
        return self.serial == SIMULATED_ID

    @property
    def is_alone(self) -> bool:
        """Whether no other controller answers alike: it has an ID module."""
        return self.serial not in {NO_MODULE, SIMULATED_ID}

    @property
    def fingerprint(self) -> str:
        """SHA-256 over what does not change from day to day."""
        fixed: tuple[object, ...] = (
            self.card,
            self.firmware,
            self.card_type,
            self.cpu,
            self.dpram,
            *((self.serial,) if self.is_alone else ()),
        )
        return hashlib.sha256(repr(fixed).encode()).hexdigest()[:16]

    def as_dict(self) -> dict[str, object]:
        """For ``--json``."""
        return {**asdict(self), "fingerprint": self.fingerprint}


def read_identity(link: Link) -> Identity:
    """Ask the controller who it is; five questions.

    Raises
    ------
    ConnectFailed
        Not a Turbo PMAC, or firmware older than 1.934. Nothing was written.
    """
    answers = [line.strip() for line in link.query("CID VER TYPE CPU SIZE")]
    if len(answers) != 5 or not answers[0].isdigit():
        raise ConnectFailed(
            f"What answers is no Turbo PMAC: {answers[:5]!r}.",
            code="PC-CID-001",
            hint="Check the address; the packet port of a Turbo PMAC is 1025.",
        )
    card, firmware, card_type, cpu, free = answers
    if not card_type.upper().startswith("TURBO") or _version(firmware) < OLDEST_FIRMWARE:
        raise ConnectFailed(
            f"{card_type} with firmware {firmware} is not supported.",
            code="PC-CID-002",
            hint=f"A Turbo PMAC with firmware {OLDEST_FIRMWARE} or later is needed.",
        )
    servo_period_s = read_servo_period_s(link)
    return Identity(
        card=int(card),
        card_name=CARDS.get(int(card), "unknown card"),
        firmware=firmware,
        card_type=card_type,
        cpu=cpu,
        dpram=_dpram(link),
        servo_period_s=servo_period_s,
        free_long_words=parse_integer(free),
        serial=_serial(link),
    )


def read_servo_period_s(link: Link) -> float:
    """Servo period that the controller states in I10, s."""
    return read_one(link, "I10") / CLOCK_CT_PER_MS / MS_PER_S


def _serial(link: Link) -> str:
    """Number of the ID module; firmware that does not know the question has none."""
    try:
        lines = link.query("SID")
    except CommandRefused:
        return NO_MODULE
    return lines[0].strip() if lines else NO_MODULE


def _version(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return 0.0


def _dpram(link: Link) -> str:
    end = parse_integer(link.query("RY$3F")[0]) & 0xFFFFFF  # end + 1 (p. 495)
    for name, last in DPRAM_END.items():
        if end == last + 1:
            return name
    return "none" if end <= DPRAM_BASE else "large"
