"""``dexkit view``: hands on a page in the browser, moving as on the wire. Needs the extra ``view``.

The page shows what a :class:`~dexkit.watch.Collector` knows; only :mod:`~dexkit.view.browser_page`,
:mod:`~dexkit.view.scene` and :mod:`~dexkit.view.strip_charts` touch the library that draws it.
:mod:`~dexkit.view.forward` shows the same in Rerun or Foxglove.
"""
