"""Codecs of the wires that hands hang on: bytes in, packets out, no I/O and no clock."""
