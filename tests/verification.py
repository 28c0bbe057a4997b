"""A posterior and a calibration of verifications with bounds of the caller's choice, and an index of such a model."""

import dataclasses

from retrieval.indexing.build import build_index
from retrieval.model.checkpoint import load_checkpoint, store_checkpoint
from retrieval.model.posterior import Posterior
from retrieval.model.verification import LEVELS, MAX_GRASPS, QUANTILES, VerificationCalibration

POSTERIOR = Posterior(slope=1.0, offset=0.0)


def calibration(accept, reject):
    """Return a calibration whose bounds are these at every rate."""
    return VerificationCalibration(
        group_sizes=(100,),
        impostors=(accept,) * len(LEVELS),
        similar=(accept - 1,) * len(QUANTILES),
        genuine=((accept + 1,) * len(QUANTILES),) * MAX_GRASPS,
        lowest=(reject,) * len(QUANTILES),
    )


def verified_index(folder, model, catalogue, fitted):
    """Return the index, in `folder`, of a model with this calibration that takes every picture for a gel image."""
    made = dataclasses.replace(load_checkpoint(model), posterior=POSTERIOR, verification=fitted, gel_check=None)
    store_checkpoint(made, folder / "m.safetensors")
    build_index(catalogue, load_checkpoint(folder / "m.safetensors"), folder / "index")
    return folder / "index"
