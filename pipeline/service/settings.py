"""The service's settings, and the token that they name."""

import math
from dataclasses import dataclass

from pipeline.core import storage
from pipeline.core.errors import InputError

LOOPBACK_HOSTS = {"127.0.0.1", "::1", "localhost"}
MIN_TOKEN_CHARS = 16
"Characters: fewer can be guessed by asking."


@dataclass(frozen=True, kw_only=True)
class ServiceSettings:
    """Who may ask, and how much at once."""

    host: str = "127.0.0.1"
    "Address to listen on; any but loopback demands a token."
    port: int = 8000
    "Port to listen on; 0 for any that is free."
    token_file: str | None = None
    """File whose first line a request must bring as `Authorization: Bearer ...`; not a flag, which
    other users could read."""
    max_megabytes: float = 32.0
    "Of a photo as a file; more is refused before it is read."
    max_megapixels: float = 64.0
    "Of a photo; more is refused before it is decoded. A UAV's 48 megapixels fit."
    batch: int = 8
    "Photos computed at once."
    waiting: int = 32
    """Photos that may wait beyond those being computed; more are answered 503 with the seconds to
    wait."""
    timeout_s: float = 30.0
    "Seconds from a photo's arrival to its answer."
    upload_timeout_s: float = 20.0
    "Seconds for a photo to arrive."

    def __post_init__(self) -> None:
        for name in ("max_megabytes", "max_megapixels", "timeout_s", "upload_timeout_s"):
            if not 0 < (value := getattr(self, name)) < math.inf:
                raise InputError(
                    f"--{name.replace('_', '-')} is {value}, expected a number above 0"
                )
        for name in ("batch", "waiting"):
            if (count := getattr(self, name)) < 1:
                raise InputError(f"--{name} is {count}, expected at least 1")
        if not 0 <= self.port < 65_536:
            raise InputError(f"--port is {self.port}, expected 0 to 65535")
        if self.token_file is None and self.host not in LOOPBACK_HOSTS:
            raise InputError(
                f"--host is {self.host}, where others can reach the service, and there is no token; give --token-file, or "
                "keep --host 127.0.0.1"
            )

    @property
    def max_bytes(self) -> int:
        return int(self.max_megabytes * 1e6)

    @property
    def max_pixels(self) -> int:
        return int(self.max_megapixels * 1e6)

    def token(self) -> str | None:
        """The token that a request must bring; None where none is asked for.

        Raises InputError where the file does not hold one.
        """
        if self.token_file is None:
            return None
        if not storage.exists(self.token_file):
            raise InputError(
                f"no file at {self.token_file}, expected one whose first line is the token; check --token-file"
            )
        token = (
            storage.read_bytes(self.token_file)
            .decode("ascii", "replace")
            .partition("\n")[0]
            .strip()
        )
        if (
            len(token) < MIN_TOKEN_CHARS
            or not token.isascii()
            or not token.isprintable()
            or " " in token
        ):
            raise InputError(
                f"the first line of {self.token_file} has {len(token)} characters, expected a token of at least "
                f"{MIN_TOKEN_CHARS}, ASCII without blanks; `openssl rand -hex 16` makes one"
            )
        return token
