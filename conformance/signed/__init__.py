"""Signed archives of results: :mod:`~.manifest`, :mod:`~.sign`, :mod:`~.verify`."""
