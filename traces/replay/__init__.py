"""Replay a session on a hand with care: read it, check and cure it, ramp, play, supervise, stop.

* :mod:`~dexkit.traces.replay.commands` reads the commands to hands of any source;
* :mod:`~dexkit.traces.replay.prepare` checks and cures them: findings with names, and a plan;
* :mod:`~dexkit.traces.replay.machine` plays a plan: commands out, states in, no clock of its own;
* :mod:`~dexkit.traces.replay.live` does that on DDS.

:mod:`dexkit.conformance.virtual.rehearsal` does it with a hand in memory. See docs/sessions.md.
"""
