"""Large photos of the frontier: what each way of decoding sees, and that less of a photo is further from the whole."""

import dataclasses

import numpy as np
import pytest

from benchmarks.frontier import large_photos
from benchmarks.frontier.large_photos import as_jpeg, decoders, photographed, reduced
from retrieval.data import preprocessing
from retrieval.data.images import decode
from retrieval.data.preprocessing import Preprocessing
from retrieval.frontier.sample import Sample, Scale

SETTINGS = Preprocessing(photo_px=32, views=("crop", "grey"))


@pytest.fixture(scope="module")
def file():
    return as_jpeg(photographed(0, 96).resize((800, 640)), 92)


def test_each_point_decodes_the_file_at_its_fraction_and_the_last_as_a_training_on_reduced_photos(file, monkeypatch):
    sizes = []

    def noted(*given):
        image = decode(*given)
        sizes.append(image.shape[:2])
        return image

    for module in (large_photos, preprocessing):
        monkeypatch.setattr(module, "decode", noted)
    *fixed, (needed, see) = decoders(SETTINGS)
    for _, at in fixed:
        at(file)
    assert [point.setting for point, _ in fixed] == ["whole", "1/2", "1/4", "1/8"]
    assert sizes == [(640, 800), (320, 400), (160, 200), (80, 100)]
    assert needed.series == "reduced"
    assert np.array_equal(see(file), dataclasses.replace(SETTINGS, reduced=True).photo_from_bytes(file, "x"))


@pytest.mark.parametrize(("said", "default"), [(False, "whole"), (True, "what the views need")])
def test_what_the_model_s_preprocessing_says_is_the_default(said, default):
    points = [point for point, _ in decoders(dataclasses.replace(SETTINGS, reduced=said))]
    assert [point.setting for point in points if point.is_default] == [default]


def test_the_less_of_a_photo_is_decoded_the_further_its_views_and_logits_are_from_those_of_the_whole(
    model, recording, tmp_path
):
    sample = Sample(model, lambda: recording, tmp_path, Scale(queries=4, repeats=1, quick=True), quiet=True)
    views, logits, flips = reduced(sample).panels
    for panel in (views, logits):
        whole, *fractions = [point.error for point in panel.points if point.series == "a fixed fraction"]
        assert whole == 0 < fractions[0]
        assert panel.tolerance > 0
    errors = [point.error for point in views.points[:4]]
    assert errors == sorted(errors)
    assert flips.points[0].error == 0
    assert all(0 <= point.error <= 100 for point in flips.points)
