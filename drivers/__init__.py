"""Room of dexkit: imported as dexkit.drivers."""
