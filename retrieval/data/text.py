r"""Check that text can be encoded as UTF-8.

JSON may contain a lone surrogate such as `"\ud83d"`, as from a truncated emoji. Python reads it, but no file, terminal
or HTTP response can contain it.
"""

import json
import re
from typing import Any

_SURROGATE = re.compile("[\ud800-\udfff]")


def is_utf8(document: Any) -> bool:
    """Return whether every text of a JSON document, keys included, can be encoded as UTF-8."""
    try:
        json.dumps(document, ensure_ascii=False).encode()
    except UnicodeEncodeError:
        return False
    return True


def require_utf8(document: Any) -> None:
    """Check that a JSON document can be encoded as UTF-8.

    Raises:
        ValueError: A text contains a lone surrogate.
    """
    if not is_utf8(document):
        raise ValueError("contains a lone surrogate such as \\ud83d; write the whole character")


def replace_surrogates(document: Any) -> Any:
    """Return a JSON document with U+FFFD in place of each lone surrogate."""
    if is_utf8(document):
        return document
    return json.loads(_SURROGATE.sub("\ufffd", json.dumps(document, ensure_ascii=False)))
