"""Fuzzers: functions of a seed and a count, for the suite's samples and for long campaigns.

Each makes ``count`` inputs from ``seed`` alone and returns how many it made. What it finds is an
AssertionError that names the seed, the number of the input and the input itself.
"""
