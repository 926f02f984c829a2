"""Recorded sessions and their replay."""

import pytest

from pmac_comp.base.clock import VirtualClock
from pmac_comp.base.errors import ConfigError, PmacCompError
from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.transport.base import Framing
from pmac_comp.machine.transport.pair import PairTransport
from pmac_comp.machine.transport.record import RecordingTransport, ReplayTransport
from tests.contract.scripted_card import LinePort, PacketPort, ScriptedCard

PORTS = {Framing.PACKETS: PacketPort, Framing.LINES: LinePort}


def talk(commander: Commander) -> list[object]:
    commander.write_buffer([f"P{k}={k}" for k in range(100)])
    said = [commander.query("ver"), commander.query_many(f"P{k}" for k in range(100))]
    commander.close()
    return said


@pytest.mark.parametrize("framing", PORTS)
def test_a_recorded_session_replays_byte_for_byte(tmp_path, framing):
    path = tmp_path / "session.jsonl"
    clock = VirtualClock()
    pair = PairTransport(PORTS[framing](ScriptedCard(I3=1)), clock, framing=framing)
    said = talk(Commander(RecordingTransport(pair, path, clock), clock=clock))
    replay = ReplayTransport(path.read_text().splitlines(), VirtualClock())
    assert talk(Commander(replay, clock=VirtualClock())) == said
    assert replay.finished


def test_another_conversation_is_not_answered(tmp_path):
    path = tmp_path / "session.jsonl"
    clock = VirtualClock()
    pair = PairTransport(PacketPort(ScriptedCard()), clock)
    talk(Commander(RecordingTransport(pair, path, clock), clock=clock))
    virtual = VirtualClock()
    commander = Commander(ReplayTransport(path.read_text().splitlines(), virtual), clock=virtual)
    with pytest.raises(PmacCompError):
        commander.command("P1=2")


def test_evidence_is_not_overwritten(tmp_path):
    path = tmp_path / "session.jsonl"
    path.write_text("kept")
    pair = PairTransport(PacketPort(ScriptedCard()), VirtualClock())
    with pytest.raises(ConfigError, match="cannot be recorded"):
        RecordingTransport(pair, path, VirtualClock())
    assert path.read_text() == "kept"
    with pytest.raises(ConfigError, match="no recorded session"):
        ReplayTransport([], VirtualClock())
