"""Datasets with known faults, by authors who had not read the checks, and who has found what.

Each ``author_X.py`` writes sets of good but unusual and of spoiled episodes with ``labels.json``;
:mod:`~tools.spoiled_sets.score` compares an audit of them with these.
"""
