"""Training of the network that finds the object in a photo."""

import numpy as np
import torch

from models.object_finder import EXAMPLE, MaskNetwork, overlap, score, train
from models.pictures import collect_pictures
from models.small_networks import to_onnx
from retrieval.data.object_finder import INPUT_PX, FoundObject, ObjectFinder


def test_the_stored_network_gives_the_same_mask(tmp_path):
    torch.manual_seed(0)
    network, photo = MaskNetwork().eval(), np.random.default_rng(0).random((INPUT_PX, INPUT_PX, 3), dtype=np.float32)
    file = tmp_path / "network.onnx"
    file.write_bytes(to_onnx(network, EXAMPLE))
    with torch.inference_mode():
        expected = network(torch.from_numpy(photo).permute(2, 0, 1)[None])[0, 0].numpy()
    np.testing.assert_allclose(ObjectFinder(file).logits(photo), expected, atol=1e-5)


def test_the_overlap_is_intersection_over_union():
    box = FoundObject(0, 0, 10, 10, 100)
    assert overlap(box, box) == 1
    assert overlap(box, FoundObject(5, 0, 15, 10, 100)) == 50 / 150
    assert overlap(box, FoundObject(20, 0, 30, 10, 100)) == 0


def test_varied_photos_have_masks_and_train_a_network(tmp_path):
    photos = collect_pictures("varied", tmp_path, objects=2, seed=3)
    assert [photo.mask is None for photo in photos] == [False] * 6
    assert all(120 < photo.field_mm < 400 for photo in photos)
    file = tmp_path / "network.onnx"
    file.write_bytes(to_onnx(train(photos, steps=2), EXAMPLE))
    assert "of 6 photos" in score(ObjectFinder(file), photos)
