"""Licences of the data that train a model."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from _touch_retrieval.documents import typed
from retrieval.errors import BadInput

NOT_STATED = "not stated"
LICENCES = "licences"
"""Key of a checkpoint's provenance: the fields of each DataLicence."""


@dataclass(frozen=True)
class DataLicence:
    """The licence of one source of training data.

    Attributes:
        source: The recording's source, or the file or folder.
        licence: Name of the licence, or `NOT_STATED`.
        terms: Conditions of use, or where to find them; empty if nothing is known.
    """

    source: str
    licence: str = NOT_STATED
    terms: str = ""

    def __str__(self) -> str:
        return f"{self.licence} ({self.terms})" if self.terms else self.licence


def stored_licences(provenance: Mapping[str, Any]) -> list[DataLicence]:
    """Return the licences in the provenance of a checkpoint; none if an older version made it.

    Raises:
        BadInput: The provenance is damaged.
    """
    return typed(provenance.get(LICENCES, []), list[DataLicence], LICENCES, error=BadInput)
