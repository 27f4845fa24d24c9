"""Run the tests in a fixed environment, independent of the one they are started in.

A shell leaves signals ignored (``nohup``, a job in the background of a script), a language, a time
zone, a width of its terminal, a mask for new files, and what is in the home directory.
``tests/conftest.py`` calls :func:`settle` before the first test, in each process that runs tests.
"""

from __future__ import annotations

import contextlib
import locale
import os
import pwd
import shutil
import signal
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

__all__ = ["settle"]

_LEFT_OUT = (
    *("COLUMNS", "LINES", "COLORTERM", "NO_COLOR", "FORCE_COLOR", "PY_COLORS", "TTY_COMPATIBLE"),
    *("CLICOLOR", "CLICOLOR_FORCE", "TTY_INTERACTIVE", "PAGER", "LANG", "LANGUAGE", "TZ"),
    *("CI", "BUILD_NUMBER", "SOURCE_DATE_EPOCH", "MAKEFLAGS", "MFLAGS", "MAKELEVEL"),
    *("PYTHONPATH", "PYTHONWARNINGS", "PYTHONIOENCODING", "PYTHONUTF8", "PYTHONOPTIMIZE"),
    *("PYTHONSAFEPATH", "PYTHONDEVMODE", "PYTHONINSPECT", "PYTHONSTARTUP", "PYTHONUNBUFFERED"),
    # of the run that is under way; it is no option for those that tests start
    *("PYTEST_ADDOPTS", "PYTEST_PLUGINS", "PYTEST_DISABLE_PLUGIN_AUTOLOAD"),
)
_LEFT_OUT_BEGINNINGS = ("LC_", "XDG_", "DEXKIT_", "CYCLONEDDS_", "GITHUB_", "CLICK_")
_PYTHONS_OWN = (signal.SIGPIPE, signal.SIGXFSZ)  # it ignores them, and gives them back to children


def settle() -> Callable[[], None]:
    """Make the surroundings of this process and its children the same everywhere.

    :returns: removes the home directory that was made.
    """
    _streams()
    _signals()
    os.umask(0o022)
    home = _environment()
    time.tzset()
    with contextlib.suppress(locale.Error):
        locale.setlocale(locale.LC_ALL, "C.UTF-8")
    return lambda: shutil.rmtree(home, ignore_errors=True)


def _streams() -> None:
    """A closed stdin would be the number of the next file that is opened."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            # takes the lowest number that is free
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)


def _signals() -> None:
    """A child gets what is ignored or blocked here; what has a handler here has none there."""
    if threading.current_thread() is not threading.main_thread():
        return
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    for number in signal.valid_signals():
        if number in _PYTHONS_OWN or signal.getsignal(number) is not signal.SIG_IGN:
            continue
        if number == signal.SIGINT:
            signal.signal(number, signal.default_int_handler)
        elif number == signal.SIGHUP:
            # a run under nohup survives its terminal
            signal.signal(number, lambda *_: None)
        else:
            signal.signal(number, signal.SIG_DFL)


def _environment() -> str:
    environ = os.environ
    _keep_uvs_places(environ.get("HOME", ""))
    for name in list(environ):
        if name in _LEFT_OUT or name.startswith(_LEFT_OUT_BEGINNINGS):
            del environ[name]
    home = tempfile.mkdtemp(prefix="dexkit-home-")
    # one thread, as in dexkit's own commands: the scripts that tests start begin a sixth sooner
    environ.update(HOME=home, LC_ALL="C.UTF-8", TZ="UTC", TERM="xterm", OPENBLAS_NUM_THREADS="1")
    return home


def _keep_uvs_places(home: str) -> None:
    """uv's cache and its interpreters stay where they are, or each run would fetch them again."""
    if not os.access(home, os.W_OK):
        home = pwd.getpwuid(os.getuid()).pw_dir
    for name, base, default, rest in (
        ("UV_CACHE_DIR", "XDG_CACHE_HOME", ".cache", "uv"),
        ("UV_PYTHON_INSTALL_DIR", "XDG_DATA_HOME", ".local/share", "uv/python"),
        ("PYENV_ROOT", "", ".pyenv", ""),
    ):
        place = Path(os.environ.get(base) or Path(home) / default) / rest
        if name not in os.environ and place.is_dir():
            os.environ[name] = str(place)
