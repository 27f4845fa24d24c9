"""The conformance kit, imported as ``dexkit.conformance``."""
