"""Large photos of the frontier: the size of each decoder, and larger errors for smaller sizes."""

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


def test_each_point_decodes_at_its_fraction_and_the_last_as_reduced_preprocessing(file, monkeypatch):
    sizes = []

    def recorded(*args):
        image = decode(*args)
        sizes.append(image.shape[:2])
        return image

    for module in (large_photos, preprocessing):
        monkeypatch.setattr(module, "decode", recorded)
    *fixed, (needed, load) = decoders(SETTINGS)
    for _, at in fixed:
        at(file)
    assert [point.setting for point, _ in fixed] == ["whole", "1/2", "1/4", "1/8"]
    assert sizes == [(640, 800), (320, 400), (160, 200), (80, 100)]
    assert needed.series == "reduced"
    assert np.array_equal(load(file), dataclasses.replace(SETTINGS, reduced=True).photo_from_bytes(file, "x"))


@pytest.mark.parametrize(("is_reduced", "default"), [(False, "whole"), (True, "what the views need")])
def test_the_model_s_preprocessing_is_the_default(is_reduced, default):
    points = [point for point, _ in decoders(dataclasses.replace(SETTINGS, reduced=is_reduced))]
    assert [point.setting for point in points if point.is_default] == [default]


def test_smaller_decoded_sizes_have_larger_errors_of_views_and_logits(model, recording, tmp_path):
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
