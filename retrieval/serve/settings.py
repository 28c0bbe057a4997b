"""Options and limits of the service."""

import ipaddress
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from msgspec import Meta

from _touch_retrieval.documents import Count, check_fields
from retrieval.data.images import MAX_PIXELS
from retrieval.errors import ConfigError

MAX_BODY_BYTES = 20_000_000
"""Maximum size of a request with pictures; other requests: `MAX_SMALL_BODY_BYTES`."""
MAX_SMALL_BODY_BYTES = 16_384
MAX_BODY_PIXELS = 5 * MAX_PIXELS
"""Maximum pixels of all pictures of one request together; each picture: `MAX_PIXELS`."""
MAX_PICTURES = 128
"""Maximum number of pictures of one request."""
MIN_TOKEN_CHARACTERS = 16
Port = Annotated[int, Meta(ge=0, lt=2**16)]
Wait = Annotated[float, Meta(gt=0, le=86_400)]
"""A time limit in seconds, at most a day."""


@dataclass(frozen=True, kw_only=True)
class ServiceSettings:
    """Options of `retrieve serve`.

    Attributes:
        index: Index folder.
        model: Checkpoint; None for the one that the index names.
        host: Host to listen on; a host other than this machine requires a `token`.
        port: Port to listen on; 0: any free port.
        token: Access token of at least 16 ASCII characters; None for a service without one.
        queue: Maximum number of requests in flight.
        deadline_s: Time limit for an answer.
        body_s: Time limit for the body of a request to arrive.
        poll_s: Interval of the checks for a new generation of the index.
        history: Folder for queries and feedback; None to store nothing.

    Raises:
        ConfigError: An option is out of its range.
    """

    index: Path
    model: Path | None = None
    host: str = "127.0.0.1"
    port: Port = 8000
    token: str | None = None
    queue: Count = 8
    deadline_s: Wait = 30.0
    body_s: Wait = 10.0
    poll_s: Wait = 1.0
    history: Path | None = None

    def __post_init__(self) -> None:
        check_fields(self, "", ConfigError)
        if self.token is None and not self.is_local:
            raise ConfigError(
                f"Other machines can reach {self.host}, so a token is required. Set RETRIEVE_TOKEN to at least "
                f"{MIN_TOKEN_CHARACTERS} random characters, or omit --host."
            )
        if self.token is not None and not (len(self.token) >= MIN_TOKEN_CHARACTERS and self.token.isascii()):
            raise ConfigError(
                f"A token must have at least {MIN_TOKEN_CHARACTERS} ASCII characters, got {len(self.token)} characters."
            )

    @property
    def threads(self) -> int:
        """Number of threads for the computation of one request; one core stays free for the event loop."""
        return max(1, (os.cpu_count() or 1) - 1)

    @property
    def is_local(self) -> bool:
        """Whether only this machine can reach the service."""
        if self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False
