"""Test that the kit measures itself on DDS, and that nothing else sees more than a topic."""

from __future__ import annotations

from dexkit.conformance.kit.calibration import Loopback
from dexkit.conformance.kit.stimulus_record import CALIBRATION_TOPIC
from dexkit.dds import DdsNode
from dexkit.topics import HAND_TOPICS
from tests.dds_helpers import free_domain

FEW = 20


def test_loopback_measures_every_message_that_it_sends() -> None:
    domain = free_domain()
    with DdsNode(domain=domain, interface="lo") as node:
        with Loopback(node, domain=domain, interface="lo", count=FEW) as loopback:
            found = loopback.result()
        assert found.sent == len(found.late_us) == FEW
        assert found.delay_us == sorted(found.delay_us)
        assert 0 < len(found.delay_us) <= FEW
        if found.time_error is not None:
            assert found.time_error * 1e6 >= found.delay_us[0]


def test_loopback_can_be_left_early() -> None:
    domain = free_domain()
    with DdsNode(domain=domain, interface="lo") as node:
        with Loopback(node, domain=domain, interface="lo", count=10_000) as loopback:
            pass
        assert loopback.result().sent < 10_000


def test_topic_is_no_hands() -> None:
    assert CALIBRATION_TOPIC not in HAND_TOPICS
