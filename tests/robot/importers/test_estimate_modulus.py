"""Importer of EstimateModulus; test_importers.py tests the common behaviour."""

from robot.importers.estimate_modulus import import_estimate_modulus
from tests.miniatures import estimate_modulus


def test_a_day_is_a_session_and_an_object_has_one_name_on_all_days(tmp_path):
    estimate_modulus.write(tmp_path / "clone" / "example_data")
    (tmp_path / "clone" / "example_data" / "old").mkdir()
    recording = import_estimate_modulus(tmp_path / "clone", tmp_path / "out")
    found = {
        day: {grasp.object_id for grasp in recording.grasps if grasp.session == day} for day in estimate_modulus.DAYS
    }
    assert found == {day: set(objects) for day, (_, _, objects) in estimate_modulus.DAYS.items()}
    sequences = {grasp.sequence_id for grasp in recording.grasps if grasp.object_id == "golf_ball"}
    assert sequences == {
        f"{day}-golf_ball-{k}"
        for day, k in (("2023-12-06", 1), ("2023-12-06", 2), ("2023-12-16", 0), ("2023-12-16", 1))
    }
