"""Addresses in numbers under which others in the network reach this computer."""

from __future__ import annotations

import fcntl
import socket
import struct
from contextlib import suppress
from typing import Final

_SIOCGIFADDR: Final = 0x8915
"""Asks Linux for the IPv4 address of an interface (netdevice(7))."""

_NAME_LENGTH: Final = 15
_ADDRESS_AT: Final = slice(20, 24)
"""Of `struct ifreq`: after the name, 16 bytes, family and port of `struct sockaddr_in`."""


def own_addresses() -> list[str]:
    """IPv4 addresses of this computer's interfaces that are up, without its loopback; empty when there is no network.

    The name of the computer is often one that nobody else knows, or stands for its loopback.
    """
    found = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        for _, name in socket.if_nameindex():
            request = struct.pack("256s", name.encode()[:_NAME_LENGTH])
            with suppress(OSError):  # an interface without an address
                answer = fcntl.ioctl(asking.fileno(), _SIOCGIFADDR, request)
                found.append(socket.inet_ntoa(answer[_ADDRESS_AT]))
    return [address for address in found if not address.startswith("127.")]
