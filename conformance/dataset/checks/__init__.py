"""The checks of an episode, one subject a file.

A file has ``CHECKS``, a tuple of :class:`~dexkit.conformance.dataset.check.Check`.
"""
