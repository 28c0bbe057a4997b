"""The self-contained HTML page of a query's result."""

from pathlib import Path
from string import ascii_lowercase

from retrieval.report.pages import data_uri, jpeg, render, thumbnail
from retrieval.search.answer import QueryResult

_THUMBNAIL_PX = 320


def query_html(result: QueryResult, catalogue: Path) -> str:
    """Return one HTML page with the gel images, the photos and the probabilities of a query.

    Args:
        result: The result.
        catalogue: Folder of the photos; a missing photo is left blank.

    Returns:
        The page; it embeds its images.
    """
    touches = [
        [
            {"uri": _data_uri(Path(path)), "name": Path(path).name, "finger": finger}
            for finger, path in zip(ascii_lowercase, paths, strict=False)
        ]
        for paths in result.touches
    ]
    matches = [
        {
            **match.to_dict(),
            "uri": _data_uri(catalogue / match.photo),
            "reference_images": [
                {"uri": _data_uri(catalogue / path)} for path in (match.reference.touch if match.reference else ())
            ],
        }
        for match in result.results
    ]
    return render("query.html", result=result, touches=touches, matches=matches)


def _data_uri(path: Path) -> str:
    """Return a thumbnail of the image as a data URI; empty if the image cannot be read."""
    image = thumbnail(path, _THUMBNAIL_PX)
    return "" if image is None else data_uri(jpeg(image), "jpeg")
