"""Attack a running service and measure whether it still answers.

    python -m benchmarks.attacks INDEX --gelsight a.png b.png [--only NAME ...] [--json results.json]

Each attack has its own `retrieve serve`. During the attack, one client requests `/healthz` twenty times per second and
another sends an honest query four times per second. The table shows, for each attack: the slowest `/healthz`, the
honest queries answered and the slowest of them, the peak memory of the service above idle, and the time that the
service needs to exit after SIGTERM. All traffic stays on the loopback addresses.
"""

import argparse
import base64
import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from tests.hostile_pictures import png_of_zeros

MAX_HEALTH_S, MAX_MEMORY_MB, MAX_EXIT_S = 0.5, 300, 10
BODY_BYTES = 19_500_000
ATTACKERS, HONEST = "127.0.0.1", "127.0.0.2"
"""The attack and the honest clients use two addresses."""
TIMEOUT_S = {ATTACKERS: 60, HONEST: 30}

Attack = Callable[[int, bytes], str]
"""An attack on the service at a port; it gets an honest gel image, and returns the answers of the service as text."""


@dataclass(frozen=True)
class Posts:
    """An attack of several equal requests in parallel; `body` is made from the honest gel image."""

    path: str
    times: int
    body: Callable[[bytes], bytes]

    def __call__(self, port: int, gel: bytes) -> str:
        """Send the requests; return the counts of the statuses."""
        body, statuses = self.body(gel), list[int]()

        def post() -> None:
            statuses.append(_request(port, "POST", self.path, body, source=ATTACKERS))

        threads = [threading.Thread(target=post) for _ in range(self.times)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        counts = {status: statuses.count(status) for status in sorted(set(statuses))}
        return ", ".join(f"{count} x {status or 'cut off'}" for status, count in counts.items())


def slow_bodies(port: int, _gel: bytes) -> str:
    """100 requests whose bodies arrive at one byte per second."""
    connections = [_connect(port) for _ in range(100)]
    for connection in connections:
        connection.sendall(
            b"POST /v1/session HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\n"
            b"content-length: 1000\r\n\r\n"
        )
    for _ in range(18):
        time.sleep(1)
        for connection in connections:
            with suppress(OSError):
                connection.sendall(b" ")
    return f"{_close(connections)} of 100 open after 18 s"


def header_flood(port: int, _gel: bytes) -> str:
    """One connection that sends headers without end, up to 400 MB."""
    lines = b"".join(b"x-%d: %s\r\n" % (number, b"a" * 1000) for number in range(1000))
    with _connect(port) as connection:
        connection.sendall(b"GET /healthz HTTP/1.1\r\nhost: localhost\r\n")
        sent = 0
        with suppress(OSError):
            for _ in range(400):
                connection.sendall(lines)
                sent += len(lines)
        return f"{sent / 1e6:.0f} MB accepted"


def _connect(port: int) -> socket.socket:
    return socket.create_connection(("127.0.0.1", port), 10, (ATTACKERS, 0))


def _close(connections: list[socket.socket]) -> int:
    """Close connections; return how many the service had left open."""
    still_open = sum(_is_open(connection) for connection in connections)
    for connection in connections:
        connection.close()
    return still_open


def _is_open(connection: socket.socket) -> bool:
    connection.setblocking(False)
    try:
        while connection.recv(65536):
            pass
        return False
    except BlockingIOError:
        return True
    except OSError:
        return False


def _query(pictures: list[bytes]) -> bytes:
    grasps = [pictures[start : start + 2] for start in range(0, len(pictures), 2)]
    return json.dumps({"touches": [[base64.b64encode(one).decode() for one in grasp] for grasp in grasps]}).encode()


def _paired(picture: Callable[[], bytes]) -> Callable[[bytes], bytes]:
    """Return the body of a query of this picture and the honest gel image."""
    return lambda gel: _query([picture(), gel])


ATTACKS: dict[str, Attack] = {
    # 20 MB of small keys, to the path that needs no token
    "many_keys": Posts(
        "/v1/session", 3, lambda _: b"{" + b",".join(b'"k%d":0' % number for number in range(1_400_000)) + b"}"
    ),
    # millions of empty grasps
    "empty_grasps": Posts("/v1/query", 3, lambda _: b'{"touches": [' + b"[]," * (BODY_BYTES // 3 - 10) + b"[]]}"),
    # arrays within arrays, millions deep
    "nested": Posts("/v1/query", 3, lambda _: b'{"touches": ' + b"[" * (BODY_BYTES // 2) + b"]" * (BODY_BYTES // 2)),
    "empty_verification": Posts(
        "/v1/verify", 3, lambda _: b'{"expect": "mug", "touches": [' + b"[]," * (BODY_BYTES // 3 - 20) + b"[]]}"
    ),
    # 1 pixel wide, 20,000,000 high
    "png_column": Posts("/v1/query", 4, _paired(lambda: png_of_zeros(1, 20_000_000))),
    # the largest accepted size, 17 kB each
    "png_pixels": Posts("/v1/query", 4, _paired(lambda: png_of_zeros(4472, 4472))),
    # 32 grasps of two tiny pictures
    "many_pictures": Posts("/v1/query", 8, lambda _: _query([png_of_zeros(8, 8)] * 64)),
    "many_enrolments": Posts("/v1/objects/x/touches", 8, lambda _: _query([png_of_zeros(8, 8)] * 64)),
    "slow_bodies": slow_bodies,
    "header_flood": header_flood,
    # simultaneous grasps of the simulated rig
    "many_grasps": Posts("/v1/grasp", 60, lambda _: b""),
}


def _request(port: int, method: str, path: str, body: bytes | None = None, *, source: str = HONEST) -> int:
    """Send one request from the address `source`; return the status, or 0 if the connection was cut."""
    connection = http.client.HTTPConnection("127.0.0.1", port, TIMEOUT_S[source], source_address=(source, 0))
    try:
        connection.request(method, path, body, {} if body is None else {"content-type": "application/json"})
        response = connection.getresponse()
        response.read()
        return response.status
    except (OSError, http.client.HTTPException):
        return 0
    finally:
        connection.close()


@dataclass
class AttackResult:
    """Measurements of the honest clients and of the operator during one attack."""

    attack: str
    answered: str = ""
    health_s: list[float] = field(default_factory=list)
    health_failed: int = 0
    query_s: list[float] = field(default_factory=list)
    query_failed: int = 0
    memory_mb: float = 0
    exit_s: float = 0

    @property
    def holds(self) -> bool:
        """Whether the service stayed within every limit."""
        return (
            max(self.health_s, default=99) <= MAX_HEALTH_S
            and not self.health_failed
            and not self.query_failed
            and self.memory_mb <= MAX_MEMORY_MB
            and self.exit_s <= MAX_EXIT_S
        )

    def row(self) -> str:
        """Return a row of the Markdown table."""
        return (
            f"| {self.attack} | {self.answered} | {max(self.health_s, default=99):.2f} ({self.health_failed} failed) | "
            f"{len(self.query_s)} of {len(self.query_s) + self.query_failed}, "
            f"slowest {max(self.query_s, default=99):.2f} | {self.memory_mb:.0f} | {self.exit_s:.1f} | "
            f"{'yes' if self.holds else '**no**'} |"
        )


HEAD = (
    "| attack | answered | slowest /healthz, s | honest queries answered, s | memory above idle, MB "
    "| end after SIGTERM, s | holds |\n|---|---|---|---|---|---|---|"
)


def measure(attack: str, index: Path, gels: tuple[bytes, ...]) -> AttackResult:
    """Run one attack against a new service; `gels` are the gel images of an honest grasp."""
    measured = AttackResult(attack.replace("_", " "))
    with tempfile.TemporaryDirectory() as folder, _service(index, Path(folder)) as (process, port):
        honest = _query(list(gels))
        for _ in range(3):
            _request(port, "POST", "/v1/query", honest)
        idle, over = _memory_mb(process.pid), threading.Event()
        clients = [
            threading.Thread(target=_poll_health, args=(port, measured, over)),
            threading.Thread(target=_send_queries, args=(port, honest, measured, over)),
            threading.Thread(target=_watch_memory, args=(process.pid, idle, measured, over)),
        ]
        for client in clients:
            client.start()
        time.sleep(0.5)
        measured.answered = ATTACKS[attack](port, gels[-1])
        time.sleep(2)
        over.set()
        for client in clients:
            client.join()
        begun = time.monotonic()
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(60)
        except subprocess.TimeoutExpired:
            process.kill()
        measured.exit_s = time.monotonic() - begun
    return measured


@contextmanager
def _service(index: Path, folder: Path) -> Iterator[tuple[subprocess.Popen[str], int]]:
    command = [sys.executable, "-m", "retrieval", "serve", "--port", "0"]
    log = (folder / "log").open("w")
    process = subprocess.Popen(
        [*command, "--index", str(index), "--history", str(folder / "history")], stderr=log, text=True
    )
    try:
        deadline = time.monotonic() + 60
        while not (port := _port((folder / "log").read_text())):
            if process.poll() is not None or time.monotonic() > deadline:
                sys.exit(f"the service did not start: {(folder / 'log').read_text()}")
            time.sleep(0.1)
        yield process, port
    finally:
        process.kill()
        process.wait()
        log.close()


def _port(text: str) -> int | None:
    """Return the port in a line of the service's log such as `http://127.0.0.1:8000`."""
    after = text.partition("http://127.0.0.1:")[2]
    digits = after[: len(after) - len(after.lstrip("0123456789"))]
    return int(digits) if digits and len(after) > len(digits) else None


def _poll_health(port: int, measured: AttackResult, over: threading.Event) -> None:
    while not over.is_set():
        begun = time.monotonic()
        status = _request(port, "GET", "/healthz")
        if status == 200:
            measured.health_s.append(time.monotonic() - begun)
        else:
            measured.health_failed += 1
        time.sleep(0.05)


def _send_queries(port: int, body: bytes, measured: AttackResult, over: threading.Event) -> None:
    """Send honest queries; after 429, wait and retry for at most 10 s."""
    while not over.is_set():
        begun = time.monotonic()
        while (status := _request(port, "POST", "/v1/query", body)) == 429 and time.monotonic() < begun + 10:
            time.sleep(0.2)
        if status == 200:
            measured.query_s.append(time.monotonic() - begun)
        else:
            measured.query_failed += 1
        time.sleep(0.25)


def _watch_memory(pid: int, idle: float, measured: AttackResult, over: threading.Event) -> None:
    while not over.wait(0.05):
        measured.memory_mb = max(measured.memory_mb, _memory_mb(pid) - idle)


def _memory_mb(pid: int) -> float:
    """Return the proportional memory of a process and its children."""
    total, waiting = 0.0, [pid]
    while waiting:
        one = waiting.pop()
        try:
            for line in Path(f"/proc/{one}/smaps_rollup").read_text().splitlines():
                if line.startswith("Pss:"):
                    total += int(line.split()[1]) / 1024
            for task in os.listdir(f"/proc/{one}/task"):
                waiting += map(int, Path(f"/proc/{one}/task/{task}/children").read_text().split())
        except OSError:
            continue
    return total


def main() -> None:
    """Run the attacks; exit with 1 if one of them broke a limit."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("index", type=Path)
    parser.add_argument("--gelsight", type=Path, nargs="+", required=True)
    parser.add_argument("--only", nargs="+", choices=ATTACKS, default=ATTACKS)
    arguments = parser.parse_args()
    gels = tuple(path.read_bytes() for path in arguments.gelsight)
    print(HEAD, flush=True)
    all_hold = True
    for attack in ATTACKS:
        if attack in arguments.only:
            measured = measure(attack, arguments.index, gels)
            print(measured.row(), flush=True)
            all_hold = all_hold and measured.holds
    sys.exit(0 if all_hold else 1)


if __name__ == "__main__":
    main()
