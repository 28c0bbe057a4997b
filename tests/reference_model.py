"""A model with a reference calibration, for catalogues such as the fixture `catalogue_with_touches`."""

import dataclasses

import torch

from retrieval.model.checkpoint import Checkpoint, load_checkpoint, store_checkpoint
from retrieval.model.config import Config
from retrieval.model.fusion import Matcher
from retrieval.model.posterior import Posterior
from retrieval.model.references import ReferenceCalibration
from tests import synthetic
from tests.conftest import TINY

REFERENCE_CALIBRATION = ReferenceCalibration(Posterior(8.0, -3.0, 0.5, 40), 5.0, Posterior(1.5, -2.0, 0.8, 40), 20, 40)
POSTERIOR = Posterior(0.9, -0.5, 0.7, 40)
MATCHER = dataclasses.replace(TINY.matcher, cosine=True)
NAMES = sorted(obj.object_id for obj in synthetic.make_objects(8, seed=9))
"""Objects of the fixture `catalogue`."""


def write_reference_model(path, references=REFERENCE_CALIBRATION, posterior=POSTERIOR, matcher=MATCHER, **contents):
    """Write and load a matcher with random weights; it has different scores for different touches."""
    torch.manual_seed(0)
    contents |= {"matcher": Matcher(matcher).eval(), "posterior": posterior, "references": references}
    provenance = {"source": "a test", "step": 1, "data_digest": "0" * 64, "metrics": {}}
    config = Config(matcher, TINY.training, TINY.preprocessing)
    store_checkpoint(Checkpoint(path, "", config, provenance, **contents), path)
    return load_checkpoint(path)
