"""A sharded index in an object store: building, incomplete transfers, kills and fetching.

The store is fsspec's memory file system; `benchmarks.faults` and slow tests use an S3 server (moto).
"""

import dataclasses
import shutil
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from indexes.errors import CorruptIndex, NoIndex
from indexes.store.sharded import read_sharded_manifest, sharded_manifest_bytes
from retrieval.commands.main import main
from retrieval.console.files import cache_folder
from retrieval.data import storage
from retrieval.errors import BadInput, RemoteStorageError
from retrieval.model.checkpoint import load_checkpoint
from retrieval.search.query.searcher import Searcher
from retrieval.search.sharding import build_sharded as building
from retrieval.search.sharding import object_store
from retrieval.search.sharding.build_sharded import build_sharded
from retrieval.search.sharding.object_store import RemoteShardedIndex
from tests import s3
from tests.retrieval.search.test_shards import same_answers

fsspec = pytest.importorskip("fsspec")
URL = "memory://bucket/cluster"


@pytest.fixture(autouse=True)
def _no_waiting(monkeypatch):
    monkeypatch.setattr(storage, "RETRY_WAITS_S", (0.0,) * 5)


@pytest.fixture
def store():
    """An empty object store in this process: {path: file}."""
    system = fsspec.filesystem("memory")
    system.store.clear()
    yield system.store
    system.store.clear()


@pytest.fixture
def build(catalogue, model):
    """Build the catalogue, or another one, in four shards behind the URL."""

    def built(folder=catalogue, shards=4, **how):
        return build_sharded(folder, load_checkpoint(model), URL, shards, quiet=True, **how)

    return built


def another_machine():
    """Simulate another machine by deleting the cache."""
    shutil.rmtree(cache_folder(), ignore_errors=True)


def changed(catalogue, folder, times=1):
    """A copy of the catalogue with additional photos of distinct content."""
    shutil.copytree(catalogue, folder, dirs_exist_ok=True)
    name = min(path.name for path in folder.iterdir())
    for number in range(times):
        data = next(catalogue.glob("*/2.jpg")).read_bytes()
        (folder / name / f"new-{number}.jpg").write_bytes(data + bytes([number]))  # decoders stop at the end marker
    return folder


# Building and searching -----------------------------------------------------------------------------------------------


def test_answers_equal_those_of_the_sharded_index_in_a_folder(build, store, searcher, grasps):
    report = build()
    assert (report.index, report.photos, report.embedded, len(report.shards)) == (URL, 24, 24, 4)
    another_machine()
    with Searcher.open(URL) as opened:
        for own in grasps:
            same_answers(opened.query(own), searcher.query(own))


def test_another_machine_embeds_and_uploads_nothing_again(build, store, embedded, monkeypatch):
    first = build()
    before = {path: file.created for path, file in store.items()}
    embedded.clear()
    another_machine()
    again = build()
    assert (again.written, again.generation, again.embedded, embedded) == (False, first.generation, 0, [])
    assert {path: file.created for path, file in store.items()} == before


def test_a_changed_catalogue_uploads_changed_shards_and_keeps_the_previous_generation(
    build, store, catalogue, tmp_path, embedded
):
    build()
    first = set(store)
    embedded.clear()
    report = build(changed(catalogue, tmp_path / "c"))  # the catalogue's path changed in all shards
    assert (report.written, report.photos, embedded) == (True, 25, [1])
    assert first <= set(store)
    second = set(store)
    build(changed(catalogue, tmp_path / "c", 2))
    third = RemoteShardedIndex(URL)
    entries = third.parse_manifest(third.manifest()).shards
    assert third.generations().keys() == {*object_store.generation_names(entries), *_generations(second - first)}


def _generations(paths):
    folders = {path.rpartition("/")[0] for path in paths if path.endswith("/manifest.json")}
    return {folder.removeprefix("/bucket/cluster/") for folder in folders}


def test_another_number_of_shards_reuses_the_codes_in_the_store(build, store, embedded):
    build()
    embedded.clear()
    another_machine()
    report = build(shards=3)
    assert (report.photos, report.embedded, embedded) == (24, 0, [])


def test_fetched_generations_stay_in_the_cache_and_old_ones_are_deleted(build, store, catalogue, tmp_path, requests):
    build()
    Searcher.open(URL).close()
    count = requests.count("get_file")
    assert count >= 4 * 5
    Searcher.open(URL).close()
    assert requests.count("get_file") == count
    for times in (1, 2, 3):
        build(changed(catalogue, tmp_path / "c", times))
        Searcher.open(URL).close()
    cached = list((cache_folder() / "shards").glob("*/*/shard-*/gen-*"))
    assert len(cached) == 4 * object_store.MAX_FETCHED_GENERATIONS


# Faults ---------------------------------------------------------------------------------------------------------------


class Killed(BaseException):
    """Like a signal that is not caught."""


class Requests(list):
    """Requests to the store, in order; `rule` runs first and may raise, or return True to replace the request."""

    rule = None


@pytest.fixture
def requests(monkeypatch):
    """The requests of this test."""
    kind, made_requests = type(fsspec.filesystem("memory")), Requests()

    def counted(name, plain):
        def request(self, *words, **how):
            made_requests.append(name)
            if made_requests.rule and made_requests.rule(name, *words):
                return None
            return plain(self, *words, **how)

        return request

    for name in ("put_file", "pipe_file", "rm_file", "get_file", "cat_file", "info", "find"):
        monkeypatch.setattr(kind, name, counted(name, getattr(kind, name)))
    return made_requests


@pytest.mark.slow
def test_killed_at_any_request_the_old_or_the_new_index_answers_and_nothing_is_embedded_twice(
    build, store, requests, catalogue, tmp_path, embedded, touch
):
    """Kill a build that changes the index at twelve evenly spaced requests."""
    build()
    before, expected, work = dict(store), Searcher.open(URL).query(touch), tmp_path / "work"
    folder = changed(catalogue, tmp_path / "c", 2)
    shutil.copytree(cache_folder(), work)
    start = len(requests)
    build(folder)
    count, photos = len(requests) - start, []
    for number in np.linspace(0, count - 1, 12).astype(int):
        another_machine()
        shutil.copytree(work, cache_folder())
        store.clear()
        store.update(before)
        embedded.clear()
        end = len(requests) + number + 1

        def killed(*_, end=end):
            if len(requests) >= end:
                raise Killed

        requests.rule = killed
        with pytest.raises(Killed):
            build(folder)
        requests.rule = None
        with Searcher.open(URL) as opened:
            photos.append(opened.info.photos)
            if photos[-1] == 24:
                same_answers(opened.query(touch), expected)
        report = build(folder)
        assert (report.photos, sum(embedded)) == (26, 2)
    assert set(photos) == {24, 26}
    assert photos == sorted(photos)


def test_killed_before_the_first_switch_another_machine_reuses_the_uploaded_shards(build, store, requests, embedded):
    def third_shard(name, *_):
        if name == "put_file" and sum(name == "put_file" for name in requests) > 14:
            raise Killed

    requests.rule = third_shard
    with pytest.raises(Killed):
        build()
    requests.rule = None
    with pytest.raises(NoIndex, match="there is no sharded index here"):
        Searcher.open(URL)
    whole = [name for name, is_whole in RemoteShardedIndex(URL).generations().items() if is_whole]
    assert 1 <= len(whole) < 4
    embedded.clear()
    another_machine()
    report = build()
    uploaded = sum(
        entry["photos"] for entry in report.shards if any(name.startswith(entry["folder"]) for name in whole)
    )
    assert (report.photos, sum(embedded)) == (24, 24 - uploaded)


def test_incomplete_transfers_are_repeated(build, store, requests, touch):
    remaining = {"put_file": 5, "get_file": 5}

    def truncate(name, *words):
        if not remaining.get(name) or requests.count(name) % 2:
            return False
        remaining[name] -= 1
        source, target = words
        if name == "put_file":
            store_file(target, Path(source).read_bytes()[:-7])
        else:
            Path(target).write_bytes(store[source].getvalue()[:-7])
        return True

    requests.rule = truncate
    build()
    with Searcher.open(URL) as opened:
        assert opened.query(touch).index["searched"] == 1.0
    assert remaining == {"put_file": 0, "get_file": 0}


def store_file(path, content):
    with fsspec.filesystem("memory").open(path, "wb") as file:
        file.write(content)


def test_a_store_that_refuses_every_twentieth_request_loses_nothing(build, store, requests, searcher, grasps):
    refused = []

    def refuse(name, *_):
        if len(requests) % 20 == 7:
            refused.append(name)
            raise OSError("503 Slow Down")

    requests.rule = refuse
    build()
    with Searcher.open(URL) as opened:
        same_answers(opened.query(grasps[0]), searcher.query(grasps[0]))
    assert len(refused) >= 5


def test_a_store_that_always_refuses_raises_and_the_codes_are_stored(build, store, requests, embedded):
    def refuse(name, *_):
        if name == "put_file":
            raise OSError("503 Slow Down")

    requests.rule = refuse
    with pytest.raises(RemoteStorageError, match=r"memory://bucket/cluster/shard-0.*: the storage failed 6 times"):
        build()
    requests.rule = None
    assert sum(embedded) > 0
    assert build().photos == 24
    assert sum(embedded) == 24


@pytest.mark.parametrize("what", ["partials.npy", "manifest.json", "rows.jsonl"])
@pytest.mark.parametrize("how", ["torn", "altered", "gone"])
def test_damage_in_the_store_is_reported_and_repaired(what, how, build, store, touch):
    build()
    path = next(path for path in sorted(store) if path.endswith(f"/{what}"))
    data = store[path].getvalue()
    if how == "gone":
        del store[path]
    else:
        content = data[:-100] if how == "torn" else data[:-100] + bytes(100)
        store_file(path, content)
    with pytest.raises(CorruptIndex, match=rf"memory://bucket/cluster/shard-0.*{what} (is missing|has|was altered)"):
        Searcher.open(URL)
    build(verify=how == "altered")
    assert store[path].getvalue() == data
    with Searcher.open(URL) as opened:
        assert opened.query(touch).index["searched"] == 1.0


def test_another_machine_embeds_damaged_shards_again(build, store, embedded):
    build()
    path = next(path for path in sorted(store) if path.endswith("/partials.npy"))
    store_file(path, b"torn")
    another_machine()
    embedded.clear()
    report = build()
    assert report.photos == 24
    assert 0 < report.embedded == sum(embedded) < 24
    another_machine()
    with Searcher.open(URL) as opened:
        assert opened.info.photos == 24


def test_the_second_of_two_concurrent_builds_fails_and_embeds_nothing_twice(
    build, store, catalogue, tmp_path, monkeypatch, touch, embedded
):
    build()
    run = building.build_in_process
    other = changed(catalogue, tmp_path / "other", 2)

    def meanwhile(jobs, checkpoint):
        found = list(run(jobs, checkpoint))
        monkeypatch.setattr(building, "build_in_process", run)
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))  # another machine
        build(other)
        return found

    monkeypatch.setattr(building, "build_in_process", meanwhile)
    with pytest.raises(RemoteStorageError, match="another build switched this index in the meantime"):
        build(changed(catalogue, tmp_path / "c"))
    with Searcher.open(URL) as opened:
        assert opened.info.photos == 26
        assert opened.query(touch).index["searched"] == 1.0
    embedded.clear()
    assert (build(changed(catalogue, tmp_path / "c")).photos, embedded) == (25, [])


# Bad input ------------------------------------------------------------------------------------------------------------


def test_a_forged_digest_raises(build, store, cluster):
    build()
    manifest = read_sharded_manifest(cluster)
    entry = dataclasses.replace(manifest.shards[0], sha256="../../../elsewhere")
    forged = dataclasses.replace(manifest, shards=[entry])
    fsspec.filesystem("memory").pipe_file("/bucket/cluster/SHARDS.json", sharded_manifest_bytes(forged))
    with pytest.raises(CorruptIndex, match=r"memory://bucket/cluster: .*shards\[0\]\.sha256 must be"):
        Searcher.open(URL)


@pytest.mark.parametrize(
    "content", [b"", b"{}", b"no JSON", b"[" * 100_000, b"x" * (object_store.MAX_MANIFEST_BYTES + 1)]
)
def test_an_invalid_manifest_raises_a_clear_error(content, store):
    fsspec.filesystem("memory").pipe_file("/bucket/cluster/SHARDS.json", content)
    with pytest.raises((CorruptIndex, RemoteStorageError), match="memory://bucket/cluster"):
        Searcher.open(URL)


def test_invalid_urls_raise(tmp_path):
    with pytest.raises(BadInput, match="is a local folder; give its path"):
        RemoteShardedIndex(f"file://{tmp_path}")
    with pytest.raises(BadInput, match="cannot be opened"):
        RemoteShardedIndex("nosuch://bucket/cluster")


def test_commands_accept_a_url(store, catalogue, model, touch, capsys):
    build = ["build-index", str(catalogue), "--model", str(model), "--out", URL]
    assert main([*build, "--preview"]) == 2
    assert main(build) == 0
    assert len(RemoteShardedIndex(URL).generations()) == 1
    assert main([*build, "--shards", "3"]) == 0
    assert main(build) == 0
    capsys.readouterr()
    query = ["query", "--gelsight", *map(str, touch), "--json"]
    assert main([*query, "--index", URL]) in (0, 3, 4)
    named = capsys.readouterr().out
    assert main(query) in (0, 3, 4)  # the one built last
    assert '"path": "memory://bucket/cluster"' in named
    assert '"path": "memory://bucket/cluster"' in capsys.readouterr().out
    assert main([*query, "--index", "memory://bucket/nowhere"]) != 0
    assert "there is no sharded index here; run `retrieve build-index" in capsys.readouterr().err


# A real S3 server -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")
def test_photos_on_s3_become_a_sharded_index_on_s3_despite_failed_and_incomplete_requests(
    s3_server, catalogue, model, searcher, grasps
):
    s3.put(catalogue, "photos/catalog")
    s3_server.refuse, s3_server.tear = 20, 7
    url = "s3://photos/cluster"
    report = build_sharded("s3://photos/catalog", load_checkpoint(model), url, 4, quiet=True)
    assert (report.photos, report.embedded, report.skipped) == (24, 24, [])
    assert s3_server.refused
    assert s3_server.torn
    another_machine()
    with Searcher.open(url) as opened:
        for own in grasps:
            ours, theirs = opened.query(own), searcher.query(own)
            assert [match.photo for match in ours.results] == [match.photo for match in theirs.results]
    again = build_sharded("s3://photos/catalog", load_checkpoint(model), url, 4, quiet=True)
    assert (again.written, again.embedded) == (False, 0)


@pytest.fixture
def switches(s3_server, cluster):
    """Two concurrent builds of an index on S3: a function that lets the first switch, the second doing so
    between the first one's check and its request, and the manifest of each."""
    s3_server.refuse = s3_server.tear = None
    s3.put(cluster, "photos/else")
    manifest = read_sharded_manifest(cluster)
    mine, theirs = (dataclasses.replace(manifest, about={"catalogue": name}) for name in ("mine", "theirs"))

    def switch(url, before):
        first, second = RemoteShardedIndex(url), RemoteShardedIndex(url)
        if before:
            first.switch(None, manifest)
        current, put, remaining = first.manifest(), first._system.pipe_file, [theirs]

        def meanwhile(path, content, **how):
            if remaining:
                second.switch(current, remaining.pop())
            put(path, content, **how)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(first._system, "pipe_file", meanwhile)
            first.switch(current, mine)

    yield switch, mine, theirs
    s3_server.conditions = "honoured"


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")
@pytest.mark.parametrize("before", [False, True], ids=["created", "replaced"])
def test_the_store_lets_one_of_two_concurrent_builds_switch(before, switches, s3_server):
    if before:
        pytest.importorskip("moto", "5.1.5", reason="this moto ignores the condition")
    switch, _, theirs = switches
    url = f"s3://photos/raced-{before}"
    with pytest.raises(RemoteStorageError, match=rf"{url}: another build switched this index in the meantime"):
        switch(url, before)
    assert RemoteShardedIndex(url).manifest() == sharded_manifest_bytes(theirs)
    assert s3_server.conditional >= 2


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")
@pytest.mark.parametrize("conditions", ["unknown", "ignored"])
def test_a_store_without_conditional_writes_is_checked_before_the_switch(conditions, switches, s3_server):
    """A switch between the check and the write is not detected: the last write remains."""
    switch, mine, theirs = switches
    s3_server.conditions = conditions
    url = f"s3://photos/{conditions}"
    switch(url, True)
    stored = RemoteShardedIndex(url)
    assert stored.manifest() == sharded_manifest_bytes(mine)
    with pytest.raises(RemoteStorageError, match="another build switched this index in the meantime"):
        stored.switch(b"an older one", theirs)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")
def test_an_incomplete_or_unanswered_switch_is_repeated(switches, s3_server):
    _, mine, theirs = switches
    stored = RemoteShardedIndex("s3://photos/torn")
    stored.switch(None, theirs)
    current, put, failures = stored.manifest(), stored._system.pipe_file, ["torn", "not answered"]

    def failing(path, content, **how):
        torn = failures and failures.pop(0) == "torn"
        put(path, content[:100] if torn else content, **how)
        if not torn:
            raise OSError("the line was cut")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stored._system, "pipe_file", failing)
        stored.switch(current, mine)
    assert (stored.manifest(), failures) == (sharded_manifest_bytes(mine), [])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # Ray's own warnings
@pytest.mark.skipif(find_spec("ray") is None, reason="needs the extra `cluster`")
def test_ray_builds_and_serves_a_sharded_index_on_s3(s3_server, catalogue, model, searcher, grasps):
    """Each replica fetches its shard."""
    from retrieval.cluster.building import ray_runner
    from retrieval.cluster.serving import Deployments, ReplicaSettings
    from retrieval.cluster.session import ray_session

    s3_server.refuse = s3_server.tear = None
    s3.put(catalogue, "photos/catalog")
    with ray_session(2) as ray:
        url, checkpoint = "s3://photos/by-ray", load_checkpoint(model)
        report = build_sharded("s3://photos/catalog", checkpoint, url, 2, quiet=True, run=ray_runner(workers=1))
        assert (report.photos, report.embedded) == (24, 24)
        another_machine()
        served = Deployments(ray, ReplicaSettings(cpus=0.1, wait_s=120.0))
        with Searcher.open(url, shards=served.open) as opened:
            for own in grasps:
                ours, theirs = opened.query(own), searcher.query(own)
                assert [match.object_id for match in ours.results] == [match.object_id for match in theirs.results]
                assert ours.index["searched"] == 1.0
        served.close()
    assert len(list((cache_folder() / "shards").glob("*/*/shard-*/gen-*"))) == 2
