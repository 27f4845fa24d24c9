"""Store USB transfers in a recording.

Each endpoint of each hand is a channel, ``usb/dex3/left/out`` and ``usb/dex3/left/in``; each
transfer is a message: log time is its end, publish time its submission. The payload
is the CDR form of :data:`SCHEMA`, so that common viewers show it. Descriptors and
the phases of the stimulus are in the metadata record :data:`RECORD`, so that the recording alone
can be judged.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import msgspec

from dexkit.conformance.kit.processor_waits import Time, Waits
from dexkit.conformance.kit.stimulus_record import Beats, Stall, from_metadata, to_metadata
from dexkit.conformance.usb import RECORD
from dexkit.errors import TraceUnsupported
from dexkit.hand import Side

__all__ = [
    "RECORD",
    "SCHEMA",
    "SCHEMA_NAME",
    "TIMED_OUT",
    "Descriptors",
    "SideRecord",
    "Transfer",
    "UsbPhase",
    "UsbRecord",
    "topic",
]

SCHEMA_NAME = "dexkit_usb/msg/Transfer"
SCHEMA = """\
# One bulk transfer as the host saw it. Log time: when it was done; publish time: when submitted.
uint8 endpoint    # address; bit 7 set: from the device to the host
int32 status      # 0 done, or a negative errno: -110 timed out, -32 stalled, -19 device gone
uint32 requested  # bytes offered to the device, or room for bytes from it
uint8[] data      # bytes that were sent, or that came
"""
TIMED_OUT = -110

_HEAD = struct.Struct("<4sB3xiII")
_CDR = b"\0\1\0\0"  # plain CDR, little endian


def topic(side: Side, *, inward: bool) -> str:
    """The channel of one endpoint."""
    return f"usb/dex3/{side}/{'in' if inward else 'out'}"


@dataclass(frozen=True, slots=True)
class Transfer:
    """One bulk transfer.

    :param status: 0, or a negative errno.
    :param requested: bytes offered or requested.
    """

    submitted_ns: int
    done_ns: int
    endpoint: int
    status: int
    requested: int
    data: bytes

    @property
    def inward(self) -> bool:
        """Whether it is an IN transfer, from the device."""
        return bool(self.endpoint & 0x80)

    def payload(self) -> bytes:
        """Encode it as a message of the recording."""
        head = _HEAD.pack(_CDR, self.endpoint, self.status, self.requested, len(self.data))
        return head + self.data

    @classmethod
    def from_payload(cls, payload: bytes, submitted_ns: int, done_ns: int) -> Transfer:
        """Decode a message of the recording.

        :raises TraceUnsupported: the payload is damaged.
        """
        if len(payload) >= _HEAD.size:
            cdr, endpoint, status, requested, length = _HEAD.unpack_from(payload)
            if cdr == _CDR and length == len(payload) - _HEAD.size:
                data = payload[_HEAD.size :]
                return cls(submitted_ns, done_ns, endpoint, status, requested, data)
        raise TraceUnsupported(f"a USB transfer of {len(payload)} bytes cannot be read")


@dataclass(frozen=True)
class Descriptors:
    """The descriptors of a device.

    :param device: device descriptor, 18 bytes; ``configuration`` with all that belongs to it.
    :param strings: by index.
    :param speed: 1 low, 2 full, 3 high, 4 and more super; 0 where the host does not report it.
    """

    device: bytes
    configuration: bytes
    strings: Mapping[int, str] = field(default_factory=dict)
    speed: int = 0


@dataclass
class UsbPhase:
    """One phase of the stimulus.

    :param params: what was commanded, as the checks read it.
    """

    name: str
    begin_ns: Time
    end_ns: Time = 0
    params: dict[str, Any] = field(default_factory=dict)


@dataclass
class SideRecord:
    """One hand's part of the record.

    :param buses: bus and id of each joint's motor that the script assumed.
    :param trouble: the reason why the script ended early, or empty.
    """

    descriptors: Descriptors
    buses: list[tuple[int, int]]
    phases: list[UsbPhase] = field(default_factory=list)
    trouble: str = ""


@dataclass
class UsbRecord:
    """The whole record.

    :param stalls: when programs waited for a processor.
    :param beats: how late the kit's own timer was.
    :param waits: how long the processes of an emulated device waited for a processor; None where
        it was not measured.
    """

    sides: dict[Side, SideRecord] = field(default_factory=dict)
    stalls: list[Stall] = field(default_factory=list)
    beats: Beats = field(default_factory=Beats)
    waits: Waits | None = None

    def to_metadata(self) -> dict[str, str]:
        """Encode it for the metadata: JSON by side."""
        sides = {str(side): _side_record(part) for side, part in self.sides.items()}
        record = _Record(version=1, stalls=self.stalls, beats=self.beats, waits=self.waits, **sides)
        return to_metadata(record)

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, str]) -> UsbRecord:
        """Read it back.

        :raises TraceUnsupported: of another version, or damaged.
        """
        record = from_metadata(metadata, _Record, "the USB record")
        found = cls(stalls=record.stalls, beats=record.beats, waits=record.waits)
        for side, part in ((Side.LEFT, record.left), (Side.RIGHT, record.right)):
            if part is not None:
                found.sides[side] = _side(part)
        return found


Hex = Annotated[str, msgspec.Meta(pattern="^([0-9a-f]{2})*$")]


class _DescriptorsRecord(msgspec.Struct, forbid_unknown_fields=True):
    device: Hex
    configuration: Hex
    strings: dict[int, str]
    speed: int


class _SideRecord(msgspec.Struct, forbid_unknown_fields=True):
    descriptors: _DescriptorsRecord
    buses: list[tuple[int, int]]
    phases: list[UsbPhase]
    trouble: str


class _Record(msgspec.Struct, omit_defaults=True):
    version: Literal[1]
    stalls: list[Stall]
    beats: Beats
    waits: Waits | None = None
    left: _SideRecord | None = None
    right: _SideRecord | None = None


def _side_record(part: SideRecord) -> _SideRecord:
    device = part.descriptors
    return _SideRecord(
        _DescriptorsRecord(
            device.device.hex(), device.configuration.hex(), dict(device.strings), device.speed
        ),
        part.buses,
        part.phases,
        part.trouble,
    )


def _side(record: _SideRecord) -> SideRecord:
    device = record.descriptors
    return SideRecord(
        Descriptors(
            bytes.fromhex(device.device),
            bytes.fromhex(device.configuration),
            device.strings,
            device.speed,
        ),
        record.buses,
        record.phases,
        record.trouble,
    )
