"""Vector indexes over unit vectors, and the index folder that stores one on disk.

This package imports only numpy; FAISS is imported when it is used.

    indexes.store.folder          `IndexStore`, the folder of generations
    indexes.kinds.vector_index    `VectorIndex`, the base class of every kind of index
    indexes.kinds.faiss_index     exact search and the kinds of FAISS
    indexes.kinds.measure         recall compared with exact search
    indexes.errors                every error

>>> import indexes, numpy
>>> axes = numpy.eye(3, dtype=numpy.float32)
>>> scores, rows = indexes.build(axes).search(axes[:1], 2)
>>> int(rows[0, 0]), float(scores[0, 0])
(0, 1.0)
"""

from pathlib import Path
from typing import TYPE_CHECKING

from _touch_retrieval.lazy import lazy_names
from _touch_retrieval.registry import Registry
from indexes.errors import ParameterError

if TYPE_CHECKING:
    from indexes.errors import IndexesError as IndexesError
    from indexes.kinds.measure import recall_against_exact as recall_against_exact
    from indexes.kinds.vector_index import Floats
    from indexes.kinds.vector_index import VectorIndex as VectorIndex
    from indexes.store.folder import IndexStore as IndexStore
    from indexes.store.generation import Generation as Generation
    from indexes.store.rows import Row as Row

KINDS: "Registry[type[VectorIndex]]" = Registry(
    "kind of index",
    "indexes",
    {"flat": "indexes.kinds.faiss_index:FaissIndex"},
    error=ParameterError,
    base="indexes.kinds.vector_index:VectorIndex",
)
"""Kinds of index by name: exact search ("flat"), and the classes of other packages. Other names are those of FAISS."""


def kind_name(kind: "str | type[VectorIndex]") -> str:
    """Return the name of a kind: "flat", a factory string of FAISS, `module:Class`, or a class of your own.

    Raises:
        ParameterError: The class is unusable.

    >>> indexes.kind_name("HNSW32;efSearch=64")
    'HNSW32;efSearch=64'
    """
    return KINDS.name_of(kind) if not isinstance(kind, str) or ":" in kind or kind in KINDS.names() else kind


def load_kind(name: str) -> "type[VectorIndex]":
    """Return the class of the kind `name`. Raises `ParameterError` if the class is unusable.

    >>> indexes.load_kind("flat") is indexes.load_kind("IVF1024,SQ8;nprobe=32")
    True
    """
    return KINDS.load(name if ":" in name or name in KINDS.names() else "flat")


def build(vectors: "Floats", kind: "str | type[VectorIndex]" = "flat") -> "VectorIndex":
    """Build an index of vectors in memory.

    Args:
        vectors: Unit vectors (N, d) float32, N >= 1.
        kind: "flat", a factory string of FAISS with search settings after a semicolon, or your own class.

    Raises:
        VectorError: A vector is invalid, or there is none.
        ParameterError: The kind is unknown or needs more vectors.

    >>> import numpy
    >>> indexes.build(numpy.eye(3, dtype=numpy.float32), "octree")
    Traceback (most recent call last):
    indexes.errors.ParameterError: the kind of index must be flat, a factory string of FAISS ... 'octree' ...
    """
    name = kind_name(kind)
    return load_kind(name).build(vectors, name)


def open(folder: str | Path) -> "Generation":
    """Open the current generation of an index folder for searching.

    Args:
        folder: The index folder, as `retrieve build-index` writes it.

    Raises:
        IndexesError: The index is missing or damaged, or has another format.

    >>> generation = indexes.open("index")
    >>> generation.count, generation.manifest.kind
    (4, 'flat')
    """
    from indexes.store.folder import IndexStore

    return IndexStore(Path(folder)).open()


_MODULES = {
    "Generation": "store.generation",
    "IndexStore": "store.folder",
    "IndexesError": "errors",
    "Row": "store.rows",
    "VectorIndex": "kinds.vector_index",
    "recall_against_exact": "kinds.measure",
}
"""Public name -> its module in this package, imported on first use."""

__all__ = ["KINDS", "build", "kind_name", "load_kind", "open", *_MODULES]

if not TYPE_CHECKING:  # with __getattr__, a type checker accepts every attribute name
    __getattr__, __dir__ = lazy_names(__name__, _MODULES)
