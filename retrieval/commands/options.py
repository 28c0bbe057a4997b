"""What several commands share: options, options of several values, and what is read where an option names it."""

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

import typer
from typer.core import TyperCommand

from _touch_retrieval.files import read_json
from retrieval.console.output import say
from retrieval.errors import BadInput

if TYPE_CHECKING:
    from retrieval.data.dataset import Split
    from retrieval.model.config import Config

DEFAULT_PRESET = "small"
DEFAULT_MODEL = "that of the index here, else the last one trained from this folder, else the shipped one"
SPLIT = "JSON file with train, validation and test objects"

Json = Annotated[bool, typer.Option("--json", help="print one JSON document")]
Index = Annotated[
    str | None,
    typer.Option(help="index folder, or a cluster's URL (default: ./index, else the last one built from this folder)"),
]
IndexModel = Annotated[str | None, typer.Option(help="checkpoint (default: the one the index was built with)")]
NoVerify = Annotated[bool, typer.Option("--no-verify", help="skip the checksums of a huge index")]
Model = Annotated[
    str | None,
    typer.Option(
        help=f"checkpoint; shipped and shipped-one-finger name those of the package (default: {DEFAULT_MODEL})"
    ),
]
Init = Annotated[
    str | None, typer.Option(help="first weights of the towers: random, imagenet, shipped, or a state dict file")
]
InitTower = Annotated[
    str | None, typer.Option(help="first weights of one tower alone: a file, as `train --task relief` writes it")
]
LabelledPhotos = Annotated[
    str | None,
    typer.Option("--photos", help="labelled photos (`collect --photos-only`) to train on too, with --touches"),
]
LabelledTouches = Annotated[
    str | None,
    typer.Option("--touches", help="labelled touches (`collect --touches-only`) to pair with them by labels"),
]
Recording = Annotated[Path, typer.Argument(help="recording folder", show_default=False)]
SplitFile = Annotated[Path | None, typer.Option(help=SPLIT)]
CheckpointOut = Annotated[Path, typer.Option(help="checkpoint to write (.safetensors)")]
ReportOut = Annotated[Path, typer.Option(help="folder for results.json, report.md and report.html")]

_SEPARATOR = "\0"  # which no word of a command line holds


class OptionValues(tuple[str, ...]):
    """The values after one option that takes several, such as the gel images of one grasp."""

    @classmethod
    def parse(cls, joined: str) -> Self:
        """As `Command` hands them over."""
        return cls(joined.split(_SEPARATOR))


@dataclasses.dataclass(frozen=True)
class NumberParser:
    """Read the number of an option, from `low` to `high`, so that no command begins with another one.

    kind: int or float. (A range of the library admits nan, and shows its limits in the help.)
    """

    kind: type[int] | type[float]
    low: float
    high: float

    @property
    def __name__(self) -> str:
        """As the help names it."""
        return self.kind.__name__

    def __call__(self, text: str) -> float:
        """Return the number. Raises BadParameter."""
        try:
            value = self.kind(text)
        except ValueError as error:
            raise typer.BadParameter(f"{text!r} is not a valid {self.__name__}") from error
        if not self.low <= value <= self.high:
            raise typer.BadParameter(f"{text} is not from {self.low} to {self.high}")
        return value


COUNT, SEED, WORKERS = NumberParser(int, 1, 10**9), NumberParser(int, 0, 2**32 - 1), NumberParser(int, 1, 1024)
SHARE, SECONDS = NumberParser(float, 0, 1), NumberParser(float, 0, 86_400)
Iterations = Annotated[int | None, typer.Option(parser=COUNT, help="optimiser steps, instead of the preset's")]
Jobs = Annotated[int, typer.Option(parser=WORKERS, help="simulated rigs that work at once")]
Objects = Annotated[int, typer.Option(parser=COUNT, help="how many objects")]


class Command(TyperCommand):
    """A command whose options of several values, those with a metavar in "...", take the words up to the next option.

    What is named like an option is no option's value: `--out --preview` has forgotten the folder.
    """

    def get_short_help_str(self, limit: int = 0) -> str:
        """Its help in a list of commands, not cut."""
        return self.help or ""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Join the values of such an option to one word; see `OptionValues.parse`."""
        options = {name: each for each in self.params for name in each.opts if name.startswith("-")}
        joined: list[str] = []
        while args and args[0] != "--":
            word, *args = args
            joined.append(word)
            option = options.get(word)
            if option is None or getattr(option, "is_flag", False):
                continue
            if (not args or args[0] in options) and not ctx.resilient_parsing:
                ctx.fail(f"{word} needs a value")
            if (option.metavar or "").endswith("..."):
                values = list(takewhile(lambda value: not value.startswith("-"), args))
                joined.append(_SEPARATOR.join(values))
                args = args[len(values) :]
            else:
                joined += args[:1]
                args = args[1:]
        return super().parse_args(ctx, joined + args)


def refuse_options(why: str, **given: object) -> None:
    """Raise BadInput for the first of these options that was given: it would be ignored, and `why` says so. An option
    that was left out is None or False.
    """
    for name, value in given.items():
        if value is not None and value is not False:
            raise BadInput(f"--{name.replace('_', '-')} {why}")


@contextmanager
def announce_resume(what: str) -> Iterator[None]:
    """Say on Ctrl-C what is stored, and that the same command continues from there."""
    try:
        yield
    except KeyboardInterrupt:
        say(f"{what}; the same command goes on with it")
        raise


def read_split(path: Path | None) -> "Split | None":
    """The split of objects that `--split` names. Raises BadInput."""
    if path is None:
        return None
    from retrieval.data.dataset import Split

    try:
        return Split.from_dict(read_json(path))
    except ValueError as error:
        raise BadInput(f"{path} is not a JSON file: {error}") from error


def training_config(preset: str | None, iterations: int | None, **instead: str | int | None) -> "Config":
    """A preset or TOML file, and what options say instead of it, each a setting of training. Raises ConfigError."""
    from retrieval.model.config import load_config

    config = load_config(preset or DEFAULT_PRESET)
    changed: dict[str, Any] = {name: value for name, value in instead.items() if value is not None}
    steps = config.training.iterations if iterations is None else iterations
    return dataclasses.replace(config, training=dataclasses.replace(config.training.with_iterations(steps), **changed))
