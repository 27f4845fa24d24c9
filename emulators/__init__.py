"""Room of dexkit: imported as dexkit.emulators."""
