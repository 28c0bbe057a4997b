"""Image decoding in threads: others are served while expensive pictures are decoded."""

import asyncio
import base64
import io
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import httpx
import numpy as np
import pytest
from PIL import Image

from benchmarks import attacks
from retrieval.data.images import decode
from retrieval.data.resize import resize
from retrieval.errors import ImageError
from retrieval.serve import decoders
from retrieval.serve.decoders import SMALL_PIXELS, Decoders
from tests.hostile_pictures import png_of_zeros
from tests.serving import listening, problem
from tests.waiting import wait_until

LARGE = png_of_zeros(2000, 1500)
assert SMALL_PIXELS < 2000 * 1500


def saved(samples, kind="PNG", **options):
    file = io.BytesIO()
    Image.fromarray(samples).save(file, kind, **options)
    return file.getvalue()


SMALL = saved(np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8))


def with_decoders(work):
    """Return the result of a coroutine that gets running decoders."""

    async def run():
        pool = Decoders()
        try:
            async with asyncio.timeout(120):
                return await work(pool)
        finally:
            pool.close()

    return asyncio.run(run())


def read(*named_files):
    return with_decoders(lambda pool: pool.read(named_files, 32))


def test_images_are_decoded_in_order_as_in_this_process():
    grey = saved(np.full((20, 40), 7, np.uint8))
    found = read(("a", LARGE), ("b", SMALL), ("c", grey))
    for image, data in zip(found, (LARGE, SMALL, grey), strict=True):
        assert np.array_equal(image.touch, resize(decode(data, "x"), (32, 32)))


def test_the_first_bad_picture_is_reported():
    with pytest.raises(ImageError, match="b: not a PNG") as error:
        read(("a", SMALL), ("b", b"junk"), ("c", b"junk"), ("d", LARGE))
    assert (error.value.path, error.value.reason[:9]) == ("b", "not a PNG")


def body_of(*images):
    return {"touches": [[base64.b64encode(image).decode() for image in images]]}


def test_a_query_with_a_slow_picture_ends_at_its_deadline_and_blocks_no_other(index, touch, monkeypatch):
    begun, ended = threading.Event(), threading.Event()
    read = decoders.read_gel_image

    def slow_if_large(data, name, px):
        if data == LARGE:
            begun.set()
            ended.wait(60)
        return read(data, name, px)

    monkeypatch.setattr(decoders, "read_gel_image", slow_if_large)
    with listening(index, deadline_s=3) as (url, parts), ThreadPoolExecutor(1) as attacker:

        def post(*images):
            return httpx.post(f"{url}/v1/query", json=body_of(*images), timeout=60)

        attack = attacker.submit(post, LARGE, LARGE)
        try:
            assert begun.wait(60)
            wait_until(lambda: post(*(path.read_bytes() for path in touch)).status_code == 200)
            problem(attack.result(), 504, "late")
            wait_until(lambda: parts.queue.in_flight == 0)
        finally:
            ended.set()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="memory is read from /proc")
@pytest.mark.parametrize("attack", ["many_keys", "png_pixels"])
def test_the_service_answers_others_during_an_attack_with_bounded_memory_and_ends_quickly(index, touch, attack):
    measured = attacks.measure(attack, index, tuple(path.read_bytes() for path in touch))
    print(measured.row())
    assert (measured.health_failed, measured.query_failed) == (0, 0)
    assert max(measured.health_s) < 2  # on a busy machine
    assert measured.memory_mb < attacks.MAX_MEMORY_MB
    assert measured.exit_s < attacks.MAX_EXIT_S
