"""Encoder and scale compared while the axis runs: what parts them ends the run and is named."""

from collections.abc import Callable

import numpy as np

from pmac_comp.base.arrays import IntArray
from pmac_comp.base.errors import MotorNotSafe, PmacCompError
from pmac_comp.base.units import MM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.motors.supervision import SensorFault, SensorWatch
from pmac_comp.machine.wire.numbers import read_number
from pmac_comp.workflow.bench.scales import Scales

MISMATCH_m = 0.5e-3  # encoder and scale further apart than any elasticity or lead error
# Faults after which the loop must not be trusted: the axis is killed, not held.
LOOP_BLIND = frozenset({SensorFault.ENCODER_DEAD.name, SensorFault.SLIP.name})


def block_watch(bench: Bench, scales: Scales) -> Callable[[dict[str, IntArray]], None] | None:
    """Watch for the raw blocks of a run; it raises where the sensors part. None without a scale."""
    if bench.scale is None:
        return None
    watch = SensorWatch(MISMATCH_m)

    def look(block: dict[str, IntArray]) -> None:
        require_agreement(
            watch.feed(scales.motor_m(block["actual"]), scales.table_m(block["scale"]))
        )

    return look


def jog_watch(link: Link, bench: Bench, scales: Scales) -> Callable[[], None]:
    """Watch for a jog: each call asks for both positions and raises where they part.

    The scale is read between two looks at the motor, so that a slow line does not part them.
    """
    if bench.scale is None:
        return lambda: None
    motor, scale = bench.encoder.motor_number, bench.scale.motor_number
    watch = SensorWatch(MISMATCH_m)
    start: list[float] = []

    def look() -> None:
        lines = link.query(f"#{motor}P#{scale}P#{motor}P")
        first, table, last = (float(read_number(text)) for text in lines)
        if not start:
            start.extend((first * scales.motor_m_per_ct, table * scales.scale_m_per_ct))
        ends = [place * scales.motor_m_per_ct - start[0] for place in (first, last)]
        seen = table * scales.scale_m_per_ct - start[1]
        nearest = min(max(seen, min(ends)), max(ends))
        require_agreement(watch.feed(np.array([nearest]), np.array([seen])))

    return look


def is_blind(error: PmacCompError) -> bool:
    """Whether an error says that the loop must not be trusted any more."""
    return error.context.get("fault") in LOOP_BLIND


def require_agreement(fault: SensorFault) -> None:
    """End a run whose sensors part; whoever catches it stops or kills the axis.

    Raises
    ------
    MotorNotSafe
        With the name of the fault in ``context``.
    """
    if fault is SensorFault.NONE:
        return
    done = "killed" if fault.name in LOOP_BLIND else "told to stop in closed loop"
    raise MotorNotSafe(
        f"{fault.value[0].upper()}{fault.value[1:]}: they parted by more than "
        f"{MISMATCH_m * MM_PER_M:g} mm. The axis was {done}.",
        code="PC-AXI-003",
        hint="Look at coupling, scale head and cables, and at the resolutions in the bench "
        "file, before anything moves again. Did the axis hum before? A loop that is unstable "
        "shakes them apart too: lower the gains.",
        context={"fault": fault.name},
    )
