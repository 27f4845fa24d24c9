"""Values and help texts of options that the command line and the pytest plug-in both have.

They are literal, because neither loads the conformance package before it runs.
"""

from __future__ import annotations

__all__ = [
    "CAPABILITIES",
    "GRADE",
    "GRADES",
    "LEVEL",
    "LEVELS",
    "LIST",
    "PAGE",
    "REQUIRE",
    "RESULT",
    "SUMMARY",
]

GRADES = ("drop-in", "safety")
LEVELS = ("must", "should", "info")

CAPABILITIES = "What the vendor claims; the rest is reported as not claimed"
GRADE = "Grade that decides the exit code. Default: both. All requirements are judged and shown."
LEVEL = "Only requirements at least this binding."
LIST = "Print the requirements that are selected, and end."
PAGE = "Write a report page (HTML)."
REQUIRE = "Only requirements whose id begins with PREFIX"
RESULT = "Write the result file."
SUMMARY = "Write a summary in Markdown"
