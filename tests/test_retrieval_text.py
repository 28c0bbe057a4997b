"""Text that UTF-8 cannot hold is refused where it enters, or shown as U+FFFD."""

import io
import json
import tarfile

import pytest

from retrieval.data.catalogue import list_catalogue
from retrieval.data.sources import list_photos
from retrieval.data.text import is_utf8, utf8_of
from retrieval.errors import DatasetError
from retrieval.search.objects import listed_photo
from retrieval.serve.errors import Problem
from robot.errors import RecordingError
from robot.recording.folder import read_recording

HALF = "\ud83d"  # the first half of an emoji
NAME = "mug\udcff"  # the byte ff in a file name


@pytest.mark.parametrize(
    ("line", "told"),
    [
        (r'{"object_id": "mug", "note": "nice \ud83d"}', "lone surrogate"),
        (r'{"object_id": "mug", "\ude00": 1}', "lone surrogate"),
        (r'{"object_id": "mug\ud83d", "note": 1}', "lone surrogate"),
        (r'{"object_id": "mug", "deep": [{"a": ["\udfff"]}]}', "lone surrogate"),
    ],
)
def test_half_of_a_character_in_the_metadata_of_a_catalogue_is_refused_with_its_line(own, line, told):
    (own / "metadata.jsonl").write_text('{"object_id": "a", "note": "\\ud83d\\ude00"}\n' + line + "\n")
    with pytest.raises(DatasetError, match=rf"metadata.jsonl, line 2: it holds half of a character .*{told}") as raised:
        list_catalogue(own)
    assert "\n" not in str(raised.value)


def test_a_whole_character_of_two_escapes_is_taken(own):
    name = sorted(path.name for path in own.iterdir())[0]
    (own / "metadata.jsonl").write_text(json.dumps({"object_id": name, "note": "\U0001f600"}) + "\n")
    assert list_catalogue(own).photos[0].metadata == {"note": "\U0001f600"}


def test_half_of_a_character_in_an_archive_is_refused_with_its_member(tmp_path):
    with tarfile.open(tmp_path / "photos.tar", "w") as archive:
        for name, data in (("1.jpg", b"x"), ("1.json", rb'{"object_id": "mug\ud83d"}')):
            member = tarfile.TarInfo(name)
            member.size = len(data)
            archive.addfile(member, io.BytesIO(data))
    with pytest.raises(DatasetError, match=r"photos.tar, 1.json: it holds half of a character"):
        list_photos(str(tmp_path / "photos.tar"))


def test_members_of_an_archive_whose_names_are_not_utf8_are_left_out(tmp_path):
    with tarfile.open(tmp_path / "photos.tar", "w") as archive:
        for name in (f"{NAME}/1.jpg", "cup/1.jpg"):
            archive.addfile(tarfile.TarInfo(name))
    found = list_photos(str(tmp_path / "photos.tar"))
    assert found.photos.paths == ("cup/1.jpg",)
    assert [(one.path, one.reason) for one in found.skipped] == [
        (r"mug\xff/1.jpg", "the name is not valid UTF-8; rename it")
    ]


@pytest.mark.parametrize("text", [r'"object_id": "mug\ud83d"', r'"object_id": "mug", "source": "\ud83d"'])
def test_half_of_a_character_in_a_recording_is_refused_with_its_line(recording, tmp_path, text):
    (tmp_path / "recording.json").write_bytes((recording / "recording.json").read_bytes())
    (tmp_path / "metadata.jsonl").write_text("{" + text + "}\n")
    with pytest.raises(
        RecordingError, match=r"metadata.jsonl, line 1: must be JSON in UTF-8: .*surrogates not allowed"
    ):
        read_recording(tmp_path)


def test_rows_of_an_older_index_are_shown_with_a_mark_in_place_of_what_utf8_cannot_hold():
    row = {"id": "a", "object_id": f"mug{HALF}", "path": "mug/1.jpg", "metadata": {"note": [HALF, "\U0001f600"]}}
    found = listed_photo(row)
    assert (found.object_id, found.metadata) == ("mug\ufffd", {"note": ["\ufffd", "\U0001f600"]})


def test_text_that_utf8_can_hold_stays_the_same_object():
    document = {"a": ["é", "\U0001f600", 1.5, None]}
    assert utf8_of(document) is document
    assert not is_utf8({HALF: 1})


def test_a_problem_that_names_a_file_of_unknown_coding_is_a_document():
    body = Problem("unknown", f"{NAME}.jpg is gone").response().body
    assert json.loads(body)["detail"] == "mug\ufffd.jpg is gone"
