"""Whether every wrong hand and every sample is judged as pinned: ``make pins``.

Virtual runs are recorded once, and each verdict is made once: both are kept by keys of all that
they depend on (:mod:`tools.pins.keys`). So a change of a check judges what is recorded again, by
that check alone, and plays nothing.
"""
