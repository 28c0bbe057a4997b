"""`retrieve push`: write a checkpoint or a recording to the Hugging Face Hub."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from retrieval.console.output import say
from retrieval.errors import BadInput

if TYPE_CHECKING:
    from retrieval.data.hub import Address

_NO_LICENCE = (
    "{} states no single licence for its data; if you may publish it, state the licence, such as --licence cc-by-4.0"
)


def push(
    source: Annotated[
        str,
        typer.Argument(
            metavar="MODEL|RECORDING", help="checkpoint, shipped or shipped-one-finger, or the folder of a recording"
        ),
    ],
    to: Annotated[str, typer.Argument(metavar="hf://USER/NAME", help="repository, which is made if there is none")],
    *,
    public: Annotated[bool, typer.Option("--public", help="everyone may read it (default: private)")] = False,
    licence: Annotated[
        str | None,
        typer.Option(help="licence of the model, or of a recording that states none, such as cc-by-4.0"),
    ] = None,
) -> None:
    """Write a checkpoint or a recording to the Hugging Face Hub, with a card."""
    from retrieval.data.hub import parse_address, upload

    address = parse_address(to)
    if address.revision:
        raise BadInput(f"a push makes the newest revision; leave @{address.revision} out")
    is_recording = Path(source).is_dir()
    files = (_recording_files if is_recording else _model_files)(source, address, licence)
    visibility = upload(address, files, kind="dataset" if is_recording else "model", is_public=public)
    say(f"{address}: {len(files)} files, {visibility}")


def _model_files(model: str, address: "Address", licence: str | None) -> dict[str, bytes | Path]:
    from retrieval.data.card import common_licence
    from retrieval.data.hub import CARD_FILE, CHECKPOINT_FILE
    from retrieval.model.card import checkpoint_licences, model_card
    from retrieval.model.checkpoint import load_checkpoint
    from retrieval.search.opening import find_model

    checkpoint = load_checkpoint(find_model(model)[0])
    licence = licence or common_licence(checkpoint_licences(checkpoint))
    if licence is None:
        raise BadInput(_NO_LICENCE.format(model))
    card = model_card(address.repository.rpartition("/")[2], checkpoint, checkpoint.split, licence)
    return {CHECKPOINT_FILE: checkpoint.path, CARD_FILE: card.encode(errors="replace")}


def _recording_files(folder: str, address: "Address", licence: str | None) -> dict[str, bytes | Path]:
    """Return what a reader of a recording reads, and the card, by name in the repository."""
    from retrieval.data.card import recording_card
    from retrieval.data.dataset import NOT_STATED, recording_licence
    from retrieval.data.hub import CARD_FILE
    from robot.recording.folder import INFO_FILE, METADATA_FILE, read_recording

    recording, stated = read_recording(folder), recording_licence(Path(folder)).licence
    if stated != NOT_STATED and licence:
        raise BadInput(f"{folder} states the licence {stated}; leave --licence out")
    licence = licence or stated
    if licence == NOT_STATED:
        raise BadInput(_NO_LICENCE.format(folder))
    info, rows = recording.info | {"licence": licence}, [grasp.to_row() for grasp in recording.grasps]
    names = {name for grasp in recording.grasps for name in grasp.images().values()}
    if missing := [name for name in names if not (recording.folder / name).is_file()]:
        raise BadInput(f"{folder} lacks {min(missing)}; run `retrieve check {folder}`")
    return {
        INFO_FILE: json.dumps(info, indent=2).encode(),
        METADATA_FILE: "".join(f"{json.dumps(row, ensure_ascii=False)}\n" for row in rows).encode(),
        CARD_FILE: recording_card(address.repository, info, rows, names).encode(errors="replace"),
        **{name: recording.folder / name for name in sorted(names)},
    }
