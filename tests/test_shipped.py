"""The shipped checkpoint, judged in small."""

from tests import shipped


def test_the_shipped_checkpoint_is_far_above_chance_on_objects_it_never_saw(capsys):
    assert shipped.main(["score", "--objects", "13", "--grasps", "2", "--jobs", "1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    first_guess = next(line for line in lines if line.startswith("| K=5"))
    assert float(first_guess.split("|")[2]) > 0.4
