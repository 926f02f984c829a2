"""What the person at the server is told."""

import asyncio
import socket
import threading
import time

import pytest

from pmac_comp.files.bench import Bench
from pmac_comp.machine.wire.ethernet import NAMED_ONLY
from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.plant.door import GuardedPlant
from pmac_comp.simulator.serving.server import ServeOptions, SimulatorServer


class Slow:
    """A drive that takes five times its servo period."""

    def reset(self, table_position_m: float = 0.0) -> None:
        pass

    def step(self, torque_command_Nm: float) -> tuple[float, float]:
        time.sleep(0.002)
        return 0.0, 0.0


def told(card: Card, act: object = None, wait_s: float = 5.0) -> list[str]:
    """Notices of a server, at most until the first one."""
    heard: list[str] = []
    ready, first = threading.Event(), threading.Event()
    ports: dict[str, str] = {}

    def notice(text: str) -> None:
        heard.append(text)
        first.set()

    async def main() -> None:
        stop = asyncio.Event()
        server = SimulatorServer(card, ServeOptions(tcp=0), notice=notice)

        def announce(endpoints: dict[str, str]) -> None:
            ports.update(endpoints)
            ready.set()

        async def watch() -> None:
            while not (first.is_set() or done.is_set()):
                await asyncio.sleep(0.02)
            stop.set()

        watcher = asyncio.create_task(watch())
        await server.run(announce, stop)
        await watcher

    done = threading.Event()
    thread = threading.Thread(target=lambda: asyncio.run(main()))
    thread.start()
    assert ready.wait(10.0)
    if callable(act):
        act(int(ports["tcp"].rsplit(":", 1)[1]))
    first.wait(wait_s)
    done.set()
    thread.join(10.0)
    return heard


def test_a_plant_too_slow_for_real_time_is_told_once(bench: Bench) -> None:
    card = Card(bench, plant=GuardedPlant(Slow(), bench.lead_m_per_rad))
    heard = told(card, wait_s=15.0)
    assert len(heard) == 1
    assert "falls behind" in heard[0]
    # 0.44 ms of simulated time take a little more than 2 ms.
    share = float(heard[0].split(":")[1].split()[0])
    assert 0.02 < share < 0.25


@pytest.mark.parametrize(
    ("sent", "word"),
    [
        *((bytes([0xC0, code, 0, 0, 0, 0, 0, 0]), name) for code, name in NAMED_ONLY.items()),
        (b"\xc0\xb4\xff\xf0\x00\x00\x05\x78", "ends before offset"),
        (b"\xc0\xff\x00\x00\x00\x00\x00\x00", "FF is unknown"),
    ],
)
def test_why_a_connection_was_closed_is_told(card: Card, sent: bytes, word: str) -> None:
    def act(port: int) -> None:
        with socket.create_connection(("127.0.0.1", port), 5.0) as link:
            link.sendall(sent)
            assert link.recv(100) == b""

    heard = told(card, act)
    assert len(heard) == 1
    assert word in heard[0]
