"""The documentation site: ``make docs-site`` builds it of docs/, the catalogue and the docstrings.

``mkdocs.yml`` names the settings; :mod:`~tools.site.hooks` adds the pages that are made.
"""
