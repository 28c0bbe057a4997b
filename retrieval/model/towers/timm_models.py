"""Models of the `timm` library as towers: "timm:convnext_tiny.fb_in1k"."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from retrieval.errors import CheckpointError, ConfigError
from retrieval.model.towers.tower import TowerFamily, stage_statistics
from retrieval.model.towers.weights import State


class TimmTower(TowerFamily):
    """A model of timm.

    "pooled" is its output without the classifier, "stages" the statistics of its feature maps.
    """

    def __init__(self, output: str, model: str, architecture: Mapping[str, Any]) -> None:
        super().__init__(output, model, architecture)
        timm = _timm()
        if output == "stages":
            self.model = timm.create_model(model, pretrained=False, features_only=True)
            self.feature_count = 3 * sum(self.model.feature_info.channels())
        else:
            self.model = timm.create_model(model, pretrained=False, num_classes=1000 if output == "classes" else 0)
            self.feature_count = 1000 if output == "classes" else self.model.num_features
        for name in ("mean", "std"):
            setattr(self, name, torch.tensor(architecture[name]).view(1, 3, 1, 1))

    @classmethod
    def architecture(cls, model: str) -> dict[str, Any]:
        """Return the normalisation of a model; its name determines the rest. Raises ConfigError."""
        timm = _timm()
        if not timm.is_model(model):
            raise ConfigError(f"timm:{model} must be a model of timm {timm.__version__}; see timm.list_models()")
        known = timm.get_pretrained_cfg(model)
        return {"mean": list(known.mean), "std": list(known.std)}

    def published_weights(self) -> State:
        """Return the weights that timm publishes for the model. Raises CheckpointError."""
        timm = _timm()
        options = {"features_only": True} if self.output == "stages" else {"num_classes": self.model.num_classes}
        try:
            found = timm.create_model(self.model_name, pretrained=True, **options)
        except (OSError, RuntimeError) as error:
            raise CheckpointError(f"the weights of timm:{self.model_name} are not available: {error}") from error
        return {f"model.{name}": value for name, value in found.state_dict().items()}

    def _encode(self, images: Tensor) -> Tensor:
        output = self.model(images)
        return stage_statistics(output) if self.output == "stages" else output


def _timm() -> Any:
    try:
        import timm
    except ImportError as error:
        raise ConfigError(
            f"a tower of timm needs the package, which cannot be imported ({error}); run `pip install timm`"
        ) from error
    return timm
