"""Ray sessions: join an existing Ray cluster, or start Ray on this machine for the length of a block."""

import gc
import logging
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from retrieval.errors import BadInput, RetrievalError

ADDRESS, LOOPBACK = "RAY_ADDRESS", "127.0.0.1"
_SETTINGS = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_SERVE_LOG_TO_STDERR": "0",
    "RAY_TRAIN_V2_ENABLED": "1",
    "RAY_DATA_DISABLE_PROGRESS_BARS": "1",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_ENABLE_AUTO_CONNECT": "0",
}
"""Settings for little output and no automatic start, with which a thread that outlives Ray would start it again."""
_LOOPBACK = {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}
"""Ray's setting for a cluster of this machine only, which then listens on 127.0.0.1."""


@contextmanager
def _without_ray_warnings() -> Iterator[None]:
    """Suppress the warnings of Ray and its libraries."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module=r"(ray|pydantic|google)(\.|$)")
        yield


@contextmanager
def ray_session() -> Iterator[Any]:
    """Connect to a Ray cluster, and yield the module `ray` with `ray.data` and `ray.serve`.

    The environment variable RAY_ADDRESS names the cluster ("auto": one on this machine). Without it, Ray is started
    here, on 127.0.0.1 only, and ends with the block. An existing connection of this process is reused and stays open.

    Raises:
        BadInput: Ray is not installed.
        RetrievalError: The cluster cannot be joined, or Ray cannot be started.
    """
    os.environ.update({name: os.environ.get(name, value) for name, value in _SETTINGS.items()})
    joined = os.environ.get(ADDRESS)
    if not joined:
        os.environ.update(_LOOPBACK)
    try:
        with _without_ray_warnings():
            import ray
            import ray.data
            import ray.serve
    except ImportError as error:
        raise BadInput(f"{error.name} is missing; run: pip install 'touch-retrieval[cluster]'") from error
    options: dict[str, Any] = {"logging_level": logging.ERROR, "log_to_driver": False, "ignore_reinit_error": True}
    if not joined:
        options |= {
            "object_store_memory": 200 * 2**20,  # the transferred objects are small
            "include_dashboard": False,
            "runtime_env": {"worker_process_setup_hook": "retrieval.cluster.session.on_loopback"},
        }
    ours = not ray.is_initialized()
    try:
        with _without_ray_warnings():
            ray.init(address=joined, **options)
    except (ConnectionError, OSError, RuntimeError, ValueError) as error:
        what = f"the Ray cluster at {joined} cannot be joined" if joined else "Ray cannot be started here"
        raise RetrievalError(f"{what}: {error}") from error
    for part in ("ray", "ray.data", "ray.serve"):
        logging.getLogger(part).setLevel(logging.ERROR)
    try:
        if not joined and (address := ray.util.get_node_ip_address()) != LOOPBACK:
            raise RetrievalError(
                f"Ray would listen on {address}, because this process imported it before: "
                f"set {', '.join(_LOOPBACK)}=0 before the import, or start Ray yourself and set RAY_ADDRESS"
            )
        with _without_ray_warnings():
            yield ray
    finally:
        if ours:
            ray.shutdown()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", ResourceWarning)
                gc.collect()  # Ray does not wait for the processes that it started


def on_loopback() -> None:
    """Make replicas of Ray Serve listen on 127.0.0.1, for which Ray has no setting; runs in each Ray process."""
    try:
        from ray.serve._private import replica
    except ImportError:
        return
    listen = getattr(replica, "add_port_to_grpc_server", None)
    if listen is not None:
        replica.add_port_to_grpc_server = lambda server, address: listen(server, address.replace("[::]", LOOPBACK))
