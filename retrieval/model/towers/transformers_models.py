"""Vision models of the `transformers` library as towers: "transformers:facebook/dinov2-small", or a folder of one."""

import inspect
import logging
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from retrieval.errors import CheckpointError, ConfigError
from retrieval.model.towers.tower import TowerFamily, stage_statistics
from retrieval.model.towers.weights import State

log = logging.getLogger(__name__)
STAGE_COUNT = 4
"""Number of layers, evenly chosen, whose statistics are the output "stages": all stages of a network that has four."""


class TransformersTower(TowerFamily):
    """A vision model (DINOv2, ConvNeXt, ViT, SigLIP, ...) without its task head.

    "pooled" is the model's own pooled output, or the mean over its last map or tokens.
    """

    def __init__(self, output: str, model: str, architecture: Mapping[str, Any]) -> None:
        super().__init__(output, model, architecture)
        if output == "classes":
            raise ConfigError(f"transformers:{model} has no 1000-way layer; set tower_output to pooled or stages")
        models = _transformers()
        config = models.AutoConfig.for_model(**architecture["config"])
        self.model = models.AutoModel.from_config(config).float()
        takes = inspect.signature(self.model.forward).parameters
        # Models for one image size interpolate their position embeddings only with this option.
        self._options = {"interpolate_pos_encoding": True} if "interpolate_pos_encoding" in takes else {}
        for name in ("mean", "std"):
            setattr(self, name, torch.tensor(architecture[name]).view(1, 3, 1, 1))
        with torch.device("meta"), torch.no_grad():
            side = config.image_size if isinstance(getattr(config, "image_size", None), int) else 224
            twin = models.AutoModel.from_config(config).eval()
            self.feature_count = self._features(twin, torch.zeros(1, 3, side, side)).shape[1]

    @classmethod
    def architecture(cls, model: str) -> dict[str, Any]:
        """Return configuration and normalisation of a model of the Hub or in a folder. Raises ConfigError."""
        models = _transformers()
        try:
            config = models.AutoConfig.from_pretrained(model)
            config = getattr(config, "vision_config", config)
            processor, _ = models.ImageProcessingMixin.get_image_processor_dict(model)
        except (OSError, ValueError) as error:
            raise ConfigError(f"transformers:{model} must be a model of the Hub or in a folder: {error}") from error
        known = {name: value for name, value in config.to_dict().items() if name != "_name_or_path"}
        return {"config": known, "mean": processor["image_mean"], "std": processor["image_std"]}

    def published_weights(self) -> State:
        """Return the model's own weights, from its folder or the Hub. Raises CheckpointError."""
        try:
            found, report = _transformers().AutoModel.from_pretrained(
                self.model_name, config=self.model.config, dtype=torch.float32, output_loading_info=True
            )
        except (OSError, ValueError) as error:
            raise CheckpointError(f"the weights of transformers:{self.model_name} cannot be read: {error}") from error
        if report["missing_keys"]:
            log.warning(
                "%s lacks %s: this part is initialised randomly",
                self.model_name,
                ", ".join(sorted(report["missing_keys"])),
            )
        return {f"model.{name}": value for name, value in found.state_dict().items()}

    def _encode(self, images: Tensor) -> Tensor:
        return self._features(self.model, images)

    def _features(self, model: Any, images: Tensor) -> Tensor:
        """Return features (B, F) of images (B, 3, H, W) by `model`: this tower's own, or a twin of it."""
        output = model(images, output_hidden_states=self.output == "stages", **self._options)
        if self.output == "stages":
            maps = output.hidden_states[1:]
            every = max(1, len(maps) // STAGE_COUNT)
            return stage_statistics([_as_map(each) for each in maps[every - 1 :: every]])
        pooled = getattr(output, "pooler_output", None)
        features: Tensor = _as_map(output.last_hidden_state).mean((2, 3)) if pooled is None else pooled.flatten(1)
        return features


def _as_map(hidden: Tensor) -> Tensor:
    """Return maps (B, C, H, W) unchanged, or N tokens (B, N, C) as (B, C, N, 1)."""
    return hidden if hidden.ndim == 4 else hidden.transpose(1, 2)[..., None]


def _transformers() -> Any:
    try:
        import transformers
    except ImportError as error:
        raise ConfigError(
            "a tower of transformers needs the package; run `pip install 'touch-retrieval[transformers]'`"
        ) from error
    return transformers
