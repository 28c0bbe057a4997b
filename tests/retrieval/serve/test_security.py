"""Access control of the service, and the security headers of every response."""

import pytest

from retrieval.errors import ConfigError
from retrieval.serve.security import HEADERS
from retrieval.serve.settings import ServiceSettings
from tests.serving import problem, service

TOKEN = "a token of some length"


@pytest.fixture(scope="module")
def guarded(index):
    with service(index, host="0.0.0.0", token=TOKEN) as client:
        yield client


def test_a_host_other_than_this_machine_requires_a_token(index):
    for host in ("0.0.0.0", "::", "192.168.1.4", "robot.local"):
        with pytest.raises(ConfigError, match=f"Other machines can reach {host}, so a token is required"):
            ServiceSettings(index=index, host=host)
        ServiceSettings(index=index, host=host, token=TOKEN)
    for host in ("127.0.0.1", "::1", "localhost", "127.3.2.1"):
        ServiceSettings(index=index, host=host)
    with pytest.raises(ConfigError, match="A token must have at least 16 ASCII characters, got 5"):
        ServiceSettings(index=index, token="short")


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1.evil.example:8000", "", "[::1"])
def test_foreign_host_names_are_refused(client, host):
    problem(client.get("/v1/index", headers={"host": host}), 421, "wrong-host")


def test_requests_from_pages_of_another_origin_are_refused(client):
    for headers in ({"origin": "https://evil.example"}, {"origin": "null"}, {"sec-fetch-site": "cross-site"}):
        response = client.post("/v1/query", headers=headers)
        problem(response, 403, "refused")
        assert not any(name.startswith("access-control") for name in response.headers)
    assert client.get("/v1/index", headers={"origin": "http://127.0.0.1:8000"}).status_code == 200
    problem(client.options("/v1/query", headers={"origin": "https://evil.example"}), 403, "refused")


def test_only_requests_with_the_token_are_answered_and_the_page_gets_a_cookie_for_it(guarded):
    wrong = ({"authorization": "Bearer wrong"}, {"authorization": TOKEN}, {"cookie": "retrieve-token=wrong"})
    for headers in ({}, *wrong):
        for path in ("/v1/index", "/v1/photos/x", "/v1/nothing"):
            response = guarded.get(path, headers=headers)
            problem(response, 401, "no-token")
            assert response.headers["www-authenticate"] == "Bearer"
    assert guarded.get("/v1/index", headers={"authorization": f"Bearer {TOKEN}"}).status_code == 200
    assert guarded.get("/healthz").status_code == guarded.get("/").status_code == 200
    problem(guarded.post("/v1/session", json={"token": "wrong"}), 401, "no-token")
    response = guarded.post("/v1/session", json={"token": TOKEN})
    cookie = response.headers["set-cookie"]
    assert (response.status_code, "HttpOnly" in cookie, "SameSite=strict" in cookie) == (204, True, True)
    assert guarded.get("/v1/index").status_code == 200
    guarded.cookies.clear()
    problem(guarded.get("/v1/index"), 401, "no-token")


def test_every_response_has_the_security_headers_and_the_page_no_inline_script(client):
    for path in ("/", "/v1/index", "/v1/nothing", "/openapi.json", "/healthz"):
        response = client.get(path)
        assert {name: response.headers[name] for name in HEADERS} == HEADERS
    assert "unsafe-inline" not in HEADERS["content-security-policy"]
    assert "default-src 'none'" in HEADERS["content-security-policy"]
    page = client.get("/").text
    assert not any(inline in page for inline in ("<style", " style=", "<script>"))


def test_an_unexpected_error_reveals_no_internals(client, monkeypatch):
    monkeypatch.setattr(client.app.state.service.generations.current.shard, "page", lambda *_: 1 / 0)
    response = client.get("/v1/catalogue")
    detail = problem(response, 500, "failed")
    assert detail == "Unexpected ZeroDivisionError. See the log of the service."
    assert response.headers["x-content-type-options"] == "nosniff"


def test_only_the_files_of_the_page_are_served(client):
    whole = client.get("/")
    assert (whole.status_code, whole.headers["content-type"]) == (200, "text/html; charset=utf-8")
    assert client.get("/index.html").content == whole.content
    assert client.get("/", headers={"if-none-match": whole.headers["etag"]}).status_code == 304
    assert client.head("/").headers["content-length"] == str(len(whole.content))
    for name in ("settings.py", "%2e%2e/settings.py", "..%2fsettings.py", "/etc/passwd", "index.html%00", "nothing"):
        problem(client.get(f"/{name}"), 404, "unknown")
