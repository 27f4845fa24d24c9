"""``dexkit monitor``: the traffic on DDS in a terminal, from a :class:`~dexkit.watch.Collector`.

:mod:`~dexkit.monitor.screen` makes lines of text of a picture, :mod:`~dexkit.monitor.json_lines`
lines of JSON; both are sans IO. :mod:`dexkit.cli.monitor` has the terminal.
"""
