"""Options that several commands have in common, their parsers, and the reading of files that options name."""

import dataclasses
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self, cast, get_args

import typer
from msgspec import Meta
from typer.core import TyperCommand

from _touch_retrieval.documents import Count, Fraction, Seed, typed
from _touch_retrieval.files import read_json
from retrieval.console.output import say
from retrieval.errors import BadInput

if TYPE_CHECKING:
    from retrieval.data.dataset import Split
    from retrieval.model.config import Config

DEFAULT_MODEL = "that of the index, else the shipped one"

Json = Annotated[bool, typer.Option("--json", help="print one JSON document on stdout")]
Index = Annotated[str | None, typer.Option(help="index folder (default: ./index)")]
IndexModel = Annotated[str | None, typer.Option(help="checkpoint (default: that of the index)")]
Model = Annotated[
    str | None,
    typer.Option(
        help="checkpoint file, hf://USER/NAME[@REVISION] on the Hugging Face Hub, or shipped or shipped-one-finger for "
        f"those of the package (default: {DEFAULT_MODEL})"
    ),
]
Init = Annotated[
    str | None, typer.Option(help="initial weights of the towers: random, imagenet, shipped, or a state dict file")
]
Recording = Annotated[Path, typer.Argument(help="recording folder", show_default=False)]
SplitFile = Annotated[Path | None, typer.Option(help="JSON file with train, validation and test objects")]
CheckpointOut = Annotated[Path, typer.Option(help="checkpoint to write (.safetensors)")]
ReportOut = Annotated[Path, typer.Option(help="folder for results.json, report.md and report.html")]

_SEPARATOR = "\0"  # a command line cannot contain it


class OptionValues(tuple[str, ...]):
    """The values of one option that takes several, such as the gel images of one grasp."""

    @classmethod
    def parse(cls, joined: str) -> Self:
        """Split the values that `Command.parse_args` joined."""
        return cls(joined.split(_SEPARATOR))


GELSIGHT = typer.Option(
    parser=OptionValues.parse,
    metavar="IMAGE...",
    help="gel images of one grasp, one per finger; repeat the option for more grasps of the same object",
)
GelSight = Annotated[list[OptionValues], GELSIGHT]
Background = Annotated[
    OptionValues | None,
    typer.Option(
        parser=OptionValues.parse,
        metavar="IMAGE...",
        help="no-contact frames, one per finger; some models subtract them, others use them to detect contact",
    ),
]


class NumberParser:
    """Parser of an option with a number that an annotation allows, such as `Annotated[int, Meta(ge=1)]`.

    The range types of typer accept nan, and print their limits in the help.
    """

    def __init__(self, annotation: Any) -> None:
        self._annotation, (self._kind, *_) = annotation, get_args(annotation)
        self.__name__ = self._kind.__name__  # the name of the type in the help

    def __call__(self, text: str) -> float:
        """Return the number. Raises BadParameter for another kind of value, or one out of range."""
        try:
            value = self._kind(text)
        except ValueError as error:
            raise typer.BadParameter(f"{text!r} is not a valid {self.__name__}") from error
        return cast(float, typed(value, self._annotation, error=typer.BadParameter))


COUNT, SEED, FRACTION = NumberParser(Count), NumberParser(Seed), NumberParser(Fraction)
WORKERS = NumberParser(Annotated[int, Meta(ge=1, le=1024)])
SECONDS = NumberParser(Annotated[float, Meta(gt=0, le=86_400)])
Opening = Annotated[
    list[float] | None,
    typer.Option(
        parser=NumberParser(Annotated[float, Meta(ge=0.5, le=300)]),  # as data.opening.RANGE_MM, which imports numpy
        metavar="MM",
        help="distance between the fingers, in millimetres; once for each --gelsight, in the same order, or not at all",
    ),
]
Iterations = Annotated[int | None, typer.Option(parser=COUNT, help="optimiser steps (default: those of the preset)")]
Jobs = Annotated[int, typer.Option(parser=WORKERS, help="simulated rigs that run in parallel")]
Objects = Annotated[int, typer.Option(parser=COUNT, help="number of objects")]


class Command(TyperCommand):
    """A command with options of several values: they take all words up to the next option.

    Such an option has a metavar that ends in "...". A word with the name of an option is never a value: in
    `--out --preview` the value of `--out` is missing.
    """

    def get_short_help_str(self, limit: int = 0) -> str:
        """Return the first paragraph of the help text for the list of commands; typer would cut it."""
        return (self.help or "").split("\n\n")[0]

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Join the values of each option of several values to one word; see `OptionValues.parse`.

        If an option that is given once is repeated, its values are added to the first ones.
        """
        options = {name: option for option in self.params for name in option.opts if name.startswith("-")}
        joined: list[str] = []
        place_of: dict[Any, int] = {}
        while args and args[0] != "--":
            word, *args = args
            joined.append(word)
            option = options.get(word)
            if option is None or getattr(option, "is_flag", False):
                continue
            if not args or args[0] in options:
                ctx.fail(f"{word} needs a value")
            if (option.metavar or "").endswith("..."):
                values = list(takewhile(lambda value: not value.startswith("-"), args))
                args = args[len(values) :]
                if option in place_of and not option.multiple:
                    joined.pop()
                    joined[place_of[option]] = _SEPARATOR.join([joined[place_of[option]], *values])
                else:
                    place_of[option] = len(joined)
                    joined.append(_SEPARATOR.join(values))
            else:
                joined += args[:1]
                args = args[1:]
        return super().parse_args(ctx, joined + args)


def refuse_options(reason: str, **options: object) -> None:
    """Raise BadInput for the given ones of options that would be ignored, with the reason after the option's name."""
    for name, value in options.items():
        if value is not None and value is not False:
            raise BadInput(f"--{name.replace('_', '-')} {reason}")


def resolve_index(index: str | None) -> Path:
    """Return the folder of the index; ./index, which is printed, if the user named none.

    Raises:
        BadInput: The user named none, and ./index is none.
    """
    from indexes.store.sharded import is_sharded
    from retrieval.search.opening import INDEX

    if index is not None:
        return Path(index)
    if not ((INDEX / "CURRENT").is_file() or is_sharded(INDEX)):
        raise BadInput(
            "there is no index in this folder; run `retrieve build-index CATALOGUE` first, or name one with --index"
        )
    say(f"index: {INDEX} (in this folder)")
    return INDEX


def resolve_model(model: str | None, index: Path = Path("index")) -> Path:
    """Return the file of the checkpoint, and print it with the reason.

    Args:
        model: A path or one of `SHIPPED_NAMES`; None for the checkpoint of `index`, else the shipped one.
        index: Index folder or sharded index.
    """
    from retrieval.search.opening import find_model

    path, reason = find_model(model, index)
    say(f"model: {path} ({reason})")
    return path


def read_split(path: Path | None) -> "Split | None":
    """Read the split of objects from the file of `--split`; None without a file. Raises BadInput for another file."""
    if path is None:
        return None
    from retrieval.data.dataset import Split

    try:
        return Split.from_dict(read_json(path))
    except ValueError as error:
        raise BadInput(f"{path} is not a JSON file: {error}") from error


def training_config(preset: str, iterations: int | None, **overrides: str | int | None) -> "Config":
    """Return the configuration of a preset or TOML file; options that are not None override settings of training."""
    from retrieval.model.config import load_config

    config = load_config(preset)
    changed: dict[str, Any] = {name: value for name, value in overrides.items() if value is not None}
    training = config.training if iterations is None else config.training.with_iterations(iterations)
    return dataclasses.replace(config, training=dataclasses.replace(training, **changed))
