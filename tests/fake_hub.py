"""A server that answers the calls of the Hub's API that `huggingface_hub` makes, and a process that uses it."""

import base64
import hashlib
import json
import os
import re
import subprocess
import sys
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import yaml

TOKEN = "hf_of_the_owner"
MAIN = ("main", "1" * 40)
"""Names of the only revision."""
_PROGRAM = (
    "import json, sys; from retrieval.commands.main import main\nprint(json.dumps([main(words) for words in {}]))"
)


class Repository:
    """Files of a repository by name, and its visibility."""

    def __init__(self, is_private):
        self.is_private, self.files = is_private, {}


class FakeHub(ThreadingHTTPServer):
    """The server.

    Attributes:
        repositories: By kind ("models", "datasets") and name.
        requests: Method and path of each request.
    """

    daemon_threads = True

    def __init__(self):
        super().__init__(("127.0.0.1", 0), _Handler)
        self.repositories, self.objects, self.requests = {}, {}, []
        self.url = f"http://127.0.0.1:{self.server_port}"

    def run(self, home, *commands, token=TOKEN, **environment):
        """Run command lines in one process, which has no access to the real Hub; return exit codes and stderr."""
        environment = {
            **{name: value for name, value in os.environ.items() if not name.startswith("HF_")},
            "HF_ENDPOINT": self.url,
            "HF_HOME": str(home),
            "HF_HUB_DISABLE_XET": "1",
            **({"HF_TOKEN": token} if token else {}),
            **environment,
        }
        program = _PROGRAM.format([list(map(str, words)) for words in commands])
        done = subprocess.run(
            [sys.executable, "-c", program],
            env=environment,
            cwd=Path(__file__).parents[1],
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        assert "Traceback" not in done.stderr, done.stderr
        return json.loads(done.stdout.splitlines()[-1]), done.stderr


@contextmanager
def fake_hub():
    """Yield a running server."""
    with FakeHub() as hub:
        thread = threading.Thread(target=hub.serve_forever)
        thread.start()
        try:
            yield hub
        finally:
            hub.shutdown()
            thread.join(60)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def log_message(self, *_): ...

    def _answer(self, document=None, status=200, content=None, **headers):
        content = json.dumps(document).encode() if content is None else content
        self.send_response(status)
        for name, value in {"Content-Length": str(len(content)), **headers}.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    def _refuse(self, code, status=404):
        self._answer({"error": code}, status, X_Error_Code=code)

    def _handle(self):
        hub, path = self.server, self.path.partition("?")[0]
        hub.requests.append((self.command, path))
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        is_owner = self.headers.get("Authorization") == f"Bearer {TOKEN}"
        if path.startswith("/objects/") and self.command == "PUT":
            assert hashlib.sha256(body).hexdigest() == path.rpartition("/")[2]
            hub.objects[path.rpartition("/")[2]] = body
            return self._answer({})
        if self.command == "POST" and not is_owner:
            return self._refuse("Unauthorized", 401)
        if path == "/api/repos/create":
            wanted = json.loads(body)
            key = (f"{wanted.get('type') or 'model'}s", f"{wanted['organization']}/{wanted['name']}")
            status = 409 if key in hub.repositories else 200
            is_private = wanted.get("private") or wanted.get("visibility") == "private"
            hub.repositories.setdefault(key, Repository(is_private))
            return self._answer({"url": f"{hub.url}/{key[1]}"}, status)
        if path == "/api/validate-yaml":
            header = yaml.safe_load(json.loads(body)["content"].split("---")[1])
            wrong = [] if isinstance(header, dict) and header["license"] else [{"message": "license is missing"}]
            return self._answer({"errors": wrong, "warnings": []}, 400 if wrong else 200)
        kind, name, rest = re.fullmatch(r"/(?:api/)?(models/|datasets/|)([\w-]+/[\w-]+)(.*)", path).groups()
        repository = hub.repositories.get((kind.strip("/") or "models", name))
        if repository is None or (repository.is_private and not is_owner):
            return self._refuse("RepoNotFound", 404 if is_owner else 401)
        if rest.endswith("/info/lfs/objects/batch"):
            wanted = json.loads(body)["objects"]
            action = [{**each, "actions": {"upload": {"href": f"{hub.url}/objects/{each['oid']}"}}} for each in wanted]
            return self._answer({"transfer": "basic", "objects": action}, Content_Type="application/vnd.git-lfs+json")
        if rest == "/preupload/main":
            modes = {True: "lfs", False: "regular"}
            files = [{"path": file["path"], "shouldIgnore": False} for file in json.loads(body)["files"]]
            return self._answer(
                {"files": [file | {"uploadMode": modes[file["path"].endswith(".safetensors")]} for file in files]}
            )
        if rest == "/commit/main":
            for line in map(json.loads, body.splitlines()):
                value = line["value"]
                if line["key"] == "file":
                    repository.files[value["path"]] = base64.b64decode(value["content"])
                elif line["key"] == "lfsFile":
                    repository.files[value["path"]] = hub.objects[value["oid"]]
                elif line["key"] == "deletedFile":
                    del repository.files[value["path"]]
            return self._answer({"success": True, "commitUrl": f"{hub.url}/{name}/commit/1", "commitOid": MAIN[1]})
        if match := re.fullmatch("/resolve/([^/]+)/(.+)", rest):
            revision, file = match.groups()
            if revision not in MAIN:
                return self._refuse("RevisionNotFound")
            if file not in repository.files:
                return self._refuse("EntryNotFound")
            content = repository.files[file]
            etag = f'"{hashlib.sha256(content).hexdigest()}"'
            return self._answer(content=content, ETag=etag, X_Repo_Commit=MAIN[1])
        assert not rest, path
        siblings = [{"rfilename": file} for file in repository.files]
        return self._answer({"id": name, "sha": MAIN[1], "private": repository.is_private, "siblings": siblings})

    do_GET = do_HEAD = do_POST = do_PUT = _handle
