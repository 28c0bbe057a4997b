"""Shards served by Ray: how a query waits for them and what it does if one fails; without a Ray cluster."""

from importlib.util import find_spec
from types import SimpleNamespace

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from indexes.store.sharded import read_sharded_manifest
from retrieval.commands.main import main
from retrieval.errors import BadInput, IncompleteSearch

pytestmark = [
    pytest.mark.filterwarnings("ignore"),  # Ray's own warnings
    pytest.mark.skipif(find_spec("ray") is None, reason="needs the extra `cluster`"),
]


def shards_of(manifest, **answers):
    """Shards whose processes give these answers in turn, by number: a result, or an exception that Ray raises."""
    from retrieval.cluster.serving import RayShards, ReplicaSettings

    def handle(turns):
        def result(timeout_s):
            turn = next(turns)
            if isinstance(turn, type):
                raise turn
            return turn

        response = SimpleNamespace(result=result, cancel=lambda: None)
        return SimpleNamespace(call=SimpleNamespace(remote=lambda method, *arguments: response))

    handles = {entry.folder: handle(iter(answers[f"s{place}"])) for place, entry in enumerate(manifest.shards)}
    return RayShards(manifest, handles, ReplicaSettings(wait_s=60.0))


def test_a_lost_replica_is_asked_again_and_results_are_in_the_order_of_shards(cluster):
    from ray.exceptions import RayActorError

    manifest = read_sharded_manifest(cluster)
    shards = shards_of(manifest, s0=[RayActorError, RayActorError, "a"], s1=["b"], s2=["c"], s3=["d"])
    assert shards.call(manifest.shards, "page") == ["a", "b", "c", "d"]


def test_no_result_lacks_a_part_of_the_catalogue(cluster):
    manifest = read_sharded_manifest(cluster)
    silent = shards_of(manifest, s0=["a"], s1=[TimeoutError], s2=["c"], s3=[TimeoutError])
    with pytest.raises(IncompleteSearch, match="within 60 s from shard-01-of-04, shard-03-of-04"):
        silent.call(manifest.shards, "page")
    failing = shards_of(manifest, s0=["a"], s1=[BadInput("a wrong query")], s2=["c"], s3=["d"])
    with pytest.raises(BadInput, match="a wrong query"):
        failing.call(manifest.shards, "page")


def test_a_shard_uses_one_blas_thread_and_returns_its_errors(cluster):
    """Idle threads of OpenBLAS spin for a while: with them, a query over Ray took 40 ms instead of 6."""
    from retrieval.cluster.serving import ShardReplica

    manifest = read_sharded_manifest(cluster)
    with threadpool_limits(2, "blas"):
        replica = ShardReplica(str(cluster), manifest, manifest.shards[0], manifest.about["checkpoint"])
        assert {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"} == {1}
    assert replica.call("page", [], None, 0, 5).total == manifest.shards[0].photos


def test_without_a_sharded_index_the_service_says_what_to_do(index, capsys):
    assert main(["serve", "--index", str(index), "--cluster", "--no-history"]) == 2
    assert "has no shards; build a sharded index with `retrieve build-index --shards`" in capsys.readouterr().err
