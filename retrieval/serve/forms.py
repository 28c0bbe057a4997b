"""Parser of multipart/form-data bodies (RFC 7578) with a limit on the number of parts.

It uses `bytes` methods, which run in C. A general parser calls Python for each header and for each byte that may begin
a boundary, without a limit.
"""

from email.message import Message
from email.parser import HeaderParser
from email.utils import collapse_rfc2231_value
from typing import NamedTuple

from retrieval.serve.errors import HttpProblem
from retrieval.serve.settings import MAX_PICTURES

MAX_PARTS = MAX_PICTURES + 8
"""Maximum number of parts: pictures, and options of the query."""
MAX_PART_HEADER_BYTES = 4096


class FormPart(NamedTuple):
    """A field of a form; `is_file` if it was sent with a file name."""

    name: str
    is_file: bool
    content: bytes


def form_parts(body: bytes, content_type: str) -> list[FormPart]:
    """Return the parts of a form, in their order.

    Raises:
        HttpProblem: The body is not a valid form, or it has too many parts.
    """
    header = Message()
    header["content-type"] = content_type
    boundary = header.get_boundary("")
    if not boundary or not boundary.isascii() or len(boundary) > 70:
        raise HttpProblem("malformed", "multipart/form-data requires a boundary of 1 to 70 ASCII characters.")
    delimiter = b"\r\n--" + boundary.encode("ascii")
    body = b"\r\n" + body
    found = body.count(delimiter) - 1  # the last delimiter ends the form
    if found > MAX_PARTS:
        raise HttpProblem("bad-input", f"A form may have at most {MAX_PARTS} parts, got {found}.")
    _, *parts = body.split(delimiter)
    if not parts or not parts[-1].startswith(b"--"):
        raise HttpProblem("bad-input", "The form is incomplete: it must end with its boundary and two dashes.")
    return [_part(part) for part in parts[:-1]]


def _part(part: bytes) -> FormPart:
    end = part.find(b"\r\n\r\n", 0, MAX_PART_HEADER_BYTES)
    if end < 0:
        raise HttpProblem(
            "bad-input", f"Each part of a form must begin with headers of at most {MAX_PART_HEADER_BYTES} bytes."
        )
    headers = HeaderParser().parsestr(part[:end].decode("utf-8", "replace").lstrip())
    name = headers.get_param("name", header="content-disposition")
    if name is None:
        raise HttpProblem("bad-input", "Each part of a form must name its field in content-disposition.")
    return FormPart(collapse_rfc2231_value(name), headers.get_filename() is not None, part[end + 4 :])
