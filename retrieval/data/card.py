"""Cards of the Hugging Face Hub: Markdown with a header that the Hub and `huggingface_hub` read."""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import PurePosixPath
from typing import Any

from retrieval.data.dataset import NOT_STATED, DataLicence

LIBRARY = "touch-retrieval"
TAGS = ("tactile", "gelsight", "robotics", "retrieval")
_HUB_LICENCES = {
    *("mit", "apache-2.0", "bsd-2-clause", "bsd-3-clause", "gpl-3.0", "cc0-1.0", "odbl", "pddl"),
    *(f"cc-{terms}-4.0" for terms in ("by", "by-sa", "by-nc", "by-nd", "by-nc-sa", "by-nc-nd")),
}
"""Names of licences for the Hub; any other one is "other" with a name."""


def card_header(licence: str | None, **entries: Any) -> list[str]:
    """Return the lines of a card's header; each value is JSON, which is YAML, too.

    Args:
        licence: Name of the licence, such as "CC BY 4.0"; None if it is not stated.
        entries: Further entries by key; "_" stands for "-".
    """
    known = re.sub(r"[\s_]+", "-", (licence or "").strip().lower())
    stated: dict[str, Any] = {"license": known} if known in _HUB_LICENCES else {}
    if licence and not stated:
        stated = {"license": "other", "license_name": licence}
    fields = stated | {"tags": TAGS} | {key.replace("model_index", "model-index"): entries[key] for key in entries}
    return ["---", *(f"{key}: {json.dumps(value, ensure_ascii=False)}" for key, value in fields.items()), "---", ""]


def common_licence(licences: Iterable[DataLicence]) -> str | None:
    """Return the licence that all sources of data state; None if they state several, or one states none."""
    names = {licence.licence for licence in licences}
    return names.pop() if len(names) == 1 and NOT_STATED not in names else None


def plain_name(source: str) -> str:
    """Return the source of a recording as the name of a data set: "Simulated rigs" as "simulated-rigs"."""
    return re.sub(r"[^a-z0-9]+", "-", source.lower()).strip("-") or "unnamed"


def recording_card(repository: str, info: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], files: set[str]) -> str:
    """Return the card of a recording as a data set of images (imagefolder).

    Args:
        repository: Its name on the Hub, USER/NAME.
        info: Content of recording.json, with the licence.
        rows: Content of metadata.jsonl.
        files: Paths of the images.
    """
    # Without the configuration, names such as "test-tube.png" would make a split.
    paths = ["metadata.jsonl", *sorted({f"**/*{PurePosixPath(file).suffix}" for file in files})]
    split = {"split": "train", "path": paths}
    configuration = {"config_name": "default", "drop_labels": True, "data_files": [split]}
    lines = [
        *card_header(info["licence"], pretty_name=info["source"], configs=[configuration]),
        f"# {repository}",
        "",
        f"{len(rows)} grasps of {len({row['object_id'] for row in rows})} objects, recorded for touch-retrieval. A row "
        f'is a grasp. `datasets.load_dataset("{repository}", split="train")` opens it.',
        "",
        *(f"* {key}: {info[key]}" for key in ("source", "sensor", "licence", "terms", "citation") if info.get(key)),
    ]
    return "\n".join(lines) + "\n"
