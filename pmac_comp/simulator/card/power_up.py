"""Power-up, factory reset and the image that SAVE writes.

Source: Turbo PMAC Software Reference Manual p. 271-275 (reset), 394 (SAVE).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pmac_comp.simulator.language.scanner import Scanner
from pmac_comp.simulator.language.statements import MOTION, PLC
from pmac_comp.simulator.memory import registers as r
from pmac_comp.simulator.memory.flash import FlashDamaged, Image
from pmac_comp.simulator.memory.ivariables import TABLE
from pmac_comp.simulator.memory.memory import DPRAM_END_LARGE, DPRAM_END_SMALL, DPRAM_START
from pmac_comp.simulator.programs.axes import read_definition
from pmac_comp.simulator.programs.programs import Program, parse_program
from pmac_comp.simulator.servo.servo_tuning import pmac_gains

if TYPE_CHECKING:
    from pmac_comp.simulator.card.card import Card

_DPRAM_ENDS = {"small": DPRAM_END_SMALL, "large": DPRAM_END_LARGE, "none": DPRAM_START}
_SAVED_RANGES = (
    (r.M_DEFINITIONS, r.USER_BUFFER_START - r.M_DEFINITIONS),  # M definitions, P, Q
    (r.BLCOMP_POINTERS, r.MEMORY_END - r.BLCOMP_POINTERS),
)


def fixed_registers(card: Card) -> None:
    """Registers that no command writes and that hold from power-up on."""
    m = card.memory
    m.x[r.MEMORY_END] = r.USER_BUFFER_END_STANDARD
    m.y[r.DPRAM_END_REGISTER] = _DPRAM_ENDS[card.dpram]
    m.x[r.GLOBAL_STATUS] |= r.G1_THIS_CARD
    m.y[r.GLOBAL_STATUS] |= r.G2_UMAC
    # Task times in half CPU cycles, what load monitors read; those of servo and real-time interrupt
    # and of the background follow from what runs.
    m.x[r.TASK_TIME] = 180
    m.y[r.RTI_TIME] = m.y[r.BACKGROUND_TIME] = 0
    m.x[r.WATCHDOG_COUNT] = 0xFFFFFF


def restore(card: Card) -> bool:
    """Bring up what flash keeps, or the bench's set-up if nothing was saved.

    Returns
    -------
    bool
        True if the image is damaged: the card then has its factory values.
    """
    damaged = False
    card.programs.password, card.programs.unlocked = "", True  # unless it was saved
    try:
        image = card.flash.load()
    except FlashDamaged:
        damaged = True
    else:
        if image is None:
            _apply_bench(card)
        else:
            _apply_image(card, image)
    _start(card)
    return damaged


def _apply_bench(card: Card) -> None:
    """I-variables of the bench file, as though they had been saved."""
    bench = card.bench
    for number, value in ((3, 2.0), (4, 0.0), (6, 1.0), (9, 2.0)):
        card.variables.write_i(number, value)
    for motor in bench.motor_numbers:
        card.variables.write_i(100 * motor, 1.0)
        entry = 8000 + motor - 1
        is_encoder = motor == bench.encoder.motor_number
        if not is_encoder or bench.encoder.extension == "none":
            card.variables.write_i(entry, float(0xC00000 | r.channel_base(motor)))
    card.variables.write_i(52, max(0.0, round(bench.controller.cpu_clock_MHz / 10.0) - 1.0))
    # A bench file that states no I10 still has a servo period; the clock must agree with it.
    card.variables.write_i(10, float(round(bench.servo_period_s * 1e3 * 8388608.0)))
    for tail, value in pmac_gains(bench).items():
        card.variables.write_i(100 * bench.encoder.motor_number + tail, value)
    for name, value in bench.controller.ivariables.items():
        card.variables.write_i(int(name[1:]), value)


def _apply_image(card: Card, image: Image) -> None:
    for number, value in image.variables.items():
        card.variables.write_i(number, value)
    for start, words in image.cells.items():
        card.memory.x[start : start + words.shape[1]] = words[0]
        card.memory.y[start : start + words.shape[1]] = words[1]
    for kind, texts, table in (
        (MOTION, image.programs, card.programs.programs),
        (PLC, image.plcs, card.programs.plcs),
    ):
        for number, text in texts.items():
            program = Program(kind, number, parse_program(text, kind))
            program.reassemble()
            table[number] = program
    for cs, motor, text in image.axes:
        definition = read_definition(Scanner(text))
        if definition is not None:
            card.systems[cs].axes[motor] = definition
    card.programs.password = image.password
    card.programs.unlocked = not image.password


def _start(card: Card) -> None:
    _set_phase_interval(card)
    card.programs.update_memory()
    card.servo.boot()
    _power_up_motors(card)
    for system in card.systems.values():
        for motor in system.axes:
            card.write_assignment(motor)
    for number in range(32):
        card.plcs.reload(number)
    card.plcs.enable_all()
    card.memory.touch()


def _set_phase_interval(card: Card) -> None:
    """Time between phase interrupts in half CPU cycles (I52); never zero."""
    half_cycles_per_s = 0.5e7 * (card.variables.int_i(52) + 1)
    interval = card.bench.servo_period_s * half_cycles_per_s / (card.variables.int_i(7002) + 1)
    card.memory.x[r.PHASE_INTERVAL] = max(1, round(interval))


def _power_up_motors(card: Card) -> None:
    """Ixx80 bit 0: close the loop at power-up (p. 271-275)."""
    for motor in card.servo.active_motors():
        if card.variables.int_i(100 * motor + 80) & 1:
            card.servo.enable(motor)


def factory_reset(card: Card) -> None:
    """``$$$***``: factory values in memory; flash keeps what it has."""
    memory = card.memory
    for system in card.systems.values():
        memory.y[system.base + r.C_STATUS2_ADDRESS] = memory.y[system.base + r.C_STATUS13] = 0
        system.power_up()
    for motor in card.servo.active_motors():
        card.servo.kill(motor)
    for base in map(r.motor_base, range(1, r.MOTORS + 1)):
        memory.y[base + r.M_STATUS2] = memory.y[base + r.M_IXX86] = 0
    card.variables.set_factory_values()
    card.programs.clear_all()
    card.programs.password, card.programs.unlocked = "", True
    card.rotary.delete_all()
    card.gathering.stop()
    card.gathering.delete()
    card.tables.delete_all()
    for number in range(32):
        card.plcs.reload(number)
    card.servo.boot()
    for system in card.systems.values():
        for motor in system.axes:
            card.write_assignment(motor)


def saved_image(card: Card) -> Image:
    """What SAVE writes to flash (p. 394)."""
    cells: dict[int, NDArray[np.int32]] = {}
    for start, count in (*_SAVED_RANGES, _table_range(card)):
        if count:
            cells[start] = np.stack(
                [card.memory.x[start : start + count], card.memory.y[start : start + count]]
            )
    return Image(
        {n: card.variables.read_i(n) for n, v in TABLE.items() if not v.fixed},
        cells,
        {n: _program_text(p) for n, p in card.programs.programs.items()},
        {n: _program_text(p) for n, p in card.programs.plcs.items()},
        [(s.number, m, d.text()) for s in card.systems.values() for m, d in s.axes.items()],
        card.programs.password,
    )


def _table_range(card: Card) -> tuple[int, int]:
    """Memory of the compensation tables, at the end of the user area."""
    end = int(card.memory.x[r.MEMORY_END])
    starts = [
        int(card.memory.x[pointers + k])
        for pointers in (r.BLCOMP_POINTERS, r.TCOMP_POINTERS, r.COMP_POINTERS)
        for k in range(r.MOTORS)
    ]
    lowest = min((s for s in starts if s), default=end)
    return lowest, end - lowest


def _program_text(program: Program) -> str:
    """Text of a program that can be entered again, without its RETURN."""
    return "\n".join(text for _, text in program.lines(long=True)[:-1])
