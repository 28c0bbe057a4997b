"""Text that UTF-8 can hold. JSON may name half of a surrogate pair, `"\\ud83d"`, as a cut-off emoji leaves it: Python
reads it, and no file, terminal or HTTP answer can show it.
"""

import json
import re
from typing import Any

_SURROGATE = re.compile("[\ud800-\udfff]")


def is_utf8(document: Any) -> bool:
    """Whether UTF-8 can hold every text of a JSON document, keys too."""
    try:
        json.dumps(document, ensure_ascii=False).encode()
    except UnicodeEncodeError:
        return False
    return True


def require_utf8(document: Any) -> None:
    """Raise ValueError for a JSON document with text that UTF-8 cannot hold."""
    if not is_utf8(document):
        raise ValueError("it holds half of a character (a lone surrogate such as \\ud83d); write the whole character")


def replace_surrogates(document: Any) -> Any:
    """A JSON document, in which U+FFFD stands for what UTF-8 cannot hold."""
    if is_utf8(document):
        return document
    return json.loads(_SURROGATE.sub("\ufffd", json.dumps(document, ensure_ascii=False)))
