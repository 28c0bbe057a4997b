"""Output files of commands: written atomically, only over files of their kind, with cleanup after killed writers."""

import contextlib
import errno
import os
import resource
import signal
import socket
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from _touch_retrieval import files
from _touch_retrieval.files import write_atomically
from retrieval.console.files import (
    CARD,
    CHECKPOINT,
    EXPORT,
    HAND_EYE,
    PAGE,
    PREVIEW,
    RESULTS,
    TEXT,
    TIMINGS,
    require_ours,
    text_bytes,
    write_output,
)
from retrieval.errors import BadInput

ROOT = Path(__file__).parents[3]
KINDS = (CARD, CHECKPOINT, EXPORT, HAND_EYE, PAGE, PREVIEW, RESULTS, TEXT, TIMINGS)
PNG = b"\x89PNG\r\n\x1a\n" + bytes(64)


def test_only_files_of_the_same_kind_are_overwritten(tmp_path):
    foreign = {
        "photo": PNG,
        "index": b"gen-000001\n",
        "page": b"<!doctype html><title>mine</title>",
        "settings": b'{"mine": 1}',
        "weights": (8).to_bytes(8, "little") + b"{}      ",
        "huge header": (2**63).to_bytes(8, "little"),
    }
    for name, data in foreign.items():
        path = tmp_path / name
        path.write_bytes(data)
        for kind in KINDS:
            with pytest.raises(BadInput, match="that this program wrote, so it is not overwritten"):
                write_output(path, b"ours", kind)
            assert path.read_bytes() == data


def test_missing_and_empty_files_are_written(tmp_path):
    (tmp_path / "empty").touch()
    write_output(tmp_path / "empty", b"1", PAGE)
    write_output(tmp_path / "new" / "deep" / "page", b"2", PAGE)
    assert ((tmp_path / "empty").read_bytes(), (tmp_path / "new/deep/page").read_bytes()) == (b"1", b"2")


@pytest.mark.parametrize(
    ("kind", "data"),
    [
        (PAGE, b'<!doctype html>\n<meta name="generator" content="touch-retrieval">'),
        (TEXT, b"<!-- touch-retrieval -->\n\n# Report"),
        (CARD, b"# m.safetensors\n\nMatches touches of 2 gel image(s)"),
        (CHECKPOINT, (39).to_bytes(8, "little") + b'{"__metadata__":{"touch_retrieval":""}}'),
        (EXPORT, bytes(9000) + b"touch_retrieval.sha256" + bytes(68)),
        (RESULTS, b'{"software": "1", "rows": {}}'),
        (TIMINGS, b'{"machine": {}, "methods": {}}'),
        (HAND_EYE, b'{"rigid": [], "residuals_mm": []}'),
        (PREVIEW, PNG + b"tEXtSoftware\0touch-retrieval"),
    ],
)
def test_a_file_of_its_kind_is_replaced(tmp_path, kind, data):
    path = tmp_path / "file"
    path.write_bytes(data)
    write_output(path, b"new", kind)
    assert path.read_bytes() == b"new"


def test_pipes_sockets_devices_and_folders_are_refused_and_unchanged(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    server = socket.socket(socket.AF_UNIX)
    server.bind(str(tmp_path / "socket"))
    (tmp_path / "folder").mkdir()
    for path in (tmp_path / "pipe", tmp_path / "socket", tmp_path / "folder", Path("/dev/null"), Path("/dev/full")):
        mode = path.stat().st_mode
        with pytest.raises(BadInput, match=r"is a (pipe|socket|folder|device)"):
            write_output(path, b"x", PAGE)
        assert path.stat().st_mode == mode
    server.close()


def test_a_link_is_followed_and_stays_a_link(tmp_path):
    (tmp_path / "link").symlink_to("there")
    write_output(tmp_path / "link", b"1", PAGE)
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "there").read_bytes() == b"1"


def test_a_circular_link_is_reported_for_its_file(tmp_path):
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    with pytest.raises(BadInput, match=r"a cannot be opened \(Too many levels of symbolic links\)"):
        require_ours(tmp_path / "a", PAGE)
    with pytest.raises(OSError, match="circle") as error:
        write_atomically(tmp_path / "a", b"")
    assert error.value.filename == str(tmp_path / "a")


def test_a_full_disk_error_names_the_file(tmp_path):
    path = tmp_path / "page.html"
    path.write_bytes(b"old")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        with pytest.raises(OSError, match="File too large") as error:
            write_atomically(path, bytes(5000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)
    assert (error.value.errno, error.value.filename) == (errno.EFBIG, str(path))
    assert [one.name for one in tmp_path.iterdir()] == ["page.html"]
    assert path.read_bytes() == b"old"


def test_the_next_write_removes_the_files_of_a_killed_writer(tmp_path):
    path = tmp_path / "m.safetensors"
    code = (
        "import os, signal, sys\nfrom pathlib import Path\nfrom _touch_retrieval import files\n"
        "files.os.fsync = lambda _: os.kill(os.getpid(), signal.SIGKILL)\n"
        "files.write_atomically(Path(sys.argv[1]), b'partial')"
    )
    done = subprocess.run([sys.executable, "-c", code, str(path)], cwd=ROOT, timeout=60, check=False)
    assert done.returncode == -signal.SIGKILL
    assert len(list(tmp_path.iterdir())) == 1
    (tmp_path / f".m.safetensors.{os.getpid()}.tmp").touch()  # of an older version, with a reused process id
    (tmp_path / ".other.1.tmp").touch()
    write_atomically(path, b"whole")
    assert sorted(one.name for one in tmp_path.iterdir()) == [".other.1.tmp", "m.safetensors"]


def test_files_of_a_running_writer_are_not_removed(tmp_path, monkeypatch):
    path = tmp_path / "page"

    def meanwhile(descriptor):
        monkeypatch.setattr(files.os, "fsync", lambda _: None)
        write_atomically(path, b"second")

    monkeypatch.setattr(files.os, "fsync", meanwhile)
    write_atomically(path, b"first")
    assert path.read_bytes() == b"first"
    assert [one.name for one in tmp_path.iterdir()] == ["page"]


@pytest.mark.parametrize("number", [errno.EINVAL, errno.EACCES, errno.EIO])
def test_disks_without_folder_fsync_work_and_broken_disks_are_reported(tmp_path, monkeypatch, number):
    real = os.fsync

    def refusing(descriptor):
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(number, os.strerror(number))
        real(descriptor)

    monkeypatch.setattr(os, "fsync", refusing)
    outcome = pytest.raises(OSError, match="cannot be written") if number == errno.EIO else contextlib.nullcontext()
    with outcome:
        write_atomically(tmp_path / "page", b"whole")
    assert (tmp_path / "page").read_bytes() == b"whole"


def test_names_of_the_maximum_length_can_be_written(tmp_path):
    for name in ("n" * 255, "ü" * 127):
        write_atomically(tmp_path / name, b"x")
        assert (tmp_path / name).read_bytes() == b"x"


def test_a_name_that_is_too_long_is_reported(tmp_path):
    with pytest.raises(BadInput, match="File name too long"):
        write_output(tmp_path / ("n" * 10_000), b"", PAGE)


def test_a_written_file_has_default_permissions(tmp_path):
    (tmp_path / "plain").touch()
    write_atomically(tmp_path / "ours", b"x")
    assert (tmp_path / "ours").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_page_with_a_name_in_an_unknown_encoding_can_be_written():
    assert text_bytes("m\udcfcg") == b"m&#56572;g"


@given(st.binary(max_size=300))
def test_the_check_of_a_kind_never_raises(data):
    import io

    for kind in KINDS:
        assert kind.is_ours(io.BytesIO(data)) in (True, False)
