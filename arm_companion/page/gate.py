"""Who may see the page and press its button. Pure.

A browser carries requests for whatever site it shows, so an address on loopback protects from nobody: a page from
anywhere can send to it (cross-site requests) or get a name of its own to point at it (DNS rebinding). Hence: the name
that we are called by must be an address, localhost or a configured name; what changes something must come from our own
page; and where a token is set, a cookie must prove it that no other site can have sent (SameSite=Strict).
"""

import hashlib
import hmac
import ipaddress
from collections.abc import Collection, Mapping
from http.cookies import CookieError, SimpleCookie
from typing import Final

COOKIE: Final = "arm_companion_page"
_SAME_SITE: Final = frozenset({"same-origin", "none"})


class Gate:
    """The rules.

    Args:
        token: that is asked for; empty: none is.
        names: host names by which browsers may call us.
    """

    def __init__(self, token: str, names: Collection[str] = ()) -> None:
        self._token = token
        self._names = frozenset(name.lower() for name in names) | {"localhost"}
        # what a cookie shows must not be the token itself, and must hold beyond a restart of this process
        self._proof = hmac.new(token.encode(), b"arm_companion page", hashlib.sha256).hexdigest()

    @property
    def asks_token(self) -> bool:
        """Whether there is a token."""
        return bool(self._token)

    @property
    def cookie(self) -> str:
        """The header that lets a browser in."""
        return f"{COOKIE}={self._proof}; Path=/; HttpOnly; SameSite=Strict; Max-Age=86400"

    def knows_host(self, host: str) -> bool:
        """Whether a Host header is a name of ours; any port, since a tunnel may have another."""
        name, colon, port = host.rpartition(":")
        if not colon or host.endswith("]"):
            name, port = host, ""
        if port and not (port.isascii() and port.isdigit()):
            return False
        if name.startswith("[") and name.endswith("]"):
            name = name[1:-1]
        elif ":" in name:
            return False
        if name.lower() in self._names:
            return True
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return False
        return True

    def from_our_page(self, headers: Mapping[str, str]) -> bool:
        """Whether a request that changes something comes from our own page: its Origin is the host it calls."""
        origin, host = headers.get("origin", ""), headers.get("host", "")
        return bool(host) and origin in (f"http://{host}", f"https://{host}") and self.not_cross_site(headers)

    @staticmethod
    def not_cross_site(headers: Mapping[str, str]) -> bool:
        """Whether the browser does not say that another site made it ask; older browsers say nothing."""
        return headers.get("sec-fetch-site", "none") in _SAME_SITE

    def admits(self, headers: Mapping[str, str]) -> bool:
        """Whether a request carries the proof that its browser was given the token."""
        if not self._token:
            return True
        try:
            cookies = SimpleCookie(headers.get("cookie", ""))
        except CookieError:
            return False
        morsel = cookies.get(COOKIE)
        return morsel is not None and _same(morsel.value, self._proof)

    def is_token(self, word: str) -> bool:
        """Whether this is the token; how long it takes does not tell how much of it is right."""
        return bool(self._token) and _same(word, self._token)


def _same(a: str, b: str) -> bool:
    return hmac.compare_digest(a.encode(errors="replace"), b.encode(errors="replace"))
