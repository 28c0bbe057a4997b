"""The catalogue over HTTP: pages, search, photos by id, similar photos, and no files outside the index."""

import io

import pytest
from PIL import Image

from tests.serving import problem


def test_pages_contain_every_photo_once_in_index_order(client, searcher):
    found, offset = [], 0
    while offset is not None:
        page = client.get("/v1/catalogue", params={"offset": offset, "limit": 7}).json()
        assert (page["total"], page["offset"], page["generation"]) == (24, offset, searcher.manifest.generation)
        found, offset = found + page["items"], page["next"]
    assert [item["id"] for item in found] == [row.path for row in searcher.generation.rows]
    assert client.get("/v1/catalogue", params={"offset": 500}).json()["items"] == []


def test_object_and_words_filter_the_catalogue(client, searcher):
    name = searcher.generation.rows[0].object_id
    own = client.get("/v1/catalogue", params={"object": name}).json()["items"]
    assert {item["object_id"] for item in own} == {name}
    assert len(own) == 3
    words = f"{name.upper()} 2.jpg"
    assert [item["id"] for item in client.get("/v1/catalogue", params={"search": words}).json()["items"]] == [
        f"{name}/2.jpg"
    ]
    assert client.get("/v1/catalogue", params={"object": "nobody's"}).json()["total"] == 0


def test_a_photo_is_its_file_and_a_thumbnail_is_small(client, catalogue, searcher):
    name = searcher.generation.rows[0].path
    whole = client.get(f"/v1/photos/{name}")
    assert whole.content == (catalogue / name).read_bytes()
    assert whole.headers["content-type"] == "image/jpeg"
    small = client.get(f"/v1/photos/{name}", params={"px": 64})
    assert max(Image.open(io.BytesIO(small.content)).size) == 64
    for first in (whole, small):
        again = client.get(first.request.url, headers={"if-none-match": first.headers["etag"]})
        assert (again.status_code, again.content) == (304, b"")


@pytest.mark.parametrize(
    "name", ["nobody/1.jpg", "../index/CURRENT", "..%2F..%2Fetc%2Fpasswd", "%2Fetc%2Fpasswd", "%00", "%FF", "."]
)
def test_names_outside_the_index_are_unknown(client, name):
    response = client.get(f"/v1/photos/{name}")
    assert problem(response, 404, "unknown")
