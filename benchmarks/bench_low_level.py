"""The CRC of LowCmd_ and LowState_: against C, and against Python as a client would do it."""

from __future__ import annotations

import ctypes
import struct
import tempfile
import timeit
from collections.abc import Callable

from benchmarks import Result
from benchmarks.bench_dex3_usb_codec import C_PEER, PYTHON_PEER, table_crc
from benchmarks.native import compiled
from dexkit.messages import encode, message_type
from dexkit.messages import unitree_go as go
from dexkit.messages import unitree_hg as hg
from dexkit.wire.low_level import crc_of_payload, encode_with_crc, struct_of_payload, verify_payload

COMMAND = go.LowCmd_(motor_cmd=[go.MotorCmd_(1, 0.1 * i, kp=60.0) for i in range(20)])
STATE = hg.LowState_(motor_state=[hg.MotorState_(1, 0.1 * i) for i in range(35)])
CASES = (
    ("LowCmd_ of an H1", "unitree_go::msg::dds_::LowCmd_", COMMAND),
    ("LowState_ of a G1", "unitree_hg::msg::dds_::LowState_", STATE),
)
# docs/sources/unitree-dex.md#a7: how unitree_sdk2_python packs an H1's command before it takes the
# CRC
FORMAT = "<4B4IH2x" + "B3x5f3I" * 20 + "4B55Bx2I"
_MANY = 2000


def _best(function: Callable[[], object], number: int) -> float:
    """Microseconds a call; short runs get past a busy machine."""
    return min(timeit.repeat(function, number=number, repeat=30)) / number * 1e6


def _python_crc() -> int:
    """The CRC of the command with struct and a table, from the message."""
    m = COMMAND
    motors = [v for c in m.motor_cmd for v in (c.mode, c.q, c.dq, c.tau, c.kp, c.kd, *c.reserve)]
    head = (*m.head, m.level_flag, m.frame_reserve, *m.sn, *m.version, m.bandwidth)
    tail = (*m.wireless_remote, *m.led, *m.fan, m.gpio, m.reserve, 0)
    packed = struct.pack(FORMAT, *head, *motors, m.bms_cmd.off, *m.bms_cmd.reserve, *tail)
    return table_crc(packed[:-4])


def run() -> list[Result]:
    results = []
    with tempfile.TemporaryDirectory() as folder:
        library = compiled("dex3_crc", folder)
        for title, name, message in CASES:
            if library is None:
                break
            payload = encode(message)
            ours = _best(lambda: crc_of_payload(name, payload), 100)  # noqa: B023
            image = struct_of_payload(name, payload)
            data = ctypes.create_string_buffer(image, len(image))
            words = len(image) // 4 - 1
            assert library.crc_words(data, words) == crc_of_payload(name, payload)
            peer = _best(lambda: library.crc_many(_MANY, data, words), 1) / _MANY  # noqa: B023
            results.append(
                Result(
                    name=f"CRC of a sample, {title}",
                    value=ours,
                    unit="us",
                    peer=C_PEER,
                    peer_value=peer,
                    ratio=peer / ours,
                )
            )
    assert _python_crc() == crc_of_payload(CASES[0][1], encode(COMMAND))
    ours, plain = _best(lambda: encode_with_crc(COMMAND), 100), _best(_python_crc, 5)
    results.append(
        Result(
            name="encode with CRC, LowCmd_ of an H1",
            value=ours,
            unit="us",
            peer=f"{PYTHON_PEER}, without the encoding",
            peer_value=plain,
            ratio=plain / ours,
        )
    )
    name, payload = CASES[1][1], encode_with_crc(STATE)
    kind = message_type(name)
    ours = _best(lambda: verify_payload(name, payload), 100)
    decoding = _best(lambda: kind.decode(payload), 20)
    results.append(
        Result(
            name="verify a received LowState_ of a G1",
            value=ours,
            unit="us",
            peer="dexkit, decoding it",
            peer_value=decoding,
            ratio=decoding / ours,
        )
    )
    return results
