"""Registry of the metrics of an evaluation: name in results.json, labels in the report, and function.

A new metric is one function from a `ScoreTable` to a `Measure` (`retrieval.metrics.protocols`) and one row here.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

from retrieval.metrics import protocols
from retrieval.metrics.measure import Measure
from retrieval.metrics.table import ScoreTable

SET_SIZES = (1, 2, 3, 5, 8, 12, 20)
"""Numbers of grasps in a query."""
PHOTOS_PER_CANDIDATE = 3
"""Photos of a candidate in the metrics of several grasps."""


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


def _gallery_metric(column: str, value: Callable[[ScoreTable], Measure]) -> Metric:
    """Return a measure of the ranking of the whole gallery."""
    return Metric(f"{column}, touch to photo", "gallery", lambda tables: value(tables.test), column)


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
    **{f"recall_{k}": _gallery_metric(f"R@{k}", partial(protocols.recall, k=k)) for k in (1, 5, 10)},
    "map": _gallery_metric("mAP", protocols.average_precision),
}
"""Name in results.json -> metric, in the order of every table."""


def compute(scored: MethodScoreTables, names: Iterable[str] = METRICS) -> dict[str, Measure]:
    """Return the metrics of these names that a method's scores allow."""
    found = {name: METRICS[name].compute(scored) for name in names}
    return {name: measure for name, measure in found.items() if measure is not None}
