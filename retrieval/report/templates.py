"""Pages from the package's templates."""

from importlib import resources
from typing import Any

import jinja2


def render(name: str, **values: Any) -> str:
    """The template `name` with these values, whose text is escaped."""
    source = (resources.files("retrieval") / "templates" / name).read_text("utf-8")
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(source).render(**values)
