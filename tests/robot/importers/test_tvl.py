"""Importers of TVL: HCT and SSVTP; test_importers.py tests the common behaviour."""

import json
import tracemalloc

import pytest

from retrieval.data.check.recording import check_recording
from robot.errors import ImporterError
from robot.importers.ssvtp import import_ssvtp
from robot.importers.tvl import csv_rows, import_tvl
from tests.miniatures import ssvtp, tvl

pytestmark = pytest.mark.usefixtures("no_fsync")


@pytest.fixture
def hct(tmp_path):
    tvl.write(tmp_path / "src")
    return tmp_path / "src"


@pytest.fixture
def pairs(tmp_path):
    ssvtp.write(tmp_path / "src")
    return tmp_path / "src"


# HCT ---------------------------------------------------------------------------------------------------------


def test_a_timestamp_folder_is_object_and_sequence_even_if_two_parts_have_the_same_numbers(hct, tmp_path):
    recording = import_tvl(hct, tmp_path / "out")
    expected = {f"{data}-{contact}" for data, contacts in tvl.CONTACTS.items() for contact in contacts}
    assert {grasp.object_id for grasp in recording.grasps} == expected
    assert all(grasp.sequence_id == grasp.object_id for grasp in recording.grasps)
    assert recording.info["objects"]["data1-1-1702507300.1"]["caption"] == "smooth, hard, cool"


def test_photo_and_touch_have_the_same_name_and_each_contact_has_its_no_contact_frame(hct, tmp_path):
    recording = import_tvl(hct, tmp_path / "out")
    grasp = recording.grasps[0]
    contact = hct / "hct/data1/0-1702507215.615537"
    for path, kind in ((grasp.photo, "vision"), (grasp.touches["a"], "tactile")):
        assert (recording.folder / path).read_bytes() == (contact / kind / f"{tvl.FRAMES[0]}.jpg").read_bytes()
    before = {grasp.object_id: grasp.touches_before["a"] for grasp in recording.grasps}
    assert len(set(before.values())) == 4


def test_frames_without_contact_are_not_grasps_and_frames_are_in_the_order_of_their_numbers(hct, tmp_path):
    recording = import_tvl(hct, tmp_path / "out")
    first = [grasp.grasp_id for grasp in recording.grasps if grasp.object_id == "data2-0-1702600000.5"]
    assert [name.split("1702600000.5-")[1].split("-")[0] for name in first] == ["9", "165", "170"]


def test_all_frames_are_imported_without_contact_json(hct, tmp_path):
    for path in hct.rglob("*contact.json"):
        path.unlink()
    assert len(import_tvl(hct, tmp_path / "out").grasps) == 4 * 4


def test_the_published_split_gets_a_leak_note(hct, tmp_path):
    """All 3 rows of one folder are test rows, and 1 of 3 rows of another folder."""
    recording = import_tvl(hct / "hct", tmp_path / "out")
    (leak,) = [note for note in recording.notes if note.startswith("LEAK")]
    assert "1 of 4 sequences in two parts, and 25% of its test rows are frames of training sequences" in leak
    whole = json.loads((tmp_path / "out/splits/published-whole.json").read_text())
    assert whole["test"] == ["data1-1-1702507300.1"]
    assert len(whole["train"]) == 3


def test_a_note_names_the_check_for_exchanged_folders(hct, tmp_path):
    recording = import_tvl(hct, tmp_path / "out")
    assert any("exchanged in some folders: `retrieve check`" in note for note in recording.notes)
    assert not any(finding.kind == "broken" for finding in check_recording(tmp_path / "out"))


@pytest.mark.parametrize("text", ["[]", "{", '{"tactile": [1]}'])
def test_an_invalid_list_of_contacts_is_refused(hct, tmp_path, text):
    (hct / "hct/data1/contact.json").write_text(text)
    with pytest.raises(ImporterError, match=r"contact\.json (cannot be read|must contain lists of paths)"):
        import_tvl(hct, tmp_path / "out")


@pytest.mark.slow
def test_100000_rows_are_read_one_by_one(tmp_path):
    with open(tmp_path / "train.csv", "w") as file:
        file.write("url,tactile,caption\n")
        file.writelines(
            f'images_rgb/image_{number}_rgb.jpg, images_tac/{number}.jpg, "soft"\n' for number in range(100_000)
        )
    tracemalloc.start()
    try:
        count = sum(row["caption"] == "soft" for row in csv_rows(tmp_path / "train.csv"))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert count == 100_000
    assert peak < 500_000


# SSVTP -------------------------------------------------------------------------------------------------------


def test_each_pair_is_an_object_and_blocks_of_numbers_are_sequences(pairs, tmp_path):
    recording = import_ssvtp(pairs, tmp_path / "out")
    assert [(grasp.object_id, grasp.sequence_id) for grasp in recording.grasps] == [
        (f"pair-{number}", f"block-{number // 50}") for number in ssvtp.NUMBERS
    ]
    assert {grasp.touches_before["a"] for grasp in recording.grasps} == {"images/no_contact_shared.png"}
    blocks = {grasp.sequence_id for grasp in import_ssvtp(pairs, tmp_path / "ten", block=10).grasps}
    assert blocks == {"block-0", "block-1", "block-5", "block-12"}


def test_rows_of_test_csv_without_a_touch_count_in_the_split(pairs, tmp_path):
    recording = import_ssvtp(pairs, tmp_path / "out")
    (leak,) = [note for note in recording.notes if note.startswith("LEAK")]
    assert "has 1 of 3 sequences in two parts, and 67% of its test rows" in leak  # 2 and 10 among 2, 10, 120
    whole = json.loads((tmp_path / "out/splits/published-whole.json").read_text())
    assert whole["test"] == ["pair-120"]


def test_pairs_without_the_no_contact_frame_are_imported_without(pairs, tmp_path):
    (pairs / "ssvtp/tac_background.png").unlink()
    recording = import_ssvtp(pairs / "ssvtp", tmp_path / "out")
    assert recording.info["background"] == "none"
    assert not any(grasp.touches_before for grasp in recording.grasps)


def test_an_empty_block_is_refused(pairs, tmp_path):
    with pytest.raises(ImporterError, match="block must be at least 1, got 0"):
        import_ssvtp(pairs, tmp_path / "out", block=0)
