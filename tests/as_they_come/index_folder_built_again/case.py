"""A service answers from the index that was built again in a deleted folder, whose generations count from 1 again."""

import shutil

from retrieval.indexing.build import build_index
from retrieval.model.checkpoint import load_checkpoint
from tests.serving import service
from tests.waiting import wait_until


def check(folder, get):
    catalogue = shutil.copytree(get("catalogue"), folder / "catalog")
    index, model = folder / "index", load_checkpoint(get("model"))
    build_index(catalogue, model, index)
    with service(index, poll_s=0.1) as client:
        before = client.get("/v1/index").json()
        shutil.rmtree(index)
        shutil.rmtree(min(catalogue.iterdir()))
        build_index(catalogue, model, index)
        wait_until(lambda: client.get("/v1/index").json()["objects"] == before["objects"] - 1, 30)
        assert client.get("/v1/index").json()["generation"] == before["generation"]
