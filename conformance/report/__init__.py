"""Renderings of one result: terminal, JUnit, HTML. JSON is :meth:`RunResult.write_json`."""
