"""Importer of RCT; test_importers.py tests the common behaviour."""

import pytest

from robot.errors import ImporterError
from robot.importers.rct import import_rct
from tests.miniatures import rct


def test_a_material_is_an_object_a_press_a_sequence_and_a_row_with_a_picture_a_grasp_with_its_force(source, tmp_path):
    recording = import_rct(source, tmp_path / "out")
    assert {grasp.object_id for grasp in recording.grasps} == set(rct.MATERIALS)
    presses = {grasp.sequence_id for grasp in recording.grasps}
    assert len(presses) == 3 * 2 * 2
    assert "Cork 03-1-D20045" in presses
    grasp = next(grasp for grasp in recording.grasps if grasp.grasp_id == "ABS-01-0-D20011-10")
    assert grasp.force_n == 5.0
    picture = source / "tactile/ABS-01/0/D20011/10.png"
    assert (recording.folder / grasp.touches["a"]).read_bytes() == picture.read_bytes()
    assert recording.info["skipped"] == {"no picture matches the option touch": 2}


def test_an_option_selects_one_sensor(source, tmp_path):
    recording = import_rct(source, tmp_path / "out", sensor="D20045")
    assert recording.info["sensor"] == "DIGIT D20045"
    assert len(recording.grasps) == rct.GRASPS / 2
    assert {grasp.sequence_id.split("-")[-1] for grasp in recording.grasps} == {"D20045"}


def test_options_define_the_paths_of_pictures(source, tmp_path):
    (source / "tactile").rename(source / "digit_images")
    with pytest.raises(
        ImporterError, match=r"the folder contains: digit_images, metadata, rgb\); set the paths with --option"
    ):
        import_rct(source, tmp_path / "out")
    recording = import_rct(source, tmp_path / "out", touch="digit_images/{material_id}/*/{sensor}/{z_frame}.png")
    assert len(recording.grasps) == rct.GRASPS + 1  # the row without a folder gets the picture of another position


@pytest.mark.parametrize("pattern", ["tactile/{material}/{z_frame}", "/etc/{sensor}", "", "a**b", "."])
def test_a_pattern_with_other_words_or_outside_the_folder_is_refused(source, tmp_path, pattern):
    with pytest.raises(ImporterError, match=r"braces of touch must contain|a pattern must be a path"):
        import_rct(source, tmp_path / "out", touch=pattern)
