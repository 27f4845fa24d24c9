"""Room of dexkit: imported as dexkit.traces."""
