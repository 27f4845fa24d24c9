"""The listener: what it hears of a domain, and that it publishes nothing."""

from __future__ import annotations

import pytest

from dexkit.hand import Side
from dexkit.messages import message_type
from dexkit.watch import Collector
from dexkit.watch.listener import Listener
from tests.dds_helpers import DdsNode, free_domain, wait_until
from tests.watch_helpers import COMMAND, STATE, dex3_command, dex3_state


def test_listener_hears_all_and_publishes_nothing() -> None:
    domain = free_domain()
    state, command = dex3_state([0.1] * 7), dex3_command([0.2] * 7)
    with (
        DdsNode(domain) as hand,
        DdsNode(domain) as node,
        Listener(node, collector := Collector()) as heard,
    ):
        states = hand.writer("rt/dex3/left/state", message_type(STATE))
        commands = hand.writer("rt/dex3/left/cmd", message_type(COMMAND))

        def complete() -> bool:
            states.write_raw(state)
            commands.write_raw(command)
            heard.poll()
            found = collector.picture(collector.last).subjects
            return bool(found) and found[0].age == found[0].age and found[0].target[0] > 0

        wait_until(complete)
        (seen,) = collector.picture(collector.last).subjects
        assert seen.subject is Side.LEFT
        assert seen.q[0] == pytest.approx(0.1)
        assert seen.target[0] == pytest.approx(0.2)
        assert len(seen.commanders) == 1
        own = [e for e in node.endpoints() if e.own and not e.topic.startswith("DCPS")]
        assert {e.kind for e in own} == {"reader"}
        states.close()

        def gone() -> bool:
            heard.poll()
            return not collector.picture(0.0).topics[1].publishers

        wait_until(gone)
        assert heard.dropped == 0


def test_listener_reads_only_what_is_wanted() -> None:
    domain = free_domain()
    with (
        DdsNode(domain) as hand,
        DdsNode(domain) as node,
        Listener(node, collector := Collector(), ["rt/dex3/*/cmd"]) as heard,
    ):
        states = hand.writer("rt/dex3/left/state", message_type(STATE))
        commands = hand.writer("rt/dex3/left/cmd", message_type(COMMAND))

        def complete() -> bool:
            states.write_raw(dex3_state([0.1] * 7))
            commands.write_raw(dex3_command([0.2] * 7))
            heard.poll()
            return any(t.samples for t in collector.picture(collector.last).topics)

        wait_until(complete)
        assert [t.name for t in collector.picture(0.0).topics] == ["rt/dex3/left/cmd"]
