"""Cut, merge and compare recordings, and convert other session formats.

All modules work on recordings: an importer writes one, an exporter reads one, and
:class:`~dexkit.traces.sessions.streams.Stream` objects of recordings are compared and aligned. See
docs/sessions.md.
"""
