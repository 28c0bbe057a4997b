"""Registry of the metrics of an evaluation: name in results.json, labels in the report, and function.

A new metric is one function from a `ScoreTable` to a `Measure` (`retrieval.metrics.protocols`) and one row here.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property, partial

from retrieval.metrics import protocols
from retrieval.metrics.measure import Measure
from retrieval.metrics.table import ScoreTable

SET_SIZES = (1, 2, 3, 5, 8, 12, 20)
"""Numbers of grasps in a query."""
PHOTOS_PER_CANDIDATE = 3
"""Photos of a candidate in the metrics of several grasps."""
PHOTO_COUNTS = (1, 2, 3, 5, 10, 20)
"""Photos of a candidate in the metrics of one grasp."""


@dataclass(frozen=True, eq=False)
class MethodScoreTables:
    """Scores of one method and seed as tables: the input of the metrics.

    Attributes:
        test: Touches with photos of test objects.
        all_objects: The same touches with the photos of all objects.
        sets: By number of grasps, sets of test touches with photos of test objects.
        threshold: Score above which a touch and a photo are classified as a match; None without a threshold.
        seed: Seed of random draws.
    """

    test: ScoreTable
    all_objects: ScoreTable
    sets: dict[int, ScoreTable]
    threshold: float | None
    seed: int

    @cached_property
    def photos(self) -> ScoreTable:
        """Photos of test objects as queries, touches as gallery."""
        return self.test.transposed()


@dataclass(frozen=True)
class Metric:
    """A metric, as results and reports use it.

    Attributes:
        label: Name in the report.
        section: Name of its table.
        compute: Returns its values; None if these scores do not allow it.
        short_label: Heading in its table, if shorter than the label.
    """

    label: str
    section: str
    compute: Callable[[MethodScoreTables], Measure | None]
    short_label: str = ""

    @property
    def column(self) -> str:
        """Heading in its table."""
        return self.short_label or self.label


def grasps_metric_name(count: int) -> str:
    """Return the name of the metric of a query of `count` grasps, with three photos of each candidate."""
    return f"topn_k5_g{count}_p{PHOTOS_PER_CANDIDATE}"


def photos_metric_name(count: int) -> str:
    """Return the name of the metric of a query of one grasp, with `count` photos of each candidate."""
    return "topn_k5" if count == 1 else f"topn_k5_p{count}"


def k_way_measure(table: ScoreTable | None, k: int, seed: int, photos: int = 1) -> Measure | None:
    """Return `protocols.k_way`, or None if there are fewer objects than candidates."""
    return protocols.k_way(table, k, photos=photos, seed=seed) if table and len(table.objects) >= k else None


def _top1_of(k: int, table: Callable[[MethodScoreTables], ScoreTable], words: str = "") -> Metric:
    return Metric(f"{k}-way top-1 accuracy{words}", "main", lambda tables: k_way_measure(table(tables), k, tables.seed))


def _grasps_metric(count: int) -> Metric:
    words = f"{count} grasp{'s' * (count > 1)}"
    return Metric(
        f"5-way top-1 accuracy, {words}, {PHOTOS_PER_CANDIDATE} photos",
        "grasps",
        lambda tables: k_way_measure(tables.sets.get(count), 5, tables.seed, PHOTOS_PER_CANDIDATE),
        words,
    )


def _photos_metric(count: int) -> Metric:
    words = f"{count} photos"
    return Metric(
        f"5-way top-1 accuracy, {words}",
        "photos",
        # A candidate with fewer photos has a mean of fewer scores, which varies more.
        lambda tables: k_way_measure(tables.test, 5, tables.seed, count) if tables.test.min_photos >= count else None,
        words,
    )


TOUCH_TO_PHOTO, PHOTO_TO_TOUCH = "touch to photo", "photo to touch"


def _gallery_metrics(prefix: str, section: str, table: Callable[[MethodScoreTables], ScoreTable]) -> dict[str, Metric]:
    """Return the measures of the whole gallery in one direction."""

    def metric(column: str, compute: Callable[[ScoreTable], Measure]) -> Metric:
        return Metric(f"{column}, {section}", section, lambda tables: compute(table(tables)), column)

    return {
        **{f"{prefix}recall_{k}": metric(f"R@{k}", partial(protocols.recall, k=k)) for k in (1, 5, 10)},
        f"{prefix}mrr": metric("MRR", protocols.reciprocal_rank),
        f"{prefix}map": metric("mAP", protocols.average_precision),
    }


METRICS: dict[str, Metric] = {
    "pair_accuracy": Metric(
        "pair accuracy",
        "main",
        lambda tables: None if tables.threshold is None else protocols.pair_accuracy(tables.test, tables.threshold),
    ),
    "pair_auc": Metric("pair AUC", "main", lambda tables: protocols.pair_auc(tables.test)),
    **{f"topn_k{k}": _top1_of(k, lambda tables: tables.test) for k in (5, 10, 100)},
    "topn_k5_all_objects": _top1_of(5, lambda tables: tables.all_objects, ", all objects"),
    **{grasps_metric_name(count): _grasps_metric(count) for count in SET_SIZES},
    **{photos_metric_name(count): _photos_metric(count) for count in PHOTO_COUNTS if count > 1},
    **_gallery_metrics("", TOUCH_TO_PHOTO, lambda tables: tables.test),
    **_gallery_metrics("photo_to_touch_", PHOTO_TO_TOUCH, lambda tables: tables.photos),
    "objectfolder_touch_to_photo": Metric(
        "mAP, touch to photo", "objectfolder", lambda tables: protocols.average_precision(tables.test.with_own())
    ),
    "objectfolder_photo_to_touch": Metric(
        "mAP, photo to touch", "objectfolder", lambda tables: protocols.average_precision(tables.photos.with_own())
    ),
}
"""Name in results.json -> metric, in the order of every table."""


def compute(scored: MethodScoreTables, names: Iterable[str] = METRICS) -> dict[str, Measure]:
    """Return the metrics of these names that a method's scores allow."""
    found = {name: METRICS[name].compute(scored) for name in names}
    return {name: measure for name, measure in found.items() if measure is not None}
