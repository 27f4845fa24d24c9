"""Put any gripper or hand on Unitree's Dex topics and prove that it is a drop-in.

Start at :mod:`dexkit.hand` (the common interface) and :mod:`dexkit.models` (the family as
data). The folders ``drivers``, ``emulators``, ``conformance`` and ``traces`` are sub-packages.
"""

__version__ = "0.1.0"
