"""Licences of the data that train a model, and the check of `retrieve train --require-licence`."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from _touch_retrieval.documents import typed
from retrieval.errors import BadInput

NOT_STATED = "not stated"
LICENCES = "licences"
"""Key of a checkpoint's provenance: the fields of each DataLicence."""
OPEN = "open"
"""Value of `--require-licence` for all licences of `_OPEN_NAMES`."""

_OPEN_NAMES = re.compile(
    r"(cc0|cc by|cc by sa)( \d(\.\d)?)?|public domain|mit|bsd [23] clause|apache( license)? 2\.0|[al]?gpl v?[23](\.0)?"
    r"( only| or later)?|(odc by|odbl|pddl)( 1\.0)?"
)
"""Licences that allow any use, commercial use included. Some of them have conditions, such as to name the authors."""


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


def require_licences(found: Iterable[DataLicence], accepted: Sequence[str]) -> None:
    """Check that the licence of each source is accepted.

    Args:
        found: The licences of all training data.
        accepted: Names of accepted licences; `OPEN` accepts every licence that allows any use.

    Raises:
        BadInput: A licence is not accepted.
    """
    names = {_normalised(name) for name in accepted}
    for each in found:
        name = _normalised(each.licence)
        if name not in names and not (OPEN in names and _OPEN_NAMES.fullmatch(name)):
            raise BadInput(
                f"--require-licence accepts {', '.join(accepted)}, but the licence of {each.source} is {each}. Use "
                'other data, add the name to --require-licence, or correct "licence" in its recording.json'
            )


def _normalised(name: str) -> str:
    """Return a licence's name in small letters with single spaces: "CC-BY-4.0" and "CC BY 4.0" are one licence."""
    return " ".join(re.split(r"[\s_-]+", name.strip().lower()))
