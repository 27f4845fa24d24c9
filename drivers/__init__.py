"""Drivers of real devices, imported as ``dexkit.drivers``: M4010, Dex3-1 on USB, EZGripper."""
