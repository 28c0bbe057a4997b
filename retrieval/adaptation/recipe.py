"""Adapt a model to a new sensor and to your objects.

Two kinds of frozen towers are used together: the towers of the start model (pretrained on relief in simulation) and one
published tower (pretrained on photos). The fit is linear (`retrieval.methods.cca_towers`). Every reported number comes
from objects that were left out of the fit.
"""

from dataclasses import dataclass
from pathlib import Path

from retrieval.adaptation.data import AdaptationData, load_adaptation_data
from retrieval.adaptation.estimate import Estimate, estimate_accuracy
from retrieval.adaptation.fitting import calibrate_baseline, calibrate_fit, fit_matcher
from retrieval.data.dataset import AnyRecording, Split, finger_count, folder_of, load_grasps
from retrieval.model.checkpoint import Checkpoint, load_checkpoint, require_writable, store_checkpoint
from retrieval.model.shipped import shipped_model


@dataclass(frozen=True, eq=False)
class Adaptation:
    """Result of `adapt`: the checkpoint and its accuracy on held-out objects.

    Attributes:
        checkpoint: The written checkpoint.
        data: The fitted grasps and their features.
        estimate: The accuracy estimate; None for fewer than six objects; the checkpoint then has no probabilities.

    >>> from pathlib import Path
    >>> made = retrieval.adapt("lab", Path("own.safetensors"), "model.safetensors", init="none", quiet=True)
    >>> made.checkpoint.path.name
    'own.safetensors'
    >>> 0 <= made.estimate.to_dict()["held_out_top1"] <= 1
    True
    """

    checkpoint: Checkpoint
    data: AdaptationData
    estimate: Estimate | None

    def lines(self) -> list[str]:
        """Return the result as lines of text."""
        lines = self.estimate.lines() if self.estimate else []
        grasps = self.data.grasps
        objects = len({grasp.object_id for grasp in grasps})
        return [*lines, f"{self.checkpoint.path}: fitted to {objects} objects, {len(grasps)} touches"]


def adapt(
    recording: AnyRecording,
    out: Path,
    start: str | Path | Checkpoint | None = None,
    *,
    init: str = "imagenet",
    split: Split | None = None,
    cache: Path | None = None,
    seed: int = 0,
    quiet: bool = False,
) -> Adaptation:
    """Fit a model to a recording from another sensor with your objects, and write the checkpoint `out`.

    If the pair accuracy of the start model on held-out objects is at least that of the fit, `out` is a copy of the
    start model with newly fitted calibrations and gel check.

    Args:
        recording: A folder, or the object that `robot.read_recording` returns.
        out: The checkpoint (.safetensors).
        start: The start model. Default: the shipped model for one finger, or for two or more.
        init: Weights of the published MobileNetV2 that is combined with the towers of the start model: "imagenet", a
            file, or "none" to use the towers of the start model only.
        split: A split whose test objects are not used at all.
        cache: Folder of encoded features, so that a stopped run resumes.
        seed: Seed of the folds.
        quiet: No progress on stderr.

    Raises:
        DatasetError: The recording cannot be read.
        BadInput: The recording has too few objects.
        CheckpointError: `start` cannot be read, or `out` cannot be written.

    >>> from pathlib import Path
    >>> made = retrieval.adapt("lab", Path("mine.safetensors"), "model.safetensors", init="none", quiet=True)
    >>> made.lines()[-1]
    'mine.safetensors: fitted to 12 objects, 24 touches'
    """
    require_writable(out)
    recording = folder_of(recording)
    if not isinstance(start, Checkpoint):
        start = load_checkpoint(start or shipped_model(min(finger_count(load_grasps(recording)), 2)))
    data = load_adaptation_data(recording, start, init=init, split=split, cache=cache, seed=seed, quiet=quiet)
    estimate = estimate_accuracy(data, start, cache=cache, seed=seed, quiet=quiet)
    if estimate and estimate.is_baseline_better:
        checkpoint = calibrate_baseline(start, data, estimate, quiet=quiet)
    else:
        checkpoint = calibrate_fit(fit_matcher(data, estimate, out), data, estimate, quiet=quiet)
    store_checkpoint(checkpoint, out)
    return Adaptation(load_checkpoint(out), data, estimate)
