r"""Check text from files that other people made: it must be UTF-8, and a path must stay in its folder.

JSON may contain a lone surrogate such as `"\ud83d"`, as from a truncated emoji. Python reads it, but no file, terminal
or HTTP response can contain it.
"""

import json
import re
from pathlib import PurePosixPath
from typing import Any

_SURROGATE = re.compile("[\ud800-\udfff]")


def is_utf8(document: Any) -> bool:
    """Return whether every text of a JSON document, keys included, can be encoded as UTF-8."""
    return not _SURROGATE.search(json.dumps(document, ensure_ascii=False))


def is_inside(path: str) -> bool:
    """Return whether `path` is a relative path that stays below its folder.

    Paths in indexes are untrusted: a path with ".." could lead to other files of the user.
    """
    parts = PurePosixPath(path).parts
    return bool(parts) and not path.startswith("/") and ".." not in parts and "\0" not in path


def replace_surrogates(document: Any) -> Any:
    """Return a JSON document with U+FFFD in place of each lone surrogate."""
    if is_utf8(document):
        return document
    return json.loads(_SURROGATE.sub("\ufffd", json.dumps(document, ensure_ascii=False)))
