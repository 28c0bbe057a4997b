"""`retrieve adapt`: a checkpoint for a new sensor and own objects, from a few of them.

Towers stand still: those of the checkpoint that one starts from, which learnt on the simulated rig what relief looks
like, beside those of published weights, which know pictures. What is fitted is linear (`retrieval.methods.cca_towers`),
and every number that is told of it comes from objects that were left out of the fit.
"""

from pathlib import Path

from retrieval.adaptation.estimate import Estimate, judge
from retrieval.adaptation.fitting import fit_matcher, start_with_probabilities, with_probabilities
from retrieval.adaptation.material import Material, encode
from retrieval.data.dataset import Split
from retrieval.model.checkpoint import Checkpoint, require_writable, store_checkpoint


def adapt(
    recording: Path,
    out: Path,
    start: Checkpoint,
    *,
    init: str,
    split: Split | None = None,
    cache: Path | None = None,
    seed: int = 0,
    quiet: bool = False,
) -> tuple[Material, Estimate | None]:
    """Fit the towers of `start` to a recording of another sensor and own objects, and write the checkpoint `out`; where
    `start` as it is tells objects that were left out apart better than the fit, it is kept, its probabilities fitted.

    init: published weights whose tower stands beside those of the start ("imagenet", a file, or "none"). split: its
    test objects are left out of everything. cache: where features are kept, so that a run which was stopped goes on.
    The estimate is None for fewer than six objects; the checkpoint then says nothing of probabilities. Raises
    DatasetError, CheckpointError, BadInput.
    """
    require_writable(out)
    material = encode(recording, start, init=init, split=split, cache=cache, seed=seed, quiet=quiet)
    estimate = judge(material, start, cache=cache, seed=seed, quiet=quiet)
    if estimate and estimate.keeps_the_model:
        made = start_with_probabilities(start, material, estimate, quiet=quiet)
    else:
        made = with_probabilities(fit_matcher(material, estimate, out), material, estimate, quiet=quiet)
    store_checkpoint(made, out)
    return material, estimate
