"""Where the console may listen: on this machine as it is, elsewhere only with passwords, TLS and an audit log.

Options that are not given are taken from the service's credentials (systemd.exec(5), LoadCredential): the files
`CREDENTIALS` in ``$CREDENTIALS_DIRECTORY``.
"""

from __future__ import annotations

import ipaddress
import os
import ssl
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from console.accounts import Accounts, read_accounts
from runtime.errors import ConfigError, TimberhandError

CREDENTIALS: Final = {"passwords": "console-passwords", "tls_cert": "console-cert", "tls_key": "console-key"}


@dataclass(frozen=True, slots=True)
class Exposure:
    """What protects a console: each None on this machine alone."""

    passwords: Path | None = None
    tls_cert: Path | None = None
    tls_key: Path | None = None
    audit: Path | None = None

    def with_credentials(self, environment: Mapping[str, str] = os.environ) -> Exposure:
        """Return the same, with the service's credentials in place of what is not given."""
        folder = environment.get("CREDENTIALS_DIRECTORY")
        credential_paths = {name: getattr(self, name) for name in CREDENTIALS}
        for name, file in CREDENTIALS.items():
            if folder and credential_paths[name] is None and (path := Path(folder, file)).exists():
                credential_paths[name] = path
        return Exposure(**credential_paths, audit=self.audit)

    def check(self, bind: str) -> Accounts | None:
        """Return the accounts for serving on an address, None where nobody signs in.

        Raises:
            StartError: it may not be served there, or a file cannot be used.
        """
        if (self.tls_cert is None) != (self.tls_key is None):
            raise StartError("console.tls-pair", "give --tls-cert and --tls-key together, or neither of them", 2)
        missing = [
            option
            for option, given in (
                ("--passwords", self.passwords),
                ("--tls-cert and --tls-key", self.tls_cert),
                ("--audit", self.audit),
            )
            if given is None
        ]
        if missing and not is_local(bind):
            sentence = (
                f"{bind} is reached from other machines, where the page needs passwords, TLS and an audit log; give "
                f"{', '.join(missing)}, or serve on 127.0.0.1 and use an ssh tunnel"
            )
            raise StartError("console.unprotected", sentence, 2)
        if self.tls_cert is not None and self.tls_key is not None:
            self._check_tls(self.tls_cert, self.tls_key)
        try:
            return None if self.passwords is None else read_accounts(self.passwords)
        except ConfigError as error:
            raise StartError(error.code, str(error), 3) from None

    @staticmethod
    def _check_tls(cert: Path, key: Path) -> None:
        try:
            ssl.create_default_context(ssl.Purpose.CLIENT_AUTH).load_cert_chain(cert, key, password="")
        except (OSError, ssl.SSLError) as error:
            reason = error.strerror or str(error)
            sentence = (
                f"{cert} and {key} are no certificate and its key ({reason}); give them as PEM, the key unencrypted"
            )
            raise StartError("console.tls-files", sentence, 3) from None


def is_local(bind: str) -> bool:
    """Tell whether an address is reached from this machine only."""
    try:
        return ipaddress.ip_address(bind).is_loopback
    except ValueError:
        return bind == "localhost"


def check_local(bind: str, what: str) -> None:
    """Refuse to serve on an address that other machines reach.

    Raises:
        StartError: they do.
    """
    if not is_local(bind):
        sentence = f"{what} is served on this machine only, not on {bind}; serve on 127.0.0.1 and use an ssh tunnel"
        raise StartError("console.local-only", sentence, 2)


# -- Why the console cannot start.


class StartError(TimberhandError):
    """The console cannot start: an error code, one sentence and the exit code of the process."""

    def __init__(self, code: str, sentence: str, exit_code: int) -> None:
        super().__init__(code, sentence)
        self.exit_code = exit_code

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.code, str(self), self.exit_code)
