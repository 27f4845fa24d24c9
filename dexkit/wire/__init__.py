"""Codecs of serial, USB and low-level frames: bytes to packets and back, without I/O or clock."""
