"""Judge every recorded session of an archive, and keep one row for each file and finding.

* :mod:`~.sessions`: which files there are, in folders and behind URLs.
* :mod:`~.examine`: judge one of them; whatever is wrong with it becomes a row.
* :mod:`~.workers`: do so in several processes, of which any may die.
* :mod:`~.cluster`: do so on a Ray cluster, whose nodes may die.
* :mod:`~.journal`: what is done, line by line on the disk, so that an audit can go on later.
* :mod:`~.result_tables`: the rows as Parquet or JSON lines; :mod:`~.summary_page`: the page.
* :mod:`~.audit`: all of it together.
"""
