"""What to gather: sources, period, and the buffer that takes the samples.

The servo-cycle counter X:$0 is always the last source, so that every sample proves its own time.
What a count is worth in um is the business of ``workflow``. Source: Software Reference Manual
p. 170-171, 307; User Manual p. 401-402.
"""

from dataclasses import dataclass
from enum import Enum
from typing import Final

from pmac_comp.base.errors import ConfigError
from pmac_comp.machine.controller.card import registers as reg
from pmac_comp.machine.wire.gather_words import SampleLayout

COUNTER_NAME: Final = "servo_cycle"
SOURCES_MAX: Final = 48


class GatherMode(Enum):
    """Value of I5000."""

    RAM = 0
    RAM_WRAP = 1
    DPRAM = 2
    RING = 3


@dataclass(frozen=True)
class GatherSource:
    """One register to gather.

    Parameters
    ----------
    name : str
        Name of the column.
    address : int
        Word of I5001-I5048: kind in the first hex digit, address below.
    counter : bool
        Whether a 24-bit word counts around and is to be unwrapped.
    """

    name: str
    address: int
    counter: bool = False

    @property
    def width(self) -> int:
        """24-bit words: 1 or 2."""
        return reg.GatherAddress(self.address).n_words


def motor_source(name: str, motor: int, offset: int) -> GatherSource:
    """48-bit register of a motor, e.g. ``motor_source("actual", 1, registers.ACTUAL)``."""
    return GatherSource(name, reg.LONG | reg.motor_register(motor, offset))


def output_source(name: str, motor: int) -> GatherSource:
    """Servo command of a motor, 24 bits, 1/256 DAC unit."""
    return GatherSource(name, reg.X_WORD | reg.motor_register(motor, reg.OUTPUT))


def bench_sources(motor: int, scale_motor: int | None) -> tuple[GatherSource, ...]:
    """What a calibration gathers.

    ``commanded`` (trajectory), ``actual``, ``master`` (law), ``compensation`` (tables), ``scale``
    in 1/(32 Ixx08) count of their motors; ``output`` in 1/256 DAC unit.
    """
    sources = [
        motor_source("commanded", motor, reg.COMMANDED),
        motor_source("actual", motor, reg.ACTUAL),
        motor_source("master", motor, reg.MASTER),
        motor_source("compensation", motor, reg.COMPENSATION),
    ]
    if scale_motor is not None:
        sources.append(motor_source("scale", scale_motor, reg.ACTUAL))
    return (*sources, output_source("output", motor))


@dataclass(frozen=True)
class GatherPlan:
    """What to gather and how.

    Parameters
    ----------
    sources : tuple of GatherSource
        48-bit sources are put first (so that none straddles two long words), the servo counter
        last.
    period_cycles : int
        Servo cycles between samples, I5049.
    mode : GatherMode
        RAM buffer or DPRAM ring.
    dpram : str
        ``small`` or ``large``.
    """

    sources: tuple[GatherSource, ...]
    period_cycles: int = 1
    mode: GatherMode = GatherMode.RING
    dpram: str = "large"

    def __post_init__(self) -> None:
        given = [s for s in self.sources if s.name != COUNTER_NAME]
        names = [s.name for s in given]
        if len(set(names)) != len(names) or not given:
            raise ConfigError(f"Gather sources need different names: {names}.", code="PC-GAT-001")
        if len(given) + 1 > SOURCES_MAX:
            raise ConfigError(
                f"{len(given)} sources and the counter are more than {SOURCES_MAX}.",
                code="PC-GAT-002",
            )
        if not 1 <= self.period_cycles <= 8388607:
            raise ConfigError("The gather period is 1 to 8388607 cycles.", code="PC-GAT-003")
        if self.mode in {GatherMode.RING, GatherMode.DPRAM} and self.dpram not in reg.DPRAM_END:
            raise ConfigError(
                "This card has no dual-ported RAM.", code="PC-GAT-004", hint="Use the RAM buffer."
            )
        counter = GatherSource(COUNTER_NAME, reg.X_WORD | reg.SERVO_COUNTER)
        ordered = sorted(given, key=lambda s: -s.width)
        object.__setattr__(self, "sources", (*ordered, counter))

    @property
    def layout(self) -> SampleLayout:
        """Words of a sample."""
        padded = self.mode in {GatherMode.RAM, GatherMode.RAM_WRAP}
        return SampleLayout(tuple(s.width for s in self.sources), padded=padded)

    @property
    def cells(self) -> int:
        """Cells of the dual-ported RAM that the ring takes: whole samples."""
        room = reg.DPRAM_END[self.dpram] - reg.GATHER_RING + 1
        return room // self.layout.words * self.layout.words

    @property
    def ring_samples(self) -> int:
        """Samples that the ring holds."""
        return self.cells // self.layout.words

    def variables(self) -> dict[str, float]:
        """I-variables that set the plan up."""
        n = len(self.sources)
        masks = (1 << min(n, 24)) - 1, (1 << max(0, n - 24)) - 1
        return {
            "I5000": self.mode.value,
            **{f"I{5001 + k}": s.address for k, s in enumerate(self.sources)},
            "I5049": self.period_cycles,
            "I5050": masks[0],
            "I5051": masks[1],
        }
