"""Room of dexkit: imported as dexkit.conformance."""
