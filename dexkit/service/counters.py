"""Counters of the service, logged at exit and on SIGUSR1."""

from __future__ import annotations

from dataclasses import asdict, dataclass

__all__ = ["HandCounters", "TopicCounters"]


@dataclass
class TopicCounters:
    """Counts of one topic pair.

    :ivar received: command samples taken.
    :ivar undecodable: of those, samples that are not the message they claim to be.
    :ivar short: samples with too few motors for a hand that is served here, or that leave its
        joints without a goal; ignored.
    :ivar overlong: samples with more motors than the dialect has; the surplus is ignored.
    :ivar pauses: times that the service was paused for more than a quarter of a second (stopped,
        suspended, starved); the hands brake then until a command comes that was sent later.
    :ivar published: state samples written.
    :ivar publish_misses: publish deadlines missed by a whole period.
    :ivar publish_errors: samples that DDS or the codec refused.
    """

    received: int = 0
    undecodable: int = 0
    short: int = 0
    overlong: int = 0
    pauses: int = 0
    published: int = 0
    publish_misses: int = 0
    publish_errors: int = 0

    def snapshot(self) -> dict[str, int]:
        """The counts now."""
        return asdict(self)


@dataclass
class HandCounters:
    """Counts of one hand.

    :ivar accepted: commands that are in force or were.
    :ivar stale: commands that did not count because they were old, or may have been sent before
        a pause, a reconnection or the end of a fault.
    :ivar rejected: commands with NaN or infinity.
    :ivar clamped: accepted commands that had to be brought within the limits.
    :ivar wrong_ids: accepted commands with a mode byte whose id is not the motor's index.
    :ivar unknown_status: accepted commands with a mode byte whose status is neither lock nor FOC,
        or that has bits which are not used.
    :ivar zero_gains: accepted commands of a client that has changed q for a second or more without
        gains, so that the hand stays limp (:mod:`dexkit.service.limp`).
    :ivar brakes: times that driving stopped because no fresh command was there.
    :ivar holds: times that a position was held for want of a fresh command, the client having
        switched the time-out protection off.
    :ivar exchanges: exchanges done.
    :ivar exchange_errors: exchanges that failed.
    :ivar faults: of those, hardware errors that the device reported.
    :ivar losses: times that the link was given up.
    :ivar reconnects: times that it was opened again.
    """

    accepted: int = 0
    stale: int = 0
    rejected: int = 0
    clamped: int = 0
    wrong_ids: int = 0
    unknown_status: int = 0
    zero_gains: int = 0
    brakes: int = 0
    holds: int = 0
    exchanges: int = 0
    exchange_errors: int = 0
    faults: int = 0
    losses: int = 0
    reconnects: int = 0

    def snapshot(self) -> dict[str, int]:
        """The counts now."""
        return asdict(self)
