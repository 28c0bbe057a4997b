"""Vector indexes over unit vectors, and the index folder that stores one on disk.

This package imports only numpy; FAISS is imported when one of its kinds is used.

    indexes.store.folder          `IndexStore`, the folder of generations
    indexes.kinds.vector_index    `VectorIndex`, the base class of every kind of index
    indexes.kinds.measure         recall compared with exact search
    indexes.errors                every error

>>> import indexes, numpy
>>> axes = numpy.eye(3, dtype=numpy.float32)
>>> scores, slots = indexes.load_kind("exact").build(axes).search(axes[:1], 2)
>>> int(slots[0, 0]), float(scores[0, 0])
(0, 1.0)
"""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from _touch_retrieval.registry import Registry
from indexes.errors import ParameterError

if TYPE_CHECKING:
    from indexes.errors import IndexesError as IndexesError
    from indexes.kinds.measure import recall_against_exact as recall_against_exact
    from indexes.kinds.vector_index import VectorIndex as VectorIndex
    from indexes.store.folder import IndexStore as IndexStore
    from indexes.store.generation import Generation as Generation

KINDS: "Registry[type[VectorIndex]]" = Registry(
    "kind of index",
    "indexes",
    {
        "exact": "indexes.kinds.exact:ExactIndex",
        "flat": "indexes.kinds.flat:FlatIndex",
        "ivf_flat": "indexes.kinds.ivf:IVFFlatIndex",
        "ivf_sq8": "indexes.kinds.ivf:IVFSQ8Index",
        "ivf_pq": "indexes.kinds.ivf:IVFPQIndex",
        "hnsw": "indexes.kinds.hnsw:HNSWIndex",
    },
    error=ParameterError,
    base="indexes.kinds.vector_index:VectorIndex",
)
"""Names of the kinds of index, the fastest to build first. The class of a kind describes it (`indexes.VectorIndex`)."""


def load_kind(name: str) -> "type[VectorIndex]":
    """Return the class of the kind `name`. Raises `ParameterError` for an unknown name, and lists the known names.

    >>> indexes.load_kind("flat").exact, indexes.load_kind("hnsw").exact
    (True, False)
    >>> indexes.load_kind("octree")
    Traceback (most recent call last):
    indexes.errors.ParameterError: kind of index must be one of exact, flat, ivf_flat, ...; got 'octree'. Give ...
    """
    kind = KINDS.load(name)
    if kind.kind != name:
        raise ParameterError(
            f"the index {kind.__module__}:{kind.__qualname__} must have kind = {name!r}, got {kind.kind!r}"
        )
    return kind


def open(folder: str | Path, *, verify: bool = True) -> "Generation":
    """Open the current generation of an index folder for searching.

    Args:
        folder: The index folder, as `retrieve build-index` writes it.
        verify: Compare the SHA-256 of every file with the manifest.

    Raises:
        IndexesError: The index is missing or damaged, or has another format.

    >>> generation = indexes.open("index")
    >>> generation.count, generation.manifest.kind
    (4, 'flat')
    """
    from indexes.store.folder import IndexStore

    return IndexStore(Path(folder)).open(verify=verify)


_MODULES = {
    "Generation": "store.generation",
    "IndexStore": "store.folder",
    "IndexesError": "errors",
    "VectorIndex": "kinds.vector_index",
    "recall_against_exact": "kinds.measure",
}
"""Public name -> its module in this package, imported on first use."""

__all__ = ["KINDS", "load_kind", "open", *_MODULES]

if not TYPE_CHECKING:  # with it, a type checker would accept every attribute

    def __getattr__(name: str) -> Any:
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES})
