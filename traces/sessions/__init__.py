"""Sessions as data: cut, merge and compare recordings; other formats in and out.

Everything here goes through recordings: an importer writes one, an exporter reads one, and what is
compared or aligned are the :class:`~dexkit.traces.sessions.streams.Stream` objects of one. See
docs/sessions.md.
"""
