"""Topics, types and quality of service, by which a client and a hand find each other."""

from __future__ import annotations

import numpy as np

from dexkit.conformance.checks import Context, Outcome, causes, check
from dexkit.conformance.checks.combined import all_of, warning
from dexkit.conformance.checks.robot import RobotContext
from dexkit.conformance.kit.provenance import MESSAGES
from dexkit.models import DIALECTS
from dexkit.traces import TraceEndpoint

_AHEAD_S = 0.05  # s by which the low-rate topic may be received before the fast one


def _endpoints(ctx: Context, topic: str, kind: str) -> list[TraceEndpoint]:
    return [e for e in ctx.recording.endpoints if e.topic == topic and e.kind == kind]


@check("DEX1-TOPIC-01", "DEX3-TOPIC-01", "H1-TOPIC-01", rests_on=(MESSAGES,))
def state_topic(ctx: Context) -> Outcome:
    """The state topic carries samples of the right type."""
    dialect = ctx.recording.dialect
    topic, wanted = ctx.states.topic, dialect.state_type
    channels = [c for c in ctx.recording.channels if c.topic == topic]
    right = [c for c in channels if c.type_name == wanted and c.message_count]
    if right and right[0].problem:
        return ctx.failed("unreadable", f"samples on {topic}, but {right[0].problem}")
    if right:
        return ctx.passed(wanted.rpartition("::")[2], f"{len(ctx.states)} samples of {wanted}")
    types = {c.type_name for c in channels if c.message_count}
    types |= {e.type_name for e in _endpoints(ctx, topic, "writer") if e.type_name}
    others = types - {wanted}
    if others:
        return ctx.failed("wrong type", f"{topic} has type {', '.join(sorted(others))}").because(
            causes.of_type(others, wanted, dialect)
        )
    similar = sorted(
        {c.topic for c in ctx.recording.channels if c.topic.endswith("state")} - {topic}
    )
    seen = f"; other state topics: {', '.join(similar)}" if similar else ""
    if types or _endpoints(ctx, topic, "writer"):
        return ctx.failed("no sample", f"a publisher of {topic} was seen, but no sample came{seen}")
    return ctx.failed("no topic", f"no process publishes {topic}{seen}").because(_absent(ctx))


def _absent(ctx: Context) -> str:
    """The likely cause of a missing publisher of the state topic, from the other topics."""
    recording, topic = ctx.recording, ctx.states.topic
    seen = {c.topic for c in recording.channels}
    seen |= {e.topic for e in recording.endpoints if e.kind == "writer"}
    if topic.removeprefix("rt/") in seen:
        return f"It is published as {topic.removeprefix('rt/')}, without ROS 2's prefix rt/."
    for dialect in DIALECTS.values():
        if dialect is not recording.dialect and dialect.topics(ctx.side)[1] in seen - {topic}:
            name = dialect.topics(ctx.side)[1]
            return f"{name} is there, the topic of another generation (--dialect {dialect.name})."
    if recording.dialect.topics(ctx.other)[1] in seen:
        return f"Only the {ctx.other} hand is served."
    return ""


@check("DEX1-TOPIC-02", "DEX3-TOPIC-02", "H1-TOPIC-02")
def command_topic(ctx: Context) -> Outcome:
    """The command topic has a reader of the right type."""
    topic, wanted = ctx.commands.topic, ctx.recording.dialect.cmd_type
    readers = _endpoints(ctx, topic, "reader")
    if not readers:
        return ctx.failed("no reader", f"no process subscribes to {topic}")
    types = {r.type_name for r in readers}
    if wanted in types:
        return ctx.passed(wanted.rpartition("::")[2], f"a reader of {wanted}")
    if "" in types:
        return ctx.skipped(f"{topic} has a reader, but the recording does not say of which type")
    return ctx.failed("wrong type", f"{topic} is read as {', '.join(sorted(types))}").because(
        causes.of_type(types, wanted, ctx.recording.dialect)
    )


@check("DEX3-TOPIC-03")
def low_rate(ctx: Context) -> Outcome:
    """Whether the low-rate copy of the state is fresh, and comes as often as one."""
    fresh = _low_rate_is_fresh(ctx)
    # only the kit's own run is known to record all topics
    return all_of(fresh, warning(_low_rate_topic(ctx))) if ctx.phases("listen") else fresh


def _low_rate_is_fresh(ctx: Context) -> Outcome:
    """Whether each state of the low-rate topic equals a recent one of the fast topic."""
    slow, fast = ctx.recording.low_rate.get(ctx.side), ctx.states
    if slow is None or not len(slow) or not len(fast):
        return ctx.absent("there is no low-rate topic")
    age = ctx.tolerance("max_age_s")
    margin = np.array([ctx.tolerance("margin_stroke", j) for j in range(len(ctx.joints))])
    odd: list[tuple[float, int, str]] = []
    judged = 0
    for i, t in enumerate(slow.t.tolist()):
        rows = fast.between(t - age, t + _AHEAD_S)
        q, mode = fast.q[rows], fast.mode[rows]
        if len(q) < 3 or not np.isfinite(q).all():
            continue
        judged += 1
        with np.errstate(invalid="ignore"):
            away = np.maximum(q.min(axis=0) - slow.q[i], slow.q[i] - q.max(axis=0))
            other = (mode.min(axis=0) > slow.mode[i]) | (mode.max(axis=0) < slow.mode[i])
        off = ~(away <= margin)
        if off.any():
            joint = int(np.argmax(np.nan_to_num(away / margin, nan=np.inf)))
            text = f"q is {away[joint]:.2f} {ctx.unit} from all of the fast topic within {age:g} s"
            odd.append((t, joint, text))
        elif other.any():
            joint = int(np.argmax(other))
            text = f"mode is {slow.mode[i, joint]:g}, which the fast topic did not have"
            odd.append((t, joint, text))
    if judged < 3:
        return ctx.skipped("too few states on the low-rate topic beside those on the fast one")
    if len(odd) < ctx.tolerance("min_odd"):
        return ctx.passed(f"{judged} states", f"{judged} states on {slow.topic}, all as fast ones")
    _, joint, what = odd[0]
    text = ctx.named(f"{what}; so in {len(odd)} of {judged} states on {slow.topic}", joint)
    outcome = ctx.failed(
        f"{len(odd)} of {judged}", text, *(ctx.at(slow.topic, t) for t, *_ in odd[:5])
    )
    return outcome.about(joint).if_late(age)


@check("DEX1-QOS-01", "DEX3-QOS-01", "H1-QOS-01")
def qos(ctx: Context) -> Outcome:
    """What the command reader asks for, and what the state writer offers."""
    return all_of(_command_qos(ctx), warning(_state_qos(ctx)))


def _command_qos(ctx: Context) -> Outcome:
    """The command reader is compatible with a RELIABLE, VOLATILE writer."""
    readers = _endpoints(ctx, ctx.commands.topic, "reader")
    if not any(r.durability for r in readers):
        return ctx.skipped("the recording does not say the reader's durability")
    bad = [r for r in readers if r.durability and r.durability.lower() != "volatile"]
    if len(bad) == len(readers):
        return ctx.failed(
            bad[0].durability,
            f"the reader asks for {bad[0].durability}; official clients offer VOLATILE",
        )
    shown = next(r for r in readers if r not in bad)
    return ctx.passed(shown.durability.lower(), f"the reader asks for {_qos(shown)}")


def _state_qos(ctx: Context) -> Outcome:
    """The state writer is reliable."""
    writers = _endpoints(ctx, ctx.states.topic, "writer")
    if not writers:
        return ctx.skipped("the recording names no writer of the state topic")
    bad = [w for w in writers if w.reliability.lower() != "reliable"]
    if bad:
        return ctx.failed(bad[0].reliability, f"the writer offers {_qos(bad[0])}")
    return ctx.passed(writers[0].reliability, f"the writer offers {_qos(writers[0])}")


def _qos(endpoint: TraceEndpoint) -> str:
    return ", ".join(
        part.lower().replace("_", " ")
        for part in (endpoint.reliability, endpoint.durability)
        if part
    )


def _low_rate_topic(ctx: Context) -> Outcome:
    """The low-rate copy of the state."""
    dialect = ctx.recording.dialect
    topic = dialect.low_rate_topic.format(side=ctx.side)
    found = [
        c
        for c in ctx.recording.channels
        if c.topic == topic and c.type_name == dialect.state_type and c.message_count
    ]
    if not found:
        return ctx.failed("no topic", f"no process publishes {topic} with {dialect.state_type}")
    rate = found[0].message_count / max(ctx.recording.duration, 1e-9)
    text = f"{found[0].message_count} samples on {topic}, {rate:.1f} Hz"
    if rate < ctx.tolerance("min_rate_hz"):
        return ctx.failed(f"{rate:.1f} Hz", text, rate_hz=rate).because(
            "The period has another unit, or a state is copied only now and then."
        )
    if rate <= ctx.tolerance("max_rate_hz"):
        return ctx.passed(f"{rate:.0f} Hz", text, rate_hz=rate)
    return ctx.failed(f"{rate:.0f} Hz", text, rate_hz=rate).because(
        "Every state is copied to the slow topic, too."
    )


@check("H1-TOPIC-03")
def one_publisher(ctx: RobotContext) -> Outcome:
    """Writers of the state topic."""
    writers = [
        e for e in ctx.recording.endpoints if (e.topic, e.kind) == (ctx.states.topic, "writer")
    ]
    if not writers:
        return ctx.skipped("the recording names no writer of the state topic")
    if len(writers) == 1:
        return ctx.passed("1", "one writer")
    return ctx.failed(str(len(writers)), f"{len(writers)} writers publish {ctx.states.topic}")
