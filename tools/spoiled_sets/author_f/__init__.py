"""Good and spoiled episodes, with labels: ``python -m tools.spoiled_sets.author_f OUT``.

Hands move as in the shipped recordings (as ``dexkit export`` samples them), cut, warped in time,
mirrored and joined; arms by minimum-jerk reaches with tremor, followed with lag, overshoot and sag.
Deterministic. Needs pyarrow, Pillow, PyAV and rosbags.
"""
