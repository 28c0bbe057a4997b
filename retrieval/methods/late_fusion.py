"""Late fusion (Lin, Calandra, Levine, ICRA 2019): a head that scores pairs, trained as in `retrieve train`."""

import dataclasses
import tempfile
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import torch

from retrieval.data.dataset import Grasp, Split
from retrieval.methods.method import Array, Method, MethodSettings
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.config import Config
from retrieval.model.encode import default_device
from retrieval.model.fusion import Matcher
from retrieval.training.batches import FrozenFeatures
from retrieval.training.features import Features, features_by_image
from retrieval.training.initial_weights import TOWER_WEIGHTS, build_matcher
from retrieval.training.trainer import Trainer


class LateFusion(Method):
    """Match logits of a fusion head over frozen towers. The encodings are partial activations of its first layer.

    The head of a start model is trained further, and kept if no step is better on validation objects.
    """

    uses_cells = True

    def _fit(self, train: Features, validation: Features) -> None:
        self._use_checkpoint(self.settings.model or trained_checkpoint(self.settings, train, validation))

    def _use_checkpoint(self, checkpoint: Checkpoint) -> None:
        self.checkpoint, self._matcher = checkpoint, checkpoint.matcher
        self.best_params = {"step": checkpoint.provenance["step"], **checkpoint.provenance["metrics"]}
        if checkpoint.posterior is not None:  # the logit at which the likelihood ratio is 1
            self.best_params["pair_threshold"] = checkpoint.posterior.threshold

    @torch.inference_mode()
    def _encode_touch(self, touch: Array) -> Array:
        return np.asarray(self._matcher.touch_encoding(torch.from_numpy(touch).flatten(1)).partial.numpy())

    @torch.inference_mode()
    def _encode_photo(self, photo: Array) -> Array:
        return np.asarray(self._matcher.photo_encoding(torch.from_numpy(photo)).partial.numpy())

    def _score(self, touch_encodings: Array, photo_encodings: Array) -> Array:
        scorer = self._matcher.head.scorer
        return np.array([scorer.logits(touch[None], photo_encodings) for touch in touch_encodings])


def trained_checkpoint(settings: MethodSettings, train: Features, validation: Features) -> Checkpoint:
    """Train on features of the towers of `frozen_matcher`, and store the checkpoint in `settings.folder`.

    A checkpoint of the same fit in that folder is reused, an unfinished one is continued. The model has no candidate
    encoder, because every photo is scored.

    Raises:
        JobInterrupted: The user pressed Ctrl-C.
    """
    known = train.concatenate(validation)
    # Grasps to draw pairs from. Their files are only names and are never opened.
    grasps = [
        Grasp(grasp_id, object_id, None, photo_file=Path(grasp_id), touches=(), backgrounds=())
        for grasp_id, object_id in zip(known.grasp_ids, known.object_ids, strict=True)
    ]
    objects = [tuple(sorted(set(part.object_ids))) for part in (train, validation)]
    split = Split(settings.seed, train=objects[0], validation=objects[1], test=())
    config = settings.config.without_candidate_encoder()
    config = dataclasses.replace(
        config,
        matcher=dataclasses.replace(config.matcher, fingers=train.touch.shape[1]),
        training=dataclasses.replace(config.training, seed=settings.seed, freeze_towers=True),
    )
    if settings.start:
        weights = settings.start.matcher.state_dict()
    else:
        towers = frozen_matcher(settings.config).state_dict()
        weights = {name: part for name, part in towers.items() if name.startswith(TOWER_WEIGHTS)}
    with nullcontext(settings.folder) if settings.folder else tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"late_fusion-{settings.seed}.safetensors"
        source = FrozenFeatures(features_by_image(grasps, known, default_device()))
        made_from = {"source": "features of a recording", "data_digest": known.digest}
        return Trainer(config, split, grasps, path, made_from, source, weights).run_or_reuse()


def frozen_matcher(config: Config) -> Matcher:
    """Return a matcher whose towers compute features.

    Random weights depend on the configuration's seed, not on that of a head: one set of features serves heads of every
    seed.
    """
    torch.manual_seed(config.training.seed)
    return build_matcher(config).eval()
