"""A searcher in a robot's process: arrays, several objects at once, threads, forks, and an end."""

import copy
import os
import pickle
import shutil
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import retrieval
from retrieval.errors import BadInput, ImageError
from retrieval.model import touches as model_touches
from retrieval.model.checkpoint import load_checkpoint
from retrieval.model.export import touch_encoder_to_onnx
from retrieval.model.onnx_encoder import with_checksum
from retrieval.search.build.build_index import build_index
from retrieval.search.query.searcher import Searcher
from tests import synthetic


@pytest.fixture(scope="module")
def grasps(tmp_path_factory):
    """Files of three grasps of each of two objects."""
    objects = synthetic.make_objects(2, seed=9)
    return list(synthetic.write_queries(tmp_path_factory.mktemp("grasps"), objects, 3).values())


def array(path):
    with Image.open(path) as image:
        return np.asarray(image)


def ranking(result):
    return [(match.object_id, match.photo, match.logit) for match in result.results]


def test_arrays_give_the_answer_of_their_files_to_the_bit(searcher, grasps):
    files = grasps[0]
    arrays = [[array(path) for path in grasp] for grasp in files]
    assert ranking(searcher.query(arrays)) == ranking(searcher.query(files))
    assert ranking(searcher.query(np.array(arrays))) == ranking(searcher.query(files))


def test_one_grasp_needs_no_list_of_grasps(searcher, grasps):
    assert ranking(searcher.query(grasps[0][0])) == ranking(searcher.query(grasps[0][:1]))


def test_an_answer_names_arrays_by_their_place_and_photos_by_absolute_paths(searcher, grasps, catalogue):
    answer = searcher.query([array(path) for path in grasps[0][0]])
    assert answer.touches == [
        ["grasp 1, finger a (array 120 x 160 x 3 uint8)", "grasp 1, finger b (array 120 x 160 x 3 uint8)"]
    ]
    assert answer.top is answer.results[0]
    assert answer.top.photo_path == catalogue.absolute() / answer.top.photo
    assert answer.top.photo_path.is_file()
    assert "photo_path" not in answer.to_dict()["results"][0]


def test_one_pillow_image_may_be_given_for_both_fingers(searcher, touch):
    image = Image.open(touch[0])
    assert ranking(searcher.query([image, image])) == ranking(searcher.query([touch[0], touch[0]]))


# Several objects -----------------------------------------------------------------------------------------------------


def test_several_objects_are_answered_as_one_at_a_time(searcher, grasps):
    objects = [grasps[0], grasps[1][0], grasps[1][:2]]
    together = searcher.query_many(objects, top=3)
    for answer, touches in zip(together, objects, strict=True):
        alone = searcher.query(touches, top=3)
        assert [match.object_id for match in answer.results] == [match.object_id for match in alone.results]
        for ours, theirs in zip(answer.results, alone.results, strict=True):
            assert ours.logit == pytest.approx(theirs.logit, abs=1e-4)
        assert answer.touches == alone.touches
        assert answer.verdict == alone.verdict
        assert answer.grasps == alone.grasps == ["contact"] * len(answer.touches)
        assert answer.none_probability == pytest.approx(alone.none_probability, abs=1e-4)


def test_the_grasps_of_all_objects_are_encoded_in_batches(searcher, grasps, monkeypatch):
    asked, encode = [], searcher.encoder.encode

    def counted(touches):
        asked.append(len(touches))
        return encode(touches)

    monkeypatch.setattr(searcher.encoder, "encode", counted)
    assert len(searcher.query_many([grasps[0][:2]] * 20, top=1)) == 20
    assert asked == [32, 8]


def test_no_object_gives_no_answer(searcher):
    assert searcher.query_many([]) == []


def test_of_several_objects_the_bad_one_is_named_before_anything_is_read(searcher, grasps):
    with pytest.raises(BadInput, match=r"object 2, this model takes 2 gel image\(s\) for one touch; got 1"):
        searcher.query_many([["absent.png", "absent.png"], grasps[0][0][:1]])
    broken = [array(path) for path in grasps[0][0]]
    with pytest.raises(ImageError, match=r"object 2, grasp 1, finger b \("):
        searcher.query_many([grasps[0], [broken[0], broken[1][..., 0]]])


# The end -------------------------------------------------------------------------------------------------------------


def test_a_closed_searcher_says_so_and_closes_twice(index, touch):
    with Searcher.open(index) as searcher:
        assert searcher.query(touch).results
    searcher.close()
    for use in (lambda: searcher.query(touch), lambda: searcher.query_many([touch]), lambda: searcher.encode(touch)):
        with pytest.raises(BadInput, match=r"this searcher of .*index was closed; open the index again"):
            use()
    with pytest.raises(BadInput, match="was closed"), searcher:
        pass


def test_a_searcher_cannot_be_pickled_and_says_what_to_do(searcher):
    for attempt in (pickle.dumps, copy.copy, copy.deepcopy):
        with pytest.raises(BadInput, match=r"cannot be pickled.*open the index in each process: retrieval\.open\('"):
            attempt(searcher)


def test_what_is_under_way_when_a_searcher_is_closed_is_answered(index, touch, monkeypatch):
    searcher = Searcher.open(index)
    expected, encode = ranking(searcher.query(touch)), searcher.encoder.encode

    def closed_meanwhile(touches):
        searcher.close()
        return encode(touches)

    monkeypatch.setattr(searcher.encoder, "encode", closed_meanwhile)
    assert ranking(searcher.query(touch)) == expected


# For an index of one's own -------------------------------------------------------------------------------------------


def test_the_inner_product_of_the_two_embeddings_is_the_score_of_the_candidates(searcher, grasps, catalogue, model):
    rows = list(searcher.generation.rows)
    photos = retrieval.embed_photos([catalogue / row["path"] for row in rows], model=model)
    touches = searcher.encode(grasps[0])
    np.testing.assert_allclose(np.linalg.norm(touches.embeddings, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(photos.embeddings, axis=1), 1, atol=1e-6)
    scores = touches.embeddings @ photos.embeddings.T
    for own, (numbers, theirs) in zip(scores, searcher.generation.search(touches.embeddings, len(rows)), strict=True):
        np.testing.assert_allclose(own[numbers], theirs, atol=1e-5)  # a photo's batch rounds in another order


def test_the_scorer_gives_the_logits_of_two_partials(searcher, grasps, catalogue, model):
    answer = searcher.query(grasps[0])
    photos = retrieval.embed_photos([match.photo_path for match in answer.results], model=load_checkpoint(model))
    shown = np.asarray(searcher.scorer.logits(searcher.encode(grasps[0]).partials, photos.partials))
    meant = searcher.posterior.object_logits(shown, np.arange(len(shown)), np.ones(len(shown), dtype=int))
    # The photos shown are the best of each object; the mean likelihood of all is no larger than the best one's.
    assert (meant + 0.01 >= [match.logit for match in answer.results]).all()
    rows = [photo["path"] for photo in searcher.generation.rows]
    places = np.array([rows.index(match.photo) for match in answer.results])
    stored = searcher.scorer.logits(searcher.encode(grasps[0]).partials, searcher.generation.arrays["partials"], places)
    np.testing.assert_allclose(shown, stored, atol=0.01)  # stored as float16


def test_photos_are_embedded_however_they_are_given(catalogue, model):
    path = sorted(catalogue.rglob("*.jpg"))[0]
    given = [path, path.read_bytes(), Image.open(path), array(path)]
    code = retrieval.embed_photos(given, model=model)
    for embedding in code.embeddings[1:]:
        np.testing.assert_allclose(embedding, code.embeddings[0], atol=1e-6)


def test_no_photo_and_a_bad_one_are_refused(catalogue, model):
    with pytest.raises(BadInput, match="give at least one photo"):
        retrieval.embed_photos([], model=model)
    with pytest.raises(BadInput, match="photos must be a list, of one photo too"):
        retrieval.embed_photos("catalog/mug/1.jpg", model=model)
    with pytest.raises(ImageError, match=r"photo 1: an image must be a path, .*, got int"):
        retrieval.embed_photos([5], model=model)
    with pytest.raises(ImageError, match=r"photo 2: an array must hold uint8"):
        retrieval.embed_photos([sorted(catalogue.rglob("*.jpg"))[0], np.zeros((4, 4, 3))], model=model)


# For hours -----------------------------------------------------------------------------------------------------------


def resident_mb():
    """Memory of this process that lies in RAM."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


@pytest.mark.parametrize("queries", [60, pytest.param(1000, marks=pytest.mark.slow)])
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory is read from Linux's /proc")
def test_a_resident_process_answers_arrays_as_files_and_does_not_grow(queries, searcher, grasps):
    given = [[[array(path) for path in grasp] for grasp in touches] for touches in grasps]
    expected = [ranking(searcher.query(touches)) for touches in grasps]
    for number in range(20):  # what is kept for ever is kept by now
        searcher.query(given[number % 2])
    before = resident_mb()
    for number in range(queries):
        assert ranking(searcher.query(given[number % 2])) == expected[number % 2]
    one_query = sum(image.nbytes for grasp in given[0] for image in grasp) / 2**20
    assert resident_mb() - before < max(8, 0.1 * queries * one_query)  # of what was given, next to nothing stays


# Threads and forks ---------------------------------------------------------------------------------------------------


def test_eight_threads_get_the_answers_of_one(searcher, grasps):
    alone = [ranking(searcher.query(touches)) for touches in grasps]
    with ThreadPoolExecutor(8) as threads:
        answers = list(threads.map(lambda number: searcher.query(grasps[number % 2]), range(48)))
    for number, answer in enumerate(answers):
        expected = alone[number % 2]
        assert [match.object_id for match in answer.results] == [name for name, _, _ in expected]
        np.testing.assert_allclose([m.logit for m in answer.results], [logit for _, _, logit in expected], atol=1e-4)


def in_fork(work, seconds=60):
    """What `work` returns in a forked process; killed and told where it does not end."""
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        try:
            os.write(writer, repr(work()).encode())
        finally:
            os._exit(0)
    os.close(writer)
    end = time.monotonic() + seconds
    while os.waitpid(child, os.WNOHANG) == (0, 0):
        if time.monotonic() > end:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            pytest.fail("the forked process did not end")
        time.sleep(0.01)
    with os.fdopen(reader) as said:
        return said.read()


forking = pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")


@forking
def test_a_fork_answers_as_its_parent_does(searcher, touch):
    expected = ranking(searcher.query(touch))
    torch.ones(1 << 20).add(1)  # by OpenMP's threads, which the fork does not have
    assert in_fork(lambda: ranking(searcher.query(touch))) == repr(expected)


@forking
def test_a_process_forks_when_no_touch_is_being_read_and_threads_that_did_are_gone(searcher, touch):
    """A thread that Python has joined may still hold a lock of the allocator, which a fork would copy as it is: this
    once left a child waiting for ever in PyTorch."""
    expected, found = ranking(searcher.query(touch)), []
    for _ in range(3):
        with ThreadPoolExecutor(8) as threads:
            list(threads.map(searcher.query, [touch] * 24))
        ended = model_touches._fork_guard._threads - {thread.native_id for thread in threading.enumerate()}
        assert len(ended) >= 8
        found.append(in_fork(lambda: ranking(searcher.query(touch))))
        assert not any(Path(f"/proc/self/task/{one}").exists() for one in ended)
    assert found == [repr(expected)] * 3


@forking
def test_a_fork_waits_for_the_query_under_way(searcher, touch, monkeypatch):
    begun, order, encode = threading.Event(), [], searcher.encoder.encode

    def slow(views):
        begun.set()
        time.sleep(0.3)
        order.append("encoded")
        return encode(views)

    monkeypatch.setattr(searcher.encoder, "encode", slow)
    with ThreadPoolExecutor(1) as threads:
        answer = threads.submit(searcher.query, touch)
        assert begun.wait(60)
        assert in_fork(lambda: len(order)) == "1"
        assert answer.result().results


def test_touches_are_encoded_with_the_threads_asked_for_whichever_thread_asks(index, touch):
    before = torch.get_num_threads()
    try:
        with Searcher.open(index, threads=2) as opened, ThreadPoolExecutor(1) as threads:
            torch.set_num_threads(3)
            assert threads.submit(lambda: (opened.query(touch), torch.get_num_threads())[1]).result() == 2
            assert (opened.query(touch).results != [], torch.get_num_threads()) == (True, 2)
    finally:
        torch.set_num_threads(before)


@forking
def test_a_fork_of_a_process_that_computed_on_several_threads_computes_on_one(searcher):
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        sums = torch.ones(1 << 20).add(1).sum()
        found = in_fork(lambda: (torch.get_num_threads(), float(torch.ones(1 << 20).add(1).sum())))
    finally:
        torch.set_num_threads(before)
    assert found == repr((1, float(sums)))


@forking
def test_a_fork_opens_the_export_again_and_lets_go_of_its_parents(catalogue, model, touch, tmp_path):
    pytest.importorskip("onnx")
    own = Path(shutil.copy(model, tmp_path / "m.safetensors"))
    own.with_suffix(".onnx").write_bytes(with_checksum(touch_encoder_to_onnx(load_checkpoint(own))))
    build_index(catalogue, load_checkpoint(own), tmp_path / "index", quiet=True)
    searcher = Searcher.open(tmp_path / "index")
    expected = ranking(searcher.query(touch))
    assert searcher.query(touch).index["encoder"] == "onnx"

    def answered_and_closed():
        with searcher:
            return ranking(searcher.query(touch))

    assert in_fork(answered_and_closed) == repr(expected)
    assert in_fork(searcher.close) == "None"
    assert ranking(searcher.query(touch)) == expected
