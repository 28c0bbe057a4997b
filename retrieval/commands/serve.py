"""`retrieve serve`: answer queries over HTTP, with a page."""

import os
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from msgspec import Meta

from retrieval.commands.options import SECONDS, WORKERS, Index, IndexModel, NumberParser, refuse_options, resolve_index
from retrieval.console.output import say
from retrieval.errors import BadInput

if TYPE_CHECKING:
    from robot.recording.folder import RecordingWriter

TOKEN_VARIABLE = "RETRIEVE_TOKEN"
"""Environment variable with the token that clients must send."""


def serve(
    *,
    index: Index = None,
    model: IndexModel = None,
    host: Annotated[
        str,
        typer.Option(
            help="address to listen on; one that other machines can reach needs a token, which clients must send, in "
            f"the environment variable {TOKEN_VARIABLE}"
        ),
    ] = "127.0.0.1",
    port: Annotated[
        int, typer.Option(parser=NumberParser(Annotated[int, Meta(ge=0, lt=2**16)]), help="port; 0 chooses a free one")
    ] = 8000,
    rig: Annotated[
        str | None,
        typer.Option(
            help="rig by name or TOML file, for live images (default: sim, if the index contains its objects)"
        ),
    ] = None,
    history: Annotated[
        Path | None, typer.Option(help="folder that stores queries and feedback (default: INDEX-history)")
    ] = None,
    no_history: Annotated[bool, typer.Option("--no-history", help="store no queries and no feedback")] = False,
    deadline: Annotated[
        float, typer.Option(metavar="SECONDS", parser=SECONDS, help="maximum time for one request")
    ] = 30.0,
    cluster: Annotated[
        bool,
        typer.Option(
            "--cluster", help="serve a sharded index on the Ray cluster at RAY_ADDRESS, else on Ray on this machine"
        ),
    ] = False,
    replicas: Annotated[
        int | None, typer.Option(parser=WORKERS, help="with --cluster: processes per shard (default: 1)")
    ] = None,
    shard_timeout: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS", parser=SECONDS, help="with --cluster: maximum time to wait for a shard (default: 5)"
        ),
    ] = None,
) -> None:
    """Answer queries over HTTP and serve a page, until Ctrl-C or SIGTERM."""
    try:
        from retrieval.serve.app import create_app
        from retrieval.serve.server import serve as run
        from retrieval.serve.settings import ServiceSettings
    except ImportError as error:
        raise BadInput(f"{error.name} is missing; run: pip install 'touch-retrieval[serve]'") from error
    from retrieval.serve.rig import load_live_rig

    if no_history:
        refuse_options("contradicts --no-history; give one of them", history=history)
    if not cluster:
        refuse_options("needs --cluster", replicas=replicas, shard_timeout=shard_timeout)
    path = resolve_index(index)
    local = path.resolve()
    settings = ServiceSettings(
        index=path,
        model=Path(model) if model else None,
        host=host,
        port=port,
        token=os.environ.get(TOKEN_VARIABLE),
        deadline_s=deadline,
        history=None if no_history else history or local.with_name(f"{local.name}-history"),
    )
    with ExitStack() as stack:
        writer = _feedback_writer(settings.history, path, stack) if settings.history else None
        open_shards = None
        if cluster:
            from indexes.store.sharded import is_sharded
            from retrieval.cluster.serving import Deployments, ReplicaSettings
            from retrieval.cluster.session import ray_session

            if not is_sharded(path):
                raise BadInput(f"{path} has no shards; build a sharded index with `retrieve build-index --shards`")
            deployments = Deployments(
                stack.enter_context(ray_session()), ReplicaSettings(replicas=replicas or 1, wait_s=shard_timeout or 5.0)
            )
            stack.callback(deployments.close)
            open_shards = deployments.open
        app = create_app(settings, load_live_rig(rig, path), writer, open_shards)

        def on_start(bound_port: int) -> None:
            say(f"listening on http://{f'[{host}]' if ':' in host else host}:{bound_port}")

        run(app, on_start)


def _feedback_writer(folder: Path, index: str | Path, stack: ExitStack) -> "RecordingWriter":
    """Open the writer of the recording of people's feedback."""
    from retrieval.model.checkpoint_info import read_checkpoint_info
    from retrieval.search.opening import manifest_of, model_of
    from retrieval.serve.store import ADVICE
    from robot.errors import RobotError
    from robot.recording.folder import RecordingWriter

    stored = read_checkpoint_info(model_of(manifest_of(index)))
    info = {"source": "feedback on queries", "sensor": f"as {stored.provenance.get('source', 'unknown')}"}
    try:
        writer = stack.enter_context(RecordingWriter(folder / "recording", info))
    except RobotError as error:
        raise BadInput(f"{error}. {ADVICE}") from error
    say(f"queries and feedback are stored in {folder}")
    return writer
