"""Ray, joined where there is one, else started here for as long as it is wanted."""

import gc
import logging
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from retrieval.errors import BadInput, RetrievalError

OBJECT_STORE_BYTES = 200 * 2**20
"""Of a Ray that is started here: what travels is small."""
ADDRESS, LOOPBACK = "RAY_ADDRESS", "127.0.0.1"
_SETTINGS = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_SERVE_LOG_TO_STDERR": "0",
    "RAY_TRAIN_V2_ENABLED": "1",
    "RAY_DATA_DISABLE_PROGRESS_BARS": "1",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_ENABLE_AUTO_CONNECT": "0",
}
"""Quiet, and started by `ray_session` alone: a thread of Ray's own that outlives it would start another Ray."""
_LOOPBACK = {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}
"""Ray's own switch for a cluster of this machine alone, which then listens on 127.0.0.1."""


@contextmanager
def _without_ray_warnings() -> Iterator[None]:
    """Without the warnings of Ray's own making, most of which are about Ray."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module=r"(ray|pydantic|google)(\.|$)")
        yield


@contextmanager
def ray_session(cpus: int | None = None) -> Iterator[Any]:
    """Ray with its parts `data` and `serve`, connected to the cluster that the variable RAY_ADDRESS names ("auto": one
    of this machine), else to one that is started here, on 127.0.0.1 alone, and ends with the block. Where this process
    is connected already, it stays so.

    cpus: of a Ray that is started here, None: all. Raises BadInput without Ray, RetrievalError where it cannot be had.
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
    said: dict[str, Any] = {"logging_level": logging.ERROR, "log_to_driver": False, "ignore_reinit_error": True}
    if not joined:
        said |= {
            "num_cpus": cpus,
            "object_store_memory": OBJECT_STORE_BYTES,
            "include_dashboard": False,
            "runtime_env": {"worker_process_setup_hook": "retrieval.cluster.session.on_loopback"},
        }
    ours = not ray.is_initialized()
    try:
        with _without_ray_warnings():
            ray.init(address=joined, **said)
    except (ConnectionError, OSError, RuntimeError, ValueError) as error:
        what = f"the Ray cluster at {joined} cannot be joined" if joined else "Ray cannot be started here"
        raise RetrievalError(f"{what}: {error}") from error
    for part in ("ray", "ray.data", "ray.serve"):
        logging.getLogger(part).setLevel(logging.ERROR)
    try:
        if not joined and (address := ray.util.get_node_ip_address()) != LOOPBACK:
            raise RetrievalError(
                f"Ray would listen on {address}, for this process had imported it already: "
                f"set {', '.join(_LOOPBACK)}=0 before that, or start Ray yourself and name it in RAY_ADDRESS"
            )
        with _without_ray_warnings():
            yield ray
    finally:
        if ours:
            ray.shutdown()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", ResourceWarning)
                gc.collect()  # Ray waits for none of the processes that it started


def on_loopback() -> None:
    """In each process of a Ray that is started here: replicas of Ray Serve listen on 127.0.0.1 too, for which Ray has
    no setting.
    """
    try:
        from ray.serve._private import replica
    except ImportError:
        return
    listen = getattr(replica, "add_port_to_grpc_server", None)
    if listen is not None:
        replica.add_port_to_grpc_server = lambda server, address: listen(server, address.replace("[::]", LOOPBACK))
