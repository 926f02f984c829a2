"""Compiles the servo task, the interpreter and the drive ahead of their first use.

``python -m pmac_comp.simulator.serving.warm`` fills the cache of machine code, so that the first
simulated card of a fresh installation answers at once.
"""

import time

import numpy as np


def warm() -> float:
    """Seconds it took to compile, or to find compiled, what a simulated card runs."""
    from pmac_comp.files.bench import load_bench
    from pmac_comp.simulator.card.card import Card
    from pmac_comp.simulator.plant import make_plant
    from pmac_comp.simulator.servo.closed_loop import run_closed_loop

    start = time.perf_counter()
    bench = load_bench("paper")
    card = Card(bench)
    card.port().line("P1=SIN(30)*2")
    card.run_cycles(2)
    run_closed_loop(bench, make_plant(bench), np.zeros(3))
    return time.perf_counter() - start


if __name__ == "__main__":
    print(f"compiled in {warm():.1f} s")
