"""A local S3 server (moto) with injected faults."""

import io
import threading
from contextlib import contextmanager

import pytest

CREDENTIALS = {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test", "AWS_DEFAULT_REGION": "us-east-1"}
MIN_TORN_BYTES = 200
"""Minimum size of an upload that is truncated."""


class S3Faults:
    """A wrapper of the server's application that injects faults.

    Attributes:
        refuse: Refuse every n-th request; None for none.
        tear: Truncate every n-th upload to its first half, as if the sender had died; None for none.
        conditions: Conditional uploads are "honoured", refused as not implemented ("unknown"), or treated as
            unconditional ("ignored").
        refused: Number of refused requests.
        torn: Number of truncated uploads.
        conditional: Number of conditional uploads.
    """

    def __init__(self, application):
        self.application, self.refuse, self.tear = application, None, None
        self.conditions = "honoured"
        self.requests = self.uploads = self.refused = self.torn = self.conditional = 0
        self._lock = threading.Lock()

    def __call__(self, environ, start):
        with self._lock:
            self.requests += 1
            refused = bool(self.refuse) and self.requests % self.refuse == 0
            self.refused += refused
            size = int(environ.get("CONTENT_LENGTH") or 0)
            is_upload = environ["REQUEST_METHOD"] == "PUT" and size > MIN_TORN_BYTES and not refused
            self.uploads += is_upload
            torn = bool(self.tear) and is_upload and self.uploads % self.tear == 0
            self.torn += torn
        body = environ["wsgi.input"].read(size)  # unread bytes would be parsed as the next request
        environ["wsgi.input"] = io.BytesIO(body)
        if refused:
            start("503 Slow Down", [("Content-Type", "application/xml")])
            return [b"<Error><Code>SlowDown</Code><Message>Please reduce your request rate.</Message></Error>"]
        if environ["REQUEST_METHOD"] == "PUT" and (headers := CONDITIONS & environ.keys()):
            self.conditional += 1
            if self.conditions == "unknown":
                start("501 Not Implemented", [("Content-Type", "application/xml")])
                return [b"<Error><Code>NotImplemented</Code><Message>A header is not implemented.</Message></Error>"]
            if self.conditions == "ignored":
                for name in headers:
                    del environ[name]
        if torn:
            environ["wsgi.input"], environ["CONTENT_LENGTH"] = io.BytesIO(body[: size // 2]), str(size // 2)
            for name in [name for name in environ if "CHECKSUM" in name or name in ("HTTP_CONTENT_MD5", TRAILER)]:
                del environ[name]
        return self.application(environ, start)


TRAILER = "HTTP_X_AMZ_TRAILER"
CONDITIONS = {"HTTP_IF_MATCH", "HTTP_IF_NONE_MATCH"}


@contextmanager
def run_server():
    """Run the server and yield its faults; the environment contains its address for S3 clients."""
    pytest.importorskip("moto.server", reason="needs moto[server]")
    pytest.importorskip("s3fs", reason="needs s3fs")
    import s3fs
    from moto.moto_server.werkzeug_app import DomainDispatcherApplication, create_backend_app
    from werkzeug.serving import WSGIRequestHandler, make_server

    class Quiet(WSGIRequestHandler):
        def log(self, *_):
            pass

    faults = S3Faults(DomainDispatcherApplication(create_backend_app))
    server = make_server("127.0.0.1", 0, faults, threaded=True, request_handler=Quiet)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    patch = pytest.MonkeyPatch()
    for name, value in {**CREDENTIALS, "AWS_ENDPOINT_URL": f"http://127.0.0.1:{server.server_port}"}.items():
        patch.setenv(name, value)
    try:
        yield faults
    finally:
        patch.undo()
        s3fs.S3FileSystem.clear_instance_cache()
        server.shutdown()
        thread.join()
        server.server_close()


def put(folder, target):
    """Upload the files of a folder to bucket/path; create the bucket."""
    import s3fs

    system = s3fs.S3FileSystem()
    system.makedirs(target.partition("/")[0], exist_ok=True)
    for path in folder.rglob("*"):
        if path.is_file():
            system.pipe_file(f"{target}/{path.relative_to(folder)}", path.read_bytes())
