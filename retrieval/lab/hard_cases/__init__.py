"""Stiff and extreme inputs of every numerical kernel: what must hold, what the naive formula gives, what ours gives.

    losses        of pairs, of embeddings, and the gradients of what leads to them
    probability   logits, calibration, several grasps, choices
    linear        canonical correlation, partial least squares, whitening, standardising, cosine
    ranking       top k, halves, measures of a ranking, intervals
    images        background, samples, resizing
    vectors       unit vectors, inner products and exact search in the index
    contact       the gel's contact, its kernels, closing jaws
    rig           what a rig sees and does
    gel_pictures  gel pictures, and the fit of their optics

The naive formulae stand in these files to be shown failing; nothing else uses them. A new case is one function, and one
`yield` in `hard_cases` of its file.
"""

import warnings
from importlib import import_module

import numpy as np

from retrieval.lab.hard_cases.case import HardCase

KERNELS = {
    "retrieval": ("losses", "probability", "linear", "ranking", "images"),
    "indexes": ("vectors",),
    "robot": ("contact", "rig", "gel_pictures"),
}
"""Package -> files here with the hard cases of its kernels, imported when they are run."""


def hard_cases(package: str) -> list[HardCase]:
    """Every hard case of a package."""
    found: list[HardCase] = []
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of naive formulae
        for name in KERNELS[package]:
            found += import_module(f"{__name__}.{name}").hard_cases()
    return found
