"""What the trainings of small networks for photos share: their command, their loop, and the file of a network."""

import argparse
import io
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from models.pictures import LabelledPicture, load_pictures
from retrieval.console.progress import Bar, show_progress


def convolution(channels: int, out: int, stride: int = 1) -> nn.Sequential:
    """Return a convolution with batch normalisation and ReLU."""
    layer = nn.Conv2d(channels, out, 3, stride=stride, padding=1, bias=False)
    return nn.Sequential(layer, nn.BatchNorm2d(out), nn.ReLU())


def run_command(
    argv: Sequence[str] | None,
    description: str | None,
    make: Callable[[Sequence[LabelledPicture]], bytes],
    score: Callable[[Path, Sequence[LabelledPicture]], str],
) -> int:
    """Train and write a network, or print the score of one, on the photos of some folders.

    Args:
        argv: The arguments; None for those of the process.
        description: Help of the command.
        make: Returns the file of a network that was trained on photos.
        score: Returns the score on photos of the network of a file.
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", nargs="+", type=Path)
    chosen = parser.add_mutually_exclusive_group(required=True)
    chosen.add_argument("--out", type=Path, help="train, and write the network to this file")
    chosen.add_argument("--score", type=Path, help="score the network of this file")
    options = parser.parse_args(argv)
    show_progress()
    pictures = [each for folder in options.photos for each in load_pictures(folder)]
    if options.out:
        options.out.write_bytes(make(pictures))
    else:
        print(score(options.score, pictures))
    return 0


def fit(
    network: nn.Module, loss_of_step: Callable[[], Tensor], what: str, steps: int, rate: float, weight_decay: float
) -> None:
    """Train a network by the losses of `steps` steps, with a rate that rises to `rate` and falls again."""
    optimizer = torch.optim.AdamW(network.parameters(), rate, weight_decay=weight_decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, total_steps=steps)
    with Bar(f"train the {what}", steps, "steps") as bar:
        for _ in range(steps):
            loss = loss_of_step()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            bar.advance(note=f"loss {loss.item():.3f}")
    network.eval()


def to_onnx(network: nn.Module, example: Tensor) -> bytes:
    """Return the file of a network that takes photos like `example`."""
    file = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the tracing exporter is deprecated; the new one needs one more package
        torch.onnx.export(network.eval(), (example,), file, opset_version=11, dynamo=False, input_names=["photo"])
    return file.getvalue()
