"""A model that knows what reference touches are worth, for catalogues such as the fixture `touched`."""

import dataclasses

import torch

from retrieval.model.checkpoint import load_checkpoint, save_checkpoint
from retrieval.model.config import Config
from retrieval.model.fusion import Matcher
from retrieval.model.posterior import Posterior
from retrieval.model.references import ReferenceWorth
from tests import synthetic
from tests.conftest import TINY

WORTH = ReferenceWorth(Posterior(8.0, -3.0, 0.5, 40), 5.0, Posterior(1.5, -2.0, 0.8, 40), 20, 40)
MEANING = Posterior(0.9, -0.5, 0.7, 40)
NAMES = sorted(one.object_id for one in synthetic.make_objects(8, seed=9))
"""Objects of the catalogue that the fixture `catalogue` is."""


def a_model(path, references=WORTH, posterior=MEANING, cosine=True):
    """A matcher of random weights whose touches differ."""
    matcher = dataclasses.replace(TINY.matcher, cosine=cosine)
    config = Config(matcher, TINY.training, TINY.preprocessing)
    torch.manual_seed(0)
    about = {"source": "a test", "step": 1, "data_digest": "0" * 64, "metrics": {}}
    save_checkpoint(
        path,
        Matcher(matcher).eval(),
        config,
        split=None,
        provenance=about,
        posterior=posterior,
        references=references,
    )
    return load_checkpoint(path)
