"""What the law costs on the card's processor, and what a cheaper one would lose.

What lives here: the share of a servo period, counted beforehand and measured on the card, and the
words for people. What may not: the count of operations and the card's task times
(``machine.controller``), the fit (``physics.compensate``).
"""

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from pmac_comp.base.errors import SafetyRefusal
from pmac_comp.base.progress import Progress
from pmac_comp.base.units import MS_PER_S, US_PER_S
from pmac_comp.files.bench import Bench
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.processor_load import ProcessorLoad, read_load
from pmac_comp.machine.controller.law.law_cost import law_cost_cycles, servo_cost_cycles
from pmac_comp.physics.compensate.design import slower_law
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.loop import model_loop
from pmac_comp.physics.compensate.motions import design_motions
from pmac_comp.physics.compensate.promise import promise
from pmac_comp.workflow.law.routes import LATENCY_CYCLES

if TYPE_CHECKING:
    from pmac_comp.physics.model.drive import DriveModel

ASKED = "every_asked"  # of a law that would not fit into the rhythm that was asked for
CHEAP_FRAC = 0.25  # of a servo period: more than this is said, and cheaper laws are offered
# Of the processor's time: a law that takes more would leave too little beside phase and servo tasks
# (11 % with two motors at 80 MHz) for the background, where limits are checked.
MOST_FRAC = 0.84
BUSIEST_FRAC = 0.95  # all that comes before the background, by the card's own task times
# By which looks at the task times of one card differ, and what the interrupt itself takes: a law
# that was counted to fit, at the edge, is not taken back for it.
_SCATTER_FRAC = 0.01
_SLOWEST_CYCLES = 4


@dataclass(frozen=True)
class CheaperLaw:
    """A law that runs less often, and what the model expects of it over the design motions.

    Parameters
    ----------
    every_cycles : int
        Servo cycles between two passes.
    share_frac : float
        Share of the processor's time.
    e_r_um, total_um : float
        Rms over the design motions.
    """

    every_cycles: int
    share_frac: float
    e_r_um: float
    total_um: float


def share_frac(bench: Bench, law: CompensationLaw) -> float:
    """Share of the processor's time that PLC 0 takes with a law."""
    return _cost_us(bench, law) / (bench.servo_period_s * US_PER_S) / law.every_cycles


def _lacks(law: CompensationLaw) -> list[str]:
    """Parts that a law does not have, by their names in the count of operations."""
    has = {
        "friction_per_turn": law.turn_friction_Nm != 0.0,
        "wobble": law.is_wobble,
        "cogging": law.ripple_Nm != 0.0,
        "place": law.torque_place_Nm_per_m != 0.0,
        "gap": law.gap_half_m > 0.0,
        "uneven": law.torque_uneven_Nm_s_per_m != 0.0,
        "ripple": law.turn_share != 0.0,
        "bed": law.bed_share > 0.0,
        "drag": law.drag_m > 0.0,
        "stribeck": law.has_stribeck,
    }
    return [part for part in has if not has[part]]


def _cost_cycles(law: CompensationLaw) -> float:
    """CPU cycles of a pass of PLC 0."""
    return law_cost_cycles(_lacks(law))


def _cost_us(bench: Bench, law: CompensationLaw) -> float:
    """Time of a pass of PLC 0 in us."""
    return _cost_cycles(law) / bench.controller.cpu_clock_MHz


def cost_text(bench: Bench, law: CompensationLaw) -> str:
    """What a pass of the law costs, for people."""
    every = law.every_cycles
    rhythm = "each servo cycle" if every == 1 else f"every {every} servo cycles"
    if ASKED in law.provenance:
        rhythm += f" (more often, every {law.provenance[ASKED]}, it would not fit)"
    share = 100.0 * share_frac(bench, law)
    return (
        f"PLC 0 takes about {_cost_us(bench, law):.0f} us in {rhythm}, {share:.0f} % of the "
        f"processor's time at {bench.controller.cpu_clock_MHz:g} MHz"
    )


def cost_refusals(
    bench: Bench, law: CompensationLaw, load: ProcessorLoad | None = None
) -> list[SafetyRefusal]:
    """Refusal of a law whose passes of PLC 0 leave the processor too little time for the rest.

    By the task times of the card where they are known, else by the clock of the bench file.
    """
    if _over_room(bench, law, load) <= 1.0:
        return []
    beside = "" if load is None else f" beside {_tasks_text(load)} by the card's own task times"
    return [
        SafetyRefusal(
            f"{cost_text(bench, law)}{beside}: too little would be left for the background tasks, "
            "which check limits and serve the watchdog.",
            code="PC-LAW-043",
            hint=f"Compute it for fewer passes (`--every {fitting_cycles(bench, law, load)}` of "
            "`pmac-comp compensate`), or for the open servo (--route servo).",
        )
    ]


def servo_cost_refusals(
    bench: Bench, law: CompensationLaw, load: ProcessorLoad | None
) -> list[SafetyRefusal]:
    """Refusal of a law that would leave too little time in an open servo that has none yet.

    By the task times of the card, in which the servo's own terms are, where they are known.
    """
    if load is None:
        fits = _servo_frac(bench, law) <= MOST_FRAC
    else:
        taken_frac = load.share_frac(servo_cost_cycles(_lacks(law)), 1)
        fits = load.foreground_frac + taken_frac <= BUSIEST_FRAC
    if fits:
        return []
    beside = "" if load is None else f", which is busy already: {load_text(load)}"
    return [
        SafetyRefusal(
            f"{_servo_cost_text(bench, law)}{beside}. Too little would be left for the background "
            "tasks, which check limits and serve the watchdog.",
            code="PC-LAW-053",
            hint="Take other load off the card, or compute it for PLC 0 with fewer passes: "
            f"{_seldom_text(bench, law)}.",
        )
    ]


def fitting_cycles(bench: Bench, law: CompensationLaw, load: ProcessorLoad | None = None) -> int:
    """Servo cycles between two passes of a law that leave the processor time: its own, or more."""
    over = min(_over_room(bench, law, load), float(_SLOWEST_CYCLES))
    return min(_SLOWEST_CYCLES, max(law.every_cycles, math.ceil(law.every_cycles * over)))


def _over_room(bench: Bench, law: CompensationLaw, load: ProcessorLoad | None) -> float:
    """What a law takes over what it may take; above 1 it does not fit."""
    if load is None:
        return share_frac(bench, law) / MOST_FRAC
    room_frac = BUSIEST_FRAC - load.phase_frac - load.servo_frac
    taken_frac = load.share_frac(_cost_cycles(law), law.every_cycles)
    return taken_frac / room_frac if room_frac > 0.0 else math.inf


def _tasks_text(load: ProcessorLoad) -> str:
    return f"phase tasks {100 * load.phase_frac:.0f} %, servo tasks {100 * load.servo_frac:.0f} %"


def load_text(load: ProcessorLoad | None) -> str:
    """How busy the card is, for people."""
    if load is None:
        return "the card's task times make no sense: how busy its processor is was not measured"
    return (
        f"the processor is busy {100 * load.foreground_frac:.0f} % of the time by the card's own "
        f"task times ({_tasks_text(load)}, real-time interrupt {100 * load.rti_frac:.0f} %); a "
        f"background cycle takes {MS_PER_S * load.background_s:.1f} ms"
    )


def require_time_left(link: Link, bench: Bench, route: str) -> str:
    """What is left to the background with the law running, measured before it is armed.

    Raises
    ------
    SafetyRefusal
        Too little: limits would be checked late.
    """
    load = read_load(link, bench.servo_period_s)
    if load is not None and load.foreground_frac > BUSIEST_FRAC + _SCATTER_FRAC:
        raise SafetyRefusal(
            f"With the law {load_text(load)}: too little is left for the tasks that check limits "
            "and serve the watchdog.",
            code="PC-LAW-044",
            hint=_LESS_BUSY[route],
        )
    return f"with the law {load_text(load)}"


_LESS_BUSY: Final = {
    "law": "Compute the law for fewer passes (`--every 2` or `--every 4` of `pmac-comp "
    "compensate`), or for the open servo (--route servo).",
    "servo": "An open servo runs in every servo cycle: take other load off the card, or compute "
    "the law for PLC 0 with fewer passes (`--route law --every 2` or `--every 4`).",
}


def cheaper_laws(
    bench: Bench,
    model: "DriveModel",
    law: CompensationLaw,
    progress: Progress | None = None,
    *,
    whole: CompensationLaw | None = None,
) -> tuple[CheaperLaw, ...]:
    """The law as it is, and run every second cycle and as often as a quarter of the time allows.

    ``whole`` is what will run and is counted, where the law itself is the model's part of it.
    """
    counted = law if whole is None else whole
    whole_frac = counted.every_cycles * share_frac(bench, counted)
    needed = min(_SLOWEST_CYCLES, max(2, math.ceil(whole_frac / CHEAP_FRAC)))
    loop, latency = model_loop(model), LATENCY_CYCLES["law"]
    offers: list[CheaperLaw] = []
    for every in sorted({law.every_cycles, 2, needed}):
        if progress is not None:
            progress("looking for a cheaper law", every / (needed + 1.0))
        other = law
        if every != law.every_cycles:
            other = slower_law(bench, law, loop, every, latency_cycles=latency)
        runs = [promise(other, loop, m, latency_cycles=latency) for m in design_motions(bench)]
        offers.append(
            CheaperLaw(
                every,
                whole_frac / every,
                float(np.sqrt(np.mean([run.e_r_after_um**2 for run in runs]))),
                float(np.sqrt(np.mean([run.total_after_um**2 for run in runs]))),
            )
        )
    return tuple(offers)


def cost_remarks(
    bench: Bench,
    route: str,
    law: CompensationLaw,
    offers: tuple[CheaperLaw, ...] = (),
) -> list[str]:
    """What the route costs on the card's processor, and the ways out where that is much."""
    if route == "servo":
        return [_servo_text(bench, law)]
    if route != "law":
        return []
    text, every_cycles = cost_text(bench, law), law.every_cycles
    if share_frac(bench, law) <= CHEAP_FRAC:
        return [text]
    slower = [offer for offer in offers if offer.every_cycles > every_cycles]
    here = [offer for offer in offers if offer.every_cycles == every_cycles]
    ways = "; ".join(_offer_text(offer, here) for offer in slower)
    if not ways and every_cycles == 1:
        ways = "run it every second cycle (`--every 2` of `pmac-comp compensate`)"
    elif not ways and every_cycles < _SLOWEST_CYCLES:
        ways = f"`--every {_SLOWEST_CYCLES}` of `pmac-comp compensate`"
    ways = ways or "no slower rhythm is left"
    fits = share_frac(bench, law) <= MOST_FRAC
    much = "more than a quarter" if fits else "more than it may, `upload` refuses it"
    servo_frac = _servo_frac(bench, law)
    if servo_frac < share_frac(bench, law):
        ways += (
            f"; or --route servo, whose compiled form takes about {100 * servo_frac:.0f} % in each "
            "servo cycle"
        )
    return [f"{text}: {much}. Cheaper: {ways}"]


def _servo_us(bench: Bench, law: CompensationLaw) -> float:
    """Time in us that the law takes of the open servo in each servo cycle."""
    return servo_cost_cycles(_lacks(law)) / bench.controller.cpu_clock_MHz


def _servo_frac(bench: Bench, law: CompensationLaw) -> float:
    """Share of the processor's time that the law takes in the open servo, every servo cycle."""
    return _servo_us(bench, law) / (bench.servo_period_s * US_PER_S)


def _servo_text(bench: Bench, law: CompensationLaw) -> str:
    """What the law costs in the open servo, and what is cheaper where that is much."""
    text = f"{_servo_cost_text(bench, law)}, beside the loop's own terms"
    text = text[0].lower() + text[1:]
    if _servo_frac(bench, law) <= CHEAP_FRAC:
        return text
    return f"{text}: more than a quarter. Cheaper: {_seldom_text(bench, law)}"


def _servo_cost_text(bench: Bench, law: CompensationLaw) -> str:
    return (
        f"In the open servo the law takes about {_servo_us(bench, law):.0f} us in each servo "
        f"cycle, {100 * _servo_frac(bench, law):.0f} % of the processor's time at "
        f"{bench.controller.cpu_clock_MHz:g} MHz"
    )


def _seldom_text(bench: Bench, law: CompensationLaw) -> str:
    """Rhythms of PLC 0 that take less than the open servo, the slowest if none does."""
    shares = {n: share_frac(bench, replace(law, every_cycles=n)) for n in (2, _SLOWEST_CYCLES)}
    less = [n for n, share in shares.items() if share < _servo_frac(bench, law)]
    ways = [f"--every {n} ({100 * shares[n]:.0f} %)" for n in less or [_SLOWEST_CYCLES]]
    return f"--route law with {' or '.join(ways)}"


def _offer_text(offer: CheaperLaw, here: list[CheaperLaw]) -> str:
    loss = ""
    if here:
        loss = (
            f", the model expects e_r {here[0].e_r_um:.2f} -> {offer.e_r_um:.2f} um and total "
            f"{here[0].total_um:.2f} -> {offer.total_um:.2f} um rms"
        )
    return f"--every {offer.every_cycles} ({100 * offer.share_frac:.0f} %{loss})"
