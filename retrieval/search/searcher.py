"""Query an opened index: encode the touch, find candidates, rerank them by match logit, and give a verdict."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from itertools import chain, compress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from _touch_retrieval.names import lookup_key
from indexes.store.generation import Generation
from indexes.store.sharded import ShardedManifest
from retrieval.data.opening import Openings, parse_openings
from retrieval.data.text import is_utf8
from retrieval.errors import BadInput, IncompleteSearch
from retrieval.indexing.enrolled import EnrolledTable, EnrolledTouch, content_digest, model_key, picture_path, to_code
from retrieval.model.checkpoint_info import CheckpointInfo, fingerprint, read_scorer
from retrieval.model.gel_check import CONTACT, NO_CONTACT, NOT_A_GEL
from retrieval.model.onnx_encoder import find_export
from retrieval.model.posterior import NONE_PRIOR, Posterior, require_prior
from retrieval.model.references import REFERENCE_ROWS
from retrieval.model.touch_reader import (
    EncodedQuery,
    EncodedTouches,
    Stopwatch,
    TouchEncoder,
    TouchEncodings,
    TouchReader,
    require_distinct,
)
from retrieval.model.touches import AnyImage, AnyTouches, InputImage, parse_grasps, with_file
from retrieval.model.verification import MAX_GRASPS, DecisionBounds
from retrieval.search.answer import (
    MATCH,
    NONE_OF_THESE,
    UNCALIBRATED,
    Enrolment,
    Match,
    QueryResult,
    Verification,
)
from retrieval.search.objects import ListedPhoto, Objects
from retrieval.search.opening import OpenShards, manifest_of, open_index
from retrieval.search.shard import FolderShard, ShardResult, Shards, resolve_object


class Searcher:
    """An opened index with its model.

    Threads may query it at the same time; open the index in each process. Close it with `close` or a `with` block.

    >>> searcher = retrieval.open("index")
    >>> one = searcher.query(["a.png", "b.png"], top=2)
    >>> [match.rank for match in one.results]
    [1, 2]
    >>> mug, tin = [["a.png", "b.png"], ["a2.png", "b2.png"]], ["a2.png", "b2.png"]
    >>> len(searcher.query_many([mug, tin]))
    2
    >>> searcher.close()
    """

    def __init__(
        self, index: Path, shard: FolderShard | Shards, checkpoint: CheckpointInfo, encoder: TouchEncoder
    ) -> None:
        self.index, self.shard, self.checkpoint, self.encoder = index, shard, checkpoint, encoder
        self.manifest, self.posterior = shard.manifest, checkpoint.posterior
        self.scorer = shard.scorer if isinstance(shard, FolderShard) else read_scorer(checkpoint)
        check = checkpoint.gel_check
        self.reader = TouchReader(checkpoint.config, encoder, check is not None and check.level_above is not None)
        self.catalogue = Path(self.manifest.about["catalogue"])
        self._process, self._is_closed = os.getpid(), False

    @classmethod
    def open(
        cls,
        index: str | Path,
        *,
        model: str | Path | None = None,
        threads: int | None = None,
        shards: OpenShards | None = None,
    ) -> Searcher:
        """Open the current generation of an index or a sharded index, with the checkpoint that built it.

        If an export of the checkpoint (`retrieval.model.export`) is in its folder or in the user's cache, the export
        encodes touches, without PyTorch.

        Args:
            index: Its folder.
            model: Path of the checkpoint, if it was moved.
            threads: Number of threads of the encoder (with PyTorch: of the process). Default: the library's choice.
            shards: Function that opens the shards of a sharded index. Default: open them in this process.

        Raises:
            IndexesError: The index is missing, damaged, or of another model.
            CheckpointError: The checkpoint is missing or damaged.

        >>> import numpy as np
        >>> from PIL import Image
        >>> pictures = [np.asarray(Image.open(name)) for name in ("a.png", "b.png")]  # red first
        >>> with retrieval.open("index") as searcher:
        ...     from_arrays, from_files = searcher.query(pictures), searcher.query(["a.png", "b.png"])
        >>> from_arrays.results == from_files.results
        True
        """
        shard, stored = open_index(Path(index), model, shards)
        return cls(Path(index), shard, stored, find_export(stored, threads) or _torch_encoder(stored, threads))

    def close(self) -> None:
        """Refuse further queries; running ones continue. Index and model are freed with the searcher."""
        self._is_closed = True

    @property
    def generation(self) -> Generation:
        """The opened generation of an index folder. Raises BadInput for a sharded index."""
        return self.folder_shard.generation

    @property
    def objects(self) -> Objects:
        """The objects of the opened generation of an index folder. Raises BadInput for a sharded index."""
        return self.folder_shard.objects

    @property
    def folder_shard(self) -> FolderShard:
        """The shard of an opened index folder. Raises BadInput for a sharded index."""
        if not isinstance(self.shard, FolderShard):
            raise BadInput(f"{self.index} is a sharded index, but one index folder is required; open one of its shards")
        return self.shard

    def __enter__(self) -> Searcher:
        self._require_open()
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def query(
        self,
        touches: AnyTouches,
        *,
        background: Sequence[AnyImage] | None = None,
        opening_mm: Openings = None,
        top: int = 10,
        candidates: int | None = None,
        none_prior: float = NONE_PRIOR,
    ) -> QueryResult:
        """Rank the objects of the catalogue by one or more grasps of the object in the hand.

        Grasps without contact, or with an image that is not a gel image, are left out. Match logits of the others add
        up; `retrieval.model.posterior` converts them to probabilities of the objects and of "none of these".

        Args:
            touches: One grasp, a list with an image for each finger in their order; or a list of such grasps. For a
                model with one finger a single image is a grasp too. An image is a path, the bytes of a file, a Pillow
                image, or an array (height, width, 3) of uint8, red first (OpenCV: `image[..., ::-1]`).
            background: The fingers' no-contact frames, for a model that uses them.
            opening_mm: Distance between the fingers in each grasp, in millimetres; None for a grasp without a
                measurement, and by default for all. A number is that of one grasp. It is compared with the openings of
                reference touches (`retrieval.model.opening`), and changes nothing where there is none.
            top: Number of objects to return.
            candidates: Number of photos that each shard reranks, at least `top`: those nearest to the sum of the
                grasps' embeddings. Default: as measured by `build-index`. All photos of the best objects, and of the
                objects with the nearest reference touches, are scored too. If a shard has no more photos than this
                number, or the model has no trained embeddings, all its photos are scored.
            none_prior: Prior probability that the catalogue lacks the object.

        Raises:
            BadInput: An argument is invalid, or a picture is given twice.
            ImageError: An image cannot be read.
            NumericalError: A logit is not finite.
        """
        return self.query_many(
            [touches],
            background=background,
            opening_mm=[opening_mm],
            top=top,
            candidates=candidates,
            none_prior=none_prior,
        )[0]

    def query_many(
        self,
        objects: Sequence[AnyTouches],
        *,
        background: Sequence[AnyImage] | None = None,
        opening_mm: Sequence[Openings] | None = None,
        top: int = 10,
        candidates: int | None = None,
        none_prior: float = NONE_PRIOR,
    ) -> list[QueryResult]:
        """Return one result for each of several objects in the hand; give touches and openings of each as for `query`.

        Touches are encoded in batches, so logits differ by at most 1e-4 from single queries. If the touches of one
        object are invalid, the error names the object and no query runs.
        """
        self._require_open()
        clock = Stopwatch()
        counts: list[object] = [top] if candidates is None else [top, candidates]
        if not all(isinstance(count, int | np.integer) and count >= 1 for count in counts):
            raise BadInput(f"top and candidates must be whole numbers of 1 or more; got {top} and {candidates}")
        require_prior(none_prior)
        prefixes = [f"object {number}, " if len(objects) > 1 else "" for number in range(1, len(objects) + 1)]
        parsed = [
            parse_grasps(touches, self.reader.fingers, of=of) for touches, of in zip(objects, prefixes, strict=True)
        ]
        given = [None] * len(objects) if opening_mm is None else opening_mm
        if len(given) != len(objects):
            raise BadInput(f"opening_mm needs an entry for each object: got {len(given)} for {len(objects)} objects")
        openings = [
            parse_openings(openings_mm, len(grasps), of)
            for openings_mm, grasps, of in zip(given, parsed, prefixes, strict=True)
        ]
        if not parsed:
            return []
        codes, shown = self._encoded([grasp for grasps in parsed for grasp in grasps], background, clock)
        found, start = list[tuple[list[str], ShardResult | None]](), 0
        for grasps, openings_mm in zip(parsed, openings, strict=True):
            span = slice(start, start := start + len(grasps))
            classes, result = shown[span], None
            if _fault(classes) is None:
                used = classes == CONTACT
                require_distinct(compress(grasps, used), compress(codes.pictures[span], used))
                measured_mm = np.array(openings_mm, np.float64)[used]  # None becomes NaN
                query = EncodedQuery(codes.embeddings[span][used], codes.partials[span][used], measured_mm)
                result = self.shard.search(query, top, candidates)
            clock.add({stage: result.timing_ms[stage] if result else 0.0 for stage in ("candidates", "rerank")})
            found.append((classes.tolist(), result))
        timing_ms = clock.finish(len(parsed))
        return [
            self._result(grasps, openings_mm, classes, timing_ms, result, none_prior)
            for grasps, openings_mm, (classes, result) in zip(parsed, openings, found, strict=True)
        ]

    def encode(self, touches: AnyTouches, *, background: Sequence[AnyImage] | None = None) -> EncodedTouches:
        """Return the unit embeddings (G, embedding_dim) and partial activations (G, touch_partial_width) of G grasps.

        The inner product of a grasp's embedding with a photo's (`retrieval.encode_photos`) orders candidates; it is not
        a probability. `searcher.scorer.logits(partials, photo_partials)` gives match logits, summed over the grasps.

        Args:
            touches: As for `query`.
            background: As for `query`.

        >>> checkpoint = retrieval.load_checkpoint("model.safetensors")
        >>> files = ["catalog/mug/1.jpg", "catalog/tin/1.jpg"]
        >>> photos = retrieval.encode_photos(checkpoint.matcher, map(checkpoint.config.preprocessing.load_photo, files))
        >>> with retrieval.open("index") as searcher:
        ...     embeddings, partials = searcher.encode(["a.png", "b.png"])
        ...     logits = searcher.scorer.logits(partials, photos.partial.numpy())
        >>> scores = embeddings @ photos.embedding.numpy().T  # a row for each grasp
        >>> scores.shape, logits.shape
        ((1, 2), (2,))
        """
        self._require_open()
        codes, _ = self._encoded(parse_grasps(touches, self.reader.fingers), background, Stopwatch())
        return EncodedTouches(codes.embeddings, codes.partials)

    def verify(
        self, touches: AnyTouches, expect: str, *, far: float = 0.01, background: Sequence[AnyImage] | None = None
    ) -> Verification:
        """Decide whether the object in the hand is the expected one, at a stated false-accept rate.

        Openings of the jaws are not used: the error rates were measured without them.

        Args:
            touches: As for `query`; at most the first four grasps with contact are used.
            expect: The expected object of the catalogue.
            far: False-accept rate: the fraction of other objects that is accepted.
            background: As for `query`.

        Raises:
            BadInput: The catalogue lacks the object, the rate is too small for the model's validation objects, or the
                model has no error rates.
        """
        self._require_open()
        name, bounds, posterior = self.expected_object(expect, far)
        grasps = parse_grasps(touches, self.reader.fingers)
        names = [[image.name for image in grasp] for grasp in grasps]
        codes, classes = self._encoded(grasps, background, Stopwatch())
        if (fault := _fault(classes)) is not None:
            return Verification(expect, fault, names, classes.tolist(), [], None)
        used = classes == CONTACT
        require_distinct(compress(grasps, used), compress(codes.pictures, used))
        logits = self.folder_shard.object_logits(name, codes.partials[used][:MAX_GRASPS])
        ratios = [float(posterior.log_ratio(logit, count)) for count, logit in enumerate(logits, 1)]
        return Verification(expect, bounds.decide(np.array(ratios)), names, classes.tolist(), ratios, bounds)

    def picture_file(self, photo: ListedPhoto) -> Path:
        """Return the absolute path of the file of a photo or gel image."""
        return (self.index if photo.is_enrolled else self.catalogue).absolute() / photo.path

    @property
    def can_verify(self) -> bool:
        """Whether the model has error rates for verification, which hold for an index with the model's cells."""
        return self.checkpoint.verification is not None and self.posterior is not None

    def expected_object(self, expect: str, far: float) -> tuple[str, DecisionBounds, Posterior]:
        """Return the expected object, the bounds of the decision and the posterior; raise as `verify`."""
        calibration, posterior = self.checkpoint.verification, self.posterior
        if calibration is None or posterior is None:
            raise BadInput(
                f"{self.checkpoint.path} has no error rates for verification with this index: fit a model with at "
                "least 20 objects of 5 grasps (`retrieve train`: validation objects), and build its index with its "
                "cells"
            )
        bounds = calibration.bounds(far)
        name = resolve_object(self.shard, expect)
        if self.objects.find(name) < 0:
            raise BadInput(f"the catalogue of {self.index} has no object {expect!r}; give the name of its folder")
        return name, bounds, posterior

    def enrol(
        self,
        object_id: str,
        touches: AnyTouches,
        *,
        opening_mm: Openings = None,
        background: Sequence[AnyImage] | None = None,
    ) -> Enrolment:
        """Remember touches of an object, which queries of this index find at once; every build keeps them.

        The pictures are copied to the folder of the index; the catalogue does not change. An object needs no photo.

        Args:
            object_id: The object: one of the index, exactly so or the only one with its `lookup_key`; or a new one.
            touches: As for `query`; each grasp becomes a reference touch.
            opening_mm: As for `query`.
            background: As for `query`; the frames are kept with the touches.

        Raises:
            BadInput: The model cannot compare touches, a grasp shows no contact or no gel, a picture is enrolled
                already, or the name or an opening is invalid.
            ImageError: An image cannot be read.
            IndexesError: The table of enrolled touches is damaged or cannot be written.

        >>> with retrieval.open("index") as searcher:
        ...     searcher.enrol("spoon", ["a.png", "b.png"], opening_mm=12.5)
        Enrolment(object_id='spoon', touches=1, added=1)
        >>> retrieval.remove_enrolled("index", "spoon")
        ('spoon', 1)
        """
        self._require_open()
        stored, name, fingers = self.checkpoint, self.enrolled_name(object_id), self.reader.fingers
        grasps = [list(map(with_file, grasp)) for grasp in parse_grasps(touches, fingers)]
        openings = parse_openings(opening_mm, len(grasps))
        frames = [] if background is None else parse_grasps(background, fingers, noun="background")[0]
        frames = list(map(with_file, frames))
        codes, classes = self._encoded(grasps, [frame.image for frame in frames] or None, Stopwatch())
        for grasp, shows in zip(grasps, classes, strict=True):
            if shows != CONTACT:
                raise BadInput(f"{_names(grasp)}: {shows}; enrol grasps in which the object is pressed into the gels")
        require_distinct(grasps, codes.pictures)

        def files(images: Sequence[InputImage]) -> dict[str, bytes]:
            return {picture_path(name, image.file): image.file for image in images}

        new = [
            EnrolledTouch(
                name,
                {path: content_digest(file) for path, file in files(grasp).items()},
                {model_key(fingerprint(stored)): to_code(partial, stored)},
                opening,
                tuple(files(frames)),
            )
            for grasp, partial, opening in zip(grasps, codes.partials, openings, strict=True)
        ]
        table = EnrolledTable(self.index)
        with table.lock() as known:
            owners = {digest: touch.object_id for touch in known for digest in touch.pictures.values()}
            for touch, grasp in zip(new, grasps, strict=True):
                if owner := next((owners[digest] for digest in touch.pictures.values() if digest in owners), None):
                    raise BadInput(
                        f"a picture of {_names(grasp)} is enrolled already, for {owner}; it counts once: give another "
                        f"grasp, or remove {owner} first"
                    )
            if manifest_of(self.index).fingerprint != self.manifest.fingerprint:
                raise IncompleteSearch(f"{self.index} was built with another model in the meantime; enrol again")
            table.replace([*known, *new], files([*chain.from_iterable(grasps), *frames]))
        return Enrolment(name, sum(touch.object_id == name for touch in (*known, *new)), len(new))

    @property
    def can_enrol(self) -> bool:
        """Whether the model can compare enrolled touches."""
        return self.checkpoint.references is not None and self.posterior is not None

    def enrolled_name(self, object_id: str) -> str:
        """Return the object of the index that a person names, or the name of a new one; raise as `enrol`."""
        if not self.can_enrol:
            raise BadInput(
                f"{self.checkpoint.path} has no calibration of reference touches, so this index cannot compare "
                "touches. Use a shipped model, or one of `retrieve train`, and build the index with it"
            )
        like, new = self.shard.names_like(object_id), lookup_key(object_id)
        if len(like) > 1:
            raise BadInput(f"{object_id!r} can be {' or '.join(map(repr, like))}; give one of these names exactly")
        if not like and not (new.isprintable() and new and is_utf8(new)):
            raise BadInput(f"the name of an object must be printable text, got {object_id!r}")
        return like[0] if like else new

    def _require_open(self) -> None:
        if self._is_closed:
            raise BadInput(f"this searcher of {self.index} is closed; open the index again")
        if self._process != os.getpid():  # its threads and their locks do not survive a fork
            raise BadInput(
                f"this searcher of {self.index} was opened before this process was forked; start processes with the "
                'method "spawn" of multiprocessing, and open the index in each of them'
            )

    def _encoded(
        self, grasps: Sequence[Sequence[InputImage]], background: Sequence[AnyImage] | None, clock: Stopwatch
    ) -> tuple[TouchEncodings, NDArray[np.str_]]:
        """Return the codes of grasps and the gel check (G,) of each."""
        codes = self.reader.encode(grasps, self.reader.no_contact_frames(background), clock)
        check = self.checkpoint.gel_check
        if check is None or codes.readings is None:  # then every grasp has contact
            return codes, np.full(len(grasps), CONTACT)
        return codes, np.array(check.classify(codes.readings, codes.levels))

    def _result(
        self,
        grasps: Sequence[Sequence[InputImage]],
        openings_mm: list[float | None],
        classes: list[str],
        timing_ms: dict[str, float],
        found: ShardResult | None,
        none_prior: float,
    ) -> QueryResult:
        """Return the answer; `found` is None without a grasp with contact."""
        manifest, posterior, count = self.manifest, self.posterior, classes.count(CONTACT)
        has_openings = any(opening is not None for opening in openings_mm)
        probabilities, formula = None, None
        verdict = _fault(classes) or UNCALIBRATED
        if found is not None and posterior is not None:
            logits = [ranked.logit for ranked in found.best]
            probabilities = posterior.probabilities_given(logits, found.mass, count, none_prior)
            verdict = MATCH if probabilities.objects.max() > probabilities.none else NONE_OF_THESE
            formula = {
                **asdict(posterior),
                "none_prior": none_prior,
                "grasps": count,
                "objects": found.mass.objects,
                "scored_objects": found.objects,
                "unscored_probability": probabilities.unscored,
            }
            if found.references[0] and self.checkpoint.references is not None:
                counts = dict(zip(("touches", "objects"), found.references, strict=True))
                built = manifest.about.get(REFERENCE_ROWS, {})
                formula[REFERENCE_ROWS] = {**built, **counts, "calibration": asdict(self.checkpoint.references)}
            if has_openings:
                opening = self.checkpoint.opening
                formula["opening"] = {
                    "compared_objects": found.compared_openings,
                    "calibration": None if opening is None else asdict(opening),
                }
        sharding = {"shards": len(manifest.shards)} if isinstance(manifest, ShardedManifest) else {}
        return QueryResult(
            touches=[[image.name for image in grasp] for grasp in grasps],
            grasps=classes,
            index={
                "path": str(self.index),
                "generation": manifest.generation,
                "kind": manifest.kind,
                "photos": manifest.photos,
                "objects": found.mass.objects if found else manifest.objects,
                "scored": found.photos if found else 0,
                **sharding,
                "encoder": self.encoder.name,
                "catalogue": str(self.catalogue),
                "model": str(self.checkpoint.path),
                "trained_on": self.checkpoint.provenance.get("source", "unknown"),
            },
            timing_ms=timing_ms,
            verdict=verdict,
            none_probability=probabilities.none if probabilities else None,
            posterior=formula,
            results=[
                Match(
                    place + 1,
                    ranked.photo.object_id,
                    ranked.logit,
                    None if probabilities is None else float(probabilities.objects[place]),
                    ranked.photo.path,
                    ranked.photo.digest,
                    ranked.photo.metadata,
                    self.picture_file(ranked.photo),
                    ranked.reference,
                    None if probabilities is None else float(probabilities.objects_if_present[place]),
                )
                for place, ranked in enumerate(found.best if found else ())
            ],
            opening_mm=openings_mm if has_openings else None,
        )


def _fault(classes: Iterable[str]) -> str | None:
    """Return the verdict on grasps of which none can be used, by the gel check of each; None if one can."""
    shown = set(classes)
    if CONTACT in shown:
        return None
    return NOT_A_GEL if NOT_A_GEL in shown else NO_CONTACT


def _names(grasp: Sequence[InputImage]) -> str:
    return " and ".join(image.name for image in grasp)


def _torch_encoder(stored: CheckpointInfo, threads: int | None) -> TouchEncoder:
    from retrieval.model.checkpoint import load_checkpoint  # the slow import of PyTorch
    from retrieval.model.encode import TorchEncoder

    return TorchEncoder(load_checkpoint(stored.path, digest=stored.digest).matcher, threads)
