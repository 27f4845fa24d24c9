"""Leave credentials of URLs out of what is shown or kept.

By their place, not by their names: whoever shares a result must not share the userinfo of a URL
(``http://user:password@host/``), its query (``?X-Amz-Signature=...``, ``?token=...``) or its
fragment. Each is replaced by ``***``. What a URL's library is asked for keeps the URL itself; all
else goes through :func:`redact`, and the name of a file behind a URL is its :func:`url_name`.
"""

from __future__ import annotations

import hashlib
import logging
import re
from urllib.parse import parse_qsl, unquote

__all__ = ["redact", "redact_logs", "url_name"]

_SHOWN = "***"
_SCHEME = r"[A-Za-z][A-Za-z0-9+.\-]*:/+"  # one slash is what a path leaves of two
# A quote belongs to a URL, unless the text goes on behind it as behind a quoted one
_CHARACTER = r"""(?:[^\s"'<>]|'(?![\s,)\]}.;:]|$))"""
_URL = re.compile(
    rf"(?P<scheme>{_SCHEME})(?P<place>(?:(?!{_SCHEME})(?![?#]){_CHARACTER})*)"
    rf"(?P<rest>[?#](?:\*\*\*(?!{_CHARACTER}{{2}})|{_CHARACTER}*))?"
)
_WHOLE = re.compile(
    rf"(?P<scheme>{_SCHEME})(?P<place>(?:(?!{_SCHEME})[^?#])*)(?P<rest>[?#].*)?", re.DOTALL
)
_HOST = re.compile(r"(\[[^\]]*\]|[^:]*)(:\d*)?")
# Characters of a part of a URL, and of a value of its query, that are left out of other text, too
_SHORT, _LONG = 4, 8
_PASSWORD = re.compile(r"(://[^/?#@:]*):[^/?#]*@")


def redact(text: object, *urls: str) -> str:
    """``text`` without the credentials of the URLs in it.

    :param urls: URLs that the text may be about. They are found whatever characters they hold, and
        so are their userinfo, query and fragment alone.
    """
    shown = str(text)
    for url in urls:
        if (instead := _WHOLE.sub(_redacted, url)) == url:
            continue
        shown = shown.replace(url, instead)
        for secret in sorted(_secrets(url), key=len, reverse=True):
            shown = shown.replace(secret, _SHOWN)
    return _URL.sub(_redacted, shown)


def url_name(url: str) -> str:
    """The name of a file behind a URL: without credentials, and with a digest of the URL where that
    leaves something out, so that different URLs have different names.

    The password is not part of the digest: it could be guessed with it.
    """
    shown = redact(url, url)
    if shown == url:
        return url
    digest = hashlib.sha256(_PASSWORD.sub(r"\1@", url).encode("utf-8", "surrogateescape"))
    return f"{shown} [{digest.hexdigest()[:16]}]"


def redact_logs() -> None:
    """Redact what other libraries log where nobody has set up logging: on standard error."""
    if logging.lastResort is not None:
        logging.lastResort.setFormatter(_Formatter())


class _Formatter(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        return redact(super().format(record))


def _redacted(found: re.Match[str]) -> str:
    scheme, place, rest = found["scheme"], found["place"], found["rest"] or ""
    host, slash, path = place.partition("/")
    if "@" in host:
        place = f"{_SHOWN}@{host.rpartition('@')[2]}{slash}{path}"
    elif "@" in place + rest and not _HOST.fullmatch(host):
        # no host and port: a password with a slash, question mark or hash that is not escaped
        if "@" not in path:
            return f"{scheme}{_SHOWN}"
        place = f"{_SHOWN}@{place.rpartition('@')[2]}"
    return f"{scheme}{place}{rest[:1]}{_SHOWN if rest else ''}"


def _secrets(url: str) -> set[str]:
    """Userinfo, password, query and fragment of a URL, as they stand and decoded, and the values of
    the query; without those that are too short to be one.
    """
    rest = re.sub(f".*?{_SCHEME}", "", url, count=1, flags=re.DOTALL)
    place, query, fragment = re.fullmatch(r"([^?#]*)\??([^#]*)#?(.*)", rest, re.DOTALL).groups()  # type: ignore[union-attr]
    user = place.partition("/")[0].rpartition("@")[0]
    found = {user, user.partition(":")[2], query, fragment}
    values = {value for _, value in parse_qsl(f"{query}&{fragment}") if len(value) >= _LONG}
    return {secret for secret in found | set(map(unquote, found)) | values if len(secret) >= _SHORT}
