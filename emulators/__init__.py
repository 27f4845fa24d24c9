"""Emulators of devices and robots, and simulated hands; imported as ``dexkit.emulators``."""
