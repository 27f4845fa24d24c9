"""The synthetic session of a Dex5-1: ``python tests/dex5_helpers.py`` writes it anew.

No client of a Dex5-1 and no such hand could be recorded. What stands in is dexkit's model of the
client, an operator's profile, and the simulated hands, all on one clock that does not wait; no
DDS took part, so that there are no endpoints either.
"""

from __future__ import annotations

from pathlib import Path

from dexkit.clock import ManualClock
from dexkit.emulators.sim_dex5 import SimDex5
from dexkit.hand import HandCommand, Side
from dexkit.messages import message_type
from dexkit.models import DEX5_1
from dexkit.service.dialects import StateView, dialect_map
from dexkit.teleop import Operator, client_for, profile
from dexkit.teleop.client_codec import ClientWire
from dexkit.traces import Recorder, sample_path

EPOCH_NS = 1_795_000_000_000_000_000
PROFILE = "sine"
MOST = {Side.RIGHT: 0.6}  # of the profile: clear of where the conformance kit puts an object
STATE_NS = 2_000_000
CLIENT_STEPS = 5  # of the state's period
CLIENT_STARTS = 0.5  # seconds after the hands


def write(path: Path, seconds: float = 6.0) -> None:
    """The session, or the beginning of it."""
    dialect = DEX5_1.dialects[0]
    clock = ManualClock()
    hands = {s: SimDex5(s, clock=clock) for s in Side}
    maps = {s: dialect_map(dialect, {s: hand.spec}) for s, hand in hands.items()}
    client, wire = client_for(dialect), ClientWire(dialect)
    operator = Operator(profile(PROFILE, DEX5_1.name), dialect, most=MOST)
    decode = message_type(dialect.cmd_type).decode
    commands = {s: HandCommand.brake(hand.spec.n_joints) for s, hand in hands.items()}
    about = {
        "controller_commit": "none: dexkit's model of xr_teleoperate's Dex5_1_Controller",
        "states": "dexkit's simulated hands (sim-dex5)",
        "operator": f"dexkit's profile {PROFILE!r}",
        "network": "none: one virtual clock",
    }
    with Recorder(path, overwrite=True) as recorder:
        recorder.add_metadata("provenance", about)
        for hand in hands.values():
            hand.open()
        for step in range(round(seconds * 1e9 / STATE_NS)):
            now_ns = EPOCH_NS + step * STATE_NS
            states = {}
            for s, hand in hands.items():
                state = hand.exchange(commands[s])
                states[s] = tuple(state.q.tolist())
                payload = maps[s].encode({s: StateView(state, (0,) * len(state.q))})
                recorder.put(
                    wire.state_topics[s], dialect.state_type, payload, now_ns + 200_000, now_ns
                )
            now = clock.now() - CLIENT_STARTS
            if now >= 0.0 and step % CLIENT_STEPS == 0:
                told = client.step(now, states, operator.inputs(now, Side))
                for topic, payload in wire.encode(told):
                    recorder.put(
                        topic, dialect.cmd_type, payload, now_ns + 500_000, now_ns + 300_000
                    )
                for s, (_, payload) in zip(told, wire.encode(told), strict=True):
                    command = maps[s].command(decode(payload), s)
                    assert command is not None
                    commands[s] = command
            clock.advance(STATE_NS / 1e9)
        for hand in hands.values():
            hand.close()


if __name__ == "__main__":
    write(sample_path("dex5_synthetic"))
