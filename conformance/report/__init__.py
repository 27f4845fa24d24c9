"""Render results: terminal, HTML page, Markdown, JUnit, badge, comparison.

:mod:`~.card` holds the facts about a requirement; :mod:`~.labels` the names that all share;
:mod:`~.result_plots` and :mod:`~.run_plots` choose what :mod:`~.charts` draws.
"""
