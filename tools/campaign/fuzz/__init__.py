"""Fuzzers: every parser that takes bytes or text from outside, fed with damaged inputs.

A finding is any exception that is not one of dexkit's own, an input that takes more than two
seconds of processor time or two gigabytes, and a difference between two readings of one input.
"""

from tools.campaign.fuzz.case import Difference, FuzzCase, Target

__all__ = ["Difference", "FuzzCase", "Target"]
