"""How busy the controller's processor is, by the task times that it keeps itself.

PLC 0 takes its time from the background tasks: limit checks, PLCs 1-31, answers, the watchdog
(Software Reference Manual p. 42). What is left to them is measured, not only counted beforehand.

Source: User Manual p. 237-240 (task times and what interrupts them), Software Reference Manual
p. 57 (I40), I52, p. 495-497 (registers).
"""

from dataclasses import astuple, dataclass
from typing import Final

import numpy as np

from pmac_comp.base.errors import CommandRefused
from pmac_comp.base.units import MS_PER_S
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.numbers import parse_integer

# Phase interval; phase, servo and last real-time interrupt tasks; last background cycle: all in
# half CPU cycles. Lowest watchdog count. CPU frequency, RTI period, watchdog reload.
_QUESTION: Final = "RX$FFFF8C RX$37 RY$37 RX$B RX$22 RX$25 I52 I8 I40"
_LONGEST_WATCHDOG: Final = 4095  # servo cycles, where I40 is 0
_LOOKS: Final = 8
_LOOK_SPACING_s: Final = 0.003  # several servo cycles: tasks differ from one to the next
_WHOLE_TOLERANCE: Final = 0.1  # of a phase interrupt: as many come in each servo cycle


@dataclass(frozen=True)
class ProcessorLoad:
    """Shares of the processor's time, and what is left to the background.

    Parameters
    ----------
    half_cycles : float
        Half CPU cycles, the unit of the task times, in a servo cycle.
    phase_frac, servo_frac, rti_frac : float
        Share of phase, servo and real-time interrupt tasks (PLC 0, move planning).
    background_s : float
        Duration of the last background cycle, s.
    watchdog_frac : float
        Lowest watchdog count since power-up over the value that it starts from.
    """

    half_cycles: float
    phase_frac: float
    servo_frac: float
    rti_frac: float
    background_s: float
    watchdog_frac: float

    @property
    def foreground_frac(self) -> float:
        """What all tasks take that come before the background."""
        return self.phase_frac + self.servo_frac + self.rti_frac

    def share_frac(self, cpu_cycles: float, every_cycles: int) -> float:
        """Share of the time that a task of so many CPU cycles takes every so many servo cycles."""
        return 0.5 * cpu_cycles / (self.half_cycles * every_cycles)

    def as_dict(self) -> dict[str, float]:
        """For people and ``--json``."""
        return {
            "foreground_frac": round(self.foreground_frac, 4),
            "phase_frac": round(self.phase_frac, 4),
            "servo_frac": round(self.servo_frac, 4),
            "rti_frac": round(self.rti_frac, 4),
            "background_cycle_ms": round(MS_PER_S * self.background_s, 3),
            "watchdog_lowest_frac": round(self.watchdog_frac, 4),
        }


def read_load(link: Link, servo_period_s: float) -> ProcessorLoad | None:
    """Mean of some looks, which differ from cycle to cycle; None where they make no sense.

    A card that refuses to show one of the registers is such a one.

    Parameters
    ----------
    servo_period_s : float
        By I10, s.
    """
    found: list[ProcessorLoad] = []
    for k in range(_LOOKS):
        if k:
            link.clock.sleep_s(_LOOK_SPACING_s)
        try:
            values = [parse_integer(line) for line in link.query(_QUESTION)]
        except CommandRefused:
            return None
        load = load_of(values, servo_period_s)
        if load is not None:
            found.append(load)
    if not found:
        return None
    return ProcessorLoad(*np.mean([astuple(load) for load in found], axis=0).tolist())


def load_of(values: list[int], servo_period_s: float) -> ProcessorLoad | None:
    """Load by the nine answers to the question above.

    The timer of a task runs on while tasks of higher priority interrupt it: as often as their
    interrupts came meanwhile, their time is taken out (User Manual p. 239-240). A phase interval
    that is zero, or that does not go into the servo period a whole number of times at the
    frequency of I52, tells nothing.
    """
    interval, phase, servo, rti, background, lowest, i52, i8, i40 = values
    half_cycles = servo_period_s * 0.5e7 * (i52 + 1)
    per_cycle = half_cycles / interval if interval > 0 else 0.0
    n_phases = round(per_cycle)
    if n_phases < 1 or abs(per_cycle - n_phases) > _WHOLE_TOLERANCE:
        return None
    servo_net = servo - (phase + servo) // interval * phase
    until = phase + servo + rti
    rti_net = rti - until // interval * phase - until // (interval * n_phases) * servo_net
    return ProcessorLoad(
        half_cycles=half_cycles,
        phase_frac=phase / interval,
        servo_frac=servo_net / half_cycles,
        rti_frac=max(0.0, rti_net / (half_cycles * (i8 + 1))),
        background_s=background / half_cycles * servo_period_s,
        watchdog_frac=lowest / (i40 or _LONGEST_WATCHDOG),
    )
