"""Vector indexes over unit vectors, and the folder that keeps one on disk.

Importing this package needs only numpy; FAISS is imported when one of its kinds is used.

    load_kind("flat")    the class of a kind of index (see `KINDS`)
    indexes.store        `IndexStore`, the folder of generations
    indexes.choice       which kind meets a latency budget, by measurement
    indexes.measure      recall against the exact search
    indexes.errors       every error
"""

from importlib import import_module
from typing import TYPE_CHECKING

from indexes.errors import ParameterError

if TYPE_CHECKING:
    from indexes.base import VectorIndex

__all__ = ["KINDS", "load_kind"]

KINDS = {
    "exact": "indexes.exact:ExactIndex",
    "flat": "indexes.flat:FlatIndex",
    "hnsw": "indexes.hnsw:HNSWIndex",
    "ivf_flat": "indexes.ivf:IVFFlatIndex",
    "ivf_sq8": "indexes.ivf:IVFSQ8Index",
    "ivf_pq": "indexes.ivf:IVFPQIndex",
}
"""Name of a kind -> where its class stands. A new kind is one file and one line here."""


def load_kind(name: str) -> "type[VectorIndex]":
    """The class of the kind `name`; an unknown name raises `ParameterError` listing the known ones."""
    if name not in KINDS:
        raise ParameterError(f"the kind of index must be one of {', '.join(KINDS)}; got {name!r}")
    module, _, attribute = KINDS[name].partition(":")
    kind: type[VectorIndex] = getattr(import_module(module), attribute)
    return kind
