"""The self-test of one hand: what its joints and sensors do today.

:mod:`~dexkit.conformance.selftest.joint_motion` moves joints, as a generator of commands that is
sent states; :mod:`~dexkit.conformance.selftest.procedure` is the order of the tests;
:mod:`~dexkit.conformance.selftest.supervision` adds the supervision. None of them has a clock, a
device or DDS: time is the states' stamps. :mod:`~dexkit.conformance.selftest.live` runs them on a
:class:`~dexkit.hand.Hand`, :mod:`~dexkit.conformance.selftest.external` is a hand on DDS.
:mod:`~dexkit.conformance.selftest.result` judges, and is the file.
"""
