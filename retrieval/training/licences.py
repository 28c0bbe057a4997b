"""The licences of all data that train a model: of its recording and of the start model."""

from pathlib import Path

from retrieval.data.dataset import recording_licence
from retrieval.data.licences import DataLicence, stored_licences
from retrieval.model.checkpoint_info import CheckpointInfo, read_checkpoint_info
from retrieval.model.config import TrainingConfig
from retrieval.model.shipped import is_shipped
from retrieval.model.towers import TOWER_SEPARATOR
from retrieval.model.towers.weights import GEL, SHIPPED

_SHIPPED = DataLicence("simulated objects of the shipped models", "MIT", "as touch-retrieval")


def training_licences(recording: Path, settings: TrainingConfig) -> list[DataLicence]:
    """Return the licences of all data that a training with these settings uses.

    Published weights (`init = "imagenet"`) are not data of a recording and are left out.

    Raises:
        CheckpointError: The checkpoint `start` cannot be read.
    """
    found = [recording_licence(recording)]
    if settings.start:  # replaces the initial weights, which are not read
        found += checkpoint_licences(read_checkpoint_info(Path(settings.start)))
    else:
        inits = {settings.tower_init(init) for init in (settings.init_touch, settings.init_photo)}
        for name in sorted({part for init in inits for part in init.split(TOWER_SEPARATOR)} - {"random", "imagenet"}):
            found.append(_SHIPPED if name in (SHIPPED, GEL) else DataLicence(name))
    return list(dict.fromkeys(found))


def checkpoint_licences(info: CheckpointInfo) -> list[DataLicence]:
    """Return the licences that a checkpoint lists; for one of an older version, that its licence is not stated."""
    unlisted = _SHIPPED if is_shipped(info.path) else DataLicence(str(info.provenance.get("source", info.path)))
    return stored_licences(info.provenance) or [unlisted]
