"""One picture of the Dex family: each model as plain data, as a drawing, as a page.

=====================  =========================================================================
:mod:`~.facts`         a model as JSON-ready data, the one input of the command line and the page
:mod:`~.robot_layout`  how robots are drawn; a hand's layout is in its profile
:mod:`~.drawing`       the drawings, as SVG
:mod:`~.page`          docs/models.md and docs/images/model-*.svg:
                       ``python -m dexkit.family.page``
=====================  =========================================================================
"""
