"""Files on the Hugging Face Hub, addressed as `hf://USER/NAME` or, to read, `hf://USER/NAME@REVISION`.

`huggingface_hub` is imported when an address is used. It finds the user's token, and it keeps downloaded files in its
cache, from which they are read without a network.
"""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from retrieval.errors import BadInput, RetrievalError

CHECKPOINT_FILE, CARD_FILE = "model.safetensors", "README.md"
"""Names in a repository."""
_ADDRESS = re.compile(r"hf:/{1,2}([\w.-]+/[\w.-]+)(?:@([\w./-]+))?")  # pathlib makes one slash of two


class Address(NamedTuple):
    """A repository on the Hub; `revision` is a branch, tag or commit, None for the newest."""

    repository: str
    revision: str | None

    def __str__(self) -> str:
        return f"hf://{self.repository}" + (f"@{self.revision}" if self.revision else "")


def parse_address(text: str) -> Address:
    """Return the address of a repository. Raises BadInput for any other text."""
    match = _ADDRESS.fullmatch(text)
    if match is None:
        raise BadInput(f"an address on the Hub must be hf://USER/NAME or hf://USER/NAME@REVISION; got {text}")
    return Address(match[1], match[2])


def local_file(path: str | Path) -> Path:
    """Return a path as it is; for an address on the Hub download its checkpoint, and return the file in the cache.

    Raises:
        BadInput: The package, the repository, the revision or the file is missing, or may not be read.
        RetrievalError: There is no network, and the cache does not have the file.
    """
    if not str(path).startswith("hf:/"):
        return Path(path)
    address = parse_address(str(path))
    with _hub(address) as hub:
        return Path(hub.hf_hub_download(address.repository, CHECKPOINT_FILE, revision=address.revision))


def upload(address: Address, files: Mapping[str, bytes | Path], *, kind: str, is_public: bool) -> str:
    """Write files into a repository in one commit, and make the repository if there is none.

    Args:
        address: The repository.
        files: Content by name in the repository, which loses all other files in `images/`.
        kind: "model" or "dataset".
        is_public: Whether a new repository is public, and whether a public one may be written.

    Returns:
        "public" or "private".

    Raises:
        BadInput: The package is missing, the token may not write, or the repository is public.
        RetrievalError: The Hub cannot be reached, or refuses the files.
    """
    name, options = address.repository, {"repo_type": kind}
    with _hub(address) as hub:
        api = hub.HfApi()
        api.create_repo(name, private=not is_public, exist_ok=True, **options)
        existing = api.repo_info(name, **options)
        if not (is_public or existing.private):
            raise BadInput(f"{address} exists and is public; add --public to write there, or give another name")
        operations = [
            hub.CommitOperationAdd(path, content if isinstance(content, bytes) else str(content))
            for path, content in files.items()
        ]
        stored = [entry.rfilename for entry in existing.siblings or ()]
        operations += [
            hub.CommitOperationDelete(path) for path in stored if path.startswith("images/") and path not in files
        ]
        api.create_commit(name, operations, commit_message="Upload with touch-retrieval", **options)
    return "private" if existing.private else "public"


@contextmanager
def _hub(address: Address) -> Iterator[Any]:
    """Yield `huggingface_hub`; its errors become one sentence, which never contains the text of a request."""
    try:
        import huggingface_hub
    except ImportError as error:
        raise BadInput(f"{address} needs a package: pip install 'touch-retrieval[hub]'") from error
    try:
        yield huggingface_hub
    except Exception as error:
        if isinstance(error, RetrievalError) or getattr(error, "errno", None) is not None:  # such as a full disk
            raise
        raise _explained(address, error) from error


def _explained(address: Address, error: Exception) -> RetrievalError:
    from huggingface_hub import errors

    status = getattr(getattr(error, "response", None), "status_code", None)
    if isinstance(error, errors.RevisionNotFoundError):
        return BadInput(f"{address} does not exist: the repository has no such branch, tag or commit")
    if isinstance(error, errors.LocalEntryNotFoundError | errors.OfflineModeIsEnabled) or (
        status is None and not isinstance(error, ValueError)
    ):
        return RetrievalError(
            f"the Hub cannot be reached for {address} ({type(error).__name__}); check the network, HF_ENDPOINT and "
            "HF_HUB_OFFLINE; without a network only models that were read before can be read"
        )
    if isinstance(error, errors.EntryNotFoundError):
        return BadInput(f"{address} has no {CHECKPOINT_FILE}; `retrieve push` writes it")
    if isinstance(error, errors.RepositoryNotFoundError) or status in (401, 403):
        return BadInput(
            f"{address} does not exist, or your token may not use it; check the name, and log in with `hf auth login` "
            "or set HF_TOKEN (to write, to a token that may write)"
        )
    reason = getattr(error, "server_message", None) or (str(error) if status is None else f"status {status}")
    return RetrievalError(f"the Hub refused {address}: {' '.join(reason.split())}")
