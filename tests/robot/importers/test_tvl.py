"""TVL, its parts HCT and SSVTP: what is their own; what holds of every importer stands in test_robot_importers."""

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


def test_a_timestamp_folder_is_object_and_sequence_also_where_two_parts_number_alike(hct, tmp_path):
    recording = import_tvl(hct, tmp_path / "out")
    wanted = {f"{data}-{contact}" for data, contacts in tvl.CONTACTS.items() for contact in contacts}
    assert {grasp.object_id for grasp in recording.grasps} == wanted
    assert all(grasp.sequence_id == grasp.object_id for grasp in recording.grasps)
    assert recording.info["objects"]["data1-1-1702507300.1"]["caption"] == "smooth, hard, cool"


def test_photo_and_touch_have_one_name_and_each_contact_its_no_contact_frame(hct, tmp_path):
    recording = import_tvl(hct, tmp_path / "out")
    grasp = recording.grasps[0]
    contact = hct / "hct/data1/0-1702507215.615537"
    for path, kind in ((grasp.photo, "vision"), (grasp.touches["a"], "tactile")):
        assert (recording.folder / path).read_bytes() == (contact / kind / f"{tvl.FRAMES[0]}.jpg").read_bytes()
    before = {grasp.object_id: grasp.touches_before["a"] for grasp in recording.grasps}
    assert len(set(before.values())) == 4


def test_frames_in_the_air_are_no_grasps_and_frames_are_in_the_order_of_their_numbers(hct, tmp_path):
    recording = import_tvl(hct, tmp_path / "out")
    first = [grasp.grasp_id for grasp in recording.grasps if grasp.object_id == "data2-0-1702600000.5"]
    assert [name.split("1702600000.5-")[1].split("-")[0] for name in first] == ["9", "165", "170"]


def test_without_contact_json_all_frames_of_both_folders_count(hct, tmp_path):
    for path in hct.rglob("*contact.json"):
        path.unlink()
    assert len(import_tvl(hct, tmp_path / "out").grasps) == 4 * 4


def test_the_published_split_is_told_as_a_leak_with_its_share(hct, tmp_path):
    """One folder is tested alone with 3 rows, of another one row of 3 is tested."""
    recording = import_tvl(hct / "hct", tmp_path / "out")
    (leak,) = [note for note in recording.notes if note.startswith("LEAK")]
    assert "1 of 4 sequences on two sides, and 25% of its test rows are frames of sequences that it trains on" in leak
    left = json.loads((tmp_path / "out/splits/published-whole.json").read_text())
    assert left["test"] == ["data1-1-1702507300.1"]
    assert len(left["train"]) == 3


def test_folders_that_were_exchanged_in_the_upload_are_for_the_check_which_the_importer_says(hct, tmp_path):
    recording = import_tvl(hct, tmp_path / "out")
    assert any("exchanged in some folders: run `retrieve check`" in note for note in recording.notes)
    assert not any(finding.kind == "broken" for finding in check_recording(tmp_path / "out"))


@pytest.mark.parametrize("text", ["[]", "{", '{"tactile": [1]}'])
def test_a_list_of_contacts_that_is_none_is_refused_in_a_sentence(hct, tmp_path, text):
    (hct / "hct/data1/contact.json").write_text(text)
    with pytest.raises(ImporterError, match=r"contact\.json (cannot be read|must hold lists of paths)"):
        import_tvl(hct, tmp_path / "out")


@pytest.mark.slow
def test_a_hundred_thousand_rows_are_read_one_after_the_other(tmp_path):
    with open(tmp_path / "train.csv", "w") as file:
        file.write("url,tactile,caption\n")
        file.writelines(f'images_rgb/image_{at}_rgb.jpg, images_tac/{at}.jpg, "soft"\n' for at in range(100_000))
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
    assert {grasp.touches_before["a"] for grasp in recording.grasps} == {"images/untouched_shared.png"}
    blocks = {grasp.sequence_id for grasp in import_ssvtp(pairs, tmp_path / "ten", block=10).grasps}
    assert blocks == {"block-0", "block-1", "block-5", "block-12"}


def test_rows_of_test_csv_have_no_touch_and_count_all_the_same(pairs, tmp_path):
    recording = import_ssvtp(pairs, tmp_path / "out")
    (leak,) = [note for note in recording.notes if note.startswith("LEAK")]
    assert "has 1 of 3 sequences on two sides, and 67% of its test rows" in leak  # 2 and 10 of 2, 10, 120
    left = json.loads((tmp_path / "out/splits/published-whole.json").read_text())
    assert left["test"] == ["pair-120"]


def test_pairs_without_the_no_contact_frame_are_imported_without(pairs, tmp_path):
    (pairs / "ssvtp/tac_background.png").unlink()
    recording = import_ssvtp(pairs / "ssvtp", tmp_path / "out")
    assert recording.info["background"] == "none"
    assert not any(grasp.touches_before for grasp in recording.grasps)


def test_a_block_of_no_pairs_is_refused(pairs, tmp_path):
    with pytest.raises(ImporterError, match="block must be 1 or more pairs, got 0"):
        import_ssvtp(pairs, tmp_path / "out", block=0)
