"""Replay a session on a hand safely: read, check and correct it, ramp, play, supervise, stop.

* :mod:`~dexkit.traces.replay.commands` reads the commands to hands of any source;
* :mod:`~dexkit.traces.replay.prepare` checks and corrects them: named findings, and a plan;
* :mod:`~dexkit.traces.replay.machine` plays a plan: commands out, states in, time from the caller;
* :mod:`~dexkit.traces.replay.live` does that on DDS.

:mod:`dexkit.conformance.virtual.rehearsal` does it with a hand in memory. See docs/sessions.md.
"""
