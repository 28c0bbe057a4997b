"""What an operator may choose of the service."""

import ipaddress
import os
from dataclasses import dataclass
from pathlib import Path

from retrieval.data.images import MAX_PIXELS
from retrieval.errors import ConfigError

MAX_BODY_BYTES = 20_000_000
"""Of a request with pictures; of any other, MAX_SMALL_BODY_BYTES."""
MAX_SMALL_BODY_BYTES = 16_384
MAX_BODY_PIXELS = 5 * MAX_PIXELS
"""Of all pictures of one request together; of each, MAX_PIXELS."""
MAX_PICTURES = 128
"""Of one request."""
MIN_TOKEN_CHARACTERS = 16
MAX_WAIT_S = 86_400


@dataclass(frozen=True, kw_only=True)
class ServiceSettings:
    """What `retrieve serve` was told.

    host: where it listens; anything but this machine needs a `token` (16 characters at least). queue: requests that
    are held at once, those in work among them. workers: threads that answer. max_batch: so many queries that wait and
    ask alike are answered together at most. batch_ms: how long one waits for others besides. deadline_s: after which an
    answer is no longer waited for. body_s: by which the body of a request must have come. poll_s: how often a new
    generation of the index is looked for. history: folder where queries are kept, and what is said of them; None keeps
    nothing. keep, keep_bytes: queries of which nothing was said, and their gel images, that are kept at most. streams:
    pictures of sensors that run at once.
    """

    index: str | Path
    model: Path | None = None
    verify: bool = True
    host: str = "127.0.0.1"
    port: int = 8000
    token: str | None = None
    queue: int = 8
    workers: int = 1
    batch_ms: float = 0.0
    max_batch: int = 4
    deadline_s: float = 30.0
    body_s: float = 10.0
    poll_s: float = 1.0
    history: Path | None = None
    keep: int = 10_000
    keep_bytes: int = 4 * 2**30
    streams: int = 8

    def __post_init__(self) -> None:
        """Raises ConfigError."""
        for name in ("queue", "workers", "max_batch", "keep", "keep_bytes", "streams"):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name} must be 1 or more; got {getattr(self, name)}")
        for name in ("deadline_s", "body_s", "poll_s"):
            if not 0 < getattr(self, name) <= MAX_WAIT_S:
                raise ConfigError(f"{name} must be above 0 and at most {MAX_WAIT_S} seconds; got {getattr(self, name)}")
        for name, maximum in (("batch_ms", 1000), ("port", 2**16 - 1)):
            if not 0 <= getattr(self, name) <= maximum:
                raise ConfigError(f"{name} must be from 0 to {maximum}; got {getattr(self, name)}")
        if self.token is None and not self.is_local:
            raise ConfigError(
                f"{self.host} can be reached from other machines, so a token must be given: write {MIN_TOKEN_CHARACTERS} or "
                "more characters into a file and name it with --token-file, or leave out --host"
            )
        if self.token is not None and not (len(self.token) >= MIN_TOKEN_CHARACTERS and self.token.isascii()):
            raise ConfigError(f"a token must be {MIN_TOKEN_CHARACTERS} or more ASCII characters; got {len(self.token)}")

    @property
    def threads(self) -> int:
        """With which one request is worked on. A core is left to the event loop, which else answers late; and threads
        of one computation wait for each other, so that a taken core holds up all of them.
        """
        return max(1, ((os.cpu_count() or 1) - 1) // self.workers)

    @property
    def is_local(self) -> bool:
        """Whether only this machine reaches the service."""
        if self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False
