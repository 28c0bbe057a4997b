"""Towers: parity with an independent implementation, ImageNet keys, and the contract of the base class."""

import math
import re
import socket
from unittest.mock import Mock
from urllib.error import URLError

import pytest
import torch
from torch import nn
from torch.nn import functional

from retrieval.errors import BadInput, CheckpointError, ConfigError, NumericalError
from retrieval.model.towers.mobilenet import InvertedResidual
from retrieval.model.towers.tower import Tower, build_tower, stage_statistics
from retrieval.model.towers.weights import download, read_state
from tests.data import touch_data

RESNETS = {
    "resnet18": ("basic", [2, 2, 2, 2], [64, 128, 256, 512]),
    "resnet50": ("bottleneck", [3, 4, 6, 3], [256, 512, 1024, 2048]),
}


def independent_implementation(name):
    import transformers

    if name == "mobilenet_v2":
        config = transformers.MobileNetV2Config(tf_padding=False, layer_norm_eps=1e-5, num_labels=1000)
        return transformers.MobileNetV2ForImageClassification(config)
    kind, depths, widths = RESNETS[name]
    config = transformers.ResNetConfig(layer_type=kind, depths=depths, hidden_sizes=widths, num_labels=1000)
    return transformers.ResNetForImageClassification(config)


def weights_in_order_of_use(model, images):
    """Return the convolutions, normalisations and linear layers in the order of a forward pass."""
    met, hooks = [], []
    for module in model.modules():
        if isinstance(module, nn.Conv2d | nn.BatchNorm2d | nn.Linear):
            hooks.append(module.register_forward_hook(lambda layer, _, __: met.append(layer)))
    with torch.inference_mode():
        model(images)
    for hook in hooks:
        hook.remove()
    return met


@pytest.mark.parametrize("name", ["resnet18", "resnet50", "mobilenet_v2"])
def test_a_tower_computes_the_same_as_an_independent_implementation_with_the_same_weights(name):
    torch.manual_seed(3)
    other = independent_implementation(name).eval()
    tower = build_tower(name, "classes").eval()
    images = torch.rand(2, 3, 96, 64)
    normalised = (images - tower.mean) / tower.std
    ours, theirs = weights_in_order_of_use(tower, images), weights_in_order_of_use(other, normalised)
    # Shortcuts may come before or after the main branch, so layers are paired by kind and shape, in order.
    waiting = list(theirs)
    for layer in ours:
        shapes = {key: value.shape for key, value in layer.state_dict().items()}
        partner = next(
            other_layer
            for other_layer in waiting
            if isinstance(layer, type(other_layer))
            and {key: value.shape for key, value in other_layer.state_dict().items()} == shapes
        )
        waiting.remove(partner)
        for value in partner.parameters():  # random weights, so that a wrong pairing shows
            nn.init.normal_(value, std=0.05) if value.ndim > 1 else nn.init.uniform_(value, 0.5, 1.5)
        layer.load_state_dict(partner.state_dict())
    assert not waiting
    with torch.inference_mode():
        torch.testing.assert_close(tower(images), other(normalised).logits, rtol=1e-5, atol=1e-5)


PUBLISHED = {
    "resnet50": (320, "conv1.weight layer1.0.downsample.1.running_var layer4.2.bn3.num_batches_tracked fc.bias"),
    "mobilenet_v2": (314, "features.0.0.weight features.1.conv.0.0.weight features.2.conv.3.bias classifier.1.weight"),
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_tower_has_the_key_names_of_published_checkpoints(name):
    count, some = PUBLISHED[name]
    keys = build_tower(name, "classes").state_dict()
    assert set(some.split()) <= set(keys)
    assert len(keys) == count
    assert "layer1.0.downsample.0.weight" not in build_tower("resnet18").state_dict()


@pytest.mark.parametrize(
    ("images", "error", "words"),
    [
        (torch.rand(3, 64, 64), BadInput, "shaped"),
        (torch.rand(1, 1, 64, 64), BadInput, "RGB"),
        (torch.randint(0, 255, (1, 3, 64, 64), dtype=torch.uint8), BadInput, "float32"),
        (torch.rand(1, 3, 64, 64) * 255, BadInput, "divide"),
        (torch.full((1, 3, 64, 64), math.nan), NumericalError, "NaN"),
    ],
)
def test_a_tower_refuses_input_that_is_not_an_image(images, error, words):
    with pytest.raises(error, match=words):
        build_tower("small")(images)


class Plain(Tower):
    def __init__(self, output):
        super().__init__()
        self.feature_count = 2
        self.layer = nn.Linear(3, 2)

    def _encode(self, images):
        return self.layer(images.mean((2, 3)))


def test_a_tower_loads_a_file_of_its_weights(tmp_path):
    weights, target = Plain("pooled").state_dict(), Plain("pooled")
    torch.save(weights, tmp_path / "weights.pth")
    target.initialise(str(tmp_path / "weights.pth"))
    assert all(torch.equal(value, weights[name]) for name, value in target.state_dict().items())
    with pytest.raises(CheckpointError, match="no weights are published for Plain; give a file"):
        target.initialise("imagenet")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"layer.other": torch.zeros(1)}, r"has an unknown layer\.other; name the tower"),
        ({"layer.weight": torch.zeros(3, 3)}, r"layer\.weight is \(3, 3\), must be \(2, 3\)"),
        ({"layer.weight": None}, r"lacks layer\.weight"),
        # Otherwise the first training step would fail, as if the learning rate were too high.
        ({"layer.weight": torch.full((2, 3), math.nan)}, r"w\.pth contains a NaN or infinite weight in layer\.weight"),
    ],
)
def test_weights_of_another_architecture_and_weights_that_are_not_finite_are_refused_and_named(change, message):
    tower = Plain("pooled")
    state = {name: value for name, value in {**tower.state_dict(), **change}.items() if value is not None}
    with pytest.raises(CheckpointError, match=message):
        tower.load(state, "w.pth")
    assert all(bool(torch.isfinite(weight).all()) for weight in tower.state_dict().values())


class Payload:
    def __reduce__(self):
        return (print, ("arbitrary code",))


def test_a_pickle_with_code_is_refused_and_not_run(tmp_path, capsys):
    torch.save({"weight": Payload()}, tmp_path / "evil.pth")
    with pytest.raises(CheckpointError):
        read_state(tmp_path / "evil.pth")
    assert "arbitrary" not in capsys.readouterr().out


def test_without_network_the_error_names_the_file_to_fetch_and_its_place(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    monkeypatch.setattr(torch.hub, "download_url_to_file", Mock(side_effect=URLError("no route to host")))
    with pytest.raises(CheckpointError, match=re.escape(str(tmp_path / "checkpoints" / "resnet18-f37072fd.pth"))):
        build_tower("resnet18").initialise("imagenet")


def test_a_download_from_a_server_that_does_not_answer_ends(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    monkeypatch.setattr("retrieval.model.towers.weights._TIMEOUT_S", 0.1)
    with socket.create_server(("127.0.0.1", 0)) as silent, pytest.raises(CheckpointError, match="timed out"):
        download(f"http://127.0.0.1:{silent.getsockname()[1]}/resnet50-0676ba61.pth")
    assert socket.getdefaulttimeout() is None


def test_a_published_file_may_lack_the_counts_of_batches_and_contain_parameters(tmp_path):
    tower, path = build_tower("resnet50", "classes"), tmp_path / "resnet50-0676ba61.pth"
    published = {
        name: nn.Parameter(torch.rand_like(value)) if name in dict(tower.named_parameters()) else torch.rand_like(value)
        for name, value in tower.state_dict().items()
        if not name.endswith("num_batches_tracked")
    }
    torch.save(published, path)
    tower.initialise(str(path))
    loaded = tower.state_dict()
    assert all(torch.equal(loaded[name], value) for name, value in published.items())
    assert loaded["bn1.num_batches_tracked"] == 0


def test_real_imagenet_weights_load_in_their_older_key_layout():
    path = touch_data("weights/mobilenet_v2_imagenet_features.pt")
    tower = build_tower("mobilenet_v2")
    tower.initialise(str(path))
    state = read_state(path)
    assert torch.equal(tower.features[0][0].weight, state["features.0.0.weight"])
    assert torch.equal(tower.features[1].conv[1].weight, state["features.1.conv.3.weight"])
    assert torch.equal(tower.features[17].conv[3].running_var, state["features.17.conv.7.running_var"])
    features = tower.eval()(torch.rand(1, 3, 224, 224))
    # ReLU6 after the last convolution, averaged.
    assert features.min() >= 0
    assert features.max() <= 6


def test_a_tower_up_to_stride_16_takes_the_weights_of_the_whole_one_and_gives_its_first_features():
    torch.manual_seed(1)
    whole, short = build_tower("mobilenet_v2", "stages").eval(), build_tower("mobilenet_v2_stride16", "stages").eval()
    short.load(whole.state_dict(), "the whole tower")
    images = torch.rand(2, 3, 64, 64)
    with torch.inference_mode():
        assert torch.equal(short(images), whole(images)[:, : 3 * (32 + 64 + 96)])
    with pytest.raises(ConfigError, match="only the tower_output"):
        build_tower("mobilenet_v2_stride16", "pooled")


def test_stage_statistics_are_those_of_each_map_concatenated():
    first = torch.tensor([[[[0.0, 2.0], [4.0, 6.0]]]])  # mean 3, deviation sqrt(5), maximum 6
    second = torch.full((1, 1, 1, 3), 7.0)  # constant
    expected = torch.tensor([[3.0, 5**0.5, 6.0, 7.0, 0.0, 7.0]])
    torch.testing.assert_close(stage_statistics([first, second]), expected)
    torch.testing.assert_close(stage_statistics([first.double(), second.double()]), expected.double())


@pytest.mark.parametrize(("kind", "has_gradient"), [(torch.float32, True), (torch.bfloat16, False)])
def test_a_nearly_constant_map_has_no_gradient_if_its_deviation_is_only_rounding(kind, has_gradient):
    """In bfloat16 such maps had most of the gradient of a tower, and a training of the shipped towers failed."""
    torch.manual_seed(0)
    maps = (5 + 0.04 * torch.rand(2, 3, 4, 4)).to(kind).requires_grad_()
    deviations = stage_statistics([maps])[:, 3:6]
    assert deviations.min() > 0
    deviations.sum().backward()
    assert bool(maps.grad.any()) == has_gradient


@pytest.mark.parametrize(
    ("name", "first", "second"),
    [("mobilenet_v2", "features.2", "features.3.conv.0.0"), ("small", "stages.2", "stages.3")],
)
def test_first_layers_of_a_tower_stay_in_float32_where_others_multiply_in_bfloat16(name, first, second):
    """An image rounded to bfloat16 has lost the differences between two gels."""
    tower, types = build_tower(name, "stages"), []
    for place in (first, second):
        tower.get_submodule(place).register_forward_hook(lambda _, __, made: types.append(made.dtype))
    with torch.autocast("cpu", torch.bfloat16):
        tower(torch.rand(2, 3, 32, 32))
    assert types == [torch.float32, torch.bfloat16]


def test_a_frozen_normalisation_in_training_gives_the_output_and_the_gradients_of_its_layers():
    torch.manual_seed(2)
    block, maps = InvertedResidual(8, 8, stride=1, expansion=2), torch.rand(2, 8, 6, 6)
    for module in block.modules():
        if isinstance(module, nn.BatchNorm2d):
            for values in (module.running_mean, module.running_var, module.weight.data, module.bias.data):
                values.uniform_(0.5, 1.5)

    def gradients(output):
        return torch.autograd.grad(output.square().sum(), list(block.parameters()))

    block.eval()
    plain = maps
    for layer in block.modules():
        if not list(layer.children()):
            plain = layer(plain)
    torch.testing.assert_close(block(maps), maps + plain)
    torch.testing.assert_close(gradients(block(maps)), gradients(maps + plain))


def test_group_norms_and_strided_depthwise_convolutions_compute_in_float32_under_autocast():
    """PyTorch's own versions round to bfloat16, and are slow."""
    torch.manual_seed(0)
    norm = next(module for module in build_tower("small").modules() if isinstance(module, nn.GroupNorm))
    maps = torch.rand(2, norm.num_channels, 8, 8).bfloat16()
    strided, image = InvertedResidual(8, 8, stride=2, expansion=2).conv[1][0], torch.rand(2, 16, 8, 8).bfloat16()
    exact = functional.group_norm(maps.float(), norm.num_groups)
    with torch.autocast("cpu", torch.bfloat16):
        ours, naive, got = norm(maps), functional.group_norm(maps, norm.num_groups), strided(image)
    assert ours.dtype == got.dtype == torch.float32
    torch.testing.assert_close(ours, exact)
    assert (naive.float() - exact).abs().max() > 1e-3
    expected = functional.conv2d(image.float(), strided.weight, stride=2, padding=1, groups=16)
    torch.testing.assert_close(got, expected)
