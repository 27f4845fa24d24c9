"""Judge the episodes of datasets: which to train on, which to look at, which to drop.

The data of an episode are in :mod:`~dexkit.conformance.dataset.episode`, what is found in
:mod:`~dexkit.conformance.dataset.findings`, the checks in ``checks/``, one subject a file, and
:mod:`~dexkit.conformance.dataset.judge` puts them together.
"""
