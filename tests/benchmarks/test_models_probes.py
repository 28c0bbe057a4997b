"""Linear probes of the towers' features find what the features say, and nothing else."""

import numpy as np

from benchmarks.models.probes import predict, table
from retrieval.data.labelled_pictures import ObjectLabels

LABELS = [ObjectLabels(("ribs", "box"), (2.0, 0.2, 1.0, 0.5)), ObjectLabels(("knurl", "tube"), (8.0, 0.8, 1.0, 0.5))]


def test_a_probe_reads_the_relief_from_features_that_contain_it_and_not_from_noise():
    rng = np.random.default_rng(0)
    owner = np.arange(400) % 40
    labels = [LABELS[name % 2] for name in owner]
    touch = np.where(owner[:, None] % 2 == 0, [1.0, 0.0], [0.0, 1.0]) + 0.1 * rng.normal(size=(400, 2))
    photo = rng.normal(size=(400, 2))
    predictions = [predict(features[:200], features[200:], labels[:200]) for features in (touch, photo)]
    relief = table(predictions, labels[:200], labels[200:], owner[200:])[2]
    name, chance, by_touch, by_photo, both = (cell.strip() for cell in relief.strip("|").split("|"))
    assert (name, chance, by_touch) == ("relief", "0.500", "1.000 [1.000, 1.000]")
    assert 0.3 < float(by_photo.split()[0]) < 0.7
    assert both == by_photo
