"""Where a camera's server is: host and port of the key `address`."""

from __future__ import annotations

from urllib.parse import urlsplit

from namod_ctl.core.errors import ConfigError
from namod_ctl.devices.cameras.settings import CameraSettings


def server_address(settings: CameraSettings, default_port: int) -> tuple[str, int]:
    """Host and port that `settings.address` names; "localhost", "10.0.0.7:11111" and "[::1]:7624" are addresses.

    Raises
    ------
    ConfigError
        There is no address, or it is none.
    """
    where = f"[{settings.role}_camera.device] address"
    if settings.address is None:
        raise ConfigError(
            f'{where} is missing: driver "{settings.driver}" needs to know where the camera\'s server is, '
            f'for example address = "127.0.0.1:{default_port}"'
        )
    try:
        parts = urlsplit(f"//{settings.address}")
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise ConfigError(f'{where} = "{settings.address}": {error}; write host:port') from error
    if not host or parts.netloc != settings.address or parts.username is not None:
        raise ConfigError(
            f'{where} = "{settings.address}" names no server; write host:port, for example "127.0.0.1:{default_port}"'
        )
    return host, default_port if port is None else port
