"""Linear probes predict a label from features that contain it, and not from noise."""

import numpy as np

from benchmarks.models.probes import table
from retrieval.data.labelled_pictures import ObjectLabels
from retrieval.training.features import Features

LABELS = [ObjectLabels(("ribs", "box"), (2.0, 0.2, 1.0, 0.5)), ObjectLabels(("knurl", "tube"), (8.0, 0.8, 1.0, 0.5))]


def test_a_probe_reads_the_relief_from_features_that_contain_it_and_not_from_noise():
    rng = np.random.default_rng(0)
    owner = np.arange(400) % 40
    names = tuple(f"{name:02d}" for name in owner)
    touch = np.where(owner[:, None] % 2 == 0, [1.0, 0.0], [0.0, 1.0]) + 0.1 * rng.normal(size=(400, 2))
    features = Features(
        tuple(map(str, range(400))), names, np.float32(touch)[:, None], np.float32(rng.normal(size=(400, 2)))
    )
    train, test = features.select(np.arange(200)), features.select(np.arange(200, 400))
    relief = table(train, test, {name: LABELS[int(name) % 2] for name in names})[2]
    name, chance, by_touch, by_photo, both = (cell.strip() for cell in relief.strip("|").split("|"))
    assert (name, chance, by_touch) == ("relief", "0.500", "1.000 [1.000, 1.000]")
    assert 0.3 < float(by_photo.split()[0]) < 0.7
    assert both == by_photo
