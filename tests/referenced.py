"""A catalogue with reference touches beside photos and instead of them, and a model that knows what they are worth."""

import dataclasses
import shutil

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
OBJECTS = synthetic.make_objects(8, seed=9)
NAMES = sorted(one.object_id for one in OBJECTS)


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


def write_touches(folder):
    """Three touches of each of the catalogue's objects, by object."""
    return synthetic.write_queries(folder, OBJECTS, 3)


def put(catalogue, name, number, files):
    """A touch into a catalogue."""
    (catalogue / name).mkdir(exist_ok=True)
    for finger, path in zip("ab", files, strict=True):
        shutil.copy(path, catalogue / name / f"touch_{number}_{finger}.png")


def put_touches(catalogue, touches):
    """Two touches of each of its first four objects, the third of which loses its photos."""
    for name in NAMES[:4]:
        for number in (0, 1):
            put(catalogue, name, number, touches[name][number])
    for photo in (catalogue / NAMES[2]).glob("*.jpg"):
        photo.unlink()
    return catalogue
