"""What DDS is about, as values: quality of service, samples, participants and endpoints."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from dexkit.errors import UsageError
from dexkit.messages import MessageType

__all__ = ["DURABILITIES", "DiscoveryEvent", "Endpoint", "Participant", "Qos", "Sample"]

DURABILITIES = ("volatile", "transient_local", "transient", "persistent")
"""As CycloneDDS counts them."""


@dataclass(frozen=True)
class Qos:
    """The QoS policies of an endpoint: reliability, durability and history.

    :param reliability: ``"reliable"`` or ``"best_effort"``.
    :param durability: ``"volatile"``, ``"transient_local"``, ``"transient"``, ``"persistent"``.
    :param depth: samples kept of the history; None keeps all.

    Unitree's SDKs write reliable and read best-effort, volatile, keep-last 1
    (docs/sources/unitree-dex.md#a5).
    """

    reliability: str = "reliable"
    durability: str = "volatile"
    depth: int | None = 1

    def __post_init__(self) -> None:
        if self.reliability not in ("reliable", "best_effort"):
            raise UsageError(f"reliability {self.reliability!r}")
        if self.durability not in DURABILITIES:
            raise UsageError(f"durability {self.durability!r}")
        if self.depth is not None and self.depth < 1:
            raise UsageError(f"a history keeps at least 1 sample, not {self.depth}")

    @classmethod
    def writer_default(cls) -> Qos:
        """The QoS that Unitree's writers offer."""
        return cls("reliable")

    @classmethod
    def reader_default(cls) -> Qos:
        """The QoS that Unitree's readers request."""
        return cls("best_effort")

    def __str__(self) -> str:
        keep = "keep_all" if self.depth is None else f"keep_last({self.depth})"
        return f"{self.reliability}, {self.durability}, {keep}"


@dataclass(slots=True)
class Sample:
    """One received sample.

    :ivar data: as on the wire, encapsulation header included.
    :ivar source_timestamp_ns: when the writer wrote it, wall clock, ns.
    :ivar reception_ns: when it was taken from the reader, wall clock, ns.
    :ivar writer: handle of the writer, the same for all samples of one writer.
    """

    data: bytes
    source_timestamp_ns: int
    reception_ns: int
    writer: int
    type: MessageType = field(repr=False)
    _message: Any = field(default=None, repr=False, compare=False)

    @property
    def message(self) -> Any:
        """The decoded message (decoded once).

        :raises WireError: the bytes are not that message.
        """
        if self._message is None:
            self._message = self.type.decode(self.data)
        return self._message


@dataclass(frozen=True)
class Participant:
    """A process's presence on the domain.

    :param process: name and pid if the participant announces them (CycloneDDS does), or empty.
    :param pid: process id, or 0 if it is not announced.
    """

    key: str
    process: str
    pid: int
    host: str
    own: bool


@dataclass(frozen=True)
class Endpoint:
    """A reader or writer somewhere on the domain.

    :param kind: ``"reader"`` or ``"writer"``.
    :param own: it belongs to this node.
    :param key: unique id of the endpoint; ``participant`` that of its participant.
    :param process: name and pid of the process that it lives in, if known.
    :param user_data: its USER_DATA, or empty.
    :param type_hash: hash of the complete type if the other side announces one, or empty; two
        endpoints whose ``type_name`` is the same but whose hash differs disagree on the layout.
    """

    topic: str
    type_name: str
    kind: str
    qos: Qos
    own: bool
    key: str
    participant: str
    process: str = ""
    type_hash: str = ""
    user_data: bytes = b""


@dataclass(frozen=True)
class DiscoveryEvent:
    """An endpoint that appeared or vanished."""

    appeared: bool
    endpoint: Endpoint
