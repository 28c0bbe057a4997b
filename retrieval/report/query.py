"""The self-contained HTML page of a query's result."""

from pathlib import Path
from string import ascii_lowercase

from retrieval.errors import ImageError
from retrieval.model.gel_check import CONTACT
from retrieval.report.document import Block, Card, Cards, Document, Section, Table, Text, capitalized, to_html
from retrieval.report.numbers import format_number, probability
from retrieval.report.pages import data_uri, thumbnail
from retrieval.search.answer import MATCH, UNCALIBRATED, Match, QueryResult, verdict_sentence

_THUMBNAIL_PX = 320
CALIBRATED = (
    "The probabilities of all objects of the catalogue and of “none of these” add up to 1. They are calibrated on "
    "validation objects, and account for the correlation of several grasps of one object. “If present”: the "
    "probability given that the catalogue contains the object."
)


def query_page(result: QueryResult, catalogue: Path) -> str:
    """Return one HTML page with the gel images, the photos and the probabilities of a query.

    Args:
        result: The result.
        catalogue: Folder of the photos; a photo that is missing or has changed since the build is left blank.

    Returns:
        The page; it embeds its pictures.
    """
    index, answers = result.index, result.verdict in (MATCH, UNCALIBRATED)
    blocks: list[Block] = [
        Text(f"Grasps: {len(result.touches)}. Catalogue: {index['photos']} photos, {index['objects']} objects."),
        Text(capitalized(verdict_sentence(result)).rstrip(".") + ".", warn=not answers),
    ]
    touches = zip(result.grasps, result.touches, strict=True)
    grasps = tuple(_touch(number, check, paths) for number, (check, paths) in enumerate(touches, start=1))
    blocks.append(Section("Touch", (Cards(grasps),)))
    if result.results:
        folders = catalogue, Path(index["path"])
        cards = tuple(_match(match, *folders, answers and match.rank == 1) for match in result.results)
        blocks.append(Section("Photos, most likely first", (Cards(cards),)))
    facts = Table(("property", "value"), tuple(_facts(result)), words=frozenset({1}))
    blocks.append(Section("How this was found", (facts, *((Text(CALIBRATED),) if result.posterior else ()))))
    return to_html(Document("Which object is in the hand?", tuple(blocks)), catalogue)


def _touch(number: int, check: str, paths: list[str]) -> Card:
    fingers = tuple(f"finger {finger}: {Path(path).name}" for finger, path in zip(ascii_lowercase, paths, strict=False))
    title = f"grasp {number}" if check == CONTACT else f"grasp {number}: {check}, not scored"
    return Card(tuple((_uri(Path(path)), "gel image") for path in paths), title, fingers)


def _match(match: Match, catalogue: Path, index: Path, is_answer: bool) -> Card:
    pictures, lines = [(_uri(match.photo_path, match.photo_digest), f"photo of {match.object_id}")], []
    if match.probability is not None and match.probability_if_present is not None:
        lines += [probability(match.probability), f"{probability(match.probability_if_present)} if present"]
    lines += [f"match logit {match.logit:+.2f}", match.photo]
    if nearest := match.reference:
        pictures += [
            (_uri((index if nearest.is_enrolled else catalogue) / path, digest), "reference touch")
            for path, digest in zip(nearest.touch, nearest.digests, strict=True)
        ]
        added = "no photo: scored by its touches only"
        if nearest.adds is not None:
            added = f"references add {nearest.adds:+.2f} to the logit"
        lines.append(f"nearest reference touch: {nearest.touch[0]}, cosine {nearest.cosine:.2f}; {added}")
    lines += [f"{key}: {value}" for key, value in match.metadata.items()]
    return Card(tuple(pictures), f"{match.rank}. {match.object_id}", tuple(lines), is_answer)


def _facts(result: QueryResult) -> list[tuple[str, str]]:
    index, found = result.index, result.posterior
    times = ", ".join(f"{stage} {format_number(ms)} ms" for stage, ms in result.timing_ms.items())
    rows = [
        ("index", f"{index['path']}, {index['generation']}, kind {index['kind']}"),
        ("model", f"{index['model']}, trained on: {index['trained_on']}"),
        ("scored", f"{index['scored']} of {index['photos']} photos by the fusion head"),
        ("time", times),
    ]
    if not found:
        return [*rows, ("probability", "this model is not calibrated: its logits rank the objects")]
    names = ("slope", "offset", "dependence", "grasps", "none_prior", "objects")
    parameters = ", ".join(f"{name} {format_number(found[name])}" for name in names)
    rows.append(("probability", f"{found['formula']}; {parameters}"))
    if known := found.get("references"):
        by = known["calibration"]
        rows.append(
            (
                "reference touches",
                f"{known['touches']} of {known['objects']} objects; calibrated on {by['touches']} touches of "
                f"{by['objects']} objects, and valid for touches like those",
            )
        )
    unscored = found["objects"] - found["scored_objects"]
    total = probability(found["unscored_probability"])
    return [*rows, ("not scored", f"{unscored} of {found['objects']} objects, with a total probability of {total}")]


def _uri(path: Path, digest: str | None = None) -> str:
    """Return a thumbnail of the picture as a data URI; empty if it cannot be read, or has another SHA-256."""
    try:
        return data_uri(thumbnail(path, _THUMBNAIL_PX, digest), "jpeg")
    except ImageError:
        return ""
