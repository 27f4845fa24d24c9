"""The table of hand topics that the service, the doctor and others ask."""

from __future__ import annotations

from dexkit.hand import Side
from dexkit.models import DIALECTS
from dexkit.topics import HAND_TOPICS, roles, topics_of
from tests.each import each


@each("name", list(DIALECTS))
def test_every_topic_of_a_dialect_is_known(name: str) -> None:
    dialect = DIALECTS[name]
    table = dict(topics_of(dialect))
    for side in Side:
        cmd, state = dialect.topics(side)
        assert (table[cmd].kind, table[cmd].type_name) == ("cmd", dialect.cmd_type)
        assert (table[state].kind, table[state].type_name) == ("state", dialect.state_type)
        assert side in table[cmd].sides
    assert set(table) <= HAND_TOPICS
    for topic, role in table.items():
        assert role in roles(topic)
        assert role in roles(topic, role.type_name)
        assert role not in roles(topic, "std_msgs::msg::dds_::String_")


def test_a_topic_may_be_both_hands_or_two_dialects() -> None:
    (role,) = roles("rt/unitree_actuator/state")
    assert role.sides == (Side.LEFT, Side.RIGHT)
    assert {r.dialect.name for r in roles("rt/dex1/left/cmd")} == {"unitree_go", "unitree_hg"}
    (low,) = roles("rt/lf/dex3/right/state")
    assert (low.kind, low.sides, low.dialect.name) == ("low", (Side.RIGHT,), "dex3")
    assert roles("rt/lowstate") == []
