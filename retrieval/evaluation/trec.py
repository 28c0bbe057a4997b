"""Rankings of an evaluation in the formats of trec_eval, for other tools of information retrieval.

    trec/qrels.txt       "touch 0 photo relevant": a line for each photo in the gallery of each query
    trec/<method>.run    "touch Q0 photo rank score method": the same photos, best first

Touches and photos are named by the ids of their grasps. As in the metrics, the gallery of a touch excludes the photos
of its own grasp, and a touch without another photo of its object is no query.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from _touch_retrieval.files import write_atomically
from retrieval.metrics.table import ScoreTable

TREC_FOLDER = "trec"


def write_trec(
    folder: Path, method: str, table: ScoreTable, touch_ids: Sequence[str], photo_ids: Sequence[str]
) -> None:
    """Write the ranking of each query by one method, and the relevant photos, which are the same for all methods.

    Args:
        folder: Folder of the files.
        method: Name of the method.
        table: Scores (T, N) of touches with photos.
        touch_ids: (T,) ids of the touches, without spaces.
        photo_ids: (N,) ids of the photos, without spaces.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / "qrels.txt", "".join(_qrels(table, touch_ids, photo_ids)).encode())
    write_atomically(folder / f"{method}.run", "".join(_run(method, table, touch_ids, photo_ids)).encode())


def _qrels(table: ScoreTable, touch_ids: Sequence[str], photo_ids: Sequence[str]) -> Iterator[str]:
    for row in np.flatnonzero(table.has_target).tolist():
        for column in np.flatnonzero(~table.own[row]).tolist():
            yield f"{touch_ids[row]} 0 {photo_ids[column]} {int(table.relevant[row, column])}\n"


def _run(method: str, table: ScoreTable, touch_ids: Sequence[str], photo_ids: Sequence[str]) -> Iterator[str]:
    for row in np.flatnonzero(table.has_target).tolist():
        columns = np.flatnonzero(~table.own[row]).tolist()
        best = sorted(columns, key=lambda column: (-table.scores[row, column], photo_ids[column]))
        for rank, column in enumerate(best, start=1):
            # Nine digits keep single precision: equal scores stay equal, and different ones different.
            yield f"{touch_ids[row]} Q0 {photo_ids[column]} {rank} {table.scores[row, column]:.9g} {method}\n"
