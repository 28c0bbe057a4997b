"""Image decoding in separate processes: expensive pictures end with their process, and others are served meanwhile."""

import asyncio
import base64
import io
import os
import sys
from concurrent.futures import ThreadPoolExecutor

import httpx
import numpy as np
import pytest
from PIL import Image

from benchmarks import attacks
from retrieval.data.images import decode
from retrieval.data.resize import resize
from retrieval.errors import ImageError, RetrievalError
from retrieval.serve import decoders
from retrieval.serve.decoders import SMALL_PIXELS, Decoders
from tests import decoding
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
            await pool.close()

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


def test_a_crashed_process_is_reported_for_its_picture_and_replaced(monkeypatch):
    monkeypatch.setattr(decoders, "PROGRAM", decoding.DIE)

    async def work(pool):
        for _ in range(2):
            with pytest.raises(ImageError, match="b: decoding needs more than 5 s of CPU time or 200 MB"):
                await pool.read([("a", SMALL), ("b", LARGE)], 32)
        return await pool.read([("a", SMALL)], 32)

    assert with_decoders(work)[0].touch.shape == (32, 32, 3)


def test_a_process_that_cannot_start_is_not_reported_as_a_bad_picture(monkeypatch):
    monkeypatch.setattr(decoders, "PROGRAM", decoding.FAIL)
    with pytest.raises(RetrievalError, match="ended during its start") as error:
        read(("a", SMALL))
    assert not isinstance(error.value, ImageError)


LIMITED = "from retrieval.serve import decoders as d; {}; d.serve_pictures()"
LINUX = pytest.mark.skipif(sys.platform != "linux", reason="only Linux enforces the memory limit")


@pytest.mark.parametrize(
    "limit",
    [
        "d.DECODE_CPU_S = 0; d.decode = lambda *_: any(iter(int, 1))",  # computes for ever
        pytest.param("d.DECODE_BYTES = 5_000_000", marks=LINUX),
    ],
    ids=["time", "memory"],
)
def test_a_process_ends_beyond_its_limits_of_cpu_time_and_memory(limit, monkeypatch):
    monkeypatch.setattr(decoders, "PROGRAM", LIMITED.format(limit))
    with pytest.raises(ImageError, match="a: decoding needs more than 5 s of CPU time or 200 MB"):
        read(("a", LARGE))


def body_of(*images):
    return {"touches": [[base64.b64encode(image).decode() for image in images]]}


def test_a_query_with_a_hanging_picture_ends_at_its_deadline_and_blocks_no_other(index, touch, monkeypatch, tmp_path):
    monkeypatch.setattr(decoders, "PROGRAM", decoding.HANG)
    monkeypatch.setattr("retrieval.serve.uploads.RequestPictures.named_files", _named_in(tmp_path))
    with listening(index, deadline_s=3) as (url, parts), ThreadPoolExecutor(1) as attacker:

        def post(*images):
            return httpx.post(f"{url}/v1/query", json=body_of(*images), timeout=60)

        attack = attacker.submit(post, LARGE, LARGE)
        wait_until(lambda: [file for file in tmp_path.iterdir() if file.read_text()])
        (file,) = tmp_path.iterdir()  # large pictures are decoded one at a time
        process = int(file.read_text())
        assert is_running(process)
        wait_until(lambda: post(*(path.read_bytes() for path in touch)).status_code == 200)  # a busy machine is late
        problem(attack.result(), 504, "late")
        wait_until(lambda: parts.queue.in_flight == 0)
        wait_until(lambda: not is_running(process))


def _named_in(folder):
    """Name the pictures after files of a folder."""
    return lambda pictures: [(str(folder / str(number)), data) for number, data in enumerate(pictures.files[0])]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="memory is read from /proc")
@pytest.mark.parametrize("attack", ["many_keys", "jpeg_scans", "png_pixels"])
def test_the_service_answers_others_during_an_attack_with_bounded_memory_and_ends_quickly(index, touch, attack):
    measured = attacks.measure(getattr(attacks, attack), index, tuple(path.read_bytes() for path in touch))
    print(measured.row())
    assert (measured.health_failed, measured.query_failed) == (0, 0)
    assert max(measured.health_s) < 2  # on a busy machine
    assert measured.memory_mb < attacks.MAX_MEMORY_MB
    assert measured.exit_s < attacks.MAX_EXIT_S


def is_running(process):
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True
