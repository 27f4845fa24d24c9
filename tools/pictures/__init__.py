"""Make the pictures of ``dexkit view``, ``monitor`` and ``info`` in docs/images: ``make pictures``.

Needs Chromium and the development dependencies. What they show are recordings of
:mod:`dexkit.traces.samples`, so that they can be made anew at any time; they differ in a few pixels
from one machine to another, and no test compares them.
"""
