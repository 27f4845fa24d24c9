"""Emulated robot bodies, H1 and G1, on Unitree's low-level topics; see docs/body.md."""

from dexkit.emulators.body.body import Body, Counters
from dexkit.emulators.body.run import EmulatedBody, run_body
from dexkit.emulators.body.settings import Remote, Settings

__all__ = ["Body", "Counters", "EmulatedBody", "Remote", "Settings", "run_body"]
