"""The service's settings, and the token in the file that they name."""

import math
from dataclasses import dataclass

from pipeline.core import storage
from pipeline.core.errors import InputError, require

LOOPBACK_HOSTS = {"127.0.0.1", "::1", "localhost"}
MIN_TOKEN_CHARS = 16
"A shorter token can be guessed by trying."


@dataclass(frozen=True, kw_only=True)
class ServiceSettings:
    """The address to listen on, the token, and the limits."""

    host: str = "127.0.0.1"
    "Address to listen on; any but loopback requires a token."
    port: int = 8000
    "Port to listen on; 0 for any that is free."
    token_file: str | None = None
    """File whose first line requests must send as `Authorization: Bearer ...`; not a flag, which
    other users could read."""
    max_megabytes: float = 32.0
    "Size of a photo's file; a larger one is refused before it is read."
    max_megapixels: float = 64.0
    "Size of a photo; a larger one is refused before it is decoded. A UAV's 48 megapixels fit."
    batch: int = 8
    "Photos in a batch."
    waiting: int = 32
    """Photos that may wait beyond those being computed; further ones get 503 with the seconds to
    wait."""
    timeout_s: float = 30.0
    "Seconds from a photo's arrival to its answer."
    upload_timeout_s: float = 20.0
    "Seconds for a photo to arrive."

    def __post_init__(self) -> None:
        for name in ("max_megabytes", "max_megapixels", "timeout_s", "upload_timeout_s"):
            value = getattr(self, name)
            require(0 < value < math.inf, name, value, "a number above 0")
        for name in ("batch", "waiting"):
            require(getattr(self, name) >= 1, name, getattr(self, name), "at least 1")
        require(0 <= self.port < 65_536, "port", self.port, "0 to 65535")
        if self.token_file is None and self.host not in LOOPBACK_HOSTS:
            raise InputError(
                f"--host is {self.host}, where others can reach the service, and there is no "
                "token; give --token-file, or keep --host 127.0.0.1"
            )

    @property
    def max_bytes(self) -> int:
        return int(self.max_megabytes * 1e6)

    @property
    def max_pixels(self) -> int:
        return int(self.max_megapixels * 1e6)

    def token(self) -> str | None:
        """The token that requests must send; None where the service requires none.

        Raises InputError where the file has no valid one.
        """
        if self.token_file is None:
            return None
        if not storage.exists(self.token_file):
            raise InputError(
                f"no file at {self.token_file}, expected one whose first line is the token; check "
                "--token-file"
            )
        first_line = storage.read_bytes(self.token_file).partition(b"\n")[0]
        token = first_line.decode("ascii", "replace").strip()
        valid = token.isascii() and token.isprintable() and " " not in token
        if len(token) < MIN_TOKEN_CHARS or not valid:
            raise InputError(
                f"the first line of {self.token_file} has {len(token)} characters, expected a "
                f"token of at least {MIN_TOKEN_CHARS}, ASCII without blanks; `openssl rand -hex "
                "16` makes one"
            )
        return token
