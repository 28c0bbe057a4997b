"""The model card of a checkpoint, and the licences of the data that trained it."""

from retrieval.data.card import LIBRARY, card_header, common_licence, plain_name
from retrieval.data.dataset import DataLicence, Split, stored_licences
from retrieval.model.checkpoint_info import CheckpointInfo
from retrieval.model.shipped import is_shipped
from retrieval.model.verification import CARD_FAR

SHIPPED_DATA = DataLicence("simulated objects of the shipped models", "MIT", "as touch-retrieval")


def checkpoint_licences(info: CheckpointInfo) -> list[DataLicence]:
    """Return the licences that a checkpoint lists; for one of an older version, that its licence is not stated."""
    unlisted = SHIPPED_DATA if is_shipped(info.path) else DataLicence(str(info.provenance.get("source", info.path)))
    return stored_licences(info.provenance) or [unlisted]


def model_card(name: str, checkpoint: CheckpointInfo, split: Split | None, licence: str | None = None) -> str:
    """Return the card of a checkpoint.

    Args:
        name: Name of the model.
        checkpoint: The checkpoint.
        split: Its split.
        licence: Licence of the model; None for that of its data, if there is one.
    """
    config, provenance, licences = checkpoint.config, checkpoint.provenance, checkpoint_licences(checkpoint)
    source = provenance["source"]
    metrics = [
        {"type": key, "name": key.replace("_", " "), "value": round(value, 4)}
        for key, value in provenance["metrics"].items()
    ]
    results = {
        "task": {"type": "cross-modal-retrieval", "name": "Find the photo of a touched object"},
        "dataset": {"type": plain_name(source), "name": source, "split": "validation"},
        "metrics": metrics,
    }
    lines = [
        *card_header(
            licence or common_licence(licences),
            library_name=LIBRARY,
            datasets=[plain_name(source)],
            model_index=[{"name": name.removesuffix(".safetensors"), "results": [results] if metrics else []}],
        ),
        f"# {name}",
        "",
        f"Matches touches of {config.matcher.fingers} gel image(s) with photos. Tower `{config.matcher.tower}`, "
        f"output `{config.matcher.tower_output}`.",
        "",
        f"* Trained on: {source} (data digest `{provenance['data_digest'][:16]}`)",
        f"* Best step: {provenance['step']} of {config.training.iterations}, seed {config.training.seed}",
    ]
    lines += [f"* Licence of the data of {each.source}: {each}" for each in licences]
    if split:
        lines.append(f"* Objects: {len(split.train)} train, {len(split.validation)} validation, {len(split.test)} test")
    for key, value in provenance["metrics"].items():
        lines.append(f"* {key.replace('_', ' ')}: {value:.4g}" if isinstance(value, float) else f"* {key}: {value}")
    if posterior := checkpoint.posterior:
        lines.append(
            f"* Probabilities: fitted on {posterior.tests} sets of validation touches; slope {posterior.slope:.3f}, "
            f"offset {posterior.offset:.3f}, dependence of grasps {posterior.dependence:.3f}"
        )
    if checkpoint.verification:
        rate = checkpoint.verification.bounds(CARD_FAR).false_rejects
        lines.append(
            f"* Verification at a false-accept rate of {CARD_FAR:g}: false-reject rate {rate.value:.3f} "
            f"[{rate.low:.3f}, {rate.high:.3f}]"
        )
    if check := checkpoint.gel_check:
        rates = [f"{name.replace('_', ' ')} {value:.3f}" for name, value in check.rates.items()]
        lines.append(f"* Check of gel images, on validation objects: {', '.join(rates)}")
    return "\n".join(lines) + "\n"
