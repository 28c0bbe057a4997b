"""Pictures in base64 as programs write them: in lines, as data URLs, with the alphabet of URLs, or without padding."""

import base64
from urllib.parse import quote

from tests.serving import problem, service


def check(folder, get):
    touch = [path.read_bytes() for path in get("touch")]
    plain = [base64.b64encode(data).decode() for data in touch]
    lines = [base64.encodebytes(data).decode() for data in touch]
    urls = [f"data:image/png;base64,{text}" for text in plain]
    forms = {
        "lines of base64": lines,
        "lines of Windows, indented": [text.replace("\n", "\r\n  ") for text in lines],
        "data URL": urls,
        "data URL in lines, with parameters": [f"\nDATA:image/png;charset=utf-8;base64,\n{text}" for text in lines],
        "data URL, escaped": [f"data:;base64,{quote(text, safe='')}" for text in plain],
        "alphabet of URLs, no padding": [base64.urlsafe_b64encode(data).decode().rstrip("=") for data in touch],
    }
    with service(get("index")) as client:
        expected = client.post("/v1/query", json={"touches": [plain]}).json()["results"]
        for form, texts in forms.items():
            answer = client.post("/v1/query", json={"touches": [texts], "background": None})
            assert answer.status_code == 200, (form, answer.text)
            assert answer.json()["results"] == expected, form
        body = f'{{"touches": [["{lines[0]}", "{lines[1]}"]]}}'  # as `base64` in a shell script breaks the lines
        answer = client.post("/v1/query", content=body, headers={"content-type": "application/json"})
        assert answer.json()["results"] == expected
        expect = {"expect": expected[0]["object_id"], "touches": [urls]}
        assert "base64" not in client.post("/v1/verify", json=expect).text
        wrong = ("a.png", "/tmp/a.png", "data:image/png,%89PNG", urls[0][:-9] + "*", 7, None)
        for text in wrong:
            detail = problem(client.post("/v1/query", json={"touches": [[text, plain[1]]]}), 422, "bad-input")
            assert detail.startswith("touches.0.0: "), text
            assert "must be an image file in base64" in detail
