"""A service whose history cannot be written, as on a read-only volume, says what to do: --history or --no-history."""

import pytest

import robot.recording.folder
from retrieval.commands.main import main
from retrieval.errors import BadInput
from retrieval.serve.store import HistoryStore


def check(folder, get):
    capsys, index, file = get("capsys"), str(get("index")), folder / "file"
    file.write_text("no folder")

    def assert_refused(history, text):
        assert main(["serve", "--index", index, "--history", str(history)]) == 2
        message = capsys.readouterr().err.splitlines()[-1]
        assert text in message
        assert "--no-history" in message

    with pytest.MonkeyPatch.context() as patch:

        def read_only(path):
            raise OSError(30, "Read-only file system", str(path))

        patch.setattr(robot.recording.folder, "LineFile", read_only)
        assert_refused(folder / "history", "Read-only file system")
    assert_refused(file, "file")
    assert_refused(file / "history", "file")
    (folder / "history.sqlite").mkdir()
    (folder / "other.sqlite").write_text("no database, but longer than a header " * 9)
    for path in (file / "history.sqlite", folder / "history.sqlite", folder / "other.sqlite"):
        with pytest.raises(BadInput, match=f"{path} must be .* --history, or .* --no-history"):
            HistoryStore(path)
