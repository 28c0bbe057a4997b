"""A searcher in a long-running process: arrays, several objects at once, threads, forks and closing."""

import os
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import retrieval
from retrieval.errors import BadInput, ImageError
from retrieval.model.checkpoint import load_checkpoint
from retrieval.model.touch_reader import EncodedTouches
from retrieval.search.searcher import Searcher


def array(path):
    with Image.open(path) as image:
        return np.asarray(image)


def ranking(result):
    return [(match.object_id, match.photo, match.logit) for match in result.results]


def test_arrays_give_bitwise_the_results_of_their_files_and_one_grasp_needs_no_list(searcher, grasps):
    files = grasps[0]
    arrays = [[array(path) for path in grasp] for grasp in files]
    assert ranking(searcher.query(arrays)) == ranking(searcher.query(files))
    assert ranking(searcher.query(np.array(arrays))) == ranking(searcher.query(files))
    assert ranking(searcher.query(files[0])) == ranking(searcher.query(files[:1]))


def test_several_objects_give_the_results_of_single_queries(searcher, grasps):
    objects = [grasps[0], grasps[1][0], grasps[1][:2]]
    batch = searcher.query_many(objects, top=3)
    for answer, touches in zip(batch, objects, strict=True):
        single = searcher.query(touches, top=3)
        assert [match.object_id for match in answer.results] == [match.object_id for match in single.results]
        for ours, theirs in zip(answer.results, single.results, strict=True):
            assert ours.logit == pytest.approx(theirs.logit, abs=1e-4)
        assert answer.touches == single.touches
        assert answer.verdict == single.verdict
        assert answer.grasps == single.grasps == ["contact"] * len(answer.touches)
        assert answer.none_probability == pytest.approx(single.none_probability, abs=1e-4)


def test_the_bad_one_of_several_objects_is_reported_before_reading(searcher, grasps):
    with pytest.raises(BadInput, match=r"object 2, this model takes 2 gel image\(s\) for one touch; got 1"):
        searcher.query_many([["absent.png", "absent.png"], grasps[0][0][:1]])
    broken = [array(path) for path in grasps[0][0]]
    with pytest.raises(ImageError, match=r"object 2, grasp 1, finger b: "):
        searcher.query_many([grasps[0], [broken[0], broken[1][..., 0]]])


def test_a_closed_searcher_raises_and_can_be_closed_twice(index, touch):
    with Searcher.open(index) as searcher:
        assert searcher.query(touch).results
    for use in (lambda: searcher.query(touch), lambda: searcher.query_many([touch]), lambda: searcher.encode(touch)):
        with pytest.raises(BadInput, match=r"this searcher of .*index is closed; open the index again"):
            use()
    with pytest.raises(BadInput, match="is closed"), searcher:
        pass
    searcher.close()


def test_a_running_query_finishes_when_the_searcher_is_closed(index, touch, monkeypatch):
    searcher = Searcher.open(index)
    expected, encode = ranking(searcher.query(touch)), searcher.encoder.encode

    def closed_meanwhile(touches):
        searcher.close()
        return encode(touches)

    monkeypatch.setattr(searcher.encoder, "encode", closed_meanwhile)
    assert ranking(searcher.query(touch)) == expected


def encoded_photos(paths, model):
    checkpoint = load_checkpoint(model)
    code = retrieval.encode_photos(checkpoint.matcher, map(checkpoint.config.preprocessing.load_photo, paths))
    return EncodedTouches(code.embedding.numpy(), code.partial.numpy())


def test_the_inner_product_of_embeddings_is_the_score_of_candidate_search(searcher, grasps, catalogue, model):
    rows = list(searcher.generation.rows)
    photos = encoded_photos([catalogue / row.path for row in rows], model)
    touches = searcher.encode(grasps[0])
    np.testing.assert_allclose(np.linalg.norm(touches.embeddings, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(photos.embeddings, axis=1), 1, atol=1e-6)
    scores = touches.embeddings @ photos.embeddings.T
    theirs, numbers = searcher.generation.index.search(touches.embeddings, len(rows))
    # other batches round in another order
    np.testing.assert_allclose(np.take_along_axis(scores, numbers, axis=1), theirs, atol=1e-5)


def test_the_scorer_gives_the_logits_of_two_partials(searcher, grasps, catalogue, model):
    paths = [row.path for row in searcher.generation.rows][::5]
    photos = encoded_photos([catalogue / path for path in paths], model)
    partials, stored = searcher.encode(grasps[0]).partials, searcher.generation.arrays["partials"]
    expected = searcher.scorer.logits(partials, stored, np.arange(0, len(stored), 5))
    np.testing.assert_allclose(searcher.scorer.logits(partials, photos.partials), expected, atol=0.01)  # float16


def resident_mb():
    """Resident memory of this process in MiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory is read from Linux's /proc")
def test_a_long_running_process_gives_equal_results_and_does_not_grow(searcher, grasps):
    arrays = [[[array(path) for path in grasp] for grasp in touches] for touches in grasps]
    expected = [ranking(searcher.query(touches)) for touches in grasps]
    for number in range(80):
        assert ranking(searcher.query(arrays[number % 2])) == expected[number % 2]
        if number == 19:  # all caches are filled
            before = resident_mb()
    one_query = sum(image.nbytes for grasp in arrays[0] for image in grasp) / 2**20
    assert resident_mb() - before < max(8, 0.1 * 60 * one_query)  # almost no input stays in memory


def test_eight_threads_get_the_results_of_one(searcher, grasps):
    single = [ranking(searcher.query(touches)) for touches in grasps]
    with ThreadPoolExecutor(8) as threads:
        answers = list(threads.map(lambda number: searcher.query(grasps[number % 2]), range(48)))
    for number, answer in enumerate(answers):
        expected = single[number % 2]
        assert [match.object_id for match in answer.results] == [name for name, _, _ in expected]
        np.testing.assert_allclose([m.logit for m in answer.results], [logit for _, _, logit in expected], atol=1e-4)


def in_fork(work, seconds=60):
    """Return the result of `work` in a forked process; a process that does not end is killed and fails the test."""
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
    with os.fdopen(reader) as output:
        return output.read()


forking = pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")


@forking
def test_a_fork_is_refused_with_what_to_do_and_its_parent_continues(searcher, touch):
    expected = ranking(searcher.query(touch))

    def message():
        with pytest.raises(BadInput) as error:
            searcher.query(touch)
        return str(error.value)

    assert 'the method "spawn"' in in_fork(message).replace("\\", "")
    assert ranking(searcher.query(touch)) == expected


def test_touches_are_encoded_with_the_requested_threads_from_any_thread(index, touch):
    before = torch.get_num_threads()
    try:
        with Searcher.open(index, threads=2) as opened, ThreadPoolExecutor(1) as threads:
            torch.set_num_threads(3)
            assert threads.submit(lambda: (opened.query(touch), torch.get_num_threads())[1]).result() == 2
            assert (opened.query(touch).results != [], torch.get_num_threads()) == (True, 2)
    finally:
        torch.set_num_threads(before)
