"""From the URL of a link in the configuration to the opener of its transport."""

from collections.abc import Callable

from arm_companion.errors import ConfigError
from arm_companion.transport.base import Opener
from arm_companion.transport.serial import open_serial
from arm_companion.transport.tcp import tcp_in, tcp_out
from arm_companion.transport.udp import udp_broadcast, udp_in, udp_out

FORMS = "udpin:HOST:PORT, udpout:HOST:PORT, udpbcast:HOST:PORT, tcp:HOST:PORT, tcpin:HOST:PORT, serial:DEVICE:BAUD"

_SOCKETS: dict[str, Callable[[str, int], Opener]] = {
    "udpin": udp_in,
    "udpout": udp_out,
    "udpbcast": udp_broadcast,
    "tcp": tcp_out,
    "tcpin": tcp_in,
}


def open_url(url: str) -> Opener:
    """The opener that `url` names. IPv6 hosts stand in brackets.

    Raises:
        ConfigError: with the URL and the allowed forms.
    """
    scheme, _, rest = url.partition(":")
    place, separator, number = rest.rpartition(":")
    if not separator or not place or not number.isascii() or not number.isdigit():
        raise ConfigError(f"link url {url!r} is not one of {FORMS}")
    value = int(number)
    if scheme == "serial":
        if not 1200 <= value <= 12_000_000:
            raise ConfigError(f"link url {url!r}: baud {value} is outside 1200 to 12000000")
        return open_serial(place, value)
    if scheme not in _SOCKETS:
        raise ConfigError(f"link url {url!r} is not one of {FORMS}")
    if not 1 <= value <= 65_535:
        raise ConfigError(f"link url {url!r}: port {value} is outside 1 to 65535")
    host = place.removeprefix("[").removesuffix("]")
    try:
        host.encode("idna")  # as the socket will, whose UnicodeError would be nobody's
    except UnicodeError:
        raise ConfigError(f"link url {url!r}: {host!r} is no name of a host") from None
    return _SOCKETS[scheme](host, value)


def open_bus(port: str, baud: int) -> Opener:
    """The opener of a servo bus: a serial device at `baud`, or the `tcp:HOST:PORT` of a bridge that has its own.

    Raises:
        ConfigError: a port that begins with `tcp:` and goes on otherwise.
    """
    return open_url(port) if port.startswith("tcp:") else open_serial(port, baud)
