"""`retrieve serve`: the answers over HTTP, and a page."""

import os
import webbrowser
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Annotated, Any

import typer

from retrieval.commands.options import (
    COUNT,
    SECONDS,
    SHARE,
    WORKERS,
    Index,
    IndexModel,
    NoVerify,
    NumberParser,
    refuse_options,
)
from retrieval.console.output import say
from retrieval.errors import BadInput, ConfigError

if TYPE_CHECKING:
    from retrieval.search.query.opening import OpenShards
    from robot.recording.folder import RecordingWriter

TOKEN_VARIABLE = "RETRIEVE_TOKEN"
"""Variable of the environment that may hold the token."""


def serve(
    *,
    index: Index = None,
    model: IndexModel = None,
    host: Annotated[str, typer.Option(help="where to listen; other machines reach it only with a token")] = "127.0.0.1",
    port: Annotated[int, typer.Option(parser=NumberParser(int, 0, 2**16 - 1), help="port; 0 for a free one")] = 8000,
    token_file: Annotated[
        Path | None, typer.Option(help=f"file with the token that requests must carry (or variable {TOKEN_VARIABLE})")
    ] = None,
    rig: Annotated[
        str | None, typer.Option(help="rig by name or TOML file, for live pictures (default: sim for its own objects)")
    ] = None,
    history: Annotated[
        Path | None, typer.Option(help="folder for queries and what is said of them (default: INDEX-history)")
    ] = None,
    no_history: Annotated[bool, typer.Option("--no-history", help="keep nothing")] = False,
    trials: Annotated[
        Path | None, typer.Option(metavar="RECORDING", help="test people with objects the model never saw")
    ] = None,
    queue: Annotated[
        int, typer.Option(parser=COUNT, help="requests that are held at once; more are told to come again")
    ] = 8,
    workers: Annotated[int, typer.Option(parser=WORKERS, help="requests in work at once")] = 1,
    batch_ms: Annotated[
        float,
        typer.Option(
            parser=NumberParser(float, 0, 1000), help="how long a query waits for others to be encoded with it"
        ),
    ] = 0.0,
    deadline: Annotated[
        float, typer.Option(metavar="SECONDS", parser=SECONDS, help="after which no answer is waited for")
    ] = 30.0,
    cluster: Annotated[
        bool, typer.Option("--cluster", help="Ray holds the shards of a cluster: that of RAY_ADDRESS, else one here")
    ] = False,
    replicas: Annotated[
        int | None, typer.Option(parser=WORKERS, help="of --cluster: processes that hold the same shard (default: 1)")
    ] = None,
    max_replicas: Annotated[
        int | None,
        typer.Option(
            parser=WORKERS, help="of --cluster: to how many they grow while requests wait (default: they do not)"
        ),
    ] = None,
    shard_timeout: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS", parser=SECONDS, help="of --cluster: how long a shard is waited for (default: 5)"
        ),
    ] = None,
    min_share: Annotated[
        float | None,
        typer.Option(
            metavar="SHARE",
            parser=SHARE,
            help="of --cluster: of the catalogue, that an answer must have searched (default: 1, all)",
        ),
    ] = None,
    open_page: Annotated[bool, typer.Option("--open-page", help="open the page in a browser")] = False,
    no_verify: NoVerify = False,
) -> None:
    """Answer over HTTP, and show a page, until Ctrl-C or SIGTERM."""
    try:
        from retrieval.serve.app import create_app
        from retrieval.serve.server import serve as run
        from retrieval.serve.settings import ServiceSettings
    except ImportError as error:
        raise BadInput(f"{error.name} is missing; run: pip install 'touch-retrieval[serve]'") from error
    from retrieval.data.storage import is_url
    from retrieval.search import defaults
    from retrieval.serve.rig import load_live_rig, simulated_live_rig

    if no_history:
        refuse_options("names where to keep what --no-history keeps nowhere; give one of them", history=history)
    how = {"replicas": replicas, "max_replicas": max_replicas, "shard_timeout": shard_timeout, "least_share": min_share}
    if not cluster:
        refuse_options("is for shards that Ray holds; give --cluster too", **how)
    path, why = defaults.find_index(index)
    if index is None:
        say(f"index: {path} ({why})")
    kept = Path(PurePosixPath(path).name if is_url(path) else path).resolve()
    settings = ServiceSettings(
        index=path,
        model=Path(model) if model else None,
        verify=not no_verify,
        host=host,
        port=port,
        token=_read_token(token_file),
        queue=queue,
        workers=workers,
        batch_ms=batch_ms,
        deadline_s=deadline,
        history=None if no_history else history or kept.with_name(f"{kept.name}-history"),
    )
    with ExitStack() as closed:
        recorder = _feedback_writer(settings.history, path, closed) if settings.history else None
        held = _ray_shards(path, closed, how, not no_verify) if cluster else None
        app = create_app(
            settings, load_live_rig(rig, path) if rig else simulated_live_rig(path), recorder, trials, held
        )

        def started(bound: int) -> None:
            address = f"http://{f'[{host}]' if ':' in host else host}:{bound}"
            say(f"listening on {address}")
            if open_page:
                webbrowser.open(address)

        run(app, started)


def _ray_shards(index: str | Path, closed: ExitStack, how: Mapping[str, Any], verify: bool) -> "OpenShards":
    """What opens shards on Ray, which is joined or started. how: options of it by name, None for those left out. Raises
    BadInput where there is no cluster to hold.
    """
    from retrieval.cluster.serving import Deployments, ReplicaSettings
    from retrieval.cluster.session import ray_session
    from retrieval.search.sharding.object_store import is_sharded

    if not is_sharded(index):
        raise BadInput(f"{index} is one index folder; make a cluster by `retrieve build-index --shards`")
    given = {name.replace("shard_timeout", "wait_s"): value for name, value in how.items() if value is not None}
    settings = ReplicaSettings(**given)
    deployments = Deployments(closed.enter_context(ray_session()), settings, verify)
    closed.callback(deployments.close)
    return deployments.open


def _feedback_writer(folder: Path, index: str | Path, closed: ExitStack) -> "RecordingWriter":
    """The writer of the recording of what people say. Raises RobotError."""
    from retrieval.model.checkpoint_info import read_checkpoint_info
    from retrieval.search.defaults import manifest_of, model_of
    from robot.recording.folder import RecordingWriter

    if folder.exists() and not folder.is_dir():
        raise BadInput(f"the history must be a folder, but {folder} is a file; name another one with --history")
    stored = read_checkpoint_info(model_of(manifest_of(index)))
    info = {"source": "what people said of queries", "sensor": f"as {stored.provenance.get('source', 'unknown')}"}
    say(f"queries and what is said of them are kept in {folder}")
    return closed.enter_context(RecordingWriter(folder / "recording", info))


def _read_token(file: Path | None) -> str | None:
    if file is None:
        return os.environ.get(TOKEN_VARIABLE)
    from _touch_retrieval.files import read_regular

    try:
        return read_regular(file).decode("ascii").strip()
    except (OSError, ValueError) as error:
        raise ConfigError(f"{file} must hold a token in ASCII: {error}") from error
