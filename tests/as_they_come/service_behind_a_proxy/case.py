"""A service behind a proxy that serves it below a prefix: every address of the page and of answers works, also HEAD."""

import base64
import re
from urllib.parse import urljoin

from fastapi.testclient import TestClient

from retrieval.serve.app import create_app
from retrieval.serve.settings import ServiceSettings
from robot.recording.folder import RecordingWriter
from tests.serving import INFO

PREFIX, ORIGIN = "/tools/touch", "https://shop.example"
TOKEN = "a token of some length"


def behind_proxy(app):
    """Remove the prefix and replace the host, as nginx does; everything outside the prefix is another service's."""

    async def proxy(scope, receive, send):
        if scope["type"] == "http":
            assert scope["path"].startswith(f"{PREFIX}/"), f"{scope['path']} is not below the prefix"
            headers = [(b"host", b"127.0.0.1:8000"), *(pair for pair in scope["headers"] if pair[0] != b"host")]
            scope = {**scope, "path": scope["path"].removeprefix(PREFIX), "headers": headers}
        await app(scope, receive, send)

    return proxy


def check(folder, get):
    settings = ServiceSettings(index=get("index"), history=folder, host="0.0.0.0", token=TOKEN)
    with RecordingWriter(folder / "recording", INFO) as writer:
        app = create_app(settings, None, writer)
        with TestClient(behind_proxy(app), base_url=ORIGIN) as client:
            page = f"{ORIGIN}{PREFIX}/"
            same_origin = {"origin": ORIGIN, "sec-fetch-site": "same-origin"}  # as browsers send
            assert client.post(f"{page}v1/session", json={"token": TOKEN}, headers=same_origin).status_code == 204
            assert {cookie.path for cookie in client.cookies.jar} == {f"{PREFIX}/v1"}
            found = [page]
            for address in found:  # grows: files that files name
                text = client.get(address).text
                names = re.findall(r"""(?:href|src)="([^"#]+)"|from "([^"]+)"|h\("a", \{ href: "([^"#]+)" """, text)
                for name in ("".join(match) for match in names):
                    if (target := urljoin(address if name.startswith(".") else page, name)) not in found:
                        found.append(target)
            assert len(found) > 15
            body = {"touches": [[base64.b64encode(path.read_bytes()).decode() for path in get("touch")]]}
            query = client.post(f"{page}v1/query", json=body, headers=same_origin).headers["x-query-id"]
            for path in ("v1/history", f"v1/history/{query}"):
                document = client.get(page + path)
                item = document.json().get("items", [document.json()])[0]
                found += [document.url, *(urljoin(str(document.url), name) for name in item["touches"][0])]
            (server,) = client.get(f"{page}openapi.json").json()["servers"]
            found.append(urljoin(f"{page}openapi.json", server["url"]).rstrip("/") + "/v1/index")
            for address in found:
                whole, head = client.get(address), client.head(address)
                assert (whole.status_code, head.status_code, head.content) == (200, 200, b""), address
                assert head.headers["content-length"] == str(len(whole.content)), address
            assert client.head(f"{page}v1/query").status_code == client.get(f"{page}v1/query").status_code == 404
            script = client.get(f"{page}js/api.js").text
            assert "v1/query" in script
            assert '"/v1' not in script
            assert "`/v1" not in script
