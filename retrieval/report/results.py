"""One protocol of results.json as the report shows it: its measures, and labels of rows and measures."""

import re
from dataclasses import dataclass

from retrieval.evaluation.results import Details, ProtocolResult, Results
from retrieval.methods import CHANCE
from retrieval.metrics.intervals import Summary
from retrieval.metrics.registry import METRICS, grasps_metric_name

METHOD_LABELS = {
    "late_fusion": "late fusion",
    "retrieve_rerank": "retrieve + rerank",
    "contrastive": "contrastive, InfoNCE",
    "cca_towers": "CCA, tower by tower",
    "cca": "CCA",
    "chance": "random scores",
}
NOT_FITTED = ", not fitted"
"""End of the label of a checkpoint that scores as it is."""
HEADLINES = ("pair_accuracy", "topn_k5", "topn_k10", grasps_metric_name(5), "map")
"""Measures of the overview of a protocol with many measures."""


@dataclass(frozen=True)
class ProtocolView:
    """Results of one protocol, with labels.

    Attributes:
        name: Name of the protocol.
        result: Its results.
        is_only: Whether the report has no other protocol.
    """

    name: str
    result: ProtocolResult
    is_only: bool

    @property
    def learned(self) -> list[str]:
        """The rows without random scores."""
        return [name for name in self.result.rows if name != CHANCE]

    @property
    def main_row(self) -> str:
        """The row that is shown in detail."""
        return next(iter(self.learned or self.result.rows))

    @property
    def details(self) -> dict[str, Details]:
        """Single objects and decisions, of the rows that have them; such a protocol also has many measures."""
        return {name: row.details for name, row in self.result.rows.items() if row.details}

    @property
    def headlines(self) -> list[str]:
        """The measures of the overview, the deciding one among them."""
        names = HEADLINES if self.details else [key for key, _ in self.result.labels]
        return [key for key in names if self.summaries(key)]

    def label(self, row: str) -> str:
        """Return the label of a row: that of its method, or the name of a checkpoint that scores as it is."""
        found = self.result.rows.get(row)
        if found and found.method != row and found.model is not None:
            return f"{row}{NOT_FITTED}"
        return METHOD_LABELS.get(row, row.rpartition(":")[2].replace("_", " "))

    @property
    def note(self) -> str | None:
        """A sentence on the rows of checkpoints that score as they are; None without such a row."""
        labels = [label for row in self.result.rows if (label := self.label(row)).endswith(NOT_FITTED)]
        if not labels:
            return None
        return (
            f"{' and '.join(labels)}: the checkpoint as it is, trained on none of the test objects. The other "
            "methods are fitted on the training objects of the recording."
        )

    def measure_label(self, key: str) -> str:
        """Return the label of a measure."""
        return dict(self.result.labels).get(key) or (METRICS[key].label if key in METRICS else key.replace("_", " "))

    def summary(self, row: str, key: str) -> Summary | None:
        """Return a measure of a row; None if the row lacks it."""
        return self.result.rows[row].measures.get(key)

    def summaries(self, key: str) -> dict[str, Summary]:
        """Return a measure of all rows that have it."""
        return {row: found for row in self.result.rows if (found := self.summary(row, key))}

    def figure_name(self, name: str) -> str:
        """Return a name of a figure's file that no other protocol of the report has."""
        return re.sub(r"[^A-Za-z0-9_-]+", "-", name if self.is_only else f"{self.name}-{name}")


def views(results: Results) -> list[ProtocolView]:
    """Return a view of each protocol, in the order of the file."""
    is_only = len(results.protocols) == 1
    return [ProtocolView(name, result, is_only) for name, result in results.protocols.items()]
