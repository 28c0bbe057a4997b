"""Training of the network that estimates the roll of a photo."""

import numpy as np
import torch

from models.pictures import collect_pictures
from models.small_networks import to_onnx
from models.upright import EXAMPLE, RollEstimator, RollNetwork, score, target, train
from retrieval.data.object_finder import whole_photo
from retrieval.data.upright import disc


def test_the_probabilities_are_the_mean_over_four_turned_copies(tmp_path):
    torch.manual_seed(0)
    network, photo = RollNetwork().eval(), np.random.default_rng(0).random((80, 80, 3), dtype=np.float32)
    file = tmp_path / "network.onnx"
    file.write_bytes(to_onnx(network, EXAMPLE))
    found = whole_photo(photo)
    turned = torch.stack([torch.from_numpy(disc(photo, found)).rot90(quarters) for quarters in range(4)])
    with torch.inference_mode():
        each = network(turned.permute(0, 3, 1, 2)).softmax(1)
    expected = torch.stack([row.roll(-6 * quarters) for quarters, row in enumerate(each)]).mean(0)
    np.testing.assert_allclose(RollEstimator(file).probabilities(photo, found), expected, atol=1e-5)


def test_the_target_is_at_the_roll_and_goes_round():
    assert target(np.radians([0.0, 90.0, -15.0])).argmax(1).tolist() == [0, 6, 23]
    np.testing.assert_allclose(target(np.radians([352.5]))[0, [23, 0]], target(np.radians([7.5]))[0, [1, 0]])


def test_varied_photos_state_their_roll_and_train_a_network(tmp_path):
    photos = collect_pictures("varied", tmp_path, objects=4, seed=3)
    assert len({photo.roll_rad for photo in photos}) > 4
    file = tmp_path / "network.onnx"
    file.write_bytes(to_onnx(train(photos, steps=2), EXAMPLE))
    assert "of 12 photos" in score(RollEstimator(file), photos)
