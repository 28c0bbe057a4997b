"""Stiff and extreme inputs of every numerical kernel: what must hold, what the naive formula gives, what ours gives.

    losses        of pairs, of embeddings, and the gradients of what leads to them
    probability   logits, calibration, several grasps, choices
    linear        canonical correlation, partial least squares, whitening, standardising, cosine
    ranking       top k, halves, measures of a ranking, intervals
    images        background, samples, resizing

The naive formulae stand in these files to be shown failing; nothing else uses them.
"""

import warnings

import numpy as np

from retrieval.lab.hard_cases.case import HardCase as HardCase


def hard_cases() -> tuple[HardCase, ...]:
    """Every hard case, in a few seconds; a kernel whose library is missing is left out, and a log line says so."""
    from retrieval.lab.hard_cases import images, linear, losses, probability, ranking

    parts = (losses, probability, linear, ranking, images)
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of naive formulae
        return tuple(case for part in parts for case in part.hard_cases())
