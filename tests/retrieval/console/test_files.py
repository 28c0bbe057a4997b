"""Output files of commands: only over files with their suffix, written whole or not at all."""

import errno
import resource
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from _touch_retrieval.files import write_atomically
from retrieval.console.files import require_output, write_output

ROOT = Path(__file__).parents[3]


def test_an_output_replaces_a_file_with_its_suffix_and_creates_its_folder(tmp_path):
    for name in ("page.html", "new/deep/page.html", "n" * 250 + ".html"):
        for data in (b"old", b"new"):
            write_output(tmp_path / name, data)
        assert (tmp_path / name).read_bytes() == b"new"
        require_output(tmp_path / name, ".html")


def test_a_link_is_followed(tmp_path):
    (tmp_path / "link").symlink_to("there")
    write_output(tmp_path / "link", b"1")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "there").read_bytes() == b"1"


def test_a_full_disk_keeps_the_old_file_and_is_reported_with_its_name(tmp_path):
    path = tmp_path / "page.html"
    path.write_bytes(b"old")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        with pytest.raises(OSError, match="File too large") as error:
            write_output(path, bytes(5000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)
    assert (error.value.errno, error.value.filename) == (errno.EFBIG, str(path))
    assert [one.name for one in tmp_path.iterdir()] == ["page.html"]
    assert path.read_bytes() == b"old"


def test_a_killed_writer_keeps_the_old_file(tmp_path):
    path = tmp_path / "m.safetensors"
    path.write_bytes(b"old")
    code = (
        "import os, signal, sys\nfrom pathlib import Path\nfrom _touch_retrieval import files\n"
        "files.os.fsync = lambda _: os.kill(os.getpid(), signal.SIGKILL)\n"
        "files.write_atomically(Path(sys.argv[1]), b'partial')"
    )
    done = subprocess.run([sys.executable, "-c", code, str(path)], cwd=ROOT, timeout=60, check=False)
    assert (done.returncode, path.read_bytes()) == (-signal.SIGKILL, b"old")
    write_atomically(path, b"whole")
    assert path.read_bytes() == b"whole"


def test_a_written_file_has_default_permissions(tmp_path):
    (tmp_path / "plain").touch()
    write_atomically(tmp_path / "ours", b"x")
    assert (tmp_path / "ours").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_page_with_a_name_in_an_unknown_encoding_can_be_written(tmp_path):
    write_output(tmp_path / "page.html", "m\udcfcg")
    assert (tmp_path / "page.html").read_bytes() == b"m&#56572;g"
