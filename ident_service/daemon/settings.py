"""Hold the settings of the service: state folder, listening address, TLS, host names, webhook."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from ident_service.daemon.maintenance.webhook import require_address
from ident_service.errors import UsageError

PORT: Final = 8470
_LOCAL_NAMES: Final = frozenset({"localhost", "127.0.0.1", "::1"})


@dataclass(frozen=True)
class Settings:
    """Settings that a service is started with.

    Attributes:
        state: the state folder.
        host: address to listen on; one that is not a loopback one needs a certificate and its key.
        port: port to listen on; 0 for any that is free.
        tls_cert: file of the certificate chain, PEM.
        tls_key: file of its key, PEM.
        names: host names under which clients may reach it, besides the address.
        motion_socket: socket of the unit that motions run in; None for processes of the service's own.
        webhook: address that notices go to; None for nobody.
        webhook_secret: file of the secret that they are signed with.
        computing: how many jobs compute at a time.
        lease_factor: factor of the leases, for tests on machines that stall (`jobs/queue.py`).
    """

    state: Path
    host: str = "127.0.0.1"
    port: int = PORT
    tls_cert: Path | None = None
    tls_key: Path | None = None
    names: tuple[str, ...] = ()
    motion_socket: Path | None = None
    webhook: str | None = None
    webhook_secret: Path | None = None
    computing: int = 1
    lease_factor: float = 1.0

    def __post_init__(self) -> None:
        """Refuse settings that would expose the service to a network.

        Raises:
            UsageError: an address beyond loopback without TLS, half of what TLS or a webhook needs, or no address.
        """
        if (self.tls_cert is None) != (self.tls_key is None):
            raise UsageError("TLS needs both --tls-cert and --tls-key")
        if (self.webhook is None) != (self.webhook_secret is None):
            raise UsageError("a webhook needs both --webhook and --webhook-secret")
        if self.webhook is not None:
            require_address(self.webhook)
        for path in (self.tls_cert, self.tls_key):
            if path is not None and not path.is_file():
                raise UsageError(f"{path}: no such file")
        if not self.loopback and not self.tls:
            raise UsageError(
                f"{self.host} can be reached from other machines: give --tls-cert and --tls-key, or listen on 127.0.0.1"
            )

    @property
    def loopback(self) -> bool:
        """Return whether the service listens at a loopback address or `localhost`: only this machine reaches it."""
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            # A resolver may map a name to any address; only this name is sure to mean loopback.
            return self.host == "localhost"

    @property
    def tls(self) -> bool:
        """Return whether the service speaks TLS: a certificate is set."""
        return self.tls_cert is not None

    @property
    def hosts(self) -> frozenset[str]:
        """Return the names that a request's Host may have, in lower case, without port and brackets."""
        own = {name.lower() for name in (*self.names, self.host)} - {"0.0.0.0", "::"}  # noqa: S104 - taken out
        return frozenset(own | _LOCAL_NAMES) if self.loopback else frozenset(own)
