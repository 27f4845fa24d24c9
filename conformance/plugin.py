"""Options of the conformance suite, registered with pytest."""
