"""Find out how a hand is wired, one joint at a time, with a person who watches.

From the inside out, all sans-IO: :mod:`dead_man` (is the key held?), :mod:`motion` (move one motor
slowly until it arrives or stalls), :mod:`script` (what to move and to ask, in which order),
:mod:`session` (both on the caller's clock). A driver brings a :class:`~bench.Bench`, which
exchanges frames with the hand; ``dexkit bringup`` has the loop and the terminal.
"""

from dexkit.bringup.bench import Bench, Drive, JointChoice, Plan, Reading, Snapshot, Zero
from dexkit.bringup.dead_man import DeadMan
from dexkit.bringup.findings import Findings
from dexkit.bringup.motion import Effort
from dexkit.bringup.script import Question
from dexkit.bringup.session import BringupSession
from dexkit.bringup.settings_file import SettingsFile

__all__ = [
    "Bench",
    "BringupSession",
    "DeadMan",
    "Drive",
    "Effort",
    "Findings",
    "JointChoice",
    "Plan",
    "Question",
    "Reading",
    "SettingsFile",
    "Snapshot",
    "Zero",
]
