"""`python -m benchmarks.queueing FIGURES.json`: cost of many shards, extrapolated from measurements.

FIGURES.json contains a line for each size, as `python -m benchmarks.shards --json` prints them. The rest is simulated,
because one machine cannot measure it. Touches arrive at random times (Poisson). Each is encoded, sent to all shards at
once, and answered when the slowest shard has answered. A shard has replicas, each with its own queue in order of
arrival, and takes the less loaded of two random ones, as Ray Serve does. Its time is log-normal, with the measured
median and 99th percentile, and grows with its photos like the measured times.

The tables show storage, memory and hours of embedding with the shipped checkpoint; then p50 and p99 of answers by
number of shards, with one slow shard (three times slower), and with one replica lost.
"""

import argparse
import heapq
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from retrieval.model.checkpoint_info import read_checkpoint_info
from retrieval.search.defaults import shipped_model

ENCODE_S = 0.008
"""Decoding and encoding of one touch, by one core (benchmarks.versions: a query on an open index)."""
HOP_S = 0.004
"""Transfer to a shard and back."""
EMBED_PER_S = 90.0
"""Photos per second, by one core, with the shipped model (half of `build-index` on two cores in benchmarks.table)."""
PLANS = {1e6: (1, 8), 1e7: (1, 10, 40), 1e8: (20, 100), 1e9: (100, 1000)}
"""Photos -> numbers of shards."""
REQUESTS, SLOWER = 4000, 3.0
BUSY, MIN_REPLICAS = 0.5, 2
"""Busy fraction of a replica's time. With a single replica, a lost shard is unavailable until it has restarted."""


@dataclass(frozen=True)
class ServiceTimes:
    """Time of one shard: log-normal with this median and this 99th percentile, in seconds."""

    p50: float
    p99: float

    def draw(self, rng: np.random.Generator, size: tuple[int, ...]) -> np.ndarray:
        """Draw times of that shape."""
        return self.p50 * np.exp(math.log(self.p99 / self.p50) / 2.3263 * rng.standard_normal(size))

    @property
    def mean(self) -> float:
        """Mean of the distribution."""
        spread = math.log(self.p99 / self.p50) / 2.3263
        return self.p50 * math.exp(spread**2 / 2)


def service_of(photos: float, measured: Sequence[Mapping[str, Any]]) -> ServiceTimes:
    """Return the time of a shard of this many photos.

    It interpolates the measurements, including those of whole folders, and extrapolates by a power law.
    """
    points = {one["photos"] / one["shards"]: one["slowest_p50_s"] for one in measured}
    points |= {one["photos"]: one["folder_p50_s"] for one in measured}
    sizes, medians = np.log(np.array(sorted(points.items()))).T
    tail = float(np.median([one["shard_p99_s"] / one["slowest_p50_s"] for one in measured]))
    at = math.log(photos)
    if sizes[0] <= at <= sizes[-1]:
        p50 = math.exp(np.interp(at, sizes, medians))
    else:
        near = slice(-2, None) if at > sizes[-1] else slice(0, 2)
        slope = np.diff(medians[near])[0] / np.diff(sizes[near])[0]
        end = -1 if at > sizes[-1] else 0
        p50 = math.exp(medians[end] + slope * (at - sizes[end]))
    return ServiceTimes(p50, p50 * tail)


def answers(
    shards: int, replicas: int, service: ServiceTimes, rate: float, seed: int = 0, slow: int = 0, lost: int = 0
) -> np.ndarray:
    """Return the seconds from the arrival of each of `REQUESTS` touches to its answer.

    Args:
        shards: number of shards.
        replicas: replicas of each shard.
        service: time of one shard.
        rate: touches per second.
        seed: seed of the simulation.
        slow: number of shards that take `SLOWER` times longer.
        lost: number of shards with one replica less, if they have at least two.
    """
    rng = np.random.default_rng([seed, shards, replicas])
    arrivals = np.cumsum(rng.exponential(1 / rate, REQUESTS))
    last = np.zeros(REQUESTS)
    for shard in range(shards):
        times = service.draw(rng, (REQUESTS,)) * (SLOWER if shard < slow else 1.0)
        servers = max(1, replicas - (shard < lost))
        last = np.maximum(last, _ended(arrivals, times, servers, rng))
    return ENCODE_S + HOP_S + last - arrivals


def _ended(arrivals: np.ndarray, times: np.ndarray, servers: int, rng: np.random.Generator) -> np.ndarray:
    """Return when each request of one shard ends; it joins the shorter of two queues drawn at random."""
    free, queues = np.zeros(servers), [list[float]() for _ in range(servers)]
    drawn = rng.integers(servers, size=(len(arrivals), 2))
    ended = np.empty(len(arrivals))
    for number, (arrival, seconds) in enumerate(zip(arrivals, times, strict=True)):
        for place in set(drawn[number].tolist()):
            while queues[place] and queues[place][0] <= arrival:
                heapq.heappop(queues[place])
        chosen = min(drawn[number].tolist(), key=lambda place: len(queues[place]))
        free[chosen] = max(free[chosen], arrival) + seconds
        heapq.heappush(queues[chosen], free[chosen])
        ended[number] = free[chosen]
    return ended


def tables(measured: Sequence[Mapping[str, Any]], rate: float) -> Iterator[str]:
    """Yield the lines of the Markdown tables."""
    disk, shard = measured[-1]["bytes_per_photo"], measured[-1]["photos"]
    each = photo_bytes()
    yield "| photos | disk, no cells | disk | memory, `flat` | memory, `ivf_sq8` | embedding, 1 core | 100 cores |"
    yield "|---|---|---|---|---|---|---|"
    for photos in PLANS:
        hours = photos / EMBED_PER_S / 3600
        sizes = disk, disk + each["cells"], each["embedding"], each["list entry"]
        cells = " | ".join(_bytes(size * photos) for size in sizes)
        yield f"| {photos:.0e} | {cells} | {hours:,.0f} h | {hours / 100:,.1f} h |"
    yield ""
    yield (
        f"| photos | shards of | shard's own time | replicas for {rate:g}/s | p50 | p99 | p99, one shard {SLOWER:g} x "
        "slower | p99, one replica lost |"
    )
    yield "|---|---|---|---|---|---|---|---|"
    for photos, divisions in PLANS.items():
        for shards in divisions:
            service = service_of(photos / shards, measured)
            replicas = max(MIN_REPLICAS, math.ceil(rate * service.mean / BUSY))
            plain = answers(shards, replicas, service, rate)
            slow = answers(shards, replicas, service, rate, slow=1)
            lost = answers(shards, replicas, service, rate, lost=1)
            yield (
                f"| {photos:.0e} | {shards} x {photos / shards:.0e} | {_ms(service.p50)} | {replicas} | "
                f"{_ms(np.median(plain))} | {_ms(np.percentile(plain, 99))} | {_ms(np.percentile(slow, 99))} | "
                f"{_ms(np.percentile(lost, 99))} |"
            )
    yield ""
    yield f"Measured at shards of up to {shard:,.0f} photos; larger shards are extrapolated."


def photo_bytes() -> dict[str, int]:
    """Return the bytes of a photo with the shipped checkpoint: embedding, entry of an `ivf_sq8` list, and cells."""
    sizes = read_checkpoint_info(shipped_model()).config.matcher
    return {
        "embedding": 4 * sizes.embedding_dim,  # float32
        "list entry": sizes.embedding_dim + 8,  # one byte of each component, and the row
        "cells": sizes.photo_cells**2 * sizes.cell_dim,  # int8
    }


def _bytes(count: float) -> str:
    for unit in ("B", "kB", "MB", "GB", "TB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} PB"


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:,.0f} ms" if seconds < 10 else f"{seconds:,.0f} s"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.queueing", description=__doc__.split("\n\n")[0])
    parser.add_argument("figures", type=Path, help="lines of `python -m benchmarks.shards --json`")
    parser.add_argument("--rate", type=float, default=5.0, help="touches per second")
    arguments = parser.parse_args()
    lines = [json.loads(line) for line in arguments.figures.read_text().splitlines() if line.startswith("{")]
    measured = sorted((line for line in lines if "slowest_p50_s" in line), key=lambda line: line["photos"])
    if len(measured) < 2:
        raise SystemExit(f"{arguments.figures} must contain at least two sizes; run python -m benchmarks.shards --json")
    for line in tables(measured, arguments.rate):
        print(line)


if __name__ == "__main__":
    main()
