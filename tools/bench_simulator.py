"""Speed of the simulated card as a multiple of real time, by CPU time of one core.

The card carries the paper's drive with all its hidden effects, an active position table and a
gather source set of six sources into the dual-ported RAM ring. Then: the feed-forward law in PLC 0
at every servo cycle, the same law as open servo, and a drive written in Python. The last figure is
the share of a core at real time, cut into the chunks of the server.
"""

import time
from pathlib import Path

from pmac_comp.files.bench import load_bench
from pmac_comp.machine.controller.contents.law_bank import Index, LawBlock, LawParameters
from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.plant import make_plant

ROOT = Path(__file__).resolve().parent.parent
BENCH = load_bench("paper")
MOTION = ("OPEN PROG 90 CLEAR", "ABS LINEAR TA200 TS100 F150", "WHILE(1=1)", "X40", "X-40",
          "ENDWHILE", "CLOSE", "#1->1000X", "&1B90R")  # fmt: skip


class PythonDrive:
    """A rigid axis with friction as a user would write it."""

    def __init__(self) -> None:
        self.angle = self.speed = 0.0
        self.period = BENCH.servo_period_s

    def reset(self, table_position_m: float = 0.0) -> None:
        self.angle, self.speed = table_position_m / BENCH.lead_m_per_rad, 0.0

    def step(self, torque_command_Nm: float) -> tuple[float, float]:
        drive = torque_command_Nm - 0.01 * self.speed
        friction = max(-0.4, min(0.4, drive + self.speed / self.period * 1.1e-3))
        self.speed += self.period * (drive - friction) / 1.1e-3
        self.angle += self.period * self.speed
        return self.angle, self.angle * BENCH.lead_m_per_rad


def say(card: Card, *lines: str) -> None:
    port = card.port()
    for line in lines:
        answer = port.line(line)
        if b"ERR" in answer:
            raise SystemExit(f"{line}: {answer!r}")


def firmware(name: str) -> list[str]:
    text = (ROOT / "firmware_plc" / name).read_text()
    lines = [line.split(";")[0].strip() for line in text.splitlines()]
    return [line for line in lines if line]


# Following of the master word, and the head of the law's block: no heartbeat, clamp 60 counts.
LAW_HEAD = ("I105=$10F8", "I107=3", "I106=3", "P7004=60", "P7005=-1", "P7006=0.001", "P7007=1",
            "P7008=1024", "P7009=0.000325520833")  # fmt: skip


def law_bank() -> list[str]:
    law = LawParameters(A0=11.0, V0=0.01, S0=0.9, S_INV=0.1, JL=0.01, L1=2.0, TJ=100.0, TB=1.0,
                        TC=300.0, T_INV=0.1, T_LIMIT=5000.0)  # fmt: skip
    block = LawBlock()
    values = [f"P{block.bank(0, k)}={v}" for k, v in enumerate(law.values())]
    return [*values, f"P{block.p(Index.BANK)}=0", f"P{block.p(Index.TARGET)}=1"]


def prepared(*, plant: object = None, law: str = "") -> Card:
    source = "\n".join(firmware("feedforward_servo.txt")) if law == "servo" else None
    card = Card(BENCH, plant=plant, servo_source=source)  # type: ignore[arg-type]
    say(card, *firmware("bench_setup.pmc"), *LAW_HEAD)
    table = " ".join(str(round(160 * (k % 20 - 10) / 10)) for k in range(200))
    say(card, "#1", "DELETE GATHER", "DEFINE COMP 200,#1D,#1,600000")
    for at in range(0, 200, 20):
        say(card, " ".join(table.split()[at : at + 20]))
    say(card, "I51=1", "I5000=3", "DEFINE GATHER", "GATHER")
    if law:
        say(card, *law_bank())
    if law == "plc":
        say(card, *firmware("feedforward_law.plc0"), "ENABLE PLC 0")
    if law == "servo":
        say(card, "I159=1")
    card.run_cycles(50)
    say(card, "#1J/")
    card.run_cycles(500)
    return card


def times_real(card: Card, *, seconds: float, program: bool) -> float:
    """Best of three runs, so that a neighbour on the machine does not count."""
    cycles = round(seconds / BENCH.servo_period_s)
    if program:
        say(card, *MOTION)
    else:
        say(card, "I122=10", "#1J+")  # 10 mm/s: the travel lasts as long as the run
    best = 0.0
    for _ in range(3):
        start = time.process_time()
        card.run_cycles(cycles)
        best = max(best, cycles * BENCH.servo_period_s / (time.process_time() - start))
        if not program:
            say(card, "I122=100", "#1J=0")
            card.run_cycles(20_000)
            say(card, "I122=10", "#1J+")
    return best


def core_share(card: Card, *, wall_s: float = 3.0) -> float:
    """CPU seconds per wall second when the card keeps pace with the clock in 10 ms steps."""
    chunk = round(0.01 / BENCH.servo_period_s)
    begin, spent = time.perf_counter(), time.process_time()
    steps = 0
    while time.perf_counter() - begin < wall_s:
        card.run_cycles(chunk)
        steps += 1
        ahead = steps * chunk * BENCH.servo_period_s - (time.perf_counter() - begin)
        if ahead > 0:
            time.sleep(ahead)
    return (time.process_time() - spent) / (time.perf_counter() - begin)


def plant_alone() -> float:
    import numpy as np

    plant = make_plant(BENCH)
    cycles = 100_000
    torque = 2.0 * np.sin(np.arange(cycles) * 0.01)
    plant.run(torque[:10])
    start = time.process_time()
    plant.run(torque)
    cpu_s = time.process_time() - start
    return cycles * BENCH.servo_period_s / cpu_s


def main() -> None:
    rows = [
        ("drive alone", plant_alone(), None),
        ("card, table and gather, jogging",
         times_real(prepared(), seconds=20.0, program=False), 300),
        ("card, table and gather, motion program",
         times_real(prepared(), seconds=20.0, program=True), None),
        ("the same with the law in PLC 0 every cycle",
         times_real(prepared(law="plc"), seconds=10.0, program=True), 20),
        ("the same with the law as open servo",
         times_real(prepared(law="servo"), seconds=10.0, program=True), None),
        ("the same with a drive written in Python",
         times_real(prepared(plant=PythonDrive()), seconds=3.0, program=True), None),
    ]  # fmt: skip
    for name, value, aim in rows:
        goal = "" if aim is None else f"   (aim: {aim})"
        print(f"{name:45s} {value:8.0f} x real time{goal}")
    share = core_share(prepared())
    print(f"{'share of a core at real time':45s} {100 * share:8.1f} %   (aim: under 10)")


if __name__ == "__main__":
    main()
